"""`python -m tests.benchmarks.simulate_blocks FOOTPRINTS COUNTRY TILES`: a country by `citystitch generalise`.

The footprints of a few square kilometres, a whole number of tiles to each side, are generalised for real, and what
each tile tells the driver is kept. A country of such tiles then goes through what the driver itself does: ids of
all buildings, blocks, cells across tiles, objects of LoD0A, and the lists that tiles get, on disk. It prints the
seconds of the driver and of tasks, and the private memory of the driver.
"""

import argparse
import copy
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import shapely

from tests.benchmarks.countries import COUNTRIES, outline
from tests.benchmarks.simulate import memory
from tiler.convert.features import unique_name
from tiler.generalisation import generalise as whole
from tiler.generalisation.options import Asked, Inputs
from tiler.generalisation.shards import Shards, Tile
from tiler.generalisation.summary import Told
from tiler.generalisation.tile_cells import Work
from tiler.generalisation.tile_levels import CellRecord

Recorded = dict[tuple[str, Tile], Any]


def record(footprints: Path, folder: Path) -> tuple[Recorded, list[Tile], float]:
    """Generalise some tiles for real; gives what each step told of each, the tiles, and the seconds of all."""
    found: Recorded = {}
    seconds = [0.0]

    def keep(step: Callable[[Work], Any], works: Iterator[Work], _: int) -> Iterator[Any]:
        for work in works:
            begin = time.process_time()
            found[step.__name__, work.tile] = step(work)
            seconds[0] += time.process_time() - begin
            yield found[step.__name__, work.tile]

    with patch.object(whole, "map_in_order", keep):
        whole.generalise(Inputs(footprints=footprints), folder / "blocks.gpkg", Asked(), overwrite=True)
    tiles = sorted(tile for name, tile in found if name == "sort_buildings")
    return found, tiles, seconds[0]


class Country(Shards):
    """Shards of a country whose tiles all have buildings, and nothing that stands for itself."""

    def tiles(self, kind: str) -> list[Tile]:
        """List the tiles with buildings."""
        return [(i, j) for i, j in json.loads((self.folder / "tiles.json").read_text())]

    def read(self, kind: str, tile: Tile) -> list[Any]:
        """Give the values of a tile."""
        return [np.empty(0, object)] if kind == "standing" else super().read(kind, tile)


def simulate(recorded: Recorded, sample: Sequence[Tile], tiles: list[Tile], folder: Path) -> dict[str, float]:
    """Take a country through the driver's part; gives seconds, and memory (MB) beyond what the process had."""
    low, high = np.min(sample, axis=0), np.max(sample, axis=0)
    span = high - low + 1
    before, peak = memory(), memory()

    def of(tile: Tile) -> Tile:
        i, j = (low + (np.array(tile) - low) % span).tolist()
        return i, j

    def each(step: Callable[[Work], Any], some: Sequence[Tile], /) -> Iterator[Any]:
        nonlocal peak
        for tile in some:
            if step.__name__ == "make_cells":
                number = shards.read("cells", tile)[0].number
                names = np.array([f"C{value:013x}" for value in number.tolist()], object)
                yield CellRecord(number, names, number % 8 == 0)
            elif step.__name__ == "pair_buildings":
                shift = np.array(tile) - of(tile)
                pairs = recorded[step.__name__, of(tile)]
                near = [((one[0] + shift[0], one[1] + shift[1]), rows) for one, rows in pairs]
                yield [(one, rows) for one, rows in near if one in known]
            else:
                yield copy.deepcopy(recorded.get((step.__name__, of(tile))))  # no tile's is that of another
        peak = max(peak, memory())

    shards = Country(folder, Asked().tile_size)
    (folder / "tiles.json").write_text(json.dumps(tiles))
    known = set(tiles)
    n = sum(recorded["sort_buildings", of(tile)][0] for tile in tiles)
    begin = time.process_time()
    seen: set[int] = set()
    for k in range(n):
        unique_name(f"NL.IMBAG.Pand.{k:016d}", seen)
    peak = max(peak, memory())
    del seen
    work = Work(shards, (0, 0), Asked(), axis=True, rim=shapely.to_wkb(shapely.Point()))
    cells = whole._make_cells(tiles, work, each, Told())
    peak = max(peak, memory())
    whole._make_levels(cells, work, each)
    peak = max(peak, memory())
    return {
        "tiles": len(tiles),
        "buildings": n,
        "cells": len(cells.area),
        "driver_seconds": round(time.process_time() - begin, 1),
        "driver_memory_MB": round(peak - before, 1),
        "bytes_a_building": round((peak - before) * 1e6 / n, 1),
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
        recorded, sample, seconds = record(given.footprints, folder)
        shape = outline(replace(COUNTRIES[given.country], tile_size=1000.0), given.tiles)
        west, south, east, north = (int(value // 1000) for value in shape.bounds)
        i, j = (part.ravel() for part in np.meshgrid(np.arange(west, east + 1), np.arange(south, north + 1)))
        inside = shapely.contains_xy(shape, 1000.0 * i + 500, 1000.0 * j + 500)
        tiles = sorted(zip(i[inside].tolist(), j[inside].tolist(), strict=True))
        told = simulate(recorded, sample, tiles, folder)
        told["task_hours"] = round(seconds / len(sample) * len(tiles) / 3600, 2)
        told["largest_disk_MB"] = round(sum(path.stat().st_size for path in folder.rglob("*.pkl")) / 1e6)
        print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
