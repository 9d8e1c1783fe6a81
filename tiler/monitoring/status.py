"""`citystitch status`: how far the run in a folder is, whether it is alive, and how to go on."""

import json
import os
import socket
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipeline.data.errors import InputError
from tiler.monitoring.terminal import next_commands
from tiler.store.folder_lock import is_held
from tiler.store.out_folder import PROGRESS, RUN_RECORD
from tiler.words.note_words import say_notes
from tiler.words.stage_groups import group_stages, title_of_stage

LISTED_ITEMS = 10  # items in hand that the table lists
COUNTS = ("total", "done", "reused", "running", "failed")


def read_status(directory: Path) -> dict[str, Any]:
    """Return how far the run in a folder is.

    Returns
    -------
    dict
        What ``progress.json`` holds (`tiler.monitoring.progress`), and

        - ``state``: ``"running"`` where a process holds the folder; else ``"done"``, ``"failed"``, or
          ``"stopped"`` where the run ended without saying so;
        - ``held``: whether a process holds the folder;
        - ``stages``: in each also ``left``, the items not begun.

    Raises
    ------
    InputError
        If the folder is not that of a run, or its ``progress.json`` is damaged.
    """
    path = directory / PROGRESS
    if not path.is_file():
        known = (directory / RUN_RECORD).is_file()
        reason = (
            f"has a {RUN_RECORD}, but no {PROGRESS}" if known else f"holds neither {RUN_RECORD} nor {PROGRESS}"
        )
        raise InputError(f"{directory}: {reason}; give the folder of a run that was begun")
    try:
        progress = json.loads(path.read_bytes())
        stages: dict[str, dict[str, Any]] = progress["stages"]
        for stage in stages.values():
            counts = {count: int(stage[count]) for count in COUNTS}
            stage["left"] = counts["total"] - counts["done"] - counts["failed"] - counts["running"]
        status = progress["status"]
        for name in ("started", "updated"):
            datetime.fromisoformat(progress[name])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is damaged ({error!r}); run again, and it is written anew") from None
    held = is_held(directory)
    state = "running" if held else "stopped" if status == "running" else status
    return {**progress, "state": state, "held": held}


def print_status(directory: Path, status: dict[str, Any], console: Console) -> None:
    """Print what `read_status` gives: a line on the run, a row for each stage, items in hand, and how to go on."""
    console.print(f"[bold]{directory}[/]: {_headline(status)}", soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    table.add_column("step")
    for title in ("done", "of", "used again", "running", "failed", "left", "time"):
        table.add_column(title, justify="right")
    for name, stages in group_stages(status["stages"]).items():
        step = {key: sum(status["stages"][stage][key] for stage in stages) for key in (*COUNTS, "left", "seconds")}
        done, total, reused, failed = (f"{step[count]:,}" for count in ("done", "total", "reused", "failed"))
        seconds = f"{step['seconds']:.1f} s" if step["done"] else ""
        row = (escape(name), done, total, reused, f"{step['running']:,}", failed, f"{step['left']:,}", seconds)
        table.add_row(*row, style="red" if step["failed"] else None if step["left"] or step["running"] else "dim")
    console.print(table)
    items = status["running"] if status["state"] != "done" else []
    if items:
        console.print("in the workers' hands:" if status["held"] else "in hand when it ended:")
    for item in items[:LISTED_ITEMS]:
        console.print(f"  {title_of_stage(item['stage'])} {item['name']}, since {item['since']}", markup=False)
    if items and status["n_running"] > LISTED_ITEMS:
        console.print(f"  and {status['n_running'] - LISTED_ITEMS} more")
    if status["notes"]:
        notes = "; ".join(say_notes(kind, count) for kind, count in status["notes"].items())
        console.print(f"notes so far: {notes}", markup=False)
    if status["error"]:
        console.print(f"error: {status['error']}", markup=False)
    console.print(_next_move(directory, status), markup=False, soft_wrap=True)


def _headline(status: dict[str, Any]) -> str:
    process = f"process {status['pid']} on {status['host']}"
    match status["state"]:
        case "running" if _is_of_holder(status):
            return f"running, {process}, since {status['started']}; last word {status['updated']}"
        case "running":
            return f"a run has begun, but not with its stages; what follows is the run of {status['started']}"
        case "done":
            return f"done, {status['started']} to {status['updated']}"
        case "failed":
            return f"failed at {status['updated']}, {process}, begun {status['started']}"
    return (
        f"stopped without a word after {status['updated']}, {process}, begun {status['started']}; it is not alive"
    )


def _is_of_holder(status: dict[str, Any]) -> bool:
    """Return whether the process that wrote the progress may be the one that holds the folder."""
    if status["status"] != "running":
        return False
    if status["host"] != socket.gethostname():
        return True
    try:
        os.kill(status["pid"], 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _next_move(directory: Path, status: dict[str, Any]) -> str:
    if status["state"] == "running":
        return f"next: wait, and ask again: citystitch status {directory}"
    if status["state"] == "done":
        return f"next: {' '.join(next_commands(directory)[0])}"
    if not status["command"]:
        return "to go on where it ended: call tiler.workflow.run.run again, with the same stages of your own"
    return f"to go on where it ended, in {status['directory']}:\n{status['command']}"
