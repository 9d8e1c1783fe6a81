"""Workers as jobs of a batch system, brought up by dask-jobqueue as there is work, see `tiler.executors`."""

import asyncio
import json
import logging
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError
from tiler.engine.task import Failure, Task
from tiler.engine.task_limits import REFUSE_AT, Limits
from tiler.executors.dask_executor import ClusterError, DaskExecutor
from tiler.executors.dask_settings import ANYWHERE, BOTH, ENVIRONMENT, SCHEDULER, WORKER, as_variables
from tiler.executors.executor import Executor
from tiler.jobs.queues import QUEUES, JobSize, Queue, QueueError
from tiler.jobs.table import Cluster
from tiler.store.atomic import replacing
from tiler.words.plain_text import say_nothing

JOB = "job"  # folder in that of a run, with all that its jobs need and print
WORKER_JOBS = "workers.json"  # in it: the numbers of worker jobs that wait or run
LOSSES = 3  # how often a task may be lost with its node or job before it is blamed
ADAPT = 2.0  # s between two looks at how many workers there should be
ASK = 10.0  # s between two questions to the batch system
UNBORN = 5  # worker jobs in a row that end without a worker, before it is an error
NANNY = 200 * 2**20  # bytes of a job that are not its workers'
SETTINGS: Mapping[str, Any] = {
    **SCHEDULER,
    **BOTH,
    "distributed.scheduler.worker-ttl": "10 minutes",
    "distributed.deploy.lost-worker-timeout": "15 s",  # a job's nanny may start its worker anew
}
# What a worker's own process is told; as variables, since its job has no other settings of Dask.
VARIABLES: Mapping[str, Any] = {
    **ENVIRONMENT,
    **as_variables(WORKER),
    **as_variables(BOTH),
    "PYTHONWARNINGS": "ignore",
}


class QueuedDask(DaskExecutor):
    """Tasks on workers that come and go with their jobs.

    Notes
    -----
    Nodes and jobs end for reasons of their own. A task that was on one is sent again, `LOSSES` times; only then,
    or where the worker has left a reason, is it blamed. That no worker is there is no error as long as jobs wait.
    """

    def __init__(self, client: Any, table: Cluster, limits: Limits, scheduler: Any, jobs: "_Jobs") -> None:
        super().__init__(client, table.worker.max_workers, limits, scheduler)
        self.losses: Counter[tuple[str, str]] = Counter()  # by stage and name
        self._jobs = jobs

    def _forgives(self, task: Task, death: Failure) -> bool:
        item = task.stage, task.name
        if death.kind != "killed" or self.losses[item] >= LOSSES:
            return False
        self.losses[item] += 1
        return True

    def _has_workers(self) -> bool:
        if self._jobs.broken:
            raise ClusterError(self._jobs.broken)
        return True


@contextmanager
def job_queue(
    table: Cluster,
    folder: Path,
    limits: Limits,
    *,
    dashboard: str = ANYWHERE,
    say: Callable[[str], None] = say_nothing,
) -> Iterator[Executor]:
    """Run tasks on workers that are jobs; all of them are cancelled with the context.

    Parameters
    ----------
    table : Cluster
        The cluster.
    folder : Path
        `JOB` of the run, which all nodes see: logs and certificates.
    limits : Limits
        Time that a task may take; memory is the table's.
    dashboard : str
        Where the HTTP server of the scheduler listens, ``HOST:PORT``.
    say : callable
        Called with a sentence on tasks that were lost with their nodes.

    Raises
    ------
    ConfigError
        If dask-jobqueue is not installed.
    ClusterError
        If `UNBORN` worker jobs in a row end without a worker.
    """
    kind = cluster_class(table)
    from dask import config
    from distributed import Client
    from distributed.utils import silence_logging_cmgr

    from tiler.executors.local_cluster import WorkerSetup

    memory = int(table.worker.memory * 2**30)
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"dashboard_address": dashboard}
    options |= {"interface": table.interface} if table.interface else {}
    silence = silence_logging_cmgr(logging.CRITICAL)  # what matters is told by us
    with (
        silence,
        config.set(dict(SETTINGS)),
        kind(
            scheduler_options=options,
            security=table.tls or None,
            shared_temp_directory=str(folder),
            silence_logs="critical",
            **worker_options(table, folder),
        ) as cluster,
        Client(cluster) as client,
    ):
        client.register_plugin(WorkerSetup(int(REFUSE_AT * memory)))
        jobs = _Jobs(cluster, QUEUES[table.type], folder)
        bounds = {"minimum": table.worker.min_workers, "maximum": table.worker.max_workers}
        cluster.adapt(
            Adaptive=_adaptive(jobs, table.worker.processes),
            interval=f"{ADAPT} s",
            wait_count=max(1, round(table.worker.idle / ADAPT)),
            **bounds,
        )
        executor = QueuedDask(client, table, Limits(limits.seconds, memory), cluster.scheduler, jobs)
        try:
            yield executor
        finally:
            if n := executor.losses.total():
                say(f"{n} times a task was lost with its worker's job or node, and sent again")


def cluster_class(table: Cluster) -> Any:
    """Class of dask-jobqueue for a cluster; ConfigError if it is not installed."""
    try:
        import dask_jobqueue
    except ImportError as error:
        raise ConfigError(
            f'workers as jobs need dask-jobqueue ({error}); pip install "citystitch[cluster]"'
        ) from error
    return getattr(dask_jobqueue, QUEUES[table.type].scheduler)


def worker_options(table: Cluster, folder: Path) -> dict[str, Any]:
    """What a class of dask-jobqueue takes to make the scripts of workers."""
    worker, queue = table.worker, QUEUES[table.type]
    memory = worker.processes * int(worker.memory * 2**30)
    size = JobSize(
        "citystitch-worker",
        folder / "logs" / "worker-{job}.log",
        worker.walltime,
        memory + NANNY,
        worker.processes,
        worker.options,
    )
    exports = [f"export {name}={value}" for name, value in VARIABLES.items()]
    life = ["--lifetime", f"{worker.lifetime:.0f}s", "--lifetime-stagger", f"{worker.stagger:.0f}s"]
    return {
        "cores": worker.processes,
        "processes": worker.processes,
        "memory": f"{memory} B",
        "job_name": size.name,
        "python": python_words(table),
        "local_directory": f'"{worker.scratch}"',
        "worker_extra_args": life,
        "job_script_prologue": [*begin_words(table), *exports],
        "interface": table.interface or None,
        **queue.worker_words(table, size),
    }


def worker_script(table: Cluster, folder: Path) -> str:
    """Script of a worker job, as dask-jobqueue submits it but for its name and the scheduler's address."""
    protocol = "tls" if table.tls else "tcp"
    job = cluster_class(table).job_cls(
        f"{protocol}://CONTROLLER:PORT", name="NAME", **worker_options(table, folder)
    )
    return str(job.job_script())


def begin_words(table: Cluster) -> list[str]:
    """Lines of shell that every job begins with."""
    return [*table.setup, *(f"module load {module}" for module in table.modules)]


def python_words(table: Cluster) -> str:
    """Command that runs Python on a node."""
    python = table.python or shlex.quote(sys.executable)
    return f"{table.container} {python}".strip()


def read_worker_jobs(folder: Path) -> list[str]:
    """Numbers of the worker jobs that were last known to wait or run."""
    try:
        return [str(job) for job in json.loads((folder / WORKER_JOBS).read_bytes())]
    except (OSError, ValueError, TypeError):
        return []


class _Jobs:
    """The worker jobs of a cluster: those that ended are told to dask-jobqueue, which only counts workers."""

    def __init__(self, cluster: Any, queue: Queue, folder: Path) -> None:
        self.broken = ""
        self._cluster, self._queue, self._folder = cluster, queue, folder
        self._missed: Counter[str] = Counter()
        self._born: set[str] = set()
        self._unborn = 0
        self._written: list[str] | None = None

    async def look(self) -> None:
        """Ask the batch system, and give up the jobs that it no longer has: others take their place."""
        workers = dict(self._cluster.workers)
        here = set(self._cluster.observed)
        self._born |= {name for name in workers if any(_is_of(one, name) for one in here)}
        numbers = {name: str(job.job_id) for name, job in workers.items() if job.job_id}
        self._remember(sorted(numbers.values()))
        try:
            states = await asyncio.to_thread(self._queue.states, list(numbers.values())) if numbers else {}
        except QueueError:
            return  # it answers later
        for name, job in workers.items():
            alive = self._queue.is_alive(states.get(numbers.get(name, "")))
            self._missed[name] = 0 if alive else self._missed[name] + 1
            if self._missed[name] >= 2 and self._cluster.workers.get(name) is job:
                self._give_up(name)

    def _give_up(self, name: str) -> None:
        job = self._cluster.workers.pop(name)
        self._cluster._futures.add(asyncio.ensure_future(job.close()))
        del self._missed[name]
        self._unborn = 0 if name in self._born else self._unborn + 1
        self._born.discard(name)
        if self._unborn >= UNBORN:
            self.broken = (
                f"{self._unborn} worker jobs in a row ended before their worker was there; look at "
                f"{self._folder / 'logs'}, the same command goes on"
            )

    def _remember(self, numbers: list[str]) -> None:
        if numbers != self._written:
            with replacing(self._folder / WORKER_JOBS) as part:
                part.write_text(json.dumps(numbers) + "\n")
            self._written = numbers


def _is_of(worker: str, job: str) -> bool:
    """Tell whether a worker is of a job: jobs of several processes number them."""
    return worker == job or str(worker).startswith(f"{job}-")


def _adaptive(jobs: _Jobs, processes: int) -> Any:
    """Class that follows the work in whole jobs, and looks after these."""
    from distributed.deploy.adaptive import Adaptive

    class Adaptation(Adaptive):  # type: ignore[misc]  # distributed has no types
        looked = 0.0

        async def safe_target(self) -> int:
            now = self.loop.time()
            if now - self.looked >= ASK:
                self.looked = now
                await jobs.look()
            return -(-int(await super().safe_target()) // processes) * processes

    return Adaptation
