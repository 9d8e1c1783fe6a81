"""Points inside polygons, by counting crossings (steps 1.5, 2.0 and 2.4)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.kernel import kernel

INDEX_CELL = 2.0  # m, side of a cell of the point index; a power of two, so that borders of cells are exact
BLOCK = 1 << 13  # points that room is made for at a time
ROOM = 1 << 10  # cells, and edges, that room is made for at first
DOUBT = 1e-15  # share of its two products within which rounding may have chosen the sign of a turn
OUTSIDE, INSIDE, UNSURE = range(3)
POLYGON = 3  # GEOS's number of that type

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Box = tuple[float, float, float, float]  # xmin, ymin, xmax, ymax (m)

EVERYWHERE: Box = (-np.inf, -np.inf, np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Edges:
    """Edges of all rings of some polygons."""

    start: Index  #: (n + 1,): polygon ``i`` has the edges ``start[i]`` to ``start[i + 1]``
    #: (m, 2): from and to (m)
    a: Array
    b: Array


@dataclass(frozen=True, eq=False)
class Rings:
    """Closed rings of some polygons, one after the other."""

    start: Index  #: (n + 1,): polygon ``i`` has the vertices ``start[i]`` to ``start[i + 1]``
    xy: Array  #: (m, 2): vertices (m), the first of a ring again as its last
    ring: Index  #: (m,): ring of each vertex, ascending; the shell of a polygon comes first


def read_rings(polygons: NDArray[np.object_]) -> Rings:
    """Read the rings of polygons, shapely Polygons or MultiPolygons (n,)."""
    if (shapely.get_type_id(polygons) == POLYGON).all() and not shapely.get_num_interior_rings(polygons).any():
        xy, ring = shapely.get_coordinates(polygons, return_index=True)
        owner = ring
    else:
        parts, of_part = shapely.get_parts(polygons, return_index=True)
        rings, of_ring = shapely.get_rings(parts, return_index=True)
        xy, ring = shapely.get_coordinates(rings, return_index=True)
        owner = of_part[of_ring[ring]]
    return Rings(np.searchsorted(owner, np.arange(len(polygons) + 1)), xy, ring)


def list_edges(polygons: NDArray[np.object_]) -> Edges:
    """List the edges of polygons, shapely Polygons or MultiPolygons (n,), ring by ring; those of no length too."""
    return edges_of_rings(read_rings(polygons))


def edges_of_rings(rings: Rings) -> Edges:
    """List the edges of rings; those of no length too."""
    return Edges(*_edges_of_rings(rings.start, rings.xy, rings.ring))


@kernel
def _edges_of_rings(start: Index, xy: Array, ring: Index) -> tuple[Index, Array, Array]:
    n = 0
    for v in range(1, len(xy)):
        n += ring[v] == ring[v - 1]
    first, a, b = np.zeros(len(start), np.int64), np.empty((n, 2)), np.empty((n, 2))
    n = 0
    for i in range(len(start) - 1):
        for v in range(start[i] + 1, start[i + 1]):
            if ring[v] == ring[v - 1]:
                a[n, 0], a[n, 1], b[n, 0], b[n, 1] = xy[v - 1, 0], xy[v - 1, 1], xy[v, 0], xy[v, 1]
                n += 1
        first[i + 1] = n
    return first, a, b


@dataclass(frozen=True, eq=False)
class PolygonIndex:
    """Polygons listed in the square cells that they have a part of."""

    cells: tuple[int, int, int, int]  #: column and row of the first cell, number of columns and rows
    start: Index  #: (cells + 1,): cell ``c``, row by row, has the entries ``start[c]`` to ``start[c + 1]``
    polygon: NDArray[np.int32]  #: (m,): polygon of each entry
    #: (m, 2): first and last of its edges that meet the row of cells; none where the whole cell is inside
    edges: Index
    #: (k, 2): these edges, from and to (m)
    a: Array
    b: Array


def index_polygons(polygons: NDArray[np.object_], box: Box = EVERYWHERE) -> PolygonIndex:
    """List polygons, valid shapely Polygons or MultiPolygons (n,), in cells, for `find_inside` in a box.

    Parameters
    ----------
    polygons : object, (n,)
        The polygons.
    box : (xmin, ymin, xmax, ymax)
        Box in which points may be looked for (m), its borders included; all of the plane by default.
    """
    edges = list_edges(polygons)
    cells = _find_cells(box, edges.a, edges.b) if len(edges.a) else (0, 0, 0, 0)
    return PolygonIndex(cells, *_put_into_cells(cells, edges.start, edges.a, edges.b))


def find_inside(
    xy: Array,
    polygons: NDArray[np.object_],
    *,
    among: NDArray[np.bool_] | None = None,
    index: PolygonIndex | None = None,
) -> tuple[Index, Index]:
    """Find the points inside each polygon, those on its outline left out.

    Parameters
    ----------
    xy : float64, (k, 2) or (k, 3)
        Points (m).
    polygons : object, (n,)
        Valid shapely Polygons; a point in several of them is found in each.
    among : bool, (k,), optional
        Points to look for; all by default.
    index : PolygonIndex, optional
        The polygons in cells, where that is known; points beyond its box are not looked for.

    Returns
    -------
    polygon, point : int64, (h,)
        Rows of `polygons` and `xy`, by polygon, then by point.

    Notes
    -----
    Polygons are listed in the square cells that they have a part of. A point is held against those of its cell:
    it is in a polygon that has the whole cell, else the polygon's edges that meet the cell's row tell. Where
    rounding might decide, GEOS is asked: the result is that of `shapely.contains_xy` for every pair.
    """
    if len(xy) == 0 or len(polygons) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    among = np.ones(len(xy), np.bool_) if among is None else among
    index = index_polygons(polygons, _box_of(xy, among)) if index is None else index
    start, found = _find(
        xy, among, len(polygons), index.cells, index.start, index.polygon, index.edges, index.a, index.b
    )
    polygon = np.repeat(np.arange(len(polygons)), np.diff(start))
    point, side = found >> 2, found & 3
    if not (side == UNSURE).any():
        return polygon, point
    inside = _settle(polygons, polygon, xy, point, side, closed=False)
    return polygon[inside], point[inside]


@dataclass(frozen=True, eq=False)
class Cover:
    """Cells of the index that some polygons have a part of."""

    #: column and row of the first cell; cell (i, j) begins at ``i * INDEX_CELL``, ``j * INDEX_CELL``
    i0: int
    j0: int
    #: (rows, columns): whether a polygon has a part of the cell; it may be marked where one only comes within
    #: rounding of it. There is at least one cell
    marked: NDArray[np.bool_]


def cover_polygons(polygons: NDArray[np.object_]) -> Cover:
    """Mark the cells that polygons, valid shapely Polygons or MultiPolygons (n,), have a part of."""
    index = index_polygons(polygons)
    i0, j0, width, height = index.cells
    marked = (np.diff(index.start) > 0).reshape(height, width)
    return Cover(i0, j0, marked if marked.size else np.zeros((1, 1), np.bool_))


@kernel(inline="always")
def is_covered(x: float, y: float, i0: int, j0: int, marked: NDArray[np.bool_]) -> bool:
    """Tell for kernels whether a place lies in a cell of the cover with these attributes."""
    i, j = int(np.floor(x / INDEX_CELL)) - i0, int(np.floor(y / INDEX_CELL)) - j0
    there = (i >= 0) & (i < marked.shape[1]) & (j >= 0) & (j < marked.shape[0])
    return bool(there & marked[j * there, i * there])


@kernel
def _look_up(xy: Array, i0: int, j0: int, marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    found = np.zeros(len(xy), np.bool_)
    for k in range(len(xy)):
        found[k] = is_covered(xy[k, 0], xy[k, 1], i0, j0, marked)
    return found


def are_covered(cover: Cover, xy: Array) -> NDArray[np.bool_]:
    """Tell which points, (k, 2) or (k, 3), lie in cells of a cover: all inside its polygons, and some near them.

    Examples
    --------
    >>> cover = cover_polygons(np.array([shapely.box(0.5, 0.5, 3.0, 1.5)]))
    >>> are_covered(cover, np.array([[0.1, 0.1], [3.5, 1.0], [4.5, 1.0], [1.0, 2.5]]))
    array([ True,  True, False, False])
    """
    return np.asarray(_look_up(xy, cover.i0, cover.j0, cover.marked))


def are_inside(
    polygons: NDArray[np.object_], polygon: Index, xy: Array, *, closed: bool = False
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

    Returns
    -------
    bool, (k,)
        What `shapely.contains_xy` says, with `closed` `shapely.intersects_xy`. O(edges) a point.
    """
    edges = list_edges(polygons)
    side = np.empty(len(polygon), np.int64)
    _locate(xy, polygon, edges.start, edges.a, edges.b, side)
    return _settle(polygons, polygon, xy, np.arange(len(xy)), side, closed=closed)


def find_owner(polygons: NDArray[np.object_], xy: Array, *, edges: Edges | None = None) -> Index:
    """Find the polygon that each point is inside.

    Parameters
    ----------
    polygons : object, (n,)
        Valid shapely Polygons that do not overlap, few of them.
    xy : float64, (k, 2) or (k, 3)
        Points (m).
    edges : Edges, optional
        The polygons' edges, where they are known.

    Returns
    -------
    int64, (k,)
        Row of the polygon; -1 for a point in none, on outlines too.
    """
    edges = list_edges(polygons) if edges is None else edges
    owner = np.full(len(xy), -1)
    for k in _find_owners(xy, edges.start, edges.a, edges.b, owner):
        found = np.flatnonzero(shapely.contains_xy(polygons, *xy[k, :2]))
        owner[k] = found[0] if len(found) else -1
    return owner


def _settle(
    polygons: NDArray[np.object_], polygon: Index, xy: Array, point: Index, side: Index, *, closed: bool
) -> NDArray[np.bool_]:
    """Ask GEOS of those points, rows of `xy`, of which the crossings leave a doubt."""
    inside: NDArray[np.bool_] = side == INSIDE
    unsure = np.flatnonzero(side == UNSURE)
    if len(unsure):
        predicate = shapely.intersects_xy if closed else shapely.contains_xy
        inside[unsure] = predicate(polygons[polygon[unsure]], *xy[point[unsure], :2].T)
    return inside


@kernel(inline="always")
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


@kernel(inline="always")
def side_of(x: float, y: float, first: int, last: int, a: Array, b: Array) -> int:
    """Tell for kernels the side of a place from the rings of some edges; where it is `UNSURE`, GEOS knows."""
    side = OUTSIDE
    for e in range(first, last):
        crossed = _cross(x, y, a[e, 0], a[e, 1], b[e, 0], b[e, 1])
        if crossed == UNSURE:
            return UNSURE
        side ^= crossed
    return side


@kernel(inline="always")
def _may_meet(
    xa: float, ya: float, xb: float, yb: float, left: float, under: float, right: float, over: float
) -> bool:
    """Whether an edge may meet a box, its sides included; False where it surely does not."""
    if max(xa, xb) < left or min(xa, xb) > right or max(ya, yb) < under or min(ya, yb) > over:
        return False
    n_ahead = n_behind = 0
    for x in (left, right):
        for y in (under, over):
            ahead, across = (xb - xa) * (y - ya), (yb - ya) * (x - xa)
            doubt = DOUBT * (abs(ahead) + abs(across))
            n_ahead += ahead - across > doubt
            n_behind += across - ahead > doubt
    return n_ahead < 4 and n_behind < 4


@kernel
def _side_of_cell(left: float, under: float, near: Index, a: Array, b: Array) -> int:
    """Side of a cell from the rings of the edges that meet its row; `UNSURE` where it may have both."""
    right, over = left + INDEX_CELL, under + INDEX_CELL
    side = OUTSIDE
    for e in near:
        if _may_meet(a[e, 0], a[e, 1], b[e, 0], b[e, 1], left, under, right, over):
            return UNSURE
        crossed = _cross((left + right) / 2, (under + over) / 2, a[e, 0], a[e, 1], b[e, 0], b[e, 1])
        if crossed == UNSURE:
            return UNSURE
        side ^= crossed
    return side


@kernel
def _box_of(xy: Array, among: NDArray[np.bool_]) -> Box:
    """Box of some points; inside out where there are none."""
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for k in range(len(xy)):
        x, y = xy[k, 0], xy[k, 1]
        low_x, high_x = min(low_x, x if among[k] else np.inf), max(high_x, x if among[k] else -np.inf)
        low_y, high_y = min(low_y, y if among[k] else np.inf), max(high_y, y if among[k] else -np.inf)
    return low_x, low_y, high_x, high_y


@kernel
def _find_cells(box: Box, a: Array, b: Array) -> tuple[int, int, int, int]:
    """Column and row of the first cell that both the box and edges are around, number of columns and rows."""
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for e in range(len(a)):
        low_x, high_x = min(low_x, a[e, 0], b[e, 0]), max(high_x, a[e, 0], b[e, 0])
        low_y, high_y = min(low_y, a[e, 1], b[e, 1]), max(high_y, a[e, 1], b[e, 1])
    low_x, low_y, high_x, high_y = max(box[0], low_x), max(box[1], low_y), min(box[2], high_x), min(box[3], high_y)
    if not (low_x <= high_x and low_y <= high_y):
        return 0, 0, 0, 0
    i0, j0 = int(np.floor(low_x / INDEX_CELL)), int(np.floor(low_y / INDEX_CELL))
    return i0, j0, int(np.floor(high_x / INDEX_CELL)) - i0 + 1, int(np.floor(high_y / INDEX_CELL)) - j0 + 1


@kernel
def _put_into_cells(
    cells: tuple[int, int, int, int], edge_start: Index, a: Array, b: Array
) -> tuple[Index, NDArray[np.int32], Index, Array, Array]:
    """List for each cell the polygons that have a part of it.

    Gives where each cell's list starts; the polygons in it; first and last of their edges that meet the row of
    cells, none where the cell is inside; and from and to of these edges.
    """
    i0, j0, width, height = cells
    size = INDEX_CELL
    n, n_near = 0, 0
    cell, polygon = np.empty(ROOM, np.int64), np.empty(ROOM, np.int32)
    begin, end, near = np.empty(ROOM, np.int64), np.empty(ROOM, np.int64), np.empty(ROOM, np.int64)
    for p in range(len(edge_start) - 1):
        e0, e1 = edge_start[p], edge_start[p + 1]
        if e0 == e1:
            continue
        low_y, high_y = np.inf, -np.inf
        for e in range(e0, e1):
            low_y, high_y = min(low_y, a[e, 1], b[e, 1]), max(high_y, a[e, 1], b[e, 1])
        bottom = max(int(np.floor(low_y / size)) - j0, 0)
        top = min(int(np.floor(high_y / size)) - j0, height - 1)
        for row in range(bottom, top + 1):
            under, over = (row + j0) * size, (row + j0 + 1) * size
            first = n_near
            low_x, high_x = np.inf, -np.inf
            while n_near + e1 - e0 > len(near):
                near = _lengthen(near)
            for e in range(e0, e1):
                if not ((a[e, 1] < under and b[e, 1] < under) or (a[e, 1] > over and b[e, 1] > over)):
                    near[n_near] = e
                    n_near += 1
                    low_x, high_x = min(low_x, a[e, 0], b[e, 0]), max(high_x, a[e, 0], b[e, 0])
            if first == n_near:
                continue
            left = max(int(np.floor(low_x / size)) - i0, 0)
            right = min(int(np.floor(high_x / size)) - i0, width - 1)
            while n + right + 1 - left > len(cell):
                cell, polygon, begin, end = _lengthen(cell), _lengthen(polygon), _lengthen(begin), _lengthen(end)
            for column in range(left, right + 1):
                side = _side_of_cell((column + i0) * size, under, near[first:n_near], a, b)
                if side != OUTSIDE:
                    cell[n], polygon[n] = row * width + column, p
                    begin[n], end[n] = first, n_near if side == UNSURE else first
                    n += 1
    start, order = _group(cell[:n], width * height)
    ordered, edges = np.empty(n, np.int32), np.empty((n, 2), np.int64)
    for k in range(n):
        ordered[k], edges[k, 0], edges[k, 1] = polygon[order[k]], begin[order[k]], end[order[k]]
    return start, ordered, edges, _take(a, near[:n_near]), _take(b, near[:n_near])


@kernel
def _take(xy: Array, rows: Index) -> Array:
    """Rows of an array (n, 2); quicker to compile than an index."""
    taken = np.empty((len(rows), 2))
    for k in range(len(rows)):
        taken[k, 0], taken[k, 1] = xy[rows[k], 0], xy[rows[k], 1]
    return taken


@kernel
def _lengthen(values: NDArray[Any]) -> NDArray[Any]:
    """Twice the room, with the values in its first half."""
    room = np.empty(2 * len(values), values.dtype)
    for k in range(len(values)):  # a slice would bring the words of an error of shapes into the kernel
        room[k] = values[k]
    return room


@kernel
def _group(group: NDArray[np.integer], n: int) -> tuple[Index, Index]:
    """Where each of n groups starts, and the rows by group, in their old order within each."""
    start = np.zeros(n + 1, np.int64)
    for k in range(len(group)):
        start[group[k] + 1] += 1
    for g in range(n):
        start[g + 1] += start[g]
    place = start[:-1].copy()
    order = np.empty(len(group), np.int64)
    for k in range(len(group)):
        order[place[group[k]]] = k
        place[group[k]] += 1
    return start, order


@kernel
def _find(
    xy: Array,
    among: NDArray[np.bool_],
    n_polygons: int,
    cells: tuple[int, int, int, int],
    cell_start: Index,
    polygon: NDArray[np.int32],
    edges: Index,
    a: Array,
    b: Array,
) -> tuple[Index, Index]:
    """For each polygon, four times the point plus its side, of all points that are not surely outside."""
    most = 0
    for cell in range(len(cell_start) - 1):
        most = max(most, cell_start[cell + 1] - cell_start[cell])
    owner, found = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int64)
    n: Any = np.int64(0)  # for a constant, numba would compile what it is given to once more
    for first in range(0, len(xy) if most else 0, BLOCK):
        last = min(first + BLOCK, len(xy))
        while n + (last - first) * most > len(found):
            owner, found = _lengthen(owner), _lengthen(found)
        n = _find_some(xy, among, first, last, cells, cell_start, polygon, edges, a, b, owner, found, n)
    start, order = _group(owner[:n], n_polygons)
    ordered = np.empty(n, np.int64)
    for k in range(n):
        ordered[k] = found[order[k]]
    return start, ordered


@kernel
def _find_some(
    xy: Array,
    among: NDArray[np.bool_],
    first: int,
    last: int,
    cells: tuple[int, int, int, int],
    cell_start: Index,
    polygon: NDArray[np.int32],
    edges: Index,
    a: Array,
    b: Array,
    owner: NDArray[np.int32],
    found: Index,
    n: int,
) -> int:
    """Write what `_find` finds of the points from first to last after the n that there are; give their number."""
    i0, j0, width, height = cells
    for k in range(first, last):
        if not among[k]:
            continue
        x, y = xy[k, 0], xy[k, 1]
        i, j = int(np.floor(x / INDEX_CELL)) - i0, int(np.floor(y / INDEX_CELL)) - j0
        if i < 0 or i >= width or j < 0 or j >= height:
            continue
        cell = j * width + i
        for m in range(cell_start[cell], cell_start[cell + 1]):
            begin, end = edges[m, 0], edges[m, 1]
            side = INSIDE if begin == end else side_of(x, y, begin, end, a, b)
            if side != OUTSIDE:
                owner[n], found[n] = polygon[m], 4 * np.int64(k) + side
                n += 1
    return n


@kernel
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
        sides[k] = side_of(xy[k, 0], xy[k, 1], edge_start[p], edge_start[p + 1], a, b)


@kernel
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
            side = side_of(xy[k, 0], xy[k, 1], edge_start[p], edge_start[p + 1], a, b)
            if side == UNSURE:
                unsure[n_unsure] = k
                n_unsure += 1
            if side != OUTSIDE:
                owner[k] = p
                break
    return unsure[:n_unsure].copy()
