"""Workers that come and go with their jobs: tasks outlive them, and jobs that are gone are replaced."""

import asyncio
import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from pipeline.data.errors import CityError
from tests.tiler.engine.test_engine import make
from tiler.engine.stage import Facts, Scope, Stage
from tiler.engine.task import Task
from tiler.engine.task_limits import Limits
from tiler.executors.dask_executor import ClusterError
from tiler.executors.dask_settings import ENVIRONMENT, METHOD, start_fork_server
from tiler.jobs import workers
from tiler.jobs.cluster import QueueError
from tiler.jobs.submission import read_worker_jobs
from tiler.jobs.workers import FAILURES, LOSSES, SETTINGS, JobDask, WorkerJobs

HERE: dict[str, Any] = {  # workers that begin quickly, and again as often as they end
    "distributed.deploy.lost-worker-timeout": "3650 days",
    "distributed.nanny.pre-spawn-environ": dict(ENVIRONMENT),
    "distributed.worker.multiprocessing-method": METHOD,
    "distributed.worker.daemon": False,
}


def dies_at_first(task: Task) -> Facts:
    """End the process the first times, as a node does that goes."""
    mark = task.store.path.parent / f"deaths-{task.name}"
    mark.touch()
    with mark.open("a") as file:
        file.write("x")
    if mark.stat().st_size < LOSSES:
        os._exit(1)
    return {}


def dies(task: Task) -> Facts:
    os._exit(1)


def retires_its_worker(task: Task) -> Facts:
    """Have the first worker of all retire while this runs on it, as one does at the end of its lifetime."""
    from distributed import get_worker

    folder = task.store.path.parent
    with (folder / f"begun-{task.name}").open("a") as file:
        file.write(f"{os.getpid()}\n")
    with suppress(FileExistsError):
        (folder / "retires").touch(exist_ok=False)
        worker = get_worker()
        worker.loop.add_callback(worker.close_gracefully, restart=True)
    time.sleep(1.0)
    return {}


@contextmanager
def queued(n: int = 2, error: str = "") -> Iterator[JobDask]:
    """Make the executor over workers of this machine."""
    from dask import config
    from distributed import Client, LocalCluster

    start_fork_server()
    with (
        config.set(dict(SETTINGS) | HERE),
        LocalCluster(
            n_workers=n, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
            silence_logs="CRITICAL",
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        jobs: Any = SimpleNamespace(error=error)
        yield JobDask(client, 16, Limits(), cluster.scheduler, jobs)


@pytest.mark.long
def test_a_task_that_was_lost_with_its_worker_is_sent_again_and_blamed_at_last(tmp_path: Path) -> None:
    with queued() as executor:
        make(tmp_path, executor).run(Stage("dies-at-first", Scope.REGION, dies_at_first))
        assert executor.losses.total() == LOSSES - 1
        with pytest.raises(CityError, match="the worker process died with this item on it"):
            make(tmp_path, executor).run(Stage("dies", Scope.REGION, dies))
        assert executor.losses.total() == 2 * LOSSES - 1


@pytest.mark.long
def test_a_task_on_a_retiring_worker_is_not_lost(tmp_path: Path) -> None:
    with queued() as executor:
        make(tmp_path, executor).run(Stage("retires-its-worker", Scope.TILE, retires_its_worker))
        assert executor.losses.total() == 0
        executor._client.wait_for_workers(2, timeout=60)  # another took its place
    begun = [path.read_text().split() for path in tmp_path.glob("begun-*")]
    assert len(begun) == 9
    assert sum(map(len, begun)) <= 10  # no other than that one may have begun twice


def test_workers_that_never_come_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tiler.executors.dask_executor.LOOK", 0.2)
    with (
        queued(n=0, error="5 worker jobs in a row ended before their worker was there") as executor,
        pytest.raises(ClusterError, match="5 worker jobs in a row"),
    ):
        make(tmp_path, executor).run(Stage("dies", Scope.REGION, dies))


class FakeJob:
    """A worker job as dask-jobqueue holds it."""

    def __init__(self, number: str | None) -> None:
        self.job_id = number
        self.closed = False

    async def close(self) -> None:
        self.closed = True


class FakeSystem:
    """A batch system of which some jobs are alive."""

    def __init__(self) -> None:
        self.alive: set[str] = set()
        self.answers = True

    def states(self) -> dict[str, str]:
        if not self.answers:
            raise QueueError("no answer")
        return dict.fromkeys(self.alive, "R")


class FakeCluster:
    """What the worker jobs see of a cluster of dask-jobqueue, whose scheduler wants three workers."""

    def __init__(self) -> None:
        self.workers: dict[str, FakeJob] = {}
        self.observed: set[str] = set()
        self.scheduler_comm = self
        self.loop = SimpleNamespace(time=lambda: 1000.0)

    async def scale_down(self, names: Sequence[str]) -> None:
        for name in names:
            await self.workers.pop(name).close()

    async def adaptive_target(self, target_duration: float) -> int:
        return 3


def worker_jobs(tmp_path: Path, processes: int = 1) -> tuple[WorkerJobs, Any, FakeSystem]:
    cluster, system = FakeCluster(), FakeSystem()
    (tmp_path / "job").mkdir()
    jobs = WorkerJobs(cluster, system, tmp_path / "job", processes, interval="0 s")  # type: ignore[arg-type]
    return jobs, cluster, system


def test_jobs_that_are_gone_are_given_up_and_others_kept(tmp_path: Path) -> None:
    jobs, cluster, system = worker_jobs(tmp_path)
    waits, runs, gone, refused = FakeJob("1"), FakeJob("2"), FakeJob("3"), FakeJob(None)
    cluster.workers = {"C-1": waits, "C-2": runs, "C-3": gone, "C-4": refused}
    cluster.observed, system.alive = {"C-2-0", "C-30"}, {"1", "2"}
    system.answers = False
    for _ in range(3):
        asyncio.run(jobs.look())
    assert len(cluster.workers) == 4  # nobody knows
    system.answers = True
    asyncio.run(jobs.look())
    assert len(cluster.workers) == 4  # a job may just have been submitted
    asyncio.run(jobs.look())
    assert cluster.workers == {"C-1": waits, "C-2": runs}
    assert gone.closed
    assert read_worker_jobs(tmp_path) == {"1", "2", "3"}
    asyncio.run(jobs.look())
    assert read_worker_jobs(tmp_path) == {"1", "2"}
    assert jobs.error == ""


@pytest.mark.parametrize("with_worker", [False, True])
def test_only_jobs_without_a_worker_count_as_failures(with_worker: bool, tmp_path: Path) -> None:
    jobs, cluster, system = worker_jobs(tmp_path)

    async def fail(number: int) -> None:
        cluster.workers = {"C-1": FakeJob(str(number))}
        cluster.observed = {"C-1"} if with_worker else set()
        system.alive = {str(number)}
        await jobs.look()
        cluster.observed, system.alive = set(), set()
        await jobs.look()
        await jobs.look()
        assert cluster.workers == {}

    for number in range(FAILURES):
        assert jobs.error == ""
        asyncio.run(fail(number))
    assert bool(jobs.error) is not with_worker


@pytest.mark.parametrize(("processes", "number"), [(1, 3), (2, 4), (5, 5)])
def test_the_number_of_workers_is_one_of_whole_jobs(processes: int, number: int, tmp_path: Path) -> None:
    jobs, _, _ = worker_jobs(tmp_path, processes)
    assert asyncio.run(jobs.target()) == number


class Processes:
    """A batch system whose jobs are processes of this machine."""

    def states(self) -> dict[str, str]:
        return {str(one.pid): one.status() for one in psutil.process_iter() if one.status() != "zombie"}


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # dask-jobqueue leaves processes
def test_a_job_of_two_workers_that_is_gone_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dask_jobqueue.local import LocalCluster
    from distributed import Client

    monkeypatch.setattr(workers, "ASK", 0.5)
    with (
        LocalCluster(
            cores=2, processes=2, memory="2 GiB", local_directory=str(tmp_path), name="citystitch-worker",
            scheduler_options={"dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}, silence_logs="critical",
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        options = {"minimum_jobs": 1, "maximum_jobs": 1, "interval": "0.2 s", "worker_key": workers._name_job}
        jobs = cluster.adapt(Adaptive=WorkerJobs, system=Processes(), folder=tmp_path, processes=2, **options)
        client.wait_for_workers(2, timeout=120)
        (first,) = [job.job_id for job in cluster.workers.values()]
        os.kill(int(first), signal.SIGKILL)
        end = time.monotonic() + 120
        while first in [job.job_id for job in cluster.workers.values()] or len(client.nthreads()) != 2:
            assert time.monotonic() < end
            time.sleep(0.2)
        assert jobs.error == ""
