"""Items that fail: tried again, set aside, and what waits for them; in processes that die of them."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.data.errors import GeometryError, OutputError
from tests.helpers.faults import Faulty, Once, hangs_in_c, is_killed, raises, segfaults, swallows_memory
from tests.helpers.told import Told
from tests.tiler.engine.test_engine import contents, grid_layout, make, nothing, one_at_a_time, seen, told
from tiler.engine.engine import Engine
from tiler.engine.executor import Executor, Serial
from tiler.engine.failures import Policy
from tiler.engine.schedule import StoppedError
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Failure, Record, Task
from tiler.engine.task_limits import Limits
from tiler.executors.dask_executor import refuse_round, run_packed
from tiler.executors.local_cluster import local
from tiler.store.out_folder import TASKS

A = Stage("a", Scope.TILE, nothing)
B = Stage("b", Scope.TILE, seen, (Read("a", 1.0),))
C = Stage("c", Scope.TILE, seen, (Read("a", 1.0, optional=True),))
BY_NAME = Stage("by-name", Scope.TILE, told, (Read("a", 1.0, optional=True, others_by_name=True),))
OF_THESE = Stage("of-these", Scope.TILE, seen, (Read("by-name", optional=True),))
ASIDE = Policy(retries=1, set_aside=True)
MEMORY, SECONDS = 2**30, 3.0


@pytest.fixture(scope="module")
def workers() -> Iterator[Executor]:
    with local(2, Limits(SECONDS, MEMORY)) as executor:
        yield executor


def faulty(stage: Stage, **faults: Callable[[Task], None]) -> Stage:
    return replace(
        stage, function=Faulty(stage.function, {name[1:].replace("_", "."): f for name, f in faults.items()})
    )


def no_geometry(_: Task) -> None:
    raise GeometryError("no valid result")


def full_disk(_: Task) -> None:
    raise OutputError("disk full")


def slow(_: Task) -> Facts:
    time.sleep(0.5)
    return {}


def leaves_its_time(task: Task) -> Facts:
    (Path(task.parameters.begun) / f"{task.stage} {task.name}").write_text(repr(time.time()))
    time.sleep(0.05)
    return {}


def test_what_needs_a_failed_item_is_not_run_and_the_rest_is(tmp_path: Path) -> None:
    engine = make(tmp_path, policy=ASIDE)
    engine.run(faulty(A, t0_0=raises), B, C)
    (failed,) = engine.set_aside.values()
    assert (failed.stage, failed.name, failed.scope, failed.kind) == ("a", "0.0", Scope.TILE, "error")
    assert failed.reason == "ZeroDivisionError: a fault on purpose"
    assert "in raises" in failed.trace
    assert failed.attempts == 2
    needing = {"0.0", "0.1", "1.0", "1.1"}
    assert {name for stage, name in engine.blocked if stage == "b"} == needing
    assert set(engine.blocked.values()) == {("a", "0.0")}
    # An item's own result is never optional.
    assert {name for stage, name in engine.blocked if stage == "c"} == {"0.0"}
    assert engine.records["c", "1.1"].facts["a"] == ["0.1", "0.2", "1.0", "1.1", "1.2", "2.0", "2.1", "2.2"]
    n_tiles = len(engine.layout.tiles)
    assert len(engine.store.names("b")) == n_tiles - 4
    assert len(engine.store.names("c")) == n_tiles - 1


def test_a_later_call_knows_what_failed(tmp_path: Path) -> None:
    engine = make(tmp_path, policy=ASIDE)
    engine.run(faulty(A, t0_0=raises))
    engine.run(B, C)
    assert {name for stage, name in engine.blocked if stage == "b"} == {"0.0", "0.1", "1.0", "1.1"}
    engine.run(A, B, C)
    assert not engine.set_aside
    assert not engine.blocked
    whole = make(tmp_path / "whole")
    whole.run(A, B, C)
    assert contents(engine.store.path) == contents(whole.store.path)


@pytest.mark.parametrize("tile", ["0.0", "2.2"])
def test_what_took_a_failed_item_to_be_there_is_run_again(tile: str, tmp_path: Path) -> None:
    """The first tile fails before others ask, the last after they took it to be there: results are the same."""
    ran: list[str] = []

    def tell(stage: str, done: int, total: int, record: Record) -> None:
        ran.extend([] if record.reused else [f"{stage} {record.name}"])

    failing = faulty(A, **{f"t{tile.replace('.', '_')}": raises})
    engine = make(tmp_path, policy=ASIDE, executor=one_at_a_time(), watcher=Told(tell))
    engine.run(failing, BY_NAME, OF_THESE)
    assert ran[1].startswith("by-name")  # it does not wait for its neighbours
    waited = make(tmp_path / "waited", policy=ASIDE)
    waited.run(failing)
    waited.run(BY_NAME)
    waited.run(OF_THESE)
    assert {name for stage, name in engine.blocked if stage == "by-name"} == {tile}
    assert engine.blocked == waited.blocked
    for item, record in waited.records.items():
        assert (record.key, record.facts) == (engine.records[item].key, engine.records[item].facts)
    assert contents(engine.store.path) == contents(waited.store.path)
    assert ran.count("by-name 1.1") == (2 if tile == "2.2" else 1)
    assert ran.count("by-name 0.1") == 1


def test_what_is_run_again_may_fail_too(tmp_path: Path) -> None:
    """A chain of such reads ends."""
    chain = Stage("chain", Scope.TILE, told, (Read("by-name", 1.0, optional=True, others_by_name=True),))
    engine = make(tmp_path, policy=ASIDE)
    engine.run(faulty(A, t2_2=raises), faulty(BY_NAME, t1_1=raises), chain)
    assert set(engine.set_aside) == {("a", "2.2"), ("by-name", "1.1")}
    assert engine.records["chain", "0.0"].facts["by-name"] == ["0.0", "0.1", "1.0"]


@pytest.mark.parametrize(("fault", "attempts"), [(raises, 3), (no_geometry, 1)])
def test_errors_that_would_come_again_are_not_tried_again(
    fault: Callable[[Task], None], attempts: int, tmp_path: Path
) -> None:
    engine = make(tmp_path, policy=Policy(retries=2, set_aside=True))
    engine.run(faulty(A, t1_1=fault))
    assert engine.set_aside["a", "1.1"].attempts == attempts


def test_a_fault_that_passes_leaves_no_trace(tmp_path: Path) -> None:
    engine = make(tmp_path, policy=ASIDE)
    engine.run(faulty(A, t1_1=Once(raises, tmp_path / "mark")))
    assert engine.set_aside == {}
    assert ("a", "1.1") in engine.records


def test_a_full_disk_and_a_failed_region_end_the_run(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"stage a, tile 0\.0: disk full"):
        make(tmp_path, policy=ASIDE).run(faulty(A, t0_0=full_disk))
    with pytest.raises(ZeroDivisionError):
        make(tmp_path, policy=ASIDE).run(faulty(Stage("all", Scope.REGION, nothing), tregion=raises))


def test_of_what_waits_for_a_worker_the_lowest_rank_begins_first(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    begun.mkdir()
    with local(1) as executor:
        engine = make(tmp_path, executor, parameters=SimpleNamespace(begun=str(begun)))
        engine.run(
            *(Stage(name, Scope.TILE, leaves_its_time, parameters=("begun",)) for name in ("filler", "needed"))
        )
    times = {path.name: float(path.read_text()) for path in begun.iterdir()}
    order = sorted(times, key=times.__getitem__)
    assert len(order) == 18
    assert all(name.startswith("needed") for name in order[:9])
    assert order[:9] == sorted(order[:9])


def test_a_trace_file_that_cannot_be_written_ends_the_run(workers: Executor, tmp_path: Path) -> None:
    """It is the disk's fault, not that of any tile."""
    (tmp_path / TASKS).write_text("")
    with pytest.raises(OutputError, match=rf"stage a, tile .*{TASKS}.* cannot be written"):
        make(tmp_path, workers, policy=ASIDE).run(A)


def test_dying_processes_take_no_bystanders(workers: Executor, tmp_path: Path) -> None:
    engine = make(tmp_path, workers, policy=ASIDE)
    engine.run(faulty(A, t0_0=segfaults, t1_1=hangs_in_c, t2_2=swallows_memory), C)
    found = {name: failed for (_, name), failed in engine.set_aside.items()}
    kinds = {name: failed.kind for name, failed in found.items()}
    assert kinds == {"0.0": "crash", "1.1": "time", "2.2": "memory"}
    assert all(failed.attempts == 2 for failed in found.values())
    assert "Segmentation fault" in found["0.0"].reason
    assert "in segfaults" in found["0.0"].trace
    assert f"not done after {SECONDS:g} s, the limit of a task; raise --time-limit" in found["1.1"].reason
    assert "in hangs_in_c" in found["1.1"].trace
    assert "limit of a worker, 1.00 GiB" in found["2.2"].reason
    n_tiles = len(engine.layout.tiles)
    assert len(engine.store.names("a")) == len(engine.store.names("c")) == n_tiles - 3
    assert not list((tmp_path / TASKS).iterdir())


def test_a_process_that_was_killed_is_nobodys_fault_at_first(workers: Executor, tmp_path: Path) -> None:
    engine = make(tmp_path, workers, policy=Policy(retries=0, set_aside=True))
    engine.run(faulty(A, t0_0=Once(is_killed, tmp_path / "mark"), t1_1=is_killed))
    assert {name: failed.kind for (_, name), failed in engine.set_aside.items()} == {"1.1": "killed"}
    assert engine.set_aside["a", "1.1"].attempts == 3
    assert "want of memory" in engine.set_aside["a", "1.1"].reason


@pytest.mark.long
def test_processes_that_die_again_and_again_are_replaced(tmp_path: Path) -> None:
    """One that is just starting when Dask gives up its predecessor, 15 s after that died, lives on."""
    begin = time.monotonic()
    with local(2, Limits(0.0, MEMORY)) as executor:
        for k in range(1000):
            faults = {f"t{i}_{j}": is_killed for i, j in ((0, 0), (1, 1), (2, 2))[: 1 + k % 3]}
            engine = make(tmp_path / f"{k}", executor, policy=Policy(retries=0, set_aside=True))
            engine.run(faulty(A, **faults))
            assert len(engine.set_aside) == len(faults)
            if time.monotonic() - begin > 90.0:  # s
                break


@pytest.mark.parametrize("where", ["serial", "workers"])
def test_a_stop_keeps_what_ran(where: str, workers: Executor, tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int, record: Record) -> None:
        if done == 5:
            engine.stop()

    layout = grid_layout(6)
    engine: Engine = make(tmp_path, Serial() if where == "serial" else workers, watcher=Told(stop), layout=layout)
    with pytest.raises(StoppedError) as caught:
        engine.run(A, B)
    assert caught.value.exit_code == 130
    n_done = len(engine.store.names("a"))
    assert 5 <= n_done < len(engine.layout.tiles)
    again = make(tmp_path, layout=layout)
    again.run(A, B)
    assert sum(record.reused for record in again.records.of("a")) == n_done


def test_a_worker_begins_no_task_of_a_round_that_was_dropped() -> None:
    refuse_round("dropped")
    given: dict[str, Any] = {"seconds": 0.0, "requirements": None}
    assert run_packed(b"no pickle", in_round="dropped", **given) is None
    outcome = run_packed(b"no pickle", in_round="another", **given)
    assert isinstance(outcome, Failure)
    assert "cannot be read by a worker" in str(outcome.error)


def test_what_is_dropped_ends_or_never_begins(workers: Executor, tmp_path: Path) -> None:
    """What runs is waited for, what waits does not begin, and the executor takes tasks again."""
    engine = make(tmp_path, workers, layout=grid_layout(6))
    with pytest.raises(OutputError):
        engine.run(faulty(replace(A, name="slow", function=slow), t0_0=full_disk))
    n_done = len(engine.store.names("slow"))
    time.sleep(1.0)
    assert len(engine.store.names("slow")) == n_done < 36
    engine.run(B, A)
    assert len(engine.store.names("b")) == 36
