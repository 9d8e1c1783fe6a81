"""The city model for other programs: CityJSONSeq and GeoPackage, equal to the file of the run."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely

from pipeline.data.citymodel import CityModel
from pipeline.data.errors import CityError, InputError
from pipeline.data.roofs import flat_roofs
from tests.helpers.cityjson_rules import file_faults, solid_faults
from tests.helpers.written_models import read_city_model
from tests.tiler.export.conftest import Exported
from tiler.citymodels.cityjson import write_city_model
from tiler.export.export import export_run
from tiler.formats import gpkg
from tiler.formats.cityjsonseq import write_cityjsonseq
from tiler.formats.gpkg import write_gpkg
from tiler.store.out_folder import CITY_MODEL

SUFFIX = {"cityjsonseq": "jsonl", "gpkg": "gpkg"}


def write_parts(path: Path) -> CityModel:
    """Three buildings, of which one has two parts with a wall in common, and one a courtyard."""
    boxes = shapely.box([0, 10, 30, 60], [0, 0, 0, 0], [10, 25, 50, 70], [10, 10, 20, 5])
    boxes[2] = shapely.Polygon(boxes[2].exterior.coords, [shapely.box(35, 5, 45, 15).exterior.coords])
    model = CityModel(
        boxes,
        np.array(["a-1", "a-2", "b", "c"]),
        np.array([5, 6, 2**53 - 1, 8]),
        np.array([0.0, 0.0, 1.5, 2.0]),
        flat_roofs(np.array([10.0, 14.0, 9.0, 7.25])),
        (("a",), ("a",), ("b", "x"), ()),
        np.array(["a", "a", "b", "c"]),
    )
    attributes: dict[str, list[object]] = {
        "rmse": [0.5, None, 1.5, None],
        "n": [1, None, 3, 4],
        "source": ["x", None, "y", "z"],
    }
    write_city_model(path, model, crs="EPSG:28992", bounds=(0, 0, 0, 100, 100, 50), attributes=attributes)
    return model


def merged(path: Path) -> dict[str, Any]:
    """Put the features together as one CityJSON document, after looking at each."""
    head, *features = map(json.loads, path.read_text().splitlines())
    assert (head["type"], head["version"], head["CityObjects"], head["vertices"]) == ("CityJSON", "2.0", {}, [])
    document = {**head, "CityObjects": {}, "vertices": []}
    for feature in features:
        assert list(feature) == ["type", "id", "CityObjects", "vertices"]
        assert feature["type"] == "CityJSONFeature"
        one = {**head, "CityObjects": feature["CityObjects"], "vertices": feature["vertices"]}
        assert file_faults(one) == set()
        assert not any(solid_faults(one).values())
        tops = [name for name, thing in feature["CityObjects"].items() if "parents" not in thing]
        assert tops == [feature["id"]]
        document["CityObjects"] |= placed(one)
    return document


def placed(document: dict[str, Any]) -> dict[str, Any]:
    """The objects, with the whole-number coordinates of vertices instead of their indices."""

    def put(item: Any) -> Any:
        return [put(inner) for inner in item] if isinstance(item, list) else document["vertices"][item]

    objects = json.loads(json.dumps(document["CityObjects"]))
    for thing in objects.values():
        for geometry in thing.get("geometry", []):
            geometry["boundaries"] = put(geometry["boundaries"])
    return dict(objects)


def test_features_are_the_buildings_of_the_city_model(small_run: Path, exported: Exported) -> None:
    document, found = json.loads((small_run / CITY_MODEL).read_text()), merged(exported(small_run, "cityjsonseq"))
    assert found["CityObjects"] == placed(document)
    assert len(found["CityObjects"]) >= 10
    assert (found["metadata"], found["transform"]) == (document["metadata"], document["transform"])


def test_parts_are_in_the_feature_of_their_building(tmp_path: Path) -> None:
    write_parts(tmp_path / "model.json")
    write_cityjsonseq(tmp_path / "x.jsonl", tmp_path / "model.json")
    lines = [json.loads(line) for line in (tmp_path / "x.jsonl").read_text().splitlines()]
    assert [(line["id"], list(line["CityObjects"])) for line in lines[1:]] == [
        ("b", ["b"]),
        ("c", ["c"]),
        ("a", ["a", "a-1", "a-2"]),
    ]
    # Two boxes with a wall in common, of different heights: 8 + 8 - 2 at its foot.
    assert len(lines[3]["vertices"]) == 14
    assert merged(tmp_path / "x.jsonl")["CityObjects"] == placed(json.loads((tmp_path / "model.json").read_text()))


def test_rows_are_the_buildings_of_the_city_model(small_run: Path, exported: Exported) -> None:
    model = read_city_model(small_run / CITY_MODEL)
    meta, _, wkb, columns = pyogrio.raw.read(exported(small_run, "gpkg"), layer="buildings")
    table = dict(zip(meta["fields"], columns, strict=True))
    assert meta["crs"] == json.loads((small_run / "run.json").read_text())["region"]["crs"]
    assert table["id"].tolist() == model.ids.tolist()
    assert table["house"].tolist() == model.house.tolist()
    assert np.array_equal(table["number"], model.numbers)
    for name, expected in (("ground_height", model.ground), ("roof_height", model.roof)):
        assert np.array_equal(table[name], expected)
    assert np.allclose(table["height"], model.roof - model.ground)
    shapes = shapely.from_wkb(wkb)
    assert shapely.equals_exact(shapely.normalize(shapes), shapely.normalize(model.polygons), 1e-6).all()


@pytest.mark.parametrize("batch", [1, 3, 100])
def test_missing_values_lists_and_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: int) -> None:
    monkeypatch.setattr(gpkg, "BATCH", batch)
    model = write_parts(tmp_path / "model.json")
    write_gpkg(tmp_path / "x.gpkg", tmp_path / "model.json", crs="EPSG:28992")
    meta, _, wkb, columns = pyogrio.raw.read(tmp_path / "x.gpkg")
    table = dict(zip(meta["fields"], columns, strict=True))
    assert table["house"].tolist() == ["a", "a", "b", "c"]
    assert table["number"].dtype == np.int64
    assert np.array_equal(table["number"], model.numbers)
    assert np.array_equal(table["rmse"], [0.5, np.nan, 1.5, np.nan], equal_nan=True)
    assert np.array_equal(table["n"], [1, np.nan, 3, 4], equal_nan=True)
    assert table["source"].tolist() == ["x", None, "y", "z"]
    assert [json.loads(text) for text in table["members"]] == [["a"], ["a"], ["b", "x"], []]
    assert shapely.equals(shapely.from_wkb(wkb), model.polygons).all()


def test_a_city_without_buildings(tmp_path: Path) -> None:
    none = np.empty(0)
    model = CityModel(
        np.empty(0, object),
        np.empty(0, "U1"),
        np.empty(0, np.int64),
        none,
        flat_roofs(none),
        (),
        np.empty(0, "U1"),
    )
    write_city_model(tmp_path / "model.json", model, crs="EPSG:28992", bounds=(0, 0, 0, 1, 1, 1))
    write_cityjsonseq(tmp_path / "x.jsonl", tmp_path / "model.json")
    assert len((tmp_path / "x.jsonl").read_text().splitlines()) == 1
    write_gpkg(tmp_path / "x.gpkg", tmp_path / "model.json", crs="EPSG:28992")
    assert pyogrio.read_info(tmp_path / "x.gpkg")["features"] == 0


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (r'"children":\["a-1","a-2"\]', '"children":["a-1","a-3"]', "a field is missing or wrong"),
        (r'"children":\["a-1","a-2"\]', '"children":["a-1"]', "part 'a-2' belongs to no building"),
        (r'"boundaries":\[\[\[\d+', '"boundaries":[[[999', r"building 'a'.*vertex .*999 of"),
        (r'"boundaries":\[\[\[\d+', '"boundaries":[[["x"', "building 'a'.*a field is missing or wrong"),
    ],
)
def test_what_is_damaged_is_told(tmp_path: Path, before: str, after: str, message: str) -> None:
    write_parts(tmp_path / "model.json")
    text = (tmp_path / "model.json").read_text()
    changed, n = re.subn(before, after, text, count=1)
    assert n == 1
    (tmp_path / "model.json").write_text(changed)
    with pytest.raises(InputError, match=message):
        write_cityjsonseq(tmp_path / "x.jsonl", tmp_path / "model.json")


@pytest.mark.parametrize("name", list(SUFFIX))
def test_a_missing_city_model_is_told(small_run: Path, tmp_path: Path, name: str) -> None:
    copy = shutil.copytree(small_run, tmp_path / "run", ignore=shutil.ignore_patterns("store.zarr", CITY_MODEL))
    with pytest.raises(CityError, match="cannot be read"):
        export_run(copy, tmp_path / f"x.{SUFFIX[name]}", name=name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]
