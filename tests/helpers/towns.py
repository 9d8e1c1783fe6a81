"""Small synthetic cities, meshed in tiles: a finished run to damage, to stop and to go on with."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tiler.config.config import Config, make_config
from tiler.interface.synth import write_city
from tiler.workflow.run import run

SIZE, TILE = 280.0, 140.0  # m: 4 tiles


@dataclass(frozen=True)
class Town:
    """A synthetic city as files, and the folder of its finished run."""

    folder: Path
    out: Path

    def config(self, out: Path, **others: Any) -> Config:
        values = {"pointcloud": [str(self.folder / "tiles")], "footprints": str(self.folder / "footprints.gpkg")}
        return make_config(values | {"out": str(out), "tile_size": TILE, "domain_height": 70.0} | others)

    def copy(self, out: Path) -> Path:
        shutil.copytree(self.out, out)
        return out


def make_town(folder: Path) -> Town:
    """Write a city and run it."""
    write_city(folder / "city", size=SIZE, buildings=16, density=0.5, relief=5, seed=3)
    town = Town(folder / "city", folder / "out")
    assert run(town.config(town.out))["counts"]["tiles"] == 4
    return town
