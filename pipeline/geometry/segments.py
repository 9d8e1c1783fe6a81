"""Kernels on a few segments and places: distances, room for new walls, corners on edges (for `cuts`)."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.group_order import order_values
from pipeline.geometry.inside import INSIDE, side_of

BLUNT = 0.866  # cosine of 30 degrees, the least angle between a new wall and another
ON_EDGE = 1e-6  # m; a corner of a neighbour this close to an edge lies on it

Array = NDArray[np.float64]


@kernel
def add_places(places: Array, more: Array) -> Array:
    """Add places, float64 (k, 2), to others that are sorted by x, then y, without repetitions, and stay so."""
    united = np.empty((len(places) + len(more), 2))
    n = len(places)
    for k in range(n):
        united[k, 0], united[k, 1] = places[k, 0], places[k, 1]
    for k in range(len(more)):
        x, y = more[k, 0], more[k, 1]
        to = n
        while to > 0 and (x < united[to - 1, 0] or (x == united[to - 1, 0] and y < united[to - 1, 1])):
            to -= 1
        if to > 0 and united[to - 1, 0] == x and united[to - 1, 1] == y:
            continue
        for i in range(n, to, -1):
            united[i, 0], united[i, 1] = united[i - 1, 0], united[i - 1, 1]
        united[to, 0], united[to, 1] = x, y
        n += 1
    return united[:n].copy()


@kernel(inline="always")
def _distance(x: float, y: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance of a place to a segment; NaN for one of no length."""
    dx, dy, x, y = bx - ax, by - ay, x - ax, y - ay
    squared = dx * dx + dy * dy
    if squared == 0:
        return math.nan
    t = min(max((x * dx + y * dy) / squared, 0.0), 1.0)
    return math.hypot(x - t * dx, y - t * dy)


@kernel
def distances_to_segments(xy: Array, a: Array, b: Array) -> Array:
    """Distances (m), float64 (k, n), of ``n`` places to the ``k`` segments from `a` to `b`."""
    far = np.empty((len(a), len(xy)))
    for k in range(len(a)):
        for i in range(len(xy)):
            far[k, i] = _distance(xy[i, 0], xy[i, 1], a[k, 0], a[k, 1], b[k, 0], b[k, 1])
    return far


@kernel
def heights_beside(xyz: Array, a: Array, b: Array, reach: float) -> Array:
    """Heights of the points (n, 3) within a reach (m) of the segment from `a` to `b`, float64 (2,)."""
    z = np.empty(len(xyz))
    n = 0
    for i in range(len(xyz)):
        if _distance(xyz[i, 0], xyz[i, 1], a[0], a[1], b[0], b[1]) <= reach:
            z[n] = xyz[i, 2]
            n += 1
    return z[:n].copy()


@kernel
def find_nodes(
    a: Array, b: Array, side_a: Array, side_b: Array, clearance: float
) -> tuple[Array, NDArray[np.int64]]:
    """Find where a line may cross an outline.

    Parameters
    ----------
    a, b : float64, (m, 2)
        Ends of the edges (m).
    side_a, side_b : float64, (m,)
        Their distances from the line (m), with a sign.
    clearance : float
        The line bends through starts of edges closer than this (m), and crosses edges this far from all of them.

    Returns
    -------
    nodes : float64, (k, 2)
        Starts of edges, then crossings, by edge.
    edge : int64, (k,)
        The edge that is crossed; -1 for a start of one.
    """
    nodes, edge = np.empty((2 * len(a), 2)), np.full(2 * len(a), -1)
    n = 0
    for e in range(len(a)):
        if abs(side_a[e]) < clearance:
            nodes[n, 0], nodes[n, 1] = a[e, 0], a[e, 1]
            n += 1
    for e in range(len(a)):
        if not side_a[e] * side_b[e] < 0:
            continue
        share = side_a[e] / (side_a[e] - side_b[e])
        x, y = a[e, 0] + share * (b[e, 0] - a[e, 0]), a[e, 1] + share * (b[e, 1] - a[e, 1])
        free = True
        for f in range(len(a)):
            free &= math.hypot(x - a[f, 0], y - a[f, 1]) >= clearance
        if free:
            nodes[n, 0], nodes[n, 1], edge[n] = x, y, e
            n += 1
    return nodes[:n], edge[:n]


@kernel
def are_clear(start: Array, end: Array, a: Array, b: Array, clearance: float) -> NDArray[np.bool_]:
    """Tell which walls are long enough, clear of the edges and vertices that they do not end at, and end bluntly.

    Parameters
    ----------
    start, end : float64, (k, 2)
        Ends of the walls (m).
    a, b : float64, (m, 2)
        Ends of the edges of an outline (m).
    clearance : float
        Least length of a wall, and its distance from others (m); where these are close to one of its ends
        themselves, half of that distance, and a quarter of the wall's length from its middle.

    Returns
    -------
    bool, (k,)
    """
    clear = np.zeros(len(start), np.bool_)
    for k in range(len(start)):
        length = math.hypot(end[k, 0] - start[k, 0], end[k, 1] - start[k, 1])
        if not (length >= clearance and length > 0):
            continue
        x, y = (start[k, 0] + end[k, 0]) / 2, (start[k, 1] + end[k, 1]) / 2
        room = math.inf
        far = True
        for e in range(len(a)):
            room = min(room, _distance(x, y, a[e, 0], a[e, 1], b[e, 0], b[e, 1]))
            from_start = math.hypot(start[k, 0] - a[e, 0], start[k, 1] - a[e, 1])
            from_end = math.hypot(end[k, 0] - a[e, 0], end[k, 1] - a[e, 1])
            needed = min(clearance, min(from_start, from_end) / 2) - ON_EDGE
            away = _distance(a[e, 0], a[e, 1], start[k, 0], start[k, 1], end[k, 0], end[k, 1])
            far &= away >= needed
        wide = room >= min(clearance, length / 4)
        clear[k] = wide and far and _is_blunt(start[k], end[k], a, b) and _is_blunt(end[k], start[k], a, b)
    return clear


@kernel
def _is_blunt(start: Array, end: Array, a: Array, b: Array) -> bool:
    """Whether a wall leaves the outline at `start` at no sharp angle."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.hypot(dx, dy)
    dx, dy = dx / length, dy / length
    for e in range(len(a)):
        if not _distance(start[0], start[1], a[e, 0], a[e, 1], b[e, 0], b[e, 1]) <= ON_EDGE:
            continue
        for x, y in ((a[e, 0] - start[0], a[e, 1] - start[1]), (b[e, 0] - start[0], b[e, 1] - start[1])):
            away = math.hypot(x, y)
            if x * dx + y * dy > BLUNT * away and away > ON_EDGE:
                return False
    return True


@kernel
def place_walls(
    a: Array, b: Array, along: Array, offset: float, clearance: float
) -> tuple[Array, NDArray[np.int64]]:
    """Place walls along a line inside an outline, bent through the vertices within `clearance` of it.

    Parameters
    ----------
    a, b : float64, (m, 2)
        Ends of the edges of the outline (m).
    along : float64, (2,)
        Direction of the line, a unit vector; its normal is a quarter turn to the left.
    offset : float
        Distance of the line from the origin along its normal (m).
    clearance : float
        As for `find_nodes` and `are_clear`.

    Returns
    -------
    ends : float64, (k, 2, 2)
        Walls, from and to (m).
    edge : int64, (k, 2)
        Edge of the outline that each end divides, -1 where it is a vertex already.

    Notes
    -----
    The middle of a wall that `are_clear` lets pass is away from all edges: no rounding decides where it is.
    """
    return walls_along(a, b, along, offset, clearance)


@kernel
def walls_along(
    a: Array, b: Array, along: Array, offset: float, clearance: float
) -> tuple[Array, NDArray[np.int64]]:
    """Place walls along a line as `place_walls` does, for kernels."""
    side_a, side_b = np.empty(len(a)), np.empty(len(a))
    for e in range(len(a)):
        side_a[e] = a[e, 1] * along[0] - a[e, 0] * along[1] - offset
        side_b[e] = b[e, 1] * along[0] - b[e, 0] * along[1] - offset
    found, crossed = find_nodes(a, b, side_a, side_b, clearance)
    order = order_values(found[:, 0] * along[0] + found[:, 1] * along[1])
    nodes, edge = np.empty((len(found), 2)), np.empty(len(found), np.int64)
    for k in range(len(found)):
        row = order[k]
        nodes[k, 0], nodes[k, 1], edge[k] = found[row, 0], found[row, 1], crossed[row]
    clear = are_clear(nodes[:-1], nodes[1:], a, b, clearance)
    ends, divided = np.empty((len(clear), 2, 2)), np.empty((len(clear), 2), np.int64)
    n = 0
    for k in range(len(clear)):
        if not clear[k]:
            continue
        x, y = (nodes[k, 0] + nodes[k + 1, 0]) / 2, (nodes[k, 1] + nodes[k + 1, 1]) / 2
        if side_of(x, y, 0, len(a), a, b) == INSIDE:
            for end in range(2):
                ends[n, end, 0], ends[n, end, 1] = nodes[k + end, 0], nodes[k + end, 1]
            divided[n, 0], divided[n, 1] = edge[k], edge[k + 1]
            n += 1
    return ends[:n].copy(), divided[:n].copy()


@kernel
def divide_edges(a: Array, b: Array, ends: Array, edge: NDArray[np.int64]) -> Array:
    """Divide the edges of an outline where walls end on them.

    Parameters
    ----------
    a, b : float64, (m, 2)
        Ends of the edges.
    ends : float64, (k, 2, 2)
        Walls, from and to.
    edge : int64, (k, 2)
        Edge that each end lies on, -1 for none. A line meets an edge once, so ends on one edge are the same.

    Returns
    -------
    float64, (s, 2, 2)
        Edges that are whole, first halves of the others, second halves, walls.
    """
    wall = np.full(len(a), -1)
    for k in range(2 * len(ends) - 1, -1, -1):
        if edge[k // 2, k % 2] >= 0:
            wall[edge[k // 2, k % 2]] = k
    n_cut = 0
    for e in range(len(a)):
        n_cut += wall[e] >= 0
    segments = np.empty((len(a) + n_cut + len(ends), 2, 2))
    whole, half = 0, len(a) - n_cut
    for e in range(len(a)):
        if wall[e] < 0:
            _put(segments, whole, a[e], b[e])
            whole += 1
        else:
            place = ends[wall[e] // 2, wall[e] % 2]
            _put(segments, half, a[e], place)
            _put(segments, half + n_cut, place, b[e])
            half += 1
    for k in range(len(ends)):
        _put(segments, len(a) + n_cut + k, ends[k, 0], ends[k, 1])
    return segments


@kernel(inline="always")
def _put(segments: Array, row: int, start: Array, end: Array) -> None:
    """Write a segment number by number: assigning rows brings numpy's errors, and strings, into a kernel."""
    segments[row, 0, 0], segments[row, 0, 1] = start[0], start[1]
    segments[row, 1, 0], segments[row, 1, 1] = end[0], end[1]


@kernel
def insert_corners(xy: Array, ring: NDArray[np.int64], corners: Array) -> tuple[Array, NDArray[np.int64]]:
    """Insert the corners that lie on edges of rings, and at neither of their ends.

    Parameters
    ----------
    xy : float64, (n, 2)
        Vertices of closed rings (m).
    ring : int64, (n,)
        The ring of each, ascending.
    corners : float64, (c, 2)
        Places (m).

    Returns
    -------
    xy, ring
        With the corners, to the bit; those of one edge by their distance from its start.
    """
    near = _take_near(xy, corners)
    room = len(xy) * (len(near) + 1)
    new_xy, new_ring, away = np.empty((room, 2)), np.empty(room, np.int64), np.empty(len(near))
    n = 0
    for v in range(len(xy)):
        new_xy[n, 0], new_xy[n, 1], new_ring[n] = xy[v, 0], xy[v, 1], ring[v]
        n += 1
        if v + 1 == len(xy) or ring[v] != ring[v + 1]:
            continue
        first = n
        for c in range(len(near)):
            x, y = near[c, 0], near[c, 1]
            if not _distance(x, y, xy[v, 0], xy[v, 1], xy[v + 1, 0], xy[v + 1, 1]) <= ON_EDGE:
                continue
            from_start = math.hypot(xy[v, 0] - x, xy[v, 1] - y)
            if not (from_start > ON_EDGE and math.hypot(xy[v + 1, 0] - x, xy[v + 1, 1] - y) > ON_EDGE):
                continue
            k = n
            while k > first and away[k - 1 - first] > from_start:
                new_xy[k, 0], new_xy[k, 1] = new_xy[k - 1, 0], new_xy[k - 1, 1]
                away[k - first] = away[k - 1 - first]
                k -= 1
            new_xy[k, 0], new_xy[k, 1], new_ring[n], away[k - first] = x, y, ring[v], from_start
            n += 1
    return new_xy[:n].copy(), new_ring[:n].copy()


@kernel
def _take_near(xy: Array, corners: Array) -> Array:
    """Take the corners that lie in the box around some vertices, or on its sides."""
    near = np.empty((len(corners), 2))
    left = under = math.inf
    right = over = -math.inf
    for v in range(len(xy)):
        left, right = min(left, xy[v, 0]), max(right, xy[v, 0])
        under, over = min(under, xy[v, 1]), max(over, xy[v, 1])
    n = 0
    for c in range(len(corners)):
        x, y = corners[c, 0], corners[c, 1]
        if left - ON_EDGE <= x <= right + ON_EDGE and under - ON_EDGE <= y <= over + ON_EDGE:
            near[n, 0], near[n, 1] = x, y
            n += 1
    return near[:n]
