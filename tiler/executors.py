"""Where tasks run: in this process, in worker processes of this machine, or in a Dask cluster anywhere."""

import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from pipeline.errors import CityError
from tiler.stage import Facts
from tiler.task import Failure, Record, Task, run_task

Function = Callable[[Task], Facts]


class Executor(Protocol):
    """What the engine asks of an executor; ``ticket`` is any number of the engine's."""

    workers: int

    def submit(self, ticket: int, function: Function, task: Task) -> None:
        """Take a task."""

    def wait(self) -> tuple[int, Record | Failure]:
        """Wait until any task is done; give its ticket and what came of it."""

    def drop_waiting(self) -> set[int]:
        """Give up what is not done; what runs has ended on return. Gives the tickets of all that was given up."""


class Serial:
    """One task after the other in this process."""

    workers = 1

    def __init__(self) -> None:
        self._queue: deque[tuple[int, Function, Task]] = deque()

    def submit(self, ticket: int, function: Function, task: Task) -> None:
        """Take a task."""
        self._queue.append((ticket, function, task))

    def wait(self) -> tuple[int, Record | Failure]:
        """Run the oldest task."""
        ticket, function, task = self._queue.popleft()
        return ticket, run_task(function, task)

    def drop_waiting(self) -> set[int]:
        """Forget all."""
        dropped = {ticket for ticket, _, _ in self._queue}
        self._queue.clear()
        return dropped


class Dask:
    """Tasks on the workers of a Dask scheduler.

    Parameters
    ----------
    client : distributed.Client
        Connected client.
    workers : int
        Number of threads that run tasks.
    """

    def __init__(self, client: Any, workers: int) -> None:
        from distributed import as_completed

        self.workers = workers
        self._client = client
        self._completed = as_completed()
        self._tickets: dict[str, int] = {}

    def submit(self, ticket: int, function: Function, task: Task) -> None:
        """Take a task."""
        key = f"{task.stage}-{uuid.uuid4().hex}"  # never met again, not even by a second try
        future = self._client.submit(run_task, function, task, key=key, pure=False, retries=0)
        self._tickets[future.key] = ticket
        self._completed.add(future)

    def wait(self) -> tuple[int, Record | Failure]:
        """Wait for the scheduler; the result is released there at once."""
        while True:
            future = next(self._completed)
            ticket = self._tickets.pop(future.key, None)
            if ticket is not None:
                return ticket, _outcome(future)

    def drop_waiting(self) -> set[int]:
        """Cancel all that is not done, and wait until no worker holds or runs any of it."""
        futures = [
            future for future in self._completed.futures if future.key in self._tickets and not future.done()
        ]
        keys = {future.key for future in futures}
        self._client.cancel(futures)
        clean = 0
        while clean < 2:  # twice, as a task may be on its way to a worker
            time.sleep(0.05)
            held = set().union(*self._client.run(_held, on_error="ignore").values())
            clean = 0 if held & keys else clean + 1
        return {self._tickets.pop(key) for key in keys}


@contextmanager
def serial() -> Iterator[Executor]:
    """Run tasks in this process."""
    yield Serial()


@contextmanager
def local(workers: int, *, memory_limit: str | int = "auto") -> Iterator[Executor]:
    """Run tasks in worker processes of one thread each on this machine; they end with the context.

    Parameters
    ----------
    workers : int
        Number of processes.
    memory_limit : str or int
        Memory of one worker (bytes, or ``"4 GB"``); ``"auto"`` shares out what the machine has. A worker that
        needs more is killed.
    """
    from dask import config
    from distributed import Client, LocalCluster

    # Everything is bound to this machine, on free ports: two runs do not meet. A dead process shows by its closed
    # connection, so a worker that is silent because its task holds the interpreter is let live.
    settings = {"distributed.worker.daemon": False, "distributed.scheduler.worker-ttl": None}
    with (
        config.set(settings),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=memory_limit,
            silence_logs="CRITICAL",
        ) as cluster,
        Client(cluster) as client,
    ):
        yield Dask(client, workers)


@contextmanager
def connect(address: str) -> Iterator[Executor]:
    """Run tasks on a Dask cluster whose workers see the same store and files; it is left running.

    Parameters
    ----------
    address : str
        Address of its scheduler, ``"tcp://10.0.0.1:8786"``.

    Raises
    ------
    CityError
        If nothing answers there, or it has no workers.
    """
    from distributed import Client

    try:
        client = Client(address)
    except OSError as error:
        raise CityError(
            f"{address}: no Dask scheduler answers ({error}); start one, or check the address"
        ) from error
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise CityError(f"{address}: the scheduler has no workers; start some and run again")
        yield Dask(client, threads)


def _outcome(future: Any) -> Record | Failure:
    from distributed import KilledWorker

    try:
        outcome: Record | Failure = future.result()
        return outcome
    except KilledWorker:
        return Failure(
            CityError(
                "the worker process died again and again with this item on it, most likely for want of memory; "
                "use fewer workers, give each more memory, or make tiles smaller"
            )
        )
    except Exception as error:  # what Dask itself raises: a module that a worker lacks, a lost scheduler
        return Failure(error)
    finally:
        future.release()


def _held(dask_worker: Any) -> list[str]:
    return list(dask_worker.state.tasks)
