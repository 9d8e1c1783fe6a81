"""The live view of a run on a terminal: stages at work, workers, memory, warnings, time left."""

import logging
import threading
import time
from itertools import islice
from logging.handlers import QueueHandler
from queue import SimpleQueue

from rich.console import Console
from rich.live import Live
from rich.text import Text

from tiler.engine.watcher import RunStart
from tiler.monitoring.events import Event
from tiler.monitoring.run_log import PROGRESS, LogView
from tiler.monitoring.run_state import RunState
from tiler.monitoring.stage_state import StageState, format_duration
from tiler.monitoring.watchers import EventWatcher
from tiler.words.note_words import say_notes
from tiler.words.plain_text import printable

LEAST_EVERY = 0.5  # s between two pictures
SHARE = 0.005  # of the time that drawing may take
NAME, WORDS, BAR = 16, 38, 60  # characters: of a stage's name, of the words beside a bar, of a bar at most
WIDE = 110  # characters; from here on there is more to see
ROWS = 10  # stages at work that are shown
REST = 4  # rows of the view besides them, and the cursor's
FULL, EMPTY, PLAIN_FULL, PLAIN_EMPTY = "━", "─", "#", "-"


class LiveView(EventWatcher):
    """Shows a run in the last rows of a terminal, and above them what it logs.

    Parameters
    ----------
    console : Console
        The terminal.
    verbose : bool
        A line for each item too.

    Notes
    -----
    A thread of its own draws, and prints the lines that wait in a queue: who logs, a signal handler too, never
    waits. It draws as often as `SHARE` of the time allows.
    """

    def __init__(self, console: Console, *, verbose: bool = False) -> None:
        self._console, self._waiting = console, SimpleQueue[logging.LogRecord]()
        handler = QueueHandler(self._waiting)
        handler.addFilter(lambda record: record.name != PROGRESS.name)  # the bars show that
        self._log = LogView(handler, logging.DEBUG if verbose else logging.INFO)
        self._live = Live(console=console, auto_refresh=False, transient=True, vertical_overflow="crop")
        self._stop = threading.Event()
        self._state = RunState()
        self._thread = threading.Thread(target=self._draw_now_and_then, name="view", daemon=True)

    def take(self, event: Event, state: RunState) -> None:
        """Keep the state; print at once what was logged before the view begins."""
        self._state = state
        if not self._thread.is_alive():
            self._print_lines()

    def begin(self, start: RunStart) -> None:
        """Begin to draw."""
        self._live.start()
        self._thread.start()

    def end(self, status: str, error: str = "") -> None:
        """Take the view away, and print what waits."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._live.stop()
        self._print_lines()
        self._log.end(status, error)

    def _draw_now_and_then(self) -> None:
        pause = 0.0
        while not self._stop.wait(pause):
            began = time.thread_time()
            self._print_lines()
            size = self._console.size
            rows = draw(self._state, size.width, size.height, now=time.time(), plain=is_plain(self._console))
            self._live.update(rows, refresh=True)
            pause = max(LEAST_EVERY, (time.thread_time() - began) / SHARE)

    def _print_lines(self) -> None:
        records = [self._waiting.get() for _ in range(self._waiting.qsize())]
        if records:
            texts = (Text(one.getMessage(), "red" if one.levelno >= logging.ERROR else "") for one in records)
            self._console.print(Text("\n").join(texts))


def is_plain(console: Console) -> bool:
    """Return whether a terminal shows ASCII alone."""
    return not console.encoding.lower().startswith("utf")


def draw(run: RunState, width: int, height: int, *, now: float, plain: bool = False) -> Text:
    """Draw how far a run is.

    Parameters
    ----------
    width, height : int
        Characters and rows of the terminal.
    now : float
        The time (s since 1970).
    plain : bool
        In ASCII alone.

    Returns
    -------
    Text
        Rows that are shorter than `width`, and fewer than `height`: a terminal must not wrap or scroll them.
    """
    at_work = [(name, state) for name, state in run.groups().items() if state.in_hand and state.left]
    room = max(min(ROWS, height - REST), 0)
    shown = at_work if len(at_work) <= room else at_work[: max(room - 1, 0)]
    rows = [_draw_stage(name, state, width, now=now, plain=plain) for name, state in shown]
    if len(at_work) > len(shown) and room:
        rows.append(Text(f"  and {len(at_work) - len(shown)} more steps at work"))
    rows += [_draw_all(run, width, now=now, plain=plain), _draw_facts(run, width, now=now)]
    for row in rows:
        row.truncate(width - 1, overflow="ellipsis" if not plain else "crop")
    return Text("\n").join(rows)


def _draw_stage(name: str, state: StageState, width: int, *, now: float, plain: bool) -> Text:
    rate = _format_rate(state.rate(now))
    words = f" {f'{state.done:,}/{state.total:,}':>13} {rate:>9} {_format_mean(state):>13}"
    more = f"  {state.in_hand:,} in hand" if width >= WIDE else ""
    more += f"  {state.failed:,} failed" if state.failed else ""
    share = state.done / state.total if state.total else 0.0
    return (
        _bar(printable(name), share, width, plain=plain).append(words).append(more, "red" if state.failed else "")
    )


def _draw_all(run: RunState, width: int, *, now: float, plain: bool) -> Text:
    groups = list(run.groups().values())
    finished = sum(not state.left for state in groups)
    left, share = run.time_left(now), run.share_done(now)
    if not run.first:
        when = "starting"
    elif finished == len(groups):
        when = "writing it down"
    else:
        when = "" if left is None else f"~ {format_duration(left)} left"
    row = _bar("all", share, width, plain=plain)
    row.stylize("bold", 0, NAME)
    return row.append(f" {share:4.0%} {when:>15}  {finished:,} of {len(groups):,} steps")


def _draw_facts(run: RunState, width: int, *, now: float) -> Text:
    seconds = int(now - run.began)
    workers = _count(run.workers, "worker") if run.workers else "a cluster"
    parts = [f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}", workers]
    parts.append(f"{_count(len(run.at_work), 'task')} in hand")
    if run.memory:
        parts.append(f"peak {run.memory / 2**20:,.0f} MiB")
    row = Text("  " + ", ".join(parts))
    if run.n_own:
        row.append(f", {run.n_own:,} failed", "red")
    number = run.notes.total()
    if number:
        row.append(f", {_count(number, 'warning')}", "yellow")
        if width >= WIDE:
            kinds = islice(run.notes.most_common(), 5)
            row.append(": " + ", ".join(printable(say_notes(kind, n)) for kind, n in kinds))
    return row


def _bar(name: str, share: float, width: int, *, plain: bool) -> Text:
    """Draw a name and a bar; characters tell what is done, colours only help."""
    length = max(min(BAR, width - NAME - WORDS - 4), 4)
    done = int(length * min(share, 1.0))
    row = Text(f"  {name[:NAME]:<{NAME}} ")
    row.append((PLAIN_FULL if plain else FULL) * done, "green")
    return row.append((PLAIN_EMPTY if plain else EMPTY) * (length - done), "dim")


def _format_rate(rate: float) -> str:
    if not rate:
        return ""
    return f"{rate:,.1f}/s" if rate >= 1 else f"{60 * rate:.1f}/min"


def _format_mean(state: StageState) -> str:
    ran = state.done - state.reused
    return f"{state.seconds / ran:,.2f} s each" if ran > 0 else ""


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"
