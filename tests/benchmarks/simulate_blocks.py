"""`python -m tests.benchmarks.simulate_blocks FOOTPRINTS COUNTRY TILES`: a country by `citystitch generalise`.

The footprints of a few square kilometres, a whole number of tiles to each side, are generalised for real, and what
each tile tells the driver is kept. A country of such tiles then goes through what the driver itself does: ids of
all buildings, blocks, cells across tiles, objects of LoD0A, and the lists that tiles get, on disk. It prints the
seconds of the driver and of tasks, and the private memory of the driver.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import shapely
from numpy.typing import NDArray

from tests.benchmarks.countries import COUNTRIES, outline
from tests.benchmarks.simulate import memory
from tiler.convert.features import unique_name
from tiler.generalisation import generalise as whole
from tiler.generalisation.options import Asked, Inputs
from tiler.generalisation.region_cells import read_rows
from tiler.generalisation.shards import DiskSet, Shards, Tile
from tiler.generalisation.summary import Told
from tiler.generalisation.tile_cells import Work, read_numbers

Recorded = Mapping[tuple[str, Tile], Any]


def record(footprints: Path, folder: Path) -> tuple[Shards, Recorded, float]:
    """Generalise some tiles for real; gives their files, what steps told the driver, and the seconds of all."""
    found: dict[tuple[str, Tile], Any] = {}
    seconds = [0.0]

    def keep(step: Callable[[Work], Any], works: Iterator[Work], _: int) -> Iterator[Any]:
        for work in works:
            if step.__name__ == "make_cells" and not (folder / "sample").exists():
                shutil.copytree(work.shards.folder, folder / "sample")
            begin = time.process_time()
            found[step.__name__, work.tile] = step(work)
            seconds[0] += time.process_time() - begin
            yield found[step.__name__, work.tile]

    with patch.object(whole, "map_in_order", keep):
        whole.generalise(Inputs(footprints=footprints), folder / "blocks.gpkg", Asked(), overwrite=True)
    return Shards(folder / "sample", Asked().tile_size), found, seconds[0]


class Country(Shards):
    """Shards of a country whose tiles are those of a sample, again and again; nothing stands for itself.

    What the steps of a tile wrote for the driver is that of a tile of the sample.
    """

    def __init__(self, folder: Path, sample: Shards, known: list[Tile]) -> None:
        super().__init__(folder, sample.size)
        tiles = np.array(sample.tiles("sides"))
        self.sample, self.known, self.peak = sample, known, memory()
        self.low, self.span = tiles.min(axis=0), np.ptp(tiles, axis=0) + 1

    def __setattr__(self, name: str, value: Any) -> None:
        """Set what this class has more than its base, which is frozen."""
        object.__setattr__(self, name, value)

    def append(self, kind: str, tile: Tile, value: Any) -> None:
        """Put a value behind those of its tile, and look at the memory."""
        super().append(kind, tile, value)
        self.peak = max(self.peak, memory())

    def of(self, tile: Tile) -> Tile:
        """Give the tile of the sample."""
        i, j = (self.low + (np.array(tile) - self.low) % self.span).tolist()
        return i, j

    def tiles(self, kind: str) -> list[Tile]:
        """List the tiles with values of a kind."""
        return self.known if kind == "dealt" else super().tiles(kind)

    def read(self, kind: str, tile: Tile) -> list[Any]:
        """Give the values of a tile."""
        if kind == "standing":
            return [np.empty(0, object)]
        return self.sample.read(kind, self.of(tile)) if kind in ("chains", "sides") else super().read(kind, tile)


def simulate(sample: Shards, counts: Recorded, tiles: list[Tile], folder: Path) -> dict[str, float]:
    """Take a country through the driver's part; gives seconds, and memory (MB) beyond what the process had."""
    folder.mkdir()
    shards = Country(folder, sample, tiles)
    work = Work(shards, (0, 0), Asked(), axis=True, rim=shapely.to_wkb(shapely.Point()))
    before, tasks = memory(), 0.0

    def pair(tile: Tile) -> NDArray[np.int64]:
        """Move the pairs of a tile of the sample, some of whose neighbours may be missing here."""
        here, there = (read_numbers(one, "buildings") for one in (shards, sample))
        old = counts["pair_buildings", shards.of(tile)]
        places, rows = there.places(old.ravel())
        shift = np.array(tile) - shards.of(tile)
        first = np.array([here.first((i, j)) for i, j in (places + shift).tolist()], np.int64)
        return (first + rows).reshape(-1, 2)[(first >= 0).reshape(-1, 2).all(axis=1)]

    def each(step: Callable[[Work], Any], some: Sequence[Tile], /) -> Iterator[Any]:
        nonlocal tasks
        for tile in some:
            begin = time.process_time()
            if step.__name__ == "make_cells":
                number = np.unique(read_rows(shards, 2, tile)[0])
                names = np.array([f"C{value:013x}" for value in number.tolist()], object)
                shards.append("use", tile, (names, number % 8 == 0))
                found = None
            elif step.__name__ == "pair_buildings":
                found = pair(tile)
            elif step.__name__ == "meet_tiles":
                found = step(replace(work, tile=tile))
            else:
                found = counts.get((step.__name__, shards.of(tile)))
            tasks += time.process_time() - begin
            yield found

    begin = time.process_time()
    seen, n = DiskSet(), sum(counts["sort_buildings", shards.of(tile)][0] for tile in tiles)
    for k in range(n):
        unique_name(f"NL.IMBAG.Pand.{k:016d}", seen)
    del seen
    numbers = whole._make_cells(tiles, work, each, Told())
    owners = whole._make_levels(numbers, work, each)
    cells = sum(len(shards.read("use", tile)[0][0]) for tile in owners)
    return {
        "tiles": len(tiles),
        "buildings": n,
        "cells": cells,
        "driver_seconds": round(time.process_time() - begin - tasks, 1),
        "driver_memory_MB": round(shards.peak - before, 1),
        "bytes_a_building": round((shards.peak - before) * 1e6 / n, 1),
    }


def main() -> None:
    """Record, simulate, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("footprints", type=Path)
    parser.add_argument("country", choices=tuple(COUNTRIES))
    parser.add_argument("tiles", type=int, help="number of square kilometres")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with ProcessPoolExecutor(1, get_context("spawn")) as other:  # whose memory does not count
            sample, counts, seconds = other.submit(record, given.footprints, folder).result()
        shape = outline(replace(COUNTRIES[given.country], tile_size=1000.0), given.tiles)
        west, south, east, north = (int(value // 1000) for value in shape.bounds)
        i, j = (part.ravel() for part in np.meshgrid(np.arange(west, east + 1), np.arange(south, north + 1)))
        inside = shapely.contains_xy(shape, 1000.0 * i + 500, 1000.0 * j + 500)
        tiles = sorted(zip(i[inside].tolist(), j[inside].tolist(), strict=True))
        told = simulate(sample, counts, tiles, folder / "country")
        told["task_hours"] = round(seconds / len(sample.tiles("sides")) * len(tiles) / 3600, 2)
        told["disk_MB"] = round(sum(path.stat().st_size for path in (folder / "country").rglob("*.pkl")) / 1e6)
        print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
