"""When the stages of a run worked: from the events of its tasks, or from the totals of its record."""

from array import array
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tiler.monitoring.events import read_events
from tiler.monitoring.items import State
from tiler.monitoring.run_state import RunState
from tiler.words.stage_groups import group_of_stage

BINS = 240  # columns of the Gantt chart


@dataclass(frozen=True, eq=False)
class Timeline:
    """How busy each group of stages was over the time of a run (`tiler.words.stage_groups`)."""

    duration: float  #: from the first task's beginning to the last one's end (s)
    stages: tuple[str, ...]  #: groups in the order in which they began
    busy: NDArray[np.float64]  #: (n_stages, BINS): tasks at work in each slice of time, in the mean
    #: (n_stages,): when the first task of each began and the last one ended (s after the beginning)
    first: NDArray[np.float64]
    last: NDArray[np.float64]
    #: (n_stages,): tasks of each that ended well, those of them that took an earlier result, and those that failed
    tasks: NDArray[np.int64]
    reused: NDArray[np.int64]
    failed: NDArray[np.int64]
    by_tile: dict[str, float]  #: time of all tasks of each tile (s), of the stages that have one a tile


def read_timeline(path: Path, tiles: frozenset[str]) -> Timeline | None:
    """Read the events of a run.

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
    run = RunState()
    ends: defaultdict[str, array[float]] = defaultdict(lambda: array("d"))  # s since 1970, and what it took
    by_tile: dict[str, float] = {}
    for event in read_events(path) if path.is_file() else ():
        if not run.fold(event) or event["event"] not in ("done", "failed"):
            continue
        try:
            end, seconds = float(event["t"]) - float(event.get("ago") or 0.0), float(event.get("seconds") or 0.0)
        except (KeyError, TypeError, ValueError):
            continue
        ends[group_of_stage(event["stage"])].extend((end, seconds))
        if event["event"] == "done" and event["name"] in tiles:
            by_tile[event["name"]] = by_tile.get(event["name"], 0.0) + seconds
    if not ends:
        return None
    spans = {}
    for group, found in ends.items():
        last, spent = np.array(found).reshape(-1, 2).T
        spans[group] = last - spent, last
    begin = min(first.min() for first, _ in spans.values())
    duration = max(max(last.max() for _, last in spans.values()) - begin, 1e-3)
    names = sorted(spans, key=lambda name: (spans[name][0].min(), name))
    edges = begin + np.linspace(0.0, duration, BINS + 1)
    worked = [  # time that tasks have worked up to each edge
        [np.clip(edge - first, 0.0, last - first).sum() for edge in edges]
        for first, last in (spans[name] for name in names)
    ]
    groups = run.groups()
    return Timeline(
        duration,
        tuple(names),
        np.diff(worked, axis=1) * BINS / duration,
        np.array([spans[name][0].min() - begin for name in names]),
        np.array([spans[name][1].max() - begin for name in names]),
        np.array([groups[name].done for name in names]),
        np.array([groups[name].reused for name in names]),
        np.array([groups[name].counts[State.FAILED] for name in names]),
        by_tile,
    )
