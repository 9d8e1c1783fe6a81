"""When the stages of a run worked: from the events of its tasks, or from the totals of its record."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.monitoring.events import read_events
from tiler.words.stage_groups import group_of_stage

BINS = 240  # columns of the Gantt chart


@dataclass(frozen=True, eq=False)
class Timeline:
    """How busy each group of stages was over the time of a run (`tiler.words.stage_groups`).

    Attributes
    ----------
    duration : float
        From the first task's beginning to the last one's end (s).
    stages : tuple of str
        Groups in the order in which they began.
    busy : float64, (n_stages, BINS)
        Tasks at work in each slice of time, in the mean.
    first, last : float64, (n_stages,)
        When the first task of each began and the last one ended (s after the beginning).
    tasks, reused, failed : int64, (n_stages,)
        Tasks of each that ended well, those of them that took an earlier result, and those that failed.
    by_tile : dict of str to float
        Time of all tasks of each tile (s), of the stages that have one a tile.
    """

    duration: float
    stages: tuple[str, ...]
    busy: NDArray[np.float64]
    first: NDArray[np.float64]
    last: NDArray[np.float64]
    tasks: NDArray[np.int64]
    reused: NDArray[np.int64]
    failed: NDArray[np.int64]
    by_tile: dict[str, float]


@dataclass
class _Stage:
    first: float = math.inf
    last: float = -math.inf
    tasks: int = 0
    reused: int = 0
    failed: int = 0


def read_timeline(path: Path, tiles: frozenset[str]) -> Timeline | None:
    """Read the events of a run twice: for its span, and for what went on in it.

    Parameters
    ----------
    path : Path
        ``events.jsonl`` of a run's folder.
    tiles : frozenset of str
        Names of its tiles.

    Returns
    -------
    Timeline or None
        None where there is no file, or no task ended. A line that is no event is passed over: the last
        one may be cut off.
    """
    stages: dict[str, _Stage] = {}
    by_tile: dict[str, float] = {}
    for event, stage, end, seconds in _tasks(path):
        found = stages.setdefault(stage, _Stage())
        found.first, found.last = min(found.first, end - seconds), max(found.last, end)
        found.failed += event["event"] == "failed"
        if event["event"] == "done":
            found.tasks += 1
            found.reused += bool(event.get("reused"))
            if event.get("name") in tiles:
                by_tile[event["name"]] = by_tile.get(event["name"], 0.0) + seconds
    if not stages:
        return None
    begin, end = min(s.first for s in stages.values()), max(s.last for s in stages.values())
    duration = max(end - begin, 1e-3)
    names = sorted(stages, key=lambda name: (stages[name].first, name))
    row, busy = {name: k for k, name in enumerate(names)}, np.zeros((len(names), BINS))
    for _, stage, last, seconds in _tasks(path):
        _add(busy[row[stage]], (last - seconds - begin) / duration, (last - begin) / duration)
    kept = [stages[name] for name in names]
    return Timeline(
        duration,
        tuple(names),
        busy,
        np.array([s.first - begin for s in kept]),
        np.array([s.last - begin for s in kept]),
        np.array([s.tasks for s in kept]),
        np.array([s.reused for s in kept]),
        np.array([s.failed for s in kept]),
        by_tile,
    )


def _tasks(path: Path) -> Iterator[tuple[dict[str, Any], str, float, float]]:
    """Give the tasks that ended: event, stage, time of the end, and what it took (s)."""
    if not path.is_file():
        return
    for event in read_events(path):
        if event.get("event") not in ("done", "failed"):
            continue
        try:
            end = float(event["t"]) - float(event.get("ago") or 0.0)
            seconds = float(event.get("seconds") or 0.0)
        except (KeyError, TypeError, ValueError):
            continue
        if math.isfinite(end) and 0 <= seconds < math.inf:
            yield event, group_of_stage(str(event.get("stage", ""))), end, seconds


def _add(busy: NDArray[np.float64], start: float, end: float) -> None:
    """Add a task that is there from `start` to `end`, shares of the duration, to the slices that it touches."""
    first, last = max(start, 0.0) * BINS, min(end, 1.0) * BINS
    low, high = min(int(first), BINS - 1), min(int(last), BINS - 1)
    if low == high:
        busy[low] += last - first
        return
    busy[low] += low + 1 - first
    busy[low + 1 : high] += 1
    busy[high] += last - high
