"""A run's folder, followed: new lines of its events are folded when somebody asks, a little at a time."""

import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.data.errors import CityError, InputError
from tiler.monitoring.events import decode
from tiler.monitoring.run_state import RunState
from tiler.store.folder_lock import is_held
from tiler.store.out_folder import EVENTS, RUN_RECORD

CHUNK = 2**20  # bytes that are read at once
LONGEST = 2**24  # bytes of a line; a longer one is no event
PATIENCE = 0.5  # s that one question may spend on reading; the next goes on


class EventReader:
    """The events of a run, read as they are written.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    alive : callable, optional
        Tells whether the run is at work; by default whether a process holds the folder.

    Attributes
    ----------
    model : RunState
        What was read so far.
    run : str
        Changes when a run starts the file anew: what was known before is void.
    share : float
        How much of the file is read, 0 to 1.
    lock : threading.Lock
        Held by whoever looks at the model while others may ask.

    Notes
    -----
    Nobody asks, nothing is read: a page that is not open costs a run nothing.
    """

    def __init__(self, folder: Path, alive: Callable[[], bool] | None = None) -> None:
        self.folder, self.lock = folder, threading.Lock()
        self._alive = alive
        self._start(None)

    def _start(self, identity: tuple[int, int] | None) -> None:
        self.model, self._identity = RunState(), identity
        self._offset, self._rest = 0, b""
        self.share = 1.0
        self.run = f"{time.time_ns():x}"

    def alive(self) -> bool:
        """Return whether the run is at work."""
        if self._alive is not None:
            return self._alive()
        try:
            return is_held(self.folder)
        except CityError:
            return False

    def advance(self, patience: float = PATIENCE) -> None:
        """Read what is new, for so many seconds at most; call it with the lock held.

        Raises
        ------
        InputError
            If the folder holds neither events nor the record of a run.
        """
        until = time.monotonic() + patience
        path = self.folder / EVENTS
        try:
            with path.open("rb") as file:
                found = os.fstat(file.fileno())
                if self._identity != (found.st_dev, found.st_ino) or found.st_size < self._offset:
                    self._start((found.st_dev, found.st_ino))
                file.seek(self._offset)
                while chunk := file.read(CHUNK):
                    self._offset += len(chunk)
                    self._take(chunk)
                    if time.monotonic() > until:
                        break
                self.share = min(self._offset / max(found.st_size, 1), 1.0)
        except FileNotFoundError:
            self._from_record()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error

    def _take(self, chunk: bytes) -> None:
        """Fold the whole lines; the last one may be on its way."""
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        if len(self._rest) > LONGEST:
            self._rest = b""
            self.model.ignored += 1
        for line in lines:
            if line.strip():
                self.model.fold(decode(line))

    def _from_record(self) -> None:
        """Show a run that wrote no events by its record."""
        path = self.folder / RUN_RECORD
        try:
            stat = path.stat()
            if self._identity == (stat.st_dev, stat.st_ino):
                return
            record = json.loads(path.read_bytes())
            events = list(events_of_record(record))
        except FileNotFoundError:
            raise InputError(
                f"{self.folder}: holds neither {EVENTS} nor {RUN_RECORD}; give the folder of a run that was begun"
            ) from None
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"{path}: is damaged ({error!r}); run again, and it is written anew") from None
        self._start((stat.st_dev, stat.st_ino))
        for event in events:
            self.model.fold(event)


def events_of_record(record: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Return the record of a run, ``run.json``, as events: tiles that are there, and tiles that are missing."""
    region = record.get("region", {})
    head = {name: region.get(name) for name in ("bounds", "crs", "tile_size") if name in region}
    yield {"event": "run", "t": 0.0, "status": record["status"], "error": record.get("error", "")} | head
    tiles, missing = record.get("tiles", {}), record.get("missing", {})
    if tiles:
        yield {"event": "tiles", "tiles": [[name, *tile["box"]] for name, tile in tiles.items()]}
    yield {"event": "planned", "stage": "pieces", "scope": "tile", "total": len(tiles) + len(missing)}
    for name, tile in tiles.items():
        facts = {fact: n for fact, n in tile["counts"].items() if isinstance(n, int)}
        yield {"event": "done", "stage": "pieces", "name": name, "facts": facts}
    for name, found in missing.items():
        told = {part: found.get(part, "") for part in ("stage", "reason", "command")}
        yield {"event": "failed", "name": name} | told
    for kind, group in record.get("notes", {}).items():
        yield {"event": "message", "text": f"{group['count']} {str(kind).replace('-', ' ')}"}
