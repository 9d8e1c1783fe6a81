"""What the page asks for, as plain JSON: head, stages, series, failures, messages and the map."""

import time
from collections.abc import Iterable
from typing import Any

from tiler.dashboard.codes import State
from tiler.dashboard.follow import Follower
from tiler.dashboard.map_view import Question, tell_map
from tiler.dashboard.model import RunModel, StageState

SHOWN_FAILURES, SHOWN_AT_WORK = 200, 12
TITLES = {  # of the values that come first; a fact has its name
    "progress": "% of its stages done",
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
        found = tell_map(model, follower.run, question)
        fresh = found["whole"]
        since = 0 if fresh else question.since
        answer: dict[str, Any] = {
            "run": follower.run,
            "version": model.version + 1,
            "read": round(follower.share, 4),
            "head": tell_head(model, alive=alive),
            "stages": [_tell_stage(name, stage) for name, stage in model.stages.items()],
            "at_work": _tell_at_work(model, alive=alive),
            "series": {"width": model.series.width, "rows": model.series.rows()},
            "values": list_values(model),
            "n_failures": model.n_failures,
            "map": found,
        }
        if fresh or any(one.version >= since for one in model.failures):
            answer["failures"] = _tell_failures(model)
        if fresh or any(version >= since for _, _, version in model.messages):
            answer["messages"] = [[round(t, 1), text] for t, text, _ in model.messages]
    return answer


def tell_head(model: RunModel, *, alive: bool) -> dict[str, Any]:
    """Tell what run it is, how it stands, and how long it may take still (s), None where nobody knows."""
    status = model.standing(alive=alive)
    taken = {name: model.head.get(name) for name in ("error", "command", "bounds", "crs", "tile_size", "workers")}
    end = time.time() if status == "running" else model.last
    return taken | {
        "status": status,
        "began": round(model.began, 1),
        "last": round(model.last, 1),
        "seconds": round(max(end - model.began, 0.0), 1) if model.began else 0.0,
        "left": _estimate(model) if status == "running" else None,
        "memory": model.memory,
        "notes": dict(model.notes.most_common(20)),
        "n_notes": model.notes.total(),
        "ignored": model.ignored,
    }


def list_values(model: RunModel) -> list[list[str]]:
    """List the values that the map can be coloured by: name and title."""
    facts = {fact for items in model.items.values() for fact in items.facts}
    first = [name for name in TITLES if name in COUNTED or name in facts]
    names = [*first, *sorted(facts - TITLES.keys())]
    return [[name, TITLES.get(name, name.replace("_", " "))] for name in names]


def _estimate(model: RunModel) -> float | None:
    """Seconds that the rest takes, from the mean time of what was computed, stage by stage, on all workers.

    None as long as a stage of many items has not been measured: it may be the longest one.
    """
    work = 0.0
    for stage in model.stages.values():
        computed = stage.counts[State.DONE]
        left = max(stage.total - stage.done - stage.counts[State.FAILED], 0)
        if computed:
            work += left * stage.seconds / computed
        elif left > 1:
            return None
    workers = model.head.get("workers") or 1
    return round(work / max(int(workers), 1), 1)


def _tell_stage(name: str, stage: StageState) -> dict[str, Any]:
    reused, failed, running = (stage.counts[state] for state in (State.REUSED, State.FAILED, State.RUNNING))
    return {
        "name": name,
        "scope": stage.scope,
        "total": max(stage.total, stage.done + failed + running),
        "done": stage.done,
        "reused": reused,
        "running": running,
        "failed": failed,
        "seconds": round(stage.seconds, 2),
    }


def _tell_at_work(model: RunModel, *, alive: bool) -> list[list[Any]]:
    """List what workers have had in hand for longest."""
    now = time.time() if alive else model.last
    longest = sorted(model.at_work.items(), key=lambda item: item[1])[:SHOWN_AT_WORK]
    return [[stage, name, round(max(now - since, 0.0), 1)] for (stage, name), since in longest]


def _tell_failures(model: RunModel) -> list[dict[str, Any]]:
    last: Iterable[Any] = list(model.failures)[-SHOWN_FAILURES:]
    return [
        {"stage": one.stage, "name": one.name, "reason": one.reason, "command": one.command, "t": round(one.t, 1)}
        for one in last
    ]
