"""The events of a run, one JSON object a line: ``events.jsonl`` in its folder, and `--log-json`.

Each event has its time ``t``, in seconds since 1970, and its kind ``event``:

- ``run``: ``status`` (``running``, ``done``, ``failed``, ``stopped``), ``error``, ``command``, ``bounds``,
  ``crs``, ``tile_size``, ``workers`` (0 where a cluster decides). The first of all, and the last; a run that
  does not begin has the last alone, without what is not known.
- ``tiles``, ``seams``: lists of name and box.
- ``planned``: ``stage``, ``scope``, ``total``; again where it changes.
- ``submitted``: ``stage``, ``name``.
- ``done``: ``stage``, ``name``, ``done``, ``total``, ``seconds``, ``memory`` (bytes), ``reused``, ``notes`` by
  kind, and ``facts``: numbers that are not 0; ``ago`` (s), where it ended so long before ``t``, as its worker
  went on with what was submitted with it.
- ``failed``: ``stage``, ``name``, ``reason``, and the ``command`` that shows it alone; ``needs``, stage and name
  of the item that failed, where this one is not run for want of it; ``ends_run`` where the run ends by it.
- ``message``: ``text``.
"""

import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError, InputError
from tiler.engine.stage import Facts
from tiler.store.atomic import replacing
from tiler.store.checksums import FILES

Event = dict[str, Any]
PLACING = {"i0", "j0", "nx", "ny", "spacing"}  # facts of rasters: where, not what
GROUPS = ("counts", "facts")  # facts that are groups of facts
FIRST = 4096  # bytes of a file that must begin with an event, to be taken for a log of events


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


def read_events(path: Path) -> Iterator[Event]:
    """Read the events of a run, at work, ended or dead, one after the other.

    Parameters
    ----------
    path : Path
        ``events.jsonl``, or what `--log-json` wrote.

    Yields
    ------
    dict
        See above. A line that is cut off, since the run is just writing it or was killed, is passed over.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            for line in file:
                event = decode(line) if line.endswith(b"\n") else None
                if event is not None:
                    yield event
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the folder of a run") from error


def list_numbers(facts: Facts) -> dict[str, float]:
    """Take the numbers among the facts of a result that a map may show, without those that are 0.

    Examples
    --------
    >>> list_numbers({"counts": {"cells": 12, "facets": 0}, "facts": {"worst_ratio": [0.2, 0.4]}, "order": "x"})
    {'cells': 12, 'worst_ratio': 0.4}
    >>> list_numbers({"files": {"mesh/0_0.vtu": [700, 1], "boundary/0_0.vtp": [55, 2]}})
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


def decode(line: bytes) -> Event | None:
    """Read a line as an event; None if it is none."""
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) else None


def _is_log(path: Path) -> bool:
    with path.open("rb") as file:
        line = file.readline(FIRST)
    return line.endswith(b"\n") and "event" in (decode(line) or ())
