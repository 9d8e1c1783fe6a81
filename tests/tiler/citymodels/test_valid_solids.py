"""Solids of sloped roofs by an independent check of ISO 19107, and files by the schemas of CityJSON."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from pipeline.city_model.roof_areas import block_heights
from tests.conftest import SHARED
from tests.helpers.iso19107 import check_shell, check_solids
from tests.helpers.sloped_towns import sloped_town
from tests.helpers.tiles import shape_city
from tiler.citymodels.cityjson import write_city_model
from tiler.formats.cityjsonseq import write_cityjsonseq
from tiler.store.out_folder import CITY_MODEL, FULL_CITY_MODEL

# A house of 4 x 2 x 3 m with a ridge of 1 m along it, in millimetres.
HOUSE = [
    *((0, 0, 0), (4000, 0, 0), (4000, 2000, 0), (0, 2000, 0)),
    *((0, 0, 3000), (4000, 0, 3000), (4000, 2000, 3000), (0, 2000, 3000)),
    *((0, 1000, 4000), (4000, 1000, 4000)),
]
FACES = [
    [[0, 3, 2, 1]],
    [[4, 5, 9, 8]],
    [[6, 7, 8, 9]],
    [[0, 1, 5, 4]],
    [[2, 3, 7, 6]],
    [[1, 2, 6, 9, 5]],
    [[3, 0, 4, 8, 7]],
]
LODS = ["1.2", "1.3", "2.2"]


def faults_of(faces: list[list[list[int]]] = FACES, **moved: tuple[int, int, int]) -> set[str]:
    places = HOUSE + [place for name, place in moved.items() if name.startswith("new")]
    for name, place in moved.items():
        if name.startswith("at"):
            places[int(name[2:])] = place
    return set(check_shell(faces, np.array(places, np.int64)))


def test_a_house_is_valid() -> None:
    assert faults_of() == set()


@pytest.mark.parametrize(
    ("faces", "moved", "code"),
    [
        (FACES[:3], {}, "301"),
        (FACES[1:], {}, "302"),
        ([[[0, 1, 2, 3]], *FACES[1:]], {}, "307"),
        ([[ring[::-1] for ring in face] for face in FACES], {}, "405"),
        ([[[0, 3, 2, 1, 1]], *FACES[1:]], {}, "102"),
        ([[[0, 3]], *FACES[1:]], {}, "101"),
        ([[[0, 3, 1, 2]], *FACES[1:]], {}, "20x"),
        ([[[0, 3, 2, 1], [4, 5, 6]], *FACES[1:]], {}, "203"),
        (FACES, {"at5": (4000, 0, 3100)}, "203"),
        (FACES, {"at5": (4000, 2000, 3001)}, "000"),
        (FACES, {"at8": (0, 1000, -500), "at9": (4000, 1000, -500)}, "306"),
        # The same house once more, in the corner of this one, and beside its edge.
        ([*FACES, *([[v + 10 for v in ring] for ring in face] for face in FACES)], {"twice": (0, 0, 0)}, "305"),
    ],
)
def test_each_fault_is_found(faces: list[list[list[int]]], moved: dict[str, Any], code: str) -> None:
    if moved.pop("twice", None):
        moved |= {f"new{k}": (x + 9000, y, z) for k, (x, y, z) in enumerate(HOUSE)}
    assert code in {fault.partition(" ")[0] for fault in faults_of(faces, **moved)}


def test_houses_that_meet_in_an_edge_or_a_corner_are_no_solid() -> None:
    far = [(x + 4000, y + 2000, z) for x, y, z in HOUSE]
    two = np.array([*HOUSE, *far], np.int64)
    same = {10 + k: HOUSE.index(place) for k, place in enumerate(far) if place in HOUSE}
    more = [[[same.get(v + 10, v + 10) for v in ring] for ring in face] for face in FACES]
    assert set(check_shell([*FACES, *more], two)) >= {"304 more than two faces at an edge"}
    high = np.array([*HOUSE, *((x, y, z + 3000) for x, y, z in far)], np.int64)
    more = [[[6 if v == 0 else v + 10 for v in ring] for ring in face] for face in FACES]
    assert set(check_shell([*FACES, *more], high)) == {"303 shells meet in a vertex"}


def assert_valid(path: Path, lods: list[str] = LODS) -> int:
    """All solids are valid, and each building has one of each level; gives the number of buildings."""
    document = json.loads(path.read_text())
    found = check_solids(document, lods)
    assert {key: faults for key, faults in found.items() if faults} == {}
    things = {name for name, thing in document["CityObjects"].items() if "geometry" in thing}
    assert set(found) == {(name, lod) for name in things for lod in lods}
    return len(things)


def test_solids_of_a_run_are_valid(sloped_run: Path) -> None:
    assert assert_valid(sloped_run / CITY_MODEL) > 60
    assert assert_valid(sloped_run / FULL_CITY_MODEL, ["2.2"]) > 60


@pytest.mark.parametrize("seed", range(2))
def test_solids_of_any_roofs_are_valid(tmp_path: Path, seed: int) -> None:
    """Sheds, gables and slopes in any direction, cut by limits, over blocks of any shape."""
    model = sloped_town(seed, 25, steepest=3.0).model
    blocks = block_heights(model)
    attributes = {"lod12_height": blocks[:, 0].tolist(), "lod13_height": blocks[:, 1].tolist()}
    write_city_model(
        tmp_path / "x.json", model, crs="EPSG:28992", bounds=(0, 0, 0, 200, 200, 50), attributes=attributes
    )
    assert assert_valid(tmp_path / "x.json", ["2.2"]) == len(model) > 20


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("roofs", ["planes", "skeleton"])
def test_solids_of_amsterdam_are_valid(shared_data: Path, tmp_path: Path, roofs: str) -> None:
    data = shared_data / "amsterdam"
    values = {
        "pointcloud": [str(path) for path in sorted((data / "tiles").iterdir())],
        "footprints": str(data / "footprints.gpkg"),
        "bounds": (120_750.0, 486_000.0, 121_050.0, 486_300.0),
        "tile_size": 150.0,
        "roofs": roofs,
    }
    shape_city(values, tmp_path / "out")
    assert assert_valid(tmp_path / "out" / CITY_MODEL) > 1000
    assert assert_valid(tmp_path / "out" / FULL_CITY_MODEL, ["1.2", "2.2"]) > 1000


def schema(name: str) -> Any:
    """Validator of a schema of CityJSON 2.0, as its authors publish it in one file."""
    path = SHARED / "schemas" / "cityjson" / "2.0" / f"{name}.min.schema.json"
    if not path.is_file():
        pytest.skip(f"no schema at {path}")
    return jsonschema.Draft7Validator(json.loads(path.read_text()))


def test_files_obey_the_schemas(sloped_run: Path, tmp_path: Path) -> None:
    model = sloped_run / CITY_MODEL
    write_cityjsonseq(tmp_path / "x.jsonl", model)
    document = json.loads(model.read_text())
    head, *features = map(json.loads, (tmp_path / "x.jsonl").read_text().splitlines())
    house = next(name for name, thing in document["CityObjects"].items() if "children" in thing)
    kept = {house, *document["CityObjects"][house]["children"]}
    small = document | {"CityObjects": {name: document["CityObjects"][name] for name in sorted(kept)}}
    whole, part = schema("cityjson"), schema("cityjsonfeature")
    for one in (small, head):
        assert [error.message for error in whole.iter_errors(one)] == []
    one = next(feature for feature in features if feature["id"] == house)
    assert [error.message for error in part.iter_errors(one)] == []
    lods = [[item["lod"] for item in small["CityObjects"][name].get("geometry", [])] for name in sorted(kept)]
    assert lods.count(["0", *LODS]) == len(kept) - 1
    broken = json.loads(json.dumps(one))
    broken["CityObjects"][house]["type"] = "House"
    assert not part.is_valid(broken)
