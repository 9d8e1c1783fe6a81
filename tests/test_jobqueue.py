"""Workers that come and go with their jobs: tasks outlive them, and jobs without a worker are found."""

import asyncio
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.errors import CityError
from tests.test_engine import make
from tiler.engine.stage import Facts, Scope, Stage
from tiler.engine.task import Task
from tiler.engine.task_limits import Limits
from tiler.executors.dask_executor import ClusterError
from tiler.executors.dask_settings import ENVIRONMENT, METHOD, start_fork_server
from tiler.jobs.jobqueue import LOSSES, SETTINGS, UNBORN, QueuedDask, _Jobs, read_worker_jobs
from tiler.jobs.queues import QueueError
from tiler.jobs.table import Cluster

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
def queued(workers: int = 2, broken: str = "") -> Iterator[QueuedDask]:
    """Make the executor over workers of this machine."""
    from dask import config
    from distributed import Client, LocalCluster

    start_fork_server()
    with (
        config.set(dict(SETTINGS) | HERE),
        LocalCluster(
            n_workers=workers, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
            silence_logs="CRITICAL",
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        jobs: Any = SimpleNamespace(broken=broken)
        yield QueuedDask(client, Cluster(), Limits(), cluster.scheduler, jobs)


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
        queued(workers=0, broken="5 worker jobs in a row ended before their worker was there") as executor,
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


class FakeQueue:
    """A batch system of which some jobs are alive."""

    def __init__(self) -> None:
        self.alive: set[str] = set()
        self.answers = True

    def states(self, jobs: Sequence[str]) -> dict[str, str]:
        if not self.answers:
            raise QueueError("no answer")
        return {job: "R" for job in jobs if job in self.alive}

    def is_alive(self, state: str | None) -> bool:
        return state == "R"


def test_jobs_that_are_gone_are_given_up_and_others_kept(tmp_path: Path) -> None:
    cluster, queue = SimpleNamespace(workers={}, observed=set(), _futures=set()), FakeQueue()
    jobs: Any = _Jobs(cluster, queue, tmp_path)  # type: ignore[arg-type]
    waits, runs, gone, refused = FakeJob("1"), FakeJob("2"), FakeJob("3"), FakeJob(None)
    cluster.workers = {"C-1": waits, "C-2": runs, "C-3": gone, "C-4": refused}
    cluster.observed, queue.alive = {"C-2-0", "C-30"}, {"1", "2"}

    async def look(times: int) -> None:
        for _ in range(times):
            await jobs.look()
        await asyncio.gather(*cluster._futures)

    queue.answers = False
    asyncio.run(look(3))
    assert len(cluster.workers) == 4  # nobody knows
    queue.answers = True
    asyncio.run(look(1))
    assert len(cluster.workers) == 4  # a job may just have been submitted
    cluster._futures.clear()
    asyncio.run(look(1))
    assert cluster.workers == {"C-1": waits, "C-2": runs}
    assert gone.closed
    assert read_worker_jobs(tmp_path) == ["1", "2", "3"]
    assert jobs.broken == ""


@pytest.mark.parametrize("born", [False, True])
def test_only_jobs_without_a_worker_count_as_failures(born: bool, tmp_path: Path) -> None:
    cluster, queue = SimpleNamespace(workers={}, observed=set(), _futures=set()), FakeQueue()
    jobs: Any = _Jobs(cluster, queue, tmp_path)  # type: ignore[arg-type]

    async def fail(number: int) -> None:
        cluster.workers = {"C-1": FakeJob(str(number))}
        cluster.observed = {"C-1"} if born else set()
        queue.alive = {str(number)}
        await jobs.look()
        cluster.observed, queue.alive = set(), set()
        await jobs.look()
        await jobs.look()
        assert cluster.workers == {}

    for number in range(UNBORN):
        assert jobs.broken == ""
        asyncio.run(fail(number))
    assert bool(jobs.broken) is not born
