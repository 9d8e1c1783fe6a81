"""Tasks on the workers of a Dask scheduler, on this machine or anywhere."""

import asyncio
import time
import uuid
from collections import Counter, deque
from collections.abc import Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from itertools import count
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from pipeline.data.errors import CityError
from tiler.engine.executor import LEAST, PER_WORKER
from tiler.engine.submission import Outcome, Part, run_parts
from tiler.engine.task import Failure, Task
from tiler.engine.task_limits import Limits, WorkerError, describe_death, describe_memory, run_guarded
from tiler.executors.worker_requirements import (
    ClusterMismatchError,
    Mismatch,
    Requirements,
    UnansweredError,
    check_cluster,
    find_mismatch,
)

BYSTANDER = 20  # how often tasks may be lost with a worker that died before they began, before it is an error
LOOK = 5.0  # s without a result, after which the scheduler is asked whether it has workers
NO_WORKERS = 300.0  # s without any worker, after which a run ends; a busy machine starts them slowly


class ClusterError(CityError):
    """The Dask cluster of a run is gone: start it again, the same command goes on."""


class _Given(NamedTuple):
    """Tasks as the engine submitted them."""

    ticket: int
    parts: Sequence[Part]
    rank: int


class DaskExecutor:
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
    requirements : Requirements, optional
        What a worker must meet that was not started from here. A task that comes back from one that does not meet
        them fails with a `ClusterMismatchError`, which ends a run.

    Notes
    -----
    Where a worker dies, Dask blames all that it had. Here a task is blamed if it had begun, which its trace
    file shows (`tiler.engine.task_limits`); the others are sent again, and so are those before it in its
    submission, whose results are found in the store.

    Outcomes of a submission come as an event of Dask, in the stream of messages that reports it done: fetching
    the result of a future takes a connection and four messages each.
    """

    def __init__(
        self,
        client: Any,
        workers: int,
        limits: Limits | None = None,
        scheduler: Any | None = None,
        *,
        requirements: Requirements | None = None,
    ) -> None:
        self.workers, self.scheduler = workers, scheduler
        self._client, self._limits, self._requirements = client, limits or Limits(), requirements
        self._round = uuid.uuid4().hex  # of submissions that are dropped together
        self._number = count()
        self._waiting: list[_Given] = []
        self._sent: dict[str, tuple[Any, _Given]] = {}  # future and task by key
        self._over: list[Any] = []  # futures of what is done
        self._told: dict[str, bytes] = {}  # what workers say that submissions came to, by key
        self._ready: SimpleQueue[tuple[str, BaseException | None]] = SimpleQueue()  # key, and the error
        self._done: deque[tuple[int, list[Outcome | None]]] = deque()
        self._losses: Counter[int] = Counter()  # by ticket
        self._lost = False
        self._topic = f"citystitch-{self._round}"
        client.subscribe_topic(self._topic, self._hear)

    @property
    def window(self) -> int:
        """Some for each worker."""
        return max(PER_WORKER * self.workers, LEAST)

    def submit(self, ticket: int, parts: Sequence[Part], rank: int = 0) -> None:
        """Take tasks, the lower their rank the sooner they begin; ClusterError if the scheduler is lost."""
        self._check_scheduler()
        self._waiting.append(_Given(ticket, parts, rank))

    def wait(self) -> tuple[int, list[Outcome | None]]:
        """Wait until any submission is done.

        Raises
        ------
        ClusterError
            If the scheduler is lost, or has had no worker for `NO_WORKERS` seconds.
        """
        while not self._done:
            self._send()
            self._take(*self._next())
            # What else is there comes too, so that what follows from it is sent in one call.
            while not self._ready.empty():
                self._take(*self._next())
        return self._done.popleft()

    def drop_waiting(self) -> set[int]:
        """Let workers refuse what they have not begun, and wait until they have ended the rest.

        Without a scheduler nobody can be asked; what workers then still commit is what a task of that key gives.
        """
        dropped = {given.ticket for given in self._waiting}
        self._waiting.clear()
        try:
            self._check_scheduler()
            self._client.run(refuse_round, self._round, on_error="ignore")
            while self._sent:
                key, error = self._next()
                _, given = self._sent.pop(key)
                dropped.add(given.ticket)
                self._outcomes(key, error, given)
        except (OSError, RuntimeError, CancelledError, ClusterError):
            if not self._is_lost():
                raise
            dropped |= {given.ticket for _, given in self._sent.values()}
            self._sent.clear()
        self._told.clear()
        self._round = uuid.uuid4().hex
        return dropped

    def _send(self) -> None:
        """Send all that waits in one call, as most of what a call costs it costs once."""
        from dask import annotate
        from distributed.protocol.pickle import dumps

        self._over.clear()  # all at once: Dask would send a message for each
        if not self._waiting:
            return
        batch, self._waiting = self._waiting, []
        # Dask shows the stages; a second try has another key.
        keys = [
            f"{'+'.join(part.task.stage for part in given.parts)}-{self._round}{next(self._number)}"
            for given in batch
        ]
        priority = {key: -given.rank for key, given in zip(keys, batch, strict=True)}
        try:
            packed = [dumps(given.parts) for given in batch]
        except Exception:  # a function that cannot be sent
            self._waiting = batch
            raise
        with annotate(priority=priority.get):
            futures = self._client.map(
                run_and_tell,
                packed,
                keys,
                key=keys,
                pure=False,
                retries=0,
                topic=self._topic,
                seconds=self._limits.seconds,
                in_round=self._round,
                requirements=self._requirements,
            )
        self._sent.update((key, (future, given)) for key, future, given in zip(keys, futures, batch, strict=True))
        self._client.loop.add_callback(self._follow, futures)

    def _hear(self, event: tuple[float, tuple[str, bytes]]) -> None:
        """Take what a worker says that a submission came to."""
        key, packed = event[1]
        self._told[key] = packed

    async def _follow(self, futures: Sequence[Any]) -> None:
        """Put what submissions came to, or the error of one, into the queue when they are done."""
        await asyncio.gather(*map(self._follow_one, futures))

    async def _follow_one(self, future: Any) -> None:
        error = await future.exception()
        self._ready.put((future.key, CancelledError() if future.cancelled() else error))

    def _next(self) -> tuple[str, BaseException | None]:
        """Wait for the next that is done, and its error; Dask would wait for ever where there are no workers."""
        began = time.monotonic()
        while True:
            with suppress(Empty):
                key, error = self._ready.get(timeout=LOOK)
                if key in self._sent:
                    return key, error
                continue
            self._check_scheduler()
            now = time.monotonic()
            if self._has_workers():
                began = now
            elif now - began >= NO_WORKERS:
                raise ClusterError(
                    f"the Dask scheduler has no worker for {now - began:.0f} s, bound {NO_WORKERS:g} s; "
                    "start some, the same command goes on where it ended"
                )

    def _take(self, key: str, error: BaseException | None) -> None:
        """Take the outcomes of a submission; one that had not begun when its worker died is sent again."""
        future, given = self._sent.pop(key)
        outcomes = self._outcomes(key, error, given)
        self._over.append(future)
        if outcomes is None:
            self._losses[given.ticket] += 1
            self._waiting.append(given)
        else:
            self._losses.pop(given.ticket, None)
            self._done.append((given.ticket, outcomes))

    def _outcomes(self, key: str, error: BaseException | None, given: _Given) -> list[Outcome | None] | None:
        """Records and failures of a submission; None if it must be sent again."""
        from distributed import KilledWorker
        from distributed.protocol.pickle import loads

        packed = self._told.pop(key, None)
        if packed is None and error is None:
            raise ClusterError(f"a worker of the Dask cluster has not told what became of {key}; run again")
        match error if packed is None else loads(packed):
            case list() as found:
                return [
                    describe_memory(one, self._limits)
                    if isinstance(one, Failure) and one.kind == "memory"
                    else one
                    for one in found
                ]
            case Failure() as found:
                return _of_one(found, given)
            case Mismatch() as found:
                return _of_one(Failure(found.as_error(self._address)), given)
            case KilledWorker():
                return self._find_dead(given)
            case CancelledError():  # of a lost scheduler alone
                self._lost = True
                self._check_scheduler()
            case Exception() as found:  # of Dask itself: a module that a worker lacks
                return _of_one(Failure(self._find_mismatch() or found), given)
        return None  # dropped

    def _find_dead(self, given: _Given) -> list[Outcome | None] | None:
        """Find by its files which task a worker died of; None if the submission must be sent again."""
        for k, part in enumerate(given.parts):
            death = describe_death(part.task, self._limits)
            if death is not None:
                return None if self._forgives(part.task, death) else _of_one(death, given, k)
        failure = self._bystander(given.ticket)
        return None if failure is None else _of_one(failure, given)

    def _bystander(self, ticket: int) -> Failure | None:
        """Failure of what had not begun in a worker that died; None if it must be sent again."""
        if mismatch := self._find_mismatch():
            return Failure(mismatch)
        if self._losses[ticket] < BYSTANDER:
            return None
        return Failure(WorkerError(f"{BYSTANDER} workers died before they began it; look at their logs"))

    def _forgives(self, task: Task, death: Failure) -> bool:
        """Return whether a task is sent again as if it had not begun, whose worker died with it."""
        return False

    def _has_workers(self) -> bool:
        try:
            return bool(self._client.nthreads())
        except (OSError, RuntimeError, CancelledError):
            self._check_scheduler()
            return True

    def _find_mismatch(self) -> Exception | None:
        """Ask workers again: one may have joined that cannot even read a task, and dies of it."""
        if self._requirements is None:
            return None
        try:
            check_cluster(self._client, self._address, self._requirements, late=True)
        except ClusterMismatchError as error:
            return error
        except UnansweredError:  # one is out of reach: what the others run is theirs
            return None
        except (OSError, RuntimeError, CancelledError):
            self._check_scheduler()
        return None

    def _check_scheduler(self) -> None:
        if self._is_lost():
            raise ClusterError(
                "the connection to the Dask scheduler is lost; all that was done is kept: start a scheduler and "
                "workers, the same command goes on where it ended"
            )

    def _is_lost(self) -> bool:
        """Return whether the client has lost its scheduler since it sent what is in flight."""
        return self._lost or self._client.status != "running"

    @property
    def _address(self) -> str:
        return str(self._client.scheduler.address)


def _of_one(failure: Failure, given: _Given, k: int = 0) -> list[Outcome | None]:
    """The outcomes of a submission of which one task failed, and nothing is known of the others."""
    return [failure if k == number else None for number in range(len(given.parts))]


_REFUSED = set[str]()  # rounds, in a worker


def refuse_round(dropped: str) -> None:
    """In a worker: begin no task of a round any more."""
    _REFUSED.add(dropped)


def run_and_tell(packed: bytes, key: str, *, topic: str, **given: Any) -> None:
    """In a worker: run tasks by `run_packed`, and tell what they come to."""
    from distributed import get_worker
    from distributed.protocol.pickle import dumps

    get_worker().log_event(topic, (key, dumps(run_packed(packed, **given))))


def run_packed(
    packed: bytes, *, seconds: float, in_round: str, requirements: Requirements | None
) -> list[Outcome | None] | Failure | Mismatch | None:
    """In a worker: run tasks as they were sent; what cannot be read is a failure, None if they were dropped."""
    from distributed.protocol.pickle import loads

    if in_round in _REFUSED:
        return None
    if requirements is not None and (mismatch := find_mismatch(requirements)):
        return mismatch
    try:
        parts = loads(packed)
    except Exception as error:
        return Failure(RuntimeError(f"cannot be read by a worker: {type(error).__name__}: {error}"))
    return run_parts(
        parts, lambda function, task: run_guarded(function, task, seconds), lambda: in_round not in _REFUSED
    )
