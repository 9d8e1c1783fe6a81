"""The point cloud as arrays."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.classes import BUILDING, UNCLASSIFIED

N_CLASSES = 256  # that a point may have


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of one or several files."""

    xyz: NDArray[np.float64]  #: (n, 3): coordinates in the region's CRS, heights in the data's vertical datum (m)
    classification: NDArray[np.uint8]  #: (n,): ASPRS class of each point

    def __post_init__(self) -> None:
        n = len(self.xyz)
        if self.xyz.shape != (n, 3) or self.classification.shape != (n,):
            raise ValueError(f"xyz {self.xyz.shape} and classification {self.classification.shape} do not match")


def rename_classes(marks: Collection[int]) -> NDArray[np.uint8]:
    """Give each class the number that it has here, where others than `BUILDING` may mark buildings.

    Parameters
    ----------
    marks : collection of int
        Classes that mark buildings in the files.

    Returns
    -------
    uint8, (256,)
        `BUILDING` for these; `UNCLASSIFIED` for `BUILDING` where it is not among them; the others as they are.

    Examples
    --------
    >>> rename_classes([8, 67])[[2, 6, 8, 67]].tolist()
    [2, 1, 6, 6]
    """
    become = np.arange(N_CLASSES, dtype=np.uint8)
    become[BUILDING] = UNCLASSIFIED
    become[list(marks)] = BUILDING
    return become
