"""Cells of the quadtree: squares of longitude and latitude, whose smallest are the same ones whatever the region.

Cell ``(level, x, y)`` counts from the south-western corner of the root; level 0 is the root. What belongs to the
smallest waits on the disk, as it comes tile by tile, until the cell is made.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

STEP = 180 / 2**16  # degrees of latitude of the smallest cells: 305 m
SLACK = 1e-6  # degrees around a region: its sides are curves on the globe
MOST_LEVELS = 18
HELD_BYTES = 64 * 2**20  # that wait in memory, of all cells together

Ints = NDArray[np.int64]
Cell = tuple[int, int, int]


@dataclass(frozen=True)
class CellGrid:
    """The quadtree over a region."""

    #: column and row of the root's south-western smallest cell, from longitude and latitude 0 on
    west: int
    south: int
    #: width of a cell in `STEP`: 1 at the equator, 2 from 45 degrees on, so that cells are nearly square
    width: int
    depth: int  #: level of the smallest cells

    @property
    def side(self) -> float:
        """Side of the smallest cells from south to north (m), nearly."""
        return math.radians(STEP) * 6_371_000

    def leaves_of(self, lon: NDArray[np.float64], lat: NDArray[np.float64]) -> Ints:
        """Give the smallest cells, as `code` has them, in which places (degrees) lie, (n,) to (n,)."""
        x, y = self.columns_and_rows(lon, lat)
        return encode(x, y)

    def columns_and_rows(self, lon: NDArray[np.float64], lat: NDArray[np.float64]) -> tuple[Ints, Ints]:
        """Give columns and rows (n,) of the smallest cells in which places (degrees) lie, or that are nearest."""
        last = 2**self.depth - 1
        x = np.floor(lon / (self.width * STEP)).astype(np.int64) - self.west
        y = np.floor(lat / STEP).astype(np.int64) - self.south
        return x.clip(0, last), y.clip(0, last)

    def box(self, cell: Cell) -> tuple[float, float, float, float]:
        """Give west, south, east and north side of a cell (degrees)."""
        level, x, y = cell
        n = 2 ** (self.depth - level)
        a, b = self.west + x * n, self.south + y * n
        return a * self.width * STEP, b * STEP, (a + n) * self.width * STEP, (b + n) * STEP


def make_grid(box: Sequence[float]) -> CellGrid:
    """Lay the smallest quadtree over a box (degrees)."""
    west, south, east, north = (side + (-SLACK, SLACK)[k > 1] for k, side in enumerate(box))
    width = 2 ** max(0, round(-math.log2(math.cos(math.radians((south + north) / 2)))))
    a, b = math.floor(west / (width * STEP)), math.floor(south / STEP)
    n = max(math.floor(east / (width * STEP)) - a, math.floor(north / STEP) - b) + 1
    return CellGrid(a, b, width, (n - 1).bit_length())


def encode(x: Ints, y: Ints) -> Ints:
    """Interleave the bits of columns and rows (n,): Morton's order, x lowest.

    Examples
    --------
    >>> encode(np.array([0, 1, 0, 1, 2]), np.array([0, 0, 1, 1, 0])).tolist()
    [0, 1, 2, 3, 4]
    """
    code = np.zeros_like(x)
    for bit in range(MOST_LEVELS):
        code |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    return code


def decode(code: int) -> tuple[int, int]:
    """Give column and row of a code.

    Examples
    --------
    >>> decode(6), decode(9)
    ((2, 1), (1, 2))
    """
    x = sum((code >> (2 * bit) & 1) << bit for bit in range(MOST_LEVELS))
    y = sum((code >> (2 * bit + 1) & 1) << bit for bit in range(MOST_LEVELS))
    return x, y


class CellBuffers:
    """Bytes by cell in files of a folder: appended in any number of parts, read back whole.

    Parameters
    ----------
    folder : Path
        A folder that exists; its files are those of this buffers alone.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._waiting: dict[int, list[bytes]] = {}
        self._held = 0
        self.cells: set[int] = set()

    def add(self, cell: int, data: bytes) -> None:
        """Append to what a cell has."""
        self._waiting.setdefault(cell, []).append(data)
        self._held += len(data)
        if self._held > HELD_BYTES:
            self.flush()

    def add_rows(self, cells: NDArray[np.int64], rows: NDArray[np.float64]) -> None:
        """Append each row (n, k) to its cell (n,)."""
        if not len(cells):
            return
        order = np.argsort(cells, kind="stable")
        found, first = np.unique(cells[order], return_index=True)
        for cell, own in zip(found.tolist(), np.split(rows[order], first[1:]), strict=True):
            self.add(cell, own.tobytes())

    def flush(self) -> None:
        """Write all that waits."""
        for cell, parts in self._waiting.items():
            with (self._folder / str(cell)).open("ab") as file:
                file.writelines(parts)
        self.cells |= self._waiting.keys()
        self._waiting.clear()
        self._held = 0

    def read(self, cell: int) -> bytes:
        """Give what a cell has; nothing if it was never added to."""
        return (self._folder / str(cell)).read_bytes() if cell in self.cells else b""
