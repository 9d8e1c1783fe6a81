"""Rows of a long array that belong to a piece, in as few blocks as there are."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray


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
