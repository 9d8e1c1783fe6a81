"""Lines through a house, where its roof points fall best into two heights (for `house_levels`)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.group_order import order_values, sort_group

MAX_DIRECTIONS = 4  # directions of walls along which lines are tried, those with most wall first
SAME_DIRECTION = 0.0872  # sine of 5 degrees; walls that differ by less count as one direction
MAX_TRIES = 4  # lines that are handed on, the best first
MIN_GAIN = 0.05  # least share of the squares around the mean height that a line takes away

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Line:
    """The line of the places whose product with ``normal`` is ``offset``."""

    along: Array  #: (2,): unit vector along the line
    offset: float  #: distance from the origin (m)

    @property
    def normal(self) -> Array:
        """Unit vector across the line, float64 (2,): a quarter turn to the left."""
        return np.array([-self.along[1], self.along[0]])


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
    return [
        Line(np.array([x, y]), offset) for x, y, offset in _rank_lines(a, b, xyz, clearance, min_points).tolist()
    ]


@kernel
def _rank_lines(a: Array, b: Array, xyz: Array, clearance: float, min_points: int) -> Array:
    """Rank lines as `rank_lines` does; gives direction and offset of each, (k, 3)."""
    n = len(xyz)
    z = xyz[:, 2].copy()
    mean, total = _sum_pairwise(z) / max(n, 1), sum_squares(z)
    for k in range(n):
        z[k] -= mean
    if not total > 0:
        return np.empty((0, 3))
    directions = wall_directions(a, b)
    n_found = 2 * len(directions)
    found, loss = np.empty((n_found, 3)), np.empty(n_found)
    across, vertex = np.empty(n), np.empty(len(a))
    for d in range(len(directions)):
        along_x, along_y = directions[d, 0], directions[d, 1]
        for k in range(n):
            across[k] = xyz[k, 1] * along_x - xyz[k, 0] * along_y
        for k in range(len(a)):
            vertex[k] = a[k, 1] * along_x - a[k, 0] * along_y
        gain, offset = _best_lines(across, z, vertex[order_values(vertex)], total, clearance, min_points)
        for k in range(2):
            row = 2 * d + k
            found[row, 0], found[row, 1], found[row, 2], loss[row] = along_x, along_y, offset[k], -gain[k]
    lines = np.empty((min(n_found, MAX_TRIES), 3))
    n_lines = 0
    for row in order_values(loss)[:MAX_TRIES]:
        if loss[row] <= -MIN_GAIN:
            lines[n_lines, 0], lines[n_lines, 1], lines[n_lines, 2] = found[row, 0], found[row, 1], found[row, 2]
            n_lines += 1
    return lines[:n_lines].copy()


@kernel
def wall_directions(a: Array, b: Array) -> Array:
    """Unit vectors of the directions with most wall, each that of its longest wall."""
    n = len(a)
    along, length = np.empty((n, 2)), np.empty(n)
    for e in range(n):
        x, y = b[e, 0] - a[e, 0], b[e, 1] - a[e, 1]
        length[e] = math.hypot(x, y)
        along[e, 0], along[e, 1] = x / length[e], y / length[e]
    found, total = _group_directions(along, length, order_values(-length))
    order = order_values(-total)
    most = np.empty((min(len(found), MAX_DIRECTIONS), 2))
    for k in range(len(most)):
        most[k, 0], most[k, 1] = found[order[k], 0], found[order[k], 1]
    return most


@kernel
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


@kernel
def sum_squares(z: Array) -> float:
    """Sum the squares of heights around their mean (m²)."""
    n = len(z)
    mean, squares = _sum_pairwise(z) / max(n, 1), np.empty(n)
    for k in range(n):
        squares[k] = (z[k] - mean) * (z[k] - mean)
    total: float = _sum_pairwise(squares)
    return total


@kernel
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


@kernel
def _best_lines(
    across: Array, z: Array, vertex: Array, total: float, clearance: float, min_points: int
) -> tuple[Array, Array]:
    """Find the best line through a vertex, and the best between two points and clear of all vertices.

    Gives the share of the squares `total` of the heights `z` that each takes away, 0 with too few points on a side
    and -1 where there is no such line, and its place across.
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
