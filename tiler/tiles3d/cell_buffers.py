"""Data of cells that wait on the disk, as they come tile by tile, until a cell is made."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HELD_BYTES = 64 * 2**20  # that wait in memory, of all cells together


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
