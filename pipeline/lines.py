"""Lines through a house, where its roof points fall best into two heights (for `house_levels`)."""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.group_order import sort_group

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
        across, vertex = xyz[:, :2] @ normal, np.sort(a @ normal)
        for gain, offset in zip(*_best_lines(across, z, vertex, total, clearance, min_points), strict=True):
            if gain >= MIN_GAIN:
                ranked.append((gain, Line(along, normal, offset)))
    ranked.sort(key=lambda entry: -entry[0])
    return [line for _, line in ranked[:MAX_TRIES]]


def _directions(a: Array, b: Array) -> Array:
    """Unit vectors of the directions with most wall, each that of its longest wall."""
    d = b - a
    length = np.hypot(d[:, 0], d[:, 1])
    found, total = _group_directions(d / length[:, None], length, np.argsort(-length, kind="stable"))
    most: Array = found[np.argsort(-total, kind="stable")[:MAX_DIRECTIONS]]
    return most


@numba.njit(cache=True, nogil=True)
def _group_directions(along: Array, length: Array, left: NDArray[np.int64]) -> tuple[Array, Array]:
    """Group walls of about the same direction, in the order that is given; gives directions and length of all.

    The order is used up.
    """
    n = len(left)
    found, total, same = np.empty((n, 2)), np.empty(n), np.empty(n)
    n_found = 0
    while n:
        x, y = along[left[0], 0], along[left[0], 1]
        n_same = n_left = 0
        for k in range(n):
            e = left[k]
            if abs(along[e, 0] * y - along[e, 1] * x) <= SAME_DIRECTION:
                same[n_same] = length[e]
                n_same += 1
            else:
                left[n_left] = e
                n_left += 1
        found[n_found, 0], found[n_found, 1], total[n_found] = x, y, _sum_pairwise(same[:n_same])
        n_found += 1
        n = n_left
    return found[:n_found], total[:n_found]


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
        Places of the vertices across the line, ascending (m).
    total : float
        Sum of the squares of `z` (m²).

    Returns
    -------
    gain, offset : float64, (2,)
        Share of `total` that the line takes away, 0 with too few points on a side, and its place across (m); -1
        where there is no such line.
    """
    n = len(across)
    points = np.empty((n, 3))  # in order across the line, and as they come where they are on one line
    for k in range(n):
        points[k, 0], points[k, 1], points[k, 2] = z[k], k, across[k]
    sort_group(points)
    gain = np.zeros(n + 1)
    running = 0.0
    for left in range(1, n + 1):  # points before the line
        running += points[left - 1, 0]
        if min_points <= left <= n - min_points:
            gain[left] = running * running * n / (left * (n - left)) / total
    best, offset = np.full(2, -1.0), np.zeros(2)
    left = 0
    for v in vertex:
        while left < n and points[left, 2] < v:
            left += 1
        if gain[left] > best[0]:
            best[0], offset[0] = gain[left], v
    after = 0
    for left in range(1, n):
        low, high = points[left - 1, 2], points[left, 2]
        middle = (high + low) / 2
        while after < len(vertex) and vertex[after] < middle:
            after += 1
        room = min(abs(middle - vertex[max(after - 1, 0)]), abs(vertex[min(after, len(vertex) - 1)] - middle))
        if room >= clearance and high > low and gain[left] > best[1]:
            best[1], offset[1] = gain[left], middle
    return best, offset
