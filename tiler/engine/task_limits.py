"""Limits of tasks in worker processes, and what a process that ends leaves to tell why.

A task that crashes its process, hangs, or takes more memory than there is cannot report it. So before it starts
a file is opened, into which the interpreter's own fault handler writes the traceback of a crash or at the time
limit; the file goes when the task ends. What is found in it afterwards says which task it was, and why.
"""

import faulthandler
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from pipeline.data.errors import CityError, OutputError
from tiler.config.config import Config
from tiler.engine.submission import Function, Outcome
from tiler.engine.task import Failure, Task, run_task
from tiler.objects.places import local_folder
from tiler.store.out_folder import TASKS

TIMEOUT = "Timeout ("  # how the fault handler begins at the time limit
TRIM_AT = 400 * 2**20  # bytes that a worker holds before a task when it gives back what it does not use
REFUSE_AT, KILL_AT = 0.9, 0.95  # of the limit: no more is given; a process is ended whose memory was not counted
CONTAINER_MEMORY = (  # where Linux tells what a container may take (bytes): control groups of version 1, then of 2
    "/sys/fs/cgroup/memory/memory.limit_in_bytes",
    "/sys/fs/cgroup/memory/memory.soft_limit_in_bytes",
    "/sys/fs/cgroup/memory.max",
    "/sys/fs/cgroup/memory.high",
    "/sys/fs/cgroup/memory.low",
)
MEMORY_SHARE = 0.9  # of the machine, for all workers together
ADVICE = "use fewer workers, give each more memory (--memory-limit), or make tiles smaller"


class WorkerError(CityError):
    """The process of a task ended before the task did."""


@dataclass(frozen=True)
class Limits:
    """What a task may take."""

    seconds: float = 0.0  #: wall time (s); 0 for no limit
    memory: int = 0  #: memory of a worker process (bytes); 0 for no limit


def trace_file(task: Task) -> Path:
    """File that is there while a task runs in a worker."""
    # Of a bucket, on this machine alone: a driver elsewhere counts how many workers died of a task.
    return local_folder(task.store.path.parent) / TASKS / f"{task.stage}.{task.name}.txt"


def run_guarded(function: Function, task: Task, seconds: float) -> Outcome:
    """Run a task so that a crash leaves a traceback, and end the process at the time limit.

    Notes
    -----
    The fault handler's watchdog is no Python thread: it acts even while the task holds the interpreter. There is
    one for the process, so workers of several threads have no time limit.
    """
    if resident_memory() > TRIM_AT:
        trim_memory()
    path = trace_file(task)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except OSError as error:
        words = f"{path}: cannot be written ({error.strerror}); free space or choose another folder"
        return Failure(OutputError(words))
    with _watched(path, file, seconds):
        return run_task(function, task)


@contextmanager
def _watched(path: Path, file: TextIO, seconds: float) -> Iterator[None]:
    with file:
        faulthandler.enable(file)
        if seconds:
            faulthandler.dump_traceback_later(seconds, exit=True, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            faulthandler.disable()
    with suppress(OSError):  # a disk that refuses says so where results are written
        path.unlink()


def describe_death(task: Task, limits: Limits) -> Failure | None:
    """Find out from its file how a task ended whose process died; None if it had not begun.

    The file goes.
    """
    path = trace_file(task)
    try:
        trace = path.read_text(errors="replace").strip()
    except FileNotFoundError:
        return None
    with suppress(OSError):
        path.unlink()
    if trace.startswith(TIMEOUT):
        words = (
            f"not done after {limits.seconds:g} s, the limit of a task; raise --time-limit, or make tiles smaller"
        )
        return Failure(WorkerError(words), trace, "time")
    if trace:
        words = f"the worker process died of it: {trace.splitlines()[0]}; a fault of citystitch or a library"
        return Failure(WorkerError(words), trace, "crash")
    words = f"the worker process died with this item on it, killed or for want of memory; {ADVICE}"
    return Failure(WorkerError(words), "", "killed")


def describe_memory(failure: Failure, limits: Limits) -> Failure:
    """Put the limit and the way out into the error of a task that was refused memory."""
    bound = f"the limit of a worker, {limits.memory / 2**30:.2f} GiB" if limits.memory else "what the machine has"
    return Failure(
        WorkerError(f"needs more memory than {bound} ({failure.error}); {ADVICE}"), failure.trace, "memory"
    )


def limit_memory(memory: int) -> None:
    """Let this process have so much memory (bytes): beyond it, what asks for more gets a MemoryError.

    Notes
    -----
    Linux counts writable private memory, touched or not; what is mapped so far and not touched comes on top.
    """
    status = Path("/proc/self/status")
    if not status.is_file():
        return
    text = status.read_text()
    mapped, resident = (int(text.split(f"{key}:")[1].split()[0]) * 1024 for key in ("VmData", "VmRSS"))
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    bound = memory + max(mapped - resident, 0)
    resource.setrlimit(resource.RLIMIT_DATA, (bound if hard == resource.RLIM_INFINITY else min(bound, hard), hard))


def resident_memory() -> int:
    """Memory that this process holds now (bytes); 0 where the system does not tell."""
    with suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def trim_memory() -> None:
    """Give freed memory back to the system, between what is in use too; nothing happens but with GNU's C library.

    Notes
    -----
    A worker keeps what it freed (`tiler.executors.dask_settings`), and small things that live on keep all that
    lies below. To give it back takes time, and so does getting it anew: for workers that hold much.
    """
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def machine_memory() -> int:
    """Memory of this machine, or of the container it is (bytes): what Dask finds, whose import takes 0.2 s."""
    found = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), resource.getrlimit(resource.RLIMIT_RSS)[1]]
    for path in CONTAINER_MEMORY:
        with suppress(OSError, ValueError):  # not there, or "max"
            found.append(int(Path(path).read_text()))
    return min(memory for memory in found if memory > 0)


def share_memory(workers: int) -> int:
    """Share of the machine's memory for each of so many workers (bytes)."""
    return int(MEMORY_SHARE * machine_memory() / max(workers, 1))


def limit_workers(config: Config) -> Limits:
    """What a task may take in a worker of this machine; where no number of workers is given, there is one."""
    return Limits(config.time_limit, int(config.memory_limit * 2**30) or share_memory(config.workers))
