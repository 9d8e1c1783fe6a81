"""The interface of executors, and the one that runs tasks in this process; see `tiler.executors.dask_executor`."""

from collections import deque
from collections.abc import Sequence
from typing import Protocol

from tiler.engine.submission import Function, Outcome, Part, run_parts
from tiler.engine.task import Failure, Task, run_task
from tiler.engine.task_limits import Limits, describe_memory

PER_WORKER, LEAST = 8, 8  # submissions that are not done


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


def _run(function: Function, task: Task) -> Outcome:
    outcome = run_task(function, task)
    if isinstance(outcome, Failure) and outcome.kind == "memory":
        return describe_memory(outcome, Limits())
    return outcome
