"""Points inside polygons, by counting crossings (steps 1.5, 2.0 and 2.4)."""

from dataclasses import dataclass

import numba
import numpy as np
import shapely
from numpy.typing import NDArray

INDEX_CELL = 4.0  # m, side of a cell of the point index; a power of two, so that borders of cells are exact
DOUBT = 1e-15  # share of its two products within which rounding may have chosen the sign of a turn
OUTSIDE, INSIDE, UNSURE = range(3)
POLYGON = 3  # GEOS's number of that type

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Edges:
    """Edges of all rings of some polygons.

    Attributes
    ----------
    start : int64, (n + 1,)
        Polygon ``i`` has the edges ``start[i]`` to ``start[i + 1]``.
    a, b : float64, (m, 2)
        From and to (m).
    """

    start: Index
    a: Array
    b: Array


def list_edges(polygons: NDArray[np.object_]) -> Edges:
    """List the edges of polygons, shapely Polygons or MultiPolygons (n,), ring by ring; those of no length too."""
    if (shapely.get_type_id(polygons) == POLYGON).all() and not shapely.get_num_interior_rings(polygons).any():
        xy, owner = shapely.get_coordinates(polygons, return_index=True)
        first = np.flatnonzero(owner[1:] == owner[:-1])
        owner = owner[first]
    else:
        parts, of_part = shapely.get_parts(polygons, return_index=True)
        rings, of_ring = shapely.get_rings(parts, return_index=True)
        xy, ring = shapely.get_coordinates(rings, return_index=True)
        first = np.flatnonzero(ring[1:] == ring[:-1])
        owner = of_part[of_ring[ring[first]]]
    start = np.searchsorted(owner, np.arange(len(polygons) + 1))
    return Edges(start, xy[first], xy[first + 1])


def find_inside(xy: Array, polygons: NDArray[np.object_]) -> tuple[Index, Index]:
    """Find the points inside each polygon, those on its outline left out.

    Parameters
    ----------
    xy : float64, (k, 2) or (k, 3)
        Points (m).
    polygons : object, (n,)
        Valid shapely Polygons; a point in several of them is found in each.

    Returns
    -------
    polygon, point : int64, (h,)
        Rows of `polygons` and `xy`, by polygon, then by point.

    Notes
    -----
    Points are sorted into square cells. A polygon goes through the rows of cells under its box, and holds the
    points there against the edges that meet the row. Where rounding might decide, GEOS is asked: the result is
    that of `shapely.contains_xy` for every pair.
    """
    if len(xy) == 0 or len(polygons) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    edges = list_edges(polygons)
    sorted_xy, order, first, cell_start = _sort_into_cells(xy)
    start, found = _find(sorted_xy, order, first, cell_start, edges.start, edges.a, edges.b)
    polygon = np.repeat(np.arange(len(polygons)), np.diff(start))
    point, side = found >> 2, found & 3
    if not (side == UNSURE).any():
        return polygon, point
    inside = _settle(polygons, polygon, xy[point], side, closed=False)
    return polygon[inside], point[inside]


def are_inside(
    polygons: NDArray[np.object_], polygon: Index, xy: Array, *, closed: bool = False, edges: Edges | None = None
) -> NDArray[np.bool_]:
    """Tell whether points are inside the polygon that is named for each.

    Parameters
    ----------
    polygons : object, (n,)
        Valid shapely Polygons.
    polygon : int64, (k,)
        Row of `polygons` for each point.
    xy : float64, (k, 2) or (k, 3)
        Points (m).
    closed : bool
        Whether outlines count as inside.
    edges : Edges, optional
        The polygons' edges, where they are known.

    Returns
    -------
    bool, (k,)
        What `shapely.contains_xy` says, with `closed` `shapely.intersects_xy`. O(edges) a point.
    """
    edges = list_edges(polygons) if edges is None else edges
    side = np.empty(len(polygon), np.int64)
    _locate(xy, polygon, edges.start, edges.a, edges.b, side)
    return _settle(polygons, polygon, xy, side, closed=closed)


def find_owner(polygons: NDArray[np.object_], xy: Array) -> Index:
    """Find the polygon that each point is inside.

    Parameters
    ----------
    polygons : object, (n,)
        Valid shapely Polygons that do not overlap, few of them.
    xy : float64, (k, 2) or (k, 3)
        Points (m).

    Returns
    -------
    int64, (k,)
        Row of the polygon; -1 for a point in none, on outlines too.
    """
    edges = list_edges(polygons)
    owner = np.full(len(xy), -1)
    for k in _find_owners(xy, edges.start, edges.a, edges.b, owner):
        found = np.flatnonzero(shapely.contains_xy(polygons, *xy[k, :2]))
        owner[k] = found[0] if len(found) else -1
    return owner


def _settle(
    polygons: NDArray[np.object_], polygon: Index, xy: Array, side: Index, *, closed: bool
) -> NDArray[np.bool_]:
    """Ask GEOS where the crossings leave a doubt."""
    inside: NDArray[np.bool_] = side == INSIDE
    unsure = np.flatnonzero(side == UNSURE)
    if len(unsure):
        predicate = shapely.intersects_xy if closed else shapely.contains_xy
        inside[unsure] = predicate(polygons[polygon[unsure]], xy[unsure, 0], xy[unsure, 1])
    return inside


@numba.njit(cache=True, nogil=True)
def _sort_into_cells(
    xy: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int32], tuple[int, int], NDArray[np.int64]]:
    """Sort points by cell, row by row, in their old order within a cell.

    Gives their coordinates and rows in that order, column and row of the first cell, and where each cell starts; a
    row of starts ends with that of the next row.
    """
    low_x = high_x = xy[0, 0]
    low_y = high_y = xy[0, 1]
    for k in range(len(xy)):
        low_x, high_x = min(low_x, xy[k, 0]), max(high_x, xy[k, 0])
        low_y, high_y = min(low_y, xy[k, 1]), max(high_y, xy[k, 1])
    i0, j0 = int(np.floor(low_x / INDEX_CELL)), int(np.floor(low_y / INDEX_CELL))
    width = int(np.floor(high_x / INDEX_CELL)) - i0 + 1
    height = int(np.floor(high_y / INDEX_CELL)) - j0 + 1
    start = np.zeros(height * (width + 1) + 1, np.int64)
    cell = np.empty(len(xy), np.int32)
    for k in range(len(xy)):
        i, j = int(np.floor(xy[k, 0] / INDEX_CELL)) - i0, int(np.floor(xy[k, 1] / INDEX_CELL)) - j0
        cell[k] = j * (width + 1) + i
        start[cell[k] + 1] += 1
    for c in range(1, len(start)):
        start[c] += start[c - 1]
    place = start[:-1].copy()
    order = np.empty(len(xy), np.int32)
    sorted_xy = np.empty((len(xy), 2))
    for k in range(len(xy)):
        to = place[cell[k]]
        place[cell[k]] += 1
        order[to], sorted_xy[to, 0], sorted_xy[to, 1] = k, xy[k, 0], xy[k, 1]
    return sorted_xy, order, (i0, j0), start[:-1].reshape(height, width + 1)


@numba.njit(cache=True, nogil=True, inline="always")
def _cross(x: float, y: float, xa: float, ya: float, xb: float, yb: float) -> int:
    """Whether the ray from a point towards greater x crosses an edge; `UNSURE` where the point may be on it."""
    if (ya > y) == (yb > y):
        on = ya == y and ((xa == x) or (yb == y and (xa > x) != (xb > x)))
        return UNSURE if on else 0
    if xa < x and xb < x:
        return 0
    if xa > x and xb > x:
        return 1
    ahead, across = (xb - xa) * (y - ya), (yb - ya) * (x - xa)
    if abs(ahead - across) <= DOUBT * (abs(ahead) + abs(across)):
        return UNSURE
    return 1 if (ahead > across) == (yb > ya) else 0


@numba.njit(cache=True, nogil=True, inline="always")
def _side(x: float, y: float, first: int, last: int, a: NDArray[np.float64], b: NDArray[np.float64]) -> int:
    """Side of a place from the ring of edges ``first`` to ``last``."""
    side = OUTSIDE
    for e in range(first, last):
        crossed = _cross(x, y, a[e, 0], a[e, 1], b[e, 0], b[e, 1])
        if crossed == UNSURE:
            return UNSURE
        side ^= crossed
    return side


@numba.njit(cache=True, nogil=True)
def _find(
    xy: NDArray[np.float64],
    order: NDArray[np.int32],
    first: tuple[int, int],
    cell_start: NDArray[np.int64],
    edge_start: NDArray[np.int64],
    a: NDArray[np.float64],
    b: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each polygon, four times the point plus its side, of all points that are not surely outside."""
    height, width = cell_start.shape[0], cell_start.shape[1] - 1
    n = len(edge_start) - 1
    start = np.zeros(n + 1, np.int64)
    found = np.empty(1024, np.int64)
    near = np.empty(np.max(np.diff(edge_start)), np.int64)
    n_found = 0
    for p in range(n):
        e0, e1 = edge_start[p], edge_start[p + 1]
        if e0 < e1:
            low_x = min(a[e0:e1, 0].min(), b[e0:e1, 0].min())
            high_x = max(a[e0:e1, 0].max(), b[e0:e1, 0].max())
            low_y = min(a[e0:e1, 1].min(), b[e0:e1, 1].min())
            high_y = max(a[e0:e1, 1].max(), b[e0:e1, 1].max())
            left = max(int(np.floor(low_x / INDEX_CELL)) - first[0], 0)
            right = min(int(np.floor(high_x / INDEX_CELL)) - first[0], width - 1)
            bottom = max(int(np.floor(low_y / INDEX_CELL)) - first[1], 0)
            top = min(int(np.floor(high_y / INDEX_CELL)) - first[1], height - 1)
            for row in range(bottom, top + 1 if left <= right else bottom):
                begin, end = cell_start[row, left], cell_start[row, right + 1]
                if begin == end:
                    continue
                n_near = 0
                under, over = (row + first[1]) * INDEX_CELL, (row + first[1] + 1) * INDEX_CELL
                for e in range(e0, e1):
                    if not ((a[e, 1] < under and b[e, 1] < under) or (a[e, 1] > over and b[e, 1] > over)):
                        near[n_near] = e
                        n_near += 1
                while n_found + end - begin > len(found):
                    found = np.concatenate((found, np.empty_like(found)))
                for k in range(begin, end):
                    side = OUTSIDE
                    for m in range(n_near):
                        e = near[m]
                        crossed = _cross(xy[k, 0], xy[k, 1], a[e, 0], a[e, 1], b[e, 0], b[e, 1])
                        if crossed == UNSURE:
                            side = UNSURE
                            break
                        side ^= crossed
                    if side != OUTSIDE:
                        found[n_found] = 4 * np.int64(order[k]) + side
                        n_found += 1
            found[start[p] : n_found].sort()
        start[p + 1] = n_found
    return start, found[:n_found].copy()


@numba.njit(cache=True, nogil=True)
def _locate(
    xy: NDArray[np.float64],
    polygon: NDArray[np.int64],
    edge_start: NDArray[np.int64],
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    sides: NDArray[np.int64],
) -> None:
    for k in range(len(polygon)):
        p = polygon[k]
        sides[k] = _side(xy[k, 0], xy[k, 1], edge_start[p], edge_start[p + 1], a, b)


@numba.njit(cache=True, nogil=True)
def _find_owners(
    xy: NDArray[np.float64],
    edge_start: NDArray[np.int64],
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    owner: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Write the polygon that each point is surely inside; give the points that are not surely anywhere."""
    unsure = np.empty(len(xy), np.int64)
    n_unsure = 0
    for k in range(len(xy)):
        for p in range(len(edge_start) - 1):
            side = _side(xy[k, 0], xy[k, 1], edge_start[p], edge_start[p + 1], a, b)
            if side == UNSURE:
                unsure[n_unsure] = k
                n_unsure += 1
            if side != OUTSIDE:
                owner[k] = p
                break
    return unsure[:n_unsure].copy()
