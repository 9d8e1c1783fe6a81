"""How far a run is: kept by its driver, and written to ``progress.json`` for `citystitch status`."""

import dataclasses
import json
import os
import shlex
import socket
import time
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tiler.config.config import Config
from tiler.engine.submission import Item
from tiler.engine.task import Record
from tiler.monitoring.tally import StageTally, Tally
from tiler.store.atomic import replacing
from tiler.store.out_folder import PROGRESS

SCHEMA = 1  # of progress.json
EVERY = 2.0  # s between two writes of it
LISTED = 100  # items in hand that it lists, those first that have waited longest


class RunProgress(Tally):
    """Keeps how far a run is, and writes it to a file.

    Parameters
    ----------
    out : Path
        Folder of the run.
    config : Config
        Its parameters.
    expected : mapping of str to int
        Number of items of the stages that are known from the start, in order; others come as they are planned.
    command : str, optional
        What a user gives to go on with the run; made of `config` by default.

    Attributes
    ----------
    finished : dict of str to float
        Seconds after the start at which each finished stage was done.

    Notes
    -----
    The file is replaced as a whole, at most every `EVERY` seconds and at the end. It holds times: it is no result.
    """

    def __init__(
        self, out: Path, config: Config, expected: Mapping[str, int], *, command: str | None = None
    ) -> None:
        super().__init__(time.perf_counter)
        self.stages = {stage: StageTally(total) for stage, total in expected.items()}
        self.finished: dict[str, float] = {}
        self._path, self._written = out / PROGRESS, -EVERY
        self._since: dict[Item, float] = {}  # when items in hand were given to workers
        self._head = {
            "schema": SCHEMA,
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "directory": os.getcwd(),
            "command": command_line(config) if command is None else command,
            "parameters": dataclasses.asdict(config),
            "started": format_time(time.time()),
        }
        self.write("running")

    def submitted(self, stage: str, name: str) -> None:
        """Take note of an item that was given to a worker."""
        super().submitted(stage, name)
        self._since[stage, name] = time.time()
        self._write_sometimes()

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        """Take note of an item that is done."""
        super().done(stage, n_done, total, record)
        self._since.pop((stage, record.name), None)
        if n_done == total:
            self.finished[stage] = round(self.elapsed, 3)
        self._write_sometimes()

    def failed(
        self, stage: str, name: str, reason: str, needs: Item | None = None, *, ends_run: bool = False
    ) -> None:
        """Take note of an item that failed."""
        super().failed(stage, name, reason, needs)
        self._since.pop((stage, name), None)
        self._write_sometimes()

    def end(self, status: str, error: str = "") -> None:
        """Write how the run ended."""
        self.write(status, error)

    def write(self, status: str, error: str = "") -> None:
        """Write the file.

        Parameters
        ----------
        status : str
            ``"running"``, ``"done"`` or ``"failed"``.
        error : str
            Why it failed.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        in_hand = sorted(self._since.items(), key=lambda item: item[1])
        running = Counter(stage for stage, _ in self._since)
        content = self._head | {
            "updated": format_time(time.time()),
            "status": status,
            "error": error,
            "stages": {name: self._describe(name, running[name]) for name in self.stages},
            "n_running": len(in_hand),
            "running": [
                {"stage": stage, "name": name, "since": format_time(since)}
                for (stage, name), since in in_hand[:LISTED]
            ],
            "notes": dict(sorted(self.warnings.items())),
        }
        with replacing(self._path) as part:
            part.write_text(json.dumps(content, indent=1, default=str) + "\n")
        self._written = time.perf_counter()

    def _write_sometimes(self) -> None:
        if time.perf_counter() - self._written >= EVERY:
            self.write("running")

    def _describe(self, stage: str, running: int) -> dict[str, Any]:
        state = self.stages[stage]
        counts = {count: getattr(state, count) for count in ("total", "done", "reused", "failed")}
        finished = {"finished": self.finished[stage]} if stage in self.finished else {}
        return counts | {"running": running, "seconds": round(state.seconds, 3)} | finished


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
