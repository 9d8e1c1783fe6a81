"""How far a run is, in ``progress.json`` for `citystitch status`; and the command of a run."""

import dataclasses
import json
import os
import shlex
import socket
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tiler.config.config import Config
from tiler.engine.watcher import RunStart
from tiler.monitoring.events import Event
from tiler.monitoring.run_state import RunState
from tiler.monitoring.stage_state import StageState
from tiler.monitoring.watchers import EventWatcher
from tiler.store.atomic import replacing
from tiler.store.out_folder import PROGRESS

SCHEMA = 1  # of progress.json
EVERY = 2.0  # s between two writes of it
WRITTEN = {"submitted", "done", "failed"}  # events after which it is, in time
LISTED = 100  # items in hand that it lists, those first that have waited longest


class ProgressFile(EventWatcher):
    """Writes how far a run is to a file.

    Parameters
    ----------
    out : Path
        Folder of the run.
    config : Config
        Its parameters.
    command : str, optional
        What a user gives to go on with the run; made of `config` by default.

    Raises
    ------
    OutputError
        If the file cannot be written.

    Notes
    -----
    The file is replaced as a whole, when the run begins, at most every `EVERY` seconds, and at the end. It holds
    times: it is no result.
    """

    def __init__(self, out: Path, config: Config, *, command: str | None = None) -> None:
        self._path, self._written = out / PROGRESS, 0.0
        self._state = RunState()
        self._head = {
            "schema": SCHEMA,
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "directory": os.getcwd(),
            "command": command_line(config) if command is None else command,
            "parameters": dataclasses.asdict(config),
            "started": format_time(time.time()),
        }

    def take(self, event: Event, state: RunState) -> None:
        """Take note of what happened, and write the file if it is time."""
        self._state = state
        if event["event"] in WRITTEN and time.perf_counter() - self._written >= EVERY:
            self._write()

    def begin(self, start: RunStart) -> None:
        """Write the file with all stages that are known."""
        self._write()

    def end(self, status: str, error: str = "") -> None:
        """Write how the run ended."""
        if self._state.head:
            self._write()

    def _write(self) -> None:
        state = self._state
        in_hand = sorted(state.at_work.items(), key=lambda item: item[1])
        content = self._head | {
            "updated": format_time(time.time()),
            "status": state.status or "running",
            "error": state.head.get("error", ""),
            "stages": {name: _describe(stage) for name, stage in state.stages.items()},
            "n_running": len(in_hand),
            "running": [
                {"stage": stage, "name": name, "since": format_time(since)}
                for (stage, name), since in in_hand[:LISTED]
            ],
            "notes": dict(sorted(state.notes.items())),
        }
        with replacing(self._path) as part:
            part.write_text(json.dumps(content, indent=1, default=str) + "\n")
        self._written = time.perf_counter()


def _describe(stage: StageState) -> dict[str, Any]:
    counts = {count: getattr(stage, count) for count in ("total", "done", "reused", "failed")}
    finished = {"finished": stage.finished} if stage.finished else {}
    return counts | {"running": stage.in_hand, "seconds": round(stage.seconds, 3)} | finished


def format_time(seconds: float) -> str:
    """Write a time, in seconds since 1970, as ISO 8601 in UTC.

    Examples
    --------
    >>> format_time(0.0)
    '1970-01-01T00:00:00+00:00'
    """
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def command_line(config: Config) -> str:
    """Give the command of a run, with all parameters that are not the default's; one that overwrites goes on.

    Examples
    --------
    >>> from tiler.config.config import make_config
    >>> command_line(make_config({"pointcloud": ["a b.laz"], "out": "o", "manifold": True, "overwrite": True}))
    "citystitch run 'a b.laz' --manifold --out o"
    """
    words = ["citystitch", "run", *map(str, config.pointcloud)]
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if entry.name in ("pointcloud", "overwrite") or (value == entry.default and entry.name != "out"):
            continue
        option = entry.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        elif isinstance(value, tuple):
            words += [f"--{option}", *map(str, value)]
        else:
            words += [f"--{option}", str(value)]
    return shlex.join(words)
