"""What a worker of somebody's cluster must meet before it runs a task: same versions, output folder and inputs.

Workers are asked before a run begins. One that joins later is asked by its first task, which comes back unless all
is met: results of another version, or on another disk, are never among those of the run.
"""

import functools
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import ConfigError
from tiler.engine.stage import Facts
from tiler.engine.task import Failure, Record, Task
from tiler.engine.task_limits import run_guarded
from tiler.scheduler.versions import digest_versions, tell_versions
from tiler.store.atomic import replacing

PROBE = ".cluster.json"  # in the folder of a run, as long as its tasks are on a cluster
GRACE = 5.0  # s for a shared folder to show a new file
INPUTS = 20  # files of the inputs that each worker looks for

Files = dict[str, str]  # what is wrong, by path


@dataclass(frozen=True)
class Terms:
    """What a worker must meet; given with every task.

    Attributes
    ----------
    versions : str
        `digest_versions` of the driver.
    probe : str
        Path of a file of the driver in the output folder, which lists inputs too; empty for none.
    token : str
        Hash of the bytes of that file.
    """

    versions: str
    probe: str = ""
    token: str = ""


@dataclass(frozen=True)
class Refusal:
    """Comes back instead of a result from a worker that does not meet the terms.

    Attributes
    ----------
    worker : str
        Its address.
    versions : dict of str to str
        Its versions.
    files : dict of str to str
        What is wrong with files, by path.
    """

    worker: str
    versions: dict[str, str]
    files: Files


@contextmanager
def offer_terms(out: Path, inputs: Sequence[Path]) -> Iterator[Terms]:
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
        yield Terms(own_terms().versions, str(probe), _hash(text))
    finally:
        with suppress(OSError):  # a disk that refuses has said so
            probe.unlink(missing_ok=True)


@functools.cache
def own_versions() -> dict[str, str]:
    """Versions of this process, as they were when it was asked first: what is installed may change meanwhile."""
    return tell_versions()


def own_terms() -> Terms:
    """Terms of this process without files."""
    return Terms(digest_versions(own_versions()))


def check_files(terms: Terms) -> Files:
    """Tell what is wrong with output folder and inputs, as this process sees them."""
    if not terms.probe:
        return {}
    path = Path(terms.probe)
    try:
        text = path.read_bytes()
    except OSError as error:
        return {str(path.parent): f"the output folder is not seen there ({error.strerror})"}
    if _hash(text) != terms.token:
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


def run_on_terms(
    function: Callable[[Task], Facts], task: Task, seconds: float, terms: Terms
) -> Record | Failure | Refusal:
    """Run a task as `run_guarded` does if this process meets the terms."""
    refusal = _refuse(terms)
    return run_guarded(function, task, seconds) if refusal is None else refusal


@functools.lru_cache(maxsize=4)
def _refuse(terms: Terms) -> Refusal | None:
    """Hold this process against the terms, once."""
    versions = own_versions()
    end = time.monotonic() + GRACE
    while (files := check_files(terms)) and time.monotonic() < end:
        time.sleep(0.2)
    if digest_versions(versions) == terms.versions and not files:
        return None
    return Refusal(_address(), versions, files)


def _address() -> str:
    from distributed import get_worker

    return str(get_worker().address)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def _hash(text: bytes) -> str:
    return hashlib.blake2b(text, digest_size=16).hexdigest()
