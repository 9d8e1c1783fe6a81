"""What a run logs, by Python's `logging`: logger ``citystitch``, and how its lines are shown.

Levels: ``ERROR`` for items that failed, ``INFO`` for finished groups of stages and sentences for the user,
``DEBUG`` for each item. How far a long stage is comes at ``INFO`` from the logger ``citystitch.progress``.
"""

import logging
import time

from tiler.engine.submission import Item
from tiler.engine.task import Record
from tiler.engine.watcher import Watcher
from tiler.monitoring.tally import StageTally, Tally, format_duration
from tiler.words.note_words import say_notes
from tiler.words.plain_text import printable
from tiler.words.stage_groups import group_of_stage, title_of_stage

LOGGER = logging.getLogger("citystitch")
LOGGER.addHandler(logging.NullHandler())
PROGRESS = LOGGER.getChild("progress")
LISTED_FAILURES = 20  # that are logged as errors; the record has all
EVERY = 60.0  # s without a line, after which one says how far a stage is


class RunLog(Tally):
    """Logs what happens in a run.

    Parameters
    ----------
    every : float
        Seconds without a line, after which one says how far a stage is.
    """

    def __init__(self, *, every: float = EVERY) -> None:
        super().__init__()
        self._every, self._logged = every, time.monotonic()
        self._ended: set[str] = set()  # groups

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        """Log a finished group of stages, or each item."""
        super().done(stage, n_done, total, record)
        if LOGGER.isEnabledFor(logging.DEBUG):
            what = "was there" if record.reused else f"{record.seconds.get('all', 0.0):.2f} s"
            notes = "".join(f", {say_notes(kind, n)}" for kind, n in record.notes.items())
            self._log(logging.DEBUG, f"    {title_of_stage(stage)} {record.name}  {what}{notes}")
        group = group_of_stage(stage)
        if n_done == total:
            state = self.groups()[group]
            if not state.left and group not in self._ended:
                self._ended.add(group)
                self._log(logging.INFO, describe_group(group, state))
        elif PROGRESS.isEnabledFor(logging.INFO) and time.monotonic() - self._logged >= self._every:
            left, state = self.time_left(), self.groups()[group]
            words = f", ~ {format_duration(left)} left" if left is not None else ""
            self._log(logging.INFO, f"  {group}: {state.done:,} of {state.total:,} tasks{words}", PROGRESS)

    def failed(
        self, stage: str, name: str, reason: str, needs: Item | None = None, *, ends_run: bool = False
    ) -> None:
        """Log a failure; as an error if the run goes on and it is none of many, and for want of no other item."""
        super().failed(stage, name, reason, needs)
        is_error = needs is None and not ends_run and self.failures <= LISTED_FAILURES
        self._log(
            logging.ERROR if is_error else logging.DEBUG, f"failed: {title_of_stage(stage)} {name}: {reason}"
        )
        if needs is None and self.failures == LISTED_FAILURES + 1:
            self._log(logging.ERROR, "failed: more than that; run.json will list all")

    def say(self, text: str) -> None:
        """Log a sentence for the user."""
        self._log(logging.INFO, text)

    def _log(self, level: int, text: str, logger: logging.Logger = LOGGER) -> None:
        self._logged = time.monotonic()
        logger.log(level, text)


class PrintableFormatter(logging.Formatter):
    """Writes a record as one line without control characters."""

    def format(self, record: logging.LogRecord) -> str:
        """Give the line."""
        return printable(record.getMessage())


class LogView(Watcher):
    """Shows by a handler what a run logs, until the run ends.

    Parameters
    ----------
    handler : logging.Handler
        Takes the records.
    level : int
        Least level that is shown.
    """

    def __init__(self, handler: logging.Handler, level: int = logging.INFO) -> None:
        handler.setLevel(level)
        handler.setFormatter(PrintableFormatter())
        self._handler, self._level_before = handler, LOGGER.level
        if not LOGGER.isEnabledFor(level):
            LOGGER.setLevel(level)
        LOGGER.addHandler(handler)

    def end(self, status: str, error: str = "") -> None:
        """Take the handler away."""
        LOGGER.removeHandler(self._handler)
        LOGGER.setLevel(self._level_before)


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
