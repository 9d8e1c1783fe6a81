"""The process that the workers of this machine are forked from: it imports once what all of them need.

A command forks it from itself when it has imported what both need, and goes on while the rest is imported there;
from Python it is a program of its own, started before the driver's own imports. Where the system cannot fork well
(all but Linux), workers start from nothing instead, which takes them some seconds.
"""

import fcntl
import importlib
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from functools import partial
from multiprocessing import forkserver, resource_tracker, util
from pathlib import Path
from typing import Any

# One thread a worker. Dask's own settings of malloc give memory back at once, and it costs a third of a run's
# time to get it again page by page; with these a worker keeps some 200 MB that it does not use, and gives them
# back before a task where it holds much (`tiler.engine.task_limits`).
ENVIRONMENT: Mapping[str, int] = {
    "OMP_NUM_THREADS": 1,
    "MKL_NUM_THREADS": 1,
    "OPENBLAS_NUM_THREADS": 1,
    "MALLOC_ARENA_MAX": 1,
    "MALLOC_TRIM_THRESHOLD_": 2**28,
    "MALLOC_MMAP_THRESHOLD_": 2**25,
}
SHARED = (
    "tiler.cli.main",
    "tiler.executors.worker_processes",
    "tiler.workflow.own_stages",
)  # what a driver needs, too
PRELOAD, PRELOAD_DASK = "tiler.executors.preload", "tiler.executors.preload_dask"
METHOD = "forkserver" if sys.platform == "linux" else "spawn"
THREADS = Path("/proc/self/task")  # a folder for each thread of this process, also of those that are not Python's
FILES = Path("/proc/self/fd")


def limit_threads() -> None:
    """Keep the libraries that this process imports from now on to one thread: for one that is forked itself."""
    os.environ.update({name: str(value) for name, value in ENVIRONMENT.items() if name.endswith("_THREADS")})


def begin(*, dask: bool = False, forked: bool = False) -> None:
    """Start it in the background, unless it runs; a second call does nothing.

    Parameters
    ----------
    dask : bool
        Whether the workers are Dask's.
    forked : bool
        Import what it shares with a driver here, and fork it from this process if that has one thread.
    """
    if METHOD != "forkserver":
        return
    modules = [PRELOAD_DASK if dask else PRELOAD]
    multiprocessing.set_forkserver_preload(modules)
    resource_tracker.ensure_running()  # a program of its own, whatever the server is
    if forked:
        for name in SHARED:
            importlib.import_module(name)
    with _environment(), _forked(modules) if forked and has_one_thread() else nullcontext():
        forkserver.ensure_running()


def start(target: Callable[..., None], *given: Any) -> tuple[Any, Any]:
    """Start a process that is forked from it; signals are the affair of this one, with whom it ends at the latest.

    Parameters
    ----------
    target : callable
        Called there with the other end of the pipe, and with what is given.

    Returns
    -------
    process, pipe
        The process, and this end of a pipe to it.
    """
    begin()
    methods: Any = multiprocessing.get_context(METHOD)
    ours, theirs = methods.Pipe()
    with closing(theirs):
        process = methods.Process(target=_deaf, args=(target, theirs, *given), daemon=True)
        process.start()
    return process, ours


def _deaf(target: Callable[..., None], *given: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    target(*given)


def has_one_thread() -> bool:
    """Tell whether this process may be forked: what its other threads hold would be held for ever in a copy."""
    try:
        return len(os.listdir(THREADS)) == 1
    except OSError:
        return False


@contextmanager
def _environment() -> Iterator[None]:
    earlier = {name: os.environ.get(name) for name in ENVIRONMENT}
    os.environ.update({name: str(value) for name, value in ENVIRONMENT.items()})
    try:
        yield
    finally:
        for name, value in earlier.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _forked(modules: list[str]) -> Iterator[None]:
    """Let `multiprocessing` fork where it would start a program: it has no such choice of its own."""
    start, name = util.spawnv_passfds, "spawnv_passfds"
    setattr(util, name, partial(_fork, modules))
    try:
        yield
    finally:
        setattr(util, name, start)


def _fork(modules: list[str], path: str, words: Sequence[str], passed: Sequence[int]) -> int:
    """Do in a copy of this process what the program would that is called for; gives its number.

    It is given where it is asked for workers, and what ends with this process; from Python 3.14 on, a key too.
    """
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        _close_files(passed)
        asked, alive, *key = passed
        serve: Any = forkserver.main
        serve(asked, alive, modules, **dict(zip(("authkey_r",), key, strict=False)))
    except SystemExit:
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _close_files(passed: Collection[int]) -> None:
    """Close what a program would not be given: the other ends of pipes, by which it knows that a process ended."""
    for name in os.listdir(FILES):
        with suppress(OSError):  # the one that lists them
            if int(name) not in passed and fcntl.fcntl(int(name), fcntl.F_GETFD) & fcntl.FD_CLOEXEC:
                os.close(int(name))
