"""The proof that solids of all levels of detail agree with the city model: each fault is found."""

import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.city_model.roof_areas import block_heights
from pipeline.data.citymodel import CityModel
from pipeline.data.roofs import Roofs
from tests.helpers import iso19107
from tests.helpers.written_models import read_city_model
from tiler.check.solid_proofs import check_solids
from tiler.citymodels.building_index import copy_vertices
from tiler.citymodels.cityjson import write_city_model

Json = dict[str, Any]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Json:
    """A house of a shed whose plane is cut at its eaves and of a flat part; a turned shed; a flat house."""
    west, south = 121000.0, 487000.0
    turned = shapely.affinity.rotate(shapely.box(30, 0, 40, 6), 31)
    boxes = [shapely.box(0, 0, 10, 6), shapely.box(10, 0, 14, 6), turned, shapely.box(60, 0, 65, 5)]
    polygons = np.array([shapely.affinity.translate(box, west, south) for box in boxes])
    planes = np.array([[0.5, 0.0, 5.0], [0.0, 0.0, 7.0], [0.3, -0.8, 9.0], [0.0, 0.0, 4.0]])
    origin = np.array([[west, south], [0, 0], [west + 35, south], [0, 0]])
    limits = np.array([[6.0, 30.0], [7.0, 7.0], [-1.0, 30.0], [4.0, 4.0]])
    ids = np.array(["a-part1", "a-part2", "b", "c"])
    house = np.array(["a", "a", "b", "c"])
    roofs = Roofs(planes, origin, limits)
    model = CityModel(polygons, ids, np.arange(4), np.full(4, 0.25), roofs, ((),) * 4, house)
    blocks = block_heights(model)
    columns = {"lod12_height": blocks[:, 0].tolist(), "lod13_height": blocks[:, 1].tolist()}
    file = tmp_path_factory.mktemp("town") / "a.city.json"
    bounds = (west, south, 0, west + 100, south + 100, 50)
    assert write_city_model(file, model, crs="EPSG:28992", bounds=bounds, attributes=columns) == ()
    found: Json = json.loads(file.read_text())
    return found


@pytest.mark.parametrize("plane", [(0.0, 0.0, 9.0), (0.2, -0.1, 9.0)])
def test_a_courtyard_that_touches_a_wall_is_parted_from_it(tmp_path: Path, plane: tuple[float, ...]) -> None:
    hole = [(0.0, 5.0), (6.0, 2.0), (8.0, 5.0), (6.0, 8.0)]
    polygons = np.array([shapely.Polygon([(0, 0), (10, 0), (10, 10), (0, 10)], [hole])])
    sloped = plane[0] != 0
    roofs = Roofs(np.array([plane]), np.array([[5.0, 5.0]]), np.array([[8.0, 12.0] if sloped else [9.0, 9.0]]))
    ids = np.array(["a"])
    model = CityModel(polygons, ids, np.arange(1), np.zeros(1), roofs, ((),), ids)
    blocks = block_heights(model)
    columns = {"lod12_height": blocks[:, 0].tolist(), "lod13_height": blocks[:, 1].tolist()}
    file = tmp_path / "a.city.json"
    (note,) = write_city_model(file, model, crs="EPSG:28992", bounds=(0, 0, 0, 99, 99, 50), attributes=columns)
    assert (note.kind, note.detail) == ("solid-touching", "touches itself in 1 points, expected 0")
    document = json.loads(file.read_text())
    assert iso19107.check_solids(document) == {("a", lod): set() for lod in ("1.2", "1.3", "2.2")}
    assert prove(tmp_path, document)[1] == set()
    xy = np.array(document["vertices"])[:, :2].tolist()
    assert [5, 5000] in xy  # the corner of the courtyard, 5 mm into it
    assert shapely.equals(read_city_model(file).polygons[0], polygons[0])
    away = json.loads(json.dumps(document))
    away["vertices"] = [[x + 20 * (x == 5), y, z] for x, y, z in away["vertices"]]
    assert prove(tmp_path, away)[1] == {"solid-plan"}


def prove(folder: Path, model: Json) -> tuple[str, set[str]]:
    """Claim of the proof, and kinds of its faults."""
    file = folder / "b.city.json"
    file.write_text(json.dumps(model))
    with TemporaryFile() as spool:
        proof = check_solids(file, copy_vertices(file, spool))
    return proof.claim, {fault.kind for fault in proof.faults}


def take(model: Json, name: str = "b", lod: str = "2.2") -> Json:
    (solid,) = (one for one in model["CityObjects"][name]["geometry"] if one["lod"] == lod)
    found: Json = solid
    return found


def find_face(solid: Json, kind: int, k: int = 0) -> int:
    return int([row for row, value in enumerate(solid["semantics"]["values"][0]) if value == kind][k])


def lift_roof_corner(model: Json) -> None:
    """One corner of a roof 60 mm up, in all faces that have it."""
    solid = take(model)
    corner = solid["boundaries"][0][find_face(solid, 1)][0][0]
    x, y, z = model["vertices"][corner]
    model["vertices"].append([x, y, z + 60])
    for face in solid["boundaries"][0]:
        for ring in face:
            ring[:] = [len(model["vertices"]) - 1 if vertex == corner else vertex for vertex in ring]


def drop_face(kind: int) -> Callable[[Json], None]:
    def drop(model: Json) -> None:
        solid = take(model)
        k = find_face(solid, kind)
        solid["boundaries"][0].pop(k)
        solid["semantics"]["values"][0].pop(k)

    return drop


def level_cut_roof(model: Json) -> None:
    """One face for the roof of three, which is no plane then: the middle of it is off by more than its corners."""
    solid = take(model, "a-part1")
    faces, kinds = solid["boundaries"][0], solid["semantics"]["values"][0]
    two = [find_face(solid, 1, k) for k in range(2)]
    rings = [faces[k][0] for k in two]
    edges = {(a, b) for ring in rings for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)}
    after = {a: b for a, b in edges if (b, a) not in edges}
    start = min(after)
    ring = [start]
    while after[ring[-1]] != start:
        ring.append(after[ring[-1]])
    faces[two[0]] = [ring]
    faces.pop(two[1])
    kinds.pop(two[1])


def say(kind: int, semantic: int) -> Callable[[Json], None]:
    def change(model: Json) -> None:
        solid = take(model)
        solid["semantics"]["values"][0][find_face(solid, kind)] = semantic

    return change


def set_attribute(name: str, value: Any, building: str = "b") -> Callable[[Json], None]:
    def change(model: Json) -> None:
        model["CityObjects"][building]["attributes"][name] = value

    return change


def change_plane(k: int, by: float) -> Callable[[Json], None]:
    def change(model: Json) -> None:
        model["CityObjects"]["b"]["attributes"]["roof_plane"][k] += by

    return change


def move(lod: str) -> Callable[[Json], None]:
    """Move a solid by 10 mm to the east."""

    def change(model: Json) -> None:
        first = len(model["vertices"])
        used = sorted({row for face in take(model, "b", lod)["boundaries"][0] for ring in face for row in ring})
        model["vertices"] += [[x + 10, y, z] for x, y, z in (model["vertices"][row] for row in used)]
        for face in take(model, "b", lod)["boundaries"][0]:
            for ring in face:
                ring[:] = [first + used.index(row) for row in ring]

    return change


def drop_level(lod: str) -> Callable[[Json], None]:
    def drop(model: Json) -> None:
        geometry = model["CityObjects"]["b"]["geometry"]
        geometry[:] = [one for one in geometry if one["lod"] != lod]

    return drop


def turn(model: Json) -> None:
    for face in take(model)["boundaries"][0]:
        for ring in face:
            ring.reverse()


def lean_wall(model: Json) -> None:
    """A corner of the floor 10 mm into the house, in all its faces: walls lean, the floor is not the outline."""
    solid = take(model)
    corner = solid["boundaries"][0][find_face(solid, 0)][0][0]
    x, y, z = model["vertices"][corner]
    model["vertices"].append([x + 10, y + 10, z])
    for face in solid["boundaries"][0]:
        for ring in face:
            ring[:] = [len(model["vertices"]) - 1 if vertex == corner else vertex for vertex in ring]


FAULTS: dict[str, tuple[Callable[[Json], None], set[str]]] = {
    "nothing": (lambda model: None, set()),
    "a corner of the roof up": (lift_roof_corner, {"solid-roof", "solid-height", "solid-bent"}),
    "no roof": (drop_face(1), {"solid-open", "solid-plan", "solid-volume"}),
    "no floor": (drop_face(0), {"solid-open", "solid-plan"}),
    "a wall gone": (drop_face(2), {"solid-open", "solid-volume"}),
    "a roof of two planes in one face": (level_cut_roof, {"solid-bent"}),
    "a roof called wall": (say(1, 2), {"solid-semantics", "solid-plan"}),
    "a wall called roof": (say(2, 1), {"solid-semantics", "solid-roof"}),
    "a floor called roof": (say(0, 1), {"solid-semantics", "solid-roof", "solid-plan"}),
    "plane too steep": (change_plane(0, 0.01), {"solid-roof", "solid-height"}),
    "plane 10 mm up": (change_plane(2, 0.01), {"solid-roof", "solid-height", "block-height"}),
    "plane elsewhere": (change_plane(3, 1.0), {"solid-roof", "solid-height", "block-height", "solid-volume"}),
    "inside out": (turn, {"solid-semantics", "solid-volume", "solid-plan"}),
    "moved": (move("2.2"), {"solid-plan"}),
    "block moved": (move("1.2"), {"solid-plan"}),
    "a leaning wall": (lean_wall, {"solid-semantics", "solid-plan"}),
    "no LoD2.2": (drop_level("2.2"), {"solid-missing"}),
    "no LoD1.3": (drop_level("1.3"), {"solid-missing"}),
    "other height of LoD1.2": (set_attribute("lod12_height", 8.0), {"solid-height", "solid-volume"}),
    "other height of LoD1.3": (
        set_attribute("lod13_height", 8.0),
        {"solid-height", "solid-volume", "block-height"},
    ),
    "a flat house raised": (
        set_attribute("roof_height", 4.5, "c"),
        {"height-attribute", "solid-height", "solid-volume", "block-height"},
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found(town: Json, tmp_path: Path, name: str) -> None:
    change, expected = FAULTS[name]
    model = json.loads(json.dumps(town))
    change(model)
    claim, found = prove(tmp_path, model)
    assert expected <= found if name != "nothing" else found == set()
    assert "12 solids" in claim or found


def test_the_claim_tells_of_sloped_roofs(town: Json, tmp_path: Path) -> None:
    claim, _ = prove(tmp_path, town)
    assert "12 solids of the city model are closed" in claim
    assert "0.006 m of the 2 with sloped roofs" in claim
