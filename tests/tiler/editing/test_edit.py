"""Edits of a run folder: the bytes of one run on the final input, refusals, the city of a day, and kills."""

import json
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from shapely import affinity

import tiler
from pipeline.data.citymodel import CityModel
from pipeline.data.errors import InputError
from pipeline.data.roofs import flat_roofs
from tests.runs.test_city_models import parts_of
from tests.runs.test_run import hashes
from tests.tiler.cityinput.models import CORNERS, PLACE, city_json, solid, write_json
from tiler.citymodels.cityjson import write_city_model
from tiler.cli.main import main
from tiler.config.config import make_config
from tiler.editing.edit import CITY_FILES, edit_city, list_edits
from tiler.editing.staging import DONE_NOW, NOT_DONE
from tiler.editing.uploads import Upload, read_upload
from tiler.store.edit_journal import edit_path
from tiler.tiles3d.gltf import begin_glb
from tiler.workflow.audit import Audit
from tiler.workflow.run import run

CRS = "EPSG:3006"
MESH = re.compile(r"(mesh|boundary|citymodel)\b.*")
SCRIPT = """
import os, signal, sys
from pathlib import Path
from tiler.editing import edit, staging

module, name, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
place = {"edit": edit, "os": staging.os, "moves": staging.os, "shutil": staging.shutil}[module]
real = getattr(place, name)

def kill(*given, **more):
    global count
    count -= module != "moves" or Path(sys.argv[4], ".edit", "commit.json").exists()
    if count == -1:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*given, **more)

setattr(place, name, kill)
edit.edit_city(Path(sys.argv[4]), "remove", sys.argv[5])
"""


def write(path: Path, *polygons: shapely.Polygon, ids: list[str], crs: str = CRS) -> Path:
    blobs = np.array(shapely.to_wkb(list(polygons)), np.object_)
    pyogrio.raw.write(path, blobs, [np.array(ids, np.object_)], ["id"], geometry_type="Polygon", crs=crs)
    return path


def read_input(folder: Path) -> dict[str, shapely.Polygon]:
    """Footprints that a run was given, by id."""
    config = json.loads((folder / "run.json").read_text())["parameters"]
    _, _, blobs, values = pyogrio.raw.read(config["footprints"], columns=["id"])
    return dict(zip(values[0].tolist(), shapely.from_wkb(blobs), strict=True))


def mesh_of(folder: Path) -> dict[str, str]:
    return {name: value for name, value in hashes(folder).items() if MESH.match(name)}


def test_edits_end_in_the_bytes_of_one_run_and_a_day_has_those_before_it(edited: Path, tmp_path: Path) -> None:
    city, shapes = shutil.copytree(edited, tmp_path / "city"), read_input(edited)
    gone, first, *_ = shapes
    shapes[first] = shapes[first].buffer(-0.5)  # by the first edit
    free = affinity.scale(shapes.pop(gone), 0.5, 0.5)
    changed = tiler.open(city).remove(gone, date="2028-01-01")
    new = write(tmp_path / "n.gpkg", free, ids=["new"])
    assert main(["edit", str(city), "--add", str(new), "--date", "2028-01-01", "--base", "2"]) == 0
    assert [edit.ids for edit in changed.edits()] == [[first], [gone], ["new"]]
    assert not [*Audit(city)]
    record = json.loads((city / "run.json").read_text())
    assert "damaged-artefact" not in record["notes"]
    assert json.loads((edited / "run.json").read_text())["ran"]["outlines"] == 1  # though it is the first edit
    ran = record["ran"]
    assert ran.keys().isdisjoint({"points", "footprints", "terrain"})
    assert ran["columns"] < 4  # others have the same buildings around them

    final = write(tmp_path / "final.gpkg", *shapes.values(), free, ids=[*shapes, "new"])
    given = json.loads((edited / "run.json").read_text())["parameters"]
    run(make_config(given | {"footprints": str(final), "out": str(tmp_path / "whole")}))
    assert mesh_of(city) == mesh_of(tmp_path / "whole")
    made = [hashes(folder / "store.zarr" / "columns") for folder in (city, tmp_path / "whole")]
    assert made[0] == made[1]  # those with another key, too
    day = changed.at("2027-12-31", tmp_path / "day").folder
    assert mesh_of(day) == mesh_of(edited)
    points = [path.relative_to(city) for path in (city / "store.zarr/points").iterdir()]
    assert points
    assert all((city / path).samefile(day / path) for path in points)


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--remove", "nobody"], 2, "not in the city"),
        (["--remove", "HOUSE", "--date", "soon"], 2, "is no day"),
        (["--remove", "HOUSE", "--base", "7"], 2, "the last edit is number 1"),
        (["--remove", "EDITED", "--base", "0"], 2, "edit 1 of 2027-01-01 (replace, h.gpkg) came after state 0"),
        (["--remove", "EDITED", "--date", "2026-01-01"], 2, "is later than 2026-01-01"),
        (["--replace", "HOUSE", "far.gpkg"], 1, "0 of 1 features meet the region"),
        (["--replace", "HOUSE", "bow.gpkg"], 1, "Self-intersection"),
        (["--replace", "HOUSE", "two.gpkg"], 1, "has 2 footprints"),
        (["--replace", "HOUSE", "none.gpkg"], 1, "no such file"),
        (["--add", "there.gpkg"], 2, "is there already"),
        (["--remove", "HOUSE", "--out", "x"], 2, "is for --at"),
    ],
)
def test_what_cannot_be_edited_is_refused_and_the_city_stays(
    arguments: list[str],
    code: int,
    words: str,
    edited: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    house, other, *_ = read_input(edited)
    monkeypatch.chdir(edited.parent)
    before = hashes(edited)
    given = [{"HOUSE": house, "EDITED": other}.get(text, text) for text in arguments]
    assert main(["edit", str(edited), *given]) == code
    told = capsys.readouterr().err
    assert words in told
    assert len(told.splitlines()) == 1
    assert hashes(edited) == before
    assert not (edited / ".edit").exists()


@pytest.fixture(scope="module")
def edited(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A city with one edit, and files that are uploaded; not to be changed."""
    folder = tmp_path_factory.mktemp("edited")
    city = shutil.copytree(small_run, folder / "city")
    (house, shape), (other, moved), *_ = read_input(city).items()
    bow = shapely.Polygon(_bow(shape))
    write(folder / "far.gpkg", affinity.translate(shape, 5000.0), ids=["x"])
    write(folder / "bow.gpkg", bow, ids=["x"])
    write(folder / "two.gpkg", shape, affinity.translate(shape, 5.0), ids=["x", "y"])
    write(folder / "there.gpkg", shape, ids=[house])
    tiler.open(city).replace(other, write(folder / "h.gpkg", moved.buffer(-0.5), ids=["x"]), date="2027-01-01")
    return city


def _bow(shape: shapely.Polygon) -> list[tuple[float, float]]:
    xmin, ymin, xmax, ymax = shape.bounds
    return [(xmin, ymin), (xmax, ymax), (xmax, ymin), (xmin, ymax)]


def test_an_upload_in_another_crs_is_taken_to_that_of_the_region(edited: Path, tmp_path: Path) -> None:
    record = json.loads((edited / "run.json").read_text())
    (_, shape), *_ = read_input(edited).items()
    region, there = record["region"], pyproj.Transformer.from_crs(CRS, 4326, always_xy=True)
    far = shapely.transform(shape, lambda xy: np.stack(there.transform(*xy.T), axis=1))
    path = write(tmp_path / "far.geojson", far, ids=["x"], crs="EPSG:4326")
    found = read_upload(
        Upload(path), make_config(record["parameters"]), crs=region["crs"], bounds=region["bounds"]
    )
    assert shape.hausdorff_distance(found.footprints.polygons[0]) < 0.01


def test_a_building_of_cityjson_is_an_outline_with_a_height(edited: Path, tmp_path: Path) -> None:
    record = json.loads((edited / "run.json").read_text())
    bounds, crs = record["region"]["bounds"], record["region"]["crs"]
    x, y = bounds[0] + 40, bounds[1] + 30
    square, number = shapely.box([x], [y], [x + 8], [y + 6]), np.array([7])
    model = CityModel(
        square, np.array(["a"]), number, np.array([2.0]), flat_roofs(np.array([11.5])), (("a",),), np.array(["a"])
    )
    path = tmp_path / "a.city.json"
    write_city_model(path, model, crs=CRS, bounds=(x, y, 0, x + 9, y + 9, 20))
    found = read_upload(Upload(path), make_config(record["parameters"]), crs=crs, bounds=bounds).footprints
    assert (found.ids.tolist(), found.given_height.tolist()) == (["a"], [pytest.approx(9.5)])
    assert found.polygons[0].equals(square[0])
    far = tmp_path / "far.city.json"
    far.write_text(path.read_text().replace(f'"translate":[{x // 1}', f'"translate":[{x // 1 + 5000}'))
    with pytest.raises(InputError, match="0 of 1 buildings meet the region"):
        read_upload(Upload(far), make_config(record["parameters"]), crs=crs, bounds=bounds)


def test_a_building_of_glb_stands_at_its_position_with_the_mean_height_of_its_roof(
    edited: Path, tmp_path: Path
) -> None:
    record = json.loads((edited / "run.json").read_text())
    bounds, crs = record["region"]["bounds"], record["region"]["crs"]
    x, y = bounds[0] + 40, bounds[1] + 30
    path = write_house(tmp_path / "house.glb", extras={"origin": [x, y, 2.0]})
    given: dict[str, Any] = {"config": make_config(record["parameters"]), "crs": crs, "bounds": bounds}
    found = read_upload(Upload(path), **given).footprints
    assert (found.ids.tolist(), found.given_height.tolist()) == (["house"], [pytest.approx(7.5, abs=0.01)])
    assert found.polygons[0].symmetric_difference(shapely.box(x + 1, y, x + 9, y + 6)).area < 0.01
    moved = read_upload(Upload(path, (x + 50, y, 2.0)), **given).footprints.polygons[0]
    assert moved.equals(affinity.translate(found.polygons[0], 50.0))
    for data, words in (
        (write_house(tmp_path / "x.glb").read_bytes(), "give the position"),
        (
            write_house(tmp_path / "x.glb", extensionsRequired=["KHR_draco_mesh_compression"]).read_bytes(),
            "without",
        ),
        (path.read_bytes()[:-40], "is no GLB file"),
        (path.read_bytes().replace(b'"count":8', b'"count":9'), "beyond its part"),
    ):
        (tmp_path / "x.glb").write_bytes(data)
        with pytest.raises(InputError, match=words):
            read_upload(Upload(tmp_path / "x.glb"), **given)


def write_house(path: Path, extras: dict[str, Any] | None = None, **more: Any) -> Path:
    """Write a house of 8 x 6 m with a floor, two walls and a roof from 6 to 9 m."""
    low = [[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [8.0, 0.0, -6.0], [0.0, 0.0, -6.0]]
    top = [[x, 6.0 - z / 2, z] for x, _, z in low]
    places = np.array([*low, *top], np.float32)
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4], [2, 3, 7], [2, 7, 6]])
    data = places.tobytes() + faces.astype(np.uint8).tobytes()
    document = {
        "asset": {"version": "2.0"} | ({"extras": extras} if extras else {}),
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "translation": [1, 0, 0]}, {"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": faces.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": faces.size},
        ],
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(document | more, separators=(",", ":")).encode()
    path.write_bytes(begin_glb(text, len(data)) + data)
    return path


def test_an_upload_keeps_its_roof_whatever_points_the_cloud_has_there(sloped_run: Path, tmp_path: Path) -> None:
    city, shapes = shutil.copytree(sloped_run, tmp_path / "city"), read_input(sloped_run)
    given = json.loads((city / "run.json").read_text())["parameters"]
    house = max(shapes, key=lambda name: shapes[name].area)
    x, y = map(round, shapes.pop(house).centroid.coords[0])
    corners = [[x - 5 + a - PLACE[0], y - 4 + b - PLACE[1], 20 + c] for a, b, c in CORNERS]
    objects = {house: {"type": "Building", "geometry": [solid()]}}
    model = write_json(tmp_path / "new.city.json", city_json(objects, corners, crs=CRS))
    said: list[str] = []
    edit_city(city, "replace", house, Upload(model), say=said.append)
    points, foot = said
    assert foot.endswith("m above the ground")
    assert re.fullmatch(rf"{house}: [1-9]\d* roof points in the cloud do not count", points)
    parts = parts_of(city)
    new = [parts[name] for name in parts if name.startswith(house)]
    assert [(part["roof_method"], round(part["roof_slope"])) for part in new] == [("model", 37)] * 2
    assert {part["roof_points"] for part in new} == {0}
    assert not [*Audit(city)]

    # One run on the final input: footprints without that house, and the model beside them.
    final = write(tmp_path / "final.gpkg", *shapes.values(), ids=list(shapes))
    values = {
        "footprints": str(final),
        "buildings": [str(model)],
        "clearance": 1.0,
        "out": str(tmp_path / "whole"),
    }
    run(make_config(given | values))
    made, whole = (mesh_of(tmp_path / name) for name in ("city", "whole"))
    assert len(made) > len(CITY_FILES)
    assert {name for name in made if made[name] != whole[name]} <= {
        *CITY_FILES
    }  # which tell how points fit the roof


def test_a_changed_or_lost_edit_is_found(edited: Path, tmp_path: Path) -> None:
    city = shutil.copytree(edited, tmp_path / "city")
    path = edit_path(city, 1)
    text = path.read_text()
    path.write_text(text.replace("2027-01-01", "2026-01-01"))
    assert "checksum differs" in str([*Audit(city)])
    with pytest.raises(InputError, match="checksum differs"):
        tiler.open(city).edits()
    path.unlink()
    assert "has the edits [], the mesh is of [1]" in str([*Audit(city)])


@pytest.mark.long
@pytest.mark.parametrize(
    ("module", "name", "count"),
    [
        *(("edit", name, 0) for name in ("begin", "write_edit", "run", "commit")),
        *(("os", "replace", count) for count in (0, 10, 60)),
        *(("moves", "replace", count) for count in (0, 1, 5, 20)),
        ("os", "link", 50),
        ("os", "rename", 0),
        ("shutil", "rmtree", 3),
    ],
)
def test_a_killed_edit_is_finished_or_forgotten(
    module: str, name: str, count: int, killed: tuple[Path, Path], tmp_path: Path
) -> None:
    before, after = killed
    city, (house, *_) = shutil.copytree(before, tmp_path / "city"), read_input(before)
    command = [sys.executable, "-c", SCRIPT, module, name, str(count), str(city), house]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    told: list[str] = []
    n = len(list_edits(city, told.append))
    done = n == 2
    assert told in ([], [DONE_NOW] if done else [NOT_DONE])  # nothing where nothing was left
    assert mesh_of(city) == mesh_of(after if done else before)
    assert not [*Audit(city)]
    assert not [path for path in city.iterdir() if path.name.startswith(".edit")]


@pytest.fixture(scope="module")
def killed(edited: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A city before and after the edit that is killed."""
    after = shutil.copytree(edited, tmp_path_factory.mktemp("after") / "city")
    house, *_ = read_input(edited)
    tiler.open(after).remove(house)
    return edited, after
