"""Tiled runs as a whole: tiles depend on their halo alone and on no order, the city model on no tiles."""

import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import shapely
from shapely import affinity

from pipeline.data.classes import BUILDING
from pipeline.data.mesh import Marker
from stitch.seams.tiles import tile_halo
from tests.helpers.campaigns import keep_outcome, rounds
from tests.helpers.cities import crowded_blocks
from tests.helpers.tiles import (
    SIZE,
    Town,
    X,
    Y,
    around,
    box,
    comb,
    hash_files,
    make_town,
    prove,
    prove_local,
    put_beside,
    run_of,
    shape_city,
    shuffle_inputs,
    terraces,
    write_town,
)
from tiler.config.config import make_config
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.vtk_files import read_vtp
from tiler.pointclouds import clouds, las_chunks
from tiler.stages.surroundings import terrain_halo
from tiler.store.store import Store

TILE = (2272, 45708)
WEST, SOUTH = TILE[0] * SIZE, TILE[1] * SIZE  # its corner, close to (X, Y)
# The first and the last are held as close as they reach, the others in a region that is much larger.
WAYS = [("adaptive", "clearance"), ("layered", "clearance"), ("adaptive", "paper"), ("layered", "paper")]


def reach_of(values: dict[str, Any]) -> float:
    """How far beyond a tile anything counts for it (tiles), houses of up to 50 m across."""
    config = make_config(values)
    halo = tile_halo(config.tile_size, config.mesh_size)
    return (halo + max(terrain_halo(config), 50.0)) / config.tile_size


def test_a_file_read_in_shares_is_the_same_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Buildings are marked in the first shares of a file alone, and a damaged share takes the file with it."""
    region = box(2 * SIZE, SIZE)
    values = write_town(tmp_path / "city", make_town(region, terraces(region, seed=2), relief=3), files=(2, 1))
    for path in (tmp_path / "city" / "tiles").iterdir():
        las = laspy.read(path)
        above = np.flatnonzero(las.classification == BUILDING)[::3]  # a roof, if the file marked none
        las.classification[above], las.z[above] = 1, las.z[above] + 4
        las.points = las.points[np.argsort(-np.array(las.classification, int), kind="stable")]
        las.write(path.with_suffix(".las"))
        path.unlink()
        if path.stem == "1_0":  # the last point lies 100 km away, which the header does not say
            with path.with_suffix(".las").open("r+b") as file:
                file.seek(-las.point_format.size, os.SEEK_END)
                file.write((10_000_000).to_bytes(4, "little"))
    values |= {"tile_size": SIZE, "skip_unreadable": True, "bounds": region}
    whole = run_of(values, tmp_path / "whole")
    monkeypatch.setattr(clouds, "SHARE_POINTS", 5000)
    monkeypatch.setattr(las_chunks, "SOME_POINTS", 1000)
    shared = run_of(values, tmp_path / "shared")
    assert len(Store(tmp_path / "shared" / "store.zarr").names("points")) == 8
    assert shared["unreadable"].keys() == whole["unreadable"].keys() != set()
    assert shared["counts"] == whole["counts"]
    found, expected = (
        hash_files(tmp_path / name, besides=lambda path: "store.zarr" in path.parts)
        for name in ("shared", "whole")
    )
    assert found == expected


@pytest.mark.parametrize(("mesher", "simplify"), [WAYS[0], pytest.param(*WAYS[3], marks=pytest.mark.long)])
def test_a_tile_depends_on_its_surroundings_alone(mesher: str, simplify: str, tmp_path: Path) -> None:
    region = around(TILE, 2)
    town = make_town(region, crowded_blocks(region, 100, seed=5), relief=10)
    values = write_town(tmp_path / "city", town, files=(2, 2)) | {"mesher": mesher, "simplify": simplify}
    values |= {"tile_size": SIZE, "domain_height": 50.0 if mesher == "adaptive" else 38.0}
    least = 1.0 if mesher == "adaptive" else 1.5
    assert reach_of(values) < least
    prove_local(values, TILE, tmp_path, around(TILE, least + 0.1), around(TILE, least))


@pytest.mark.long
@pytest.mark.parametrize(("mesher", "simplify"), WAYS[1:3])
def test_a_tile_in_a_large_region_is_that_in_a_small_one(mesher: str, simplify: str, tmp_path: Path) -> None:
    region = around(TILE, 3)
    town = make_town(region, crowded_blocks(region, 700, seed=6), relief=30)
    values = write_town(tmp_path / "city", town, files=(3, 2)) | {"mesher": mesher, "simplify": simplify}
    values |= {"tile_size": SIZE, "domain_height": 50.0}
    least = 1 if mesher == "adaptive" else 2
    assert reach_of(values) < least
    prove_local(values, TILE, tmp_path, *(around(TILE, by) for by in (3, least)))


@pytest.mark.long
@pytest.mark.shared
def test_a_tile_of_real_blocks_depends_on_its_surroundings_alone(shared_data: Path, tmp_path: Path) -> None:
    """The data is too small for the layered mesher's reach, and has clusters that reach farther when merged."""
    values = {
        "pointcloud": [str(shared_data / "amsterdam" / "tiles")],
        "footprints": str(shared_data / "amsterdam" / "footprints.shp"),
        "crs": "EPSG:28992",
        "tile_size": SIZE,
        "domain_height": 50.0,
    }
    tile = (863, 3472)
    assert reach_of(values) < 1
    prove_local(values, tile, tmp_path, (120625.0, 485937.0, 121250.0, 486523.0), around(tile, 1))


# Order and workers.


def small_city(folder: Path) -> dict[str, Any]:
    """Four tiles in six files, with blocks on the lines between them."""
    region = box(280, 280)
    town = make_town(region, crowded_blocks(region, 45, seed=1), relief=15)
    return write_town(folder, town, files=(3, 2)) | {"tile_size": SIZE, "domain_height": 50.0}


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, str]]:
    """The small city, and the hashes of all files of its run without workers."""
    folder = tmp_path_factory.mktemp("city")
    values = small_city(folder / "city")
    run_of(values, folder / "out")
    return values, hash_files(folder / "out")


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.long), 2])
def test_workers_leave_the_same_files(
    city: tuple[dict[str, Any], dict[str, str]], workers: int, tmp_path: Path
) -> None:
    values, hashes = city
    run_of(values, tmp_path, workers=workers)
    assert hash_files(tmp_path) == hashes
    assert len([name for name in hashes if name.startswith("mesh/")]) == 4


class AnyOrder:
    """In place of heapq in the engine: of the tasks that may run, any is taken."""

    def __init__(self, seed: int) -> None:
        self.rng, self.jumps = random.Random(seed), 0

    def heapify(self, ready: list[Any]) -> None:
        """Leave them as they are."""

    def heappush(self, ready: list[Any], entry: Any) -> None:
        ready.append(entry)

    def heappop(self, ready: list[Any]) -> Any:
        place = self.rng.randrange(len(ready))
        self.jumps += ready[place] != min(ready)
        return ready.pop(place)


def test_any_order_of_files_and_tasks_leaves_the_same_files(
    city: tuple[dict[str, Any], dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values, hashes = city
    order = AnyOrder(1)
    monkeypatch.setattr("tiler.engine.schedule.heapq", order)
    files = sorted(Path(values["pointcloud"][0]).iterdir(), reverse=True)
    run_of(values | {"pointcloud": [str(path) for path in files]}, tmp_path)
    assert hash_files(tmp_path) == hashes
    assert order.jumps > 20


def test_shuffled_points_and_footprints_give_the_same_mesh(
    city: tuple[dict[str, Any], dict[str, str]], tmp_path: Path
) -> None:
    """Rows of all inputs in another order, and files with other names: only the store's copies of them differ."""
    values, hashes = city
    shuffled = shuffle_inputs(values, tmp_path / "city", seed=2)
    run_of(values | shuffled, tmp_path / "out")
    found = hash_files(tmp_path / "out")
    results = {name for name in hashes if not name.startswith("store.zarr")}
    assert len(results) > 10
    assert {name: found[name] for name in results} == {name: hashes[name] for name in results}
    here, there = (
        Store(tmp_path / "out" / "store.zarr"),
        Store(Path(values["footprints"]).parent.parent / "out" / "store.zarr"),
    )
    for stage in ("columns", "terrain"):
        for name in there.names(stage):
            expected, arrays = there.read(stage, name)[0], here.read(stage, name)[0]
            assert {key: array.tobytes() for key, array in arrays.items()} == {
                key: array.tobytes() for key, array in expected.items()
            }


# Regions.


Case = tuple[Town, dict[str, Any], dict[str, Any]]


def without(columns: int, rows: int, gone: list[tuple[int, int]]) -> dict[str, Any]:
    """Files in columns and rows, but some."""
    return {"files": (columns, rows), "without": gone}


def hole() -> Case:
    """Nine files, the one in the middle is not there."""
    region = box(420, 420, west=WEST, south=SOUTH)
    return (
        make_town(region, crowded_blocks(region, 90, seed=3), relief=20),
        {"files": (3, 3), "without": [(1, 1)]},
        {},
    )


def ell() -> Case:
    """Three of four files."""
    region = box(280, 280, west=WEST, south=SOUTH)
    return (
        make_town(region, crowded_blocks(region, 50, seed=4), relief=20),
        {"files": (2, 2), "without": [(1, 1)]},
        {},
    )


def corner_to_corner() -> Case:
    """Two files that touch in a corner."""
    region = box(280, 280, west=WEST, south=SOUTH)
    return (make_town(region, crowded_blocks(region, 50, seed=5), relief=20), without(2, 2, [(0, 1), (1, 0)]), {})


def single_row() -> Case:
    """A row of tiles that are lower than wide."""
    region = box(420, 80)
    return make_town(region, crowded_blocks(region, 25, seed=2), relief=20), {}, {}


def one_tile() -> Case:
    """A region within a tile."""
    region = box(150, 130)
    return make_town(region, crowded_blocks(region, 15, seed=1), relief=10), {}, {}


def one_house() -> Case:
    """A house in one tile and none in the others."""
    return make_town(box(420, 140), [shapely.box(X + 30, Y + 30, X + 50, Y + 50)], relief=20), {}, {}


def lake() -> Case:
    """A file in the middle without a point in a whole tile and beyond, houses in it and on its shore."""
    region = box(420, 420, west=WEST, south=SOUTH)
    dry = shapely.Point(WEST + 210, SOUTH + 210).buffer(130)
    return make_town(region, crowded_blocks(region, 60, seed=6), relief=30), {"lake": dry}, {}


def hall() -> Case:
    """A hall with a yard, larger than a tile, over several of them."""
    region = box(420, 300)
    yard = shapely.box(X + 170, Y + 110, X + 230, Y + 160)
    large = affinity.rotate(shapely.box(X + 90, Y + 60, X + 330, Y + 235) - yard, 9)
    return make_town(region, put_beside(crowded_blocks(region, 60, seed=7), large), relief=10), {}, {}


def on_corners() -> Case:
    """Blocks on the corners of tiles, houses on the lines between them."""
    west, south = WEST, SOUTH
    blocks = [
        shapely.box(west + x - 20, south + y - 15, west + x + 20, south + y + 18)
        for x in (140, 280)
        for y in (140,)
    ]
    turned = affinity.rotate(shapely.box(west + 61, south + 131, west + 79, south + 149), 31)
    return make_town(box(420, 280, west=west, south=south), [*blocks, turned], relief=20), {}, {}


def negative() -> Case:
    """Coordinates below zero, and the origin within."""
    region = box(280, 280, west=-170.0, south=-150.0)
    return make_town(region, crowded_blocks(region, 50, seed=8), relief=20), {}, {}


def odd_sizes() -> Case:
    """Bounds and tile size that share no divisor."""
    region = box(330, 310, west=X + 13, south=Y + 29)
    bounds = [X + 14.25, Y + 30.5, X + 340.75, Y + 337.125]
    return (
        make_town(region, crowded_blocks(region, 60, seed=9), relief=20),
        {},
        {"tile_size": 143.7, "bounds": bounds},
    )


def clipped() -> Case:
    """Terraces clipped at the border."""
    region = box(300, 300)
    bounds = [X + 31, Y + 37, X + 270, Y + 261]
    return make_town(region, terraces(region, seed=3), relief=15), {}, {"border": "clip", "bounds": bounds}


def clipped_at_hole() -> Case:
    """Terraces clipped at a hole in the region."""
    region = box(420, 420, west=WEST, south=SOUTH)
    return make_town(region, terraces(region, seed=3), relief=15), without(3, 3, [(1, 1)]), {"border": "clip"}


def merged_at_hole() -> Case:
    """Houses merged to hulls around the corner of a hole in the region, which cut that corner."""
    region = box(280, 280, west=WEST, south=SOUTH)
    x, y = WEST + 140, SOUTH + 140
    houses = [shapely.box(x - 12, y + 3, x + 2, y + 9), shapely.box(x + 2.4, y - 12, x + 9, y + 2.6)]
    others = {"border": "clip", "simplify": "paper"}
    return (
        make_town(region, [*houses, shapely.box(x + 40, y + 40, x + 60, y + 55)]),
        without(2, 2, [(0, 0)]),
        others,
    )


def manifold() -> Case:
    """Terraces without houses that touch in a point."""
    region = box(290, 290)
    return make_town(region, terraces(region, seed=4), relief=15), {}, {"manifold": True}


def combs() -> Case:
    """Houses of thin walls across tiles, simplified by their closed outlines."""
    west, south = WEST, SOUTH
    region = box(280, 280, west=west, south=south)
    houses = put_beside(terraces(region, seed=5), comb(west + 131, south + 60), comb(west + 129, south + 131))
    return make_town(region, houses, relief=15), {}, {}


def no_houses() -> Case:
    """Footprints elsewhere only."""
    region = box(280, 280)
    bounds = [X + 100, Y + 10, X + 279, Y + 279]
    return (
        make_town(region, [shapely.box(X + 10, Y + 10, X + 20, Y + 20)], relief=20),
        {},
        {"bounds": bounds, "allow_empty": True},
    )


REGIONS = [
    hole, ell, corner_to_corner, single_row, one_tile, one_house, lake, hall, on_corners, negative, odd_sizes,
    clipped, clipped_at_hole, merged_at_hole, manifold, combs, no_houses,
]  # fmt: skip
EVERYDAY = [(ell, "adaptive"), (negative, "layered"), (corner_to_corner, "adaptive")]


def region_cases() -> list[Any]:
    """All regions with the meshers in turn, and the everyday ones; in a campaign, with either."""
    both = [(make, mesher) for make in REGIONS for mesher in ("adaptive", "layered")]
    some = [case for k, case in enumerate(both) if case in EVERYDAY or k % 4 in (0, 3)]
    found = []
    for make, mesher in rounds(some, [case for case in both if case not in some]):
        marks = [] if (make, mesher) in EVERYDAY else [pytest.mark.long]
        found.append(pytest.param(make, mesher, marks=marks, id=f"{make.__name__}-{mesher}"))
    return found


@pytest.mark.parametrize(("make", "mesher"), region_cases())
def test_any_region_is_proved(make: Callable[[], Case], mesher: str, tmp_path: Path) -> None:
    town, files, others = make()
    values = write_town(tmp_path / "city", town, **files)
    record = run_of(
        values, tmp_path / "out", **{"tile_size": SIZE, "domain_height": 50.0, "mesher": mesher} | others
    )
    report = prove(tmp_path / "out")
    # Points have as many ids as places, in corners where two tiles meet alone too.
    assert open_pieces(tmp_path / "out").n_points == record["counts"]["points"]
    absent = len(files.get("without", ()))
    assert (report.facts["missing_facets"] > 0) == (absent > 0)
    tiles = [path.stem for path in (tmp_path / "out" / "mesh").iterdir()]
    if absent:
        assert len(tiles) == np.prod(files["files"]) - absent
        prove_straight(tmp_path / "out", tiles)
        gone = "building-beyond-region" if make is merged_at_hole else "footprint-on-border"
        assert any(kind.startswith(gone) for kind in record["notes"])
    if others.get("manifold"):
        assert record["counts"]["planar corner-touches"] == 0
    if make is combs:
        assert record["notes"]["building-outline-closed"]["count"] == 2
    if not absent and "bounds" not in others:
        assert record["counts"]["buildings"] >= len(town.polygons)


def prove_straight(out: Path, tiles: list[str]) -> None:
    """Facets of the class missing stand on the nominal lines of the grid."""
    for tile in tiles:
        piece = read_vtp(out / "boundary" / f"{tile}.vtp")
        corners = piece.points[piece.boundary.facets[piece.boundary.marker == Marker.MISSING]][..., :2]
        off = np.abs(corners - np.rint(corners / SIZE) * SIZE).max(axis=1).min(axis=1)
        assert (off == 0).all()


REAL = [
    ("amsterdam_no_building_class", "amsterdam/footprints.shp", (200.0,)),
    ("amsterdam_west_small", "amsterdam_west_small/footprints.gpkg", (150.0, 260.0)),
]


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.parametrize(("clouds", "footprints", "sizes"), REAL, ids=[real[0] for real in REAL])
def test_real_data_in_tiles_is_proved(
    shared_data: Path, clouds: str, footprints: str, sizes: tuple[float, ...], tmp_path: Path
) -> None:
    values = {
        "pointcloud": [str(shared_data / clouds / "tiles")],
        "footprints": str(shared_data / footprints),
        "crs": "EPSG:28992",
    }
    for size in sizes:
        record = run_of(values, tmp_path / str(size), tile_size=size, domain_height=80.0)
        assert record["exit_code"] == 0
        prove(tmp_path / str(size))


def test_points_that_only_a_failed_tile_has_are_not_counted(tmp_path: Path) -> None:
    """Where a seam goes along walls, the tile on the side of the roofs has no point on the ground before them."""
    region = box(280, 140, west=WEST, south=SOUTH)
    tower = shapely.box(WEST + 200, SOUTH + 60, WEST + 220, SOUTH + 80)
    houses = np.array([*put_beside(terraces(region, seed=1), tower)], object)
    heights = np.append(np.full(len(houses) - 1, 10.0), 45.0)
    values = write_town(tmp_path / "city", Town(region, houses, heights, 0.0), files=(2, 1))
    record = run_of(values, tmp_path / "out", tile_size=SIZE, domain_height=30.0)
    pieces = [path.stem for path in (tmp_path / "out" / "mesh").iterdir()]
    assert (record["exit_code"], pieces, len(record["missing"])) == (3, [f"{TILE[0]}_{TILE[1]}"], 1)
    assert open_pieces(tmp_path / "out").n_points == record["counts"]["points"]
    prove(tmp_path / "out")


# The city model.


def terrace_city(folder: Path, size: float, *, seed: int) -> dict[str, Any]:
    """Terraces with two combs, one of them on the corner of four tiles of 70 m."""
    west, south = (np.ceil(place / 70) * 70 for place in (X, Y))
    region = box(size, size, west=west - 65, south=south - 60)
    middle = comb(west - 12, south - 8)
    houses = put_beside(terraces(region, seed=seed), middle, comb(west + size - 95, south - 50))
    return write_town(folder, make_town(region, houses, relief=15), files=(2, 2))


def prove_same_model(values: dict[str, Any], folder: Path, sizes: list[float]) -> list[tuple[list[int], int]]:
    """Prove that the city models are the same, byte for byte; tells of each how many clusters were joined."""
    told, first = [], ""
    for size in sizes:
        out = folder / f"{size:g}"
        told.append(shape_city(values | {"tile_size": size}, out))
        hashes = hash_files(out, besides=lambda path: "store.zarr" in path.parts)
        assert len(hashes) == 2
        first = first or str(hashes)
        assert str(hashes) == first, f"tiles of {size:g} m"
    return told


def test_the_city_model_knows_no_tiles(tmp_path: Path) -> None:
    """Clusters that span tiles, are joined in later rounds, and have houses that are closed."""
    values = terrace_city(tmp_path / "city", 150, seed=18) | {"mesh_size": 5.0}
    told = prove_same_model(values, tmp_path, [5000.0, 70.0])
    rounds, closed = told[0]
    assert told[1] == told[0]
    assert sum(rounds) > 0
    assert closed == 2


def test_the_merged_city_model_knows_no_tiles(tmp_path: Path) -> None:
    """The paper's way needs several rounds."""
    values = terrace_city(tmp_path / "city", 130, seed=0) | {"mesh_size": 5.0, "simplify": "paper"}
    told = prove_same_model(values, tmp_path, [5000.0, 70.0])
    assert told[1] == told[0]
    assert len(told[0][0]) > 2


@pytest.mark.long
@pytest.mark.parametrize("simplify", ["clearance", "paper"])
@pytest.mark.parametrize("seed", [2, 6])
def test_the_model_of_a_large_town_knows_no_tiles(tmp_path: Path, seed: int, simplify: str) -> None:
    values = terrace_city(tmp_path / "city", 400, seed=seed) | {"mesh_size": 5.0, "simplify": simplify}
    told = prove_same_model(values, tmp_path, [5000.0, 200.0, 75.0])
    assert told[0] == told[1] == told[2]
    assert sum(told[0][0]) > 0


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.parametrize("simplify", ["clearance", "paper"])
def test_the_model_of_real_blocks_knows_no_tiles_and_no_workers(
    shared_data: Path, tmp_path: Path, simplify: str
) -> None:
    values = {
        "pointcloud": [str(shared_data / "amsterdam" / "tiles")],
        "footprints": str(shared_data / "amsterdam" / "footprints.shp"),
        "crs": "EPSG:28992",
        "simplify": simplify,
    }
    prove_same_model(values, tmp_path, [5000.0, 200.0])
    run_of(values, tmp_path / "two", tile_size=300.0, workers=2)
    for name in ("citymodel.city.json", "citymodel-full.city.json"):
        assert (tmp_path / "two" / name).read_bytes() == (tmp_path / "200" / name).read_bytes()


# The campaign.


@pytest.mark.long
@pytest.mark.parametrize("seed", rounds(range(2), range(2, 50)))
def test_random_tiled_cities_are_meshed_and_proved(tmp_path: Path, seed: int) -> None:
    """Cities of any density, size of blocks and relief in 9 to 25 tiles, from files to files."""
    rng = np.random.default_rng(seed)
    mesh_size = float(rng.choice([6.0, 8.0, 10.0, 15.0]))
    tile_size = float(np.rint(mesh_size * rng.uniform(14, 16)))
    across = rng.uniform(3.05, 4.95, 2) * tile_size
    region = box(*np.rint(across).tolist(), west=X + float(rng.integers(500)), south=Y + float(rng.integers(500)))
    if rng.random() < 0.4:
        houses = terraces(region, seed=seed, angle=float(rng.uniform(0, 90)))
    else:
        n = int(rng.uniform(300, 1600) * across.prod() / 1e6)
        houses = crowded_blocks(region, n, seed=seed, clearance=float(rng.choice([0.2, 1.0])))
    files = tuple(rng.integers(1, 4, 2).tolist())
    town = make_town(region, houses, relief=float(rng.uniform(0, 40)), seed=seed)
    values: dict[str, Any] = write_town(tmp_path / "city", town, files=files) | {
        "domain_height": 80.0,
        "mesh_size": mesh_size,
        "tile_size": tile_size,
        "layer_height": float(rng.choice([4.0, 10.0])),
        "border": str(rng.choice(["drop", "clip"])),
        "mesher": str(rng.choice(["adaptive", "layered"])),
        "simplify": str(rng.choice(["clearance", "clearance", "paper"])),
        "manifold": bool(rng.random() < 0.2),
    }
    record = run_of(values, tmp_path / "out")
    prove(tmp_path / "out")
    counts, way = record["counts"], f"{values['mesher']}, {values['simplify']}"
    assert 9 <= counts["tiles"] <= 25
    assert counts["buildings"] > 0
    keep_outcome("cities", seed=seed, way=way, **{what: counts[what] for what in ("tiles", "buildings", "cells")})
