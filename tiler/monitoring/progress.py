"""How far a run is: kept by its driver, and written to ``progress.json`` for `citystitch status`."""

import dataclasses
import json
import os
import shlex
import socket
import time
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tiler.config.config import Config
from tiler.engine.stage import Scope
from tiler.engine.task import Record
from tiler.monitoring.watchers import Item, Watcher
from tiler.store.atomic import replacing
from tiler.store.out_folder import PROGRESS

SCHEMA = 1  # of progress.json
EVERY = 2.0  # s between two writes of it
LISTED = 100  # items in hand that it lists, those first that have waited longest
Announce = Callable[[str, float], None]


@dataclasses.dataclass
class StageProgress:
    """How far a stage is.

    Attributes
    ----------
    total, done, reused, failed : int
        Its items; those done, those of them that an earlier run had done, and those that ended in an error.
    seconds : float
        Wall time of all items done (s).
    finished : float or None
        When its last item was done (s after the start).
    """

    total: int
    done: int = 0
    reused: int = 0
    failed: int = 0
    seconds: float = 0.0
    finished: float | None = None


class RunProgress(Watcher):
    """The progress of a run, given to an `Engine`, which tells it what begins, ends and fails.

    Parameters
    ----------
    out : Path
        Folder of the run.
    config : Config
        Its parameters.
    expected : mapping of str to int
        Number of items of the stages that are known from the start, in order; others come as they are planned.
    announce : callable, optional
        Called with the name of each stage and the seconds of all its items when it is done.
    command : str, optional
        What a user gives to go on with the run; made of `config` by default.

    Notes
    -----
    The file is replaced as a whole, at most every `EVERY` seconds and at the end. It holds times: it is no result.
    """

    def __init__(
        self,
        out: Path,
        config: Config,
        expected: Mapping[str, int],
        *,
        announce: Announce | None = None,
        command: str | None = None,
    ) -> None:
        self.stages = {stage: StageProgress(total) for stage, total in expected.items()}
        self._path, self._announce = out / PROGRESS, announce
        self._begin, self._started = time.perf_counter(), time.time()
        self._written = -EVERY
        self._in_hand: dict[tuple[str, str], float] = {}
        self._notes: Counter[str] = Counter()
        self._head = {
            "schema": SCHEMA,
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "directory": os.getcwd(),
            "command": command_line(config) if command is None else command,
            "parameters": dataclasses.asdict(config),
            "started": format_time(self._started),
        }
        self.write("running")

    @property
    def finished(self) -> dict[str, float]:
        """Seconds after the start at which each finished stage was done."""
        return {name: stage.finished for name, stage in self.stages.items() if stage.finished is not None}

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        """Take note of how many items a stage has."""
        self._stage(stage).total = total

    def submitted(self, stage: str, name: str) -> None:
        """Take note of an item that was given to a worker."""
        self._in_hand[stage, name] = time.time()
        self._write_sometimes()

    def failed(self, stage: str, name: str, reason: str, needs: Item | None = None) -> None:
        """Take note of an item that ended in an error."""
        self._in_hand.pop((stage, name), None)
        self._stage(stage).failed += 1
        self._write_sometimes()

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Take note of an item that is done."""
        self._in_hand.pop((stage, record.name), None)
        state = self._stage(stage)
        state.done, state.total = done, total
        state.reused += record.reused
        state.seconds += record.seconds.get("all", 0.0)
        self._notes.update(record.notes)
        if done == total:
            state.finished = round(time.perf_counter() - self._begin, 3)
        self._write_sometimes()
        if done == total and self._announce is not None:
            self._announce(f"{stage} ({total})", state.seconds)

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
        in_hand = sorted(self._in_hand.items(), key=lambda item: item[1])
        running = Counter(stage for stage, _ in self._in_hand)
        content = self._head | {
            "updated": format_time(time.time()),
            "status": status,
            "error": error,
            "stages": {name: _tell(stage, running[name]) for name, stage in self.stages.items()},
            "n_running": len(in_hand),
            "running": [
                {"stage": stage, "name": name, "since": format_time(since)}
                for (stage, name), since in in_hand[:LISTED]
            ],
            "notes": dict(sorted(self._notes.items())),
        }
        with replacing(self._path) as part:
            part.write_text(json.dumps(content, indent=1, default=str) + "\n")
        self._written = time.perf_counter()

    def _write_sometimes(self) -> None:
        if time.perf_counter() - self._written >= EVERY:
            self.write("running")

    def _stage(self, name: str) -> StageProgress:
        return self.stages.setdefault(name, StageProgress(0))


def _tell(stage: StageProgress, running: int) -> dict[str, Any]:
    told = dataclasses.asdict(stage) | {"running": running, "seconds": round(stage.seconds, 3)}
    return {name: value for name, value in told.items() if value is not None}


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
