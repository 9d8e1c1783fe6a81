"""A run as lines of text: where there is no terminal, and what stays above the live view of one."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

from tiler.plain_text import printable
from tiler.tally import Tally, tell_duration
from tiler.task import Record
from tiler.watching import Item, Watcher

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
        self._seconds: dict[str, float] = {}
        self._failures = 0

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Tell a finished stage, or each item."""
        seconds = record.seconds.get("all", 0.0)
        self._seconds[stage] = self._seconds.get(stage, 0.0) + seconds
        if self._verbose:
            what = "was there" if record.reused else f"{seconds:.2f} s"
            notes = "".join(f", {n} {kind}" for kind, n in record.notes.items())
            self._put(Line(f"    {stage} {record.name}  {what}{notes}"))
        if done == total:
            self._put(Line(tell_stage(stage, total, self._seconds[stage])))

    def failed(self, stage: str, name: str, reason: str, needs: Item | None = None) -> None:
        """Tell a failure; an item that is not run because of it only where each item is told."""
        self._failures += needs is None
        if self._verbose or (needs is None and self._failures <= LISTED_FAILURES):
            self._put(Line(f"failed: {stage} {name}: {reason}", bad=True))
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

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Print what there is to tell."""
        self._lines(stage, done, total, record)
        if done < total and time.monotonic() - self._printed >= self._every:
            left = self._tally.time_left()
            words = f", ~ {tell_duration(left)} left" if left is not None else ""
            self._print(Line(f"  {stage} {done:,} of {total:,}{words}"))

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


def tell_stage(stage: str, total: int, seconds: float) -> str:
    """Write a finished stage, and the time of all its items.

    Examples
    --------
    >>> tell_stage("pieces", 9, 1.5)
    '  pieces (9)                       1.50 s'
    """
    return f"  {f'{stage} ({total})':<28} {seconds:8.2f} s"
