"""A town whose attributes name its roofs, and whose points do not: it gets these roofs back, in any tiles."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pytest
import shapely

from pipeline.data.classes import BUILDING
from tests.runs.test_run import hashes
from tiler.check.check import check_run
from tiler.config.config import make_config
from tiler.interface.synth import write_city
from tiler.store.results import StoredTerrain
from tiler.workflow.run import run

TAGS = {"shed": "skillion", "gable": "gabled", "hip": "hipped", "pyramid": "pyramidal"}
OFF = 0.25  # degrees; corners on the grid of the city model


def write_town(folder: Path) -> dict[str, Any]:
    """Write a city without its points on roofs."""
    files = write_city(folder, size=220, buildings=40, density=1.0, relief=4, seed=3, roofs="mixed")
    for path in files.clouds:
        las = laspy.read(path)
        las.points = las.points[np.asarray(las.classification) != BUILDING]
        las.write(str(path))
    return {
        "pointcloud": [str(folder / "tiles")],
        "footprints": str(files.footprints),
        "height_attribute": "height",
        "roofs": "skeleton",
        "mesh_size": 6.0,
        "tile_size": 120.0,
        "domain_height": 60.0,
    }


def read_roofs(out: Path) -> dict[str, list[dict[str, Any]]]:
    """Attributes of the parts of each house of the city model."""
    found = defaultdict(list)
    for name, item in json.loads((out / "citymodel.city.json").read_text())["CityObjects"].items():
        if "roof_slope" in item.get("attributes", {}):
            found[item.get("parents", [name])[0]].append(item["attributes"])
    return dict(found)


def slopes(roofs: dict[str, list[dict[str, Any]]]) -> dict[str, list[tuple[float, Any]]]:
    return {
        house: sorted((part["roof_slope"], part["roof_azimuth"] or 0.0) for part in parts)
        for house, parts in roofs.items()
    }


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path, dict[str, Any]]:
    """Configuration, folder of the results, and record."""
    folder = tmp_path_factory.mktemp("forms")
    values, out = write_town(folder / "city"), folder / "out"
    return values, out, run(make_config(values | {"out": str(out)}))


def test_a_town_without_points_on_roofs_gets_back_the_roofs_that_its_attributes_name(
    town: tuple[dict[str, Any], Path, dict[str, Any]],
) -> None:
    values, out, record = town
    assert record["counts"]["tiles"] == 4
    assert record["counts"]["roofs of a given form"] == 40
    assert check_run(out, StoredTerrain).ok
    roofs = read_roofs(out)
    truth = json.loads((Path(values["footprints"]).parent / "truth.json").read_text())["buildings"]
    _, _, blobs, _ = pyogrio.raw.read(values["footprints"])
    outlines = shapely.from_wkb(blobs)
    apart = np.bincount(shapely.STRtree(outlines).query(outlines, predicate="dwithin", distance=1.0)[0]) == 1
    compared = 0
    for house, alone in zip(truth, apart.tolist(), strict=True):
        parts = next(parts for name, parts in roofs.items() if name.endswith(house["id"]))
        assert {part["roof_method"] for part in parts} == {"flat" if house["type"] == "flat" else "skeleton"}
        if house["type"] == "mansard":  # its slope changes elsewhere
            assert {part["roof_form"] for part in parts} <= {"mansard", "gambrel"}
            continue
        assert {part["roof_form"] for part in parts} == {TAGS.get(house["type"], house["type"])}
        if len(house["wings"]) == 1 and alone:
            planes = np.array(house["wings"][0]["planes"])
            expected = np.unique(np.degrees(np.arctan(np.hypot(planes[:, 0], planes[:, 1]))).round(6))
            made = np.unique([part["roof_slope"] for part in parts])
            assert len(parts) == len(planes)
            assert np.abs(made[:, np.newaxis] - expected).min(axis=1).max() < OFF
            assert np.abs(made[:, np.newaxis] - expected).min(axis=0).max() < OFF
            compared += 1
    assert compared > 15


def test_roofs_are_the_same_in_one_tile(town: tuple[dict[str, Any], Path, dict[str, Any]], tmp_path: Path) -> None:
    values, out, _ = town
    run(make_config(values | {"out": str(tmp_path), "tile_size": 500.0}))
    assert slopes(read_roofs(tmp_path)) == slopes(read_roofs(out))


def test_an_attribute_that_changes_is_built(
    town: tuple[dict[str, Any], Path, dict[str, Any]], tmp_path: Path
) -> None:
    """The last test of the folder: it is used on."""
    values, out, _ = town
    path = Path(values["footprints"])
    meta, _, wkb, columns = pyogrio.raw.read(path)
    fields = dict(zip(meta["fields"].tolist(), columns, strict=True))
    k = int(np.flatnonzero(fields["roof:shape"] == "gabled")[0])
    fields["roof:shape"][k] = "hipped"
    path.unlink()
    pyogrio.raw.write(path, wkb, list(fields.values()), list(fields), geometry_type="Polygon", crs=meta["crs"])
    record = run(make_config(values | {"out": str(out)}))
    ran = record["ran"]
    assert ran["houses"] == ran["model"] == 1
    assert "ground" not in ran
    assert len(read_roofs(out)[f"{fields['id'][k]}"]) == 4
    run(make_config(values | {"out": str(tmp_path)}))
    assert hashes(out) == hashes(tmp_path)
