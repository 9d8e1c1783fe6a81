"""Optimisation of the plane mesh (step 3.1, ours): vertices move, edges flip, walls and borders stay.

Each pass first moves every free vertex to where the triangles around it are closest to equilateral (mean
ratio), then flips edges until the mesh is Delaunay between the walls again. An edge is a wall where the labels of
its two sides differ; walls, border edges and their vertices stay as they are, bit for bit.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.plane_mesh.edges import triangle_neighbours

SEARCH_SWEEPS = 6  # rounds of the search in each pass
FIRST_STEP = 0.15  # of the mesh size: the search's first step
LAST_STEP = 0.01  # of the first step: the search's last
MAX_FLIP_SWEEPS = 100  # a bound that rounding could otherwise break; some 5 were seen
FLIP_TOLERANCE = 1e-10  # sine of the angle by which two opposite angles must exceed a half turn
MAX_RING = 64  # triangles around a vertex; a vertex with more stays

# To stay, and the cosines and sines of multiples of 45 degrees, written out: the same bits on every machine.
_D = 0.7071067811865476
DIRECTIONS = np.array(
    [[0.0, 0], [1.0, 0], [_D, _D], [0, 1.0], [-_D, _D], [-1.0, 0], [-_D, -_D], [0, -1.0], [_D, -_D]]
)


def improve_plane(
    xy: NDArray[np.float64],
    triangles: NDArray[np.int32],
    label: NDArray[np.int32],
    *,
    mesh_size: float | NDArray[np.float64],
    passes: int,
    kept: NDArray[np.int32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Move free vertices and flip free edges for better angles.

    Parameters
    ----------
    xy : float64, (n, 2)
        Vertices (m).
    triangles : int32, (m, 3)
        Vertex indices, counter-clockwise.
    label : int32, (m,)
        What each triangle belongs to; edges between different labels are kept.
    mesh_size : float or float64 (n,)
        Target edge length (m), one for all or one a vertex, which scales the search.
    passes : int
        Rounds of moving and flipping; 0 returns the input.
    kept : int32, (k, 2), optional
        Pairs of vertices whose edges stay, too, those that no edge has do not matter.

    Returns
    -------
    xy : float64, (n, 2)
        Vertices (m).
    triangles : int32, (m, 3)
        Vertex indices, counter-clockwise; row by row of the same label as before.

    Notes
    -----
    Moving vertices makes angles better, not areas equal: the largest triangle may outgrow its bound by
    some half. Cost is linear in the vertices.
    """
    xy, triangles = xy.copy(), triangles.copy()
    if passes == 0:
        return xy, triangles
    neighbour = triangle_neighbours(triangles)
    if kept is not None and len(kept):
        _part_at(kept, triangles, neighbour, len(xy))
    frozen = _frozen_vertices(len(xy), triangles, neighbour, label)
    first_step = FIRST_STEP * np.broadcast_to(np.asarray(mesh_size, np.float64), len(xy))
    for _ in range(passes):
        _move_vertices(xy, triangles, neighbour, frozen, DIRECTIONS, first_step)
        _flip_edges(xy, triangles, neighbour, label)
    return xy, triangles


def _frozen_vertices(
    n: int, triangles: NDArray[np.int32], neighbour: NDArray[np.int32], label: NDArray[np.int32]
) -> NDArray[np.bool_]:
    kept = (neighbour < 0) | (label[neighbour] != label[:, None])
    frozen = np.zeros(n, np.bool_)
    for k in range(3):
        frozen[triangles[kept[:, k]][:, [(k + 1) % 3, (k + 2) % 3]]] = True
    return frozen


def _part_at(kept: NDArray[np.int32], triangles: NDArray[np.int32], neighbour: NDArray[np.int32], n: int) -> None:
    """Part the triangles on both sides of edges, in place: an edge without a neighbour stays."""
    ends = np.sort(kept.astype(np.int64), axis=1)
    wanted = ends[:, 0] * n + ends[:, 1]
    for k in range(3):
        p, q = (triangles[:, (k + i) % 3].astype(np.int64) for i in (1, 2))
        neighbour[np.isin(np.minimum(p, q) * n + np.maximum(p, q), wanted), k] = -1


@kernel(error_model="numpy")
def _ring_costs(
    ring: NDArray[np.float64], n: int, x: NDArray[np.float64], y: NDArray[np.float64], cost: NDArray[np.float64]
) -> None:
    """Sum of (squared edges / area)^4 of the triangles around each of some places; infinite outside of them."""
    cost[:] = 0.0
    for k in range(n):
        ax, ay, bx, by, opposite = ring[k, 0], ring[k, 1], ring[k, 2], ring[k, 3], ring[k, 4]
        for d in range(len(cost)):
            px, py = ax - x[d], ay - y[d]
            qx, qy = bx - x[d], by - y[d]
            area2 = px * qy - py * qx
            ratio = (px * px + py * py + qx * qx + qy * qy + opposite) / area2
            square = ratio * ratio
            cost[d] += square * square if area2 > 0 else np.inf


@kernel
def _collect_ring(
    xy: NDArray[np.float64],
    triangles: NDArray[np.int32],
    neighbour: NDArray[np.int32],
    vertex: int,
    first: int,
    ring: NDArray[np.float64],
) -> int:
    """Edges opposite to an inner vertex in its triangles, with their squared lengths; 0 if too many."""
    n, t = 0, first
    while n < MAX_RING:
        k = 0 if triangles[t, 0] == vertex else (1 if triangles[t, 1] == vertex else 2)
        p, q = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
        ring[n, 0], ring[n, 1] = xy[p, 0], xy[p, 1]
        ring[n, 2], ring[n, 3] = xy[q, 0], xy[q, 1]
        dx, dy = xy[q, 0] - xy[p, 0], xy[q, 1] - xy[p, 1]
        ring[n, 4] = dx * dx + dy * dy
        n += 1
        t = neighbour[t, (k + 1) % 3]
        if t == first:
            return n
    return 0


@kernel
def _move_vertices(
    xy: NDArray[np.float64],
    triangles: NDArray[np.int32],
    neighbour: NDArray[np.int32],
    frozen: NDArray[np.bool_],
    directions: NDArray[np.float64],
    first_step: NDArray[np.float64],
) -> None:
    """Compass search: the best of eight places a step away, else half the step."""
    of_vertex = np.full(len(xy), -1, np.int32)
    for t in range(len(triangles)):
        for k in range(3):
            of_vertex[triangles[t, k]] = t
    step = first_step.copy()
    ring = np.empty((MAX_RING, 5))
    x, y, cost = np.empty(len(directions)), np.empty(len(directions)), np.empty(len(directions))
    for _ in range(SEARCH_SWEEPS):
        for v in range(len(xy)):
            if frozen[v] or of_vertex[v] < 0 or step[v] < LAST_STEP * first_step[v]:
                continue
            n = _collect_ring(xy, triangles, neighbour, v, of_vertex[v], ring)
            for d in range(len(directions)):
                x[d] = xy[v, 0] + step[v] * directions[d, 0]
                y[d] = xy[v, 1] + step[v] * directions[d, 1]
            _ring_costs(ring, n, x, y, cost)
            best = 0
            for d in range(1, len(directions)):
                if cost[d] < cost[best]:
                    best = d
            xy[v, 0], xy[v, 1] = x[best], y[best]
            step[v] *= 1.25 if best else 0.5


@kernel
def _flip_edges(
    xy: NDArray[np.float64], triangles: NDArray[np.int32], neighbour: NDArray[np.int32], label: NDArray[np.int32]
) -> None:
    """Flip edges until the mesh is Delaunay within each label."""
    for _ in range(MAX_FLIP_SWEEPS):
        flipped = False
        for t in range(len(triangles)):
            for k in range(3):
                u = neighbour[t, k]
                if u > t and label[u] == label[t] and _wants_flip(xy, triangles, neighbour, t, k, u):
                    _flip(triangles, neighbour, t, k, u)
                    flipped = True
        if not flipped:
            return


@kernel(inline="always")
def _side_of(neighbour: NDArray[np.int32], u: int, t: int) -> int:
    return 0 if neighbour[u, 0] == t else (1 if neighbour[u, 1] == t else 2)


@kernel
def _wants_flip(
    xy: NDArray[np.float64], triangles: NDArray[np.int32], neighbour: NDArray[np.int32], t: int, k: int, u: int
) -> bool:
    """Whether the angles opposite to the edge add up to more than a half turn: then the quad is convex."""
    a, b = triangles[t, k], triangles[u, _side_of(neighbour, u, t)]
    p, q = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
    apx, apy, aqx, aqy = xy[p, 0] - xy[a, 0], xy[p, 1] - xy[a, 1], xy[q, 0] - xy[a, 0], xy[q, 1] - xy[a, 1]
    bpx, bpy, bqx, bqy = xy[p, 0] - xy[b, 0], xy[p, 1] - xy[b, 1], xy[q, 0] - xy[b, 0], xy[q, 1] - xy[b, 1]
    sin_a, cos_a = apx * aqy - apy * aqx, apx * aqx + apy * aqy
    sin_b, cos_b = bqx * bpy - bqy * bpx, bqx * bpx + bqy * bpy
    scale = np.sqrt((sin_a * sin_a + cos_a * cos_a) * (sin_b * sin_b + cos_b * cos_b))
    return bool(sin_a * cos_b + cos_a * sin_b < -FLIP_TOLERANCE * scale)


@kernel
def _flip(triangles: NDArray[np.int32], neighbour: NDArray[np.int32], t: int, k: int, u: int) -> None:
    """Turn triangles a-p-q and b-q-p into a-p-b and a-b-q."""
    j = _side_of(neighbour, u, t)
    a, p, q = triangles[t, k], triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
    b = triangles[u, j]
    over_aq, over_ap = neighbour[t, (k + 1) % 3], neighbour[t, (k + 2) % 3]
    over_bp, over_bq = neighbour[u, (j + 1) % 3], neighbour[u, (j + 2) % 3]
    triangles[t, 0], triangles[t, 1], triangles[t, 2] = a, p, b
    neighbour[t, 0], neighbour[t, 1], neighbour[t, 2] = over_bp, u, over_ap
    triangles[u, 0], triangles[u, 1], triangles[u, 2] = a, b, q
    neighbour[u, 0], neighbour[u, 1], neighbour[u, 2] = over_bq, over_aq, t
    if over_bp >= 0:
        neighbour[over_bp, _side_of(neighbour, over_bp, u)] = t
    if over_aq >= 0:
        neighbour[over_aq, _side_of(neighbour, over_aq, t)] = u
