"""Small synthetic cities, meshed in tiles: a finished run to damage, to stop and to go on with."""

import json
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tiler.config.config import Config, make_config
from tiler.interface.synth import write_city
from tiler.workflow.run import run

SIZE, TILE = 280.0, 140.0  # m: 4 tiles


@dataclass(frozen=True)
class Town:
    """A synthetic city as files, the folder of its finished run, and its record."""

    folder: Path
    out: Path
    record: dict[str, Any] = field(default_factory=dict)

    def config(self, out: Path, **others: Any) -> Config:
        values = {"pointcloud": [str(self.folder / "tiles")], "footprints": str(self.folder / "footprints.gpkg")}
        return make_config(values | {"out": str(out), "tile_size": TILE, "domain_height": 70.0} | others)

    def copy(self, out: Path) -> Path:
        shutil.copytree(self.out, out)
        return out

    def unfinished(self, out: Path) -> Path:
        """Copy the run as if it had ended just before its last line."""
        record = json.loads((self.copy(out) / "run.json").read_text())
        (out / "run.json").write_text(json.dumps(record | {"status": "running"}))
        return out


def make_town(folder: Path, *, size: float = SIZE, buildings: int = 16) -> Town:
    """Write a city and run it."""
    write_city(folder / "city", size=size, buildings=buildings, density=0.5, relief=5, seed=3)
    town = Town(folder / "city", folder / "out")
    record = run(town.config(town.out))
    assert record["counts"]["tiles"] == (size / TILE) ** 2
    assert (record["exit_code"], record["reused"]) == (0, {})
    return replace(town, record=record)
