"""Values and points put in order within groups that lie one after the other (steps 1.5 and 2.0)."""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel

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


def percentile_by_group(
    start: NDArray[np.int64], z: NDArray[np.float64], percentile: float
) -> NDArray[np.float64]:
    """Percentile of each group of ascending values, linear between order statistics; NaN if empty.

    Examples
    --------
    >>> percentile_by_group(np.array([0, 3, 3]), np.array([1.0, 2.0, 4.0]), 75)
    array([ 3., nan])
    """
    count = np.diff(start)
    filled = count > 0
    position = (count[filled] - 1) * (percentile / 100)
    low = np.floor(position).astype(np.int64)
    high = np.minimum(low + 1, count[filled] - 1)
    begin = start[:-1][filled]
    below, above = z[begin + low], z[begin + high]
    result = np.full(len(count), np.nan)
    result[filled] = below + (above - below) * (position - low)
    return result


@kernel
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
        sort_group(ordered[start[g] : start[g + 1]])
    return ordered


@kernel
def sort_group(xyz: NDArray[np.float64]) -> None:
    """Sort the points of one group, (n, 3), in place, as `sort_points` does; for kernels."""
    bins = _sort_into_bins(xyz)
    for k in range(len(bins) - 1):
        _sort(xyz[bins[k] : bins[k + 1]])


@kernel
def order_values(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rows of values, (n,), in ascending order, those of equal ones as they come; for kernels."""
    n = len(values)
    rows, order = np.empty((n, 3)), np.empty(n, np.int64)
    for k in range(n):
        rows[k, 0], rows[k, 1], rows[k, 2] = 0.0, k, values[k]
    sort_group(rows)
    for k in range(n):
        order[k] = int(rows[k, 1])
    return order


@kernel
def _sort_into_bins(xyz: NDArray[np.float64]) -> NDArray[np.int64]:
    """Put points in order of as many bins of equal height; give where each bin starts."""
    n = len(xyz)
    start = np.zeros(n + 1, np.int64)
    if n == 0:
        return start
    values = xyz[:, 2]
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


@kernel
def _sort(xyz: NDArray[np.float64]) -> None:
    """Sort points in place: a few at a time, and what is sorted is merged."""
    n = len(xyz)
    for first in range(0, n, FEW):
        _insert(xyz[first : min(first + FEW, n)])
    if n <= FEW:
        return
    room = np.empty((n, 3))
    width: Any = np.int64(FEW)  # for a constant, numba would compile `_merge` once more
    while width < n:
        for first in range(0, n - width, 2 * width):
            _merge(xyz[first : min(first + 2 * width, n)], width, room)
        width *= 2


@kernel
def _merge(xyz: NDArray[np.float64], middle: int, room: NDArray[np.float64]) -> None:
    """Merge the sorted points before the middle with those after it, in place."""
    for k in range(middle):
        room[k, 0], room[k, 1], room[k, 2] = xyz[k, 0], xyz[k, 1], xyz[k, 2]
    first, second, to = 0, middle, 0
    while first < middle:
        x, y, z = room[first, 0], room[first, 1], room[first, 2]
        while second < len(xyz) and _is_before(xyz[second, 0], xyz[second, 1], xyz[second, 2], x, y, z):
            xyz[to, 0], xyz[to, 1], xyz[to, 2] = xyz[second, 0], xyz[second, 1], xyz[second, 2]
            second += 1
            to += 1
        xyz[to, 0], xyz[to, 1], xyz[to, 2] = x, y, z
        first += 1
        to += 1


@kernel
def _insert(xyz: NDArray[np.float64]) -> None:
    """Sort a few points in place."""
    for k in range(1, len(xyz)):
        x, y, z = xyz[k]
        m = k
        while m > 0 and _is_before(x, y, z, xyz[m - 1, 0], xyz[m - 1, 1], xyz[m - 1, 2]):
            xyz[m, 0], xyz[m, 1], xyz[m, 2] = xyz[m - 1, 0], xyz[m - 1, 1], xyz[m - 1, 2]
            m -= 1
        xyz[m, 0], xyz[m, 1], xyz[m, 2] = x, y, z


@kernel(inline="always")
def _is_before(x: float, y: float, z: float, x2: float, y2: float, z2: float) -> bool:
    if z != z2:
        return z < z2
    return y < y2 or (y == y2 and x < x2)
