"""Solids under sloped roofs: cut where the plane meets a limit, closed, planar, on the plane."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.city_model.roof_areas import block_heights
from pipeline.city_model.sloped_solids import ROOF
from pipeline.city_model.solids import build_solids
from pipeline.data.citymodel import CityModel
from pipeline.data.notes import Note
from pipeline.data.roofs import Roofs
from tests.helpers.campaigns import examples
from tests.helpers.cityjson_rules import file_faults, solid_faults
from tiler.citymodels.cityjson import write_city_model

WEST, SOUTH = 121000.0, 487000.0


def make_model(polygon: shapely.Polygon, plane: list[float], low: float, high: float) -> CityModel:
    """A building at (WEST, SOUTH) on ground 0, its plane by the polygon's own coordinates."""
    moved = shapely.transform(polygon, lambda xy: xy + np.array([WEST, SOUTH]))
    roofs = Roofs(np.array([plane], float), np.array([[WEST, SOUTH]]), np.array([[low, high]], float))
    ids = np.array(["b"])
    return CityModel(np.array([moved]), ids, np.array([1]), np.zeros(1), roofs, ((),), ids)


def roof_rings(model: CityModel) -> list[list[list[float]]]:
    """Outer rings of the roof's faces (m, from WEST and SOUTH), each from its smallest corner on, ascending."""
    origin = np.array([WEST, SOUTH, 0.0])
    levels, _ = build_solids(model, origin, grid=0.001, blocks=block_heights(model))
    rings = [face[0] for kind, face in levels.solids[2].others[0] if kind == ROOF]
    found = []
    for ring in rings:
        xyz = (levels.vertices[ring] / 1000).tolist()
        first = xyz.index(min(xyz))
        found.append(xyz[first:] + xyz[:first])
    return sorted(found)


def write(path: Path, model: CityModel) -> tuple[dict[str, Any], tuple[Note, ...]]:
    blocks = block_heights(model)
    columns = {"lod12_height": blocks[:, 0].tolist(), "lod13_height": blocks[:, 1].tolist()}
    bounds = (WEST, SOUTH, 0, WEST + 100, SOUTH + 100, 50)
    notes = write_city_model(path, model, crs="EPSG:28992", bounds=bounds, attributes=columns)
    return json.loads(path.read_text()), notes


def test_a_shed_is_cut_where_it_meets_its_limits() -> None:
    """A plane of z = x over 10 m, kept within 2 and 6: faces from 0 to 2, from 2 to 6 and from 6 to 10 m."""
    assert roof_rings(make_model(shapely.box(0, 0, 10, 3), [1, 0, 0], 2, 6)) == [
        [[0, 0, 2], [2, 0, 2], [2, 3, 2], [0, 3, 2]],
        [[2, 0, 2], [6, 0, 6], [6, 3, 6], [2, 3, 2]],
        [[6, 0, 6], [10, 0, 6], [10, 3, 6], [6, 3, 6]],
    ]


def test_a_limit_that_cuts_off_two_arms_makes_three_faces() -> None:
    """An outline like a U whose arms reach over the line: one sloped face, and one flat one in each arm."""
    shape = shapely.Polygon([(0, 0), (9, 0), (9, 8), (6, 8), (6, 3), (3, 3), (3, 8), (0, 8)])
    rings = roof_rings(make_model(shape, [0, 1, 1], 0, 6))
    assert [len(ring) for ring in rings] == [8, 4, 4]
    assert rings[1] == [[0, 5, 6], [3, 5, 6], [3, 8, 6], [0, 8, 6]]
    assert rings[2] == [[6, 5, 6], [9, 5, 6], [9, 8, 6], [6, 8, 6]]


def test_a_courtyard_that_the_line_meets_parts_the_faces() -> None:
    shape = shapely.Polygon(shapely.box(0, 0, 9, 9).exterior.coords, [shapely.box(3, 3, 6, 6).exterior.coords])
    rings = roof_rings(make_model(shape, [0, 1, 1], 0, 5.5))
    assert [len(ring) for ring in rings] == [8, 8]
    assert [2.0, 2.0] not in [corner[:2] for ring in rings for corner in ring]
    assert {(3.0, 4.5, 5.5), (6.0, 4.5, 5.5)} <= {tuple(corner) for ring in rings for corner in ring}


def test_a_corner_that_is_nearly_at_the_limit_is_no_face_of_its_own() -> None:
    """The plane is 4 mm over its limit at the eaves: no face of 4 mm is cut off there; 6 mm are one."""
    for over, faces in ((0.004, 1), (0.006, 2)):
        model = make_model(shapely.box(0, 0, 10, 3), [0, 1, 1], 0, 4 - over)
        origin = np.array([WEST, SOUTH, 0.0])
        levels, _ = build_solids(model, origin, grid=0.001, blocks=block_heights(model))
        others = levels.solids[2].others.get(0)
        assert (1 if others is None else sum(kind == ROOF for kind, _ in others)) == faces


def test_a_corner_on_a_straight_wall_is_left_out_of_the_sloped_solid_alone(tmp_path: Path) -> None:
    """It is 1 mm off the wall: rounding turns the triangle with its neighbours to any side."""
    bent = shapely.Polygon([(0, 0), (5.1234, -0.001), (10, 0), (10, 6), (0, 6)])
    town, _ = write(tmp_path / "a.city.json", make_model(bent, [0.9, 1.1, 5], 0, 99))
    corners = {item["lod"]: len(item["boundaries"][0]) for item in town["CityObjects"]["b"]["geometry"]}
    assert corners == {"0": 1, "1.2": 7, "1.3": 7, "2.2": 6}
    assert solid_faults(town) == {"b": set()}


def test_a_face_that_rounding_bends_is_cut_in_triangles(tmp_path: Path) -> None:
    """A strip of 3 mm, and heights are rounded to 1 mm: some of 40 planes are turned there."""
    n_cut = 0
    for k in range(40):
        model = make_model(shapely.box(0, 0, 6, 0.003), [0.9 - 0.01234 * k, 0.3, 5], 0, 99)
        town, _ = write(tmp_path / "a.city.json", model)
        # The mean height over so narrow an outline is not exact to 7 mm of its area.
        assert solid_faults(town)["b"] <= {"volume is not area times height"}
        n_roofs = town["CityObjects"]["b"]["geometry"][-1]["semantics"]["values"][0].count(1)
        assert n_roofs in (1, 2)
        n_cut += n_roofs == 2
    assert 0 < n_cut < 40


def test_a_roof_that_meets_the_ground_is_kept_over_it(tmp_path: Path) -> None:
    town, notes = write(tmp_path / "a.city.json", make_model(shapely.box(0, 0, 10, 3), [1, 0, -3], -5, 6))
    assert [note.kind for note in notes] == ["solid-into-ground"]
    solid = town["CityObjects"]["b"]["geometry"][-1]
    lowest = min(town["vertices"][row][2] for row in solid["boundaries"][0][1][0])
    assert lowest == 2  # mm
    assert "shell not a closed 2-manifold" not in solid_faults(town)["b"]


@settings(max_examples=examples(80), deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_house_is_a_valid_solid(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 12))
    turn = np.sort(rng.uniform(0, 2 * np.pi, n)) + np.arange(n) * 0.1
    reach = rng.choice([0.5, 3.0, 20.0]) * rng.uniform(0.3, 1, (n, 1))
    polygon = shapely.Polygon(reach * np.column_stack((np.cos(turn), np.sin(turn))) + 30)
    if not polygon.is_valid:
        polygon = shapely.convex_hull(polygon)
    if seed % 2 and shapely.maximum_inscribed_circle(polygon).length > 0.5:
        middle = shapely.get_point(shapely.maximum_inscribed_circle(polygon), 0)
        polygon = polygon.difference(shapely.buffer(middle, 0.2, quad_segs=2))
    slope, way = rng.choice([0.01, 0.2, 1.7]) * rng.uniform(0.5, 1), rng.uniform(0, 2 * np.pi)
    if rng.uniform() < 0.3:
        way = 0.0
    a, b = slope * np.cos(way), slope * np.sin(way)
    heights = a * (shapely.get_coordinates(polygon)[:, 0] - 30) + b * (shapely.get_coordinates(polygon)[:, 1] - 30)
    low, high = np.sort(rng.choice(np.concatenate((heights, heights + 0.003, rng.uniform(-5, 5, 4))), 2))
    plane = [a, b, 60.0 - 30 * (a + b)]
    town, notes = write(
        tmp_path_factory.mktemp("any") / "a.city.json", make_model(polygon, plane, 60 + low, 60.001 + high)
    )
    assert file_faults(town) == set()
    assert solid_faults(town) == {"b": set()} or notes


def test_walls_follow_the_edges_of_the_faces(tmp_path: Path) -> None:
    town, _ = write(tmp_path / "a.city.json", make_model(shapely.box(0, 0, 10, 3), [1, 0, 0], 2, 6))
    solid = town["CityObjects"]["b"]["geometry"][-1]
    kinds = solid["semantics"]["values"][0]
    assert (kinds.count(0), kinds.count(1), kinds.count(2)) == (1, 3, 8)
    floor = solid["boundaries"][0][0][0]
    assert len(floor) == 8
    assert all(town["vertices"][a][2] == town["vertices"][b][2] == 0 for a, b in pairwise(floor))
