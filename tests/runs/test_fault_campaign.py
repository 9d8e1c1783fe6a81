"""Faults of every kind in single items of 25 tiles: the rest finishes, the record names them, mending heals.

Which items fail is drawn from seeds. `make reliability` has every kind of fault at every place, CI each kind and
each place at least once; what was injected is kept as ``faults.json`` (`tests.helpers.campaigns`).
"""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import CityError
from stitch.tiling.grid import tiles_of_seam
from tests.helpers.campaigns import keep_outcome, rounds
from tests.helpers.faults import hangs, hangs_in_c, injected, is_killed, raises, segfaults, swallows_memory
from tests.helpers.sparse_city import SparseCity, make_city
from tests.runs.test_run import hashes
from tiler.check.check import check_run
from tiler.engine.run_context import seam_key, tile_name
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.store.results import StoredTerrain
from tiler.store.store import Store
from tiler.words.stage_groups import title_of_stage
from tiler.workflow.run import run

Fault = Callable[[Task], None]
KINDS: dict[str, tuple[Fault, str]] = {
    "exception": (raises, "error"),
    "segmentation fault": (segfaults, "crash"),
    "hang": (hangs, "time"),
    "hang in C": (hangs_in_c, "time"),
    "allocation": (swallows_memory, "memory"),
    "kill -9": (is_killed, "killed"),
}
EARLY = ("ground", "houses", "shapes-0")  # a tile each, before there is a city model
LATE = ("columns", "pieces", "fit", "own")  # a tile each, afterwards; seams come to these
ASIDE = ("fit", "own")  # what takes no tile with it
OTHER = {"early": "late", "late": "early"}
# Each kind before there is a city model, or after it; in CI the late ones are in one run from the start.
PAIRS = list(zip(KINDS, ("early", "late") * 3, strict=True))
REGION = ("coarse", "join-0", "citymodel", "report")
# One worker a core; a task that hangs is ended soon, one that allocates is refused.
LIMITS = {"workers": 2, "time_limit": 6.0, "memory_limit": 1.0, "retries": 0}


def count_triangles(task: Task) -> Facts:
    """A stage of a user's own."""
    (columns,) = task.read("columns", ("triangles",))
    return {"triangles": len(columns.arrays["triangles"])}


OWN = Stage("own", Scope.TILE, count_triangles, (Read("columns", own=True),))


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    """A finished run of 25 tiles, the stage of the user's own too."""
    made = make_city(tmp_path_factory.mktemp("city"), 5, buildings=60)
    record = run(made.config(made.out), stages=[OWN])
    return SparseCity(made.folder, made.out, record, hashes(made.out))


def draw(city: SparseCity, rng: np.random.Generator, *, early: bool) -> dict[str, str]:
    """Draw an item a stage, no two of the same tile."""
    tiles = [str(tile) for tile in rng.permutation(sorted(city.record["tiles"]))]
    if early:
        return dict(zip(EARLY, tiles, strict=False))
    chosen = dict(zip(LATE, tiles, strict=False))
    names = Store(city.out / "store.zarr").names("seams")
    inner = [str(seam) for seam in rng.permutation(names) if set(sides(str(seam))) <= set(tiles)]
    free = [seam for seam in inner if not set(sides(seam)) & set(chosen.values())]
    return chosen | {"seams": free[0]}


def sides(seam: str) -> tuple[str, ...]:
    """The two tiles of an inner seam."""
    return tuple(tile_name(key) for key in tiles_of_seam(seam_key(seam)))


def forget(out: Path, items: dict[str, str]) -> None:
    """Take results out of a finished run, so that they are computed again."""
    for stage, name in items.items():
        (out / "store.zarr" / stage / f"{name}.zip").unlink()


def lost_tiles(items: dict[str, str]) -> dict[str, str]:
    """Say by which stage each tile goes missing."""
    lost = {name: stage for stage, name in items.items() if stage not in ("seams", *ASIDE)}
    return lost | (dict.fromkeys(sides(items["seams"]), "seams") if "seams" in items else {})


def prove(city: SparseCity, out: Path, items: dict[str, str], kinds: dict[str, str]) -> dict[str, Any]:
    """Run with faults in some items, hold the record against them, prove the rest, and mend."""
    faults = {stage: {name: KINDS[kinds[stage]][0]} for stage, name in items.items()}
    with injected(faults):
        record = run(city.config(out, **LIMITS), stages=[OWN])
    assert record["exit_code"] == 3
    lost = lost_tiles(items)
    assert {tile: found["stage"] for tile, found in record["missing"].items()} == lost
    aside = {(one["stage"], one["name"]) for one in record["set_aside"]}
    assert aside == {(stage, name) for stage, name in items.items() if stage in ASIDE}
    for found in [*record["missing"].values(), *record["set_aside"]]:
        kind = kinds[found["stage"]]
        assert found["kind"] == KINDS[kind][1], found["reason"]
        assert found["reason"]
        assert ("File " in found["trace"]) is (kind != "kill -9"), found["trace"]
    for tile, found in record["missing"].items():
        assert found["command"].startswith("citystitch run ")
        assert found["command"].endswith(f"--only {tile} --traceback")
    assert set(record["tiles"]) == set(city.record["tiles"]) - set(lost)
    report = check_run(out, StoredTerrain)
    assert report.ok, "\n".join(report.lines())
    assert report.facts["missing_facets"] > 0
    healed = run(city.config(out, **LIMITS), stages=[OWN])
    assert (healed["exit_code"], healed["missing"], healed["set_aside"]) == (0, {}, [])
    assert hashes(out) == city.hashes
    assert not any((out / ".tasks").iterdir())
    return {"items": items, "kinds": kinds, "missing": len(lost)}


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("kind", "when"), rounds(PAIRS[::2], [*PAIRS[1::2], *((kind, OTHER[when]) for kind, when in PAIRS)])
)
def test_each_kind_of_fault_at_each_stage(city: SparseCity, tmp_path: Path, kind: str, when: str) -> None:
    early = when == "early"
    seed = 2 * list(KINDS).index(kind) + early
    items = draw(city, np.random.default_rng(seed), early=early)
    out = tmp_path / "out"
    shutil.copytree(city.out, out)
    forget(out, items)
    keep_outcome("faults", seed=seed, **prove(city, out, items, dict.fromkeys(items, kind)))


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", rounds([100], [101]))
def test_all_kinds_in_one_run_from_the_start(city: SparseCity, tmp_path: Path, seed: int) -> None:
    items = draw(city, np.random.default_rng(seed), early=False)
    late_first = sorted(KINDS, key=lambda kind: (kind, "early") in PAIRS)
    kinds = dict(zip(items, late_first[seed - 100 :], strict=False))
    keep_outcome("faults", seed=seed, **prove(city, tmp_path / "out", items, kinds))


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", rounds(["exception", "kill -9"], ["segmentation fault", "hang", "allocation"]))
def test_a_file_takes_the_tiles_below_it(city: SparseCity, tmp_path: Path, kind: str) -> None:
    (name, *_) = Store(city.out / "store.zarr").names("points")
    out = tmp_path / "out"
    shutil.copytree(city.out, out)
    forget(out, {"points": name})
    n_files = city.record["counts"]["files"]
    with injected({"points": {name: KINDS[kind][0]}}):
        if n_files == 1:
            with pytest.raises(CityError, match="points: point-cloud files, file"):
                run(city.config(out, **LIMITS), stages=[OWN])
        else:
            record = run(city.config(out, **LIMITS), stages=[OWN])
            assert record["exit_code"] == 3
            assert {found["kind"] for found in record["missing"].values()} == {KINDS[kind][1]}
            assert 0 < len(record["missing"]) < len(city.record["tiles"])
            assert check_run(out, StoredTerrain).ok
    assert run(city.config(out, **LIMITS), stages=[OWN])["exit_code"] == 0
    assert hashes(out) == city.hashes
    keep_outcome("faults", items={"points": name}, kinds={"points": kind})


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("stage", "kind"),
    rounds(
        zip(REGION, ("exception", "segmentation fault") * 2, strict=True),
        zip(REGION, ("segmentation fault", "exception") * 2, strict=True),
    ),
)
def test_a_stage_of_the_region_ends_the_run(city: SparseCity, tmp_path: Path, stage: str, kind: str) -> None:
    out = tmp_path / "out"
    shutil.copytree(city.out, out)
    forget(out, {stage: "region"})
    with injected({stage: {"region": KINDS[kind][0]}}), pytest.raises((CityError, ZeroDivisionError)) as caught:
        run(city.config(out, **LIMITS), stages=[OWN])
    words = " ".join([str(caught.value), *getattr(caught.value, "__notes__", [])])
    assert title_of_stage(stage) in words
    assert getattr(caught.value, "exit_code", 1) == 1
    assert json.loads((out / "run.json").read_text())["status"] == "failed"
    assert run(city.config(out, **LIMITS), stages=[OWN])["exit_code"] == 0
    assert hashes(out) == city.hashes
    keep_outcome("faults", items={stage: "region"}, kinds={stage: kind})


@pytest.mark.long
@pytest.mark.timeout(600)
def test_two_tiles_that_fail_side_by_side(city: SparseCity, tmp_path: Path) -> None:
    """The seam between them was made: no file has its points, and none is counted."""
    out = tmp_path / "out"
    shutil.copytree(city.out, out)
    seam = next(
        name for name in Store(out / "store.zarr").names("seams") if set(sides(name)) <= set(city.record["tiles"])
    )
    faults = {"columns": dict.fromkeys(sides(seam), raises)}
    for tile in sides(seam):
        forget(out, {"columns": tile})
    with injected(faults):
        assert set(run(city.config(out), stages=[OWN])["missing"]) == set(sides(seam))
    report = check_run(out, StoredTerrain)
    assert report.ok, "\n".join(report.lines())


def test_no_two_items_share_a_tile(tmp_path: Path) -> None:
    """Else one fault would hide another: what is drawn is asked of as the campaign is."""
    rows = [f"{i}_{j}" for i in range(5) for j in range(5)]
    store = Store(tmp_path / "store.zarr")
    for i in range(6):
        for j in range(5):
            store.write("seams", f"y{i}_{j}", {})
    record: dict[str, Any] = {"tiles": dict.fromkeys(rows)}
    for seed in range(20):
        items = draw(SparseCity(tmp_path, tmp_path, record, {}), np.random.default_rng(seed), early=False)
        assert set(items) == {*LATE, "seams"}
        touched = Counter([items[stage] for stage in LATE] + [*sides(items["seams"])])
        assert max(touched.values()) == 1
        assert set(touched) <= set(rows)
