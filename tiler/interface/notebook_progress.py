"""How far a run is, shown in a notebook: a bar for all tasks, one for each step in hand, failures, messages."""

import html
import sys
import time
from typing import Any

from tiler.engine.watcher import RunStart
from tiler.monitoring.events import Event
from tiler.monitoring.run_state import RunState
from tiler.monitoring.watchers import EventWatcher
from tiler.words.stage_groups import title_of_stage

EVERY = 0.25  # s between two updates of the output
LISTED = 5  # failures and messages that are shown


def in_notebook() -> bool:
    """Return whether output goes to a notebook: IPython has a kernel then."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and hasattr(shell, "kernel")


class NotebookProgress(EventWatcher):
    """Shows how far a run is in the output of the cell that runs.

    Notes
    -----
    The output is one display that is replaced, at most every `EVERY` seconds and at the end; no widgets of the
    notebook are needed. Text that comes from data is escaped.
    """

    def __init__(self) -> None:
        self._state, self._began = RunState(), time.perf_counter()
        self._drawn = 0.0
        self._failed: list[str] = []
        self._said: list[str] = []
        self._end = ""
        self._display: Any = None

    def take(self, event: Event, state: RunState) -> None:
        """Take note of an event; a message waits for the next update, since a signal's handler may send it."""
        self._state = state
        if event["event"] == "message":
            self._said.append(event["text"])
            return
        if event["event"] == "failed" and "needs" not in event:
            self._failed.append(f"{title_of_stage(event['stage'])} {event['name']}: {event['reason']}")
        if event["event"] in {"submitted", "done", "failed"} and time.perf_counter() - self._drawn >= EVERY:
            self._draw()

    def begin(self, start: RunStart) -> None:
        """Show all stages that are known."""
        self._draw()

    def end(self, status: str, error: str = "") -> None:
        """Show the end."""
        self._end = f"{status}: {error}" if error else status
        self._draw()

    def _draw(self) -> None:
        from IPython.display import display

        self._drawn = time.perf_counter()
        data = {"text/plain": self._line(), "text/html": self._page()}
        if self._display is None:
            self._display = display(data, raw=True, display_id=True)  # type: ignore[no-untyped-call]
        else:
            self._display.update(data, raw=True)

    def _line(self) -> str:
        done, total = self._counts()
        failed = f", {len(self._failed):,} failed" if self._failed else ""
        state = f" - {self._end}" if self._end else ""
        return f"{done:,} of {total:,} tasks, {time.perf_counter() - self._began:.0f} s{failed}{state}"

    def _counts(self) -> tuple[int, int]:
        stages = self._state.stages.values()
        return sum(stage.done for stage in stages), sum(stage.total for stage in stages)

    def _page(self) -> str:
        rows = [_bar("all tasks", *self._counts())]
        rows += [
            _bar(name, group.done, group.total)
            for name, group in self._state.groups().items()
            if group.in_hand and not self._end
        ]
        lists = [("failed", self._failed), ("", self._said)]
        told = "".join(_list(title, lines) for title, lines in lists if lines)
        return f"<div><table>{''.join(rows)}</table><p>{html.escape(self._line())}</p>{told}</div>"


def _bar(title: str, done: int, total: int) -> str:
    bar = f'<progress value="{done}" max="{max(total, 1)}" aria-label="{html.escape(title)}"></progress>'
    return f"<tr><th>{html.escape(title)}</th><td>{bar}</td><td>{done:,} / {total:,}</td></tr>"


def _list(title: str, lines: list[str]) -> str:
    more = [f"and {len(lines) - LISTED:,} before"] if len(lines) > LISTED else []
    items = "".join(f"<li>{html.escape(line)}</li>" for line in [*more, *lines[-LISTED:]])
    heading = f"<b>{html.escape(title)}</b>" if title else ""
    return f"{heading}<ul>{items}</ul>"
