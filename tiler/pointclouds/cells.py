"""Rows in order of the cells of a fixed grid, so that what lies in a box is a few ranges of rows."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.kernel import kernel

Box = tuple[float, float, float, float]
Pair = tuple[float, float]

MOST_CELLS = 1 << 20  # that rows are counted in; 65 km square of those of points


@dataclass(frozen=True, eq=False)
class CellOrder:
    """The order that puts rows into cells.

    Attributes
    ----------
    order : int64, (k,)
        Rows by ascending cell, row-major (j, then i); the rows of a cell in their old order.
    cell : int64, (c, 2)
        Cells (i, j) that have rows, in that order.
    start : int64, (c + 1,)
        The rows of cell k are ``order[start[k]:start[k + 1]]``.
    """

    order: NDArray[np.int64]
    cell: NDArray[np.int64]
    start: NDArray[np.int64]


def order_by_cell(xy: NDArray[np.float64], size: float, *, among: NDArray[np.bool_] | None = None) -> CellOrder:
    """Order places by the cells of the grid with the corners at multiples of a size.

    Parameters
    ----------
    xy : float64, (n, 2) or (n, 3)
        Finite coordinates (m).
    size : float
        Side of a cell (m).
    among : bool, (n,), optional
        Rows to order; all by default.

    Returns
    -------
    CellOrder

    Raises
    ------
    ValueError
        If the size is not positive.

    Notes
    -----
    Cell (i, j) holds i = floor(x / size), j = floor(y / size): it depends on the place alone. O(n) where
    no more than `MOST_CELLS` are spanned, else O(n log n).

    Examples
    --------
    >>> found = order_by_cell(np.array([[70.0, 5.0], [5.0, 70.0], [-1.0, 5.0], [71.0, 5.0]]), 64.0)
    >>> found.cell.tolist(), found.start.tolist(), found.order.tolist()
    ([[-1, 0], [1, 0], [0, 1]], [0, 1, 3, 4], [2, 0, 3, 1])
    """
    if not size > 0:
        raise ValueError(f"size of cells {size} m must be positive")
    among = np.ones(len(xy), np.bool_) if among is None else among
    place, cell, start = find_places(xy[:, 0], xy[:, 1], (1.0, 1.0), (0.0, 0.0), among, float(size))
    rows = np.flatnonzero(place >= 0)
    order = np.empty(len(rows), np.int64)
    order[place[rows]] = rows
    return CellOrder(order, cell, start)


def find_places(
    x: NDArray[Any], y: NDArray[Any], scale: Pair, offset: Pair, among: NDArray[np.bool_], size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Find the places of coordinates in whole units, ``units * scale + offset`` (m), in order of their cells.

    Parameters
    ----------
    x, y : int32, (n,)
        Coordinates in units; numbers of another type are taken as they are.
    scale, offset : pair of float
        Size of a unit along both axes, and place of unit 0 (m).
    among : bool, (n,)
        Rows to order.
    size : float
        Side of a cell (m), positive.

    Returns
    -------
    place : int64, (n,)
        Place of each row in the order that `order_by_cell` gives of the same coordinates; -1 for other rows.
    cell, start : int64
        As in `CellOrder`.
    """
    place, n_cells, first, low, width = _number_cells(x, y, scale, offset, among, size)
    key, count = _put_in_order(place, n_cells) if n_cells <= MOST_CELLS else _sort_keys(place)
    cell = np.column_stack([key % width + first, key // width + low])
    return place, cell, np.concatenate([[0], np.cumsum(count)])


@kernel
def _number_cells(
    x: NDArray[Any], y: NDArray[Any], scale: Pair, offset: Pair, among: NDArray[np.bool_], size: float
) -> tuple[NDArray[np.int64], int, int, int, int]:
    """Number the cells around some rows; gives each row's, how many, the first (i, j), and how many in a line."""
    number = np.full(len(x), -1, np.int64)
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for k in range(len(x)):
        if among[k]:
            at_x, at_y = x[k] * scale[0] + offset[0], y[k] * scale[1] + offset[1]
            low_x, high_x = min(low_x, at_x), max(high_x, at_x)
            low_y, high_y = min(low_y, at_y), max(high_y, at_y)
    if low_x > high_x:
        return number, 0, 0, 0, 1
    first, low = int(np.floor(low_x / size)), int(np.floor(low_y / size))
    width = int(np.floor(high_x / size)) - first + 1
    for k in range(len(x)):
        if among[k]:
            at_x, at_y = x[k] * scale[0] + offset[0], y[k] * scale[1] + offset[1]
            number[k] = (int(np.floor(at_y / size)) - low) * width + int(np.floor(at_x / size)) - first
    return number, (int(np.floor(high_y / size)) - low + 1) * width, first, low, width


def select_cells(
    cell: NDArray[np.int64], start: NDArray[np.int64], box: Box, *, size: float
) -> list[tuple[int, int]]:
    """Give the ranges of rows whose cells meet a box.

    Parameters
    ----------
    cell : int64, (c, 2)
        Cells (i, j), as `CellOrder` has them.
    start : int64, (c + 1,)
        First row of each cell, and the number of rows.
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax (m); the borders belong to the box.
    size : float
        Side of a cell (m), the one that the cells were made with.

    Returns
    -------
    list of (row_start, row_stop)
        Ascending, apart from each other: every row in the box is in one of them, and others near it are too.

    Examples
    --------
    >>> cell, start = np.array([[0, 0], [1, 0], [3, 0], [0, 1]]), np.array([0, 5, 6, 8, 9])
    >>> select_cells(cell, start, (10.0, 10.0, 100.0, 64.0), size=64.0)
    [(0, 6), (8, 9)]
    """
    low, high = (np.floor(np.array(corner) / size) for corner in (box[:2], box[2:]))
    i, j = cell.T
    return row_ranges((i >= low[0]) & (i <= high[0]) & (j >= low[1]) & (j <= high[1]), start)


def row_ranges(wanted: NDArray[np.bool_], start: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Give the rows of the wanted cells as ranges, merged where one follows another.

    Parameters
    ----------
    wanted : bool, (c,)
        Which cells.
    start : int64, (c + 1,)
        First row of each cell, and the number of rows.

    Returns
    -------
    list of (row_start, row_stop)
    """
    change = np.flatnonzero(np.diff(wanted.astype(np.int8), prepend=0, append=0))
    rows = start[change].reshape(-1, 2)
    return [(int(first), int(stop)) for first, stop in rows if stop > first]


def _put_in_order(place: NDArray[np.int64], n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Turn keys below n into their places in ascending order, equal ones in their old order; -1 stays.

    Gives the keys that there are, and how many rows have each.
    """
    count = np.bincount(place[place >= 0], minlength=n)
    _take_places(place, np.cumsum(count) - count)
    key = np.flatnonzero(count)
    return key, count[key]


@kernel
def _take_places(place: NDArray[np.int64], free: NDArray[np.int64]) -> None:
    """Give each key its next free place."""
    for k in range(len(place)):
        key = place[k]
        if key >= 0:
            place[k] = free[key]
            free[key] += 1


def _sort_keys(place: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Do what `_put_in_order` does, for keys of any size."""
    rows = np.flatnonzero(place >= 0)
    rows = rows[np.argsort(place[rows], kind="stable")]
    key, count = np.unique(place[rows], return_counts=True)
    place[rows] = np.arange(len(rows))
    return key, count
