"""The metrics of a run for Prometheus: ``citystitch_*``, as text and beside Dask's own."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.data.errors import CityError
from tiler.dashboard.event_reader import EventReader
from tiler.dashboard.map_view import LOWEST
from tiler.monitoring.items import STATES, Items, State
from tiler.monitoring.run_state import SEAM, TILE, RunState

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
RUN_STATES = ("running", "done", "failed", "stopped", "dead", "unknown")
Labels = dict[str, str]


@dataclass(frozen=True)
class Family:
    """A metric: its name, ``"gauge"`` or ``"counter"``, what it means, and its samples by labels.

    The samples of a counter have the ending ``_total``; its name has not.
    """

    name: str
    kind: str
    text: str
    samples: list[tuple[Labels, float]]

    @property
    def sample_name(self) -> str:
        """Name of its samples, which queries use."""
        return f"{self.name}_total" if self.kind == "counter" else self.name


def families(model: RunState, *, alive: bool, share: float = 1.0) -> list[Family]:
    """All metrics of a run.

    Parameters
    ----------
    alive : bool
        Whether it is at work.
    share : float
        How much of its events is read, 0 to 1.
    """
    standing = model.standing(alive=alive)
    status = standing if standing in RUN_STATES else "unknown"
    tiles, seams = model.items[TILE], model.items[SEAM]
    stages = model.stages.items()
    found = [
        Family(
            "citystitch_run_status",
            "gauge",
            "1 for what the run is; dead: its driver has ended without a word",
            [({"status": one}, float(one == status)) for one in RUN_STATES],
        ),
        _one("citystitch_run_started_timestamp_seconds", "Time at which the run began", model.began),
        _one("citystitch_last_event_timestamp_seconds", "Time of the last event of the run", model.last),
        _one("citystitch_workers", "Workers that the run was given", float(model.head.get("workers") or 0)),
        Family(
            "citystitch_items",
            "gauge",
            "Items of each stage in each state",
            [sample for name, stage in stages for sample in _count_stage(name, stage)],
        ),
        _count_all("citystitch_tiles", "Tiles in each state, over all stages", tiles),
        _count_all("citystitch_seams", "Seams in each state, over all stages", seams),
        Family(
            "citystitch_stage_seconds",
            "counter",
            "Wall time of the items that were computed",
            [({"stage": name}, stage.seconds) for name, stage in stages],
        ),
        _one("citystitch_cells", "Cells of the tiles that are meshed", _total(tiles, "cells")),
        _one("citystitch_written_bytes", "Bytes of the pieces that are written", _total(tiles, "bytes")),
        _one("citystitch_memory_peak_bytes", "Largest memory of a worker process so far", float(model.memory)),
        Family(
            "citystitch_quality_minimum",
            "gauge",
            "Lowest value of a measure of quality over all tiles",
            [({"measure": name}, value) for name, value in _worst(tiles)],
        ),
        Family(
            "citystitch_failures",
            "counter",
            "Items that failed, or could not be run for want of one that did",
            [({"stage": name}, float(stage.counts[State.FAILED])) for name, stage in stages],
        ),
        Family(
            "citystitch_notes",
            "counter",
            "What was dropped, repaired or defaulted, by kind",
            [({"kind": kind}, float(n)) for kind, n in sorted(model.notes.items())],
        ),
        _one(
            "citystitch_events_read_ratio",
            "Share of the run's events that is read; the next scrape goes on",
            share,
        ),
        Family("citystitch_events_ignored", "counter", "Events not understood", [({}, float(model.ignored))]),
    ]
    return found


def describe_metrics(follower: EventReader) -> list[Family]:
    """Read what is new of a run, and give its metrics; InputError as of `EventReader.advance`."""
    alive = follower.alive()
    with follower.lock:
        follower.advance()
        return families(follower.model, alive=alive, share=follower.share)


def write_text(metrics: list[Family]) -> str:
    r"""Write metrics in Prometheus' text format.

    Examples
    --------
    >>> print(write_text([Family("a_b", "counter", "Bees", [({"kind": 'big "one"'}, 2.0)])]), end="")
    # HELP a_b_total Bees
    # TYPE a_b_total counter
    a_b_total{kind="big \"one\""} 2
    """
    lines = []
    for one in metrics:
        lines += [f"# HELP {one.sample_name} {one.text}", f"# TYPE {one.sample_name} {one.kind}"]
        for labels, value in one.samples:
            inner = ",".join(f'{name}="{_escape(text)}"' for name, text in labels.items())
            lines.append(f"{one.sample_name}{'{' + inner + '}' if inner else ''} {_write_number(value)}")
    return "\n".join(lines) + "\n"


class Collector:
    """The metrics of a run for ``prometheus_client``, whose registry Dask shows at ``/metrics``.

    Parameters
    ----------
    follower : EventReader
        The run.
    """

    def __init__(self, follower: EventReader) -> None:
        self._follower = follower

    def describe(self) -> list[Any]:
        """Nothing: what there is may change, and a registry must not read files when it is told of us."""
        return []

    def collect(self) -> Iterator[Any]:
        """Give the metrics as ``prometheus_client`` wants them; none where the run cannot be read."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        try:
            metrics = describe_metrics(self._follower)
        except CityError:
            return
        for one in metrics:
            names = list(one.samples[0][0]) if one.samples else []
            kind = CounterMetricFamily if one.kind == "counter" else GaugeMetricFamily
            family = kind(one.name, one.text, labels=names)
            for labels, value in one.samples:
                family.add_metric([labels[name] for name in names], value)
            yield family


def _one(name: str, text: str, value: float) -> Family:
    return Family(name, "gauge", text, [({}, value)])


def _count_stage(name: str, stage: Any) -> Iterator[tuple[Labels, float]]:
    waiting = stage.total - sum(stage.counts.values())
    counts = stage.counts | {State.WAITING: max(waiting, 0)}
    for state in State:
        if state is not State.BEGUN:
            yield {"stage": name, "scope": stage.scope, "state": STATES[state]}, float(counts.get(state, 0))


def _count_all(name: str, text: str, items: Items) -> Family:
    counts = np.bincount(items.codes(""), minlength=len(State)) if len(items) else np.zeros(len(State), np.int64)
    return Family(name, "gauge", text, [({"state": STATES[state]}, float(counts[state])) for state in State])


def _total(items: Items, fact: str) -> float:
    return float(np.nansum(items.values(fact, ""))) if len(items) else 0.0


def _worst(items: Items) -> Iterator[tuple[str, float]]:
    for fact in sorted(items.facts):
        known = items.values(fact, "")
        known = known[np.isfinite(known)]
        if LOWEST.search(fact) and len(known):
            yield fact, float(known.min())


def _escape(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _write_number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(value)
