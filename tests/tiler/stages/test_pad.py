"""The pad: bare ground around the region that flattens outwards, in coarser cells of the same mesh."""

import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.data.errors import ConfigError, InputError
from pipeline.plane_mesh.sizes import SizeRule, local_sizes, size_field_around
from pipeline.points_terrain.approach import approach_terrain, border_nodes, make_border
from pipeline.points_terrain.raster import NodeWindow, cut_nodes, window_of
from stitch.tiling.grid import Key, has_tile, make_grid, tile_box, tile_keys
from tests.helpers.cities import crowded_blocks
from tests.helpers.faults import injected, raises
from tests.helpers.programs import mesh_is_ok, read_check, run_foam
from tests.helpers.tiles import hash_files, make_town, prove, run_of, write_footprints, write_town
from tiler.check.check import check_run
from tiler.cli.main import main
from tiler.config.config import Config, check_height, make_config
from tiler.config.config_file import load_config
from tiler.config.declared import Declared
from tiler.config.domain_height import widths_in_metres
from tiler.engine.run_context import absent_tiles, choose_tiles
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.export.export import export_run
from tiler.mesh_files.vtk_files import read_vtu
from tiler.planning.own_stages import list_stages
from tiler.planning.region import find_pad, pad_bounds, pad_grid
from tiler.report.plan_report import plan_run
from tiler.stages.surroundings import find_walls
from tiler.store.results import StoredTerrain
from tiler.store.store import Store
from tiler.workflow.run import run
from tiler.workflow.single_tile import run_alone

CORE = (318_090.0, 6_399_130.0, 318_330.0, 6_399_350.0)
TILE = 160.0  # m
MESH = {"mesh_size": 11.0, "tile_size": TILE}
PAD: tuple[float | str, ...] = (70.0, 190.0, 40.0, 0.0)
WHOLE = pad_bounds(CORE, (70.0, 190.0, 40.0, 0.0))
REGION_OF = {"region", "core", "rim"}
OUTER = NodeWindow(-20, -10, 61, 46)
INNER = NodeWindow(0, 0, 31, 26)


def write_core(folder: Path, **others: Any) -> dict[str, Any]:
    """Write a hilly town whose points and houses go on beyond the region that is asked for."""
    around = pad_bounds(CORE, (40.0,) * 4)
    town = make_town(around, crowded_blocks(around, 24, seed=3), relief=14)
    return write_town(folder, town, spacing=1.5, **others) | MESH | {"bounds": CORE}


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return write_core(tmp_path_factory.mktemp("core"))


@pytest.fixture(scope="module")
def padded(core: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    out = tmp_path_factory.mktemp("padded") / "out"
    return run_of(core, out, pad=PAD), out


@pytest.fixture(scope="module")
def bare(core: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """The same without a pad."""
    out = tmp_path_factory.mktemp("bare") / "out"
    return run_of(core, out), out


def test_the_pad_is_meshed_and_proved(padded: tuple[dict[str, Any], Path]) -> None:
    record, out = padded
    prove(out)
    claims = [proof.claim for proof in check_run(out, StoredTerrain).proofs]
    assert any("on the outer sides of the pad lie at" in claim for claim in claims)
    assert record["region"]["bounds"] == list(WHOLE)
    assert record["region"]["core"] == list(CORE)
    grid = make_grid(WHOLE, tile_size=TILE, mesh_size=11.0)
    assert set(record["tiles"]) == {f"{i}_{j}" for i, j in tile_keys(grid)}
    assert {path.stem for path in (out / "mesh").iterdir()} == set(record["tiles"])
    assert record["counts"]["tiles"] == len(record["tiles"])


def test_the_region_has_its_terrain_and_the_pad_is_level_at_its_outer_sides(
    padded: tuple[dict[str, Any], Path], bare: tuple[dict[str, Any], Path]
) -> None:
    (record, out), (before, alone) = padded, bare
    assert (alone / "citymodel.city.json").read_bytes() == (out / "citymodel.city.json").read_bytes()
    assert record["counts"]["buildings"] == before["counts"]["buildings"] > 5
    assert record["fidelity"] == before["fidelity"]
    inside, both = (StoredTerrain(folder / "store.zarr") for folder in (alone, out))
    xy = np.random.default_rng(1).uniform(CORE[:2], CORE[2:], (4000, 2))
    np.testing.assert_array_equal(both.sample(xy), inside.sample(xy))
    rim = record["region"]["rim"]
    along = np.linspace(0.0, 1.0, 400)
    x, y = (WHOLE[k] + along * (WHOLE[k + 2] - WHOLE[k]) for k in (0, 1))
    for side in ((WHOLE[0], y), (WHOLE[2], y), (x, WHOLE[1])):
        places = np.stack(np.broadcast_arrays(*side), axis=1).astype(np.float64)
        np.testing.assert_allclose(both.sample(places), rim, rtol=0, atol=1e-9)
    # Across the region's border the ground goes on: no step beyond what the terrain has within.
    y = np.arange(CORE[1], CORE[3])
    step = both.sample(np.stack((np.full_like(y, CORE[2] + 1), y), axis=1))
    step -= inside.sample(np.stack((np.full_like(y, CORE[2]), y), axis=1))
    assert np.abs(step).max() < 0.2


def test_cells_grow_away_from_the_region(padded: tuple[dict[str, Any], Path]) -> None:
    """In the eastern pad, the widest, edges are longer than anywhere near the region."""
    _, out = padded
    store, middle, area = Store(out / "store.zarr"), [], []
    for name in store.names("columns"):
        arrays, _ = store.read("columns", name, names=("xy", "triangles"))
        corners = arrays["xy"][arrays["triangles"]]
        (a, b), (c, d) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
        middle.append(corners.mean(axis=1))
        area.append((a * d - b * c) / 2)
    xy, size = np.concatenate(middle), np.concatenate(area)
    open_ground = size[(xy[:, 0] > CORE[2] - 60) & (xy[:, 0] < CORE[2])]
    assert size[xy[:, 0] > CORE[2] + 30].mean() > 1.04 * open_ground.mean()


def test_a_pad_makes_no_stage_of_the_city_model_again(
    padded: tuple[dict[str, Any], Path], bare: tuple[dict[str, Any], Path], core: dict[str, Any], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(bare[1], out)
    again = run_of(core, out, pad=PAD)
    assert {"points", "terrain", "houses", "model", "citymodel", "fit"}.isdisjoint(again["ran"])
    assert {"rim", "approach", "seams", "columns"} <= set(again["ran"])
    assert hash_files(out) == hash_files(padded[1])
    assert run_of(core, out, pad=PAD)["tasks"]["ran"] == 0


def test_a_stage_of_the_users_own_runs_where_what_it_reads_is(
    padded: tuple[dict[str, Any], Path], core: dict[str, Any], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(padded[1], out)
    stages = [
        Stage("own-heights", Scope.TILE, count_nodes, (Read("terrain", own=True),)),
        Stage("own-cells", Scope.TILE, count_refs, (Read("columns", own=True),)),
        Stage("own-both", Scope.TILE, count_refs, (Read("own-cells", own=True),)),
    ]
    config = make_config({"domain_height": 60.0} | core | {"out": str(out), "pad": PAD})
    record = run(config, stages=stages)
    store = Store(out / "store.zarr")
    assert store.names("own-heights") == store.names("terrain") != store.names("columns")
    assert store.names("own-cells") == store.names("own-both") == store.names("columns")
    assert record["ran"].keys() == {"own-heights", "own-cells", "own-both"}


def count_nodes(task: Task) -> Facts:
    (terrain,) = task.read("terrain")
    return {"n": terrain.arrays["z"].size}


def count_refs(task: Task) -> Facts:
    return {"n": sum(len(names) for names in task.refs.values())}


def test_widths_follow_from_the_tallest_building_and_are_told_before_a_run(
    core: dict[str, Any], tmp_path: Path
) -> None:
    config = make_config(core | {"out": str(tmp_path / "out"), "pad": ["4H", 190.0, 0.0, "3.5h"]})
    assert config.pad == ("4H", 190.0, 0.0, "3.5H")
    plan = plan_run(config)
    assert plan["region"]["bounds"] == list(pad_bounds(CORE, (80.0, 190.0, 0.0, 70.0)))  # 20 m are expected
    assert plan["region"]["core"] == list(CORE)
    assert plan["tasks"]["columns"]["number"] > plan["tasks"]["model"]["number"]
    assert plan["files"]["points_in_region"] < plan["files"]["points"]
    assert any("reach beyond the region" in message for message in plan["messages"])
    assert {stage.name for stage in list_stages(config)} >= {"rim", "approach"}
    with pytest.raises(InputError, match="has not come that far"):
        run_alone(config, "1988_39997")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (
            {"pad": [5.0]},
            r"pad = 5 m: must be 0 for none, or at least 10 m \(mesh_size, and 4 times dtm_spacing\)",
        ),
        ({"pad": [50.0, 60.0]}, "pad: 2 widths; give one for all sides, or four: west east south north"),
        ({"pad": ["five"]}, "pad = 'five': expected metres, or a multiple of the tallest building's height"),
        ({"pad": [-50.0]}, "pad = -50 m: must be 0 for none"),
        ({"pad": [math.inf]}, "pad = inf m: must be 0 for none"),
    ],
)
def test_widths_that_make_no_pad_are_refused(given: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        make_config(given)


def test_a_domain_that_is_too_low_for_the_pad_is_refused() -> None:
    config = make_config({"pad": [50.0], "mesh_size": 20.0, "domain_height": "2H"})
    check_height(config, 96.0)
    says = r"48 m \(most_spacing x the pad's size of 60 m\).*here 90 m; lower --most-spacing, give an --open-size"
    with pytest.raises(ConfigError, match=says):
        check_height(config, 90.0)


def test_a_pad_in_heights_needs_a_building() -> None:
    grid = make_grid(CORE, tile_size=TILE, mesh_size=10.0)
    config = make_config({"pad": ["5H"], "tile_size": TILE})
    with pytest.raises(ConfigError, match="pad = 5H: there are no buildings in the region; give it in metres"):
        find_pad(grid, config, 0.0)
    with pytest.raises(ConfigError, match="pad = 5 m: must be 0"):
        find_pad(grid, config, 1.0)
    assert widths_in_metres((50.0,), 0.0) == (50.0,) * 4
    assert widths_in_metres((50.5, "2H", 0.0, "1H"), 20.3) == (50.5, 41.0, 0.0, 21.0)


def test_no_pad_is_no_pad(tmp_path: Path) -> None:
    none, zero = Config(), make_config({"pad": [0.0]})
    assert not zero.padded
    assert [stage.name for stage in list_stages(none)] == [stage.name for stage in list_stages(zero)]
    assert "rim" not in {stage.name for stage in list_stages(none)}
    assert all("core_bounds" not in stage.parameters for stage in list_stages(none))
    path = tmp_path / "config.toml"
    path.write_text('[mesh]\npad = ["5H", 100.0, 0, "10H"]\n')
    assert make_config(load_config(path)).pad == ("5H", 100.0, 0.0, "10H")


def test_the_size_in_the_pad_is_three_times_that_of_the_mesh_as_far_as_tiles_allow() -> None:
    assert make_config({"pad": [100.0]}).graded_size == 30.0
    assert make_config({"pad": [100.0], "tile_size": 280.0}).graded_size == pytest.approx(20.0)
    assert make_config({"pad": [100.0], "tile_size": 140.0}).graded_size == 0.0
    assert make_config({"pad": [100.0], "domain_height": 40.0}).graded_size == pytest.approx(25.0)
    assert make_config({"pad": [100.0], "domain_height": 40.0, "mesher": "layered"}).graded_size == 30.0
    assert make_config({"pad": [100.0], "open_size": 12.0}).graded_size == 12.0
    assert make_config({"open_size": 12.0}).graded_size == 12.0
    field = size_field_around((0.0, 0.0, 100.0, 50.0), SizeRule(10.0, 30.0, 0.2))
    xy = np.array([[50.0, 25.0], [100.0, 50.0], [130.0, 90.0], [400.0, 20.0]])
    np.testing.assert_allclose(local_sizes(field, xy, mesh_size=10.0), [10.0, 10.0, 20.0, 30.0])


def test_tiles_of_the_pad_keep_the_lines_and_the_holes_of_the_region() -> None:
    grid = make_grid((390.0, 40.0, 1010.0, 760.0), tile_size=100.0, mesh_size=5.0)
    files = [(390.0, 40.0, 500.0, 760.0), (390.0, 40.0, 1010.0, 500.0)]  # none to the upper right
    core = choose_tiles(grid, [(*box,) for box in files])
    wide = pad_grid(core, pad_bounds(core.bounds, (70.0, 330.0, 0.0, 45.0)), mesh_size=5.0, open_size=0.0)
    assert {*grid.lines[0][1:-1]} < {*wide.lines[0]}
    assert {*grid.lines[1][1:-1]} <= {*wide.lines[1]}
    hole = (500.0, 500.0, 1010.0, 760.0)
    for i in range(len(wide.lines[0]) - 1):
        for j in range(len(wide.lines[1]) - 1):
            key = Key(wide.first.i + i, wide.first.j + j)
            box = tile_box(wide, key)
            overlap = min(box[2], hole[2]) - max(box[0], hole[0]), min(box[3], hole[3]) - max(box[1], hole[1])
            assert has_tile(wide, key) == (min(overlap) <= 0)
    assert {*absent_tiles(core)} <= {*absent_tiles(wide)}


def hilly_border(window: NodeWindow) -> Any:
    nodes = border_nodes(window)
    return make_border(20 + 3 * np.sin(nodes[:, 0] / 12) + 2 * np.cos(nodes[:, 1] / 10), window)


def test_the_ground_of_the_pad_goes_on_from_the_region_and_ends_level() -> None:
    border = hilly_border(INNER)
    ground = approach_terrain(border, OUTER, OUTER, spacing=1.0).z
    assert np.isnan(ground).sum() == (INNER.nx - 2) * (INNER.ny - 2)
    for edge in (ground[:2], ground[-2:], ground[:, :2], ground[:, -2:]):
        assert (edge == border.rim).all()
    known = ground[~np.isnan(ground)]
    assert border.z.min() <= known.min() < known.max() <= border.z.max()
    nodes = border_nodes(INNER) - (OUTER.i0, OUTER.j0)
    assert np.abs(ground[nodes[:, 1], nodes[:, 0]] - border.z).max() < 0.1
    # A step between nodes is no larger than along the border, but for the way down to the rim.
    steepest = np.abs(np.diff(border.z)).max() + 1.5 * np.abs(border.z - border.rim).max() / 9
    assert max(np.nanmax(np.abs(np.diff(ground, axis=axis))) for axis in (0, 1)) < steepest


def test_the_ground_of_the_pad_is_the_same_from_any_tile() -> None:
    border = hilly_border(INNER)
    whole = approach_terrain(border, OUTER, OUTER, spacing=1.0)
    for part in (NodeWindow(-20, -10, 7, 46), NodeWindow(25, 3, 16, 20), NodeWindow(-3, -2, 9, 9)):
        found = approach_terrain(border, part, OUTER, spacing=1.0)
        np.testing.assert_array_equal(found.z, cut_nodes(whole.z, window_of(whole), part))


def test_a_kerb_at_the_border_ends_within_metres_and_a_hill_does_not() -> None:
    window, outer = NodeWindow(0, 0, 401, 401), NodeWindow(-200, -200, 801, 801)
    nodes = border_nodes(window)
    kerb = make_border(np.where((nodes == (200, 0)).all(axis=1), 11.0, 10.0), window)
    hill = make_border(10 + np.exp(-(((nodes[:, 0] - 200) / 60) ** 2)) * (nodes[:, 1] == 0), window)
    column = NodeWindow(200, -200, 1, 200)
    low, high = (approach_terrain(one, column, outer, spacing=1.0).z[:, 0] - one.rim for one in (kerb, hill))
    assert low[-10] < 0.06
    assert high[-40] > 0.5 * high[-1]


def test_gaps_along_the_border_are_filled_and_a_border_without_terrain_is_refused() -> None:
    window = NodeWindow(0, 0, 3, 3)
    border = make_border(np.array([np.nan, 1.0, 2.0, np.nan, np.nan, 5.0, np.nan, 7.0]), window)
    np.testing.assert_allclose(border.z, [4.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    assert border.rim == (1 + 2 + 5 + 7) / 4
    with pytest.raises(InputError, match="no terrain along the border of the region"):
        make_border(np.full(8, np.nan), window)


def edit_record(out: Path, **region: Any) -> None:
    path = out / "run.json"
    record = json.loads(path.read_text())
    record["region"] |= region
    path.write_text(json.dumps(record))


@pytest.mark.parametrize(
    ("region", "kind"), [({"rim": 1.0}, "rim-uneven"), ({"core": [CORE[0] + 90.0, *CORE[1:]]}, "house-in-pad")]
)
def test_the_check_tells_a_rim_that_is_uneven_and_a_house_in_the_pad(
    region: dict[str, Any], kind: str, padded: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(padded[1], out)
    edit_record(out, **region)
    assert {fault.kind for fault in check_run(out, StoredTerrain).faults} == {kind}


def test_with_a_pad_alone_sizes_count_from_the_region_and_with_an_open_size_from_walls() -> None:
    house = np.array([shapely.box(CORE[0] - 5, CORE[1], CORE[0], CORE[3])])
    xy = np.array([[CORE[0] + 200.0, CORE[1] + 100.0], [CORE[0] - 50.0, CORE[1] + 100.0]])
    found = []
    for open_size in (0.0, 30.0):
        given = Declared(
            "columns", {"mesh_size": 10.0, "open_size": open_size, "grading": 0.2, "core_bounds": CORE}
        )
        task: Any = SimpleNamespace(parameters=given, context=SimpleNamespace(open_size=30.0))
        found.append(local_sizes(find_walls(house, task)[1], xy, mesh_size=10.0).tolist())
    assert found == [[10.0, 20.0], [30.0, 19.0]]


@pytest.mark.long
def test_absent_tiles_of_the_region_stay_absent_in_its_pad(tmp_path: Path) -> None:
    region = (318_080.0, 6_399_120.0, 318_500.0, 6_399_540.0)
    town = make_town(region, crowded_blocks(region, 25, seed=4), relief=10)
    values = write_town(tmp_path / "town", town, files=(3, 3), without=[(0, 2), (2, 1), (1, 0)], spacing=1.5)
    for mesher in ("adaptive", "layered"):
        record = run_of(values, tmp_path / mesher, tile_size=140.0, mesher=mesher, pad=[90.0])
        assert len(record["region"]["absent"]) >= 3
        assert record["counts"]["border nodes without terrain"] > 0
        prove(tmp_path / mesher)


@pytest.mark.long
@pytest.mark.parametrize(("stage", "of"), [("ground", "terrain"), ("columns", "columns"), ("fit", "terrain")])
def test_a_tile_that_fails_leaves_a_hole_and_is_mended(
    stage: str, of: str, padded: tuple[dict[str, Any], Path], core: dict[str, Any], tmp_path: Path
) -> None:
    whole, out = padded[0], tmp_path / "out"
    tile = Store(padded[1] / "store.zarr").names(of)[0]
    with injected({stage: {tile: raises}}):
        record = run_of(core, out, pad=PAD, retries=0)
    assert record["exit_code"] == 3
    assert set(record["missing"]) == ({tile} if stage != "fit" else set())
    assert [entry["stage"] for entry in record["set_aside"]] == (["fit"] if stage == "fit" else [])
    lost = set(whole["tiles"]) - set(record["tiles"])
    assert lost == {*record["missing"], *record["region"]["absent"]}
    prove(out)
    assert run_of(core, out, pad=PAD)["exit_code"] == 0
    assert hash_files(out) == hash_files(padded[1])


@pytest.mark.long
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("mesher", ["adaptive", "layered"])
def test_a_pad_goes_with_all_options_and_any_workers_and_openfoam_is_content(
    mesher: str, core: dict[str, Any], tmp_path: Path
) -> None:
    given = core | {
        "tile_size": 280.0,
        "mesher": mesher,
        "pad": ["4H", "6H", "3H", 30.0],
        "first_layer": 1.0,
        "top": "flat",
        "domain_height": "6H",
        "open_size": 20.0,
        "underground": 20.0,
        "solids": True,
    }
    hashes = []
    for workers in (0, 2):
        out = tmp_path / f"{workers}"
        record = run(make_config(given | {"out": str(out), "workers": workers}))
        assert record["exit_code"] == 0
        hashes.append(hash_files(out))
    assert hashes[0] == hashes[1]
    prove(tmp_path / "0")
    tallest = record["domain"]["tallest building (m)"]
    widths = [math.ceil(n * tallest) for n in (4, 6, 3)]
    assert record["region"]["bounds"] == list(pad_bounds(CORE, (*widths, 30.0)))
    case = tmp_path / "case"
    export_run(tmp_path / "0", case, name="openfoam")
    text = run_foam("checkMesh", case)
    assert mesh_is_ok(text), text[-3000:]
    found = read_check(text)
    assert (found["cells"], found["regions"]) == (record["counts"]["cells"], 1)
    assert {"patch west", "patch east", "patch south", "patch north"} <= found.keys()


@pytest.mark.long
@pytest.mark.parametrize("mesher", ["adaptive", "layered"])
def test_a_tile_alone_is_that_of_the_padded_region(mesher: str, core: dict[str, Any], tmp_path: Path) -> None:
    config = make_config(
        core
        | {"out": str(tmp_path / "out"), "pad": ["8H", 400.0, 0.0, "7H"], "mesher": mesher, "domain_height": 60.0}
    )
    record = run(config)
    names = sorted(record["tiles"], key=lambda name: [int(part) for part in name.split("_")])
    for tile in (names[0], names[len(names) // 2], names[-1]):
        alone, whole = (
            read_vtu(path) for path in (run_alone(config, tile), tmp_path / "out" / "mesh" / f"{tile}.vtu")
        )
        np.testing.assert_array_equal(alone.mesh.points, whole.mesh.points)
        np.testing.assert_array_equal(alone.mesh.cells, whole.mesh.cells)


@pytest.mark.long
def test_a_house_far_away_changes_no_tile_of_the_pad(tmp_path: Path) -> None:
    """What is built in the region reaches as far as its halo, also with a pad."""
    wide = (318_090.0, 6_399_130.0, 318_890.0, 6_399_350.0)
    town = make_town(wide, crowded_blocks(wide, 30, seed=3), relief=10)
    values = write_town(tmp_path / "town", town, spacing=1.5) | MESH
    kept = shapely.get_x(shapely.centroid(town.polygons)).argsort()[:-1]
    ids = np.array([f"house {k}" for k in range(30)], object)
    stores = []
    for rows in (np.sort(kept), np.arange(30)):
        path = tmp_path / f"{len(rows)}.gpkg"
        write_footprints(path, town.polygons[rows], ids[rows])
        record = run_of(values | {"footprints": str(path)}, tmp_path / path.stem, pad=[100.0])
        stores.append(Store(tmp_path / path.stem / "store.zarr"))
    changed = set()
    for name in record["tiles"]:
        one, other = (store.describe("columns", name)[1] for store in stores)
        changed |= {name} if one != other else set()
    boxes = np.array([record["tiles"][name]["box"] for name in sorted(changed)])
    assert len(changed) > 0
    assert (
        boxes[:, 0].min() > town.polygons[shapely.get_x(shapely.centroid(town.polygons)).argmax()].bounds[0] - 300
    )


def test_the_command_line_takes_one_width_or_four(core: dict[str, Any], tmp_path: Path) -> None:
    words = ["plan", *core["pointcloud"], "--tile-size", "160", "--json", str(tmp_path / "plan.json")]
    words += ["--picture", str(tmp_path / "plan.svg"), "--bounds", *map(str, CORE)]
    assert main([*words, "--pad", "70", "190", "2H", "0"]) == 0
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert plan["region"]["bounds"] == list(WHOLE)
    assert main([*words, "--pad", "70", "190"]) == 2
