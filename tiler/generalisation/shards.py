"""What waits in a folder tile by tile, so that memory holds a tile and not the region."""

import pickle
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Geometry

Tile = tuple[int, int]


@dataclass(frozen=True)
class Shards:
    """A temporary folder of our own with files by kind and tile, and the side of a tile (m)."""

    folder: Path
    size: float

    def append(self, kind: str, tile: Tile, value: Any) -> None:
        """Put a value behind those of its tile."""
        path = self._path(kind, tile)
        path.parent.mkdir(exist_ok=True)
        with path.open("ab") as file:
            _Pickler(file, protocol=5).dump(value)

    def read(self, kind: str, tile: Tile) -> list[Any]:
        """Give the values of a tile in their order; none where there are none."""
        path = self._path(kind, tile)
        if not path.exists():
            return []
        found = []
        with path.open("rb") as file:
            while file.peek(1):
                found.append(pickle.load(file))
        return found

    def drop(self, kind: str, tile: Tile) -> None:
        """Delete the values of a tile, if there are any."""
        self._path(kind, tile).unlink(missing_ok=True)

    def tiles(self, kind: str) -> list[Tile]:
        """List the tiles that have values of a kind, in order."""
        paths = (self.folder / kind).glob("*.pkl")
        return sorted((int(i), int(j)) for i, j in (path.stem.split("_") for path in paths))

    def box(self, tile: Tile) -> tuple[float, float, float, float]:
        """Give xmin, ymin, xmax, ymax of a tile (m)."""
        i, j = tile
        return i * self.size, j * self.size, (i + 1) * self.size, (j + 1) * self.size

    def covered(self, box: Iterable[float]) -> Iterator[Tile]:
        """Give the tiles that a box touches."""
        yield from product(*self._ranges(box))

    def count(self, box: Iterable[float]) -> int:
        """Count the tiles that a box touches."""
        columns, rows = self._ranges(box)
        return len(columns) * len(rows)

    def _ranges(self, box: Iterable[float]) -> tuple[range, range]:
        low_x, low_y, high_x, high_y = (int(np.floor(value / self.size)) for value in box)
        return range(low_x, high_x + 1), range(low_y, high_y + 1)

    def _path(self, kind: str, tile: Tile) -> Path:
        return self.folder / kind / f"{tile[0]}_{tile[1]}.pkl"


class _Pickler(pickle.Pickler):
    """Writes arrays of geometries at once, not one by one."""

    def reducer_override(self, value: Any) -> Any:
        """Give WKB for an array of geometries, and leave all else."""
        if (
            isinstance(value, np.ndarray)
            and value.dtype == object
            and isinstance(next(iter(value), None), Geometry)
        ):
            return _read_geometries, (shapely.to_wkb(value).tolist(),)
        return NotImplemented


def _read_geometries(wkb: list[bytes]) -> NDArray[np.object_]:
    return np.asarray(shapely.from_wkb(wkb), np.object_)


class DiskSet:
    """Whole numbers in a temporary file, of which some megabytes are in memory."""

    def __init__(self) -> None:
        self.table = sqlite3.connect("", isolation_level=None)  # no name: on the disk, gone with the object
        self.table.execute("pragma journal_mode = off")
        self.table.execute("create table numbers (number integer primary key)")
        self.table.execute("begin")

    def __contains__(self, number: object) -> bool:
        """Whether a number was added."""
        return self.table.execute("select 1 from numbers where number = ?", (number,)).fetchone() is not None

    def add(self, number: int) -> None:
        """Add a number that is not there yet."""
        self.table.execute("insert into numbers values (?)", (number,))


@dataclass(frozen=True, eq=False)
class Numbers:
    """Numbers of things that lie in tiles, over the whole region: those of a tile follow each other."""

    tiles: NDArray[np.int64]  #: (t, 2): column and row of each tile, ascending
    start: NDArray[np.int64]  #: (t + 1,): first number of each tile, and the number of all

    @classmethod
    def count(cls, tiles: Sequence[Tile], counts: Iterable[int]) -> "Numbers":
        """Number so many things in each of some tiles, which ascend."""
        start = np.cumsum(np.fromiter((0, *counts), np.int64))
        return cls(np.array(tiles, np.int64).reshape(-1, 2), start)

    def first(self, tile: Tile) -> int:
        """Give the first number of a tile, -1 if the tile is not among them."""
        low, high = np.searchsorted(self.tiles[:, 0], (tile[0], tile[0] + 1)).tolist()
        row = low + int(np.searchsorted(self.tiles[low:high, 1], tile[1]))
        return int(self.start[row]) if row < high and self.tiles[row, 1] == tile[1] else -1

    def columns(self) -> Iterator[list[tuple[Tile, int, int]]]:
        """Give tile, first number and end of numbers of each tile, those of a column of tiles together."""
        rows = zip(map(tuple, self.tiles.tolist()), self.start[:-1].tolist(), self.start[1:].tolist(), strict=True)
        for _, column in groupby(rows, key=lambda row: row[0][0]):
            yield list(column)

    def places(self, numbers: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Give the tile (n, 2) of each number, and its place in it."""
        row = np.searchsorted(self.start, numbers, side="right") - 1
        return self.tiles[row], numbers - self.start[row]


def around(tile: Tile) -> list[Tile]:
    """List a tile and its eight neighbours, in order."""
    return [(tile[0] + i, tile[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def by_tile(tiles: NDArray[np.int64]) -> Iterator[tuple[Tile, NDArray[np.int64]]]:
    """Give the rows of each tile of int64 (n, 2), tiles in order."""
    order = np.lexsort((np.arange(len(tiles)), tiles[:, 1], tiles[:, 0]))
    sorted_tiles = tiles[order]
    starts = np.flatnonzero(np.diff(sorted_tiles, axis=0, prepend=sorted_tiles[:1] - 1).any(axis=1))
    for rows in np.split(order, starts[1:]) if len(starts) else []:
        yield (int(tiles[rows[0], 0]), int(tiles[rows[0], 1])), rows
