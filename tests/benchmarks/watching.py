"""What watching costs: processor time of runs with and without it, in pairs, of each item, and within a run.

    python -m tests.benchmarks.watching [PAIRS]

The run is serial, in a pseudo-terminal, so that one process has all of it; seconds are the processor's. Pairs have
the noise of the machine, some per cent of each run, so what watchers and their threads take is measured within
the runs too.
"""

import os
import pty
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any
from unittest.mock import patch

from rich.console import Console

from tests.helpers.synthetic import city_files
from tiler.config.config import Config, make_config
from tiler.engine.stage import Scope
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart, Watcher
from tiler.monitoring.event_log import EventLog
from tiler.monitoring.events import begin_file
from tiler.monitoring.live_view import LiveView
from tiler.monitoring.run_log import RunLog
from tiler.monitoring.terminal import make_view
from tiler.monitoring.watchers import Watchers
from tiler.workflow.run import run

SIZE, BUILDINGS, TILE = 600.0, 220, 150.0  # m, number, m: 16 tiles
PAIRS = 12
CALLS = ("begin", "laid_out", "planned", "submitted", "done", "failed", "say", "end")
TILES = 100_000
FACTS = {
    "counts": {"cells": 8938, "facets": 1212, "seam faces": 542},
    "files": {"mesh/1.vtu": [68104, 1001886323]},
}


def seconds_of(config: Config, watchers: Sequence[Watcher], *, files: bool) -> float:
    """Processor time of a run."""
    began = time.process_time()
    if files:
        run(config, watchers=watchers)
    else:
        with patch("tiler.workflow.run_watchers.EventLog", lambda *_: Watcher()):
            run(config, watchers=watchers)
    return time.process_time() - began


class Clock:
    """Adds up the processor time of what is called through it, by thread."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def of(self, owner: type, name: str) -> Any:
        """Replace a method by one that is timed, for as long as the context lasts."""
        function = getattr(owner, name)

        def timed(*values: Any, **options: Any) -> Any:
            began = time.thread_time()
            try:
                return function(*values, **options)
            finally:
                self.seconds += time.thread_time() - began

        return patch.object(owner, name, timed)


def measure_share(config: Config, watchers: Sequence[Watcher]) -> float:
    """Share of a run's processor time in calls of all watchers and in their threads."""
    clock = Clock()
    with ExitStack() as stack:
        for name in CALLS:
            stack.enter_context(clock.of(Watchers, name))
        stack.enter_context(clock.of(EventLog, "_write_now_and_then"))
        stack.enter_context(clock.of(LiveView, "_draw_now_and_then"))
        seconds = seconds_of(config, watchers, files=True)
    return clock.seconds / seconds


def drain(file: int) -> None:
    """Read what a terminal is shown, until it is closed."""
    with suppress(OSError):
        while os.read(file, 65536):
            pass


def measure_pairs(pairs: int, folder: Path) -> tuple[list[tuple[float, float]], list[float]]:
    """Run in pairs, without and with all that watches; then watched ones whose watchers are timed."""
    ours, theirs = pty.openpty()
    threading.Thread(target=drain, args=(ours,), daemon=True).start()
    terminal = os.fdopen(theirs, "w")
    values = city_files(folder / "city", size=SIZE, buildings=BUILDINGS, density=1.0, relief=10.0, seed=1)
    values |= {"out": str(folder / "out"), "tile_size": TILE, "overwrite": True}
    config = make_config(values)
    run(config)  # compiled code is in its place

    def views() -> list[Watcher]:
        environment = {"TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40"}
        return [make_view(console=Console(file=terminal, _environ=environment))]

    found = []
    for k in range(pairs):
        one = {"bare": 0.0, "watched": 0.0}
        for kind in sorted(one, reverse=bool(k % 2)):
            watched = kind == "watched"
            one[kind] = seconds_of(config, views() if watched else [], files=watched)
        found.append((one["bare"], one["watched"]))
        print(f"bare {one['bare']:.2f} s, watched {one['watched']:.2f} s", flush=True)
    return found, [measure_share(config, views()) for _ in range(max(pairs // 3, 1))]


def measure_items(folder: Path) -> tuple[float, float]:
    """Processor time (s) of an item that is submitted and done, and bytes of it, of 100,000."""
    path = folder / "events.jsonl"
    log = EventLog(path, begin_file(path))
    watchers = Watchers([RunLog(), log])
    tiles = {f"{k % 317}_{k // 317}": (float(k), 0.0, k + 1.0, 1.0) for k in range(TILES)}
    expected = {"pieces": (Scope.TILE, TILES)}
    start = RunStart(folder, "citystitch", (0.0, 0.0, 1.0, 1.0), "EPSG:28992", 1.0, 2, tiles, {}, expected)
    began = time.process_time()
    watchers.begin(start)
    for k, tile in enumerate(tiles):
        watchers.submitted("pieces", tile)
        watchers.done("pieces", k + 1, TILES, Record("pieces", tile, "", "", FACTS, {}, {"all": 1.25}, 10**9))
    watchers.end("done")
    return (time.process_time() - began) / TILES, path.stat().st_size / TILES


def main() -> None:
    """Measure and print."""
    pairs = int(sys.argv[1]) if len(sys.argv) > 1 else PAIRS
    with tempfile.TemporaryDirectory() as folder:
        seconds, size = measure_items(Path(folder))
        print(f"an item of {TILES:,}: {1e6 * seconds:.0f} microseconds, {size:.0f} bytes")
        found, shares = measure_pairs(pairs, Path(folder))
    more = [watched / bare - 1 for bare, watched in found]
    error = stdev(more) / len(more) ** 0.5 if len(more) > 1 else float("nan")
    print(f"pairs: median {median(more):+.1%}, mean {mean(more):+.1%}, its standard error {error:.1%}")
    print(f"within watched runs, watchers and their threads: {median(shares):.2%}")


if __name__ == "__main__":
    main()
