"""Lines through a house, where its roof points fall best into two heights (for `house_levels`)."""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

MAX_DIRECTIONS = 4  # directions of walls along which lines are tried, those with most wall first
SAME_DIRECTION = 0.0872  # sine of 5 degrees; walls that differ by less count as one direction
MAX_TRIES = 4  # lines that are handed on, the best first
MIN_GAIN = 0.05  # least share of the squares around the mean height that a line takes away

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Line:
    """The line of the places whose product with ``normal`` is ``offset``.

    Attributes
    ----------
    along, normal : float64, (2,)
        Unit vectors along and across the line.
    offset : float
        Distance from the origin (m).
    """

    along: Array
    normal: Array
    offset: float


def rank_lines(a: Array, b: Array, xyz: Array, *, clearance: float, min_points: int) -> list[Line]:
    """Rank the lines along the walls by the squares around the mean height that they take away.

    Parameters
    ----------
    a, b : float64, (m, 2)
        Ends of the walls (m).
    xyz : float64, (n, 3)
        Points (m).
    clearance : float
        A line passes through a vertex or by it at this distance (m).
    min_points : int
        Least number of points on either side.

    Returns
    -------
    list of Line
        The best line through a vertex and the best between vertices for each direction, the best first;
        none that takes away less than `MIN_GAIN`.
    """
    z = xyz[:, 2] - xyz[:, 2].mean()
    total = float(z @ z)
    ranked: list[tuple[float, Line]] = []
    for along in _directions(a, b) if total > 0 else ():
        normal = np.array([-along[1], along[0]])
        across, vertex = xyz[:, :2] @ normal, a @ normal
        for gain, offset in zip(*_best_lines(across, z, vertex, total, clearance, min_points), strict=True):
            if gain >= MIN_GAIN:
                ranked.append((gain, Line(along, normal, offset)))
    ranked.sort(key=lambda entry: -entry[0])
    return [line for _, line in ranked[:MAX_TRIES]]


@numba.njit(cache=True, nogil=True)
def _directions(a: Array, b: Array) -> Array:
    """Unit vectors of the directions with most wall, each that of its longest wall."""
    d = b - a
    length = np.hypot(d[:, 0], d[:, 1])
    left = np.argsort(-length, kind="mergesort")
    found, total, same = np.empty_like(d), np.empty(len(d)), np.empty(len(d))
    n_found = 0
    while len(left):
        x, y = d[left[0]] / length[left[0]]
        n_same = n_left = 0
        for e in left:
            if abs(d[e, 0] / length[e] * y - d[e, 1] / length[e] * x) <= SAME_DIRECTION:
                same[n_same] = length[e]
                n_same += 1
            else:
                left[n_left] = e
                n_left += 1
        found[n_found, 0], found[n_found, 1], total[n_found] = x, y, _sum_pairwise(same[:n_same])
        n_found += 1
        left = left[:n_left]
    return found[np.argsort(-total[:n_found], kind="mergesort")[:MAX_DIRECTIONS]]


@numba.njit(cache=True, nogil=True)
def _sum_pairwise(values: Array) -> float:
    """Sum as numpy does: eight sums side by side, halves apart above 128 values."""
    n = len(values)
    if n > 128:
        half = n // 2 - n // 2 % 8
        both: float = _sum_pairwise(values[:half]) + _sum_pairwise(values[half:])
        return both
    sums = np.zeros(8)
    whole = n - n % 8
    for k in range(whole):
        sums[k % 8] += values[k]
    for step in (1, 2, 4):
        for k in range(0, 8, 2 * step):
            sums[k] += sums[k + step]
    total: float = sums[0]
    for k in range(whole, n):
        total += values[k]
    return total


@numba.njit(cache=True, nogil=True)
def _best_lines(
    across: Array, z: Array, vertex: Array, total: float, clearance: float, min_points: int
) -> tuple[Array, Array]:
    """Find the best line through a vertex, and the best between two points and clear of all vertices.

    Parameters
    ----------
    across, z : float64, (n,)
        Places of the points across the line, and their heights from the mean (m).
    vertex : float64, (m,)
        Places of the vertices across the line (m).
    total : float
        Sum of the squares of `z` (m²).

    Returns
    -------
    gain, offset : float64, (2,)
        Share of `total` that the line takes away, 0 with too few points on a side, and its place across (m); -1
        where there is no such line.
    """
    n = len(across)
    order = _argsort(across)
    gain = np.zeros(n + 1)
    running = 0.0
    for left in range(1, n + 1):  # points before the line
        running += z[order[left - 1]]
        if min_points <= left <= n - min_points:
            gain[left] = running * running * n / (left * (n - left)) / total
    vertex = np.sort(vertex)
    best, offset = np.full(2, -1.0), np.zeros(2)
    left = 0
    for v in vertex:
        while left < n and across[order[left]] < v:
            left += 1
        if gain[left] > best[0]:
            best[0], offset[0] = gain[left], v
    after = 0
    for left in range(1, n):
        low, high = across[order[left - 1]], across[order[left]]
        middle = (high + low) / 2
        while after < len(vertex) and vertex[after] < middle:
            after += 1
        room = min(abs(middle - vertex[max(after - 1, 0)]), abs(vertex[min(after, len(vertex) - 1)] - middle))
        if room >= clearance and high > low and gain[left] > best[1]:
            best[1], offset[1] = gain[left], middle
    return best, offset


@numba.njit(cache=True, nogil=True)
def _argsort(values: Array) -> NDArray[np.int64]:
    """Order values; equal ones stay in their order. Faster than numba's own stable sort."""
    order = np.argsort(values)
    i = 0
    while i < len(order):
        j = i + 1
        while j < len(order) and values[order[j]] == values[order[i]]:
            j += 1
        if j > i + 1:
            order[i:j].sort()
        i = j
    return order
