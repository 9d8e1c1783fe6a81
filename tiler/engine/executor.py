"""The interface of executors, and the one that runs tasks in this process; see `tiler.executors.dask_executor`."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from tiler.engine.stage import Facts
from tiler.engine.task import Failure, Record, Task, run_task
from tiler.engine.task_limits import Limits, describe_memory

Function = Callable[[Task], Facts]
Outcome = Record | Failure
TASKS_PER_WORKER, LEAST_TASKS = 8, 8  # submitted and not done


class Executor(Protocol):
    """What the engine asks of an executor; ``ticket`` is any number of the engine's."""

    workers: int

    @property
    def window(self) -> int:
        """Number of tasks that should be submitted and not done; more when workers come."""

    def submit(self, ticket: int, function: Function, task: Task, rank: int = 0) -> None:
        """Take a task; of those that wait, an executor may let the one of the lowest rank begin first."""

    def wait(self) -> tuple[int, Outcome]:
        """Wait until any task is done; returns its ticket and its record or failure."""

    def drop_waiting(self) -> set[int]:
        """Give up what is not done, and wait for what runs; returns the tickets of all that was given up."""


class Serial:
    """One task after the other in this process; no limits, and a crash ends all."""

    workers = 1
    window = LEAST_TASKS

    def __init__(self) -> None:
        self._queue: deque[tuple[int, Function, Task]] = deque()

    def submit(self, ticket: int, function: Function, task: Task, rank: int = 0) -> None:
        """Take a task; they run in the order of submission."""
        self._queue.append((ticket, function, task))

    def wait(self) -> tuple[int, Outcome]:
        """Run the oldest task."""
        ticket, function, task = self._queue.popleft()
        outcome = run_task(function, task)
        if isinstance(outcome, Failure) and outcome.kind == "memory":
            outcome = describe_memory(outcome, Limits())
        return ticket, outcome

    def drop_waiting(self) -> set[int]:
        """Forget all."""
        dropped = {ticket for ticket, _, _ in self._queue}
        self._queue.clear()
        return dropped


@contextmanager
def serial() -> Iterator[Executor]:
    """Run tasks in this process."""
    yield Serial()
