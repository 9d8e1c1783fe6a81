"""What an edit takes in the service: `python -m tests.benchmarks.edits OUT [N]`.

In a copy of hard links beside OUT, N houses are moved, each of four twice. A line an edit has seconds of the clock
and of the processor, for the mesh and for the 3D Tiles, and the load of the machine. As in the service, the
collector of garbage passes over what was there before.
"""

import gc
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
from shapely import affinity

from pipeline.data.errors import CityError
from tests.tiler.editing.test_edit import read_input, write
from tiler.editing.edit import City, edit_together, held_city
from tiler.editing.requests import Asked
from tiler.editing.staging import link_folder
from tiler.editing.uploads import Upload, read_upload
from tiler.mesh_files.run_files import find_files
from tiler.store.remembered import remembering
from tiler.tiles3d.update import MERGING_LEVEL, update_tileset

PLACES = ((310, 240), (-420, 130), (-350, -660), (870, -450))  # of houses, from the middle of the city (m)
Found = TypeVar("Found")


def clock(work: Callable[[], Found]) -> tuple[Found, str]:
    """Do something; give what it gives, and the seconds that it took."""
    wall, used = time.perf_counter(), time.process_time()
    found = work()
    return found, f"{time.perf_counter() - wall:.2f} s ({time.process_time() - used:.2f} of the processor)"


def replace(city: City, name: str, path: Path) -> int:
    """Replace a building as the service does; gives the number of tasks that ran."""
    found = read_upload(Upload(path), city.config, crs=city.crs, bounds=city.bounds)
    (done,) = edit_together(city, [Asked("replace", name, found)], city_files=False)
    if isinstance(done, CityError):
        raise done
    n: int = done.record["tasks"]["ran"]
    return n


def measure(out: Path, n: int, folder: Path) -> None:
    """Edit a copy of the city, and print what each edit took."""
    link_folder(out, copy := folder / "city")
    shapes = read_input(out)
    middle = np.array([shape.centroid.coords[0] for shape in shapes.values()])
    away = [np.hypot(*(middle - middle.mean(axis=0) - place).T) for place in PLACES]
    near = [list(shapes)[int(far.argmin())] for far in away]

    def write_tiles() -> int:
        return update_tileset(folder / "view", find_files(copy), merging_level=MERGING_LEVEL)

    print("all {} cells: {}".format(*clock(write_tiles)), flush=True)
    with remembering(), held_city(copy) as city:
        gc.freeze()
        for k in range(n):
            name = near[k // 2 % len(near)]
            moved = affinity.translate(shapes[name], 1 + 0.5 * (k % 2), 0.7)
            path = write(folder / f"{k}.gpkg", moved, ids=[name], crs=city.crs)
            ran, mesh = clock(partial(replace, city, name, path))
            cells, tiles = clock(write_tiles)
            load = os.getloadavg()[0]
            print(f"{name}: {ran} tasks {mesh}; {cells} cells {tiles}; load {load:.1f}", flush=True)


if __name__ == "__main__":
    given = Path(sys.argv[1]).absolute()
    with TemporaryDirectory(prefix=".edits-", dir=given.parent) as made:
        measure(given, int(sys.argv[2]) if len(sys.argv) > 2 else 8, Path(made))
