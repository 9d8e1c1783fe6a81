"""Worker processes are forked from one that has imported what they need, and keep the memory that they had."""

import gc
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from distributed import get_worker

from tests.sparse_city import make_city, start, wait_until_gone, workers
from tests.test_engine import ROOT, grid_layout, make, wait_until
from tests.test_run import hashes
from tiler.engine.stage import Facts, Scope, Stage
from tiler.engine.task import Task
from tiler.engine.task_limits import TRIM_AT, Limits, resident_memory
from tiler.executors import fork_server
from tiler.executors.executor import processes
from tiler.scheduler.executor import local

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


def test_the_command_forks_itself_the_process_that_workers_are_forked_from(tmp_path: Path) -> None:
    """What driver and workers need is imported once: the command has one thread when it has imported that."""
    city = make_city(tmp_path, 2, buildings=12)
    process = start(city.command(tmp_path / "again", "--workers", "2"), tmp_path / "log.txt")
    servers: set[psutil.Process] = set()

    def look() -> bool:
        found = workers(process)
        servers.update(worker.parent() for worker in found)
        return len(found) == 2

    try:
        wait_until(look, seconds=60)
        (server,) = servers
        assert server.ppid() == process.pid
        assert server.cmdline() == psutil.Process(process.pid).cmdline()
        assert process.wait(240) == 0
        assert wait_until_gone([server], seconds=20) == []
    finally:
        process.kill()
        process.wait()
    assert hashes(tmp_path / "again") == city.hashes
    assert "Traceback" not in (tmp_path / "log.txt").read_text()


# One worker hangs, and cannot see that its driver is dead; the other one must.
KILLED = """
import os, signal, sys, time
from pathlib import Path
from tests.faults import hangs_in_c
from tests.test_join import give_one, make_task
from tiler.executors import fork_server
from tiler.executors.worker_processes import Crew, Given
from tiler.engine.task_limits import Limits, trace_file
fork_server.has_one_thread = lambda: True  # but for one of pyarrow's memory
fork_server.begin(forked=True)
crew = Crew(2, Limits())
folder = Path(sys.argv[1])
crew.give(Given(0, give_one, make_task(folder, "a")))
hanging = make_task(folder, "b")
crew.give(Given(1, hangs_in_c, hanging))
done = []
while not (done and trace_file(hanging).exists()):
    done += crew.collect(1.0)
time.sleep(0.5)
print(*(f"{type(hand.process).__name__} {hand.process.pid}" for hand in crew._hands), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def lives(pid: int) -> bool:
    return bool(psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)


def test_a_worker_ends_with_its_driver_whatever_those_forked_after_it_do(tmp_path: Path) -> None:
    one_thread = {name: "1" for name in fork_server.ENVIRONMENT if name.endswith("_THREADS")}
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    with (tmp_path / "told.txt").open("w") as told:  # a pipe would be open as long as the worker that hangs
        subprocess.run(command, cwd=ROOT, env=os.environ | one_thread, stdout=told, check=False)
    words = (tmp_path / "told.txt").read_text().split()
    assert words[::2] == ["ForkServerProcess"] * 2
    first, last = map(int, words[1::2])
    try:
        assert lives(last)
        wait_until(lambda: not lives(first), seconds=20)
    finally:
        os.kill(last, signal.SIGKILL)


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
