"""Kernels: compiled for this machine before they are needed, side by side, once.

numba compiles a kernel when it is first called, and keeps it on disk. Left to that, workers that begin together
compile the same ones, each for itself. Whether it was done is told without numba, which a driver does not need.
"""

import hashlib
import importlib
import json
import os
import platform
from collections import deque
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection, get_context
from pathlib import Path
from typing import Any

from llvmlite import binding

from tiler.engine.keys import version_of

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).parents[1] / "kernels.json"  # written by tests/record_kernels.py
RUN, OTHER = PARTS = ("run", "other")  # of the list: what runs need by default; what other ways and commands do
MOST = 8  # processes that compile side by side: each module is one process's affair, and some take much longer
WORDS = "compiling kernels for this machine, once"

Signatures = dict[str, list[str]]  # of kernels, as numba reads them
Kernels = dict[str, Signatures]  # of modules


def read_list() -> dict[str, Kernels]:
    """Read by part which kernels Python calls, and with what; modules that take longest come first."""
    parts: dict[str, Kernels] = json.loads(LIST.read_text())
    return parts


def count_cores() -> int:
    """Number of processes that may compile side by side: one for each core that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(cores or 1, MOST)


def prepare(processes: int, say: Callable[[str], None]) -> None:
    """Compile what a run needs by default, unless that was done on this machine with this code.

    Parameters
    ----------
    processes : int
        Number of processes.
    say : callable
        Called with a sentence where there is something to compile, and with what could not be.
    """
    if are_compiled((RUN,)):
        return
    say(f"{WORDS}, in {processes} processes" if processes > 1 else WORDS)
    for line in compile_kernels(processes, (RUN,)):
        say(f"not compiled beforehand: {line}")


def are_compiled(parts: Collection[str] = PARTS) -> bool:
    """Tell whether `compile_kernels` has done its work with this code, on a machine like this one."""
    if (os.environ.get("NUMBA_DISABLE_JIT") or "0") != "0":
        return True
    state = _state()
    with suppress(OSError):
        return all(_stamp(part).read_text() == state for part in parts)
    return False


def compile_kernels(processes: int, parts: Collection[str] = PARTS) -> list[str]:
    """Compile the kernels that Python calls, or find them compiled.

    Parameters
    ----------
    processes : int
        Number of processes; each takes one module after the other.
    parts : collection of str
        Parts of the list.

    Returns
    -------
    list of str
        What could not be compiled, and why. Where nothing failed, `are_compiled` says so from then on.
    """
    failed = []
    modules = [entry for part in parts for entry in read_list()[part].items()]
    with _processes(processes) as pipes:
        failed += _share_out(pipes, modules)
        if not failed and processes > 1:  # of what two have written at the same time, one may be lost
            failed += _share_out(pipes[:1], modules)
    if not failed:
        with suppress(OSError):  # they are looked at again the next time
            stamp_folder().mkdir(parents=True, exist_ok=True)
            for part in parts:
                _stamp(part).write_text(_state())
    return failed


def describe_kernels() -> str:
    """Say what there is to compile, for what, and where it is kept."""
    kernels = {(module, name) for part in read_list().values() for module, names in part.items() for name in names}
    machine, processor, _ = _target()
    module, names = next(iter(read_list()[RUN].items()))
    folder = Path(_kernel(module, next(iter(names))).dispatcher.stats.cache_path)
    told = os.environ.get("NUMBA_CACHE_DIR")  # where it cannot be written, numba keeps them elsewhere
    kept = told if told and folder.is_relative_to(told) else f"{folder} and the like"
    return f"{len(kernels)} kernels for {machine} {processor}, kept in {kept}"


def _share_out(pipes: list[Any], modules: list[tuple[str, Signatures]]) -> list[str]:
    """Give each process one module after the other; gives what they could not compile."""
    failed: list[str] = []
    idle, busy, waiting = list(pipes), dict[Any, str](), deque(modules)
    while busy or (waiting and idle):
        while waiting and idle:
            pipe, given = idle.pop(), waiting.popleft()
            busy[pipe] = given[0]
            with suppress(OSError):  # it has died: seen when it is asked
                pipe.send(given)
        ready: list[Any] = connection.wait(list(busy))
        for pipe in ready:
            module = busy.pop(pipe)
            try:
                failed += pipe.recv()
                idle.append(pipe)
            except (EOFError, OSError):
                failed.append(f"{module}: its process died")
    return failed + [f"{module}: no process is left" for module, _ in waiting]


@contextmanager
def _processes(number: int) -> Iterator[list[Any]]:
    """Give the pipes of as many processes that compile; they end with the context, at once."""
    started, pipes = [], []
    methods = get_context("spawn")
    try:
        for _ in range(number):
            pipe, other_end = methods.Pipe()
            process = methods.Process(target=_work, args=(other_end,), daemon=True)
            process.start()
            other_end.close()
            started.append(process)
            pipes.append(pipe)
        yield pipes
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.join()
        for pipe in pipes:
            pipe.close()


def _work(pipe: Any) -> None:
    """Compile modules until the other end is gone."""
    with suppress(EOFError, OSError):
        while True:
            pipe.send(_compile(*pipe.recv()))


def _compile(module: str, kernels: Signatures) -> list[str]:
    """Compile kernels of a module, or load them; gives what failed."""
    from numba.core.sigutils import normalize_signature

    failed = []
    for name, signatures in kernels.items():
        for signature in signatures:
            try:
                arguments, _ = normalize_signature(signature)  # it is found again by these, not by their words
                _kernel(module, name).dispatcher.compile(arguments)
            except Exception as error:
                reason = (str(error) or type(error).__name__).splitlines()[0]
                failed.append(f"{module}.{name}{signature}: {reason}")
    return failed


def _kernel(module: str, name: str) -> Any:
    return getattr(importlib.import_module(module), name)


def _stamp(part: str) -> Path:
    """File that says with what a part was compiled: one for each kind of processor, as they may share a folder."""
    digest = hashlib.blake2b(" ".join([*_target(), str(ROOT)]).encode(), digest_size=8).hexdigest()
    return stamp_folder() / f"citystitch-{digest}-{part}"


def stamp_folder() -> Path:
    """Folder that numba was told; where that cannot be written one beside the code, or else the user's."""
    if told := os.environ.get("NUMBA_CACHE_DIR"):
        with suppress(OSError):
            Path(told).mkdir(parents=True, exist_ok=True)
            if os.access(told, os.W_OK):
                return Path(told)
    beside = ROOT / "pipeline" / "__pycache__"
    if os.access(beside, os.W_OK):
        return beside
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "citystitch"


def _target() -> tuple[str, str, str]:
    """What is compiled for, by this machine or as numba was told: kind of machine, processor and its features."""
    features = os.environ.get("NUMBA_CPU_FEATURES")
    if features is None:
        features = binding.get_host_cpu_features().flatten()
    return platform.machine(), os.environ.get("NUMBA_CPU_NAME") or binding.get_host_cpu_name(), features


def _state() -> str:
    """Digest of what compiled kernels depend on: versions, the list, and the files of its modules."""
    lines = [platform.python_version(), version_of("numba"), version_of("llvmlite"), LIST.read_text()]
    for module in sorted({module for part in read_list().values() for module in part}):
        with suppress(OSError):  # compiling says so
            file = ROOT.joinpath(*module.split(".")).with_suffix(".py").stat()
            lines.append(f"{module} {file.st_mtime_ns} {file.st_size}")
    return hashlib.blake2b("\n".join(lines).encode(), digest_size=16).hexdigest()
