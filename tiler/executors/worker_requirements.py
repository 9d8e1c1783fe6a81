"""What workers of any cluster must meet to run tasks: same versions, same output folder, same inputs.

Scheduler and workers are asked before a run begins. A worker that joins later is asked by its first task, which
comes back undone unless all is met: no result is of another version, or on another disk.
"""

import functools
import hashlib
import inspect
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError
from tiler.executors import versions
from tiler.executors.versions import TRANSPORT, describe_versions, digest_versions
from tiler.store.atomic import replacing
from tiler.store.out_folder import PROBE

GRACE = 5.0  # s for a shared folder to show a new file
INPUTS = 20  # files of the inputs that each worker looks for
ANSWER, LATE_ANSWER = 60.0, 5.0  # s that workers may take to answer, before a run and in it
NAMED = 3  # workers that are named in a line; the others are counted
# Runs the text of `tiler.executors.versions` where there may be no citystitch.
ASK_VERSIONS = "exec(source, scope := {}) or scope['describe_versions'](only)"
EARLY = "this cluster cannot take the tasks of this run, and nothing was written"
LATE = "a worker has joined that cannot take tasks of this run; all that was done is kept"
ADVICE = (
    "install the same versions there, as deploy/requirements.lock has them, and start scheduler and workers again"
)
FILES_ADVICE = "workers must see output folder and inputs under the same paths: mount the shared file system there"

Versions = dict[str, str]
Files = dict[str, str]  # what is wrong, by path


class UnansweredError(ConfigError):
    """A worker has not answered in time: it is out of reach, or its task holds the interpreter."""


class ClusterMismatchError(ConfigError):
    """A cluster cannot take the tasks of a run: its message has a line a difference."""

    @property
    def lines(self) -> list[str]:
        """Lines of the message."""
        return str(self).split("\n")


@dataclass(frozen=True)
class Requirements:
    """What a worker must meet; sent with every task."""

    versions: str  #: `digest_versions` of the driver
    probe: str = ""  #: path of a file of the driver in the output folder, which lists inputs too; empty for none
    token: str = ""  #: hash of the bytes of that file


@dataclass(frozen=True)
class Mismatch:
    """Result of a task on a worker that does not meet the requirements."""

    worker: str  #: its address
    versions: Versions  #: its versions
    files: Files  #: what is wrong with files, by path

    def as_error(self, address: str) -> ClusterMismatchError:
        """Error of a run on the scheduler of that address."""
        lines = compare_versions(own_versions(), {self.worker: self.versions})
        files = compare_files({self.worker: self.files})
        advice = [*([ADVICE] if lines else []), *([FILES_ADVICE] if files else [])]
        return ClusterMismatchError("\n".join([f"{address}: {LATE}", *lines, *files, *advice]))


@functools.cache
def own_versions() -> Versions:
    """Versions of this process, as they were when it was asked first: what is installed may change meanwhile."""
    return describe_versions()


def own_requirements() -> Requirements:
    """Requirements of this process without files."""
    return Requirements(digest_versions(own_versions()))


@contextmanager
def require_files(out: Path, inputs: Sequence[Path]) -> Iterator[Requirements]:
    """Write the probe into the output folder, for the time of a run.

    Parameters
    ----------
    out : Path
        Folder of the run, absolute.
    inputs : sequence of Path
        Files of the inputs; the first `INPUTS` of them are looked for.

    Raises
    ------
    ConfigError
        If an input cannot be looked at.
    OutputError
        If the folder cannot be written.
    """
    sizes = {str(path.absolute()): _size(path) for path in inputs[:INPUTS]}
    text = json.dumps({"token": os.urandom(16).hex(), "inputs": sizes}).encode()
    probe = out / PROBE
    with replacing(probe) as part:
        part.write_bytes(text)
    try:
        yield Requirements(own_requirements().versions, str(probe), _hash(text))
    finally:
        with suppress(OSError):  # a disk that refuses has said so
            probe.unlink(missing_ok=True)


def check_files(requirements: Requirements) -> Files:
    """Find what is wrong with output folder and inputs, as this process sees them."""
    if not requirements.probe:
        return {}
    path = Path(requirements.probe)
    try:
        text = path.read_bytes()
    except OSError as error:
        return {str(path.parent): f"the output folder is not seen there ({error.strerror})"}
    if _hash(text) != requirements.token:
        return {str(path.parent): "is another folder there"}
    found = {}
    for name, size in json.loads(text)["inputs"].items():
        try:
            there = Path(name).stat().st_size
        except OSError as error:
            found[name] = f"the input is not seen there ({error.strerror})"
            continue
        if there != size:
            found[name] = f"the input has {there} bytes there, {size} here"
    return found


@functools.lru_cache(maxsize=4)
def find_mismatch(requirements: Requirements) -> Mismatch | None:
    """In a worker: compare this process with the requirements, once."""
    from distributed import get_worker

    found = own_versions()
    end = time.monotonic() + GRACE
    while (files := check_files(requirements)) and time.monotonic() < end:
        time.sleep(0.2)
    if digest_versions(found) == requirements.versions and not files:
        return None
    return Mismatch(str(get_worker().address), found, files)


def check_cluster(client: Any, address: str, requirements: Requirements, *, late: bool = False) -> None:
    """Compare scheduler and all workers with this process.

    Parameters
    ----------
    client : distributed.Client
        Connected client.
    address : str
        What the user calls the scheduler.
    requirements : Requirements
        What workers must meet.
    late : bool
        Whether the run is at work already.

    Raises
    ------
    ClusterMismatchError
        If a version differs or a library is missing, or if output folder or inputs are not there, or others.
    UnansweredError
        If a worker does not answer within `ANSWER` or `LATE_ANSWER` seconds.
    """
    here, source, head = own_versions(), inspect.getsource(versions), f"{address}: {LATE if late else EARLY}"
    carried = {name: here[name] for name in ("python", "citystitch", *TRANSPORT)}
    bound = LATE_ANSWER if late else ANSWER

    def ask(function: Callable[..., Any], *given: Any, **named: Any) -> Any:
        return _ask(client, address, bound, function, *given, **named)

    there = ask(client.run_on_scheduler, eval, ASK_VERSIONS, {"source": source, "only": TRANSPORT})
    lines = compare_versions(carried, {f"scheduler {address}": there})
    found = ask(client.run, eval, ASK_VERSIONS, {"source": source, "only": None}, on_error="return")
    lines += compare_versions(here, found)
    if lines:
        raise ClusterMismatchError("\n".join([head, *lines, ADVICE]))
    end = time.monotonic() + GRACE
    while lines := compare_files(ask(client.run, check_files, requirements, on_error="return")):
        if time.monotonic() >= end:
            raise ClusterMismatchError("\n".join([head, *lines, FILES_ADVICE]))
        time.sleep(0.5)


def compare_versions(here: Versions, there: Mapping[str, Versions | BaseException]) -> list[str]:
    """Describe differences of versions, a line for each library and version that is elsewhere.

    Parameters
    ----------
    here : dict of str to str
        Versions of this process.
    there : mapping of str to dict of str to str
        Those elsewhere by address; an error for one that could not tell.

    Examples
    --------
    >>> compare_versions({"numpy": "2.4"}, {"tcp://a:1": {"numpy": "2.3"}, "tcp://b:1": {"numpy": "2.4"}})
    ['numpy: 2.4 here, 2.3 there (tcp://a:1)']
    """
    lines: dict[str, list[str]] = {}
    for place, found in sorted(there.items()):
        if isinstance(found, BaseException):
            words = " ".join(f"{type(found).__name__}: {found}".split())
            lines.setdefault(f"versions: cannot be told there ({words})", []).append(place)
            continue
        for name, version in here.items():
            if found.get(name) != version:
                lines.setdefault(f"{name}: {version} here, {found.get(name)} there", []).append(place)
    return [f"{line} ({_name(places)})" for line, places in lines.items()]


def compare_files(there: Mapping[str, Files | BaseException]) -> list[str]:
    """Describe what is wrong with files, by path, elsewhere: a line for each file and fault."""
    lines: dict[str, list[str]] = {}
    for place, found in sorted(there.items()):
        told = {"files": f"cannot be looked at there ({found!r})"} if isinstance(found, BaseException) else found
        for path, what in told.items():
            lines.setdefault(f"{path}: {what}", []).append(place)
    return [f"{line} ({_name(places)})" for line, places in lines.items()]


def _name(places: list[str]) -> str:
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    return ", ".join(places[:NAMED]) + more


def _ask(client: Any, address: str, bound: float, function: Callable[..., Any], *given: Any, **named: Any) -> Any:
    """Ask scheduler or workers, for a bounded time."""

    async def ask() -> Any:
        return await function(*given, **named)

    try:
        return client.sync(ask, callback_timeout=bound)
    except TimeoutError as error:
        raise UnansweredError(
            f"{address}: not all workers have answered within {bound:g} s; look at their logs, and run again"
        ) from error


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def _hash(text: bytes) -> str:
    return hashlib.blake2b(text, digest_size=16).hexdigest()
