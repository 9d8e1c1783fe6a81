"""A run as lines of text: where there is no terminal, and what stays above the live view of one."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

from tiler.engine.stage import Scope
from tiler.engine.task import Record
from tiler.monitoring.tally import StageTally, Tally, format_duration
from tiler.monitoring.watchers import Item, RunStart, Watcher
from tiler.words.note_words import say_notes
from tiler.words.plain_text import printable
from tiler.words.stage_groups import group_of_stage, title_of_stage

LISTED_FAILURES = 20  # that are told when they happen; the record has all
EVERY = 60.0  # s without a line, after which one says how far a stage is


@dataclass(frozen=True)
class Line:
    """A line of text, and whether it tells of a failure."""

    text: str
    bad: bool = False


class Lines(Watcher):
    """Makes the lines that a run leaves behind.

    Parameters
    ----------
    put : callable
        Takes one line.
    verbose : bool
        A line for each item too.
    """

    def __init__(self, put: Callable[[Line], None], *, verbose: bool = False) -> None:
        self._put, self._verbose = put, verbose
        self._tally = Tally()
        self._told: set[str] = set()
        self._failures = 0

    def begin(self, start: RunStart) -> None:
        """Take the stages that are known from the start."""
        self._tally.begin(start)

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        """Take note of how many items a stage has."""
        self._tally.planned(stage, scope, total)

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Tell a finished group of stages, or each item."""
        self._tally(stage, done, total, record)
        if self._verbose:
            what = "was there" if record.reused else f"{record.seconds.get('all', 0.0):.2f} s"
            notes = "".join(f", {say_notes(kind, n)}" for kind, n in record.notes.items())
            self._put(Line(f"    {title_of_stage(stage)} {record.name}  {what}{notes}"))
        if done == total:
            self._describe_group(group_of_stage(stage))

    def _describe_group(self, group: str) -> None:
        """Tell a group when nothing of it is left."""
        state = self._tally.groups()[group]
        if not state.left and group not in self._told:
            self._told.add(group)
            self._put(Line(describe_group(group, state)))

    def failed(self, stage: str, name: str, reason: str, needs: Item | None = None) -> None:
        """Tell a failure; an item that is not run because of it only where each item is told."""
        self._tally.failed(stage, name, reason, needs)
        self._failures += needs is None
        if self._verbose or (needs is None and self._failures <= LISTED_FAILURES):
            self._put(Line(f"failed: {title_of_stage(stage)} {name}: {reason}", bad=True))
        elif needs is None and self._failures == LISTED_FAILURES + 1:
            self._put(Line("failed: more than that; run.json will list all", bad=True))

    def say(self, text: str) -> None:
        """Tell it."""
        self._put(Line(text))


class PlainView(Watcher):
    """Prints lines; where nothing else is to be told for long, how far the run is.

    Parameters
    ----------
    tally : Tally
        Told before this one.
    verbose : bool
        A line for each item too.
    every : float
        Seconds without a line, after which one says how far a stage is.
    """

    def __init__(self, tally: Tally, *, verbose: bool = False, every: float = EVERY) -> None:
        self._tally, self._every = tally, every
        self._lines = Lines(self._print, verbose=verbose)
        self._printed = time.monotonic()

    def begin(self, start: RunStart) -> None:
        """Take the stages that are known from the start."""
        self._lines.begin(start)

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        """Take note of how many items a stage has."""
        self._lines.planned(stage, scope, total)

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Print what there is to tell."""
        self._lines(stage, done, total, record)
        if done < total and time.monotonic() - self._printed >= self._every:
            left = self._tally.time_left()
            words = f", ~ {format_duration(left)} left" if left is not None else ""
            group = group_of_stage(stage)
            state = self._tally.groups()[group]
            self._print(Line(f"  {group}: {state.done:,} of {state.total:,} tasks{words}"))

    def failed(self, stage: str, name: str, reason: str, needs: Item | None = None) -> None:
        """Print a failure."""
        self._lines.failed(stage, name, reason, needs)

    def say(self, text: str) -> None:
        """Print it."""
        self._lines.say(text)

    def _print(self, line: Line) -> None:
        self._printed = time.monotonic()
        print(printable(line.text), flush=True)


class QuietView(Watcher):
    """Prints failures alone, to where errors go."""

    def __init__(self) -> None:
        self._lines = Lines(lambda line: print(printable(line.text), file=sys.stderr))

    def failed(self, stage: str, name: str, reason: str, needs: Item | None = None) -> None:
        """Print a failure."""
        self._lines.failed(stage, name, reason, needs)


def describe_group(group: str, state: StageTally) -> str:
    """Write a finished group of stages, and number and time of its tasks.

    Examples
    --------
    >>> describe_group("terrain", StageTally(37, done=37, seconds=1.5))
    '  terrain          37 tasks      1.50 s'
    >>> describe_group("points", StageTally(1, done=1))
    '  points            1 task       0.00 s'
    """
    tasks = "task " if state.total == 1 else "tasks"
    failed = f"  {state.failed:,} failed" if state.failed else ""
    return f"  {group:<14} {state.total:>4,} {tasks}  {state.seconds:8.2f} s{failed}"
