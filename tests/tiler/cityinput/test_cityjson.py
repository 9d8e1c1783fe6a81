"""CityJSON of all versions and CityJSONSeq: what is read, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import InputError
from tests.tiler.cityinput.models import CORNERS, city_json, house_json, solid, write_json, write_sequence
from tiler.cityinput.citygml import Relief
from tiler.cityinput.cityjson import read_buildings
from tiler.cityinput.faces import GROUND, OUTLINE, ROOF, UNKNOWN, WALL, ModelBuilding
from tiler.cityinput.sources import read_model_header, scan_model


def buildings_of(path: Path) -> list[ModelBuilding]:
    return [each for each in scan_model(path) if isinstance(each, ModelBuilding)]


def test_a_solid_has_its_faces_with_kinds_and_places(tmp_path: Path) -> None:
    (house,) = buildings_of(write_json(tmp_path / "a.json", house_json()))
    (shape,) = house.shapes
    assert (house.id, house.height, shape.lod, shape.closed, shape.owner) == ("house", 7.0, 2.2, True, "house")
    assert shape.faces.kind.tolist() == [GROUND, ROOF, ROOF, WALL, WALL, WALL, WALL]
    assert shape.faces.xyz[4:8].tolist() == [
        [100_000.0, 450_000.0, 6.0],
        [100_010.0, 450_000.0, 6.0],
        [100_010.0, 450_004.0, 9.0],
        [100_000.0, 450_004.0, 9.0],
    ]


@pytest.mark.parametrize("version", ["1.0", "1.1", "2.0"])
@pytest.mark.parametrize("lod", ["2.2", 2.2])
def test_versions_and_levels_as_numbers_or_text(tmp_path: Path, version: str, lod: Any) -> None:
    document = house_json() | {"version": version}
    document["CityObjects"]["house"]["geometry"] = [solid(lod)]
    (house,) = buildings_of(write_json(tmp_path / "a.json", document))
    assert [shape.lod for shape in house.shapes] == [2.2]


def test_parts_belong_to_their_building(tmp_path: Path) -> None:
    objects = {
        "part": {"type": "BuildingPart", "parents": ["whole"], "geometry": [solid("2")]},
        "whole": {"type": "Building", "children": ["part"]},
        "orphan": {"type": "BuildingPart", "parents": ["elsewhere"], "geometry": [solid("1.2", semantics=False)]},
        "inner": {"type": "BuildingPart", "parents": ["part"], "geometry": [solid("2")]},
        "one": {"type": "BuildingPart", "parents": ["other"], "geometry": [solid("2")]},
        "other": {"type": "BuildingPart", "parents": ["one"], "geometry": [solid("2")]},
        "road": {"type": "Road", "geometry": [solid("2")]},
    }
    path = write_json(tmp_path / "a.json", city_json(objects, CORNERS))
    found = buildings_of(path)
    assert [(one.id, [shape.owner for shape in one.shapes]) for one in found] == [
        ("whole", ["part", "inner"]), ("orphan", ["orphan"]), ("one", ["one"]), ("other", ["other"]),
    ]  # fmt: skip
    assert list(scan_model(path))[-1] == {"Road": 1}
    assert set(found[1].shapes[0].faces.kind.tolist()) == {UNKNOWN}


def test_a_multisurface_at_level_0_is_an_outline(tmp_path: Path) -> None:
    outline = {"type": "MultiSurface", "lod": 0, "boundaries": [[[0, 1, 2, 3]]]}
    document = city_json({"a": {"type": "Building", "geometry": [outline]}}, CORNERS)
    (house,) = buildings_of(write_json(tmp_path / "a.json", document))
    assert house.shapes[0].faces.kind.tolist() == [OUTLINE]


def test_of_a_solid_with_a_cavity_the_outer_shell_counts(tmp_path: Path) -> None:
    whole = solid()
    whole["boundaries"].append([[[0, 1, 2]]])
    whole["semantics"]["values"].append([0])
    document = city_json({"a": {"type": "Building", "geometry": [whole]}}, CORNERS)
    (house,) = buildings_of(write_json(tmp_path / "a.json", document))
    assert len(house.shapes[0].faces) == 7


def test_solids_of_a_composite_are_joined(tmp_path: Path) -> None:
    one = solid()
    both: dict[str, Any] = {
        "type": "CompositeSolid",
        "lod": "2",
        "boundaries": [one["boundaries"], one["boundaries"]],
    }
    both["semantics"] = {"surfaces": one["semantics"]["surfaces"], "values": [one["semantics"]["values"], [None]]}
    document = city_json({"a": {"type": "Building", "geometry": [both]}}, CORNERS)
    (house,) = buildings_of(write_json(tmp_path / "a.json", document))
    assert house.faults == ()
    assert house.shapes[0].faces.kind.tolist() == [GROUND, ROOF, ROOF, WALL, WALL, WALL, WALL] + [UNKNOWN] * 7


def test_a_sequence_has_its_transform_in_the_first_line_alone(tmp_path: Path) -> None:
    second = house_json()
    second["CityObjects"] = {"other": second["CityObjects"]["house"]}
    found = buildings_of(write_sequence(tmp_path / "a.jsonl", [house_json(), second]))
    assert [one.id for one in found] == ["house", "other"]
    assert found[0].shapes[0].faces.xyz.tolist() == found[1].shapes[0].faces.xyz.tolist()


def test_terrain_is_read_beside_buildings(tmp_path: Path) -> None:
    relief = {
        "type": "TINRelief",
        "geometry": [{"type": "CompositeSurface", "lod": "1", "boundaries": [[[0, 1, 2]]]}],
    }
    path = write_json(tmp_path / "a.json", city_json({"tin": relief}, CORNERS))
    (terrain,) = [each for each in scan_model(path) if isinstance(each, Relief)]
    assert len(terrain.faces) == 1


def test_kinds_in_an_older_form_are_not_read_and_things_that_are_none_told(tmp_path: Path) -> None:
    document = house_json()
    (geometry,) = document["CityObjects"]["house"]["geometry"]
    geometry["semantics"] = [[{"type": "RoofSurface"}]]
    document["CityObjects"]["house"]["geometry"].append({"type": "Solid", "lod": "1", "boundaries": [[{}]]})
    (house,) = buildings_of(write_json(tmp_path / "a.json", document))
    assert set(house.shapes[0].faces.kind.tolist()) == {UNKNOWN}
    geometry["semantics"] = {"surfaces": ["RoofSurface"], "values": [[0]]}
    (house,) = buildings_of(write_json(tmp_path / "a.json", document))
    assert "AttributeError" in house.faults[0]


def test_a_geometry_that_cannot_be_read_is_told_and_others_stay(tmp_path: Path) -> None:
    document = house_json()
    bad = solid("1.2")
    bad["boundaries"][0][0] = [[0, 1, 99]]
    document["CityObjects"]["house"]["geometry"].append(bad)
    (house,) = buildings_of(write_json(tmp_path / "a.json", document))
    assert len(house.shapes) == 1
    assert "house: a Solid cannot be read (IndexError" in house.faults[0]


@pytest.mark.parametrize("value", [None, 1e12])
def test_a_vertex_without_a_place_costs_its_building_alone(tmp_path: Path, value: Any) -> None:
    bad = house_json()
    bad["vertices"][4][0] = value
    path = write_sequence(tmp_path / "a.jsonl", [bad, house_json()])
    first, second = buildings_of(path)
    assert (first.shapes, len(second.shapes)) == ((), 1)
    assert "a coordinate is no number, or beyond" in first.faults[0]
    assert read_model_header(path).bounds == (100_000, 450_000, 100_010, 450_008, 2, 9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (json.dumps(house_json() | {"transform": None}), "without a transform"),
        (json.dumps(house_json() | {"type": "FeatureCollection"}), "its type is 'FeatureCollection'"),
        (json.dumps(house_json() | {"transform": {"scale": [1], "translate": [0, 0, 0]}}), "three finite scales"),
        (
            json.dumps({key: value for key, value in house_json().items() if key != "CityObjects"}),
            "no CityObjects",
        ),
        (json.dumps(house_json())[:-40], "is no JSON object"),
        (json.dumps(house_json() | {"CityObjects": {"a": None}}), "the city object a is no JSON object"),
        (
            json.dumps(house_json() | {"CityObjects": {"a": {"parents": 5}}}),
            "the parents of a have the wrong type",
        ),
        (json.dumps(house_json() | {"vertices": [[1, 2], [3, 4], [5, 6]]}), "not all vertices have three numbers"),
    ],
)
def test_a_damaged_file_is_refused_with_the_reason(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        list(scan_model(path))


def test_a_sequence_that_is_cut_off_tells_its_line(tmp_path: Path) -> None:
    path = write_sequence(tmp_path / "a.jsonl", [house_json()])
    path.write_text(path.read_text()[:-30])
    with pytest.raises(InputError, match="line 2"):
        list(scan_model(path))


def test_a_header_has_the_extent_of_buildings_alone(tmp_path: Path) -> None:
    header = read_model_header(write_json(tmp_path / "a.json", house_json()))
    assert header.bounds == (100_000.0, 450_000.0, 100_010.0, 450_008.0, 2.0, 9.0)
    assert header.crs is not None
    assert (header.n_buildings, header.kind, header.crs.to_epsg()) == (1, "model", 28992)
    nothing = read_model_header(write_json(tmp_path / "b.json", city_json({}, [])))
    assert np.isnan(nothing.bounds).all()
    assert nothing.n_points == 0


def test_a_face_whose_border_is_a_line_is_none_whatever_holes_it_has() -> None:
    document = house_json()
    faces = document["CityObjects"]["house"]["geometry"][0]["boundaries"][0]
    faces.append([[0, 1, 0], [4, 5, 6]])
    document["CityObjects"]["house"]["geometry"][0]["semantics"]["values"][0].append(1)
    objects, vertices = document["CityObjects"], np.array(document["vertices"], np.float64)
    (house,) = read_buildings(objects, vertices)
    assert len(house.shapes[0].faces) == 7
    objects["house"]["geometry"][0]["boundaries"][0] = [[[0, 1, 0]]]
    objects["house"]["geometry"][0]["semantics"]["values"][0] = [0]
    (house,) = read_buildings(objects, vertices)
    (shape,) = house.shapes
    assert (len(shape.faces), shape.faces.face_start.tolist()) == (0, [0])
    assert shape.faces.ring_start.dtype == np.int64
