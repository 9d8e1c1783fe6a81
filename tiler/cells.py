"""Rows in order of the cells of a fixed grid, so that what lies in a box is a few ranges of rows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Box = tuple[float, float, float, float]

_FEW = 1 << 16  # keys below this sort by radix


@dataclass(frozen=True, eq=False)
class CellOrder:
    """The order that puts rows into cells.

    Attributes
    ----------
    order : int64, (n,)
        Rows by ascending cell, row-major (j, then i); the rows of a cell in their old order.
    cell : int64, (c, 2)
        Cells (i, j) that have rows, in that order.
    start : int64, (c + 1,)
        The rows of cell k are ``order[start[k]:start[k + 1]]``.
    """

    order: NDArray[np.int64]
    cell: NDArray[np.int64]
    start: NDArray[np.int64]


def order_by_cell(xy: NDArray[np.float64], size: float) -> CellOrder:
    """Order places by the cells of the grid with the corners at multiples of a size.

    Parameters
    ----------
    xy : float64, (n, 2)
        Finite coordinates (m).
    size : float
        Side of a cell (m).

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
    fewer than 65536 cells are spanned, else O(n log n).

    Examples
    --------
    >>> found = order_by_cell(np.array([[70.0, 5.0], [5.0, 70.0], [-1.0, 5.0], [71.0, 5.0]]), 64.0)
    >>> found.cell.tolist(), found.start.tolist(), found.order.tolist()
    ([[-1, 0], [1, 0], [0, 1]], [0, 1, 3, 4], [2, 0, 3, 1])
    """
    if not size > 0:
        raise ValueError(f"size of cells {size} m must be positive")
    if len(xy) == 0:
        return CellOrder(np.empty(0, np.int64), np.empty((0, 2), np.int64), np.zeros(1, np.int64))
    i, j = (np.floor(column / size).astype(np.int64) for column in xy.T)
    first, width = i.min(), int(i.max() - i.min()) + 1
    low = j.min()
    key = (j - low) * width + (i - first)
    if key.max() < _FEW:
        key = key.astype(np.uint16)
    order = np.argsort(key, kind="stable")
    key = key[order].astype(np.int64)
    begin = np.flatnonzero(np.diff(key, prepend=-1))
    cell = np.column_stack((key[begin] % width + first, key[begin] // width + low))
    return CellOrder(order, cell, np.append(begin, len(xy)))


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
