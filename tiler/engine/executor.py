"""The interface of executors, and the one that runs tasks in this process; see `tiler.executors.dask_executor`."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from tiler.engine.submission import Function, Outcome, Part, run_parts
from tiler.engine.task import Failure, Record, Task, find_earlier, run_task
from tiler.engine.task_limits import Limits, describe_memory

PER_WORKER, LEAST = 8, 8  # submissions that are not done
FOUND_HERE = 256  # submissions whose earlier results are looked for without workers


class Executor(Protocol):
    """What the engine asks of an executor; ``ticket`` is any number of the engine's."""

    workers: int

    @property
    def window(self) -> int:
        """Number of submissions that should be made and not done; more when workers come."""

    def submit(self, ticket: int, parts: Sequence[Part], rank: int = 0) -> None:
        """Take tasks that one worker runs one after the other.

        Of the submissions that wait, an executor may let the one of the lowest rank begin first.
        """

    def wait(self) -> tuple[int, list[Outcome | None]]:
        """Wait until any submission is done.

        Returns its ticket, and for each of its tasks the record, the failure, or None if it was not begun.
        """

    def drop_waiting(self) -> set[int]:
        """Give up what is not done, and wait for what runs; returns the tickets of all that was given up."""


class Serial:
    """One task after the other in this process; no limits, and a crash ends all."""

    workers = 1
    window = LEAST

    def __init__(self) -> None:
        self._queue: deque[tuple[int, Sequence[Part]]] = deque()

    def submit(self, ticket: int, parts: Sequence[Part], rank: int = 0) -> None:
        """Take tasks; they run in the order of submission."""
        self._queue.append((ticket, parts))

    def wait(self) -> tuple[int, list[Outcome | None]]:
        """Run the oldest submission."""
        ticket, parts = self._queue.popleft()
        return ticket, run_parts(parts, _run)

    def drop_waiting(self) -> set[int]:
        """Forget all."""
        dropped = {ticket for ticket, _ in self._queue}
        self._queue.clear()
        return dropped


class OnDemand:
    """Workers that start with the first task that has no earlier result: a run with nothing to do needs none.

    This process looks for the results of at most `FOUND_HERE` submissions: workers are quicker with more.

    Parameters
    ----------
    workers : int
        Number of workers that there will be.
    start : callable
        Starts them.
    """

    def __init__(self, workers: int, start: Callable[[], Executor]) -> None:
        self.workers = workers
        self._start = start
        self._executor: Executor | None = None
        self._left = FOUND_HERE
        self._done: deque[tuple[int, list[Outcome | None]]] = deque()

    @property
    def window(self) -> int:
        """Some for each worker."""
        return max(PER_WORKER * self.workers, LEAST) if self._executor is None else self._executor.window

    def submit(self, ticket: int, parts: Sequence[Part], rank: int = 0) -> None:
        """Take tasks: find their results, or give them to workers."""
        if self._executor is None and self._left:
            self._left -= 1
            found = run_parts(parts, lambda _, task: find_earlier(task))
            if all(isinstance(one, Record) for one in found):
                self._done.append((ticket, found))
                return
        if self._executor is None:
            self._executor = self._start()
        self._executor.submit(ticket, parts, rank)

    def wait(self) -> tuple[int, list[Outcome | None]]:
        """Wait until any submission is done."""
        if self._done or self._executor is None:
            return self._done.popleft()
        return self._executor.wait()

    def drop_waiting(self) -> set[int]:
        """Give up what workers have not done."""
        return set() if self._executor is None else self._executor.drop_waiting()


def _run(function: Function, task: Task) -> Outcome:
    outcome = run_task(function, task)
    if isinstance(outcome, Failure) and outcome.kind == "memory":
        return describe_memory(outcome, Limits())
    return outcome
