"""The events of a run, one JSON object a line: ``events.jsonl`` in its folder, and `--log-json`."""

import json
import math
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError, InputError, OutputError
from tiler.engine.stage import Box, Facts, Layout, Scope
from tiler.engine.submission import Item
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart, Watcher
from tiler.monitoring.watchers import describe_command
from tiler.store.atomic import replacing
from tiler.store.checksums import FILES

EVERY = 1.0  # s between two writes
CHUNK = 1000  # tiles or seams a line
PLACING = {"i0", "j0", "nx", "ny", "spacing"}  # facts of rasters: where, not what
GROUPS = ("counts", "facts")  # facts that are groups of facts
FIRST = 4096  # bytes of a file that must begin with an event, to be taken for a log of events
_encode = json.JSONEncoder(separators=(",", ":"), default=str).encode


class EventLog(Watcher):
    """Writes what happens in a run.

    Parameters
    ----------
    path : Path
        The file, for messages.
    file : int
        Descriptor to write to, from `begin_file` or `open_log`; closed at the end.
    every : float
        Seconds between two writes; with 0 each line is written at once.

    Raises
    ------
    OutputError
        From any call, if the file cannot be written.

    Notes
    -----
    Each event has its time ``t``, in seconds since 1970, and its kind ``event``:

    - ``run``: ``status`` (``running``, ``done``, ``failed``, ``stopped``), ``error``, ``command``, ``bounds``,
      ``crs``, ``tile_size``, ``workers`` (0 where a cluster decides). The first of all, and the last; a run that
      does not begin has the last alone, without what is not known.
    - ``tiles``, ``seams``: lists of name and box, at most `CHUNK` a line.
    - ``planned``: ``stage``, ``scope``, ``total``; again where it changes.
    - ``submitted``: ``stage``, ``name``.
    - ``done``: ``stage``, ``name``, ``done``, ``total``, ``seconds``, ``memory`` (bytes), ``reused``, ``notes`` by
      kind, and ``facts``: numbers that are not 0; ``ago`` (s), where it ended so long before ``t``, as its worker
      went on with what was submitted with it.
    - ``failed``: ``stage``, ``name``, ``reason``, and the ``command`` that shows it alone; none for an item that
      is not run because another one failed.
    - ``message``: ``text``.

    Lines wait in a queue, which a thread of its own writes: a signal's handler may add one at any moment.
    """

    def __init__(self, path: Path, file: int, *, every: float = EVERY) -> None:
        self.path, self._file, self._every = path, file, every
        self._queue: deque[str] = deque()
        self._writing = threading.RLock()
        self._stop = threading.Event()
        self._error: OSError | None = None
        self._busy = False
        self._cut = False  # the last line was written in part
        self._start: RunStart | None = None
        self._scopes: dict[str, Scope] = {}
        self._thread = threading.Thread(target=self._write_now_and_then, name="events", daemon=True)
        if every:
            self._thread.start()

    def begin(self, start: RunStart) -> None:
        """Write what the run is, its tiles and seams, and the stages that it will have."""
        self._start = start
        self._describe_run("running", "")
        self._describe_boxes(start.tiles, start.seams)
        for stage, (scope, total) in start.expected.items():
            self.planned(stage, scope, total)

    def laid_out(self, layout: Layout) -> None:
        """Write the tiles and seams of another layout; those that were there keep their boxes."""
        self._describe_boxes(layout.tiles, layout.seams)

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        """Write how many items a stage has."""
        self._scopes[stage] = scope
        self._add("planned", stage=stage, scope=scope.value, total=total)

    def submitted(self, stage: str, name: str) -> None:
        """Write that an item was given to a worker."""
        self._add("submitted", stage=stage, name=name)

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        """Write that an item is done."""
        self._add(
            "done",
            stage=stage,
            name=record.name,
            done=n_done,
            total=total,
            seconds=round(record.seconds.get("all", 0.0), 3),
            memory=record.peak_memory,
            reused=record.reused,
            notes=record.notes,
            facts=numbers(record.facts),
            **({"ago": record.ago} if record.ago else {}),
        )

    def failed(
        self, stage: str, name: str, reason: str, needs: Item | None = None, *, ends_run: bool = False
    ) -> None:
        """Write that an item failed, or is not run."""
        command = ""
        if needs is None and self._start is not None:
            command = describe_command(self._start, stage, self._scopes[stage], name)
        self._add("failed", stage=stage, name=name, reason=reason, command=command)

    def say(self, text: str) -> None:
        """Write what the user was told."""
        self._add("message", text=text)

    def end(self, status: str, error: str = "") -> None:
        """Write how the run ended, and close the file."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        try:
            self._error = None  # tried once more
            self._describe_run(status, error)
            self._write()
            self._raise()
        finally:
            os.close(self._file)

    def _describe_boxes(self, tiles: Mapping[str, Box], seams: Mapping[str, Box]) -> None:
        for kind, boxes in (("tiles", tiles), ("seams", seams)):
            places = ((name, *box) for name, box in boxes.items())
            while chunk := list(islice(places, CHUNK)):
                self._add(kind, **{kind: chunk})

    def _describe_run(self, status: str, error: str) -> None:
        start = self._start
        known: dict[str, Any] = {}
        if start is not None:
            known = {"command": start.command, "bounds": start.bounds, "crs": start.crs}
            known |= {"tile_size": start.tile_size, "workers": start.workers}
        self._add("run", status=status, error=error, **known)

    def _add(self, kind: str, **content: Any) -> None:
        self._raise()
        self._queue.append(_encode({"t": round(time.time(), 3), "event": kind, **content}) + "\n")
        if not self._every:
            self._write()

    def _write_now_and_then(self) -> None:
        while not self._stop.wait(self._every):
            self._write()

    def _write(self) -> None:
        """Write what waits; an error is kept, to be raised where the run can end by it."""
        with self._writing:
            if self._busy:
                return  # a handler came in between: who is writing takes its line too
            self._busy = True
            try:
                while self._queue:
                    self._write_all([self._queue.popleft() for _ in range(len(self._queue))])
            except OSError as error:
                self._error, self._cut = error, True
            finally:
                self._busy = False

    def _write_all(self, lines: list[str]) -> None:
        left = memoryview(("\n" * self._cut + "".join(lines)).encode())
        while left:
            left = left[os.write(self._file, left) :]
        self._cut = False

    def _raise(self) -> None:
        if self._error is not None:
            raise OutputError(
                f"{self.path}: cannot be written ({self._error.strerror}); free space or choose another place"
            )


def begin_file(path: Path) -> int:
    """Start a file anew: whoever has the old one open keeps it, and finds the new one by its name.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    with replacing(path) as part:
        file = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_NOFOLLOW, 0o644)
    return file


def open_log(path: Path) -> int:
    """Open the file of `--log-json`: a new one, a log of events that is replaced, or a pipe or terminal.

    Raises
    ------
    ConfigError
        If it is a file of another kind, which would be lost, or cannot be opened.
    """
    try:
        if path.is_file() and path.stat().st_size and not _is_log(path):
            raise ConfigError(f"--log-json {path}: is there, and no log of events; give another file")
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)
    except OSError as error:
        raise ConfigError(f"--log-json {path}: cannot be written ({error.strerror}); give another file") from error


def read_events(path: Path) -> Iterator[dict[str, Any]]:
    """Read the events of a run, at work, ended or dead, one after the other.

    Parameters
    ----------
    path : Path
        ``events.jsonl``, or what `--log-json` wrote.

    Yields
    ------
    dict
        As in `EventLog`. A line that is cut off, since the run is just writing it or was killed, is passed over.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            for line in file:
                event = _decode(line)
                if event is not None:
                    yield event
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the folder of a run") from error


def numbers(facts: Facts) -> dict[str, float]:
    """Take the numbers among the facts of a result that a map may show, without those that are 0.

    Examples
    --------
    >>> numbers({"counts": {"cells": 12, "facets": 0}, "facts": {"worst_ratio": [0.2, 0.4]}, "order": "heights"})
    {'cells': 12, 'worst_ratio': 0.4}
    >>> numbers({"files": {"mesh/0_0.vtu": [700, 1], "boundary/0_0.vtp": [55, 2]}})
    {'bytes': 755}
    """
    found: dict[str, float] = {}
    groups: list[Mapping[str, Any]] = [facts, *(facts[group] for group in GROUPS if group in facts)]
    for name, value in ((name, value) for group in groups for name, value in group.items()):
        # What was measured before and after a step: what counts is how it ended.
        last = value[-1] if name == "worst_ratio" and value else value
        if type(last) in (int, float) and last and math.isfinite(last) and name not in PLACING:
            found[name] = last
    if written := sum(size for size, _ in facts.get(FILES, {}).values()):
        found["bytes"] = written
    return found


def _is_log(path: Path) -> bool:
    with path.open("rb") as file:
        first = _decode(file.readline(FIRST))
    return first is not None and "event" in first


def _decode(line: bytes) -> dict[str, Any] | None:
    if not line.endswith(b"\n"):
        return None
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) else None
