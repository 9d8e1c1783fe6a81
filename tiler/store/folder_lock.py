"""One run a folder: a lock file or object that says who works there, and its heartbeat.

The library filelock has no heartbeat for mounts without locks, names no owner, and knows no buckets.
"""

import errno
import fcntl
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.data.errors import ConfigError, InputError, OutputError
from tiler.objects.path import ObjectPath
from tiler.objects.places import in_bucket
from tiler.objects.requests import ChangedError
from tiler.words.plain_text import say_nothing

LOCK = ".run.lock"  # in the folder of a run, as long as the run is at work
ASKED = 5  # how often a lock is asked for that another process holds
BEAT = 10.0  # s between two heartbeats: the lock file's time of change
SILENCE = 35.0  # s without a heartbeat after which an owner that cannot be asked counts as dead
HELD = {errno.EWOULDBLOCK, errno.EACCES}  # what a lock says that another process has
BUSY = "another run is at work there"
NEXT = "wait for its end, or give another --out"


@dataclass(frozen=True)
class Owner:
    """Who holds a folder.

    `place` and `began` are empty where the system does not tell them; `token` is never met again.
    """

    host: str
    place: str  # boot and namespace of processes, within which `pid` means something
    pid: int
    began: str  # ticks after the boot, since process numbers come again
    token: str


@contextmanager
def only_run(folder: Path, say: Callable[[str], None] = say_nothing) -> Iterator[Callable[[], None]]:
    """Hold a folder for one run at a time; the hold ends with the process, however it ends.

    Parameters
    ----------
    folder : Path
        An existing folder that can be written, or the name in a bucket that results lie below.
    say : callable, optional
        Called with a sentence where the file system knows no locks, and where the folder of a dead owner is taken.

    Yields
    ------
    callable
        Raises OutputError if the hold was lost, which only one in a bucket can be.

    Raises
    ------
    ConfigError
        If another run is at work there, or nothing can be put into the bucket.
    OutputError
        If the lock file cannot be written.

    Notes
    -----
    A lock of the system on `LOCK`, opened for writing, as NFS wants it. Some mounts keep locks to one machine, and
    some know none: so the file also names its owner and is touched every `BEAT` seconds. In a bucket it is an
    object, put if there is none (``If-None-Match``) and replaced if it is the one that was read (``If-Match``), at
    each beat too: the store decides who is first. An owner on this machine is asked for by its process, any other
    is listened to for `SILENCE` seconds.
    """
    path = folder / LOCK
    hold: _FileHold | _ObjectHold = _ObjectHold(path, say) if in_bucket(path) else _FileHold(path, say)
    stop, lost = threading.Event(), threading.Event()

    def beat() -> None:
        while not stop.wait(BEAT):
            with suppress(OSError, OutputError):  # a store that is not there has no other owner either
                if not hold.beat():
                    lost.set()
                    return

    def check() -> None:
        if lost.is_set():
            raise OutputError(
                f"{folder}: another run has taken it over, as nothing was heard of this one for {SILENCE:g} s; "
                "let one of them go on"
            )

    thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield check
    finally:
        stop.set()
        thread.join()
        hold.give_back()


def is_held(folder: Path) -> bool:
    """Return whether a run is at work in a folder; InputError if its lock file cannot be read."""
    path = folder / LOCK
    if in_bucket(path):
        lease = _read_lease(path)
        return lease is not None and _lives(lease[0], lambda: _read_lease(path), lease)
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); remove it if no run is at work") from error
    try:
        state = _ask(file, fcntl.LOCK_SH)
        owner = _read_owner(path)
        if state == "held" or owner is None:
            return state == "held"
        known = is_alive(owner) if state == "none" or _is_elsewhere(owner) else False
        return time.time() - os.fstat(file).st_mtime < SILENCE if known is None else known
    finally:
        os.close(file)


class _FileHold:
    """The lock file of a folder on a disk, held."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self._path = path
        self._file, self._locked = _take_file(path, say)

    def beat(self) -> bool:
        os.utime(self._file)
        return True

    def give_back(self) -> None:
        try:
            owner = _read_owner(self._path)
            ours = self._locked or owner is None or owner.pid == os.getpid()
            if _is_at(self._path, self._file) and ours:
                with suppress(OSError):
                    self._path.unlink()
        finally:
            os.close(self._file)


class _ObjectHold:
    """The lock of a folder in a bucket: an object, this process, and the tag that the object has now."""

    def __init__(self, path: ObjectPath, say: Callable[[str], None]) -> None:
        self._path, self._owner, self._beats = path, this_process(), 0
        try:
            self._tag = self._take(say)
        except OSError as error:
            words = f"cannot be written ({error.strerror}); give another --out"
            raise ConfigError(f"{path.parent}: {words}") from error

    def _take(self, say: Callable[[str], None]) -> str:
        path = self._path
        while True:
            found = _read_lease(path)
            if found is not None:
                _refuse_living(path, found[0], say, lambda: _read_lease(path), found)
            try:
                return path.put_if(self._text(), None if found is None else found[1])
            except (ChangedError, FileNotFoundError) as error:
                if isinstance(error, FileNotFoundError) and found is None:
                    raise
                if tag := self._find_tag():
                    return tag

    def beat(self) -> bool:
        self._beats += 1
        try:
            self._tag = self._path.put_if(self._text(), self._tag)
        except (ChangedError, FileNotFoundError):
            self._tag = self._find_tag()
        return bool(self._tag)

    def give_back(self) -> None:
        with suppress(OSError, OutputError):
            if self._find_tag():
                self._path.unlink()

    def _find_tag(self) -> str:
        """Give the tag of the object if it is ours, else nothing: a put that was repeated finds its own object."""
        found = _read_lease(self._path)
        return found[1] if found is not None and found[0] and found[0].token == self._owner.token else ""

    def _text(self) -> bytes:
        return json.dumps(asdict(self._owner) | {"beats": self._beats}).encode() + b"\n"


def _read_lease(path: ObjectPath) -> tuple[Owner | None, str] | None:
    """Read owner and tag of the lock in a bucket; None where there is none."""
    try:
        tag = path.stat().e_tag
        return parse_owner(path.read_bytes()), tag
    except FileNotFoundError:
        return None


def _take_file(path: Path, say: Callable[[str], None]) -> tuple[int, bool]:
    """Take the lock file: its descriptor, and whether the system has locked it."""
    while True:
        file = -1
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
            state = _ask_often(file)
            if state == "held":
                raise _busy(path, _read_owner(path))
            # Its holder removes the file at the end: the lock may be on one that is gone.
            if not _is_at(path, file):
                os.close(file)
                continue
            earlier = _read_owner(path)
            # Of an owner on this machine the system would have refused the lock.
            if earlier is not None and (state == "none" or _is_elsewhere(earlier)):
                _refuse_living(path, earlier, say, lambda: _look_at_file(path))
            if state == "none":
                say(
                    f"{path.parent}: its file system has no locks; a second run is kept out by the heartbeat of "
                    f"{path.name} alone"
                )
            _write_owner(path, file, locked=state == "locked")
            return file, state == "locked"
        except BaseException as error:
            if file >= 0:
                os.close(file)
            if not isinstance(error, OSError):
                raise
            if error.errno == errno.ELOOP:
                raise ConfigError(f"{path}: is a symbolic link; remove it") from error
            raise OutputError(
                f"{path}: cannot be written ({error.strerror}); free space or choose another folder"
            ) from error


def _refuse_living(
    path: Path | ObjectPath,
    owner: Owner | None,
    say: Callable[[str], None],
    look: Callable[[], object],
    first: object = None,
) -> None:
    """Return when the owner that a lock names is dead; ConfigError if it lives (see `_lives`)."""
    name = "a run" if owner is None else describe_owner(owner)
    if owner is None or is_alive(owner) is None:
        say(f"{path.parent}: {name} was at work there; listening for {SILENCE:g} s whether it is")
    if _lives(owner, look, first):
        raise _busy(path, owner)
    say(f"{path.parent}: taken over from {name}, which is dead")


def _lives(owner: Owner | None, look: Callable[[], object], first: object = None) -> bool:
    """Return whether an owner lives; one elsewhere is listened to: whether `look` sees something new.

    It gives None where there is no lock any more. No clocks are compared, which may differ between machines.
    """
    known = None if owner is None else is_alive(owner)
    if known is not None:
        return known
    first, end = first or look(), time.monotonic() + SILENCE
    while time.monotonic() < end:
        time.sleep(min(1.0, SILENCE / 10))
        if (found := look()) != first:
            return found is not None
    return False


def _look_at_file(path: Path) -> tuple[int, Owner | None]:
    try:  # opened: NFS asks its server then
        with path.open("rb") as file:
            touched = os.fstat(file.fileno()).st_mtime_ns
    except OSError:
        touched = -1
    return touched, _read_owner(path)


def _busy(path: Path | ObjectPath, owner: Owner | None) -> ConfigError:
    name = f" ({describe_owner(owner)})" if owner is not None else ""
    return ConfigError(f"{path.parent}: {BUSY}{name}; {NEXT}")


def _ask_often(file: int) -> str:
    """Ask for the lock more than once: whoever asks for the status holds it for a blink."""
    for _ in range(ASKED - 1):
        if (state := _ask(file, fcntl.LOCK_EX)) != "held":
            return state
        time.sleep(0.05)
    return _ask(file, fcntl.LOCK_EX)


def _ask(file: int, lock: int) -> str:
    """Ask the system for a lock: ``"locked"``, ``"held"`` by another process, or ``"none"`` where it has none."""
    try:
        fcntl.flock(file, lock | fcntl.LOCK_NB)
    except OSError as error:
        return "held" if error.errno in HELD else "none"
    return "locked"


def _write_owner(path: Path, file: int, *, locked: bool) -> None:
    """Write who holds the folder; without locks, make sure that nobody else did so at the same moment."""
    owner = this_process()
    os.ftruncate(file, 0)
    os.pwrite(file, json.dumps(asdict(owner)).encode() + b"\n", 0)
    if not locked:
        time.sleep(min(1.0, SILENCE / 10))
        if (found := _read_owner(path)) != owner:
            raise _busy(path, found)


def _is_at(path: Path, file: int) -> bool:
    try:
        there, here = path.stat(follow_symlinks=False), os.fstat(file)
    except FileNotFoundError:
        return False
    return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)


def _read_owner(path: Path) -> Owner | None:
    """Read who holds a folder; None where the file says nothing, as one does that is just being written."""
    try:
        return parse_owner(path.read_bytes())
    except OSError:
        return None


def parse_owner(text: bytes) -> Owner | None:
    """Parse who holds a folder; None where the text does not say so."""
    try:
        found = json.loads(text)
        words = {name: str(found[name]) for name in ("host", "place", "began", "token")}
        return Owner(pid=int(found["pid"]), **words)
    except (ValueError, KeyError, TypeError):
        return None


def describe_owner(owner: Owner) -> str:
    """Name who has a folder."""
    return f"process {owner.pid} on {owner.host}"


def this_process() -> Owner:
    """Name this process as an owner."""
    pid = os.getpid()
    return Owner(socket.gethostname(), _place(), pid, _began(pid), uuid.uuid4().hex)


def _place() -> str:
    """Name the boot and the namespace of processes: only within one can a process be asked for."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _began(pid: int) -> str:
    """Return when a process began, in ticks after the boot (field 22 of its ``stat``)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def _is_elsewhere(owner: Owner) -> bool:
    return (owner.host, owner.place) != (socket.gethostname(), _place())


def is_alive(owner: Owner) -> bool | None:
    """Return whether an owner lives; None if it is elsewhere and cannot be asked for."""
    if _is_elsewhere(owner):
        return None
    try:
        os.kill(owner.pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return _began(owner.pid) == owner.began
