"""Edges of a plane mesh: which there are, and which triangles lie beside them."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel


def plane_edges(triangles: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Edges of a plane mesh and the triangles beside them.

    Parameters
    ----------
    triangles : int32, (m, 3)
        Vertex indices.

    Returns
    -------
    edges : int32, (e, 2)
        Ascending vertex indices, each edge once, sorted.
    of_triangle : int32, (m, 3)
        Edges of each triangle: those between its corners 0-1, 0-2, 1-2.

    Notes
    -----
    Linear in the triangles, but for the most edges that one vertex has: these are sorted by insertion.
    """
    edges: NDArray[np.int32]
    of_triangle: NDArray[np.int32]
    edges, of_triangle = _number_edges(triangles, int(triangles.max()) + 1)
    return edges, of_triangle


def triangle_neighbours(triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Find the triangle across the edge opposite to each corner, -1 at the border.

    Parameters
    ----------
    triangles : int32, (m, 3)
        Vertex indices.

    Examples
    --------
    >>> triangle_neighbours(np.array([[0, 1, 2], [2, 1, 3]], np.int32)).tolist()
    [[1, -1, -1], [-1, -1, 0]]
    """
    edges, of_triangle = plane_edges(triangles)
    neighbour: NDArray[np.int32] = _pair_triangles(of_triangle, len(edges))
    return neighbour


def sort_triangles(triangles: NDArray[np.int32]) -> NDArray[np.int64]:
    """Order that sorts triangles, int32 (m, 3), by their vertices, the first first; those alike stay in order.

    Examples
    --------
    >>> sort_triangles(np.array([[1, 2, 3], [0, 2, 4], [0, 2, 3]], np.int32)).tolist()
    [2, 1, 0]
    """
    order: NDArray[np.int64] = _sort_rows(triangles, int(triangles.max(initial=-1)) + 1)
    return order


@kernel
def _number_edges(triangles: NDArray[np.int32], n: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Put the edges at their lower vertices, and sort those of each by the higher one."""
    m = len(triangles)
    start = np.zeros(n + 1, np.int64)
    for t in range(m):
        a, b, c = triangles[t]
        start[min(a, b) + 1] += 1
        start[min(a, c) + 1] += 1
        start[min(b, c) + 1] += 1
    for v in range(n):
        start[v + 1] += start[v]
    end = start[:-1].copy()
    higher, place = np.empty(3 * m, np.int32), np.empty(3 * m, np.int32)
    for t in range(m):
        for k in range(3):
            a, b = triangles[t, 0 if k < 2 else 1], triangles[t, 1 if k == 0 else 2]
            low, high = min(a, b), max(a, b)
            at = end[low]
            end[low] += 1
            while at > start[low] and higher[at - 1] > high:
                higher[at], place[at] = higher[at - 1], place[at - 1]
                at -= 1
            higher[at], place[at] = high, 3 * t + k
    edges, of_triangle = np.empty((3 * m, 2), np.int32), np.empty((m, 3), np.int32)
    e = 0
    for v in range(n):
        for at in range(start[v], start[v + 1]):
            if at == start[v] or higher[at] != higher[at - 1]:
                edges[e, 0], edges[e, 1] = v, higher[at]
                e += 1
            of_triangle[place[at] // 3, place[at] % 3] = e - 1
    return edges[:e].copy(), of_triangle


@kernel
def _pair_triangles(of_triangle: NDArray[np.int32], n_edges: int) -> NDArray[np.int32]:
    neighbour = np.full(of_triangle.shape, -1, np.int32)
    earlier = np.full(n_edges, -1, np.int32)
    for t in range(len(of_triangle)):
        for k in range(3):
            e = of_triangle[t, 2 - k]  # edges 1-2, 0-2 and 0-1 lie opposite to corners 0, 1 and 2
            if earlier[e] >= 0:
                other = earlier[e] // 3
                neighbour[t, k], neighbour[other, earlier[e] % 3] = other, t
            earlier[e] = 3 * t + k
    return neighbour


@kernel
def _sort_rows(triangles: NDArray[np.int32], n: int) -> NDArray[np.int64]:
    start = np.zeros(n + 1, np.int64)
    for t in range(len(triangles)):
        start[triangles[t, 0] + 1] += 1
    for v in range(n):
        start[v + 1] += start[v]
    end = start[:-1].copy()
    order = np.empty(len(triangles), np.int64)
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        at = end[a]
        end[a] += 1
        while at > start[a]:
            p, q = triangles[order[at - 1], 1], triangles[order[at - 1], 2]
            if p < b or (p == b and q <= c):
                break
            order[at] = order[at - 1]
            at -= 1
        order[at] = t
    return order
