"""A submission: tasks of one item that a worker runs one after the other, each with a result of its own."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.data.errors import CityError
from tiler.engine.keys import OpenKey
from tiler.engine.stage import Facts
from tiler.engine.task import Failure, Later, Record, Task, describe_trace

Function = Callable[[Task], Facts | None]
Outcome = Record | Failure | Later
Item = tuple[str, str]  # stage and name


@dataclass(eq=False)
class Part:
    """A task of a submission."""

    function: Function  #: function of its stage
    task: Task  #: the task; without its key where that is open
    #: what the key is made of, where the task reads a result of a part before it; None where the key is known
    key: OpenKey | None = None

    def close(self, done: Mapping[Item, Record]) -> bool:
        """Give the task its key by what the parts before it came to; False if one that it reads has no result.

        Raises
        ------
        InputError
            If a result that a part before it names cannot be read.
        """
        if self.key is None:
            return True
        if any(one not in done for one in self.key.awaited()):
            return False
        self.task.key, self.task.refs = self.key.close(done, self.task.store)
        return True


def run_parts(
    parts: Sequence[Part],
    run: Callable[[Function, Task], Outcome],
    goes_on: Callable[[], bool] = lambda: True,
) -> list[Outcome | None]:
    """Run the tasks of a submission one after the other.

    Parameters
    ----------
    parts : sequence of Part
        In an order in which each comes after those that it reads.
    run : callable
        Runs one task.
    goes_on : callable
        Asked before each; if it says no, nothing more is begun.

    Returns
    -------
    list of Record, Failure, Later or None
        What each came to; None if it was not begun, as a part that it reads has no result.
    """
    outcomes: list[Outcome | None] = []
    ended: list[float] = []
    done: dict[Item, Record] = {}
    for part in parts:
        outcome: Outcome | None = None
        try:
            if goes_on() and part.close(done):
                outcome = run(part.function, part.task)
        except CityError as error:
            outcome = Failure(error, describe_trace(error))
        if isinstance(outcome, Record):
            done[outcome.stage, outcome.name] = outcome
        elif isinstance(outcome, Failure) and part is not parts[-1]:
            outcome.error.with_traceback(None)  # it holds what the function had in memory
        outcomes.append(outcome)
        ended.append(time.perf_counter())
    return [
        replace(outcome, ago=round(ended[-1] - end, 4)) if isinstance(outcome, Record) else outcome
        for outcome, end in zip(outcomes, ended, strict=True)
    ]
