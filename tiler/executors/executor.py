"""Where tasks run: in this process, or in worker processes of this machine; see `tiler.scheduler` for Dask's."""

import heapq
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Protocol

from tiler.engine.task import Failure, Record, Task, run_task
from tiler.engine.task_limits import Limits, share_memory, tell_memory
from tiler.executors.worker_processes import WEIGH, Crew, Function, Given

WINDOW, LEAST_WINDOW = 4, 8  # tasks in hand for each worker, and at least


class Executor(Protocol):
    """What the engine asks of an executor; ``ticket`` is any number of the engine's."""

    workers: int

    @property
    def window(self) -> int:
        """Number of tasks that it wants in hand, done or not; more when workers come."""

    def submit(self, ticket: int, function: Function, task: Task, rank: int = 0) -> None:
        """Take a task; of those that wait, an executor may let the one of the lowest rank begin first."""

    def wait(self) -> tuple[int, Record | Failure]:
        """Wait until any task is done; give its ticket and what came of it."""

    def drop_waiting(self) -> set[int]:
        """Give up what is not done; what runs has ended on return. Gives the tickets of all that was given up."""


class Serial:
    """One task after the other in this process; no limits, and a crash ends all."""

    workers = 1
    window = LEAST_WINDOW

    def __init__(self) -> None:
        self._queue: deque[tuple[int, Function, Task]] = deque()

    def submit(self, ticket: int, function: Function, task: Task, rank: int = 0) -> None:
        """Take a task; they run as they come."""
        self._queue.append((ticket, function, task))

    def wait(self) -> tuple[int, Record | Failure]:
        """Run the oldest task."""
        ticket, function, task = self._queue.popleft()
        outcome = run_task(function, task)
        if isinstance(outcome, Failure) and outcome.kind == "memory":
            outcome = tell_memory(outcome, Limits())
        return ticket, outcome

    def drop_waiting(self) -> set[int]:
        """Forget all."""
        dropped = {ticket for ticket, _, _ in self._queue}
        self._queue.clear()
        return dropped


class Processes:
    """Tasks in the worker processes of a crew.

    Parameters
    ----------
    crew : Crew
        The processes.
    """

    def __init__(self, crew: Crew) -> None:
        self.workers, self._crew = crew.workers, crew
        self._waiting: list[tuple[int, int, Given]] = []  # heap
        self._done: deque[tuple[int, Record | Failure]] = deque()

    @property
    def window(self) -> int:
        """Some a worker."""
        return max(2 * WINDOW * self.workers, LEAST_WINDOW)

    def submit(self, ticket: int, function: Function, task: Task, rank: int = 0) -> None:
        """Take a task; of those that wait, the one of the lowest rank begins first."""
        heapq.heappush(self._waiting, (rank, ticket, Given(ticket, function, task, rank)))

    def wait(self) -> tuple[int, Record | Failure]:
        """Wait until any task is done, and give it."""
        while not self._done:
            while self._waiting and self._crew.n_free:
                self._crew.give(self._waiting[0][2])
                heapq.heappop(self._waiting)
            self._collect()
        return self._done.popleft()

    def drop_waiting(self) -> set[int]:
        """Forget what has not begun, and wait for the rest."""
        dropped = {ticket for _, ticket, _ in self._waiting}
        self._waiting.clear()
        while self._crew.n_busy:
            self._collect()
        return dropped

    def _collect(self) -> None:
        self._done.extend((given.ticket, outcome) for given, outcome in self._crew.collect(WEIGH))


@contextmanager
def serial() -> Iterator[Executor]:
    """Run tasks in this process."""
    yield Serial()


@contextmanager
def processes(workers: int, limits: Limits | None = None) -> Iterator[Executor]:
    """Run tasks in worker processes of one thread each on this machine; they end with the context.

    Parameters
    ----------
    workers : int
        Number of processes. One that dies is replaced.
    limits : Limits, optional
        What a task may take; by default its share of the machine's memory, and any time.
    """
    with closing(Crew(workers, limits or Limits(memory=share_memory(workers)))) as crew:
        yield Processes(crew)
