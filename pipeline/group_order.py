"""Values and points put in order within groups that lie one after the other (steps 1.5 and 2.0)."""

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def sort_values(start: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sort the values of each group, ``values[start[i]:start[i + 1]]``; none may be NaN.

    Examples
    --------
    >>> sort_values(np.array([0, 2, 2, 4]), np.array([3.0, 1.0, 2.0, 0.0]))
    array([1., 3., 0., 2.])
    """
    ordered = values.copy()
    for g in range(len(start) - 1):
        ordered[start[g] : start[g + 1]].sort()
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
    ordered = np.empty_like(xyz)
    for g in range(len(start) - 1):
        group = xyz[start[g] : start[g + 1]]
        rows = np.argsort(group[:, 2])
        i = 0
        while i < len(rows):
            j = _end_of_run(group[:, 2], rows, i)
            if j > i + 1:
                rows[i:j] = _sort_by_place(group, rows[i:j])
            i = j
        for k in range(len(rows)):
            ordered[start[g] + k] = group[rows[k]]
    return ordered


@numba.njit(cache=True, nogil=True)
def _sort_by_place(xyz: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Order rows by y, then x."""
    rows = rows[np.argsort(xyz[:, 1][rows])]
    i = 0
    while i < len(rows):
        j = _end_of_run(xyz[:, 1], rows, i)
        if j > i + 1:
            rows[i:j] = rows[i:j][np.argsort(xyz[:, 0][rows[i:j]])]
        i = j
    return rows


@numba.njit(cache=True, nogil=True)
def _end_of_run(values: NDArray[np.float64], rows: NDArray[np.int64], i: int) -> int:
    """First place after ``i`` at which the rows have another value."""
    j = i + 1
    while j < len(rows) and values[rows[j]] == values[rows[i]]:
        j += 1
    return j
