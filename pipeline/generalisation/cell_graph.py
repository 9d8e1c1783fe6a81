"""Cells of a region by numbers alone: small ones joined to the neighbour with the longest border."""

import heapq

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def join_small(
    area: Array, pairs: Index, length: Array, limit: float, *, among: NDArray[np.bool_] | None = None
) -> Index:
    """Join small cells to the neighbour with the longest border, the smallest cell first.

    Parameters
    ----------
    area : float64, (n,)
        Of each cell (m2).
    pairs : int64, (p, 2)
        Cells that share a border, each pair once.
    length : float64, (p,)
        Of that border (m).
    limit : float
        Without `among`, cells below this are fragments, and any neighbour takes them. With `among`, cells up to
        this are joined with each other (m2).
    among : bool, (n,), optional
        Cells that may be joined; no other takes part, nor one that has become greater than `limit`.

    Returns
    -------
    int64, (n,)
        For each cell the smallest index of those that it is joined with.

    Notes
    -----
    A joined cell is a cell: it goes on while it is small. Of equal borders the greater neighbour, then the smaller
    index is taken. With `among` no result is greater than twice the limit. O(p log p); memory holds some hundred
    bytes for each border of a small cell.

    Examples
    --------
    >>> join_small(np.array([5.0, 90, 80]), np.array([[0, 1], [0, 2]]), np.array([2.0, 3]), 10)
    array([0, 1, 0])
    """
    size, root = area.tolist(), np.arange(len(area))
    beside: dict[int, dict[int, float]] = {}
    # Cells only grow, so that borders of which none can be looked at may be left out: those of two large cells, or
    # with `among` of one.
    small = area < limit if among is None else among & (area <= limit)
    used = small[pairs].any(axis=1) if among is None else small[pairs].all(axis=1)
    for (a, b), border in zip(pairs[used].tolist(), length[used].tolist(), strict=True):
        beside.setdefault(a, {})[b] = border
        beside.setdefault(b, {})[a] = border

    def is_small(cell: int) -> bool:
        return bool(size[cell] < limit if among is None else size[cell] <= limit)

    waiting = [(size[cell], cell) for cell in beside if is_small(cell)]
    heapq.heapify(waiting)
    while waiting:
        known, cell = heapq.heappop(waiting)
        if cell not in beside or known != size[cell]:
            continue
        near = [other for other in beside[cell] if among is None or is_small(other)]
        if not near:
            continue
        into = max(near, key=lambda other: (beside[cell][other], size[other], -other))
        for other, border in beside.pop(cell).items():
            del beside[other][cell]
            if other != into:
                beside[into][other] = beside[other][into] = beside[into].get(other, 0.0) + border
        size[into] += size[cell]
        root[cell] = into
        if is_small(into):
            heapq.heappush(waiting, (size[into], into))
    while (root[root] != root).any():
        root = root[root]
    first = np.full(len(area), len(area))
    np.minimum.at(first, root, np.arange(len(area)))
    return first[root]
