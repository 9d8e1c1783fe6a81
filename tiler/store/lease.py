"""One run at a time for the results in a bucket: an object that names its owner, put on conditions as a heartbeat.

The object is put if there is none (``If-None-Match``), and replaced if it is the one that was read (``If-Match``):
the store decides who is first. An owner on this machine is asked for by its process; to another one it is listened
for `SILENCE` seconds, by the tag that each heartbeat changes. A killed run leaves its lease, for the next to take.
"""

import dataclasses
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from pipeline.data.errors import ConfigError, OutputError
from tiler.objects.path import ObjectPath
from tiler.objects.requests import ChangedError
from tiler.store import folder_lock
from tiler.store.folder_lock import BUSY, LOCK, NEXT, Owner
from tiler.words.plain_text import say_nothing


class Lease:
    """A lease that is held: its object, this process, and the tag that the object has now."""

    def __init__(self, path: ObjectPath, owner: Owner, e_tag: str) -> None:
        self._path, self._owner, self._tag = path, owner, e_tag
        self._stop = threading.Event()
        self._lost = False
        self._thread = threading.Thread(target=self._beat, name="lease", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise OutputError if another run has taken the lease."""
        if self._lost:
            raise OutputError(
                f"{self._path.parent}: another run has taken it over, as nothing was heard of this one for "
                f"{folder_lock.SILENCE:g} s; let one of them go on"
            )

    def give_back(self) -> None:
        """Delete the object, if it is still this lease's."""
        self._stop.set()
        self._thread.join()
        with suppress(OSError, OutputError):
            if _find_tag(self._path, self._owner):
                self._path.unlink()

    def _beat(self) -> None:
        beats = 0
        while not self._stop.wait(folder_lock.BEAT):
            beats += 1
            with suppress(OSError, OutputError):  # a store that is not there has no other owner either
                try:
                    self._tag = self._path.put_if(_text(self._owner, beats), self._tag)
                except (ChangedError, FileNotFoundError):
                    self._tag = _find_tag(self._path, self._owner)
                    if not self._tag:
                        self._lost = True
                        return


@contextmanager
def only_run_in_bucket(folder: ObjectPath, say: Callable[[str], None]) -> Iterator[Lease]:
    """Hold what lies below a name for one run at a time.

    Parameters
    ----------
    folder : ObjectPath
        Where the results are.
    say : callable
        Called with a sentence where the lease of a dead owner is taken over.

    Raises
    ------
    ConfigError
        If another run is at work there, or nothing can be put there.
    """
    path, owner = folder / LOCK, folder_lock.this_process()
    try:
        lease = Lease(path, owner, _take(path, owner, say))
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error.strerror}); give another --out") from error
    try:
        yield lease
    finally:
        lease.give_back()


def is_held_in_bucket(folder: ObjectPath) -> bool:
    """Return whether a run is at work there; one elsewhere is listened for."""
    path = folder / LOCK
    found = _read(path)
    return found is not None and _lives(path, *found)


def _take(path: ObjectPath, owner: Owner, say: Callable[[str], None]) -> str:
    while True:
        found = _read(path)
        if found is not None:
            name = f" ({folder_lock.describe_owner(found[0])})" if found[0] is not None else ""
            if _lives(path, *found, say=say):
                raise ConfigError(f"{path.parent}: {BUSY}{name}; {NEXT}")
            say(f"{path.parent}: taken over from{name or ' a run'}, which is dead")
        try:
            return path.put_if(_text(owner, 0), None if found is None else found[1])
        except (ChangedError, FileNotFoundError) as error:
            if isinstance(error, FileNotFoundError) and found is None:
                raise
            if tag := _find_tag(path, owner):
                return tag


def _find_tag(path: ObjectPath, owner: Owner) -> str:
    """Give the tag of a lease that is this owner's, else nothing: a put that was repeated finds its own object."""
    found = _read(path)
    return found[1] if found is not None and found[0] is not None and found[0].token == owner.token else ""


def _read(path: ObjectPath) -> tuple[Owner | None, str] | None:
    """Read owner and tag of a lease; None where there is none."""
    try:
        tag = path.stat().e_tag
        return folder_lock.parse_owner(path.read_bytes()), tag
    except FileNotFoundError:
        return None


def _lives(path: ObjectPath, owner: Owner | None, e_tag: str, say: Callable[[str], None] = say_nothing) -> bool:
    known = None if owner is None else folder_lock.is_alive(owner)
    if known is not None:
        return known
    say(f"{path.parent}: a run was at work there; listening for {folder_lock.SILENCE:g} s whether it is")
    end = time.monotonic() + folder_lock.SILENCE
    while time.monotonic() < end:
        time.sleep(min(1.0, folder_lock.SILENCE / 10))
        found = _read(path)
        if found is None:
            return False
        if found[1] != e_tag:
            return True
    return False


def _text(owner: Owner, beats: int) -> bytes:
    return json.dumps(dataclasses.asdict(owner) | {"beats": beats}).encode() + b"\n"
