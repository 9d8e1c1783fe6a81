"""What a run logs, by Python's `logging`: logger ``citystitch``, and how its lines are shown.

Levels: ``ERROR`` for items that failed, ``INFO`` for finished groups of stages and sentences for the user,
``DEBUG`` for each item. How far a long stage is comes at ``INFO`` from the logger ``citystitch.progress``.
"""

import logging
import time

from tiler.engine.watcher import Watcher
from tiler.monitoring.events import Event
from tiler.monitoring.run_state import RunState
from tiler.monitoring.stage_state import StageState, format_duration
from tiler.monitoring.watchers import EventWatcher
from tiler.words.note_words import say_notes
from tiler.words.plain_text import printable
from tiler.words.stage_groups import group_of_stage, title_of_stage

LOGGER = logging.getLogger("citystitch")
LOGGER.addHandler(logging.NullHandler())
PROGRESS = LOGGER.getChild("progress")
LISTED_FAILURES = 20  # that are logged as errors; the record has all
EVERY = 60.0  # s without a line, after which one says how far a stage is


class RunLog(EventWatcher):
    """Logs what happens in a run.

    Parameters
    ----------
    every : float
        Seconds without a line, after which one says how far a stage is.
    """

    def __init__(self, *, every: float = EVERY) -> None:
        self._every, self._logged = every, time.monotonic()
        self._ended: set[str] = set()  # groups

    def take(self, event: Event, state: RunState) -> None:
        """Log a finished group of stages, an item, a failure, or a sentence for the user."""
        match event["event"]:
            case "done":
                self._done(event, state)
            case "failed":
                self._failed(event, state)
            case "message":
                self._log(logging.INFO, event["text"])

    def _done(self, event: Event, state: RunState) -> None:
        if LOGGER.isEnabledFor(logging.DEBUG):
            what = "was there" if event["reused"] else f"{event['seconds']:.2f} s"
            notes = "".join(f", {say_notes(kind, n)}" for kind, n in event["notes"].items())
            self._log(logging.DEBUG, f"    {title_of_stage(event['stage'])} {event['name']}  {what}{notes}")
        group = group_of_stage(event["stage"])
        if event["done"] == event["total"]:
            so_far = state.groups()[group]
            if not so_far.left and group not in self._ended:
                self._ended.add(group)
                self._log(logging.INFO, describe_group(group, so_far))
        elif PROGRESS.isEnabledFor(logging.INFO) and time.monotonic() - self._logged >= self._every:
            left, so_far = state.time_left(time.time()), state.groups()[group]
            words = f", ~ {format_duration(left)} left" if left is not None else ""
            self._log(logging.INFO, f"  {group}: {so_far.done:,} of {so_far.total:,} tasks{words}", PROGRESS)

    def _failed(self, event: Event, state: RunState) -> None:
        """Log a failure; as an error if the run goes on and it is none of many, and for want of no other item."""
        own = "needs" not in event
        level = logging.DEBUG
        if own and "ends_run" not in event and state.n_own <= LISTED_FAILURES:
            level = logging.ERROR
        self._log(level, f"failed: {title_of_stage(event['stage'])} {event['name']}: {event['reason']}")
        if own and state.n_own == LISTED_FAILURES + 1:
            self._log(logging.ERROR, "failed: more than that; run.json will list all")

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


def describe_group(group: str, state: StageState) -> str:
    """Write a finished group of stages, and number and time of its tasks.

    Examples
    --------
    >>> describe_group("terrain", StageState(total=37, done=37, seconds=1.5))
    '  terrain          37 tasks      1.50 s'
    >>> describe_group("points", StageState(total=1, done=1))
    '  points            1 task       0.00 s'
    """
    tasks = "task " if state.total == 1 else "tasks"
    failed = f"  {state.failed:,} failed" if state.failed else ""
    return f"  {group:<14} {state.total:>4,} {tasks}  {state.seconds:8.2f} s{failed}"
