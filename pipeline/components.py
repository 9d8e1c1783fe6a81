"""Connected components: things that belong together by chains of pairs."""

import numpy as np
from numpy.typing import NDArray

from pipeline.kernel import kernel


def join_pairs(n: int, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Name the connected components of n things by the smallest index in each.

    Parameters
    ----------
    n : int
        Number of things.
    pairs : int64, (p, 2)
        Indices of things that belong together.

    Returns
    -------
    int64, (n,)
        Name of each thing's component.

    Examples
    --------
    >>> join_pairs(4, np.array([[3, 1]]))
    array([0, 1, 2, 1])
    """
    name: NDArray[np.int64] = _unite(np.arange(n), np.ascontiguousarray(pairs, np.int64))
    return name


@kernel(inline="always")
def unite(parent: NDArray[np.int64], a: int, b: int) -> None:
    """Unite the sets of two things, which are trees, with path halving; a parent is never above its child."""
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    while parent[b] != b:
        parent[b] = parent[parent[b]]
        b = parent[b]
    parent[max(a, b)] = min(a, b)


@kernel
def _unite(parent: NDArray[np.int64], pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Unite the sets of all pairs."""
    for k in range(len(pairs)):
        unite(parent, pairs[k, 0], pairs[k, 1])
    for i in range(len(parent)):
        parent[i] = parent[parent[i]]
    return parent
