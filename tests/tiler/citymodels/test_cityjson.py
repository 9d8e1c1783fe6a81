"""The CityJSON export: valid by the specification, solids valid by ISO 19107, nothing lost on the way."""

import json
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.affinity import rotate, translate

from pipeline.city_model.solids import build_solids
from pipeline.data.citymodel import CityModel, number_ids, take_model
from pipeline.data.errors import ConfigError, OutputError
from pipeline.data.notes import Note
from pipeline.data.roofs import flat_roofs
from tests.helpers.campaigns import examples
from tests.helpers.cityjson_rules import area_vector, broken, file_faults, solid_faults, volume
from tests.helpers.iso19107 import check_solids
from tests.helpers.written_models import read_city_model
from tiler.citymodels import cityjson
from tiler.citymodels.cityjson import write_city_blocks, write_city_model

BOUNDS = (120999.5, 486999.5, -2.5, 121200.0, 487200.0, 100.0)
HOUSE = shapely.box(121000, 487000, 121010, 487008)
# A block with two courtyards, and a house in one of them.
BLOCK = shapely.Polygon(
    shapely.box(121020, 487000, 121060, 487040).exterior.coords,
    [
        shapely.box(121025, 487005, 121045, 487035).exterior.coords,
        shapely.box(121050, 487010, 121055, 487020).exterior.coords,
    ],
)
INNER = rotate(shapely.box(121030, 487010, 121040, 487030), 0.123, use_radians=True)


def make_model(*polygons: Any, ground: Any = 0.7, roof: Any = 12.3456789, ids: Any = None) -> CityModel:
    n = len(polygons)
    rows = np.empty(n, dtype=np.object_)
    rows[:] = polygons
    names = np.array([f"b{i}" for i in range(n)] if ids is None else ids, dtype=np.str_)
    return CityModel(
        polygons=rows,
        ids=names,
        numbers=np.arange(n) if len(set(names)) < n else number_ids(names),
        ground=np.broadcast_to(np.float64(ground), n).copy(),
        roofs=flat_roofs(np.broadcast_to(np.float64(roof), n).copy()),
        members=tuple((str(name), f"{name}-annex") for name in names),
        house=names,
    )


def write(path: Path, model: CityModel, **options: Any) -> tuple[dict[str, Any], tuple[Note, ...]]:
    notes = write_city_model(path, model, **({"crs": "EPSG:28992", "bounds": BOUNDS} | options))
    return json.loads(path.read_text()), notes


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "citymodel.city.json"


@pytest.fixture
def town(target: Path) -> dict[str, Any]:
    return write(target, make_model(HOUSE, BLOCK, INNER), title="Three houses")[0]


def test_a_town_with_courtyards_is_valid(town: dict[str, Any]) -> None:
    assert file_faults(town) == set()
    assert solid_faults(town) == {"b0": set(), "b1": set(), "b2": set()}
    # 8 corners of each box, twice 12 of the block; nothing is shared between the three.
    assert len(town["vertices"]) == 8 + 24 + 8


def test_a_house_is_six_faces_in_this_order(target: Path) -> None:
    town, _ = write(target, make_model(HOUSE, ground=1.0, roof=4.0))
    flat, solid = town["CityObjects"]["b0"]["geometry"]
    assert (flat["type"], flat["lod"], solid["type"], solid["lod"]) == ("MultiSurface", "0", "Solid", "1.2")
    assert [len(face[0]) for face in solid["boundaries"][0]] == [4] * 6
    assert solid["semantics"]["values"] == [[0, 1, 2, 2, 2, 2]]
    points = np.array(town["vertices"]) * 0.001 + town["transform"]["translate"]
    assert volume(solid, points) == pytest.approx(10 * 8 * 3.0)
    np.testing.assert_allclose(area_vector(flat["boundaries"][0], points), [0, 0, 80.0], atol=1e-6)
    np.testing.assert_allclose(points[flat["boundaries"][0][0], 2], 1.0)


def test_the_courtyard_is_cut_out_of_both_geometries(town: dict[str, Any]) -> None:
    flat, solid = town["CityObjects"]["b1"]["geometry"]
    points = np.array(town["vertices"]) * 0.001 + town["transform"]["translate"]
    assert [len(rings) for rings in (flat["boundaries"][0], *solid["boundaries"][0][:2])] == [3, 3, 3]
    area = 40 * 40 - 20 * 30 - 5 * 10
    assert area_vector(flat["boundaries"][0], points)[2] == pytest.approx(area)
    assert volume(solid, points) == pytest.approx(area * (12.346 - 0.7))


def test_transform_and_metadata(town: dict[str, Any]) -> None:
    assert town["transform"] == {"scale": [0.001] * 3, "translate": [120999.0, 486999.0, -3.0]}
    assert town["metadata"]["referenceSystem"] == "https://www.opengis.net/def/crs/EPSG/0/28992"
    assert town["metadata"]["geographicalExtent"] == list(BOUNDS)
    assert town["metadata"]["title"] == "Three houses"


def test_the_extent_holds_a_building_beyond_the_region(target: Path) -> None:
    town, _ = write(target, make_model(translate(HOUSE, -20.25, 0), roof=200.0))
    assert file_faults(town) == set()
    assert town["metadata"]["geographicalExtent"] == [120979.75, *BOUNDS[1:5], 200.0]
    assert min(row[0] for row in town["vertices"]) < 0


def test_attributes_keep_their_precision_and_extra_columns(target: Path) -> None:
    extra = {
        "roof_points": np.array([7, 0]),
        "rmse": np.array([0.1, np.nan]),
        "source": ["lidar", None],
        "kept": np.array([True, False]),
    }
    town, _ = write(target, make_model(HOUSE, INNER), attributes=extra)
    first, second = (item["attributes"] for item in town["CityObjects"].values())
    assert first == {
        "number": int(number_ids(np.array(["b0"]))[0]),
        "ground_height": 0.7,
        "roof_height": 12.3456789,
        "height": 12.3456789 - 0.7,
        "members": ["b0", "b0-annex"],
        "roof_points": 7,
        "rmse": 0.1,
        "source": "lidar",
        "kept": True,
    }
    assert (second["rmse"], second["source"], second["kept"]) == (None, None, False)


def test_a_house_of_two_parts_is_a_building_with_two_parts(target: Path) -> None:
    front, back = shapely.box(121000, 487000, 121010, 487010), shapely.box(121010, 487000, 121020, 487010)
    alone = shapely.box(121030, 487000, 121040, 487010)
    model = replace(
        make_model(front, back, alone, roof=[9.0, 4.0, 6.0], ids=["h-1", "h-2", "k"]),
        house=np.array(["h", "h", "k"]),
    )
    document, _ = write(target, model)
    assert file_faults(document) == set()
    assert set().union(*solid_faults(document).values()) == set()
    objects = document["CityObjects"]
    assert objects["h"] == {"type": "Building", "children": ["h-1", "h-2"]}
    assert [objects[name]["type"] for name in ("h-1", "h-2", "k")] == ["BuildingPart", "BuildingPart", "Building"]
    assert file_faults(broken(document, ["CityObjects", "h", "children"], ["h-1"])) == {
        "parents and children differ"
    }
    assert read_city_model(target).house.tolist() == ["h", "h", "k"]


def test_an_id_is_a_row_or_a_house_of_parts(target: Path) -> None:
    houses = [shapely.box(0, 0, 9, 9), shapely.box(20, 0, 29, 9)]
    model = replace(make_model(*houses, ids=["h", "h-1"]), house=np.array(["h", "h"]))
    with pytest.raises(ValueError, match="building h: is a row and has parts"):
        write(target, model)


def test_an_empty_model_is_valid(target: Path) -> None:
    town, notes = write(target, make_model())
    assert file_faults(town) == set()
    assert (town["CityObjects"], town["vertices"], notes) == ({}, [], ())
    assert len(read_city_model(target)) == 0


def test_odd_ids_survive(target: Path) -> None:
    ids = ['NL.IMBAG.Pand "0363"', "straße 7/b\\", "", "\u2028 {}"]
    model = make_model(*(translate(HOUSE, 20 * i, 0) for i in range(4)), ids=ids)
    town, _ = write(target, model)
    assert list(town["CityObjects"]) == ids
    assert file_faults(town) == set()
    assert read_city_model(target).ids.tolist() == ids


def test_a_written_model_reads_back(target: Path) -> None:
    model = make_model(HOUSE, BLOCK, INNER, ground=[0.1, -1.2345678, 3.0], roof=[9.9, 20.00000001, 4.0])
    write(target, model)
    again = read_city_model(target)
    for name in ("ids", "numbers", "ground", "roof"):
        np.testing.assert_array_equal(getattr(again, name), getattr(model, name), strict=True)
    assert again.members == model.members
    assert shapely.hausdorff_distance(again.polygons, model.polygons).max() <= 0.0005 * np.sqrt(2) + 1e-9
    assert shapely.get_num_interior_rings(again.polygons).tolist() == [0, 2, 0]
    assert shapely.is_ccw(shapely.get_exterior_ring(again.polygons)).all()


def test_equal_input_gives_equal_bytes_and_is_left_alone(target: Path) -> None:
    model = make_model(HOUSE, BLOCK, INNER)
    before = [shapely.to_wkb(model.polygons).tolist(), model.ground.tobytes(), model.roof.tobytes()]
    write(target, model)
    first = target.read_bytes()
    time.sleep(0.01)
    write(target, model)
    assert target.read_bytes() == first
    assert before == [shapely.to_wkb(model.polygons).tolist(), model.ground.tobytes(), model.roof.tobytes()]
    other, _ = write(target, make_model(HOUSE, BLOCK, INNER, roof=12.4))
    assert other["metadata"]["identifier"] != json.loads(first)["metadata"]["identifier"]


def cut_blocks(model: CityModel, ends: list[int]) -> list[tuple[CityModel, dict[str, list[int]]]]:
    """Cut a model with one attribute column into blocks."""
    parts = [slice(a, b) for a, b in pairwise([0, *ends, len(model)])]
    return [(take_model(model, rows), {"row": list(range(len(model)))[rows]}) for rows in parts]


def test_blocks_of_any_size_give_the_same_bytes(target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cityjson, "RUN", 4)
    model = make_model(
        *(translate(HOUSE, 40 * (7 * i % 11), 3 * i) for i in range(11)), ids=[f"h{i}" for i in range(11)]
    )
    model = replace(model, house=np.array(["x", *model.ids[1:6], "x", "y", "y", *model.ids[9:]]))
    written = []
    for ends in ([], [3], [4, 8], list(range(1, 11)), [0, 11]):
        notes = write_city_blocks(target, iter(cut_blocks(model, ends)), crs="EPSG:28992", bounds=BOUNDS)
        assert notes == ()
        written.append(target.read_bytes())
    assert len(set(written)) == 1
    document = json.loads(written[0])
    assert file_faults(document) == set()
    assert set().union(*solid_faults(document).values()) == set()
    assert document["CityObjects"]["x"]["children"] == ["h0", "h6"]
    assert [document["CityObjects"][name]["attributes"]["row"] for name in model.ids] == list(range(11))
    back = read_city_model(target)
    assert shapely.equals_exact(back.polygons, model.polygons, 0.001).all()
    # One line an object and one a vertex; the identifier is that of all of it.
    assert written[0].count(b"\n") == 13 + len(document["vertices"]) + 6
    write_city_model(target, model, crs="EPSG:28992", bounds=BOUNDS, attributes={"row": list(range(11))})
    assert target.read_bytes() == written[0]


def test_blocks_that_do_not_fit_together_leave_no_file(target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cityjson, "RUN", 2)
    model = make_model(*(translate(HOUSE, 40 * i, 0) for i in range(5)), ids=["a", "b", "c", "d", "a"])
    with pytest.raises(ValueError, match="1 of the buildings have the id of another one"):
        write_city_blocks(target, cut_blocks(model, [2]), crs="EPSG:28992", bounds=BOUNDS)
    model = replace(make_model(*model.polygons, ids=["a", "b", "c", "d", "e"]), house=np.array(list("abcda")))
    with pytest.raises(ValueError, match="building a: is a row and has parts"):
        write_city_blocks(target, cut_blocks(model, [2]), crs="EPSG:28992", bounds=BOUNDS)
    other = [(part, {"other": [0] * len(part)}) for part, _ in cut_blocks(model, [])]
    with pytest.raises(ValueError, match="blocks with the attributes"):
        write_city_blocks(target, [*cut_blocks(model, []), *other], crs="EPSG:28992", bounds=BOUNDS)
    assert list(target.parent.iterdir()) == []


def test_orientation_and_z_of_the_input_do_not_matter(target: Path) -> None:
    write(target, make_model(HOUSE, BLOCK))
    first = target.read_bytes()
    turned = [shapely.force_3d(shapely.orient_polygons(part, exterior_cw=True), 55.0) for part in (HOUSE, BLOCK)]
    town, _ = write(target, make_model(*turned))
    assert solid_faults(town) == {"b0": set(), "b1": set()}
    assert target.read_bytes() == first


def test_party_walls_share_their_vertices(target: Path) -> None:
    town, _ = write(target, make_model(HOUSE, translate(HOUSE, 10, 0)))
    assert len(town["vertices"]) == 2 * 6


@pytest.mark.parametrize(
    ("polygon", "corners"),
    [
        (shapely.Polygon([(0, 0), (9, 0), (9, 2e-4), (9, 9), (0, 9), (2e-4, 9)]), 4),
        (shapely.Polygon([(0, 0), (9, 0), (9, 9), (4.0002, 9), (4, 15), (3.9999, 9), (0, 9)]), 5),
        (shapely.Polygon([(0, 0), (9, 0), (9, 9), (0, 9)], [[(3, 3), (3.0002, 3), (3, 3.0002)]]), 4),
    ],
    ids=["corners-merge", "spike-vanishes", "courtyard-vanishes"],
)
def test_rounding_leaves_no_degenerate_face(target: Path, polygon: shapely.Polygon, corners: int) -> None:
    town, notes = write(target, make_model(polygon), bounds=(0, 0, 0, 10, 10, 20))
    assert file_faults(town) == set()
    assert solid_faults(town) == {"b0": set()}
    (ring,) = town["CityObjects"]["b0"]["geometry"][0]["boundaries"][0]
    assert len(ring) == corners
    assert notes == ()


def test_what_cannot_be_written_as_it_is_gets_a_note(target: Path) -> None:
    crumb = shapely.Polygon([(5, 5), (5.0003, 5), (5, 5.0003)])
    neck = shapely.union(shapely.box(20, 0, 30, 10), shapely.box(20, 20, 30, 31))
    neck = shapely.union(neck, shapely.box(25, 9, 25.0002, 21))
    flat = shapely.box(40, 0, 50, 10)
    pinched = shapely.Polygon(shapely.box(60, 0, 70, 10).exterior.coords, [[(60, 5), (65, 2), (68, 5), (65, 8)]])
    model = make_model(crumb, neck, flat, pinched, roof=[9.0, 9.0, 0.7004, 9.0])
    town, notes = write(target, model, bounds=(0, 0, 0, 100, 100, 20))
    assert [(note.kind, note.subject) for note in notes] == [
        ("footprint-split", "b1"),
        ("footprint-lost", "b0"),
        ("solid-touching", "b3"),
        ("solid-flat", "b2"),
    ]
    assert file_faults(town) == set()
    assert solid_faults(town) == {"b1": set(), "b3": set()}
    assert set(check_solids(town)["b3", "1.2"]) == set()
    lods = [[part["lod"] for part in item["geometry"]] for item in town["CityObjects"].values()]
    assert lods == [[], ["0", "1.2"], ["0"], ["0", "1.2"]]
    again = read_city_model(target).polygons
    assert shapely.area(again).tolist() == pytest.approx([0, 110, 100, 100 - 24])
    assert (notes[3].x, notes[3].y, notes[3].detail) == (40.0, 0.0, "roof 0.700 m, ground 0.700 m")


@pytest.mark.parametrize("crs", ["EPSG:7415", "urn:ogc:def:crs:EPSG::7415"])
def test_a_compound_crs_is_named(target: Path, crs: str) -> None:
    town, notes = write(target, make_model(HOUSE), crs=crs)
    assert town["metadata"]["referenceSystem"] == "https://www.opengis.net/def/crs/EPSG/0/7415"
    assert notes == ()


def test_a_prj_file_is_recognised(target: Path) -> None:
    town, _ = write(target, make_model(HOUSE), crs=pyproj.CRS(28992).to_wkt("WKT1_ESRI"))
    assert town["metadata"]["referenceSystem"] == "https://www.opengis.net/def/crs/EPSG/0/28992"


def test_a_crs_without_code_is_left_out_and_said(target: Path) -> None:
    crs = "+proj=tmerc +lat_0=1.5 +lon_0=7 +k=1 +x_0=0 +y_0=0 +ellps=GRS80 +units=m"
    town, notes = write(target, make_model(HOUSE), crs=crs)
    assert "referenceSystem" not in town["metadata"]
    assert file_faults(town) == set()
    assert [note.kind for note in notes] == ["crs-without-epsg"]


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        (make_model(HOUSE, INNER, ids=["a", "a"]), {}, "building a: 2 buildings have this id"),
        (make_model(shapely.MultiPolygon([HOUSE])), {}, "building b0: its footprint is a MultiPolygon"),
        (make_model(None), {}, "building b0: its footprint is a nothing"),
        (make_model(HOUSE, INNER, roof=[9, np.nan]), {}, "building b1: ground 0.7 m and roof nan m"),
        (make_model(HOUSE), {"bounds": (0, 0, 1, 1)}, "6 finite numbers"),
        (make_model(HOUSE), {"bounds": (0, 0, 0, 1, 1, np.inf)}, "6 finite numbers"),
        (make_model(HOUSE), {"attributes": {"a": [1, 2]}}, "attribute 'a' has 2 values for 1 buildings"),
        (make_model(HOUSE), {"attributes": {"height": [1]}}, "attribute 'height' is one of ours"),
    ],
)
def test_wrong_arguments_leave_no_file(
    target: Path, model: CityModel, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        write(target, model, **options)
    assert list(target.parent.iterdir()) == []


def test_an_unknown_crs_says_what_to_give(target: Path) -> None:
    with pytest.raises(ConfigError, match="CRS 'Amersfoort-ish': unknown to pyproj; give a code"):
        write(target, make_model(HOUSE), crs="Amersfoort-ish")


def test_a_folder_in_the_way_leaves_nothing_behind(target: Path) -> None:
    target.mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        write(target, make_model(HOUSE))
    assert list(target.parent.iterdir()) == [target]


SOLID = ["CityObjects", "b1", "geometry", 1]


def turned_over(town: dict[str, Any], face: int) -> list[list[int]]:
    rings: list[list[int]] = town["CityObjects"]["b1"]["geometry"][1]["boundaries"][0][face]
    return [ring[::-1] for ring in rings]


@pytest.mark.parametrize(
    ("place", "value", "fault"),
    [
        (["version"], "1.1", "schema"),
        (["transform"], {"scale": [0.001] * 3}, "schema"),
        (["metadata", "referenceSystem"], "EPSG:28992", "schema"),
        (["CityObjects", "b1", "attributes", "number"], 1.5, "schema"),
        ([*SOLID, "lod"], 1.2, "schema"),
        ([*SOLID, "boundaries", 0, 2, 0, 0], 10**6, "vertex out of range"),
        (["vertices", 1], [1, 2, 3], "duplicate vertex"),
        (["CityObjects", "b0", "geometry"], [], "unused vertex"),
        ([*SOLID, "semantics", "values", 0], [0, 1, 2, 2, 2], "semantics do not match the faces"),
    ],
)
def test_the_file_rules_see_each_fault(town: dict[str, Any], place: list[Any], value: Any, fault: str) -> None:
    if fault == "duplicate vertex":
        value = town["vertices"][0]
    assert file_faults(broken(town, place, value)) == {fault}


@pytest.mark.parametrize(
    ("place", "value", "fault"),
    [
        ([*SOLID, "boundaries", 0, 2], "turned", "shell not a closed 2-manifold"),
        ([*SOLID, "boundaries", 0, 0], "turned", "semantics do not fit the normal"),
        ([*SOLID, "semantics", "values", 0, 0], 1, "semantics do not fit the normal"),
        ([*SOLID, "boundaries", 0, 2, 0, 0], 0, "face not planar"),
        ([*SOLID, "boundaries", 0, 2, 0], [0, 0, 1, 1], "corner repeated"),
        ([*SOLID, "boundaries", 0, 2, 0], [0, 1, 0, 1], "face without area"),
        (["CityObjects", "b1", "attributes", "roof_height"], 12.4, "face not at its height"),
        (["CityObjects", "b1", "attributes", "height"], 12.4, "volume is not area times height"),
    ],
)
def test_the_solid_rules_see_each_fault(town: dict[str, Any], place: list[Any], value: Any, fault: str) -> None:
    if value == "turned":
        value = turned_over(town, place[-1])
    found = solid_faults(broken(town, place, value))
    assert fault in found["b1"]
    assert found["b0"] == found["b2"] == set()


@settings(max_examples=examples(40), deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    corners=st.integers(3, 9),
    size=st.floats(0.01, 50),
    height=st.floats(0.01, 300),
)
def test_any_star_shaped_house_is_a_valid_solid(
    tmp_path_factory: pytest.TempPathFactory, seed: int, corners: int, size: float, height: float
) -> None:
    rng = np.random.default_rng(seed)
    turn = np.sort(rng.uniform(0, 2 * np.pi, corners)) + np.arange(corners) * 0.1
    reach = size * rng.uniform(0.3, 1, corners)
    polygon = shapely.Polygon(np.column_stack([reach * np.cos(turn), reach * np.sin(turn)]) + 121100.0)
    if not polygon.is_valid:
        polygon = shapely.convex_hull(polygon)
    target = tmp_path_factory.mktemp("star") / "citymodel.city.json"
    town, notes = write(target, make_model(polygon, roof=0.7 + height))
    assert file_faults(town) == set()
    if not notes:
        assert solid_faults(town) == {"b0": set()}


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 2**32 - 1), grid=st.sampled_from([0.001, 0.05, 0.25]), steps=st.booleans())
def test_corners_are_where_the_noded_overlay_rounds_them_to(seed: int, grid: float, steps: bool) -> None:
    rng = np.random.default_rng(seed)
    polygons = []
    for corners in rng.integers(3, 12, 30).tolist():
        turn = np.sort(rng.uniform(0, 2 * np.pi, corners))
        ring = 3 * np.column_stack([np.cos(turn), np.sin(turn)]) * rng.uniform(0.3, 1, (corners, 1)) + 121100.0
        polygon = shapely.Polygon(np.rint(ring * 8) / 8 if steps else ring)  # an eighth is half of the last grid
        hole = shapely.box(121099.9, 121099.9, 121100.2, 121100.1)
        if corners % 4 == 0 and polygon.is_valid:
            polygon = polygon.difference(hole)
        polygons.append(polygon if isinstance(polygon, shapely.Polygon) and polygon.is_valid else hole)
    model, origin = make_model(*polygons, *shapely.reverse(polygons)), np.array([121000.0, 121000.0, 0.0])
    levels, _ = build_solids(model, origin, grid=grid)
    found = levels.vertices[levels.footprints.low, :2]
    expected = shapely.set_precision(model.polygons, grid)
    parts = [max(shapely.get_parts(polygon), key=shapely.area, default=polygon) for polygon in expected]
    rings = shapely.get_rings(shapely.orient_polygons(np.array(parts)))
    xy = np.concatenate([shapely.get_coordinates(ring)[1:] for ring in rings])
    assert found.tolist() == np.rint((xy - origin[:2]) / grid).astype(int).tolist()


def test_real_footprints_make_valid_solids(shared_data: Path, target: Path) -> None:
    import pyogrio

    _, _, blobs, _ = pyogrio.raw.read(shared_data / "amsterdam" / "footprints.gpkg", columns=[])
    parts = shapely.get_parts(shapely.make_valid(shapely.from_wkb(blobs)))
    polygons = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON][::7]
    town, notes = write(target, make_model(*polygons))
    assert file_faults(town) == set()
    touching = {note.subject for note in notes if note.kind == "solid-touching"}
    found = solid_faults(town)
    assert len(found) == len(polygons) - sum(note.kind == "footprint-lost" for note in notes)
    assert not any(found.values())
    assert len(touching) < 0.02 * len(polygons)
