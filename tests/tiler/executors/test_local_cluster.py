"""Workers of this machine: what they are started with, and that they end with their driver."""

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import psutil
import pytest
from distributed import get_worker

from tests.helpers.sparse_city import make_city, start, wait_until_gone, workers
from tests.runs.test_run import hashes
from tests.tiler.engine.test_engine import grid_layout, make, wait_until
from tiler.engine.stage import Facts, Scope, Stage
from tiler.engine.task import Task
from tiler.engine.task_limits import TRIM_AT, Limits, resident_memory
from tiler.executors.dask_settings import ENVIRONMENT, FREED, GARBAGE, METHOD
from tiler.executors.in_order import map_in_order
from tiler.executors.local_cluster import local


def look(task: Task) -> Facts:
    """Tell what the process of a worker was started with."""
    born = Path("/proc/self/environ").read_bytes().decode().split("\0")
    return {
        "environment": sorted(word for word in born if word.partition("=")[0] in ENVIRONMENT),
        "server": psutil.Process(os.getppid()).cmdline()[-1].startswith("from multiprocessing.forkserver"),
        "imported": "tiler.stages.mesh" in sys.modules,
        "garbage": gc.get_threshold()[0],
        "frozen": gc.get_freeze_count() > 50_000,
        "sampled": sorted(get_worker().periodic_callbacks.keys() & {"profile", "profile-cycle"}),
    }


@pytest.mark.skipif(METHOD != "forkserver", reason="workers are forked on Linux alone")
def test_workers_are_forked_with_their_settings(tmp_path: Path) -> None:
    with local(1, Limits(memory=2**30)) as executor:
        engine = make(tmp_path, executor, layout=grid_layout())
        engine.run(Stage("looks", Scope.REGION, look))
    assert engine.records["looks", "region"].facts == {
        "environment": sorted(f"{name}={value}" for name, value in ENVIRONMENT.items()),
        "server": True,
        "imported": True,
        "garbage": GARBAGE,
        "frozen": True,
        "sampled": [],
    }


def keep_of_freed(n: int) -> int:
    """Take arrays of some megabytes and let them go; gives the bytes that the process holds on to."""
    before = resident_memory()
    taken = [np.ones(n, np.uint8) for _ in range(40)]
    assert resident_memory() - before > 30 * n
    del taken
    return resident_memory() - before


@pytest.mark.long
@pytest.mark.parametrize(("malloc", "least", "most"), [(ENVIRONMENT, 30, 41), (FREED, -1, 2)])
def test_workers_keep_freed_memory_unless_they_are_told(malloc: Mapping[str, int], least: int, most: int) -> None:
    n = 4 * 2**20
    (kept,) = map_in_order(keep_of_freed, [n], 1, malloc=malloc)
    assert least * n < kept < most * n


@pytest.mark.long
def test_workers_end_with_a_driver_that_is_killed(tmp_path: Path) -> None:
    city = make_city(tmp_path, 2, buildings=12)
    process = start(city.command(tmp_path / "again", "--workers", "2"), tmp_path / "log.txt")
    try:
        wait_until(lambda: len(workers(process)) == 2, seconds=60)
        found = [*psutil.Process(process.pid).children(recursive=True)]
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert wait_until_gone(found, seconds=30) == []
    finally:
        process.kill()
        process.wait()
    done = subprocess.run(city.command(tmp_path / "again", "--workers", "1"), capture_output=True, check=False)
    assert done.returncode == 0
    assert hashes(tmp_path / "again") == city.hashes


KEPT: list[bytearray] = []


def fragment(task: Task) -> Facts:
    """Take much memory in small pieces and free almost all; what is kept lies between what was freed."""
    taken = [bytearray(os.urandom(16) * 4096) for _ in range(3 * TRIM_AT // 2 // 65536)]
    KEPT.extend(taken[::100])
    return {"resident": resident_memory()}


def describe_memory_now(task: Task) -> Facts:
    return {"resident": resident_memory()}


def test_a_worker_that_holds_much_gives_it_back_before_the_next_task(tmp_path: Path) -> None:
    with local(1, Limits(memory=2 * 2**30)) as executor:
        engine = make(tmp_path, executor, layout=grid_layout())
        engine.run(Stage("fragments", Scope.REGION, fragment))
        engine.run(Stage("tells", Scope.REGION, describe_memory_now))
    facts = {stage: record.facts["resident"] for (stage, _), record in engine.records.items()}
    assert facts["fragments"] > 1.5 * TRIM_AT
    assert facts["tells"] < 0.75 * TRIM_AT
