"""Outlines: polygons by their rings of vertices, with the corners that neighbours have on them (for `cuts`)."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.inside import Rings, edges_of_rings, find_owner, read_rings
from pipeline.geometry.segments import insert_corners

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Outline:
    """A polygon by its rings."""

    xy: Array  #: (n, 2): vertices (m) of its closed rings, one after the other, the shell first
    ring: Index  #: (n,): ring of each vertex, ascending
    given: shapely.Polygon | None = None  #: the polygon, where there is one

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The polygon, of these vertices to the bit."""
        if self.given is not None:
            return self.given
        shell, *holes = shapely.linearrings(self.xy, indices=self.ring - self.ring[0])
        return shapely.polygons(shell, holes=holes or None)

    @cached_property
    def ends(self) -> tuple[Array, Array]:
        """From and to of each edge, float64 (m, 2) (m); none has no length."""
        edges = edges_of_rings(Rings(np.array([0, len(self.xy)]), self.xy, self.ring))
        long = (edges.a != edges.b).any(axis=1)
        return (edges.a, edges.b) if long.all() else (edges.a[long], edges.b[long])

    @cached_property
    def area(self) -> float:
        """Area (m²)."""
        return float(_area(self.xy, self.ring))

    @property
    def n_rings(self) -> int:
        """Number of rings."""
        return int(self.ring[-1] - self.ring[0]) + 1

    def with_corners(self, corners: Array) -> "Outline":
        """Take those of `corners`, float64 (c, 2), that lie on edges as vertices, to the bit."""
        xy, ring = insert_corners(self.xy, self.ring, corners)
        return self if len(xy) == len(self.xy) else Outline(xy, ring)


def open_outline(polygon: shapely.Polygon) -> Outline:
    """Outline of a polygon."""
    rings = read_rings(np.array([polygon]))
    return Outline(rings.xy, rings.ring, polygon)


def points_by_piece(pieces: NDArray[np.object_], xyz: Array) -> Iterator[tuple[Outline, Array]]:
    """Give the points in each piece of a polygon.

    Parameters
    ----------
    pieces : object, (k,)
        Polygons that do not overlap, few of them.
    xyz : float64, (n, 3)
        Points (m).

    Yields
    ------
    Outline, float64 (m, 3)
        Each piece, with the points inside in their order; those on outlines are in none.
    """
    rings = read_rings(pieces)
    owner = find_owner(pieces, xyz, edges=edges_of_rings(rings))
    dealt, first = _sort_by_owner(xyz, owner, len(pieces))
    for k, piece in enumerate(pieces):
        begin, end = rings.start[k], rings.start[k + 1]
        yield Outline(rings.xy[begin:end], rings.ring[begin:end], piece), dealt[first[k] : first[k + 1]]


@kernel
def _area(xy: Array, ring: Index) -> float:
    """Area of the shell less those of the holes."""
    area = twice = 0.0
    first = 0
    for v in range(1, len(xy)):
        if ring[v] != ring[v - 1]:
            first, twice = v, 0.0
            continue
        x, y = xy[first, 0], xy[first, 1]
        twice += (xy[v - 1, 0] - x) * (xy[v, 1] - y) - (xy[v, 0] - x) * (xy[v - 1, 1] - y)
        if v + 1 == len(xy) or ring[v + 1] != ring[v]:
            area += abs(twice) / 2 if ring[v] == ring[0] else -abs(twice) / 2
    return area


@kernel
def _sort_by_owner(xyz: Array, owner: Index, n: int) -> tuple[Array, Index]:
    """Put points in the order of their owners, those of none left out; gives where each owner's begin."""
    start = np.zeros(n + 2, np.int64)
    for k in range(len(xyz)):
        start[owner[k] + 2] += 1  # those of none first
    start[1] = 0
    for i in range(1, n + 2):
        start[i] += start[i - 1]
    dealt, to = np.empty((start[n + 1], 3)), start[1:].copy()
    for k in range(len(xyz)):
        if owner[k] >= 0:
            row = to[owner[k]]
            dealt[row, 0], dealt[row, 1], dealt[row, 2] = xyz[k, 0], xyz[k, 1], xyz[k, 2]
            to[owner[k]] += 1
    return dealt, start[1:]
