"""One run a folder: a lock file that says who works there, and a heartbeat for file systems without locks."""

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
from tiler.objects.places import in_bucket
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
def only_run(folder: Path, say: Callable[[str], None] | None = None) -> Iterator[Callable[[], None]]:
    """Hold a folder for one run at a time; the hold ends with the process, however it ends.

    Parameters
    ----------
    folder : Path
        An existing folder that can be written.
    say : callable, optional
        Called with a sentence where the file system knows no locks, and where the folder of a dead owner is taken.

    Yields
    ------
    callable
        Raises OutputError if the hold was lost, which only one in a bucket can be.

    Raises
    ------
    ConfigError
        If another run is at work there.
    OutputError
        If the lock file cannot be written.

    Notes
    -----
    A lock of the system on `LOCK`, opened for writing, as NFS wants it. Some mounts keep locks to one machine, and
    some know none: so the file also names its owner and is touched every `BEAT` seconds. An owner on this machine
    is asked for by its process, any other is listened to for `SILENCE` seconds.
    """
    say = say or say_nothing
    if in_bucket(folder):
        from tiler.store.lease import only_run_in_bucket

        with only_run_in_bucket(folder, say) as lease:
            yield lease.check
        return
    path = folder / LOCK
    file, locked = _take(path, say)
    stop = threading.Event()
    beat = threading.Thread(target=_beat, args=(file, stop), daemon=True)
    try:
        beat.start()
        try:
            yield lambda: None
        finally:
            stop.set()
            beat.join()
            owner = _read_owner(path)
            if _is_at(path, file) and (locked or owner is None or owner.pid == os.getpid()):
                with suppress(OSError):
                    path.unlink()
    finally:
        os.close(file)


def is_held(folder: Path) -> bool:
    """Return whether a run is at work in a folder; InputError if its lock file cannot be read."""
    if in_bucket(folder):
        from tiler.store.lease import is_held_in_bucket

        return is_held_in_bucket(folder)
    path = folder / LOCK
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


def _take(path: Path, say: Callable[[str], None]) -> tuple[int, bool]:
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
            if earlier is not None:
                _wait_for_death(path, earlier, say, locked=state == "locked")
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


def _busy(path: Path, owner: Owner | None) -> ConfigError:
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


def _wait_for_death(path: Path, owner: Owner, say: Callable[[str], None], *, locked: bool) -> None:
    """Return when the owner that a lock file names is dead; ConfigError if it lives.

    One elsewhere is listened to for a heartbeat; no clocks are compared, which may differ between machines.
    """
    if locked and not _is_elsewhere(owner):
        return  # the system would have refused the lock
    alive = is_alive(owner)
    if alive is None:
        say(f"{path.parent}: {describe_owner(owner)} was at work there; listening for {SILENCE:g} s whether it is")
        first, end = _touched(path), time.monotonic() + SILENCE
        while not alive and time.monotonic() < end:
            time.sleep(min(1.0, SILENCE / 10))
            alive = _touched(path) != first or _read_owner(path) != owner
    if alive:
        raise _busy(path, owner)
    say(f"{path.parent}: taken over from {describe_owner(owner)}, which is dead")


def _touched(path: Path) -> int:
    try:  # opened: NFS asks its server then
        with path.open("rb") as file:
            return os.fstat(file.fileno()).st_mtime_ns
    except OSError:
        return -1


def _write_owner(path: Path, file: int, *, locked: bool) -> None:
    """Write who holds the folder; without locks, make sure that nobody else did so at the same moment."""
    owner = this_process()
    os.ftruncate(file, 0)
    os.pwrite(file, json.dumps(asdict(owner)).encode() + b"\n", 0)
    if not locked:
        time.sleep(min(1.0, SILENCE / 10))
        if (found := _read_owner(path)) != owner:
            raise _busy(path, found)


def _beat(file: int, stop: threading.Event) -> None:
    while not stop.wait(BEAT):
        with suppress(OSError):
            os.utime(file)


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
