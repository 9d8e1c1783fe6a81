"""Workers as jobs of a batch system, started by dask-jobqueue as there is work."""

import asyncio
import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dask import config
from distributed import Adaptive, Client

from tiler.engine.executor import Executor
from tiler.engine.task import Failure, Task
from tiler.engine.task_limits import REFUSE_AT, Limits
from tiler.executors.dask_executor import ClusterError, DaskExecutor
from tiler.executors.dask_settings import BOTH, ENVIRONMENT, SCHEDULER, WORKER, as_variables
from tiler.executors.local_cluster import WorkerSetup
from tiler.jobs.cluster import LOGS, WORKER_JOBS, WORKER_NAME, BatchSystem, Cluster, QueueError
from tiler.store.atomic import replacing

LOSSES = 3  # how often a task may be lost with its node or job before it is blamed
ADAPT = 2.0  # s between two looks at how many workers there should be
ASK = 10.0  # s between two questions to the batch system
FAILURES = 5  # worker jobs in a row that end without a worker, before it is an error
NANNY = 200 * 2**20  # bytes that a nanny takes of the memory of its worker
SETTINGS = {
    **SCHEDULER,
    **BOTH,
    "distributed.scheduler.worker-ttl": "10 minutes",
    "distributed.deploy.lost-worker-timeout": "15 s",  # a job's nanny may start its worker anew
}
# Settings of a worker's own process; as variables, since its job has no other settings of Dask.
VARIABLES = {**ENVIRONMENT, **as_variables({**WORKER, **BOTH}), "PYTHONWARNINGS": "ignore"}


class WorkerJobs(Adaptive):  # type: ignore[misc]  # distributed has no types
    """The worker jobs of a cluster of dask-jobqueue: as many as there is work for; those that end are replaced.

    dask-jobqueue itself sees only that a worker goes, not that a job ends before its worker has come.
    """

    def __init__(
        self, cluster: Any, system: BatchSystem, folder: Path, processes: int = 1, **options: Any
    ) -> None:
        self.system, self.folder, self.processes = system, folder, processes
        self.error = ""  # what is wrong when `FAILURES` jobs in a row ended without a worker
        self.asked, self.failures = 0.0, 0
        self.missed: set[tuple[str, str]] = set()  # jobs by name and number
        self.with_workers: set[tuple[str, str]] = set()
        super().__init__(cluster, **options)

    async def target(self) -> int:
        """Return how many workers there should be, in whole jobs."""
        if self.loop.time() - self.asked >= ASK:
            self.asked = self.loop.time()
            await self.look()
        return -(-int(await super().target()) // self.processes) * self.processes

    async def look(self) -> None:
        """Ask the batch system; a job that it lacks twice is given up."""
        jobs = {(name, str(job.job_id or "")) for name, job in self.cluster.workers.items()}
        here = [f"{worker}-" for worker in self.observed]  # NAME, or NAME-0, NAME-1 ... of one job
        self.with_workers |= {job for job in jobs if any(worker.startswith(f"{job[0]}-") for worker in here)}
        with replacing(self.folder / WORKER_JOBS) as part:
            part.write_text(json.dumps(sorted(number for _, number in jobs if number)))
        try:
            alive = await asyncio.to_thread(self.system.states) if jobs else {}
        except QueueError:
            return  # it answers later
        missing = {job for job in jobs if job[1] not in alive}
        gone = sorted(missing & self.missed)
        self.missed = missing.difference(gone)
        for job in gone:
            self.failures = 0 if job in self.with_workers else self.failures + 1
        if self.failures >= FAILURES:
            self.error = (
                f"{self.failures} worker jobs in a row ended before their worker was there; look at "
                f"{self.folder / LOGS}, the same command goes on"
            )
        if gone:
            await self.cluster.scale_down([name for name, _ in gone])


class JobDask(DaskExecutor):
    """Tasks on workers that come and go with their jobs.

    Notes
    -----
    Nodes and jobs end for reasons of their own. A task that was on one is sent again, `LOSSES` times; only then,
    or where the worker has left a reason, is it blamed. That no worker is there is no error as long as jobs wait.
    """

    def __init__(self, client: Client, workers: int, limits: Limits, scheduler: Any, jobs: WorkerJobs) -> None:
        super().__init__(client, workers, limits, scheduler)
        self.losses: Counter[tuple[str, str]] = Counter()  # by stage and name
        self._jobs = jobs

    def _forgives(self, task: Task, death: Failure) -> bool:
        item = task.stage, task.name
        if death.kind != "killed" or self.losses[item] >= LOSSES:
            return False
        self.losses[item] += 1
        return True

    def _has_workers(self) -> bool:
        if self._jobs.error:
            raise ClusterError(self._jobs.error)
        return True


@contextmanager
def worker_jobs(
    cluster: Cluster, folder: Path, seconds: float, *, dashboard: str, say: Callable[[str], None]
) -> Iterator[Executor]:
    """Run tasks, of `seconds` at most (0: any), on workers that are jobs; these are cancelled with the context.

    `folder` is seen by all nodes and takes logs and certificates; the scheduler's HTTP server listens at
    `dashboard`, ``HOST:PORT``; `say` gets the number of tasks lost with their nodes.
    """
    worker, memory = cluster.worker, int(cluster.worker.memory * 2**30) - NANNY
    (folder / LOGS).mkdir(parents=True, exist_ok=True)
    with (
        config.set(SETTINGS),
        cluster.system.cluster_class()(
            name=WORKER_NAME,
            scheduler_options={"dashboard_address": dashboard},
            security=cluster.tls or None,
            shared_temp_directory=str(folder),
            silence_logs="critical",  # we report what matters
            **worker_options(cluster, folder),
        ) as started,
        Client(started) as client,
    ):
        client.register_plugin(WorkerSetup(int(REFUSE_AT * memory)))
        jobs = started.adapt(
            Adaptive=WorkerJobs,
            system=cluster.system,
            folder=folder,
            processes=worker.processes,
            minimum_jobs=-(-worker.min_workers // worker.processes),
            maximum_jobs=-(-worker.max_workers // worker.processes),
            interval=f"{ADAPT} s",
            wait_count=max(1, round(worker.idle / ADAPT)),
            worker_key=_name_job if worker.processes > 1 else None,
        )
        executor = JobDask(client, worker.max_workers, Limits(seconds, memory), started.scheduler, jobs)
        try:
            yield executor
        finally:
            if n := executor.losses.total():
                say(f"{n} times a task was lost with its worker's job or node, and sent again")


def worker_options(cluster: Cluster, folder: Path) -> dict[str, Any]:
    """What a class of dask-jobqueue takes to write the scripts of workers."""
    worker = cluster.worker
    exports = [f"export {name}={value}" for name, value in VARIABLES.items()]
    life = ["--lifetime", f"{worker.lifetime:.0f}s", "--lifetime-stagger", f"{worker.stagger:.0f}s"]
    return cluster.job_options(WORKER_NAME, worker, folder / LOGS) | {
        "python": cluster.command,
        "local_directory": f'"{worker.scratch}"',
        "worker_extra_args": life,
        "job_script_prologue": [*cluster.prologue, *exports],
        "interface": cluster.interface or None,
    }


def worker_script(cluster: Cluster, folder: Path) -> str:
    """Script of a worker job, as dask-jobqueue submits it but for its name and the scheduler's address."""
    address = f"{'tls' if cluster.tls else 'tcp'}://CONTROLLER:PORT"
    job = cluster.system.cluster_class().job_cls(address, name="NAME", **worker_options(cluster, folder))
    return str(job.job_script())


def _name_job(worker: Any) -> str:
    """Name of the job of a worker, one of several there."""
    return str(worker.name).rpartition("-")[0]
