"""What writers ask of a mesh: its pieces, one at a time, and rows of long arrays."""

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

    @property
    def ground(self) -> tuple[str, ...]:
        """Names of the patches of the ground, by number; none without land cover."""

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


def write_lines(file: BinaryIO, line: str, rows: NDArray[Any]) -> None:
    """Write rows (n, k) as text, each by the format ``line`` of k numbers."""
    for some in slices(len(rows)):
        part = rows[some]
        file.write((line * len(part) % tuple(part.ravel().tolist())).encode())
