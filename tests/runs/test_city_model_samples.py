"""Published city models in three tilings: one city, whatever the tiles, and proved."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tiler.check.check import check_run
from tiler.config.config import make_config
from tiler.store.results import StoredTerrain
from tiler.workflow.run import run

# Mesh size, and sides of tiles (m): one tile, and two ways to cut the sample in several.
SAMPLES = {
    "3dbag/tile_901_trimmed.jsonl": (6.0, 1000.0, 97.0, 85.0),
    "berlin/Block020023.gml": (4.0, 1000.0, 75.0, 60.0),
    "vienna/Johannesgasse.gml": (3.5, 1000.0, 57.0, 50.0),
}


def city_of(out: Path) -> dict[str, Any]:
    """Attributes and outlines of all parts, by id."""
    document = json.loads((out / "citymodel.city.json").read_text())
    scale, translate = (np.array(document["transform"][key]) for key in ("scale", "translate"))
    corners = np.round(np.array(document["vertices"]) * scale + translate, 3).tolist()
    found = {}
    for name, thing in document["CityObjects"].items():
        rings = [
            [corners[v] for v in ring]
            for item in thing.get("geometry", ())
            if item["lod"] == "0"
            for face in item["boundaries"]
            for ring in face
        ]
        told = {key: value for key, value in thing.get("attributes", {}).items() if key != "number"}
        found[name] = thing["type"], thing.get("parents"), told, rings
    return found


@pytest.mark.long
@pytest.mark.parametrize("name", SAMPLES)
def test_three_tilings_give_one_city(shared_data: Path, tmp_path: Path, name: str) -> None:
    size, *sides = SAMPLES[name]
    given = {"buildings": [str(shared_data / "city_models" / name)], "mesh_size": size}
    cities, tiles = [], []
    for side in sides:
        out = tmp_path / f"{side:g}"
        record = run(make_config(given | {"tile_size": side, "out": str(out)}))
        tiles.append(record["counts"]["tiles"])
        report = check_run(out, StoredTerrain)
        assert report.ok, report.lines()
        cities.append(city_of(out))
    assert tiles[0] == 1
    assert min(tiles[1:]) > 1
    assert len(cities[0]) > 1
    assert cities[0] == cities[1] == cities[2]
