"""Buildings of city models as rows: levels, outlines, roof surfaces, and points on them."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.data.roofs import roof_heights
from tests.tiler.cityinput.models import (
    CORNERS,
    PLACE,
    box_solid,
    city_json,
    house_gml,
    house_json,
    solid,
    write_gml,
    write_json,
    write_sequence,
)
from tiler.cityinput.faces import ModelBuilding
from tiler.cityinput.levels import choose_shapes, rank_levels
from tiler.cityinput.model_blocks import ModelBlock, Wanted, read_model_blocks
from tiler.cityinput.row_arrays import RowPacker, unpack_rows
from tiler.cityinput.rows import ModelRows, make_rows
from tiler.cityinput.samples import grid_faces, grid_polygons
from tiler.cityinput.sources import scan_model
from tiler.georeference.frame import AS_IT_IS, Frame
from tiler.pointclouds.cells import ranges_near

EVERYWHERE = (0.0, 0.0, 1e7, 1e7)
ALL = Wanted("auto", "", roof_points=True, ground_points=True)


def rows_of(path: Path, lod: str = "auto", frame: Frame = AS_IT_IS) -> tuple[ModelRows, list[str], Counter[str]]:
    counts: Counter[str] = Counter()
    buildings = [each for each in scan_model(path) if isinstance(each, ModelBuilding)]
    rows, notes = make_rows(buildings, frame, lod, counts)
    return rows, [f"{note.kind} {note.subject}: {note.detail}" for note in notes], counts


def height_at(rows: ModelRows, x: float, y: float) -> float:
    place = np.array([[PLACE[0] + x, PLACE[1] + y]])
    over = np.flatnonzero(shapely.contains(rows.surfaces, shapely.points(place)[0]))
    return max(float(roof_heights(rows.roofs, np.array([k]), place)[0]) for k in over)


def several_levels() -> dict[str, Any]:
    """The house at levels 0, 1.2 (8 m), 1.3 (8.5 m) and 2.2."""
    geometries = [solid(2.2)]
    vertices: list[list[float]] = [[*corner] for corner in CORNERS]
    for lod, height in ((1.2, 8.0), (1.3, 8.5)):
        box, corners = box_solid(height, lod, len(vertices))
        geometries.append(box)
        vertices += corners
    geometries.append({"type": "MultiSurface", "lod": 0, "boundaries": [[[0, 1, 2, 3]]]})
    return city_json({"house": {"type": "Building", "geometry": geometries}}, vertices)


def test_a_gabled_house_has_two_roof_surfaces_over_its_outline(tmp_path: Path) -> None:
    rows, notes, counts = rows_of(write_json(tmp_path / "a.json", house_json()))
    assert rows.ids.tolist() == ["house"]
    assert shapely.bounds(rows.outlines).tolist() == [[100_000.0, 450_000.0, 100_010.0, 450_008.0]]
    assert (rows.start.tolist(), rows.lod.tolist(), rows.base.tolist()) == ([0, 2], [2.2], [2.0])
    assert [height_at(rows, 5, y) for y in (1, 3, 5, 7)] == [6.75, 8.25, 8.25, 6.75]
    assert notes == []
    assert counts["model buildings at level 2.2"] == 1


def test_all_formats_give_the_same_rows(tmp_path: Path) -> None:
    paths = [
        write_json(tmp_path / "a.json", house_json()),
        write_sequence(tmp_path / "a.jsonl", [house_json()]),
        write_gml(tmp_path / "a.gml", house_gml()),
        write_gml(tmp_path / "b.gml", house_gml(swap=True)),
    ]
    frames = [Frame()] * 3 + [Frame((1, 1.0), (0, 1.0))]
    found = [rows_of(path, frame=frame)[0] for path, frame in zip(paths, frames, strict=True)]
    for rows in found[1:]:
        assert shapely.equals(rows.outlines, found[0].outlines).all()
        assert shapely.equals(rows.surfaces, found[0].surfaces).all()
        assert rows.roofs.plane == pytest.approx(found[0].roofs.plane)


@pytest.mark.parametrize(
    ("lod", "level", "height"), [("auto", 2.2, 8.25), ("2.2", 2.2, 8.25), ("1.3", 1.3, 8.5), ("1.2", 1.2, 8.0)]
)
def test_the_level_that_is_asked_for(tmp_path: Path, lod: str, level: float, height: float) -> None:
    rows, _, _ = rows_of(write_json(tmp_path / "a.json", several_levels()), lod)
    assert (rows.lod.tolist(), height_at(rows, 5, 3)) == ([level], height)


@pytest.mark.parametrize(
    ("asked", "levels", "order"),
    [
        ("auto", [1.0, 2.0, 3.0, -1.0], [2.0, 3.0, -1.0, 1.0]),
        ("1.2", [1.0, 1.3, 2.2], [1.0, 1.3, 2.2]),
        ("1.3", [3.0, 2.2], [2.2, 3.0]),
        ("2.2", [2.0, 1.0, -1.0], [2.0, 1.0, -1.0]),
    ],
)
def test_the_order_of_levels(asked: str, levels: list[float], order: list[float]) -> None:
    assert rank_levels(levels, asked) == order


def test_parts_have_their_own_best_levels_and_the_whole_is_not_there_twice(tmp_path: Path) -> None:
    box, corners = box_solid(8.0, "1.2", len(CORNERS))
    objects = {
        "whole": {"type": "Building", "children": ["a"], "geometry": [box]},
        "a": {"type": "BuildingPart", "parents": ["whole"], "geometry": [solid("2.2")]},
    }
    path = write_json(tmp_path / "a.json", city_json(objects, [*CORNERS, *corners]))
    (building,) = [each for each in scan_model(path) if isinstance(each, ModelBuilding)]
    attempts = list(choose_shapes(building, "auto"))
    assert [(level, [len(one.faces) for one in shapes]) for level, shapes in attempts] == [(2.2, [7]), (1.2, [6])]


def test_without_a_roof_at_the_best_level_a_lower_one_counts_and_is_told(tmp_path: Path) -> None:
    document = several_levels()
    walls = solid("2.2")
    walls["boundaries"] = [walls["boundaries"][0][3:]]
    walls["semantics"]["values"] = [[2] * 4]
    document["CityObjects"]["house"]["geometry"][0] = walls
    rows, notes, counts = rows_of(write_json(tmp_path / "a.json", document))
    assert rows.lod.tolist() == [1.3]
    assert notes == ["model-lower-level house: level 2.2 has no roof; 1.3"]
    assert counts["model buildings at a lower level"] == 1


@pytest.mark.parametrize("kind", ["level 0", "ground and walls"])
def test_an_outline_alone_leaves_the_height_to_the_attribute(tmp_path: Path, kind: str) -> None:
    document = several_levels()
    house = document["CityObjects"]["house"]
    whole, *_, outline = house["geometry"]
    chosen = np.flatnonzero(np.array(whole["semantics"]["values"][0]) != 1).tolist()
    whole["boundaries"] = [[whole["boundaries"][0][k] for k in chosen]]
    whole["semantics"]["values"] = [[whole["semantics"]["values"][0][k] for k in chosen]]
    house["geometry"], house["attributes"] = [outline if kind == "level 0" else whole], {"measuredHeight": 7.5}
    rows, notes, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert (rows.start.tolist(), rows.given_height.tolist()) == ([0, 0], [7.5])
    assert shapely.area(rows.outlines).tolist() == pytest.approx([80.0])
    assert notes == ["model-no-roof house: no level has a roof; its height of 7.5 m is taken over its outline"]


def test_a_building_without_geometry_is_told_by_its_id(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a.json", city_json({"empty": {"type": "Building"}}, []))
    rows, notes, counts = rows_of(path)
    assert len(rows) == 0
    assert notes == ["model-without-place empty: it has neither faces that lie nor an outline; left out"]
    assert counts["model buildings without a place"] == 1


def test_a_solid_without_kinds_has_the_roof_that_is_highest(tmp_path: Path) -> None:
    document = house_json()
    document["CityObjects"]["house"]["geometry"] = [solid("2", semantics=False)]
    rows, _, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert [height_at(rows, 5, y) for y in (1, 3)] == [6.75, 8.25]
    assert rows.outlines[0].area == pytest.approx(80.0)


def test_flipped_and_repeated_surfaces_change_nothing(tmp_path: Path) -> None:
    document = house_json()
    (geometry,) = document["CityObjects"]["house"]["geometry"]
    faces, values = geometry["boundaries"][0], geometry["semantics"]["values"][0]
    faces[1] = [faces[1][0][::-1]]
    faces.append(faces[2])
    values.append(values[2])
    rows, _, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert [height_at(rows, 5, y) for y in (1, 3, 5, 7)] == [6.75, 8.25, 8.25, 6.75]


def test_a_shell_that_misses_walls_has_the_same_roof(tmp_path: Path) -> None:
    document = house_json()
    (geometry,) = document["CityObjects"]["house"]["geometry"]
    del geometry["boundaries"][0][4:], geometry["semantics"]["values"][0][4:]
    rows, notes, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert [height_at(rows, 5, y) for y in (1, 3, 5, 7)] == [6.75, 8.25, 8.25, 6.75]
    assert (rows.outlines[0].area, notes) == (pytest.approx(80.0), [])


def test_attributes_of_slope_and_height_are_not_believed(tmp_path: Path) -> None:
    document = house_json()
    house = document["CityObjects"]["house"]
    house["attributes"]["measuredHeight"] = 100.0
    for surface in house["geometry"][0]["semantics"]["surfaces"]:
        surface |= {"Slope": 90, "Direction": 0}  # 90 means flat there
    rows, _, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert np.abs(rows.roofs.plane[:, 1]) == pytest.approx([0.75, 0.75])
    assert [height_at(rows, 5, y) for y in (1, 3)] == [6.75, 8.25]


def test_the_same_house_as_solid_and_as_surfaces_is_one_house(tmp_path: Path) -> None:
    document = house_json()
    box, corners = box_solid(12.0, "2.2", len(CORNERS))  # without kinds
    document["CityObjects"]["house"]["geometry"].append(box)
    document["vertices"] += [[round(1000 * v) for v in corner] for corner in corners]
    rows, _, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert (len(rows), len(rows.surfaces)) == (1, 2)
    assert [height_at(rows, 5, y) for y in (1, 3)] == [6.75, 8.25]


def test_a_roof_surface_that_is_not_planar_is_told(tmp_path: Path) -> None:
    corners: list[list[float]] = [[*corner] for corner in CORNERS]
    corners[4][2] = 7.0
    document = city_json({"house": {"type": "Building", "geometry": [solid()]}}, corners)
    rows, notes, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert len(notes) == 1
    assert notes[0].startswith("model-not-planar house: 1 of 2 roof surfaces are not planar, by 0.")
    assert len(rows.surfaces) == 2


def test_a_crossed_surface_is_mended(tmp_path: Path) -> None:
    document = house_json()
    (geometry,) = document["CityObjects"]["house"]["geometry"]
    geometry["boundaries"][0][1] = [[4, 5, 8, 9]]
    rows, _, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert shapely.is_valid(rows.surfaces).all()
    assert shapely.is_valid(rows.outlines).all()


def test_a_roof_steeper_than_70_degrees_is_a_wall_beside_others_and_told(tmp_path: Path) -> None:
    document = house_json()
    document["vertices"][8][2] = document["vertices"][9][2] = 20_000  # a ridge 14 m over eaves 4 m away
    rows, notes, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert (len(rows.surfaces), notes) == (2, [])
    (geometry,) = document["CityObjects"]["house"]["geometry"]
    geometry["boundaries"][0].append([[4, 5, 6, 7]])
    geometry["semantics"]["values"][0].append(1)
    rows, notes, _ = rows_of(write_json(tmp_path / "a.json", document))
    told = "model-steep-roof house: 2 roof surfaces steeper than 70 degrees are taken for walls"
    assert (len(rows.surfaces), height_at(rows, 5, 3.9), notes) == (1, 6.0, [told])


def test_a_ground_surface_that_crosses_itself_says_not_where_the_house_stands(tmp_path: Path) -> None:
    document = house_json()
    document["vertices"].append([2000, 0, 2000])
    (geometry,) = document["CityObjects"]["house"]["geometry"]
    geometry["boundaries"][0][0] = [[0, 2, 3, len(CORNERS)]]
    rows, notes, _ = rows_of(write_json(tmp_path / "a.json", document))
    assert shapely.area(rows.outlines).tolist() == [80.0]
    assert notes == ["model-self-crossing house: 1 of its surfaces cross themselves; taken as they lie in plan"]


def block_of(path: Path, wanted: Wanted = ALL, bounds: Any = EVERYWHERE) -> ModelBlock:
    (block,) = read_model_blocks(path, Frame(), bounds, wanted)
    return block


def test_points_lie_on_the_roof_and_along_its_foot(tmp_path: Path) -> None:
    block = block_of(write_json(tmp_path / "a.json", house_json()))
    roof, foot = block.xyz[block.classification == 6], block.xyz[block.classification == 2]
    assert len(roof) == 20 * 16  # a grid of 0.5 m in 10 x 8 m
    y = roof[:, 1] - PLACE[1]
    assert roof[:, 2] == pytest.approx(9 - 0.75 * np.abs(y - 4))
    assert len(foot) == 2 * (11 + 9) + 1  # at most a metre apart around 10.5 x 8.5 m, the first place again
    assert foot[:, :2].min(axis=0).tolist() == [PLACE[0] - 0.25, PLACE[1] - 0.25]
    assert set(foot[:, 2].tolist()) == {2.0}


def test_points_of_overlapping_houses_lie_on_the_higher_one(tmp_path: Path) -> None:
    low, corners = box_solid(8.0, 2.2, len(CORNERS))
    moved = [[x + 5.0, y, z] for x, y, z in corners]
    houses = {
        "gable": {"type": "Building", "geometry": [solid(2.2)]},
        "box": {"type": "Building", "geometry": [low]},
    }
    document = city_json(houses, [[*corner] for corner in CORNERS] + moved)
    block = block_of(write_json(tmp_path / "a.json", document))
    roof = block.xyz[block.classification == 6] - np.array(PLACE)
    assert len(roof) == len(np.unique(roof[:, :2], axis=0)) == 30 * 16
    gable = 9 - 0.75 * np.abs(roof[:, 1] - 4)
    x = roof[:, 0]
    assert roof[:, 2] == pytest.approx(np.where(x < 5, gable, np.where(x < 10, np.maximum(gable, 8.0), 8.0)))


def test_a_building_that_floats_or_is_sunk_is_told_where_feet_alone_tell_the_ground(tmp_path: Path) -> None:
    houses, vertices = {}, list[list[float]]()
    for k, lift in enumerate((0.0, 5.0, 40.0, 0.0, -30.0)):
        box, corners = box_solid(8.0, 2.2, len(vertices))
        houses[f"h{k}"] = {"type": "Building", "geometry": [box]}
        vertices += [[x + 20.0 * k, y, z + lift] for x, y, z in corners]
    path = write_json(tmp_path / "a.json", city_json(houses, vertices))
    told = [(note.kind, note.subject, note.detail) for note in block_of(path).notes]
    assert told == [
        ("model-off-neighbours", "h2", "its foot is 40.0 m above those of the buildings around"),
        ("model-off-neighbours", "h4", "its foot is 30.0 m below those of the buildings around"),
    ]
    assert not block_of(path, Wanted("auto", "", roof_points=True, ground_points=False)).notes
    vertices[4][0] += 6000.0  # of the roof of h0
    block = block_of(write_json(tmp_path / "b.json", city_json(houses, vertices)))
    assert ("h0", "it is 6 km long; left out") in [(note.subject, note.detail) for note in block.notes]
    assert block.rows.ids.tolist() == ["h1", "h2", "h3", "h4"]


def test_points_are_made_where_they_are_wanted(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a.json", house_json())
    assert len(block_of(path, Wanted("auto", "", roof_points=False, ground_points=False)).xyz) == 0
    some = block_of(path, bounds=(100_000.0, 450_000.0, 100_005.0, 450_100.0))
    assert some.xyz[:, 0].max() <= 100_005.0
    far = block_of(path, bounds=(0.0, 0.0, 10.0, 10.0))
    assert (len(far.rows), far.counts["model buildings outside the region"]) == (0, 1)


def test_the_nodes_of_a_ring_leave_out_its_hole() -> None:
    outer, hole = [[0.0, 0], [6, 0], [6, 4], [0, 4]], [[2.0, 1], [4, 1], [4, 3], [2, 3]]
    face, node = grid_faces(np.array(outer + hole), np.array([0, 4, 8]), np.array([0, 2]), 1.0)
    assert len(face) == 24 - 4
    assert [3, 2] not in node.tolist()
    row, same = grid_polygons(np.array([shapely.Polygon(outer, [hole])], object), 1.0)
    assert sorted(same.tolist()) == sorted(node.tolist())
    assert set(row.tolist()) == {0}


def test_rows_come_back_from_their_arrays(tmp_path: Path) -> None:
    documents = []
    for k in range(6):
        moved = [[x + 300 * k, y, z] for x, y, z in CORNERS]
        part = {"type": "Building", "geometry": [solid()] if k != 3 else [], "attributes": {"measuredHeight": k}}
        if k == 3:
            part["geometry"] = [{"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2, 3]]]}]
        documents.append(city_json({f"h{k}": part}, moved))
    rows = block_of(write_sequence(tmp_path / "a.jsonl", documents)).rows
    packer = RowPacker()
    arrays = packer.pack(rows)
    more = packer.pack(rows)  # a second block behind the first
    whole = {name: np.concatenate((arrays[name], more[name])) for name in arrays}

    def read(names: Any, ranges: Any) -> dict[str, Any]:
        return {name: np.concatenate([whole[name][a:b] for a, b in ranges]) for name in names}

    for ranges in ([(0, 12)], [(2, 4), (7, 11)], [(3, 4)]):
        found = unpack_rows(read, ranges)
        wanted = [k % 6 for a, b in ranges for k in range(a, b)]
        assert found.ids.tolist() == [rows.ids[k] for k in wanted]
        assert found.given_height.tolist() == [rows.given_height[k] for k in wanted]
        assert shapely.equals(found.outlines, rows.outlines[wanted]).all()
        assert np.diff(found.start).tolist() == np.diff(rows.start)[wanted].tolist()
        surfaces = [s for k in wanted for s in range(rows.start[k], rows.start[k + 1])]
        assert found.roofs.plane.tolist() == rows.roofs.plane[surfaces].tolist()
        assert shapely.equals(found.surfaces, rows.surfaces[surfaces]).all()
    box = (*rows.outlines[0].bounds,)
    near = ranges_near(whole["model_cell_box"], np.append(whole["model_cell_start"], 12), box)
    assert any(first <= 0 < last for first, last in near)
