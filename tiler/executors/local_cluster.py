"""Workers of this machine: a `distributed.LocalCluster` of processes with one thread each."""

import gc
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from dask import config
from distributed import Client, LocalCluster, WorkerPlugin

from tiler.config.config import ANYWHERE
from tiler.engine.executor import Executor
from tiler.engine.task_limits import REFUSE_AT, Limits, limit_memory, share_memory
from tiler.executors.dask_executor import DaskExecutor
from tiler.executors.dask_settings import ENVIRONMENT, GARBAGE, LOCAL, keep_memory, start_fork_server


class WorkerSetup(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Sets up a worker process, also one that replaces a dead one.

    Parameters
    ----------
    memory : int
        Memory that the process may take (bytes); 0 for no limit.
    malloc : mapping of str to int
        Settings of malloc, as `ENVIRONMENT` has them.
    """

    name = "citystitch"

    def __init__(self, memory: int, malloc: Mapping[str, int] = ENVIRONMENT) -> None:
        self._memory, self._malloc = memory, malloc

    def setup(self, worker: Any) -> None:
        """Ignore Ctrl-C, at which the driver lets running tasks end; collect garbage seldom; limit the memory."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        gc.freeze()
        gc.set_threshold(GARBAGE)
        if self._malloc != ENVIRONMENT:
            keep_memory(self._malloc)
        if self._memory:
            limit_memory(self._memory)


@contextmanager
def local(workers: int, limits: Limits | None = None, *, dashboard: str = ANYWHERE) -> Iterator[Executor]:
    """Run tasks in worker processes of this machine, which end with the context.

    Parameters
    ----------
    workers : int
        Number of processes. One that dies is replaced.
    limits : Limits, optional
        What a task may take; by default its share of the machine's memory, and any time.
    dashboard : str
        Where the HTTP server of the scheduler listens, ``HOST:PORT``.

    Raises
    ------
    RuntimeError
        In a script without ``if __name__ == "__main__":``, which each worker process would run again.
    """
    limits = limits or Limits(memory=share_memory(workers))
    with open_cluster(workers, limits, dashboard=dashboard) as (client, cluster):
        yield DaskExecutor(client, workers, limits, cluster.scheduler)


@contextmanager
def open_cluster(
    workers: int, limits: Limits, *, dashboard: str = ANYWHERE, malloc: Mapping[str, int] = ENVIRONMENT
) -> Iterator[tuple[Any, Any]]:
    """Start a scheduler and worker processes, and end them with the context: client and cluster."""
    start_fork_server()
    with (
        config.set(dict(LOCAL)),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=dashboard,
            memory_limit=limits.memory,
            silence_logs="CRITICAL",
        ) as cluster,
        Client(cluster) as client,
    ):
        client.register_plugin(WorkerSetup(int(REFUSE_AT * limits.memory), malloc))
        try:
            yield client, cluster
        except KeyboardInterrupt:  # at once: running tasks are not waited for
            _kill_workers(cluster)
            raise


def _kill_workers(cluster: Any) -> None:
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        with suppress(OSError, TypeError):
            os.kill(nanny.pid, signal.SIGKILL)
