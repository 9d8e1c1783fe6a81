"""A house divided into faces by straight walls, as half-edges (for `partition`).

A face has its half-edges on its rings in order, itself on their left. A wall between two faces is a pair of them
with the same vertices, so neighbours share theirs to the bit; half-edges on the outline of the house have no twin.
A row of the table has `NEXT`, `BEFORE`, `TWIN`, `FACE` and `NODE`, the vertex where the half-edge begins.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.inside import INSIDE, side_of
from pipeline.geometry.segments import ON_EDGE, walls_along

NEXT, BEFORE, TWIN, FACE, NODE = range(5)
HALVES, NODES, FACES = range(3)  # numbers that are kept in `count`
WALL_ROWS = 6  # half-edges that a wall adds at most: two of its own, and two at each end
ROOM, POINTS_OF_WALL = (
    100,
    4,
)  # walls that a house may get, and one more for so many points: no house needs as many
STRAIGHT = 1e-3  # m, square root of the area of the triangle at a vertex that is dropped as straight

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel
def open_subdivision(xy: Array, ring: Index, n_points: int) -> tuple[Index, Array, Index]:
    """Make one face of a house.

    Parameters
    ----------
    xy : float64, (n, 2)
        Vertices of closed rings (m), the shell first.
    ring : int64, (n,)
        Ring of each vertex, ascending.
    n_points : int
        Points of the house: with more there is room for more walls.

    Returns
    -------
    half : int64, (m, 5)
        Half-edges, with room for walls.
    place : float64, (k, 2)
        Vertices (m), those of the house first.
    count : int64, (3,)
        Half-edges, vertices and faces that there are.
    """
    n = len(xy)
    room = ROOM + n_points // POINTS_OF_WALL
    half, place = np.empty((n + WALL_ROWS * room, 5), np.int64), np.empty((n + 2 * room, 2))
    count = np.zeros(3, np.int64)
    first = 0
    while first < n:
        last = first
        while last + 1 < n and ring[last + 1] == ring[first]:
            last += 1
        twice = 0.0
        for v in range(first, last):
            x, y = xy[first, 0], xy[first, 1]
            twice += (xy[v, 0] - x) * (xy[v + 1, 1] - y) - (xy[v + 1, 0] - x) * (xy[v, 1] - y)
        forward = (twice > 0) == (first == 0)
        begin = count[HALVES]
        for k in range(last - first):
            v = first + k if forward else last - k
            h = count[HALVES]
            if h > begin and xy[v, 0] == place[h - 1, 0] and xy[v, 1] == place[h - 1, 1]:
                continue
            place[h, 0], place[h, 1] = xy[v, 0], xy[v, 1]
            half[h, NEXT], half[h, BEFORE], half[h, TWIN], half[h, FACE], half[h, NODE] = h + 1, h - 1, -1, 0, h
            count[HALVES] += 1
        end = count[HALVES] - 1
        half[end, NEXT], half[begin, BEFORE] = begin, end
        first = last + 1
    count[NODES], count[FACES] = count[HALVES], 1
    return half, place, count


@kernel
def edges_of_face(half: Index, place: Array, n: int, face: int) -> tuple[Index, Array, Array]:
    """Half-edges of a face in the order of their rows, and from and to of each, (m, 2)."""
    rows = np.empty(n, np.int64)
    m = 0
    for h in range(n):
        if half[h, FACE] == face:
            rows[m] = h
            m += 1
    a, b = np.empty((m, 2)), np.empty((m, 2))
    for k in range(m):
        p, q = half[rows[k], NODE], half[half[rows[k], NEXT], NODE]
        a[k, 0], a[k, 1], b[k, 0], b[k, 1] = place[p, 0], place[p, 1], place[q, 0], place[q, 1]
    return rows[:m].copy(), a, b


@kernel
def area_of_edges(a: Array, b: Array) -> float:
    """Area of the face with these edges."""
    twice, x, y = 0.0, a[0, 0], a[0, 1]
    for e in range(len(a)):
        twice += (a[e, 0] - x) * (b[e, 1] - y) - (b[e, 0] - x) * (a[e, 1] - y)
    return twice / 2


@kernel
def cut_face(
    half: Index, place: Array, count: Index, face: int, line: tuple[float, float, float], clearance: float
) -> bool:
    """Cut a face along a line, as `walls_along` places walls; tell whether it was divided.

    Where a wall would have the same face on both sides (it ends at a courtyard, say, and nothing goes on beyond),
    everything stays as it was: later walls would pass through it.

    Parameters
    ----------
    half, place, count
        As from `open_subdivision`; the new walls, vertices and faces are added.
    face : int
        The face.
    line : tuple of 3 floats
        Direction of the line, a unit vector, and its offset along the normal, a quarter turn to the left (m).
    clearance : float
        Distance of new walls from others (m).
    """
    rows, a, b = edges_of_face(half, place, count[HALVES], face)
    along = np.empty(2)
    along[0], along[1] = line[0], line[1]
    walls, crossed = walls_along(a, b, along, line[2], clearance)
    before, half_before = count.copy(), half[: count[HALVES]].copy()
    if count[HALVES] + WALL_ROWS * len(walls) > len(half):
        return False
    for w in range(len(walls)):
        dx, dy = walls[w, 1, 0] - walls[w, 0, 0], walls[w, 1, 1] - walls[w, 0, 1]
        start = _find_end(half, place, count, walls[w, 0], (dx, dy), rows[crossed[w, 0]], crossed[w, 0] >= 0)
        end = _find_end(half, place, count, walls[w, 1], (-dx, -dy), rows[crossed[w, 1]], crossed[w, 1] >= 0)
        if start >= 0 and end >= 0 and start != end and half[start, FACE] == half[end, FACE]:
            _add_wall(half, place, count, start, end)
    divided = count[FACES] > before[FACES]
    for h in range(before[HALVES], count[HALVES]):
        divided &= half[h, TWIN] < 0 or half[half[h, TWIN], FACE] != half[h, FACE]
    if not divided:
        half[: before[HALVES]] = half_before
        count[:] = before
    return bool(divided)


@kernel
def _find_end(
    half: Index, place: Array, count: Index, at: Array, away: tuple[float, float], edge: int, crosses: bool
) -> int:
    """Find the half-edge before which a wall leaves a vertex in a direction; an edge is divided for it.

    -1 where there is none.
    """
    found: int = -1
    for h in range(count[HALVES]):
        p = half[h, NODE]
        if abs(place[p, 0] - at[0]) > ON_EDGE or abs(place[p, 1] - at[1]) > ON_EDGE:
            continue
        q, r = half[half[h, NEXT], NODE], half[half[h, BEFORE], NODE]
        out = math.atan2(place[q, 1] - place[p, 1], place[q, 0] - place[p, 0])
        back = math.atan2(place[r, 1] - place[p, 1], place[r, 0] - place[p, 0])
        turn = (math.atan2(away[1], away[0]) - out) % (2 * math.pi)
        most = (back - out) % (2 * math.pi)
        if turn < most or most == 0:
            found = h
            break
    if found < 0 and crosses:
        found = _split_edge(half, place, count, edge, at)
    return found


@kernel
def _split_edge(half: Index, place: Array, count: Index, h: int, at: Array) -> int:
    """Divide an edge at a place; give its second half."""
    node, g = count[NODES], count[HALVES]
    place[node, 0], place[node, 1] = at[0], at[1]
    after, twin = half[h, NEXT], half[h, TWIN]
    half[g, NEXT], half[g, BEFORE], half[g, TWIN], half[g, FACE], half[g, NODE] = after, h, -1, half[h, FACE], node
    half[h, NEXT], half[after, BEFORE] = g, g
    count[NODES], count[HALVES] = node + 1, g + 1
    if twin >= 0:
        s, after = g + 1, half[twin, NEXT]
        half[s, NEXT], half[s, BEFORE], half[s, TWIN], half[s, FACE] = after, twin, h, half[twin, FACE]
        half[s, NODE] = node
        half[twin, NEXT], half[after, BEFORE] = s, s
        half[h, TWIN], half[g, TWIN], half[twin, TWIN] = s, twin, g
        count[HALVES] = s + 1
    second: int = g
    return second


@kernel
def _add_wall(half: Index, place: Array, count: Index, start: int, end: int) -> None:
    """Add a wall between the vertices where two half-edges of a face begin; a face that it divides becomes two."""
    face, u = half[start, FACE], count[HALVES]
    v = u + 1
    before_start, before_end = half[start, BEFORE], half[end, BEFORE]
    half[u, NEXT], half[u, BEFORE], half[u, TWIN], half[u, FACE] = end, before_start, v, face
    half[v, NEXT], half[v, BEFORE], half[v, TWIN], half[v, FACE] = start, before_end, u, face
    half[u, NODE], half[v, NODE] = half[start, NODE], half[end, NODE]
    half[before_start, NEXT], half[end, BEFORE] = u, u
    half[before_end, NEXT], half[start, BEFORE] = v, v
    count[HALVES] = v + 1
    h = half[u, NEXT]
    while h not in (u, v):
        h = half[h, NEXT]
    if h == v:  # it joins two rings
        return
    new = count[FACES]
    count[FACES] = new + 1
    own, other = (u, v) if _area_of_ring(half, place, u) > 0 else (v, u)
    h = own
    while True:
        half[h, FACE] = new
        h = half[h, NEXT]
        if h == own:
            break
    # Of the face's further rings, holes, those inside the new ring go with it.
    h = other
    while True:
        half[h, FACE] = -1
        h = half[h, NEXT]
        if h == other:
            break
    _, a, b = edges_of_face(half, place, count[HALVES], new)
    for g in range(count[HALVES]):
        if half[g, FACE] != face:
            continue
        x, y = place[half[g, NODE], 0], place[half[g, NODE], 1]
        there = new if side_of(x, y, 0, len(a), a, b) == INSIDE else -1
        h = g
        while True:
            half[h, FACE] = there
            h = half[h, NEXT]
            if h == g:
                break
    for g in range(count[HALVES]):
        if half[g, FACE] == -1:
            half[g, FACE] = face


@kernel
def _area_of_ring(half: Index, place: Array, first: int) -> float:
    """Area inside a ring; negative for one around a hole."""
    x, y = place[half[first, NODE], 0], place[half[first, NODE], 1]
    twice, h = 0.0, first
    while True:
        p, q = half[h, NODE], half[half[h, NEXT], NODE]
        twice += (place[p, 0] - x) * (place[q, 1] - y) - (place[q, 0] - x) * (place[p, 1] - y)
        h = half[h, NEXT]
        if h == first:
            break
    area: float = twice / 2
    return area


@kernel
def outline_regions(
    half: Index, place: Array, count: Index, region: Index, n_given: int
) -> tuple[Array, Index, Index, NDArray[np.bool_]]:
    """Outline regions of faces.

    Parameters
    ----------
    half, place, count
        As from `open_subdivision`.
    region : int64, (faces,)
        Region of each face.
    n_given : int
        Vertices of the house: these are kept. Of others, those stay where three regions meet, or a wall bends.

    Returns
    -------
    xy : float64, (n, 2)
        Vertices of closed rings, one after the other (m).
    ring : int64, (n,)
        Ring of each, ascending.
    owner : int64, (r,)
        Region of each ring.
    shell : bool, (r,)
        Whether a ring is around its region, not around a hole of it.
    """
    n = count[HALVES]
    bounds = np.zeros(n, np.bool_)
    degree = np.zeros(count[NODES], np.int64)
    for h in range(n):
        t = half[h, TWIN]
        bounds[h] = t < 0 or region[half[t, FACE]] != region[half[h, FACE]]
        if bounds[h]:
            degree[half[h, NODE]] += 1
            if t < 0:
                degree[half[half[h, NEXT], NODE]] += 1
    xy, ring = np.empty((n + 2 * count[NODES] + 2, 2)), np.empty(n + 2 * count[NODES] + 2, np.int64)
    owner, shell = np.empty(n, np.int64), np.empty(n, np.bool_)
    used = np.zeros(n, np.bool_)
    walk, trail, at = np.empty(n, np.int64), np.empty(n, np.int64), np.full(count[NODES], -1)
    m = r = 0
    for first in range(n):
        if not bounds[first] or used[first]:
            continue
        length, h = 0, first
        while not used[h]:
            used[h] = True
            walk[length] = h
            length += 1
            h = half[h, NEXT]
            while not bounds[h]:
                h = half[half[h, TWIN], NEXT]
        # A ring that comes back to a vertex, where a hole touches the outline, is two.
        n_open = 0
        for k in range(length + 1):
            node = half[walk[k % length], NODE]
            if at[node] >= 0:
                begin = m
                m = _put_ring(place, trail[at[node] : n_open], (degree, n_given), xy, m)
                owner[r], shell[r] = region[half[first, FACE]], _area_of_places(xy[begin:m]) > 0
                for v in range(begin, m):
                    ring[v] = r
                r += 1
                while n_open > at[node] + 1:
                    n_open -= 1
                    at[trail[n_open]] = -1
            else:
                at[node], trail[n_open] = n_open, node
                n_open += 1
        at[trail[0]] = -1
    return xy[:m].copy(), ring[:m].copy(), owner[:r].copy(), shell[:r].copy()


@kernel
def _put_ring(place: Array, nodes: Index, kept: tuple[Index, int], xy: Array, m: int) -> int:
    """Write the vertices of a closed ring after m others, without new ones on straight walls; give the number."""
    degree, n_given = kept
    begin, length = m, len(nodes)
    for k in range(length):
        o, p, q = nodes[(k + length - 1) % length], nodes[k], nodes[(k + 1) % length]
        if p >= n_given and degree[p] == 2:
            back_x, back_y = place[o, 0] - place[p, 0], place[o, 1] - place[p, 1]
            on_x, on_y = place[q, 0] - place[p, 0], place[q, 1] - place[p, 1]
            if abs(back_x * on_y - back_y * on_x) < 2 * STRAIGHT * STRAIGHT:
                continue
        xy[m, 0], xy[m, 1] = place[p, 0], place[p, 1]
        m += 1
    xy[m, 0], xy[m, 1] = xy[begin, 0], xy[begin, 1]
    return m + 1


@kernel
def _area_of_places(xy: Array) -> float:
    """Area inside a closed ring of places; negative for a clockwise one."""
    twice = 0.0
    x, y = xy[0, 0], xy[0, 1]
    for v in range(1, len(xy)):
        twice += (xy[v - 1, 0] - x) * (xy[v, 1] - y) - (xy[v, 0] - x) * (xy[v - 1, 1] - y)
    return twice / 2
