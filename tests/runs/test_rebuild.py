"""A run in the folder of an earlier one: what a change touches runs, and the bytes are a fresh run's."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pytest
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.data.errors import ConfigError
from stitch.tiling.grid import tiles_of_seam
from tests.helpers.campaigns import keep_outcome
from tests.helpers.told import StageEnds
from tests.helpers.towns import TILE, Town
from tests.runs.test_run import hashes
from tiler.check.check import check_run
from tiler.engine.run_context import seam_key, tile_key
from tiler.interface.synth import write_city
from tiler.store.folder_lock import only_run
from tiler.store.results import StoredTerrain
from tiler.store.store import Store
from tiler.workflow import run as run_module
from tiler.workflow.run import run
from tiler.workflow.summary import describe_tasks

CORNER = "2271_45707"  # the first tile
FILE = 100.0  # m
LAKE = 100.0  # m; side of the square without ground in the last tile: deep enough for the coarse level
# Stages of a tile that take their part of the region's: any change of that runs all of them.
TAKING = {"outlines", "members-0"}
# What two runs of the same input tell differently.
TIMES = {"checksum", "seconds_total", "seconds", "finished", "peak_memory_bytes", "driver_memory_bytes"}
TASKS = {"tasks", "ran", "reused"}
Items = set[tuple[str, str]]


def copy(town: Town, path: Path) -> Town:
    """Copy the results."""
    return Town(town.folder, town.copy(path / "out"))


def copy_all(town: Town, path: Path) -> Town:
    """Copy inputs too, with the times of their last change."""
    return Town(shutil.copytree(town.folder, path / "city"), copy(town, path).out)


def make_town(folder: Path, n: int) -> Town:
    """Make a city of n x n tiles, and mesh it."""
    write_city(folder / "synth", size=n * TILE, buildings=6 * n * n, density=0.5, relief=5, seed=3)
    (folder / "city" / "tiles").mkdir(parents=True)
    shutil.copy(folder / "synth" / "footprints.gpkg", folder / "city")
    split_cloud(sorted((folder / "synth" / "tiles").iterdir()), folder / "city" / "tiles", n)
    town = Town(folder / "city", folder / "out")
    record = run(town.config(town.out))
    assert record["counts"]["tiles"] == n * n
    assert record["tasks"]["ran"] == record["tasks"]["all"]
    return town


def lake_middle(n: int) -> NDArray[np.float64]:
    """Middle of the last of n x n tiles."""
    middle: NDArray[np.float64] = TILE * (np.array(tile_key(CORNER)) + n - 0.5)
    return middle


def split_cloud(paths: list[Path], folder: Path, n: int) -> None:
    """Deal the points of a city out to smaller files, but for those of the lake."""
    for path in paths:
        las = laspy.read(path)
        xy = np.asarray(las.xyz)[:, :2]
        cell = np.floor(xy / FILE).astype(int)
        cell[(np.abs(xy - lake_middle(n)) < LAKE / 2).all(axis=1)] = -1
        for i, j in np.unique(cell[cell[:, 0] >= 0], axis=0).tolist():
            part = laspy.LasData(las.header)
            part.points = las.points[(cell == (i, j)).all(axis=1)]
            part.write(str(folder / f"{i}-{j}-{path.stem}.laz"))


@pytest.fixture(scope="module")
def nine(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("nine"), 3)


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("many"), 5)


def results(out: Path) -> dict[tuple[str, str], tuple[int, int]]:
    """Which file on the disk every result is, and since when: another one when it was computed again."""
    store, found = Store(out / "store.zarr"), {}
    for stage in store.stages():
        for name in store.names(stage):
            state = store.file(stage, name).stat()
            found[stage, name] = state.st_ino, state.st_ctime_ns
    return found


def update(town: Town, **others: Any) -> tuple[dict[str, Any], Items]:
    """Run again in the folder of the finished run; tells what ran."""
    before = results(town.out)
    record = run(town.config(town.out, **others))
    ran = {item for item, number in results(town.out).items() if before.get(item) != number}
    assert len(ran) == record["tasks"]["ran"] == sum(record["ran"].values())
    assert record["tasks"]["all"] == len(results(town.out))
    assert record["tasks"]["all"] - len(ran) == sum(record["reused"].values())
    return record, ran


def told(out: Path) -> dict[str, Any]:
    """What the record says besides times, and what was computed again."""
    record = json.loads((out / "run.json").read_text())
    record["parameters"] = {name: value for name, value in record["parameters"].items() if name != "out"}
    return {name: value for name, value in record.items() if name not in TIMES | TASKS}


def prove_fresh(town: Town, fresh: Path, **others: Any) -> dict[str, Any]:
    """Prove that the folder is that of a run into an empty one: every file, and the record but for times."""
    record = run(town.config(fresh, **others))
    assert hashes(town.out) == hashes(fresh)
    assert told(town.out) == told(fresh)
    return record


def stages(ran: Items) -> set[str]:
    return {stage for stage, _ in ran}


def tiles_reached(ran: Items) -> set[tuple[int, int]]:
    """Columns and rows, from the first tile on, of the tiles that ran, stages in `TAKING` left out."""
    first = tile_key(CORNER)
    keys = [tile_key(name) for stage, name in ran if stage not in TAKING and re.fullmatch(r"\d+_\d+", name)]
    return {(key.i - first.i, key.j - first.j) for key in keys}


def seams_reached(ran: Items) -> list[set[tuple[int, int]]]:
    """The two tiles of each seam that ran, likewise."""
    first = tile_key(CORNER)
    pairs = [tiles_of_seam(seam_key(name)) for _, name in ran if re.fullmatch(r"[xy]\d+_\d+", name)]
    return [{(key.i - first.i, key.j - first.j) for key in pair} for pair in pairs]


# --- inputs that change ----------------------------------------------------------------------------


def change_footprints(town: Town, change: Callable[[Any, Any], tuple[Any, Any]]) -> None:
    path = town.folder / "footprints.gpkg"
    meta, _, wkb, (ids,) = pyogrio.raw.read(path)
    names, polygons = change(ids, shapely.from_wkb(wkb))
    path.unlink()
    pyogrio.raw.write(path, shapely.to_wkb(polygons), [names], ["id"], geometry_type="Polygon", crs=meta["crs"])


def lonely_house(polygons: NDArray[np.object_], tile: tuple[int, int]) -> int:
    """House of a tile, by column and row, that is far from others and from the tile's sides."""
    box = shapely.bounds(polygons)
    low = np.floor(box[:, :2].min(axis=0) / TILE) * TILE + TILE * np.array(tile)
    inside = np.minimum(box[:, :2] - low, low + TILE - box[:, 2:]).min(axis=1)
    apart = np.array([np.partition(shapely.distance(polygons, house), 1)[1] for house in polygons])
    return int(np.argmax(np.minimum(inside, apart)))


def move(town: Town, tile: tuple[int, int]) -> None:
    """Move one house by some metres."""

    def moved(ids: Any, polygons: Any) -> tuple[Any, Any]:
        k = lonely_house(polygons, tile)
        polygons[k] = affinity.translate(polygons[k], 2.0, 1.0)
        return ids, polygons

    change_footprints(town, moved)


def stretch(town: Town, tile: tuple[int, int]) -> None:
    """Make one house the largest of the city by far, within its tile."""

    def stretched(ids: Any, polygons: Any) -> tuple[Any, Any]:
        k = lonely_house(polygons, tile)
        x, y = np.floor(shapely.get_coordinates(polygons[k].centroid)[0] / TILE) * TILE
        polygons[k] = shapely.box(x + 10, y + 66, x + 132, y + 74)
        return ids, polygons

    change_footprints(town, stretched)


def raise_points(path: Path) -> None:
    """Write the file anew, its points half a metre higher."""
    las = laspy.read(path)
    las.z = np.asarray(las.z) + 0.5
    las.write(str(path))


GROUND = {"points", "ground", "flooded", "coarse", "lakes", "terrain"}


def test_nothing_changed_runs_nothing(nine: Town, tmp_path: Path) -> None:
    town = copy(nine, tmp_path)
    record, ran = update(town)
    assert ran == set()
    assert describe_tasks(record["tasks"]).startswith("0 of ")
    assert hashes(town.out) == hashes(nine.out)
    assert told(town.out)["counts"] == told(nine.out)["counts"]
    assert check_run(town.out, StoredTerrain).ok


def test_workers_folder_and_names_of_inputs_are_nothing_that_results_depend_on(nine: Town, tmp_path: Path) -> None:
    town = Town(nine.folder, copy(nine, tmp_path).out.rename(tmp_path / "elsewhere"))
    clouds = shutil.copytree(nine.folder / "tiles", tmp_path / "clouds")
    _, ran = update(town, workers=1, pointcloud=[str(clouds)])
    assert ran == set()
    assert hashes(town.out) == hashes(nine.out)


def test_files_touched_but_the_same_are_read_and_no_more(nine: Town, tmp_path: Path) -> None:
    town = copy_all(nine, tmp_path)
    update(town)
    for path in (sorted((town.folder / "tiles").iterdir())[4], town.folder / "footprints.gpkg"):
        os.utime(path, ns=(1, 1))
    _, ran = update(town)
    assert sorted(stages(ran)) == ["footprints", "points"]
    assert len(ran) == 2
    prove_fresh(town, tmp_path / "fresh")


@pytest.mark.parametrize("change", [move, pytest.param(stretch, marks=pytest.mark.long)])
def test_a_changed_footprint_reaches_the_tiles_around_it(
    nine: Town, tmp_path: Path, change: Callable[[Town, tuple[int, int]], None]
) -> None:
    town = copy_all(nine, tmp_path)
    change(town, (0, 0))
    _, ran = update(town)
    assert stages(ran).isdisjoint(GROUND)
    assert {item for item in ran if item[0] in ("houses", "shapes-0", "model")} == {
        (stage, CORNER) for stage in ("houses", "shapes-0", "model")
    }
    near = {(i, j) for i in range(2) for j in range(2)}
    assert tiles_reached(ran) <= near
    assert all(pair & near for pair in seams_reached(ran))
    prove_fresh(town, tmp_path / "fresh")
    assert hashes(town.out) != hashes(nine.out)
    assert check_run(town.out, StoredTerrain).ok


def test_another_cloud_in_place_of_one_reaches_the_tiles_under_it(nine: Town, tmp_path: Path) -> None:
    """A file at the lake: the coarse level is another one, and matters to the tile of the lake alone."""
    town = copy_all(nine, tmp_path)
    coarse = Store(town.out / "store.zarr").describe("coarse", "region")[1]
    i, j = np.floor((lake_middle(3) - LAKE / 2 - 5) / FILE).astype(int).tolist()
    (shore,) = (town.folder / "tiles").glob(f"{i}-{j}-*.laz")
    raise_points(shore)
    _, ran = update(town)
    assert Store(town.out / "store.zarr").describe("coarse", "region")[1] != coarse
    assert stages(ran).isdisjoint({"outlines", "reserved"})
    assert {name for stage, name in ran if stage == "points"} == {shore.stem}
    near = {(i, j) for i in (1, 2) for j in (1, 2)}
    assert tiles_reached({item for item in ran if item[0] in ("ground", "terrain")}) <= near
    prove_fresh(town, tmp_path / "fresh")


def test_rings_and_coarse_nodes_are_kept_only_where_a_lake_is_deep(nine: Town) -> None:
    store = Store(nine.out / "store.zarr")
    tiles = store.names("flooded")
    deep = {tile for tile in tiles if store.attributes("flooded", tile)["facts"]["deep"]}
    assert 0 < len(deep) < len(tiles)
    assert {tile for tile in tiles if "ring" in store.shapes("flooded", tile)} == deep
    assert set(store.names("lakes")) == deep


@pytest.mark.parametrize(
    ("change", "first"),
    [
        ({"stagger": 0.5}, {"seams", "columns", "pieces", "report"}),
        pytest.param({"mesh_size": 9.0}, {"seams", "columns", "pieces", "report"}, marks=pytest.mark.long),
        pytest.param(
            {"domain_height": 75.0}, {"domain", "seams", "columns", "pieces", "report"}, marks=pytest.mark.long
        ),
    ],
)
def test_a_parameter_of_the_mesh_does_not_touch_the_city_model(
    nine: Town, tmp_path: Path, change: dict[str, Any], first: set[str]
) -> None:
    town = copy(nine, tmp_path)
    _, ran = update(town, **change)
    assert stages(ran) <= first
    assert {"seams", "columns", "pieces"} <= stages(ran)
    prove_fresh(town, tmp_path / "fresh", **change)


# --- the folder ------------------------------------------------------------------------------------


def test_an_update_that_is_cut_off_states_no_finished_mesh_and_goes_on(nine: Town, tmp_path: Path) -> None:
    town = copy(nine, tmp_path)
    seen: list[tuple[str, bool]] = []

    def look(stage: str) -> None:
        status = json.loads((town.out / "run.json").read_text())["status"]
        seen.append((status, (town.out / "mesh.pvtu").exists() or (town.out / "boundary.pvtp").exists()))
        if stage == "columns":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(town.config(town.out, stagger=0.5), watchers=[StageEnds(look)])
    assert set(seen) == {("running", False)}
    assert json.loads((town.out / "run.json").read_text())["status"] == "failed"
    assert not (town.out / "mesh.pvtu").exists()
    # As a kill leaves it: a file begun, and the record of a run at work.
    (town.out / "mesh" / ".2271_45707.99.1.part.vtu").write_text("half")
    (town.out / ".citymodel.city.99.1.part.json").write_text("half")
    (town.out / "run.json").write_text(json.dumps({"schema": 1, "status": "running"}))
    _, ran = update(town)
    assert stages(ran) <= {"seams", "columns", "pieces", "report"}
    assert hashes(town.out) == hashes(nine.out)


def test_the_record_says_that_a_run_is_at_work_before_anything_goes(
    nine: Town, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    town = copy(nine, tmp_path)

    def stop(*_: Any, **__: Any) -> None:
        assert json.loads((town.out / "run.json").read_text())["status"] == "running"
        assert (town.out / "mesh.pvtu").exists()
        raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "clear_folder", stop)
    for overwrite in (False, True):
        with pytest.raises(KeyboardInterrupt):
            run(town.config(town.out, overwrite=overwrite))


def test_a_folder_whose_record_is_not_ours_is_refused_and_so_is_one_at_work(nine: Town, tmp_path: Path) -> None:
    town = copy(nine, tmp_path)
    with only_run(town.out), pytest.raises(ConfigError, match="another run is at work there"):
        run(town.config(town.out))
    # Without these a folder is known by its record alone.
    (town.out / "progress.json").unlink()
    (town.out / "store.zarr" / "manifest.jsonl").unlink()
    before = hashes(town.out)
    for text in ("[]", '{"status": 3, "schema": 1}', '{"name": "other"}', "no JSON"):
        (town.out / "run.json").write_text(text)
        with pytest.raises(ConfigError, match="not the record of a run; give another --out, or --overwrite"):
            run(town.config(town.out))
    (town.out / "run.json").unlink()
    for overwrite in (False, True):
        with pytest.raises(ConfigError, match=r"no run\.json of a run"):
            run(town.config(town.out, overwrite=overwrite))
    assert hashes(town.out) == before


# --- a larger city ---------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.timeout(900)
def test_in_a_larger_city_what_is_far_does_not_run(many: Town, tmp_path: Path) -> None:
    town = copy_all(many, tmp_path)
    move(town, (1, 1))
    record, ran = update(town)
    print("moved footprint:", record["ran"])
    near = {(i, j) for i in range(3) for j in range(3)}
    assert tiles_reached(ran) <= near
    assert all(pair & near for pair in seams_reached(ran))
    assert len(ran) < record["tasks"]["all"] / 3
    whole = prove_fresh(town, tmp_path / "fresh")
    keep_outcome(
        "rebuild",
        tiles=record["counts"]["tiles"],
        **record["tasks"],
        seconds=record["seconds_total"],
        seconds_whole=whole["seconds_total"],
    )
    raise_points(sorted((town.folder / "tiles").iterdir())[0])
    record, ran = update(town)
    print("another cloud:", record["ran"])
    assert tiles_reached(ran) <= {(i, j) for i in range(4) for j in range(4)}
    prove_fresh(town, tmp_path / "fresh2")
