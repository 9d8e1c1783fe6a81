"""Runs of synthetic cities as `citystitch synth` makes them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tiler.config.config import make_config
from tiler.interface.synth import write_city
from tiler.workflow.run import run

SMALL = {"size": 300, "buildings": 15, "density": 1.0}


def city_files(folder: Path, **city: Any) -> dict[str, Any]:
    """Write a city; returns what a configuration says of it."""
    files = write_city(folder, **city)
    return {"pointcloud": [str(path) for path in files.clouds], "footprints": str(files.footprints)}


def run_city(folder: Path, city: Mapping[str, Any] = SMALL, **given: Any) -> Path:
    """Run a city in tiles of 150 m and a domain of 60 m if not told otherwise; returns the folder of the run."""
    tiles = {"tile_size": 150.0, "domain_height": 60.0, "out": str(folder / "out")}
    run(make_config(city_files(folder / "city", **city) | tiles | given))
    return folder / "out"
