"""Unfinished runs that are gone on with, and changed input: what is computed again, and the same bytes."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely

from pipeline.data.errors import ConfigError
from tests.helpers.told import StageEnds
from tests.runs.test_run import hashes
from tiler.check.check import check_run
from tiler.config.config import Config, make_config
from tiler.interface.synth import write_city
from tiler.store.folder_lock import only_run
from tiler.store.results import StoredTerrain
from tiler.store.store import Store
from tiler.workflow.run import run

SIZE, TILE = 560.0, 140.0  # m: 16 tiles


@dataclass(frozen=True)
class Town:
    """A synthetic city as files, and the folder of its finished run."""

    folder: Path
    out: Path
    record: dict[str, Any]

    def config(self, out: Path, **others: Any) -> Config:
        values = {"pointcloud": [str(self.folder / "tiles")], "footprints": str(self.folder / "footprints.gpkg")}
        return make_config(values | {"out": str(out), "tile_size": TILE, "domain_height": 70.0} | others)

    def unfinished(self, out: Path) -> Path:
        """Copy the run as if it had ended just before its last line."""
        shutil.copytree(self.out, out)
        record = json.loads((out / "run.json").read_text())
        (out / "run.json").write_text(json.dumps(record | {"status": "running"}))
        return out


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    folder = tmp_path_factory.mktemp("town")
    write_city(folder / "city", size=SIZE, buildings=60, density=0.5, relief=5, seed=3)
    start = Town(folder / "city", folder / "out", {})
    record = run(start.config(start.out))
    assert record["counts"]["tiles"] == 16
    assert record["reused"] == {}
    return Town(start.folder, start.out, record)


def items(town: Town) -> dict[str, int]:
    """Number of results of every stage."""
    store = Store(town.out / "store.zarr")
    return {stage: len(store.names(stage)) for stage in store.stages()}


def anew(town: Town, record: dict[str, Any]) -> dict[str, int]:
    """Number of results of every stage that were computed again, those with none left out."""
    counts = {stage: n - record["reused"].get(stage, 0) for stage, n in items(town).items()}
    return {stage: n for stage, n in counts.items() if n}


def test_a_run_that_was_cut_short_goes_on_to_the_same_bytes(town: Town, tmp_path: Path) -> None:
    done: list[str] = []

    def stop(stage: str) -> None:
        done.append(stage)
        if done[-1] == "seams":
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run(town.config(out), watchers=[StageEnds(stop)])
    assert json.loads((out / "run.json").read_text())["status"] == "failed"
    committed = Store(out / "store.zarr")
    there = {stage: len(committed.names(stage)) for stage in committed.stages()}
    assert there["seams"] == 40
    assert 0 < there["pieces"] <= there["columns"] < 16  # a piece follows its columns at once
    record = run(town.config(out))
    assert record["reused"] == {stage: n for stage, n in there.items() if n}
    assert hashes(out) == hashes(town.out)


def test_a_lost_piece_and_a_lost_city_model_are_written_again(town: Town, tmp_path: Path) -> None:
    out = town.unfinished(tmp_path / "out")
    piece, *_, other = sorted((out / "mesh").iterdir())
    piece.unlink()
    other.write_bytes(other.read_bytes()[:-1])
    (out / "citymodel.city.json").unlink()
    record = run(town.config(out))
    assert anew(town, record) == {"pieces": 2, "citymodel": 1}
    assert hashes(out) == hashes(town.out)


@pytest.mark.long
def test_other_parameters_leave_nothing_of_the_unfinished_run(town: Town, tmp_path: Path) -> None:
    """Other tiles: points and footprints are used again, and no result or piece of a tile that is gone stays."""
    out = town.unfinished(tmp_path / "out")
    fewer = {"tile_size": 2 * TILE, "mesh_size": 20.0}
    record = run(town.config(out, **fewer))
    assert {"points", "footprints"} <= record["reused"].keys()
    assert len(list((out / "mesh").iterdir())) == record["counts"]["tiles"] == 4
    assert check_run(out, StoredTerrain).ok
    run(town.config(tmp_path / "fresh", **fewer))
    assert hashes(out) == hashes(tmp_path / "fresh")


def change_footprints(town: Town, path: Path, change: Any) -> Path:
    """Write the footprints after a change of the columns ids and polygons."""
    meta, _, wkb, (ids,) = pyogrio.raw.read(town.folder / "footprints.gpkg")
    names, polygons = change(ids, shapely.from_wkb(wkb))
    pyogrio.raw.write(path, shapely.to_wkb(polygons), [names], ["id"], geometry_type="Polygon", crs=meta["crs"])
    return path


def inner_house(ids: Any, polygons: Any) -> int:
    """The house that is farthest from the borders of its tile, of those that stand alone."""
    box = shapely.bounds(polygons)
    low = np.floor(box[:, :2] / TILE) * TILE
    depth = np.minimum(box[:, :2] - low, low + TILE - box[:, 2:]).min(axis=1)
    near = shapely.STRtree(polygons).query(polygons, predicate="dwithin", distance=5.0)[0]
    alone = np.bincount(near) == 1
    inside = ((box[:, :2] > box.min(axis=0)[:2] + 60) & (box[:, 2:] < box.max(axis=0)[2:] - 60)).all(axis=1)
    return int(np.lexsort((ids, -depth, ~(alone & inside)))[0])


def taken_away(ids: Any, polygons: Any) -> tuple[Any, Any]:
    k = inner_house(ids, polygons)
    return np.delete(ids, k), np.delete(polygons, k)


@pytest.mark.long
def test_a_footprint_that_is_taken_away_reruns_what_reads_it_and_no_more(town: Town, tmp_path: Path) -> None:
    changed = change_footprints(town, tmp_path / "changed.gpkg", taken_away)
    out = town.unfinished(tmp_path / "out")
    record = run(town.config(out, footprints=str(changed)))
    computed = anew(town, record)
    for stage in ("houses", "shapes-0", "model", "citymodel"):
        assert computed[stage] == 1, stage
    assert (computed["columns"], computed["seams"]) == (9, 12)
    # A piece is written again where the mesh is another one: the ids of points elsewhere stay.
    assert 1 <= computed["pieces"] <= 4
    assert computed.keys().isdisjoint({"points", "ground", "flooded", "coarse", "terrain"})
    run(town.config(tmp_path / "whole", footprints=str(changed)))
    assert hashes(out) == hashes(tmp_path / "whole")
    assert hashes(out) != hashes(town.out)


def test_two_runs_do_not_share_a_folder(town: Town, tmp_path: Path) -> None:
    out = town.unfinished(tmp_path / "out")
    with only_run(out), pytest.raises(ConfigError, match="another run is at work there"):
        run(town.config(out))
    with only_run(out):
        pass
