"""`citystitch detail`: a gabled house by rules, read again by schemas, ISO 19107 and the reader of GLB."""

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import tiler
from tests.conftest import SHARED
from tests.helpers.iso19107 import check_solids
from tests.helpers.patch_readers import read_document
from tests.tiler.cityinput.models import house_json, write_json
from tiler.cli.main import main

SCHEMA = SHARED / "schemas/cityjson/2.0/cityjson.min.schema.json"
# The front of the house is its southern wall, from (0, 0) to (10, 0), 4 m high.
RULES: dict[str, Any] = {
    "front": "bays",
    "other": "window",
    "nodes": {
        "bays": {
            "op": "split", "axis": "u", "semantics": "floor",
            "parts": [{"share": 1, "to": "window"}, {"size": 2, "to": "door"}, {"size": 3.5, "to": "balcony"}],
        },
        "window": {"op": "insert", "asset": "window", "width": 1.5, "height": 1.5, "sill": 1, "columns": 2},
        "door": {"op": "insert", "asset": "door", "width": 1.1, "height": 2.2},
        "balcony": {"op": "insert", "asset": "balcony", "width": 2.5, "height": 2.5, "sill": 1},
    },
}  # fmt: skip

WINDOW: dict[str, Any] = RULES["nodes"]["window"]


@pytest.fixture
def house(tmp_path: Path) -> Path:
    (tmp_path / "rules.json").write_text(json.dumps(RULES))
    return write_json(tmp_path / "in.city.json", house_json())


def detail(house: Path, name: str, *options: str) -> Path:
    path = house.parent / name
    words = ["detail", str(house), "-o", str(path), "--rules", str(house.parent / "rules.json")]
    assert main([*words, *options]) == 0
    return path


def geometries(path: Path) -> dict[str, list[dict[str, Any]]]:
    return {name: one["geometry"] for name, one in json.loads(path.read_text())["CityObjects"].items()}


def kinds_of(geometry: dict[str, Any]) -> dict[str, int]:
    names = [surface["type"] for surface in geometry["semantics"]["surfaces"]]
    values = [names[k] for k in geometry["semantics"]["values"][0]]
    return {name: values.count(name) for name in names}


def test_a_house_with_all_assets_is_valid_and_its_table_counts_the_file(house: Path) -> None:
    table = house.parent / "table.json"
    path = detail(house, "a.city.json", "--json", str(table))
    document = json.loads(path.read_text())
    if SCHEMA.is_file():
        jsonschema.Draft7Validator(json.loads(SCHEMA.read_text())).validate(document)
    assert document["transform"]["scale"] == [0.0001] * 3
    assert check_solids(document, ("3",)) == {("house", "3"): set(), ("house-balcony-1", "3"): set()}
    objects = document["CityObjects"]
    assert objects["house"]["children"] == ["house-balcony-1"]
    assert (objects["house-balcony-1"]["type"], objects["house-balcony-1"]["parents"]) == (
        "BuildingInstallation",
        ["house"],
    )
    found = geometries(path)
    (solid,) = found["house"]
    kinds = kinds_of(solid)
    assert (kinds["GroundSurface"], kinds["RoofSurface"]) == (1, 2)
    assert (kinds["Window"], kinds["Door"]) == (
        4 * (1 + 2),
        2 * (1 + 1),
    )  # pane and panels, of 4 windows and 2 doors
    openings = [surface for surface in solid["semantics"]["surfaces"] if "parent" in surface]
    assert [solid["semantics"]["surfaces"][one["parent"]]["type"] for one in openings] == ["WallSurface"] * 2
    told = json.loads(table.read_text())
    assert told["assets"] == {"full": 6, "reduced": 0, "flat": 0}
    number = sum(len(one["boundaries"][0]) for of_one in found.values() for one in of_one)
    assert told["polygons"] == [
        {"model": "full model", "polygons": number, "remaining": 100.0},
        {"model": "frame", "polygons": number, "remaining": 100.0},
        {"model": "low-asset level", "polygons": 13, "remaining": round(1300 / number, 1)},
        {"model": "low-façade level", "polygons": 7, "remaining": round(700 / number, 1)},
    ]
    assert detail(house, "b.city.json").read_bytes() == path.read_bytes()


def test_a_viewpoint_keeps_what_is_near_and_faces_it(house: Path) -> None:
    table = house.parent / "table.json"
    seen = ("--viewpoint", "100005,449980,4", "--distance", "30,90", "--facing", "90", "--keep", "door=100")
    path = detail(house, "a.city.jsonl", *seen, "--json", str(table))
    words: dict[str, Any] = {
        "viewpoint": (100005, 449980, 4),
        "distance": (30, 90),
        "facing": 90.0,
        "keep": {"door": 100},
    }
    other, rules = house.parent / "b.city.jsonl", str(house.parent / "rules.json")
    lines = tiler.detail_models(house, other, rules=rules, **words)
    assert other.read_text().replace("b-pictures", "a-pictures") == path.read_text()
    assert lines[-3].startswith("semantics alone")
    told = json.loads(table.read_text())
    names = [row["model"] for row in told["polygons"]]
    assert names[:5] == ["full model", "frame", "distance alone", "facing alone", "semantics alone"]
    # The southern wall is seen; others are one polygon each.
    assert (told["facades_of_one_polygon"], told["assets"]["flat"]) == (3, 3)
    feature = json.loads(path.read_text().splitlines()[1])
    assert (
        sum(len(one["geometry"][0]["boundaries"][0]) for one in feature["CityObjects"].values())
        == (told["polygons"][1]["polygons"])
    )
    away = detail(house, "far.city.json", "--viewpoint", "0,0,0")
    (plain,) = geometries(away)["house"]
    assert sorted(map(len, plain["boundaries"][0])) == [1] * 7


def test_a_glb_has_materials_for_openings(house: Path) -> None:
    document, take = read_document(detail(house, "a.glb"))
    names = [material["name"] for material in document["materials"]]
    assert names == ["surface", "ground", "roof", "wall", "window", "door", "installation"]
    used = {names[one["material"]]: take(one["indices"]) for one in document["meshes"][0]["primitives"]}
    assert set(used) == set(names) - {"surface"}
    assert [node["extras"] for node in document["nodes"]] == [{"measuredHeight": 7.0}]  # not that of the balcony
    # A frame with two holes is 14 triangles, by Euler's formula, a pane in each is 2.
    assert len(used["window"]) == 3 * 4 * (14 + 2 * 2)


def test_flat_facades_and_assets_of_a_glb_show_pictures_of_their_assets(house: Path) -> None:
    whole = detail(house, "a.glb", "--viewpoint", "0,0,0")
    single = detail(house, "b.glb", "--viewpoint", "0,0,0", "--keep", "balcony=100")  # the wall has a balcony
    model = detail(house, "d.city.json", "--viewpoint", "0,0,0")
    assets = detail(house, "e.city.jsonl", "--viewpoint", "0,0,0", "--keep", "balcony=100")
    for path, names in (
        (whole, ("wall", "window", "door")),
        (single, ("window", "door")),
        (model, ("wall", "window", "door")),
        (assets, ("window", "door")),
    ):
        page, xyz, uv = read_pictures(path) if path.suffix == ".glb" else read_textures(path)
        # On the front, from its lower left corner on: x and y (m).
        for name in names:
            x, y = {"wall": (0.3, 0.5), "window": (2.0, 1.5), "door": (5.5, 1.0)}[name]
            found = []
            for corners, places in zip(xyz, uv, strict=True):
                weight = np.linalg.lstsq((corners[1:] - corners[0])[:, :2].T, [x, y] - corners[0, :2])[0]
                if np.ptp(corners[:, 2]) < 1e-6 < corners[0, 2] and min(*weight, 1 - weight.sum()) >= 0:
                    u, v = (places[0] + weight @ (places[1:] - places[0])) * len(page)
                    found.append(page[int(v), int(u)].tolist())
            (red, _, blue) = found[0]
            assert {"wall": red > 220, "window": blue > red + 15, "door": red > blue + 30}[name], (path, name)
    assert detail(house, "c.glb", "--viewpoint", "0,0,0").read_bytes() == whole.read_bytes()
    before = model.read_bytes(), (house.parent / "d-pictures" / "1.png").read_bytes()
    again = detail(house, "d.city.json", "--viewpoint", "0,0,0", "--overwrite")
    assert (again.read_bytes(), (house.parent / "d-pictures" / "1.png").read_bytes()) == before
    (house.parent / "d-pictures" / "mine.txt").touch()  # a folder with other files is not replaced
    assert main(["detail", str(house), "-o", str(model), "--viewpoint", "0,0,0", "--overwrite"]) == 2


def read_textures(path: Path) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Read the page of CityJSON, and triangles of the faces that show it, as `read_pictures` does."""
    document, *features = map(
        json.loads, path.read_text().split("\n", 1) if path.suffix == ".jsonl" else [path.read_text()]
    )
    one = features[0] if features else document
    if SCHEMA.is_file():
        name = "cityjsonfeature" if features else "cityjson"
        jsonschema.Draft7Validator(json.loads((SCHEMA.parent / f"{name}.min.schema.json").read_text())).validate(
            one
        )
    (texture,) = one["appearance"]["textures"]
    page = np.asarray(Image.open(path.parent / texture["image"]), np.int64)
    xyz = np.array(one["vertices"]) * document["transform"]["scale"]
    xyz = (xyz - xyz.min(axis=0))[:, [0, 2, 1]] * [1, 1, -1]
    uv = np.array(one["appearance"]["vertices-texture"]) * [1, -1] + [0, 1]
    solid = one["CityObjects"]["house"]["geometry"][0]
    found = []
    for face, shown in zip(solid["boundaries"][0], solid["texture"]["facades"]["values"][0], strict=True):
        if shown != [[None]]:
            assert (len(face), shown[0][0], len(shown[0])) == (1, 0, len(face[0]) + 1)
            found += [
                (
                    (xyz[face[0][0]], xyz[face[0][k]], xyz[face[0][k + 1]]),
                    (uv[shown[0][1]], uv[shown[0][k + 1]], uv[shown[0][k + 2]]),
                )
                for k in range(1, len(face[0]) - 1)
            ]
    corners, places = (np.array(part) for part in zip(*found, strict=True))
    corners[:, :, 2] -= corners[:, :, 2].max() - 1
    return page, corners, places


def read_pictures(path: Path) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Read the page of a file, and the triangles that show it: corners, from the building's corner, and places."""
    document, take = read_document(path)
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    data = path.read_bytes()
    start = len(data) - document["buffers"][0]["byteLength"] + view["byteOffset"]
    page = np.asarray(Image.open(BytesIO(data[start : start + view["byteLength"]])), np.int64)
    assert all("byteStride" in document["bufferViews"][k] for k in (0, 2))  # which accessors share
    (shown,) = (one for one in document["meshes"][0]["primitives"] if "TEXCOORD_0" in one["attributes"])
    surface = document["materials"][shown["material"]]["pbrMetallicRoughness"]
    assert surface["baseColorTexture"] == {"index": 0}
    corners = take(shown["indices"])
    xyz, uv = (
        take(shown["attributes"][name]).reshape(-1, n)[corners].reshape(-1, 3, n)
        for name, n in (("POSITION", 3), ("TEXCOORD_0", 2))
    )
    assert 0 <= uv.min() < uv.max() <= 1
    xyz[:, :, 2] -= xyz[:, :, 2].max() - 1
    return page, xyz, uv


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"window": WINDOW | {"width": 0.1}}, "nodes.window.width: 0.1 is less than the minimum of 0.3"),
        ({"window": WINDOW | {"columns": 9}}, "nodes.window: 1.5 by 1.5 m has no room for 9 by 1 panes"),
        ({"window": WINDOW | {"sill": float("nan")}}, "a number is NaN"),
        ({"window": WINDOW | {"hight": 1}}, "nodes.window: Additional properties are not allowed ('hight'"),
        ({"door": {"op": "turn"}}, "nodes.door.op: 'turn' is not one of ['split', 'repeat', 'insert']"),
        ({"door": {"op": "repeat", "axis": "u", "size": 2, "to": "bays"}}, "is a circle"),
    ],
)  # fmt: skip
def test_bad_rules_end_with_one_error(
    house: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], told: str
) -> None:
    rules = house.parent / "rules.json"
    rules.write_text(json.dumps(RULES | {"nodes": RULES["nodes"] | change}))
    assert main(["detail", str(house), "-o", str(house.parent / "a.glb"), "--rules", str(rules)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{rules}: " in line
    assert told in line
    assert not (house.parent / "a.glb").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--facing", "90"), "give --viewpoint"),
        (("--viewpoint", "1,2"), "--viewpoint 1,2: are not 3 numbers"),
        (("--viewpoint", "1,2,3", "--distance", "9,9"), "--distance 9,9: FULL is not from 0 on and below REDUCED"),
        (("--keep", "door=101"), "--keep door=101: is not LABEL=PERCENT"),
        (("--rules", "gothic"), "--rules gothic: no such file"),
    ],
)
def test_bad_options_end_with_one_error(
    house: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], told: str
) -> None:
    assert main(["detail", str(house), "-o", str(house.parent / "a.glb"), *options]) == 2
    assert told in capsys.readouterr().err
