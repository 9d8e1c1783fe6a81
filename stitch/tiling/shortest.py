"""Shortest paths along edges."""

import numpy as np
from numpy.typing import NDArray


def find_shortest(
    edges: NDArray[np.int64], cost: NDArray[np.float64], usable: NDArray[np.bool_], start: int, end: int
) -> NDArray[np.int64]:
    """Find the shortest path between two vertices.

    Parameters
    ----------
    edges : int64, (e, 2)
        Vertices that are joined, each pair once.
    cost : float64, (e,)
        What each edge costs, above 0.
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
    Distances are scipy's. Of equally short paths scipy does not say which one it takes, so the path is followed
    back from the end: of the vertices that lead to one at its distance, to the nearest to the start, of equally
    near ones to that of the lowest number.

    Examples
    --------
    >>> edges = np.array([[0, 1], [1, 2], [0, 2]])
    >>> find_shortest(edges, np.array([1.0, 1.0, 3.0]), np.ones(3, bool), 0, 2)
    array([0, 1, 2])
    """
    from scipy.sparse import csr_array  # 0.3 s, which a plan need not wait for
    from scipy.sparse.csgraph import dijkstra

    kept = usable[edges].all(axis=1)
    n, (one, other) = len(usable), edges[kept].T
    rows, columns = np.concatenate((one, other)), np.concatenate((other, one))
    graph = csr_array((np.tile(cost[kept], 2), (rows, columns)), shape=(n, n))
    distance = dijkstra(graph, indices=[start])[0]
    if np.isinf(distance[end]):
        return np.empty(0, np.int64)
    path = [end]
    while path[-1] != start:
        row = slice(*graph.indptr[path[-1] : path[-1] + 2])
        before = graph.indices[row]
        before = before[distance[before] + graph.data[row] == distance[path[-1]]]
        path.append(int(before[np.lexsort((before, distance[before]))[0]]))
    return np.array(path[::-1])
