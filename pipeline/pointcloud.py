"""The point cloud as arrays, and the ASPRS classes that the steps use."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# ASPRS LAS 1.4 R15, tables 9 and 17.
UNCLASSIFIED = 1
GROUND = 2
LOW_VEGETATION = 3
MEDIUM_VEGETATION = 4
HIGH_VEGETATION = 5
BUILDING = 6
LOW_NOISE = 7
WATER = 9
HIGH_NOISE = 18


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of one or several files.

    Attributes
    ----------
    xyz : float64, (n, 3)
        Coordinates in the region's CRS, heights in the data's vertical datum (m).
    classification : uint8, (n,)
        ASPRS class of each point.
    """

    xyz: NDArray[np.float64]
    classification: NDArray[np.uint8]

    def __post_init__(self) -> None:
        n = len(self.xyz)
        if self.xyz.shape != (n, 3) or self.classification.shape != (n,):
            raise ValueError(f"xyz {self.xyz.shape} and classification {self.classification.shape} do not match")
