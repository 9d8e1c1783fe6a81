"""Values and points put in order within groups that lie one after the other (steps 1.5 and 2.0)."""

from itertools import pairwise

import numba
import numpy as np
from numpy.typing import NDArray

FEW = 24  # points that are sorted one by one


def sort_values(start: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sort the values of each group, ``values[start[i]:start[i + 1]]``; none may be NaN.

    Examples
    --------
    >>> sort_values(np.array([0, 2, 2, 4]), np.array([3.0, 1.0, 2.0, 0.0]))
    array([1., 3., 0., 2.])
    """
    ordered = values.copy()
    for first, stop in pairwise(start.tolist()):
        ordered[first:stop].sort()  # of some hundred values, numpy's own is faster than a kernel's
    return ordered


@numba.njit(cache=True, nogil=True)
def sort_points(start: NDArray[np.int64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sort the points of each group by height, then y, then x.

    Parameters
    ----------
    start : int64, (n + 1,)
        Group ``i`` is ``xyz[start[i]:start[i + 1]]``; groups may be empty.
    xyz : float64, (k, 3)
        Points, none with NaN.

    Returns
    -------
    float64, (k, 3)

    Examples
    --------
    >>> sort_points(np.array([0, 1, 3]), np.array([[0.0, 0, 9], [2, 2, 5], [3, 1, 5]]))[:, 0]
    array([0., 3., 2.])
    """
    ordered = xyz.copy()
    for g in range(len(start) - 1):
        group = ordered[start[g] : start[g + 1]]
        bins = _deal_out(group, 2)
        for k in range(len(bins) - 1):
            _sort_run(group[bins[k] : bins[k + 1]])
    return ordered


@numba.njit(cache=True, nogil=True)
def _deal_out(xyz: NDArray[np.float64], axis: int) -> NDArray[np.int64]:
    """Put points in order of as many bins of equal width along an axis; give where each bin starts."""
    n = len(xyz)
    start = np.zeros(n + 1, np.int64)
    if n == 0:
        return start
    values = xyz[:, axis]
    low = high = values[0]
    for value in values:
        low, high = min(low, value), max(high, value)
    scale = (n - 1) / (high - low) if high > low else 0.0
    place = np.empty(n, np.int64)
    for k in range(n):
        place[k] = max(min(int((values[k] - low) * scale), n - 1), 0)
        start[place[k] + 1] += 1
    for k in range(n):
        start[k + 1] += start[k]
    old, free = xyz.copy(), start[:-1].copy()
    for k in range(n):
        to = free[place[k]]
        free[place[k]] += 1
        xyz[to, 0], xyz[to, 1], xyz[to, 2] = old[k, 0], old[k, 1], old[k, 2]
    return start


@numba.njit(cache=True, nogil=True)
def _sort_run(xyz: NDArray[np.float64]) -> None:
    """Sort points of about the same height in place; many of the very same height by bins again."""
    if len(xyz) <= FEW:
        _insert(xyz)
    elif xyz[:, 2].min() == xyz[:, 2].max():
        bins = _deal_out(xyz, 1)
        for k in range(len(bins) - 1):
            _sort_some(xyz[bins[k] : bins[k + 1]])
    else:
        _sort_some(xyz)


@numba.njit(cache=True, nogil=True)
def _sort_some(xyz: NDArray[np.float64]) -> None:
    """Sort points in place, whatever they are."""
    if len(xyz) <= FEW:
        _insert(xyz)
        return
    old, rows = xyz.copy(), np.arange(len(xyz))
    _order_rows(rows, old[:, 2])
    i = 0
    while i < len(rows):
        j = _end_of_run(old[:, 2], rows, i)
        if j > i + 1:
            _order_by_place(rows[i:j], old)
        i = j
    for k in range(len(rows)):
        xyz[k, 0], xyz[k, 1], xyz[k, 2] = old[rows[k], 0], old[rows[k], 1], old[rows[k], 2]


@numba.njit(cache=True, nogil=True)
def _insert(xyz: NDArray[np.float64]) -> None:
    """Sort a few points in place."""
    for k in range(1, len(xyz)):
        x, y, z = xyz[k]
        m = k
        while m > 0 and _is_before(x, y, z, xyz[m - 1, 0], xyz[m - 1, 1], xyz[m - 1, 2]):
            xyz[m, 0], xyz[m, 1], xyz[m, 2] = xyz[m - 1, 0], xyz[m - 1, 1], xyz[m - 1, 2]
            m -= 1
        xyz[m, 0], xyz[m, 1], xyz[m, 2] = x, y, z


@numba.njit(cache=True, nogil=True, inline="always")
def _is_before(x: float, y: float, z: float, x2: float, y2: float, z2: float) -> bool:
    if z != z2:
        return z < z2
    return y < y2 or (y == y2 and x < x2)


@numba.njit(cache=True, nogil=True)
def _order_by_place(rows: NDArray[np.int64], xyz: NDArray[np.float64]) -> None:
    """Order rows by y, then x, in place."""
    _order_rows(rows, xyz[:, 1])
    i = 0
    while i < len(rows):
        j = _end_of_run(xyz[:, 1], rows, i)
        if j > i + 1:
            _order_rows(rows[i:j], xyz[:, 0])
        i = j


@numba.njit(cache=True, nogil=True)
def _order_rows(rows: NDArray[np.int64], values: NDArray[np.float64]) -> None:
    """Order rows by their values, in place."""
    old = rows.copy()
    order = np.argsort(values[old])
    for k in range(len(rows)):
        rows[k] = old[order[k]]


@numba.njit(cache=True, nogil=True)
def _end_of_run(values: NDArray[np.float64], rows: NDArray[np.int64], i: int) -> int:
    """First place after ``i`` at which the rows have another value."""
    j = i + 1
    while j < len(rows) and values[rows[j]] == values[rows[i]]:
        j += 1
    return j
