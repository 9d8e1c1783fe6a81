"""Rows of long arrays: those that follow each other, and so many at a time."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

ROWS = 1 << 16  # rows that are made at once


def blocks_of(place: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Group rows by places that follow each other.

    Parameters
    ----------
    place : int64, (n,)
        Where each row belongs, each place once.

    Yields
    ------
    int
        The first place of a block.
    int64, (k,)
        The rows of the block, in the order of their places.

    Examples
    --------
    >>> [(start, rows.tolist()) for start, rows in blocks_of(np.array([7, 4, 5, 8]))]
    [(4, [1, 2]), (7, [0, 3])]
    """
    order = np.argsort(place)
    breaks = np.flatnonzero(np.diff(place[order]) != 1) + 1
    for rows in np.split(order, breaks):
        if len(rows):
            yield int(place[rows[0]]), rows


def slices(n: int) -> Iterator[slice]:
    """Cut n rows into slices of `ROWS`, and what is left.

    Examples
    --------
    >>> list(slices(70_000))
    [slice(0, 65536, None), slice(65536, 70000, None)]
    """
    for start in range(0, n, ROWS):
        yield slice(start, min(start + ROWS, n))
