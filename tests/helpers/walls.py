"""Walls of boundary pieces seen from the side: over each edge of the plan they face one way and overlap nowhere.

Known from the facets alone: cells that stand on both sides of a wall and differ above its top leave a baffle
there, whose facets face both ways. It is closed, so that neither volumes nor pairs of edges tell of it.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from tiler.mesh_files.vtk_files import BoundaryPiece

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WallEdges:
    """Wall facets summed over the edges of the plan that they stand on.

    Attributes
    ----------
    ends : float64, (e, 2, 2)
        Ends of each edge (m), the smaller one first.
    area : float64, (e,)
        Sum of the areas of its facets (m²).
    signed : float64, (e,)
        The same, facets that face the other way counted as negative (m²).
    span : float64, (e,)
        Area between the lowest and the highest corners at both ends (m²).
    slanted : int
        Facets of walls that are not over one edge.
    """

    ends: NDArray[np.float64]
    area: NDArray[np.float64]
    signed: NDArray[np.float64]
    span: NDArray[np.float64]
    slanted: int


def wall_edges(pieces: Iterable[BoundaryPiece]) -> WallEdges:
    """Sum the wall facets of pieces, which meet at seams, over the edges of the plan."""
    corners = [
        piece.points[piece.boundary.facets[piece.boundary.marker == Marker.WALL]].reshape(-1, 3, 3)
        for piece in pieces
    ]
    return sum_walls(np.concatenate([np.empty((0, 3, 3)), *corners]))


def sum_walls(corners: Array) -> WallEdges:
    """Sum wall facets, float64 (n, 3, 3), over the edges of the plan."""
    if not len(corners):
        nothing = np.empty(0)
        return WallEdges(np.empty((0, 2, 2)), nothing, nothing, nothing, 0)
    place, of_corner = np.unique(corners[..., :2].reshape(-1, 2), axis=0, return_inverse=True)
    of_corner = of_corner.reshape(-1, 3)
    first, last = of_corner.min(axis=1), of_corner.max(axis=1)
    on_edge = ((of_corner == first[:, None]) | (of_corner == last[:, None])).all(axis=1) & (first < last)
    corners, of_corner, first, last = (array[on_edge] for array in (corners, of_corner, first, last))
    pairs, edge = np.unique(np.column_stack((first, last)), axis=0, return_inverse=True)
    ends = place[pairs]
    length = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    s = np.where(of_corner == last[:, None], length[edge][:, None], 0.0)
    z = corners[..., 2]
    signed = 0.5 * ((s[:, 1] - s[:, 0]) * (z[:, 2] - z[:, 0]) - (s[:, 2] - s[:, 0]) * (z[:, 1] - z[:, 0]))
    low, high = np.full((len(pairs), 2), np.inf), np.full((len(pairs), 2), -np.inf)
    at = (np.repeat(edge, 3), (of_corner == last[:, None]).ravel().astype(np.int64))
    np.minimum.at(low, at, z.ravel())
    np.maximum.at(high, at, z.ravel())
    return WallEdges(
        ends,
        _sum(np.abs(signed), edge, len(pairs)),
        _sum(signed, edge, len(pairs)),
        0.5 * length * (high - low).sum(axis=1),
        int((~on_edge).sum()),
    )


def _sum(values: Array, group: NDArray[np.int64], n: int) -> Array:
    result = np.zeros(n)
    np.add.at(result, group, values)
    return result


def prove_walls(walls: WallEdges) -> None:
    """Prove that walls are upright, face one way over each edge, and overlap nowhere."""
    assert walls.slanted == 0
    room = 1e-9 * (1.0 + walls.span)
    both = np.flatnonzero(walls.area - np.abs(walls.signed) > room)
    assert not len(both), f"{len(both)} edges have walls that face both ways, as {walls.ends[both[0]].tolist()}"
    more = np.flatnonzero(np.abs(walls.area - walls.span) > room)
    assert not len(more), f"{len(more)} edges have walls that overlap or gape, as {walls.ends[more[0]].tolist()}"
