"""What the page asks for, as plain JSON: head, stages, series, failures, messages and the map."""

import time
from collections.abc import Iterable
from typing import Any

from tiler.dashboard.event_reader import EventReader
from tiler.dashboard.map_view import Question, describe_map
from tiler.monitoring.items import State
from tiler.monitoring.run_state import SEAM, TILE, RunState
from tiler.monitoring.stage_state import add_up
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


def describe_page(follower: EventReader, question: Question) -> dict[str, Any]:
    """Answer the page: what is new since the version that it has.

    Raises
    ------
    InputError
        As of `EventReader.advance`.
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


def describe_head(model: RunState, *, alive: bool) -> dict[str, Any]:
    """Describe which run it is, its state, and how long it may still take (s), None where unknown."""
    status = model.standing(alive=alive)
    taken = {name: model.head.get(name) for name in ("error", "command", "bounds", "crs", "tile_size", "workers")}
    end = time.time() if status == "running" else model.last
    return taken | {
        "status": status,
        "began": round(model.began, 1),
        "last": round(model.last, 1),
        "seconds": round(max(end - model.began, 0.0), 1) if model.began else 0.0,
        "left": None if status != "running" else model.time_left(end),
        "share": 1.0 if status == "done" else round(model.share_done(end), 4),
        "memory": model.memory,
        "notes": [say_notes(kind, n) for kind, n in model.notes.most_common(20)],
        "n_notes": model.notes.total(),
        "ignored": model.ignored,
    }


def list_values(model: RunState) -> list[list[str]]:
    """List the values that the map can be coloured by: name and title."""
    facts = {fact for items in model.items.values() for fact in items.facts}
    first = [name for name in TITLES if name in COUNTED or name in facts]
    names = [*first, *sorted(facts - TITLES.keys())]
    return [[name, TITLES.get(name, name.replace("_", " "))] for name in names]


def _describe_step(model: RunState, step: str, names: Iterable[str]) -> dict[str, Any]:
    """Describe the stages of a step (`tiler.words.stage_groups`) together."""
    stages = {name: model.stages[name] for name in names}
    whole = add_up(stages)
    total = 0
    for one in stages.values():
        total += max(one.total, one.done + one.counts[State.FAILED] + one.counts[State.RUNNING])
    return {
        "name": step,
        "mapped": any(one.scope in {TILE, SEAM} for one in stages.values()),
        "total": total,
        "done": whole.done,
        "reused": whole.counts[State.REUSED],
        "running": whole.counts[State.RUNNING],
        "failed": whole.counts[State.FAILED],
        "seconds": round(whole.seconds, 2),
    }


def _describe_at_work(model: RunState, *, alive: bool) -> list[list[Any]]:
    """List what runs, longest first."""
    if model.ended:
        return []
    now = time.time() if alive else model.last
    running = [(item, since) for item, since in model.at_work.items() if item not in model.queued]
    longest = sorted(running, key=lambda one: one[1])[:SHOWN_AT_WORK]
    return [[title_of_stage(stage), name, round(max(now - since, 0.0), 1)] for (stage, name), since in longest]


def _describe_failures(model: RunState) -> list[dict[str, Any]]:
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
