"""What writers ask of a mesh: its pieces, one at a time, dealt out to processes, and rows of long arrays."""

from collections.abc import Iterator
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from tiler.mesh_files.mesh_pieces import MeshPiece

ROWS = 1 << 16  # rows that are made at once


class Pieces(Protocol):
    """A mesh in pieces, as `tiler.mesh_files.mesh_pieces.MeshPieces` has them of a run."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pieces, in their order."""

    @property
    def n_points(self) -> int:
        """Number of different points of the whole mesh."""

    def read(self, k: int) -> MeshPiece:
        """Read piece `k`."""


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


def split_pieces(centre: NDArray[np.float64], weight: NDArray[np.int64], n_parts: int) -> NDArray[np.int64]:
    """Deal pieces out by recursive bisection across the longer side.

    Parameters
    ----------
    centre : float64, (k, 2)
        Middle of each piece (m).
    weight : int64, (k,)
        Its cells.
    n_parts : int
        Number of parts, at most `k`.

    Returns
    -------
    int64, (k,)
        Part of each piece; every part has one at least.

    Raises
    ------
    ValueError
        If there are fewer pieces than parts, or no part.

    Examples
    --------
    >>> split_pieces(np.array([[0.0, 0], [1, 0], [2, 0], [3, 0]]), np.array([1, 1, 1, 3]), 2)
    array([0, 0, 0, 1])
    """
    if not 1 <= n_parts <= len(weight):
        raise ValueError(f"{n_parts} parts of {len(weight)} pieces")
    part = np.empty(len(weight), np.int64)
    waiting = [(np.arange(len(weight)), 0, n_parts)]
    while waiting:
        rows, first, n = waiting.pop()
        if n == 1:
            part[rows] = first
            continue
        low = n // 2
        rows, cut = _bisect(rows, centre, weight, low, n - low)
        waiting += [(rows[:cut], first, low), (rows[cut:], first + low, n - low)]
    return part


def _bisect(
    rows: NDArray[np.int64], centre: NDArray[np.float64], weight: NDArray[np.int64], low: int, high: int
) -> tuple[NDArray[np.int64], int]:
    """Order pieces along the longer side, and find the cut that leaves `low` and `high` parts even."""
    axis = int(np.ptp(centre[rows], axis=0).argmax())
    rows = rows[np.lexsort((rows, centre[rows, 1 - axis], centre[rows, axis]))]
    total = np.cumsum(weight[rows])
    cuts = np.arange(low, len(rows) - high + 1)
    heaviest = np.maximum(total[cuts - 1] / low, (total[-1] - total[cuts - 1]) / high)
    return rows, int(cuts[heaviest.argmin()])


def write_lines(file: BinaryIO, line: str, rows: NDArray[Any]) -> None:
    """Write rows (n, k) as text, each by the format ``line`` of k numbers."""
    for some in slices(len(rows)):
        part = rows[some]
        file.write((line * len(part) % tuple(part.ravel().tolist())).encode())
