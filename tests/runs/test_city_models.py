"""A block of gabled houses of a city model on rasters of terrain: meshed without any point."""

import json
import shutil
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import rasterio
import shapely
from rasterio.transform import Affine

import tiler
from pipeline.data.errors import ConfigError, InputError
from tests.helpers.tiles import write_footprints
from tests.runs.test_run import hashes
from tests.tiler.cityinput.models import (
    CORNERS,
    FACES,
    PLACE,
    city_json,
    solid,
    write_gml,
    write_json,
    write_sequence,
)
from tiler.check.check import check_run
from tiler.config.config import make_config
from tiler.store.results import StoredTerrain
from tiler.store.store import Store
from tiler.workflow.run import run

SIDE, PITCH = 4, 36.0  # houses in each direction, and metres from one to the next
SLOPE = 0.02  # of the terrain, eastwards


def ground_at(x: float) -> float:
    return 2.0 + SLOPE * (x - PLACE[0])


def corners_of(i: int, j: int) -> list[list[float]]:
    """Corners of a house, its roof at whole heights above the ground of its middle."""
    foot = round(ground_at(PLACE[0] + PITCH * i + 5), 3)
    return [[x + PITCH * i, y + PITCH * j, z - 2 + foot] for x, y, z in CORNERS]


def house(i: int, j: int) -> dict[str, Any]:
    return city_json({f"h{i}{j}": {"type": "Building", "geometry": [solid()]}}, corners_of(i, j))


def write_block(folder: Path) -> Path:
    return write_sequence(folder / "block.city.jsonl", [house(i, j) for i in range(SIDE) for j in range(SIDE)])


def write_terrain(folder: Path) -> list[str]:
    """A plane as two files side by side, with a hole of no height in one of them."""
    paths = []
    for k, west in enumerate((-60, 60)):
        x = PLACE[0] + west + 0.5 + np.arange(120 if k == 0 else 140)
        z = np.tile([ground_at(v) for v in x.tolist()], (250, 1)).astype(np.float32)
        if k == 0:
            z[:4, :4] = -9999
        paths.append(str(folder / f"t{k}.tif"))
        options = {"crs": "EPSG:28992", "transform": Affine(1, 0, PLACE[0] + west, 0, -1, PLACE[1] + 190)}
        with rasterio.open(
            paths[-1],
            "w",
            driver="GTiff",
            height=250,
            width=len(x),
            count=1,
            dtype="float32",
            nodata=-9999,
            **options,
        ) as file:
            file.write(z, 1)
    return paths


def parts_of(out: Path) -> dict[str, dict[str, Any]]:
    found = json.loads((out / "citymodel.city.json").read_text())["CityObjects"]
    return {name: one["attributes"] for name, one in found.items() if "roof_slope" in one.get("attributes", {})}


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path, dict[str, Any]]:
    """Configuration, folder of the results, and record."""
    folder = tmp_path_factory.mktemp("block")
    values = {
        "buildings": [str(write_block(folder))],
        "terrain": write_terrain(folder),
        "roofs": "planes",
        "mesh_size": 6.0,
        "tile_size": 90.0,
        "domain_height": 60.0,
    }
    out = folder / "out"
    return values, out, run(make_config(values | {"out": str(out)}))


def test_houses_keep_their_roofs_and_the_ground_is_that_of_the_rasters(
    block: tuple[dict[str, Any], Path, dict[str, Any]],
) -> None:
    _, out, record = block
    counts = record["counts"]
    assert record["exit_code"] == 0
    names = ("buildings", "roofs of a city model", "model buildings at level 2.2")
    assert [counts[name] for name in names] == [16, 16, 16]
    assert counts["tiles"] > 1
    assert check_run(out, StoredTerrain).ok
    parts = parts_of(out)
    assert len(parts) == 32
    assert {part["roof_method"] for part in parts.values()} == {"model"}
    slopes = np.array([part["roof_slope"] for part in parts.values()])
    assert slopes == pytest.approx(np.degrees(np.arctan(0.75)), abs=0.2)
    assert record["fidelity"]["roof"]["rmse"] < 0.05
    assert record["region"]["bounds"][0] == PLACE[0] - 20
    assert not [message for message in record["messages"] if "reaches beyond" in message]


def test_the_ground_is_that_of_the_rasters_everywhere(block: tuple[dict[str, Any], Path, dict[str, Any]]) -> None:
    _, out, record = block
    store = Store(out / "store.zarr")
    for name in store.names("terrain"):
        arrays, attributes = store.read("terrain", name)
        facts = attributes["facts"]
        x = [(facts["i0"] + k) * facts["spacing"] for k in range(facts["nx"])]
        assert np.abs(arrays["z"] - [ground_at(v) for v in x]).max() < 2.0**-12
    assert record["counts"]["terrain nodes filled"] == 0


def test_tiles_change_no_roof(block: tuple[dict[str, Any], Path, dict[str, Any]], tmp_path: Path) -> None:
    values, out, _ = block
    run(make_config(values | {"out": str(tmp_path), "tile_size": 400.0}))
    assert parts_of(tmp_path) == parts_of(out)


def test_an_edit_of_a_city_of_models_ends_in_the_mesh_of_the_final_model(
    block: tuple[dict[str, Any], Path, dict[str, Any]], tmp_path: Path
) -> None:
    values, out, _ = block
    city = shutil.copytree(out, tmp_path / "city")
    objects = [house(i, j) for i in range(SIDE) for j in range(SIDE) if (i, j) != (2, 1)]
    corners = [[x + 1.5, y - 1, z + 3] for x, y, z in corners_of(1, 1)]
    new = city_json({"h11": {"type": "Building", "geometry": [solid()]}}, corners)
    tiler.open(city).remove("h21").replace("h11", write_json(tmp_path / "new.city.json", new))
    assert parts_of(city)["h11-part1"]["roof_method"] == "model"
    assert check_run(city, StoredTerrain).ok
    objects[SIDE + 1] = new
    final = str(write_sequence(tmp_path / "final.city.jsonl", objects))
    run(make_config(values | {"buildings": [final], "out": str(tmp_path / "whole")}))
    made, whole = (hashes(tmp_path / name) for name in ("city", "whole"))
    assert {name: made[name] for name in whole if name.startswith(("mesh", "boundary"))} == {
        name: digest for name, digest in whole.items() if name.startswith(("mesh", "boundary"))
    }
    square = shapely.box(PLACE[0], PLACE[1], PLACE[0] + 8, PLACE[1] + 6)
    write_footprints(tmp_path / "flat.gpkg", np.array([square]), np.array(["h00"], np.object_), crs="EPSG:28992")
    with pytest.raises(InputError, match="h00 has no height"):
        tiler.open(city).replace("h00", tmp_path / "flat.gpkg")


def test_other_formats_give_the_same_bytes(
    block: tuple[dict[str, Any], Path, dict[str, Any]], tmp_path: Path
) -> None:
    values, out, _ = block
    content = ""
    for i in range(SIDE):
        for j in range(SIDE):
            surfaces = ""
            for kind, rings in FACES.items():
                for ring in rings:
                    places = [corners_of(i, j)[v] for v in [*ring, ring[0]]]
                    numbers = " ".join(f"{y + PLACE[1]:.3f} {x + PLACE[0]:.3f} {z:.3f}" for x, y, z in places)
                    surfaces += (
                        f"<bldg:boundedBy><bldg:{kind}><bldg:lod2MultiSurface><gml:MultiSurface><gml:surfaceMember>"
                        f"<gml:Polygon><gml:exterior><gml:LinearRing><gml:posList>{numbers}</gml:posList>"
                        "</gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember></gml:MultiSurface>"
                        f"</bldg:lod2MultiSurface></bldg:{kind}></bldg:boundedBy>"
                    )
            content += (
                f"<cityObjectMember><bldg:Building gml:id='h{i}{j}'>{surfaces}</bldg:Building></cityObjectMember>"
            )
    path = write_gml(tmp_path / "a.gml", content)  # the northing first, against its CRS
    record = run(make_config(values | {"buildings": [str(path)], "out": str(tmp_path / "out")}))
    assert "model-axes" in record["notes"]
    mesh = {name: value for name, value in hashes(out).items() if "mesh" in name}
    assert mesh
    assert {name: value for name, value in hashes(tmp_path / "out").items() if "mesh" in name} == mesh


def test_parts_of_a_roof_from_four_squares_of_the_clearance_on_are_kept(tmp_path: Path) -> None:
    document = house(0, 0)
    first = len(document["vertices"])
    for x, y, side in ((3.0, 1.5, 1.1), (7.0, 1.5, 0.9)):
        square = ((x, y), (x + side, y), (x + side, y + side), (x, y + side))
        document["vertices"] += [[round(1000 * a), round(1000 * b), 12_000] for a, b in square]
    document["CityObjects"]["h00"]["geometry"].append(
        {
            "type": "MultiSurface",
            "lod": "2.2",
            "boundaries": [[list(range(k, k + 4))] for k in (first, first + 4)],
            "semantics": {"surfaces": [{"type": "RoofSurface"}], "values": [0, 0]},
        }
    )
    path = write_json(tmp_path / "a.json", document)
    run(make_config({"buildings": [str(path)], "roofs": "planes", "out": str(tmp_path / "out")}))
    heights = sorted(part["roof_height"] for part in parts_of(tmp_path / "out").values())
    assert len(heights) == 3  # the larger stack is a part, the smaller one joined with the slope
    assert heights[-1] == 12.0


def test_without_terrain_the_ground_lies_at_the_feet_of_the_houses(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a.json", house(0, 0))
    record = run(make_config({"buildings": [str(path)], "roofs": "planes", "out": str(tmp_path / "out")}))
    assert (record["counts"]["buildings"], record["exit_code"]) == (1, 0)
    assert "model-ground" in record["notes"]
    assert check_run(tmp_path / "out", StoredTerrain).ok


def test_a_building_in_two_files_is_there_once_at_its_best_level(tmp_path: Path) -> None:
    one = write_json(tmp_path / "a.json", house(0, 0))
    low = house(0, 0)
    low["CityObjects"]["h00"]["geometry"][0]["lod"] = "1.2"
    other = write_json(tmp_path / "b.json", low)
    record = run(
        make_config({"buildings": [str(other), str(one)], "roofs": "planes", "out": str(tmp_path / "out")})
    )
    assert record["counts"]["footprints read"] == 1
    assert record["notes"]["model-in-two-files"]["items"][0]["subject"] == "h00"


def test_a_model_above_its_terrain_is_told_and_moved(
    block: tuple[dict[str, Any], Path, dict[str, Any]], tmp_path: Path
) -> None:
    values, out, _ = block
    high = [house(i, j) for i in range(SIDE) for j in range(SIDE)]
    for one in high:
        one["transform"]["translate"] = [*PLACE[:2], 6.0]
    path = write_sequence(tmp_path / "high.jsonl", high)
    lifted = values | {"buildings": [str(path)]}
    record = run(make_config(lifted | {"out": str(tmp_path / "told")}))
    assert record["notes"]["model-off-ground"]["count"] == 16
    (told,) = record["notes"]["model-shift"]["items"]
    assert "--shift-z -6.1" in told["detail"]  # ground is a low percentile of a slope
    record = run(make_config(lifted | {"shift_z": -6.0, "out": str(tmp_path / "moved")}))
    assert "model-shift" not in record["notes"]
    measured = run(make_config(lifted | {"shift_z": "auto", "out": str(tmp_path / "measured")}))
    (told,) = measured["notes"]["model-shifted"]["items"]
    assert told["detail"] == "city models were moved by -6.1 m onto the terrain, as measured at 16 buildings"
    assert measured["parameters"]["shift_z"] == "auto"
    fixed = run(make_config(lifted | {"shift_z": -6.1, "out": str(tmp_path / "fixed")}))
    assert hashes(tmp_path / "measured")["mesh.pvtu"] == hashes(tmp_path / "fixed")["mesh.pvtu"]
    assert measured["counts"] == fixed["counts"]
    again = run(make_config(lifted | {"shift_z": "auto", "out": str(tmp_path / "measured")}))
    assert again["tasks"]["ran"] == 0
    moved, parts = parts_of(tmp_path / "moved"), parts_of(out)
    assert moved.keys() == parts.keys()
    for name in ("roof_height", "roof_slope", "ground_height"):
        assert [moved[part][name] for part in parts] == pytest.approx([one[name] for one in parts.values()])


def write_points(path: Path, n: int) -> None:
    """Points of houses in a row, their roofs 0.3 m below those of the model, and of the ground around them."""
    x, y = (side.ravel() for side in np.meshgrid(np.arange(-19.5, PITCH * n - 6), np.arange(-19.5, 28)))
    number = np.floor((x + 13) / PITCH).clip(0, n - 1)
    on = (y > 0) & (y < 8) & (x > PITCH * number) & (x < PITCH * number + 10)
    ground = np.array([ground_at(v) for v in (PLACE[0] + x).tolist()])
    foot = np.array([ground_at(PLACE[0] + PITCH * k + 5) for k in number.tolist()])
    z = np.where(on, foot + 7.3 - 0.75 * np.abs(y - 4), ground)
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales, las.header.offsets = np.full(3, 0.001), np.array(PLACE)
    las.x, las.y, las.z = PLACE[0] + x, PLACE[1] + y, z
    las.classification = np.where(on, 6, 2)
    las.write(path)


def test_with_points_beside_it_the_model_has_the_roofs_and_points_tell_how_far_they_are(tmp_path: Path) -> None:
    path = write_sequence(tmp_path / "b.jsonl", [house(0, 0), house(1, 0)])
    write_points(tmp_path / "a.las", 2)
    values = {"pointcloud": [str(tmp_path / "a.las")], "buildings": [str(path)], "crs": "EPSG:28992"}
    record = run(make_config(values | {"roofs": "planes", "out": str(tmp_path / "out")}))
    assert record["counts"]["roofs of a city model"] == 2
    assert {part["roof_method"] for part in parts_of(tmp_path / "out").values()} == {"model"}
    assert record["fidelity"]["roof"]["bias"] == pytest.approx(-0.3, abs=0.1)
    assert record["fidelity"]["roof_fit"]["model"]["rmse"] == pytest.approx(0.3, abs=0.1)
    rmse = [part["roof_rmse"] for part in parts_of(tmp_path / "out").values()]
    assert rmse == pytest.approx([0.3] * 4, abs=0.1)  # the distance of model and points, by building
    assert check_run(tmp_path / "out", StoredTerrain).ok
    record = run(make_config(values | {"prefer": "points", "out": str(tmp_path / "points")}))
    assert {part["roof_method"] for part in parts_of(tmp_path / "points").values()} == {"planes"}
    assert abs(record["fidelity"]["roof"]["bias"]) < 0.05
    las = laspy.read(tmp_path / "a.las")
    las.points = las.points[(las.classification != 6) | (las.x > PLACE[0] + 20)]
    las.write(tmp_path / "a.las")  # of the first house no points are left
    run(make_config(values | {"prefer": "points", "out": str(tmp_path / "some")}))
    methods = {name.partition("-")[0]: part["roof_method"] for name, part in parts_of(tmp_path / "some").items()}
    assert methods == {"h00": "model", "h10": "planes"}


def test_footprints_beside_a_model_give_way_to_its_buildings(tmp_path: Path) -> None:
    path = write_sequence(tmp_path / "b.jsonl", [house(0, 0), house(1, 0)])
    write_points(tmp_path / "a.las", 3)
    boxes = {"h00": (2, 0, 14, 8), "h10": (9, 0, 19, 8), "new": (2 * PITCH, 0, 2 * PITCH + 10, 8)}
    polygons = shapely.transform(np.array([shapely.box(*b) for b in boxes.values()]), lambda xy: xy + PLACE[:2])
    values = {
        "pointcloud": [str(tmp_path / "a.las")],
        "buildings": [str(path)],
        "crs": "EPSG:28992",
        "mesh_size": 4.0,
    }
    cities = []
    for side, rows in ((60.0, [0, 1, 2]), (400.0, [2, 1, 0])):
        file, out = tmp_path / f"{side}.gpkg", tmp_path / f"{side}"
        write_footprints(file, polygons[rows], np.array(list(boxes), object)[rows], "EPSG:28992")
        given = {"footprints": str(file), "tile_size": side, "out": str(out), "domain_height": 40.0}
        record = run(make_config(values | given))
        assert record["counts"]["tiles"] == (1 if side == 400 else 2)
        assert record["counts"]["footprints read"] == 5
        told = {kind: one["items"] for kind, one in record["notes"].items() if kind.startswith("footprint-")}
        assert {kind: len(items) for kind, items in told.items()} == {
            "footprint-in-model": 1,
            "footprint-cut-by-model": 1,
            "footprint-id-repeated": 1,
            "footprint-roof-from-default": 1,
        }
        assert told["footprint-in-model"][0]["subject"] == "h00"
        cut = told["footprint-cut-by-model"][0]
        assert cut["detail"].startswith("8.00 of its 80.00 m2 are under buildings of the city model")
        parts = parts_of(out)
        methods = {name.partition("-part")[0]: part["roof_method"] for name, part in parts.items()}
        assert methods == {"h00": "model", "h10": "model", cut["subject"]: "flat", "new": "planes"}
        assert cut["subject"].startswith("h10-g")
        assert check_run(out, StoredTerrain).ok
        with pytest.raises(ConfigError, match="--footprints beside --buildings, which cannot be edited yet"):
            tiler.open(out).remove("new")
        cities.append(parts)
    assert cities[0] == cities[1]


def test_terrain_alone_is_meshed(block: tuple[dict[str, Any], Path, dict[str, Any]], tmp_path: Path) -> None:
    values, _, _ = block
    record = run(make_config({"terrain": values["terrain"], "mesh_size": 20.0, "out": str(tmp_path)}))
    assert record["counts"]["buildings"] == 0
    assert record["region"]["bounds"] == [PLACE[0] - 60, PLACE[1] - 60, PLACE[0] + 200, PLACE[1] + 190]


def test_what_does_not_go_together_is_refused(
    block: tuple[dict[str, Any], Path, dict[str, Any]], tmp_path: Path
) -> None:
    values, _, _ = block
    with pytest.raises(ConfigError, match="takes city models and rasters of terrain"):
        make_config(values | {"terrain": (), "shift_z": "auto"})
    with pytest.raises(ConfigError, match="beside a point cloud"):
        make_config(values | {"prefer": "points"})
    with pytest.raises(ConfigError, match="metres or 'auto' expected"):
        make_config(values | {"shift_z": "low"})
    far = house(0, 0)
    far["transform"]["translate"] = [200_000.0, 450_000.0, 0.0]
    path = write_json(tmp_path / "far.json", far)
    with pytest.raises(InputError, match="lie off all rasters of terrain"):
        run(make_config(values | {"buildings": [str(path)], "out": str(tmp_path / "out")}))
    with pytest.raises(InputError, match="no city model; --buildings takes these"):
        run(make_config(values | {"buildings": values["terrain"], "out": str(tmp_path / "out")}))
