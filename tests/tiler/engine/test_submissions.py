"""Tasks of one item that are submitted together: each has its own result, key, record and failure."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import GeometryError
from stitch.tiling.grid import make_grid
from tests.helpers.faults import Faulty, Once, is_killed, raises, segfaults
from tests.tiler.engine.test_engine import contents, grid_layout, make, nothing, rerun, seen
from tiler.engine.engine import Engine
from tiler.engine.executor import Executor, Serial
from tiler.engine.failures import Policy
from tiler.engine.run_context import make_layout
from tiler.engine.schedule import SMALL_ONES
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.submission import Outcome, Part, run_parts
from tiler.engine.task import Failure, Record, Task, run_task
from tiler.engine.task_limits import Limits
from tiler.executors.dask_executor import refuse_round, run_packed
from tiler.executors.local_cluster import local
from tiler.monitoring.event_log import EventLog
from tiler.monitoring.events import begin_file, read_events
from tiler.monitoring.watchers import Watchers
from tiler.report.timeline import read_timeline
from tiler.store.out_folder import TASKS

ASIDE = Policy(retries=1, set_aside=True)


def puts(task: Task) -> Facts:
    """What it reads, and a number."""
    task.put(z=np.array([len(task.name)]))
    return seen(task)


def names_two(task: Task) -> Facts:
    i, j = task.name.split(".")
    return {"names": [f"{i}.{j}", f"{(int(i) + 1) % 3}.{j}"]}


def reaches_far(task: Task) -> Facts:
    return {"extent": [task.box[0], task.box[1], task.box[2] + 25.0, task.box[3]]}


def not_yet(task: Task) -> Facts | None:
    return seen(task) if task.name != "1.1" or task.refs["more"] else None


def takes_time(task: Task) -> Facts:
    time.sleep(0.05)
    return puts(task)


def is_interrupted(_: Task) -> None:
    raise KeyboardInterrupt


FIRST = Stage("first", Scope.TILE, puts)
SECOND = Stage("second", Scope.TILE, puts, (Read("first", own=True),))
THIRD = Stage("third", Scope.TILE, puts, (Read("second", own=True),))
WIDE = Stage("wide", Scope.TILE, seen, (Read("second", 1.0),))
BESIDE = Stage("beside", Scope.TILE, puts, after="first")


class Counted(Serial):
    """Keeps what was submitted together, as stages and items."""

    def __init__(self) -> None:
        super().__init__()
        self.given: list[list[str]] = []

    def submit(self, ticket: int, parts: Any, rank: int = 0) -> None:
        self.given.append([f"{part.task.stage} {part.task.name}" for part in parts])
        super().submit(ticket, parts, rank)


@pytest.fixture(scope="module")
def workers() -> Iterator[Executor]:
    with local(2, Limits(30.0, 2**30)) as executor:
        yield executor


def faulty(stage: Stage, fault: Callable[[Task], None], name: str = "1.1") -> Stage:
    return replace(stage, function=Faulty(stage.function, {name: fault}))


def apart(path: Path, *stages: Stage, **options: Any) -> Engine:
    """Run stages in a call each, so that nothing is submitted together."""
    engine = make(path, **options)
    for stage in stages:
        engine.run(stage)
    return engine


def test_what_waits_for_its_own_item_alone_goes_with_it(tmp_path: Path) -> None:
    executor = Counted()
    engine = make(tmp_path, executor)
    engine.run(WIDE, THIRD, SECOND, FIRST, BESIDE)
    together = [given for given in executor.given if not given[0].startswith("wide")]
    assert len(together) == 9
    assert set(together[0]) == {f"{stage} 0.0" for stage in ("first", "second", "third", "beside")}
    assert len(executor.given) <= 18  # the last tile's neighbours are done when it begins
    alone = apart(tmp_path / "apart", FIRST, SECOND, THIRD, BESIDE, WIDE)
    assert {item: record.key for item, record in engine.records.items()} == {
        item: record.key for item, record in alone.records.items()
    }
    assert contents(engine.store.path) == contents(alone.store.path)


def test_of_the_whole_region_only_its_own_stages_go_together(tmp_path: Path) -> None:
    executor = Counted()
    whole, more = Stage("whole", Scope.REGION, nothing), Stage("more", Scope.REGION, seen, (Read("whole"),))
    make(tmp_path, executor).run(whole, more, Stage("tiles", Scope.TILE, seen, (Read("whole"),)))
    assert executor.given[0] == ["whole region", "more region"]
    assert [len(given) for given in executor.given[1:]] == [1] * 9


def test_the_seams_of_an_owner_go_together(tmp_path: Path) -> None:
    executor = Counted()
    owners = {"x1.0": "1.0", "y0.1": "0.1", "x1.1": "1.1", "y1.1": "1.1"}
    make(tmp_path, executor, layout=replace(grid_layout(), owners=owners)).run(Stage("s", Scope.SEAM, nothing))
    assert sorted(len(given) for given in executor.given) == [1] * 10 + [2]
    assert ["s x1.1", "s y1.1"] in executor.given


def test_a_tile_owns_its_southern_and_western_seam() -> None:
    """Three tiles, none in the north-east: the sides that no tile is beyond are owned by the one before."""
    grid = make_grid((0.0, 0.0, 800.0, 800.0), tile_size=400.0, mesh_size=10.0)
    present = np.array([[True, True], [True, False]])
    owners = make_layout(replace(grid, present=present), {}, identity="").owners
    assert owners == {
        **{"x0_0": "0_0", "x1_0": "1_0", "x0_1": "0_1", "x1_1": "1_0", "x0_2": "0_1"},
        **{"y0_0": "0_0", "y0_1": "0_1", "y1_0": "1_0", "y1_1": "0_1", "y2_0": "1_0"},
    }


@pytest.mark.parametrize(("workers", "most"), [(1, SMALL_ONES), (2, 8), (4, 4), (100, 1)])
def test_of_small_ones_several_go_together_while_all_workers_have_some(
    workers: int, most: int, tmp_path: Path
) -> None:
    executor = Counted()
    executor.workers, executor.window = workers, 1
    small = Stage("small", Scope.TILE, puts, small=True)
    engine = make(tmp_path, executor, layout=grid_layout(6))
    engine.run(small)
    assert max(map(len, executor.given)) == most
    assert len({name for given in executor.given for name in given}) == 36
    assert len(engine.records) == 36


def test_a_failure_leaves_the_record_of_what_was_before_it(tmp_path: Path) -> None:
    executor = Counted()
    engine = make(tmp_path, executor, policy=ASIDE)
    engine.run(FIRST, faulty(SECOND, raises), THIRD, BESIDE, WIDE)
    assert set(engine.set_aside) == {("second", "1.1")}
    failed = engine.set_aside["second", "1.1"]
    assert (failed.attempts, failed.inputs) == (2, {"first": ("1.1",)})
    assert not engine.records["first", "1.1"].reused
    assert ("beside", "1.1") in engine.records
    assert engine.blocked["third", "1.1"] == ("second", "1.1")
    assert {name for stage, name in engine.blocked if stage == "wide"} == set(engine.layout.tiles)
    tried = [given for given in executor.given if "second 1.1" in given]
    assert [given[0] for given in tried] == ["first 1.1", "second 1.1"]  # what was done is not submitted again


def test_what_goes_after_another_one_does_not_need_it(tmp_path: Path) -> None:
    engine = make(tmp_path, policy=Policy(retries=0, set_aside=True))
    engine.run(faulty(FIRST, raises), BESIDE, SECOND)
    assert set(engine.set_aside) == {("first", "1.1")}
    assert set(engine.blocked) == {("second", "1.1")}
    assert len(engine.store.names("beside")) == 9


def test_a_process_that_dies_of_a_later_part_is_that_parts_fault(workers: Executor, tmp_path: Path) -> None:
    engine = make(tmp_path, workers, policy=Policy(retries=0, set_aside=True))
    second = replace(
        SECOND,
        function=Faulty(puts, {"0.0": Once(is_killed, tmp_path / "mark"), "1.1": segfaults, "2.2": is_killed}),
    )
    engine.run(FIRST, second, THIRD)
    kinds = {(failed.stage, failed.name): failed.kind for failed in engine.set_aside.values()}
    assert kinds == {("second", "1.1"): "crash", ("second", "2.2"): "killed"}
    assert engine.set_aside["second", "2.2"].attempts == 3
    assert len(engine.store.names("first")) == 9
    assert len(engine.records) == 9 + 7 + 7
    assert not list((tmp_path / TASKS).iterdir())


def test_what_was_killed_between_two_parts_goes_on_with_the_second(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path).run(FIRST, faulty(SECOND, is_interrupted, "0.0"), THIRD)
    again = make(tmp_path)
    again.run(FIRST, SECOND, THIRD)
    assert {item for item in again.records if item not in rerun(again)} == {("first", "0.0")}
    assert rerun(apart(tmp_path, FIRST, SECOND, THIRD)) == set()


def test_a_round_that_is_dropped_ends_between_two_parts(tmp_path: Path) -> None:
    from distributed.protocol.pickle import dumps

    executor = Counted()
    taken: list[list[Part]] = []
    executor.submit = lambda ticket, parts, rank=0: taken.append(parts)  # type: ignore[method-assign]
    executor.wait = raise_stop  # type: ignore[method-assign]
    with pytest.raises(GeometryError, match="enough"):
        make(tmp_path, executor).run(replace(FIRST, function=refuses), SECOND)
    outcomes = run_packed(dumps(taken[0]), in_round="between", seconds=0.0, requirements=None)
    assert isinstance(outcomes, list)
    assert isinstance(outcomes[0], Record)
    assert outcomes[1:] == [None]


def raise_stop() -> tuple[int, list[Outcome | None]]:
    raise GeometryError("enough")


def refuses(task: Task) -> Facts:
    refuse_round("between")
    return {}


def test_what_a_part_names_is_read_by_the_next(tmp_path: Path) -> None:
    namer = Stage("namer", Scope.TILE, names_two)
    reader = Stage("reader", Scope.TILE, seen, (Read("namer", own=True), Read("first", named_by="namer")))
    executor = Counted()
    engine = make(tmp_path, executor)
    engine.run(FIRST)
    engine.run(namer, reader)
    assert [len(given) for given in executor.given] == [1] * 9 + [2] * 9
    assert engine.records["reader", "2.1"].facts["first"] == ["0.1", "2.1"]
    alone = apart(tmp_path / "apart", FIRST, namer, reader)
    assert contents(engine.store.path) == contents(alone.store.path)
    with pytest.raises(ValueError, match="reader reads first by facts of others: run first in an earlier call"):
        make(tmp_path).run(FIRST, namer, reader)


def test_a_key_that_needs_more_than_was_known_is_found_once_more(tmp_path: Path) -> None:
    """An absent tile that only the extent of the part before reaches counts: as where they run one by one."""
    layout = grid_layout(6)
    absent = layout.tiles["5.0"]
    layout = replace(
        layout, tiles={n: b for n, b in layout.tiles.items() if n != "5.0"}, absent=(absent,), near=2.0
    )
    stages = (
        Stage("reaching", Scope.TILE, reaches_far),
        Stage("on", Scope.TILE, seen, (Read("reaching", own=True),)),
    )
    executor = Counted()
    engine = make(tmp_path, executor, layout=layout)
    engine.run(*stages)
    assert [given for given in executor.given if len(given) == 1] == [
        [f"on {i}.{j}"] for i in (2, 3) for j in (0, 1)
    ]
    alone = apart(tmp_path / "apart", *stages, layout=layout)
    assert contents(engine.store.path) == contents(alone.store.path)


def test_what_is_put_off_is_run_by_a_later_call(tmp_path: Path) -> None:
    more = Stage("more", Scope.TILE, nothing)
    late = Stage("late", Scope.TILE, not_yet, (Read("first", own=True), Read("more", own=True, optional=True)))
    for computed in (9 + 9 + 1, 0):
        executor = Counted()
        engine = make(tmp_path, executor)
        engine.run(FIRST, more, late, items={"more": ()})
        assert len(executor.given) == 9
        assert len(engine.records) == 17
        assert not engine.set_aside
        engine.run(more, late, items={"more": ["1.1"], "late": ["1.1"]})
        assert executor.given[9:] == [["more 1.1", "late 1.1"]]
        assert engine.records["late", "1.1"].facts["more"] == ["1.1"]
        assert len(rerun(engine)) == computed
    with pytest.raises(ValueError, match=r"stage late, 1\.1: is left to a later call"):
        make(tmp_path).run(FIRST, more, late, Stage("of", Scope.TILE, seen, (Read("late"),)), items={"more": ()})


def test_events_and_times_are_told_by_stage(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    log = Watchers([EventLog(path, begin_file(path), every=0.0)])
    engine = make(tmp_path, watcher=log)
    engine.run(FIRST, replace(SECOND, function=takes_time))
    log.end("done")
    events = [event for event in read_events(path) if event.get("name") == "1.1"]
    assert [(event["event"], event["stage"]) for event in events] == [
        *(("submitted", "first"), ("submitted", "second"), ("done", "first"), ("done", "second"))
    ]
    first, second = events[2:]
    assert second["seconds"] >= 0.05
    assert first["ago"] == pytest.approx(second["seconds"], abs=0.02)
    assert "ago" not in second
    assert {"first", "second"} <= set(engine.records.seconds)
    timeline = read_timeline(path, frozenset(engine.layout.tiles))
    assert timeline is not None
    assert timeline.tasks.tolist() == [9, 9]


def test_parts_that_lack_what_they_read_are_not_begun(tmp_path: Path) -> None:
    begun: list[str] = []

    def run(function: Any, task: Task) -> Outcome:
        begun.append(task.stage)
        return Failure(ValueError()) if task.stage == "first" else run_task(function, task)

    executor = Counted()
    taken: list[list[Part]] = []
    executor.submit = lambda ticket, parts, rank=0: taken.append(parts)  # type: ignore[method-assign]
    executor.wait = raise_stop  # type: ignore[method-assign]
    with pytest.raises(GeometryError):
        make(tmp_path, executor).run(FIRST, SECOND, THIRD, BESIDE)
    outcomes = run_parts(taken[0], run)
    assert begun == ["first", "beside"]
    assert [type(outcome) for outcome in outcomes if outcome is not None] == [Failure, Record]


def test_a_stage_goes_after_one_of_its_scope(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="s goes after first, which has another scope"):
        make(tmp_path).run(FIRST, Stage("s", Scope.SEAM, nothing, after="first"))
    with pytest.raises(ValueError, match="cycle: beside, first"):
        make(tmp_path).run(replace(FIRST, after="beside"), BESIDE)
    engine = make(tmp_path)
    engine.run(BESIDE)  # without the other one it goes alone
    assert len(engine.records) == 9
