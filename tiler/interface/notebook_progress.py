"""How far a run is, shown in a notebook: a bar for all tasks, one for each step in hand, failures, messages."""

import html
import sys
import time
from typing import Any

from tiler.engine.stage import Scope
from tiler.engine.task import Record
from tiler.monitoring.watchers import Item, RunStart, Watcher
from tiler.words.stage_groups import group_stages, title_of_stage

EVERY = 0.25  # s between two updates of the output
LISTED = 5  # failures and messages that are shown


def in_notebook() -> bool:
    """Tell whether output goes to a notebook: IPython has a kernel then."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and hasattr(shell, "kernel")


class NotebookProgress(Watcher):
    """Watches a run, and shows it in the output of the cell that runs.

    Notes
    -----
    The output is one display that is replaced, at most every `EVERY` seconds and at the end; no widgets of the
    notebook are needed. Text that comes from data is escaped.
    """

    def __init__(self) -> None:
        self._begun, self._drawn = time.perf_counter(), 0.0
        self._totals: dict[str, int] = {}
        self._done: dict[str, int] = {}
        self._running: dict[str, int] = {}
        self._failures: list[str] = []
        self._said: list[str] = []
        self._end = ""
        self._display: Any = None

    def begin(self, start: RunStart) -> None:
        """Show all stages that are known."""
        self._totals = {stage: total for stage, (_, total) in start.expected.items()}
        self._draw()

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        """Take note of how many items a stage has."""
        self._totals[stage] = total

    def submitted(self, stage: str, name: str) -> None:
        """Take note of an item that was given to a worker."""
        self._running[stage] = self._running.get(stage, 0) + 1
        self._draw_sometimes()

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Take note of an item that is done."""
        self._done[stage], self._totals[stage] = done, total
        self._running[stage] = max(0, self._running.get(stage, 0) - 1)
        self._draw_sometimes()

    def failed(self, stage: str, name: str, reason: str, needs: Item | None = None) -> None:
        """Take note of an item that failed."""
        self._running[stage] = max(0, self._running.get(stage, 0) - 1)
        if needs is None:
            self._failures.append(f"{title_of_stage(stage)} {name}: {reason}")
        self._draw_sometimes()

    def say(self, text: str) -> None:
        """Keep a sentence; it is shown with the next update, since a signal's handler may be what says it."""
        self._said.append(text)

    def end(self, status: str, error: str = "") -> None:
        """Show the end."""
        self._end = f"{status}: {error}" if error else status
        self._draw()

    def _draw_sometimes(self) -> None:
        if time.perf_counter() - self._drawn >= EVERY:
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
        done, total = sum(self._done.values()), sum(self._totals.values())
        failed = f", {len(self._failures):,} failed" if self._failures else ""
        state = f" - {self._end}" if self._end else ""
        return f"{done:,} of {total:,} tasks, {time.perf_counter() - self._begun:.0f} s{failed}{state}"

    def _page(self) -> str:
        done, total = sum(self._done.values()), sum(self._totals.values())
        rows = [_bar("all tasks", done, total)]
        for group, stages in group_stages(self._totals).items() if not self._end else ():
            if any(self._running.get(stage) for stage in stages):
                counts = (sum(numbers.get(stage, 0) for stage in stages) for numbers in (self._done, self._totals))
                rows.append(_bar(group, *counts))
        lists = [("failed", self._failures), ("", self._said)]
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
