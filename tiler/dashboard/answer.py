"""What the page asks for, as plain JSON: head, stages, series, failures, messages and the map."""

import time
from collections import Counter
from collections.abc import Iterable
from typing import Any

from tiler.dashboard.follow import Follower
from tiler.dashboard.items import State
from tiler.dashboard.map_view import Question, describe_map
from tiler.dashboard.model import SEAM, TILE, RunModel
from tiler.monitoring.tally import StageTally, estimate_share, estimate_time
from tiler.words.note_words import say_notes
from tiler.words.stage_groups import group_of_stage, group_stages, title_of_stage

SHOWN_FAILURES, SHOWN_AT_WORK = 200, 12
TITLES = {  # of the values that come first; a fact has its name
    "progress": "% of its tasks done",
    "seconds": "seconds",
    "cells": "cells",
    "worst_ratio": "worst radius ratio",
    "dropped": "dropped buildings",
    "notes": "notes",
}
COUNTED = ("progress", "seconds", "dropped", "notes")  # values that are no facts of stages


def tell(follower: Follower, question: Question) -> dict[str, Any]:
    """Answer the page: what is new since the version that it has.

    Raises
    ------
    InputError
        As of `Follower.advance`.
    """
    alive = follower.alive()
    with follower.lock:
        follower.advance()
        model = follower.model
        found = describe_map(model, follower.run, question)
        fresh = found["whole"]
        since = 0 if fresh else question.since
        answer: dict[str, Any] = {
            "run": follower.run,
            "version": model.version + 1,
            "read": round(follower.share, 4),
            "head": describe_head(model, alive=alive),
            "stages": [_describe_step(model, step, names) for step, names in group_stages(model.stages).items()],
            "at_work": _describe_at_work(model, alive=alive),
            "series": {"width": model.series.width, "rows": model.series.rows()},
            "values": list_values(model),
            "n_failures": model.n_failures,
            "map": found,
        }
        if fresh or any(one.version >= since for one in model.failures):
            answer["failures"] = _describe_failures(model)
        if fresh or any(version >= since for _, _, version in model.messages):
            answer["messages"] = [[round(t, 1), text] for t, text, _ in model.messages]
    return answer


def describe_head(model: RunModel, *, alive: bool) -> dict[str, Any]:
    """Describe which run it is, its state, and how long it may still take (s), None where unknown."""
    status = model.standing(alive=alive)
    taken = {name: model.head.get(name) for name in ("error", "command", "bounds", "crs", "tile_size", "workers")}
    end = time.time() if status == "running" else model.last
    stages, spent = _tally(model), end - model.first if model.first else 0.0
    return taken | {
        "status": status,
        "began": round(model.began, 1),
        "last": round(model.last, 1),
        "seconds": round(max(end - model.began, 0.0), 1) if model.began else 0.0,
        "left": None if status != "running" else estimate_time(stages, spent),
        "share": 1.0 if status == "done" else round(estimate_share(stages, spent), 4),
        "memory": model.memory,
        "notes": [say_notes(kind, n) for kind, n in model.notes.most_common(20)],
        "n_notes": model.notes.total(),
        "ignored": model.ignored,
    }


def list_values(model: RunModel) -> list[list[str]]:
    """List the values that the map can be coloured by: name and title."""
    facts = {fact for items in model.items.values() for fact in items.facts}
    first = [name for name in TITLES if name in COUNTED or name in facts]
    names = [*first, *sorted(facts - TITLES.keys())]
    return [[name, TITLES.get(name, name.replace("_", " "))] for name in names]


def _tally(model: RunModel) -> dict[str, StageTally]:
    """How far each stage is, for the estimates of `tiler.monitoring.tally`."""
    return {
        name: StageTally(
            max(stage.total, stage.done),
            stage.done,
            stage.counts[State.REUSED],
            stage.counts[State.FAILED],
            stage.counts[State.RUNNING],
            stage.seconds,
        )
        for name, stage in model.stages.items()
    }


def _describe_step(model: RunModel, step: str, names: Iterable[str]) -> dict[str, Any]:
    """Add up the stages of a step (`tiler.words.stage_groups`)."""
    stages = [model.stages[name] for name in names]
    counts = sum((stage.counts for stage in stages), Counter[int]())
    reused, failed, running = (counts[state] for state in (State.REUSED, State.FAILED, State.RUNNING))
    scopes = {stage.scope for stage in stages}
    return {
        "name": step,
        "mapped": bool(scopes & {TILE, SEAM}),
        "total": sum(
            max(stage.total, stage.done + stage.counts[State.FAILED] + stage.counts[State.RUNNING])
            for stage in stages
        ),
        "done": sum(stage.done for stage in stages),
        "reused": reused,
        "running": running,
        "failed": failed,
        "seconds": round(sum(stage.seconds for stage in stages), 2),
    }


def _describe_at_work(model: RunModel, *, alive: bool) -> list[list[Any]]:
    """List what runs, longest first."""
    now = time.time() if alive else model.last
    running = [(item, since) for item, since in model.at_work.items() if item not in model.queued]
    longest = sorted(running, key=lambda one: one[1])[:SHOWN_AT_WORK]
    return [[title_of_stage(stage), name, round(max(now - since, 0.0), 1)] for (stage, name), since in longest]


def _describe_failures(model: RunModel) -> list[dict[str, Any]]:
    last: Iterable[Any] = list(model.failures)[-SHOWN_FAILURES:]
    return [
        {
            "step": group_of_stage(one.stage),
            "title": title_of_stage(one.stage),
            "name": one.name,
            "reason": one.reason,
            "command": one.command,
            "t": round(one.t, 1),
        }
        for one in last
    ]
