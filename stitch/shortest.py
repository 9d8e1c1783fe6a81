"""Shortest paths along edges."""

import heapq

import numpy as np
from numpy.typing import NDArray

from pipeline.kernel import kernel


def find_shortest(
    edges: NDArray[np.int64], cost: NDArray[np.float64], usable: NDArray[np.bool_], start: int, end: int
) -> NDArray[np.int64]:
    """Find the shortest path between two vertices.

    Parameters
    ----------
    edges : int64, (e, 2)
        Vertices that are joined, each pair once.
    cost : float64, (e,)
        What each edge costs, not negative.
    usable : bool, (n,)
        Vertices that may be on the path.
    start, end : int
        Vertices, both usable.

    Returns
    -------
    int64, (k,)
        Vertices from start to end, none if there is no path.

    Notes
    -----
    Dijkstra's algorithm, until the end is reached. Where paths are equally short, which one it is depends on the
    numbers of vertices and the order of edges alone.

    Examples
    --------
    >>> edges = np.array([[0, 1], [1, 2], [0, 2]])
    >>> find_shortest(edges, np.array([1.0, 1.0, 3.0]), np.ones(3, bool), 0, 2)
    array([0, 1, 2])
    """
    kept = usable[edges].all(axis=1)
    before = _search(edges[kept], cost[kept], len(usable), start, end)
    path = [end]
    while path[-1] != start:
        if path[-1] < 0:
            return np.empty(0, np.int64)
        path.append(int(before[path[-1]]))
    return np.array(path[::-1])


@kernel
def _search(
    edges: NDArray[np.int64], cost: NDArray[np.float64], n: int, start: int, end: int
) -> NDArray[np.int64]:
    """Find the vertex before each on the way from the first, -1 where none is known when the last is reached."""
    first, head, length = _index_edges(edges, cost, n)
    before, distance = np.full(n, -1), np.full(n, np.inf)
    distance[start] = 0.0
    queue = [(0.0, start)]
    while queue:
        reached, v = heapq.heappop(queue)
        if v == end:
            break
        if reached > distance[v]:
            continue
        for k in range(first[v], first[v + 1]):
            further = reached + length[k]
            if further < distance[head[k]]:
                distance[head[k]], before[head[k]] = further, v
                heapq.heappush(queue, (further, head[k]))
    return before


@kernel
def _index_edges(
    edges: NDArray[np.int64], cost: NDArray[np.float64], n: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Put edges by vertex: where those of each begin, the other end and the cost of each."""
    first = np.zeros(n + 1, np.int64)
    for e in range(len(edges)):
        first[edges[e, 0] + 1] += 1
        first[edges[e, 1] + 1] += 1
    first = np.cumsum(first)
    head, length, filled = np.empty(2 * len(edges), np.int64), np.empty(2 * len(edges)), first[:-1].copy()
    for e in range(len(edges)):
        for k in range(2):
            v = edges[e, k]
            head[filled[v]], length[filled[v]] = edges[e, 1 - k], cost[e]
            filled[v] += 1
    return first, head, length
