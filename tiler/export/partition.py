"""Pieces dealt out to processes: compact groups of about equal cells."""

import numpy as np
from numpy.typing import NDArray


def split_pieces(centre: NDArray[np.float64], weight: NDArray[np.int64], n_parts: int) -> NDArray[np.int64]:
    """Deal pieces out by recursive bisection across the longer side.

    Parameters
    ----------
    centre : float64, (k, 2)
        Middle of each piece (m).
    weight : int64, (k,)
        Its cells.
    n_parts : int
        Number of parts, at most `k`.

    Returns
    -------
    int64, (k,)
        Part of each piece; every part has one at least.

    Raises
    ------
    ValueError
        If there are fewer pieces than parts, or no part.

    Examples
    --------
    >>> split_pieces(np.array([[0.0, 0], [1, 0], [2, 0], [3, 0]]), np.array([1, 1, 1, 3]), 2)
    array([0, 0, 0, 1])
    """
    if not 1 <= n_parts <= len(weight):
        raise ValueError(f"{n_parts} parts of {len(weight)} pieces")
    part = np.empty(len(weight), np.int64)
    waiting = [(np.arange(len(weight)), 0, n_parts)]
    while waiting:
        rows, first, n = waiting.pop()
        if n == 1:
            part[rows] = first
            continue
        low = n // 2
        rows, cut = _bisect(rows, centre, weight, low, n - low)
        waiting += [(rows[:cut], first, low), (rows[cut:], first + low, n - low)]
    return part


def _bisect(
    rows: NDArray[np.int64], centre: NDArray[np.float64], weight: NDArray[np.int64], low: int, high: int
) -> tuple[NDArray[np.int64], int]:
    """Order pieces along the longer side, and find the cut that leaves `low` and `high` parts even."""
    axis = int(np.ptp(centre[rows], axis=0).argmax())
    rows = rows[np.lexsort((rows, centre[rows, 1 - axis], centre[rows, axis]))]
    total = np.cumsum(weight[rows])
    cuts = np.arange(low, len(rows) - high + 1)
    heaviest = np.maximum(total[cuts - 1] / low, (total[-1] - total[cuts - 1]) / high)
    return rows, int(cuts[heaviest.argmin()])
