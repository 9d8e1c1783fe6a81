"""Unfinished runs that are gone on with, and changed input: what is computed again, and the same bytes."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.told import StageEnds
from tests.helpers.towns import TILE, Town, make_town
from tests.runs.test_run import hashes
from tiler.check.check import check_run
from tiler.store.results import StoredTerrain
from tiler.store.store import Store
from tiler.workflow.run import run


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"), size=560.0, buildings=60)


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
