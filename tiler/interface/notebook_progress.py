"""How far a run is, shown in a notebook: a bar for all tasks, one for each step in hand, failures, messages."""

import html
import sys
import time
from typing import Any

from tiler.engine.submission import Item
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart
from tiler.monitoring.tally import Tally
from tiler.words.stage_groups import title_of_stage

EVERY = 0.25  # s between two updates of the output
LISTED = 5  # failures and messages that are shown


def in_notebook() -> bool:
    """Return whether output goes to a notebook: IPython has a kernel then."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and hasattr(shell, "kernel")


class NotebookProgress(Tally):
    """Shows how far a run is in the output of the cell that runs.

    Notes
    -----
    The output is one display that is replaced, at most every `EVERY` seconds and at the end; no widgets of the
    notebook are needed. Text that comes from data is escaped.
    """

    def __init__(self) -> None:
        super().__init__()
        self._drawn = 0.0
        self._failed: list[str] = []
        self._said: list[str] = []
        self._end = ""
        self._display: Any = None

    def begin(self, start: RunStart) -> None:
        """Show all stages that are known."""
        super().begin(start)
        self._draw()

    def submitted(self, stage: str, name: str) -> None:
        """Take note of an item that was given to a worker."""
        super().submitted(stage, name)
        self._draw_sometimes()

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        """Take note of an item that is done."""
        super().done(stage, n_done, total, record)
        self._draw_sometimes()

    def failed(
        self, stage: str, name: str, reason: str, needs: Item | None = None, *, ends_run: bool = False
    ) -> None:
        """Take note of an item that failed."""
        super().failed(stage, name, reason, needs)
        if needs is None:
            self._failed.append(f"{title_of_stage(stage)} {name}: {reason}")
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
        done, total = self._counts()
        failed = f", {len(self._failed):,} failed" if self._failed else ""
        state = f" - {self._end}" if self._end else ""
        return f"{done:,} of {total:,} tasks, {self.elapsed:.0f} s{failed}{state}"

    def _counts(self) -> tuple[int, int]:
        stages = self.stages.values()
        return sum(stage.done for stage in stages), sum(stage.total for stage in stages)

    def _page(self) -> str:
        rows = [_bar("all tasks", *self._counts())]
        rows += [
            _bar(name, group.done, group.total)
            for name, group in self.groups().items()
            if group.running and not self._end
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
