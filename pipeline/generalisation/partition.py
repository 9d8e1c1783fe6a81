"""A tile parted by barriers: its pieces of cells, the borders that they share, and those on the tile's sides."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.generalisation.barriers import GRID, order_ends
from pipeline.geometry.rings import make_canonical, sort_canonically

WEST, EAST, SOUTH, NORTH = range(4)
APART = 0.01  # m; pieces of two tiles that share less of their border are not one cell

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Borders:
    """What the pieces of a tile share with each other and with other tiles."""

    area: Array  #: (n,): of each piece (m2)
    pairs: Index  #: (p, 2): pieces that share a border, the lesser first, each pair once
    length: Array  #: (p,): of that border (m)
    #: (s,): pieces on the sides of the tile, and which side: `WEST`, `EAST`, `SOUTH`, `NORTH`
    piece: Index
    side: Index
    #: (s,): from where to where, along that side (m)
    low: Array
    high: Array
    barrier: NDArray[np.bool_]  #: (s,): whether a barrier runs along it


def partition_tile(segments: Array, box: Box, rim: shapely.Polygon) -> NDArray[np.object_]:
    """Part a tile by barriers.

    Parameters
    ----------
    segments : float64, (k, 4)
        Barriers within the tile, those of the rim among them, on the grid of `GRID` (m).
    box : tuple of 4 floats
        The tile (m).
    rim : shapely.Polygon
        What lies within belongs to the region.

    Returns
    -------
    object, (n,)
        Polygons that cover what of the tile is within the rim, in canonical form and order.

    Notes
    -----
    Segments are noded on the grid; lines that end within a cell part nothing.
    """
    lines = np.append(shapely.linestrings(segments.reshape(-1, 2, 2)), shapely.box(*box).exterior)
    noded = shapely.union_all(lines, grid_size=GRID)
    pieces = shapely.get_parts(shapely.polygonize(shapely.get_parts(noded)))
    shapely.prepare(rim)
    pieces = make_canonical(pieces[shapely.contains(rim, shapely.point_on_surface(pieces))])
    return pieces[sort_canonically(pieces)]


def find_borders(pieces: NDArray[np.object_], segments: Array, box: Box) -> Borders:
    """Measure which pieces share borders, in the tile and on its sides.

    Parameters
    ----------
    pieces : object, (n,)
        From `partition_tile`.
    segments, box
        As of `partition_tile`.
    """
    rings, owner = shapely.get_rings(pieces, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    inner = np.flatnonzero(ring[1:] == ring[:-1])
    edges, piece = order_ends(np.hstack((xy[inner], xy[inner + 1]))), owner[ring[inner]]
    order = np.lexsort((piece, *edges.T))
    edges, piece = edges[order], piece[order]
    again = (edges[1:] == edges[:-1]).all(axis=1)
    first = np.flatnonzero(again)
    both = np.column_stack((piece[first], piece[first + 1]))
    length = np.hypot(*(edges[first, 2:] - edges[first, :2]).T)
    pairs, total = sum_pairs(both, length)
    alone = np.ones(len(edges), np.bool_)
    alone[first] = alone[first + 1] = False
    rows, sides, low, high, barrier = [], [], [], [], []
    for side, at in ((WEST, box[0]), (EAST, box[2]), (SOUTH, box[1]), (NORTH, box[3])):
        across = int(side in (SOUTH, NORTH))  # which coordinate stays the same along the side
        here = np.flatnonzero(alone & (edges[:, across] == at) & (edges[:, across + 2] == at))
        start, stop = edges[here, 1 - across], edges[here, 3 - across]
        along = segments[(segments[:, across] == at) & (segments[:, across + 2] == at)]
        middle = ((start + stop) / 2)[:, None]
        rows.append(piece[here])
        sides.append(np.full(len(here), side))
        low.append(start)
        high.append(stop)
        barrier.append(((along[:, 1 - across] < middle) & (along[:, 3 - across] > middle)).any(axis=1))
    joined = [np.concatenate(part) for part in (rows, sides, low, high, barrier)]
    return Borders(shapely.area(pieces), pairs, total, *joined)


def sum_pairs(pairs: Index, length: Array) -> tuple[Index, Array]:
    """Add up the borders of each pair; pairs of a thing with itself are gone.

    Examples
    --------
    >>> sum_pairs(np.array([[1, 0], [0, 1], [2, 2]]), np.array([1.0, 2.0, 5.0]))
    (array([[0, 1]]), array([3.]))
    """
    two = pairs[:, 0] != pairs[:, 1]
    most = pairs.max(initial=0) + 1
    # One number for both, in which they sort as they do themselves.
    both, number = np.unique(pairs[two].min(axis=1) * most + pairs[two].max(axis=1), return_inverse=True)
    found: Index = np.column_stack((both // most, both % most))
    return found, np.bincount(number, length[two], minlength=len(found)).astype(np.float64)


def match_sides(one: tuple[Index, Array, Array], other: tuple[Index, Array, Array]) -> tuple[Index, Array]:
    """Find which pieces of two tiles meet on the side between them.

    Parameters
    ----------
    one, other : (pieces, low, high)
        Pieces of each tile on the side, and from where to where.

    Returns
    -------
    int64, (p, 2)
        Pieces of one and of the other.
    float64, (p,)
        Length that they share (m).
    """
    places = np.unique(np.concatenate([*one[1:], *other[1:]]))
    middle = (places[1:] + places[:-1]) / 2
    found = []
    for piece, low, high in (one, other):
        order = np.argsort(low, kind="stable")
        row = order[np.maximum(np.searchsorted(low[order], middle) - 1, 0)] if len(low) else np.zeros(0, np.int64)
        inside = (low[row] < middle) & (middle < high[row]) if len(low) else np.zeros(len(middle), np.bool_)
        found.append(np.where(inside, piece[row], -1) if len(low) else np.full(len(middle), -1))
    both = np.column_stack(found)
    meet = (both >= 0).all(axis=1)
    return both[meet], np.diff(places)[meet]
