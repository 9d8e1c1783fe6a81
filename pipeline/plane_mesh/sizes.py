"""Target edge lengths in the plane that grow with the distance to the nearest wall (step 3.1, ours).

``h(d) = min(open_size, mesh_size + grading * d)``, and at most ``size + growth * d`` around what is to be
finer, walls or areas. It is a function of a place, of the walls within the rule's reach of it, and of areas that
are known everywhere, so that seams and tiles that know these walls have the same sizes, bit for bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray


@dataclass(frozen=True)
class SizeRule:
    """How edges grow away from walls."""

    mesh_size: float  #: target edge length at walls (m)
    open_size: float  #: the largest (m), above that at walls
    grading: float  #: by how much it grows for each metre away from walls
    wall_size: float = 0.0  #: finer length at walls (m), in the plane alone; 0 for none
    wall_grading: float = 0.0  #: by how much that grows for each metre away from walls

    @property
    def reach(self) -> float:
        """Distance to walls (m) from which on the size is the largest."""
        return (self.open_size - self.mesh_size) / self.grading

    @property
    def wall_reach(self) -> float:
        """Distance to walls (m) from which on these make nothing finer."""
        return (self.open_size - self.wall_size) / self.wall_grading if self.wall_size else 0.0

    @property
    def at_walls(self) -> float:
        """Target edge length on walls (m)."""
        return self.wall_size or self.mesh_size


@dataclass(frozen=True, eq=False)
class Finer:
    """A bound on sizes around some shapes."""

    size: float  #: target edge length in and on them (m)
    growth: float  #: by how much it grows for each metre away from them
    shapes: shapely.STRtree  #: areas or lines
    upright: bool = True  #: whether the vertical spacing follows


@dataclass(frozen=True, eq=False)
class SizeField:
    """A rule, and the walls that distances count from."""

    rule: SizeRule  #: the rule
    #: what distances count from: walls as lines, at least all within the rule's reach of the places that are asked
    #: for
    walls: shapely.STRtree
    finer: tuple[Finer, ...] = ()  #: what makes sizes finer than the rule

    @property
    def smallest(self) -> float:
        """The smallest size that it can have (m)."""
        return min([self.rule.mesh_size, *(part.size for part in self.finer)])


def size_field(walls: NDArray[np.float64], rule: SizeRule, finer: Sequence[Finer] = ()) -> SizeField:
    """Make the sizes around walls: float64 (w, 2, 2), start and end of each (m); there may be none."""
    tree = shapely.STRtree(shapely.linestrings(walls))
    return SizeField(rule, tree, (*finer, *finer_walls(tree, rule)))


def finer_walls(walls: shapely.STRtree, rule: SizeRule) -> tuple[Finer, ...]:
    """Make the finer sizes of a rule at walls: one, or none."""
    return (Finer(rule.wall_size, rule.wall_grading, walls, upright=False),) if rule.wall_size else ()


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
    return _distances(field.walls, xy, field.rule.reach)


def _distances(shapes: shapely.STRtree, xy: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """Distance to the nearest shape (m), (n,); the reach where none is closer."""
    distance = np.full(len(xy), reach)
    if reach > 0:
        (row, _), found = shapes.query_nearest(
            shapely.points(xy), max_distance=reach, return_distance=True, all_matches=False
        )
        distance[row] = np.minimum(found, reach)
    return distance


def finer_sizes(finer: Sequence[Finer], xy: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """Size that shapes leave to places (m), float64 (n,): the smallest of their bounds, `most` far from them.

    Examples
    --------
    >>> part = Finer(2.0, 0.2, shapely.STRtree([shapely.box(0, 0, 9, 9)]))
    >>> finer_sizes([part], np.array([[4.0, 4.0], [14.0, 4.0], [99.0, 4.0]]), 10.0)
    array([ 2.,  3., 10.])
    """
    size = np.full(len(xy), most)
    for part in finer:
        reach = (most - part.size) / part.growth
        size = np.minimum(size, part.size + part.growth * _distances(part.shapes, xy, reach))
    return size


def local_sizes(
    field: SizeField | None, xy: NDArray[np.float64], *, mesh_size: float, upright: bool = False
) -> NDArray[np.float64]:
    """Target edge length at places.

    Parameters
    ----------
    field : SizeField or None
        None gives the same size everywhere.
    xy : float64, (n, 2)
        Places (m).
    mesh_size : float
        That size (m).
    upright : bool
        Give those that the vertical spacing follows: finer walls count in the plane alone.

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
    finer = [part for part in field.finer if part.upright or not upright]
    return np.minimum(size, finer_sizes(finer, xy, rule.open_size)) if finer else size


def largest_size(field: SizeField | None, *, mesh_size: float) -> float:
    """Return the largest target edge length (m): `mesh_size` where sizes are the same everywhere."""
    return mesh_size if field is None else field.rule.open_size
