"""Tasks on the workers of a Dask scheduler, on this machine or anywhere."""

import heapq
import itertools
import math
import os
import signal
import time
import uuid
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from pipeline.errors import CityError
from tiler.engine.task import Failure, Record, Task
from tiler.engine.task_limits import (
    REFUSE_AT,
    Limits,
    WorkerError,
    run_guarded,
    share_memory,
    tell_death,
    tell_memory,
)
from tiler.executors import fork_server
from tiler.executors.addresses import ANYWHERE
from tiler.executors.dask_settings import BOTH, SCHEDULER, WORKER
from tiler.executors.executor import LEAST_WINDOW, WINDOW, Executor
from tiler.executors.worker_processes import BYSTANDER, Function, Given
from tiler.scheduler.check import ClusterMismatchError, UnansweredError, check_cluster, tell_refusal
from tiler.scheduler.terms import Refusal, Terms, run_on_terms

Guard = Callable[..., Any]  # runs a task

BATCHES = 4  # in flight for each worker of Dask
TOGETHER = 16  # batches at most that are waited for, to send as many at once
BATCH = 0.25  # s that the tasks of a batch take together, unless one alone takes longer
FORGET = 1000  # tasks after which Dask's table of the names of tasks is emptied, which would hold 100,000
LOOK = 5.0  # s without a word of the scheduler, after which it is asked whether it has workers
NO_WORKERS = 300.0  # s without any worker, after which a run ends; a busy machine starts them slowly


class ClusterError(CityError):
    """The Dask cluster of a run is gone: start it again, the same command goes on."""


class _Done(NamedTuple):
    """What comes back of a batch: what came of each of its tasks, and the time that they took together (s)."""

    outcomes: list[Any]
    seconds: float


class Dask:
    """Tasks on the workers of a Dask scheduler.

    Parameters
    ----------
    client : distributed.Client
        Connected client.
    workers : int
        Number of threads that run tasks.
    limits : Limits
        What a task may take.
    scheduler : distributed.Scheduler, optional
        The scheduler, where it is in this process: its HTTP server shows the page of the run.
    terms : Terms, optional
        What a worker must meet that did not come from here. A task that comes back from one that does not fails
        with a `ClusterMismatchError`, which ends a run.

    Notes
    -----
    A task of Dask costs some 4 ms of the processors, so short tasks of a stage go together as one: as many as
    take `BATCH` seconds, fewer where that would leave another worker without any. What was not sent waits here.
    What came of a batch is told as an event, which takes half of the messages that it takes to fetch a result;
    what was not heard is fetched. Messages to the scheduler go as they come: Dask would let 10 ms pass after each,
    also after the one that lets go of a result, and a task that waits for another one so long.

    Where a worker dies, Dask blames all tasks that it had. Here a task is blamed if it had begun, which its file
    tells (`tiler.engine.task_limits`); the others are sent again.
    """

    def __init__(
        self,
        client: Any,
        workers: int,
        limits: Limits | None = None,
        scheduler: Any | None = None,
        *,
        terms: Terms | None = None,
    ) -> None:
        self.workers, self.scheduler = workers, scheduler
        self._limits = limits or Limits()
        self._client, self._terms = client, terms
        self._waiting: defaultdict[str, list[tuple[int, int, Given]]] = defaultdict(list)  # heap of a stage
        self._flying: dict[str, tuple[Any, list[Given]]] = {}
        self._topic, self._told = f"citystitch-{uuid.uuid4().hex}", dict[str, bytes]()
        self._ready: SimpleQueue[tuple[str, Any]] = SimpleQueue()  # key, and the result or the error
        self._done: deque[tuple[int, Record | Failure]] = deque()
        self._mean: dict[str, float] = {}  # s a task of a stage, of late
        self._sent: Counter[int] = Counter()
        self._submitted = 0
        self._lost = False
        client.subscribe_topic(self._topic, self._hear)
        client.scheduler_comm.interval = 0.0
        if scheduler is not None:
            from tiler.scheduler.prompt import Prompt

            Prompt(scheduler)

    @property
    def window(self) -> int:
        """As many as fill its batches."""
        return max(2 * WINDOW * self.workers, LEAST_WINDOW)

    def submit(self, ticket: int, function: Function, task: Task, rank: int = 0) -> None:
        """Take a task, the lower its rank the sooner it begins; ClusterError if the scheduler is lost."""
        self._check_scheduler()
        self._forget_names()
        self._wait_with(Given(ticket, function, task, rank))

    def wait(self) -> tuple[int, Record | Failure]:
        """Wait for the scheduler; the result is released there at once.

        Raises
        ------
        ClusterError
            If the scheduler is lost, or has had no worker for `NO_WORKERS` seconds.
        """
        while not self._done:
            if self._ready.empty():  # what is there is taken first, so that more can be sent together
                self._send()
            self._take(*self._next())
        return self._done.popleft()

    def drop_waiting(self) -> set[int]:
        """Cancel all that is not done, and wait until no worker holds or runs any of it.

        Without a scheduler nobody can be asked; what workers then still commit is what a task of that key gives.
        """
        dropped = {given.ticket for heap in self._waiting.values() for _, _, given in heap}
        self._waiting.clear()
        self._told.clear()
        try:
            return dropped | self._cancel()
        except (OSError, RuntimeError, CancelledError):
            if not self._is_lost():
                raise
        dropped |= {given.ticket for _, batch in self._flying.values() for given in batch}
        self._flying.clear()
        return dropped

    def _wait_with(self, given: Given) -> None:
        heapq.heappush(self._waiting[given.task.stage], (given.rank, given.ticket, given))

    def _take(self, key: str, found: Any) -> None:
        """Take what came of a batch; what had not begun when its worker died waits again."""
        if key not in self._flying:
            return
        future, batch = self._flying[key]
        told = [found] * len(batch)
        if isinstance(found, _Done):
            told, stage = found.outcomes, batch[0].task.stage
            seconds = found.seconds / len(batch)
            self._mean[stage] = (self._mean.get(stage, seconds) + seconds) / 2
        outcomes = [self._outcome(one, given.ticket, given.task) for one, given in zip(told, batch, strict=True)]
        future.release()
        del self._flying[key]
        for given, outcome in zip(batch, outcomes, strict=True):
            if outcome is not None:
                self._sent.pop(given.ticket, None)
                self._done.append((given.ticket, outcome))
            else:
                self._sent[given.ticket] += 1
                self._wait_with(given)

    async def _follow(self, future: Any) -> None:
        """Note what came of a batch as soon as it is known: no other waits for a worker that is out of reach.

        What it told has come before, and need not be fetched by way of the scheduler.
        """
        from distributed.protocol.pickle import loads

        found: Any
        try:
            found = await future.exception()
            told = self._told.pop(future.key, None)
            if found is None:
                found = await future if told is None else loads(told)
        except Exception as error:
            found = error
        self._ready.put((future.key, found))

    def _hear(self, event: tuple[float, tuple[str, bytes]]) -> None:
        _, (key, told) = event
        self._told[key] = told

    def _send(self) -> None:
        """Send batches in one call: most of what a graph costs, it costs for all of them.

        Each is told its rank, as Dask would begin with the first one of every call.
        """
        from dask import annotate

        free = BATCHES * self.workers - len(self._flying)
        if free < min(BATCHES * self.workers // 2, TOGETHER):
            return
        batches: list[list[Given]] = []
        while len(batches) < free and (batch := self._next_batch()):
            batches.append(batch)
        if not batches:
            return
        guard: Guard = run_guarded
        given: dict[str, Any] = {"seconds": self._limits.seconds}
        if self._terms is not None:
            guard, given = run_on_terms, given | {"terms": self._terms}
        # Never met again, not even by a second try.
        keys = [f"{batch[0].task.stage}-{uuid.uuid4().hex}" for batch in batches]
        urgency = {key: -batch[0].rank for key, batch in zip(keys, batches, strict=True)}
        functions = [batch[0].function for batch in batches]
        tasks = [[one.task for one in batch] for batch in batches]
        how = {"guard": guard, "given": given, "topic": self._topic}
        try:
            with annotate(priority=urgency.get):
                futures = self._client.map(_run_batch, functions, tasks, key=keys, pure=False, retries=0, **how)
        except Exception:  # a function that cannot be sent
            for given_back in itertools.chain(*batches):
                self._wait_with(given_back)
            raise
        for future, batch in zip(futures, batches, strict=True):
            self._flying[future.key] = (future, batch)
            self._client.loop.add_callback(self._follow, future)

    def _next_batch(self) -> list[Given]:
        """Take the next tasks to go together out of those that wait; empty if none does.

        They are of the stage that has the task of the lowest rank. How long one takes is known by those that were
        done; before that each goes alone.
        """
        if not self._waiting:
            return []
        stage = min(self._waiting, key=lambda one: self._waiting[one][0][:2])
        heap, mean = self._waiting[stage], self._mean.get(stage, BATCH)
        size = min(math.ceil(len(heap) / self.workers), max(int(BATCH / max(mean, 1e-3)), 1))
        batch = [heapq.heappop(heap)[2] for _ in range(size)]
        if not heap:
            del self._waiting[stage]
        return batch

    def _forget_names(self) -> None:
        from dask.utils import key_split

        self._submitted += 1
        if self._submitted % FORGET == 0:
            key_split.cache_clear()

    def _next(self) -> tuple[str, Any]:
        """Wait until a task is done. Dask waits for ever, or takes up a new scheduler without our tasks."""
        began = looked = time.monotonic()
        while True:
            self._check_scheduler()
            with suppress(Empty):
                return self._ready.get(timeout=0.1)
            if time.monotonic() - looked >= LOOK:
                looked = time.monotonic()
                if self._has_workers():
                    began = looked
                elif looked - began >= NO_WORKERS:
                    raise ClusterError(
                        f"the Dask scheduler has no worker for {looked - began:.0f} s, bound {NO_WORKERS:g} s; "
                        "start some, the same command goes on where it ended"
                    )

    def _forgives(self, task: Task, death: Failure) -> bool:
        """Tell whether a task is sent again as if it had not begun, whose worker died with it."""
        return False

    def _has_workers(self) -> bool:
        try:
            return bool(self._client.nthreads())
        except (OSError, RuntimeError, CancelledError):
            self._check_scheduler()
            return True

    def _check_scheduler(self) -> None:
        if self._is_lost():
            raise ClusterError(
                "the connection to the Dask scheduler is lost; all that was done is kept: start a scheduler and "
                "workers, the same command goes on where it ended"
            )

    def _is_lost(self) -> bool:
        """Tell whether the client has lost its scheduler since it sent what is in flight."""
        comm = self._client.scheduler_comm
        return self._client.status != "running" or comm is None or comm.comm.closed() or self._lost

    @property
    def _address(self) -> str:
        return str(self._client.scheduler.address)

    def _find_mismatch(self) -> ClusterMismatchError | None:
        """Ask somebody's workers again: one may have joined that cannot even read a task, and dies of it."""
        if self._terms is None:
            return None
        try:
            check_cluster(self._client, self._address, self._terms, late=True)
        except ClusterMismatchError as error:
            return error
        except UnansweredError:  # one is out of reach: what the others run is theirs
            return None
        except (OSError, RuntimeError, CancelledError):
            self._check_scheduler()
        return None

    def _bystander(self, ticket: int) -> Failure | None:
        """What came of a task that had not begun in a worker that died; None if it must be sent again."""
        if mismatch := self._find_mismatch():
            return Failure(mismatch)
        if self._sent[ticket] < BYSTANDER:
            return None
        return Failure(WorkerError(f"{BYSTANDER} workers died before they began it; look at their logs"))

    def _cancel(self) -> set[int]:
        if self._is_lost():
            raise CancelledError
        futures = [future for future, _ in self._flying.values() if not future.done()]
        keys = {future.key for future in futures}
        self._client.cancel(futures)
        clean = 0
        while clean < 2:  # twice, as a task may be on its way to a worker
            time.sleep(0.05)
            if self._is_lost():
                raise CancelledError
            held = set().union(*self._client.run(_held, on_error="ignore").values())
            clean = 0 if held & keys else clean + 1
        return {given.ticket for key in keys for given in self._flying.pop(key)[1]}

    def _outcome(self, found: Any, ticket: int, task: Task) -> Record | Failure | None:
        """What came of a task; None if it must be sent again."""
        from distributed import KilledWorker

        match found:
            case Record():
                return found
            case Failure():
                return tell_memory(found, self._limits) if found.kind == "memory" else found
            case Refusal():
                return Failure(tell_refusal(found, self._address))
            case KilledWorker():
                death = tell_death(task, self._limits)
                if death is not None and self._forgives(task, death):
                    return None
                return death or self._bystander(ticket)
            case CancelledError():  # nobody but a lost scheduler does that
                self._lost = True
                self._check_scheduler()
        # What Dask itself raises: a module that a worker lacks.
        return Failure(self._find_mismatch() or found)


def _run_batch(
    function: Function, tasks: Sequence[Task], *, guard: Guard, given: Mapping[str, Any], topic: str
) -> _Done:
    """Run tasks one after the other, in a worker; what came of them is told, and given to who asks for it."""
    from distributed import get_worker
    from distributed.protocol.pickle import dumps

    begin = time.perf_counter()
    outcomes = [guard(function, task, **given) for task in tasks]
    done = _Done(outcomes, time.perf_counter() - begin)
    worker = get_worker()
    worker.log_event(topic, (worker.get_current_task(), dumps(done)))
    return done


@contextmanager
def local(workers: int, limits: Limits | None = None, *, dashboard: str = ANYWHERE) -> Iterator[Executor]:
    """Run tasks in Dask's worker processes of one thread each on this machine; they end with the context.

    Parameters
    ----------
    workers : int
        Number of processes.
    limits : Limits, optional
        What a task may take; by default its share of the machine's memory, and any time. A worker that dies is
        replaced.
    dashboard : str
        Where the HTTP server of the scheduler listens, ``HOST:PORT``.
    """
    fork_server.begin(dask=True)
    from dask import config
    from distributed import Client, LocalCluster

    from tiler.executors.worker_setup import WorkerSetup

    limits = limits or Limits(memory=share_memory(workers))
    # Everything is bound to this machine, on free ports: two runs do not meet. A dead process shows by its closed
    # connection, so a worker that is silent because its task holds the interpreter is let live. One that dies is
    # started again by its nanny: the cluster would give up one that just starts 15 s after an earlier one died.
    settings = {
        **SCHEDULER,
        **WORKER,
        **BOTH,
        "distributed.nanny.pre-spawn-environ": dict(fork_server.ENVIRONMENT),
        "distributed.worker.multiprocessing-method": fork_server.METHOD,
        "distributed.worker.daemon": False,
        "distributed.scheduler.worker-ttl": None,
        "distributed.deploy.lost-worker-timeout": "3650 days",
    }
    with (
        config.set(settings),
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
        client.register_plugin(WorkerSetup(int(REFUSE_AT * limits.memory)))
        try:
            yield Dask(client, workers, limits, cluster.scheduler)
        except KeyboardInterrupt:  # at once: nobody waits for what workers are at
            _kill_workers(cluster)
            raise


def _kill_workers(cluster: Any) -> None:
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        with suppress(OSError, TypeError):
            os.kill(nanny.pid, signal.SIGKILL)


def _held(dask_worker: Any) -> list[str]:
    return list(dask_worker.state.tasks)
