"""Rows in order of the cells of a fixed grid, so that what lies in a box is a few ranges of rows."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Box = tuple[float, float, float, float]


class CellOrder(NamedTuple):
    """The order that puts rows into cells."""

    order: NDArray[np.int64]  # (k,): rows by ascending cell (j, then i), those of a cell in their old order
    cell: NDArray[np.int64]  # (c, 2): cells (i, j) that have rows
    start: NDArray[np.int64]  # (c + 1,): the rows of cell k are order[start[k]:start[k + 1]]


def order_by_cell(xy: NDArray[np.float64], size: float, *, among: NDArray[np.bool_] | None = None) -> CellOrder:
    """Order points in plan by the cells of the grid with the corners at multiples of a size.

    Parameters
    ----------
    xy : float64, (n, 2) or (n, 3)
        Finite coordinates (m).
    size : float
        Side of a cell (m).
    among : bool, (n,), optional
        Rows to order; all by default.

    Raises
    ------
    ValueError
        If the size is not positive.

    Examples
    --------
    >>> found = order_by_cell(np.array([[70.0, 5.0], [5.0, 70.0], [-1.0, 5.0], [71.0, 5.0]]), 64.0)
    >>> found.cell.tolist(), found.start.tolist(), found.order.tolist()
    ([[-1, 0], [1, 0], [0, 1]], [0, 1, 3, 4], [2, 0, 3, 1])
    """
    if not size > 0:
        raise ValueError(f"size of cells {size} m must be positive")
    rows = np.arange(len(xy)) if among is None else np.flatnonzero(among)
    if not len(rows):
        return CellOrder(rows, np.empty((0, 2), np.int64), np.zeros(1, np.int64))
    i, j = (np.floor(values[rows] / size).astype(np.int64) for values in (xy[:, 0], xy[:, 1]))
    first, low = i.min(), j.min()
    width = i.max() - first + 1
    key = (j - low) * width + i - first
    # numpy sorts keys of 16 bits in one pass; wider ones take ten times as long
    order = np.argsort(key.astype(np.min_scalar_type(key.max())), kind="stable")
    key = key[order]
    start = np.flatnonzero(np.diff(key, prepend=-1))
    key = key[start]
    cell = np.column_stack([key % width + first, key // width + low])
    return CellOrder(rows[order], cell, np.append(start, len(rows)))


def select_cells(
    cell: NDArray[np.int64], start: NDArray[np.int64], box: Box, *, size: float
) -> list[tuple[int, int]]:
    """Give the ranges of rows whose cells, as of `CellOrder` and of side `size` (m), meet a box, borders included.

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


def meets_box(boxes: NDArray[np.float64], box: Box) -> NDArray[np.bool_]:
    """Whether boxes, (n, 4), have a place in common with a box; the borders belong to it."""
    xmin, ymin, xmax, ymax = boxes.T
    meets: NDArray[np.bool_] = (xmin <= box[2]) & (xmax >= box[0]) & (ymin <= box[3]) & (ymax >= box[1])
    return meets


def boxes_of_cells(boxes: NDArray[np.float64], start: NDArray[np.int64]) -> NDArray[np.float64]:
    """Box around the boxes of the rows of each cell, (n, 4) to (c, 4)."""
    if len(start) < 2:
        return boxes
    low, high = (ufunc.reduceat(boxes, start[:-1]) for ufunc in (np.minimum, np.maximum))
    return np.hstack((low[:, :2], high[:, 2:]))


def ranges_near(cell_box: NDArray[np.float64], start: NDArray[np.int64], box: Box) -> list[tuple[int, int]]:
    """Give the ranges of rows of the cells whose boxes, as of `boxes_of_cells`, meet a box.

    Examples
    --------
    >>> cell_box = np.array([[0.0, 0, 1010, 900], [1005, 0, 2000, 900], [3000, 0, 3100, 50]])
    >>> ranges_near(cell_box, np.array([0, 4, 5, 9]), (1006.0, 10.0, 1007.0, 20.0))
    [(0, 5)]
    """
    return row_ranges(meets_box(cell_box, box), start)


def row_ranges(wanted: NDArray[np.bool_], start: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Give the rows of the wanted cells, bool (c,), as ranges, merged where one follows another."""
    change = np.flatnonzero(np.diff(wanted.astype(np.int8), prepend=0, append=0))
    rows = start[change].reshape(-1, 2)
    return [(int(first), int(stop)) for first, stop in rows if stop > first]
