"""Lines through a house, where its roof points fall best into two heights (for `house_levels`)."""

from dataclasses import dataclass

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
    n, total = len(z), float(z @ z)
    ranked: list[tuple[float, Line]] = []
    for along in _directions(a, b) if total > 0 else ():
        normal = np.array([-along[1], along[0]])
        across = xyz[:, :2] @ normal
        order = np.argsort(across, kind="stable")
        across = across[order]
        left = np.arange(min_points, n - min_points + 1)  # points before the line
        gain = np.zeros(n + 1)
        gain[left] = np.cumsum(z[order])[left - 1] ** 2 * n / (left * (n - left)) / total
        vertex = np.sort(a @ normal)
        for offset, place in (
            (vertex, np.searchsorted(across, vertex)),
            _between(across, vertex, clearance),
        ):
            if len(offset):
                best = int(np.argmax(gain[place]))
                ranked.append((float(gain[place[best]]), Line(along, normal, float(offset[best]))))
    ranked = [entry for entry in ranked if entry[0] >= MIN_GAIN]
    ranked.sort(key=lambda entry: -entry[0])
    return [line for _, line in ranked[:MAX_TRIES]]


def _directions(a: Array, b: Array) -> Array:
    """Unit vectors of the directions with most wall, each that of its longest wall."""
    d = b - a
    length = np.hypot(d[:, 0], d[:, 1])
    d = d / length[:, None]
    left = np.argsort(-length, kind="stable")
    found, total = [], []
    while len(left):
        along = d[left[0]]
        same = np.abs(d[left, 0] * along[1] - d[left, 1] * along[0]) <= SAME_DIRECTION
        found.append(along)
        total.append(length[left[same]].sum())
        left = left[~same]
    order = np.argsort(-np.array(total), kind="stable")[:MAX_DIRECTIONS]
    return np.array(found)[order]


def _between(across: Array, vertex: Array, clearance: float) -> tuple[Array, NDArray[np.int64]]:
    """Offsets midway between two points and clear of all vertices, and the number of points before them."""
    middle = (across[1:] + across[:-1]) / 2
    after = np.searchsorted(vertex, middle)
    low = vertex[np.maximum(after - 1, 0)]
    high = vertex[np.minimum(after, len(vertex) - 1)]
    clear = np.minimum(np.abs(middle - low), np.abs(high - middle)) >= clearance
    clear &= across[1:] > across[:-1]
    return middle[clear], np.flatnonzero(clear) + 1
