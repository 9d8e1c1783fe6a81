"""Zones of detail in one run: levels by the points of houses, the focus as without, proved from the files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely

from pipeline.data.citymodel import Prisms
from pipeline.data.errors import ConfigError, InputError
from pipeline.data.mesh import Boundary, Marker
from tests.benchmarks.lod_zones import find_excess, measure
from tests.helpers.tiles import (
    CRS,
    hash_files,
    make_town,
    prove,
    put_roofs,
    run_of,
    shape_city,
    terraces,
    write_town,
)
from tiler.check.check_piece import read_piece
from tiler.check.proofs import Finding, join_findings, make_surface
from tiler.check.zone_proofs import (
    BLOCK_ROWS,
    CELL_ROWS,
    GivenBlocks,
    check_sizes_of_zones,
    check_zones,
    prove_sizes_of_zones,
    read_given_blocks,
    zone_finer,
)
from tiler.citymodels.tables import unpack_buildings
from tiler.config.config import make_config
from tiler.config.zones import LEVELS, LOD, LOD_POINT, Zones
from tiler.engine.executor import Serial
from tiler.pictures.picture_data import load_city, load_levels
from tiler.planning.forecast import forecast_run
from tiler.planning.lod_zones import read_zones
from tiler.planning.own_stages import OwnStages
from tiler.planning.plan import make_plan
from tiler.planning.region import Region
from tiler.store.kept import is_kept
from tiler.store.out_folder import CITY_MODEL, FULL_CITY_MODEL, RUN_RECORD, STORE
from tiler.store.results import StoredTerrain
from tiler.store.run_folder import CELLS_REPLACED, RoofRules, RunRecord, SizesAsked, read_run_record
from tiler.store.store import Store
from tiler.workflow.stage_sequence import make_engine

SIZE = 84.0  # m, of a tile: the least for cells of 6 m
WEST, SOUTH = 3786 * SIZE, 76179 * SIZE
BOUNDS = (WEST, SOUTH, WEST + 2 * SIZE, SOUTH + SIZE)
CENTRE = f"{WEST + SIZE:g},{SOUTH + SIZE / 2:g}"  # on the seam
ZONES = {"lod_zones": [f"{CENTRE},25,2.2,4.5", f"{CENTRE},50,1.3,6", "rest,1.2"]}


SIZES = {"tile_size": SIZE, "mesh_size": 6.0, "domain_height": 24.0}


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    houses = terraces(BOUNDS, seed=4)
    values = write_town(tmp_path_factory.mktemp("town"), put_roofs(make_town(BOUNDS, houses, seed=4), seed=4))
    return values | SIZES


def models(out: Path) -> dict[str, tuple[bytes, ...]]:
    """What the store has of each building part, by id."""
    rows = {}
    for tile in sorted((out / "store.zarr" / "model").iterdir()):
        model: Prisms = unpack_buildings(Store(out / "store.zarr").read("model", tile.stem)[0]).model
        wkb = shapely.to_wkb(model.polygons)
        for k, name in enumerate(model.ids.tolist()):
            roof = (model.roofs.plane, model.roofs.origin, model.roofs.limits, model.ground)
            rows[name] = (wkb[k], *(values[k].tobytes() for values in roof))
    return rows


def prove_levels(
    text: str,
    zones: Zones,
    out: Path,
    folder: Path,
    stated: dict[str, int] | None = None,
    *,
    lower: float = 0.0,
    clearance: float = 2.0,
    given: GivenBlocks | None = None,
) -> set[str]:
    """Faults of a city model in place of that of a run, as if blocks were given lower (m)."""
    (folder / CITY_MODEL).write_text(text)
    rules = RoofRules(raised=clearance, clearance=clearance)
    given = given or read_given_blocks(
        out / STORE, StoredTerrain(out / STORE), RunRecord("", BOUNDS, 0.0, {}, roofs=rules)
    )
    given = replace(given, rows={name: (row[0], row[1] - lower, *row[2:]) for name, row in given.rows.items()})
    proof = check_zones(zones, folder / CITY_MODEL, out / FULL_CITY_MODEL, stated, given)
    return {fault.kind for fault in proof.faults}


def test_zones_of_detail_are_one_mesh_and_proved(town: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "zones"
    record = run_of(town, out, **ZONES)
    prove(out)
    assert {f"parts at level {level}" for level in LEVELS[:3]} <= record["counts"].keys()
    shape_city(town | {"full_parts": False}, tmp_path / "full")
    divided, whole = ((folder / FULL_CITY_MODEL).read_text() for folder in (out, tmp_path / "full"))
    assert '"parents"' in divided
    assert '"parents"' not in whole
    mine, full = models(out), models(tmp_path / "full")
    text = (out / CITY_MODEL).read_text()
    objects = json.loads(text)["CityObjects"]
    told = {name: row["attributes"] for name, row in objects.items() if "attributes" in row}
    focus = [name for name, row in told.items() if row[LOD] == "2.2"]
    assert len(focus) > 10
    assert all(mine[name] == full[name] for name in focus)
    assert not all(mine[name] == full.get(name) for name in mine)
    city = load_city(out)
    level = {row["number"]: LEVELS.index(row[LOD]) for row in told.values()}
    shown = load_levels(out, city)
    built = city.building >= 0
    assert shown[built].tolist() == [level[number] for number in city.building[built].tolist()]
    assert set(shown[~built].tolist()) == {0, 1, 2}
    # A building of another level than its zone asks for, one without, and a point elsewhere are found.
    x, y = next(row[LOD_POINT] for row in told.values() if row[LOD] == "1.3")
    found = read_run_record(out / RUN_RECORD)
    zones = found.zones
    assert faults_of_sizes(out, found) == set()
    # A zone elsewhere, and one with smaller cells than it has, are found.
    shifted = shapely.to_wkb(shapely.box(*BOUNDS[:2], BOUNDS[0] + 40, BOUNDS[3]), hex=True)
    both = {"zone-too-coarse", "zone-too-tall"}
    assert faults_of_sizes(out, replace(found, zones=(("2.2", 3.5, shifted), *zones))) == both
    assert faults_of_sizes(out, replace(found, zones=(("2.2", 2.5, zones[0][2]), *zones[1:]))) == both
    assert faults_of_sizes(out, found, stretched=1.5) == {"zone-too-tall"}
    assert faults_of_sizes(out, found, stretched=0.4) == {"zone-too-low"}
    for was, now, kind in (
        (f'"{LOD}":"1.2"', f'"{LOD}":"1.3"', "level-of-zone"),
        (f'"{LOD}":"2.2"', f'"{LOD}":"1.2"', "level-parts"),
        (f'"{LOD}":"1.2",', "", "level-not-stated"),
        (f'"{LOD_POINT}":[{x!r},', f'"{LOD_POINT}":["a",', "level-not-stated"),
        (f'"{LOD_POINT}":[{x!r},{y!r}]', f'"{LOD_POINT}":[{x + 60!r},{y!r}]', "level-point"),
        (f'"{LOD}":"2.2"', f'"{LOD}":"1.3"', "level-roof"),
    ):
        assert was in text
        assert kind in prove_levels(text.replace(was, now), zones, out, tmp_path)


def faults_of_sizes(out: Path, record: RunRecord, stretched: float = 1.0) -> set[str]:
    """Faults of the sizes of zones in the pieces of a run, as if vertical edges were longer."""
    found = Finding()
    for path in sorted((out / "mesh").iterdir()):
        piece = read_piece(path, out / "boundary" / f"{path.stem}.vtp", record.bounds, upright=True)
        upright = piece.upright * [1, 1, stretched, stretched]
        one = check_sizes_of_zones(piece.surface, piece.outline, upright, zone_finer(record), record)
        found = join_findings(found, one)
    return {fault.kind for fault in prove_sizes_of_zones(found).faults}


def test_triangles_on_open_ground_are_no_finer_than_their_zone_asks() -> None:
    """Right triangles with legs of 5 m."""
    rows = np.arange(21.0 * 21).reshape(21, 21).astype(np.int32)
    a, b, c, d = rows[:-1, :-1].ravel(), rows[:-1, 1:].ravel(), rows[1:, 1:].ravel(), rows[1:, :-1].ravel()
    facets = np.concatenate((np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)))
    y, x = (part.ravel() for part in np.meshgrid(np.arange(21) * 5.0, np.arange(21) * 5.0, indexing="ij"))
    boundary = Boundary(facets, np.full(len(facets), Marker.TOP, np.int8), np.full(len(facets), -1))
    surface = make_surface(np.column_stack((x, y, x * 0)), boundary, np.zeros((len(facets), 3)))
    ring = shapely.get_coordinates(shapely.box(0, 0, 100, 100))
    outline = np.stack((ring[:-1], ring[1:]), axis=1)
    for size, mesh_size, kinds in (
        (5.0, 5.0, set()),
        (3.0, 5.0, {"zone-too-coarse"}),
        (15.0, 15.0, {"zone-too-fine"}),
        (5.0, 15.0, set()),  # as they grow around the zone
    ):
        asked = SizesAsked(mesh_size, mesh_size, 1.2, alone=True)
        zones = (("2.2", size, shapely.to_wkb(shapely.box(30, 30, 70, 70), hex=True)), ("1.2", mesh_size, ""))
        record = RunRecord("done", (0, 0, 100, 100), 0.0, {}, zones=zones, sizes=asked)
        found = check_sizes_of_zones(surface, outline, np.empty((0, 4)), zone_finer(record), record)
        assert {fault.kind for fault in found.faults} == kinds, size


def write_blocks(path: Path, eastern: str = "east") -> None:
    """Two cells side by side, each with a block of LoD0C and of LoD0B, and one of LoD0A for both.

    The eastern block of LoD0B may be of another cell.
    """
    middle = WEST + 0.9 * SIZE
    cells = [shapely.box(WEST, SOUTH, middle, BOUNDS[3]), shapely.box(middle, SOUTH, *BOUNDS[2:])]
    layers: dict[str, tuple[list[shapely.Geometry], dict[str, list[Any]]]] = {
        "cells": (cells, {"id": ["west", "east"], "parent": ["both"] * 2, "members": [9.0, 9.0]}),
        "lod0c": (
            [cell.buffer(-12) for cell in cells],
            {"id": ["west/a", "east/b"], "cell": ["west", "east"], "height": [9.0, 11.0]},
        ),
        "lod0b": (
            [cell.buffer(-6) for cell in cells],
            {"id": ["west", "east"], "cell": ["west", eastern], "height": [8.0, 10.0]},
        ),
        "lod0a": ([shapely.union_all(cells).buffer(-6)], {"id": ["both"], "cell": ["west"], "height": [9.0]}),
    }
    for name, (shapes, columns) in layers.items():
        data = [np.array(values, object if isinstance(values[0], str) else float) for values in columns.values()]
        wkb = np.array(shapely.to_wkb(shapes), object)
        pyogrio.raw.write(
            path, wkb, data, list(columns), layer=name, geometry_type="Polygon", crs=CRS, append=path.exists()
        )


def test_blocks_stand_for_the_buildings_of_whole_cells(town: dict[str, Any], tmp_path: Path) -> None:
    write_blocks(tmp_path / "blocks.gpkg")
    zones = [f"{WEST + 0.4 * SIZE:g},{SOUTH + SIZE / 2:g},20,2.2,5", "rest,0A"]
    values = town | {
        "lod_zones": zones,
        "generalised": str(tmp_path / "blocks.gpkg"),
        "out": str(tmp_path / "out"),
    }
    shape_city(values, tmp_path / "out")
    text = (tmp_path / "out" / CITY_MODEL).read_text()
    objects = json.loads(text)["CityObjects"]
    told = {name: row["attributes"] for name, row in objects.items() if "attributes" in row}
    notes = [
        note[0]
        for stage in ("houses", "model")
        for path in (tmp_path / "out" / STORE / stage).iterdir()
        for note in Store(tmp_path / "out" / STORE).attributes(stage, path.stem)["notes"]
    ]
    assert not any(kind.endswith("-roof-from-attribute") for kind in notes)  # as blocks are of no points
    # The western cell is not at 0A, so that the eastern one is at 0B; what is beyond the focus has one height.
    assert {name for name, row in told.items() if row[LOD] == "0B"} == {"east"}
    np.testing.assert_allclose(told["east"]["height"], 10.0)
    assert {row[LOD] for row in told.values()} == {"2.2", "1.2", "0B"}
    assert max(row[LOD_POINT][0] for row in told.values() if row[LOD] != "0B") < WEST + 0.9 * SIZE
    config = make_config(values)
    asked = read_zones(config, Region(BOUNDS, CRS, SIZE))
    x, y = next(row[LOD_POINT] for row in told.values() if row[LOD] == "1.2")
    assert not prove_levels(text, asked, tmp_path / "out", tmp_path)
    other = (*asked[:-1], ("0C", 6.0, ""))
    assert prove_levels(text, other, tmp_path / "out", tmp_path) == {"level-of-zone", "cell-level"}
    assert all(is_kept(stage, "pieces") for stage in (BLOCK_ROWS, CELL_ROWS))  # what a run was given, for `check`
    # A cell of another level, with a point elsewhere, around other buildings, or one that is gone.
    record = RunRecord("", BOUNDS, 0.0, {}, roofs=RoofRules(raised=2.0, clearance=2.0))
    given = read_given_blocks(tmp_path / "out" / STORE, StoredTerrain(tmp_path / "out" / STORE), record)
    ((level, east, north),) = given.cell_places
    stated = {name: sum(row[LOD] == name for row in told.values()) for name in LEVELS} | {CELLS_REPLACED: 1}
    whole = np.array([shapely.box(*BOUNDS)])
    for change, kinds in (
        ({}, set()),
        ({"cell_places": [(level - 1, east, north)]}, {"cell-level", "block-cell"}),
        ({"cell_places": [(level, WEST + 10, north)]}, {"cell-point", "block-cell"}),
        ({"cells": whole}, {"building-in-cell"}),
        ({"cell_places": [], "cells": whole[:0]}, {"cell-count", "block-cell"}),
    ):
        cells = replace(given, **change)
        assert prove_levels(text, asked, tmp_path / "out", tmp_path, stated, given=cells) == kinds
    # A block of another height, level or point than the run was given, and one that it was not given.
    for was, now, kind in (
        ('"roof_height":15.0', '"roof_height":15.1', "block-height"),
        (f'"{LOD}":"0B"', f'"{LOD}":"0C"', "block-level"),
        ('"members":["east"]', '"members":["west"]', "block-unknown"),
    ):
        assert was in text
        assert kind in prove_levels(text.replace(was, now), asked, tmp_path / "out", tmp_path)
    # A block that is higher than given stands above level terrain as roofs are raised, or not.
    for clearance, faults in ((10.0, set()), (9.9, {"block-height"}), (10.1, {"block-height"})):
        assert prove_levels(text, asked, tmp_path / "out", tmp_path, lower=1, clearance=clearance) == faults
    moved = text.replace(f"[{x!r},{y!r}]", f"[{WEST + 1.5 * SIZE!r},{y!r}]")
    relabelled = text.replace(f'"{LOD}":"0B"', f'"{LOD}":"1.2"', 1)
    assert not prove_levels(text, asked, tmp_path / "out", tmp_path, stated)
    assert "level-count" in prove_levels(relabelled, asked, tmp_path / "out", tmp_path, stated)
    assert "building-in-block" in prove_levels(moved, asked, tmp_path / "out", tmp_path)
    shape_city(values | {"lod_zones": [zones[0], "rest,1.2"]}, tmp_path / "none")  # no cell is at such a level
    (path,) = (tmp_path / "none" / STORE).glob("block-cells/*")
    assert b"no-cells-in-zones" in path.read_bytes()
    write_blocks(tmp_path / "bare.gpkg", eastern="gone")
    with pytest.raises(InputError, match="cell east has buildings, and layer lod0b nothing that stands for them"):
        shape_city(values | {"generalised": str(tmp_path / "bare.gpkg")}, tmp_path / "bare")
    with pytest.raises(ConfigError, match=r"level 0A takes blocks .*--generalised"):
        make_config(town | {"lod_zones": zones})


def test_a_file_of_zones_is_read_once(town: dict[str, Any], tmp_path: Path) -> None:
    zones = tmp_path / "zones.geojson"
    zones.write_text(
        json.dumps(
            {
                "type": "Feature",
                "crs": {"type": "name", "properties": {"name": CRS}},
                "properties": {"level": "1.3", "size": 4},
                "geometry": shapely.geometry.mapping(shapely.box(*BOUNDS)),
            }
        )
    )
    config = make_config(town | {"lod_zones": [str(zones)], "out": str(tmp_path / "out")})
    plan = make_plan(config, lambda _: None)
    zones.unlink()
    engine = make_engine(config, tmp_path / "out", plan, Serial(), OwnStages())
    assert [level for level, *_ in engine.parameters.zones] == ["1.3", "2.2"]
    assert len(engine.parameters.refinements) == 1
    assert forecast_run(plan, None, config).cells_by_level["1.3"] > 0


@pytest.mark.long
def test_zones_depend_on_no_region_and_no_worker(tmp_path: Path) -> None:
    wide = (WEST - SIZE, SOUTH - SIZE, WEST + 3 * SIZE, SOUTH + 2 * SIZE)
    houses = put_roofs(make_town(wide, terraces(wide, seed=5), relief=8, seed=5), seed=5)
    values = write_town(tmp_path / "town", houses, files=(2, 1)) | SIZES
    zones = {"lod_zones": [f"{WEST + SIZE:g},{SOUTH + SIZE / 2:g},60,2.2,4", "rest,1.2"]}
    run_of(values, tmp_path / "one", **zones)
    run_of(values, tmp_path / "two", workers=2, **zones)
    assert hash_files(tmp_path / "one") == hash_files(tmp_path / "two")
    run_of(values | {"bounds": (*wide[:2], WEST + 2 * SIZE, wide[3])}, tmp_path / "less", **zones)
    for folder in ("mesh", "boundary"):
        (path,) = (tmp_path / "one" / folder).glob("3786_76179.vt?")
        assert path.read_bytes() == (tmp_path / "less" / folder / path.name).read_bytes()


@pytest.mark.long
def test_a_focus_has_few_cells_and_the_solutions_of_full_detail(tmp_path: Path) -> None:
    """As docs/lod-zones.md has it of larger cities, in which more cells lie between focus and less detail."""
    found = measure(tmp_path, 480.0, 8.0, 50.0, tiles=1)
    assert find_excess(found, poisson=8.0, flow=2.5) == []
    worse = found | {"same": False, "cells": 0.16, "quality": 0.04}
    assert len(find_excess(worse, poisson=0.0, flow=-100.0)) == 5
