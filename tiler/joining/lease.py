"""Who drives a run that several processes on several machines work at: a lease in files, without locks.

Each driver has a number. Its lease is the file ``driver.NUMBER``, made by the first who asks for it (`O_EXCL`) and
never made again: whoever takes over makes the next one. The holder touches it now and then, the others listen. No
clocks are compared: silence is how long a listener has heard nothing, by its own clock, while it could listen.
"""

import json
import os
import shutil
import threading
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import CityError, OutputError
from tiler.store.folder_lock import Owner, is_alive, tell_owner, this_process

BEAT = 3.0  # s between two heartbeats
SILENCE = 30.0  # s without one, after which a process counts as dead
LOOK = 1.0  # s between two looks at those who may be dead, or have ended
BLINK = 5.0  # s at most that count between two looks: who could not look has not heard silence
PREFIX = "driver."
OVER = "over"  # the first word of a line that ends a lease
KNOCK = ".knock"


class LostFolderError(CityError):
    """Another process drives the run now: this one must write nothing more."""


@dataclass(frozen=True)
class Holder:
    """Who drives a run, or works at it.

    Attributes
    ----------
    owner : Owner
        The process.
    member : str
        Its name for people.
    workers : int
        Number of its worker processes.
    parameters : mapping of str to object
        What the run is configured with, as plain JSON, and versions of code.
    """

    owner: Owner
    member: str
    workers: int
    parameters: Mapping[str, Any]

    def tell(self) -> str:
        """Name it for people."""
        return f"{self.member} ({tell_owner(self.owner)})"


def this_holder(member: str, workers: int, parameters: Mapping[str, Any]) -> Holder:
    """Describe this process."""
    return Holder(this_process(), member, workers, parameters)


class Pulse:
    """Listens to the heartbeat of a process.

    Parameters
    ----------
    path : Path
        The file that it touches.
    owner : Owner or None
        The process, if it is known: one of this machine is asked for, too.

    Attributes
    ----------
    heard : bool
        Whether a heartbeat was heard.
    """

    def __init__(self, path: Path, owner: Owner | None) -> None:
        self._path, self._owner = path, owner
        self._touched, self._looked, self._quiet = touched(path), time.monotonic(), 0.0
        self.heard = False

    def is_dead(self) -> bool:
        """Look: whether the process has ended, or been silent for `SILENCE` seconds."""
        if self._owner is not None and is_alive(self._owner) is False:
            return True
        now, found = time.monotonic(), touched(self._path)
        self.heard |= found not in (self._touched, -1)
        self._quiet = 0.0 if found != self._touched else self._quiet + min(now - self._looked, BLINK)
        self._touched, self._looked = found, now
        return self._quiet >= SILENCE


class Heart:
    """Touches a file every `BEAT` seconds, in a thread of its own, until it is stopped.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    missed : bool
        Whether others may have heard silence by now, or the file is gone: who works on others' trust must stop.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._stop, self._last = path, threading.Event(), time.monotonic()
        self.missed = False
        self._thread = threading.Thread(target=self._beat, name="heart", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Beat no more."""
        self._stop.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._stop.wait(BEAT):
            try:
                os.utime(self._path)
            except FileNotFoundError:
                self.missed = True
            except OSError:
                continue
            now = time.monotonic()
            self.missed |= now - self._last > SILENCE / 2
            self._last = now


class Lease:
    """The lease of this process; made by `take_lease`.

    Parameters
    ----------
    path : Path
        Its file.
    number : int
        Which driver this is.
    """

    def __init__(self, path: Path, number: int) -> None:
        self.path, self.number = path, number
        self._heart = Heart(path)
        self._checked = time.monotonic()

    def check(self) -> None:
        """Make sure, at most every `LOOK` seconds, that the lease is held; LostFolderError if not."""
        if time.monotonic() - self._checked >= LOOK or self._heart.missed:
            self.check_now()

    def check_now(self) -> None:
        """Make sure that the lease is held; LostFolderError if another one has taken over, or its file is gone."""
        if is_over(self.path):
            raise LostFolderError(
                f"{self.path}: another process drives the run now, as this one was silent for more than "
                f"{SILENCE:g} s; it goes on without this one"
            )
        self._checked = time.monotonic()

    def close(self) -> None:
        """Give the lease back: whoever waits may take the next one."""
        self._heart.stop()
        end_lease(self.path)


def take_lease(spool: Path, number: int, holder: Holder) -> Lease | None:
    """Take the lease of a number; None if another process was faster, or the spool is gone.

    Raises
    ------
    OutputError
        If the disk refuses.
    """
    path = spool / f"{PREFIX}{number}"
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
    except (FileExistsError, FileNotFoundError):
        return None
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); check the folder") from error
    try:
        os.write(file, _encode(holder))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); free space") from error
    finally:
        os.close(file)
    if number > 1:
        end_lease(spool / f"{PREFIX}{number - 1}")  # should it only have slept
    return Lease(path, number)


def end_lease(path: Path) -> None:
    """Write into a lease that it is over; nothing happens if it is gone."""
    with suppress(FileNotFoundError):
        file = os.open(path, os.O_WRONLY | os.O_APPEND)
        try:
            os.write(file, f"{OVER}\n".encode())
        finally:
            os.close(file)


def is_over(path: Path) -> bool:
    """Whether a lease is over, or gone."""
    try:
        return OVER.encode() in path.read_bytes().splitlines()[1:]
    except FileNotFoundError:
        return True


def newest_lease(spool: Path) -> int:
    """Number of the last driver; 0 if there was none."""
    names = [name for name in fresh_names(spool) if name.startswith(PREFIX)]
    return max((int(name[len(PREFIX) :]) for name in names if name[len(PREFIX) :].isdecimal()), default=0)


def fresh_names(folder: Path) -> list[str]:
    """List a folder, none if it is gone.

    A file made and removed first makes this machine forget what it remembers of the folder.
    """
    knock = folder / f"{KNOCK}.{uuid.uuid4().hex}"
    try:
        knock.touch()
        knock.unlink()
        return sorted(name for name in os.listdir(folder) if not name.startswith("."))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror}); check the folder") from error


def read_holder(path: Path) -> Holder | None:
    """Read who has a lease, or made a member's folder; None while it is just being written, or gone."""
    try:
        found = json.loads(path.read_bytes().splitlines()[0])
        owner = Owner(**{name: found["owner"][name] for name in ("host", "place", "pid", "began", "token")})
        return Holder(owner, str(found["member"]), int(found["workers"]), dict(found["parameters"]))
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        return None


def write_holder(path: Path, holder: Holder) -> None:
    """Write what `read_holder` reads."""
    path.write_bytes(_encode(holder))


def touched(path: Path) -> int:
    """When a file was touched last (ns, by the clock of its file system); -1 if it is gone."""
    try:  # opened: a network file system asks its server then
        with path.open("rb") as file:
            return os.fstat(file.fileno()).st_mtime_ns
    except OSError:
        return -1


def remove_folder(folder: Path) -> None:
    """Take a folder away: gone at once for all others, then removed as far as that can be done."""
    gone = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.gone")
    try:
        os.replace(folder, gone)
    except OSError:
        return
    shutil.rmtree(gone, ignore_errors=True)


def _encode(holder: Holder) -> bytes:
    return json.dumps(asdict(holder)).encode() + b"\n"
