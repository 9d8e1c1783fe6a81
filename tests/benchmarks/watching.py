"""What watching costs: processor time of runs with and without it, in pairs, and of each item.

    python -m tests.benchmarks.watching [PAIRS]

The run is serial, in a pseudo-terminal, so that one process has all of it; seconds are the processor's.
"""

import os
import pty
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

from rich.console import Console

from tiler.config import Config, make_config
from tiler.events import EventLog, begin_file
from tiler.run import run
from tiler.stage import Scope
from tiler.synth import write_city
from tiler.task import Record
from tiler.terminal import make_views
from tiler.watching import RunStart, Watcher, Watchers

SIZE, BUILDINGS, TILE = 600.0, 220, 150.0  # m, number, m: 16 tiles
PAIRS = 4
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
        with patch("tiler.run_watchers.EventLog", lambda *_: Watcher()):
            run(config, watchers=watchers)
    return time.process_time() - began


def drain(file: int) -> None:
    """Read what a terminal is shown, until it is closed."""
    with suppress(OSError):
        while os.read(file, 65536):
            pass


def measure_pairs(pairs: int, folder: Path) -> list[tuple[float, float]]:
    """Run in pairs, without and with all that watches."""
    ours, theirs = pty.openpty()
    threading.Thread(target=drain, args=(ours,), daemon=True).start()
    terminal = os.fdopen(theirs, "w")
    files = write_city(folder / "city", size=SIZE, buildings=BUILDINGS, density=1.0, relief=10.0, seed=1)
    values: dict[str, Any] = {
        "pointcloud": [str(path) for path in files.clouds],
        "footprints": str(files.shapefile),
    }
    values |= {"out": str(folder / "out"), "tile_size": TILE, "overwrite": True}
    config = make_config(values)
    run(config)  # compiled code is in its place
    found = []
    for k in range(pairs):
        console = Console(file=terminal, _environ={"TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40"})
        with_it: list[Watcher] = make_views(console=console)
        one = {"bare": 0.0, "watched": 0.0}
        for kind in sorted(one, reverse=bool(k % 2)):
            watched = kind == "watched"
            one[kind] = seconds_of(config, with_it if watched else [], files=watched)
        found.append((one["bare"], one["watched"]))
        print(f"bare {one['bare']:.2f} s, watched {one['watched']:.2f} s", flush=True)
    return found


def measure_items(folder: Path) -> tuple[float, float]:
    """Processor time (s) of an item that is submitted and done, and bytes of it, of 100,000."""
    path = folder / "events.jsonl"
    log = EventLog(path, begin_file(path))
    watchers = Watchers([make_views(console=Console(file=open(os.devnull, "w")))[0], log])  # noqa: SIM115
    tiles = {f"{k % 317}_{k // 317}": (float(k), 0.0, k + 1.0, 1.0) for k in range(TILES)}
    expected = {"pieces": (Scope.TILE, TILES)}
    start = RunStart(folder, "citystitch", (0.0, 0.0, 1.0, 1.0), "EPSG:28992", 1.0, 2, tiles, {}, expected)
    began = time.process_time()
    watchers.begin(start)
    for k, tile in enumerate(tiles):
        watchers.submitted("pieces", tile)
        watchers("pieces", k + 1, TILES, Record("pieces", tile, "", "", FACTS, {}, {"all": 1.25}, 10**9))
    watchers.end("done")
    return (time.process_time() - began) / TILES, path.stat().st_size / TILES


def main() -> None:
    """Measure and print."""
    pairs = int(sys.argv[1]) if len(sys.argv) > 1 else PAIRS
    with tempfile.TemporaryDirectory() as folder:
        seconds, size = measure_items(Path(folder))
        print(f"an item of {TILES:,}: {1e6 * seconds:.0f} microseconds, {size:.0f} bytes")
        found = measure_pairs(pairs, Path(folder))
    print(f"median {median(watched / bare for bare, watched in found) - 1:+.1%}")


if __name__ == "__main__":
    main()
