"""Target edge lengths in the plane that grow with the distance to the nearest wall (step 3.1, ours).

``h(d) = min(open_size, mesh_size + grading * d)``. It is a function of a place and of the walls within the rule's
reach of it alone, so that seams and tiles that know these walls have the same sizes, bit for bit.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray


@dataclass(frozen=True)
class SizeRule:
    """How edges grow away from walls.

    Attributes
    ----------
    mesh_size : float
        Target edge length at walls (m).
    open_size : float
        The largest (m), above that at walls.
    grading : float
        By how much it grows for each metre away from walls.
    """

    mesh_size: float
    open_size: float
    grading: float

    @property
    def reach(self) -> float:
        """Distance to walls (m) from which on the size is the largest."""
        return (self.open_size - self.mesh_size) / self.grading


@dataclass(frozen=True, eq=False)
class SizeField:
    """A rule, and the walls that distances count from.

    Attributes
    ----------
    rule : SizeRule
        The rule.
    walls : STRtree
        What distances count from: walls as lines, at least all within the rule's reach of the places that are
        asked for.
    """

    rule: SizeRule
    walls: shapely.STRtree


def size_field(walls: NDArray[np.float64], rule: SizeRule) -> SizeField:
    """Make the sizes around walls: float64 (w, 2, 2), start and end of each (m); there may be none."""
    return SizeField(rule, shapely.STRtree(shapely.linestrings(walls)))


def size_field_around(box: tuple[float, float, float, float], rule: SizeRule) -> SizeField:
    """Make sizes that grow away from a box (xmin, ymin, xmax, ymax) (m), and are those at walls within it.

    Examples
    --------
    >>> field = size_field_around((0.0, 0.0, 9.0, 9.0), SizeRule(10.0, 40.0, 0.5))
    >>> local_sizes(field, np.array([[4.0, 4.0], [12.0, 13.0]]), mesh_size=10.0)
    array([10. , 12.5])
    """
    return SizeField(rule, shapely.STRtree([shapely.box(*box)]))


def wall_distances(field: SizeField, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance from places, float64 (n, 2) (m), to the nearest wall, the rule's reach at most: float64 (n,) (m).

    Examples
    --------
    >>> field = size_field(np.array([[[0.0, 0.0], [0.0, 9.0]]]), SizeRule(10.0, 40.0, 0.5))
    >>> wall_distances(field, np.array([[3.0, 4.0], [99.0, 4.0]]))
    array([ 3., 60.])
    """
    distance = np.full(len(xy), field.rule.reach)
    (row, _), found = field.walls.query_nearest(
        shapely.points(xy), max_distance=field.rule.reach, return_distance=True, all_matches=False
    )
    distance[row] = np.minimum(found, field.rule.reach)
    return distance


def local_sizes(field: SizeField | None, xy: NDArray[np.float64], *, mesh_size: float) -> NDArray[np.float64]:
    """Target edge length at places.

    Parameters
    ----------
    field : SizeField or None
        None gives the same size everywhere.
    xy : float64, (n, 2)
        Places (m).
    mesh_size : float
        That size (m).

    Returns
    -------
    float64, (n,)
        Sizes (m).

    Examples
    --------
    >>> field = size_field(np.array([[[0.0, 0.0], [0.0, 9.0]]]), SizeRule(10.0, 40.0, 0.5))
    >>> local_sizes(field, np.array([[0.0, 4.0], [3.0, 4.0], [99.0, 4.0]]), mesh_size=10.0)
    array([10. , 11.5, 40. ])
    """
    if field is None:
        return np.full(len(xy), mesh_size)
    rule = field.rule
    size: NDArray[np.float64] = np.minimum(
        rule.mesh_size + rule.grading * wall_distances(field, xy), rule.open_size
    )
    return size


def largest_size(field: SizeField | None, *, mesh_size: float) -> float:
    """Return the largest target edge length (m): `mesh_size` where sizes are the same everywhere."""
    return mesh_size if field is None else field.rule.open_size
