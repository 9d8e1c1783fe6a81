"""Worker processes are forked from one that has imported what they need, and keep the memory that they had."""

import gc
import os
import sys
from pathlib import Path

import psutil
import pytest
from distributed import get_worker

from tests.sparse_city import children, make_city, start, workers
from tests.test_engine import grid_layout, make, wait_until
from tests.test_run import hashes
from tiler import fork_server
from tiler.executors import processes
from tiler.limits import TRIM_AT, Limits, resident_memory
from tiler.scheduler.executor import local
from tiler.stage import Facts, Scope, Stage
from tiler.task import Task

pytestmark = pytest.mark.skipif(fork_server.METHOD != "forkserver", reason="workers are forked on Linux alone")


def look(task: Task) -> Facts:
    """Tell what a worker is: who its parent is, and what it was born with."""
    born = Path("/proc/self/environ").read_bytes().decode().split("\0")
    kept = [word for word in born if word.partition("=")[0] in fork_server.ENVIRONMENT]
    return {
        "environment": sorted(kept),
        "server": psutil.Process(os.getppid()).cmdline()[-1].startswith("from multiprocessing.forkserver"),
        "imported": "tiler.stages.mesh" in sys.modules,
        "numba is set up": "numba.np.arrayobj" in sys.modules,
        "frozen": gc.get_freeze_count() > 50_000,
    }


def look_at_dask(task: Task) -> Facts:
    """Tell likewise, of a worker of Dask."""
    sampled = get_worker().periodic_callbacks.keys() & {"profile", "profile-cycle"}
    return {**look(task), "sampled": sorted(sampled)}


@pytest.mark.parametrize("dask", [True, False])
def test_workers_are_forked_with_their_settings_and_the_driver_keeps_its_own(
    tmp_path: Path, *, dask: bool
) -> None:
    earlier = dict(os.environ)
    fork_server.begin()
    assert dict(os.environ) == earlier
    limits = Limits(memory=2**30)
    with local(1, limits) if dask else processes(1, limits) as executor:
        engine = make(tmp_path, executor, layout=grid_layout())
        engine.run(Stage("looks", Scope.REGION, look_at_dask if dask else look))
    facts = engine.records["looks", "region"].facts
    expected = sorted(f"{name}={value}" for name, value in fork_server.ENVIRONMENT.items())
    told = {"server": True, "imported": True, "numba is set up": True, "frozen": True}
    assert facts == {"environment": expected, **({"sampled": []} if dask else {}), **told}


def test_the_command_forks_its_workers_itself_and_another_process_those_that_replace_them(tmp_path: Path) -> None:
    """All is imported once: the command has one thread when it has imported what tasks need."""
    city = make_city(tmp_path, 2, buildings=12)
    process = start(city.command(tmp_path / "again", "--workers", "2"), tmp_path / "log.txt")
    try:
        wait_until(lambda: len(workers(process)) == 2, seconds=60)
        first = workers(process)
        assert {worker.ppid() for worker in first} == {process.pid}
        assert not any("forkserver" in " ".join(child.cmdline()) for child in children(process))
        first[0].kill()
        wait_until(lambda: first[0] not in workers(process) and len(workers(process)) == 2, seconds=60)
        (fresh,) = set(workers(process)) - set(first)
        assert "forkserver" in " ".join(psutil.Process(fresh.ppid()).cmdline())
        assert process.wait(240) == 0
    finally:
        process.kill()
        process.wait()
    assert hashes(tmp_path / "again") == city.hashes


KEPT: list[bytearray] = []


def fragment(task: Task) -> Facts:
    """Take much memory in small pieces and free almost all; what is kept lies between what was freed."""
    taken = [bytearray(os.urandom(16) * 4096) for _ in range(3 * TRIM_AT // 2 // 65536)]
    KEPT.extend(taken[::100])
    return {"resident": resident_memory()}


def tell_memory_now(task: Task) -> Facts:
    return {"resident": resident_memory()}


def test_a_worker_that_holds_much_gives_it_back_before_the_next_task(tmp_path: Path) -> None:
    with processes(1, Limits(memory=2 * 2**30)) as executor:
        engine = make(tmp_path, executor, layout=grid_layout())
        engine.run(Stage("fragments", Scope.REGION, fragment))
        engine.run(Stage("tells", Scope.REGION, tell_memory_now))
    facts = {stage: record.facts["resident"] for (stage, _), record in engine.records.items()}
    assert facts["fragments"] > 1.5 * TRIM_AT
    assert facts["tells"] < 0.75 * TRIM_AT
