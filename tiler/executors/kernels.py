"""Kernels are compiled by runs of a built-in block of houses, once for a machine and a version of the code.

numba compiles a kernel at its first call and keeps it on disk. Left to that, each worker of a first run compiles
nearly all of its kernels for itself: 100 s of processor time.
"""

import hashlib
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding

from pipeline.columns import growth
from tiler.engine.keys import code_versions

BLOCK = Path(__file__).parents[1] / "demo_block"
TILES = ("--mesh-size", "7", "--tile-size", "100")  # the block is four tiles, with seams
# Options that have kernels of their own; a run needs those of its mesher, or of planes where its roofs are sloped.
WAYS: dict[str, tuple[str, ...]] = {
    "adaptive": (),
    "planes": ("--roofs", "planes"),
    "layered": ("--mesher", "layered"),
    "other": ("--simplify", "paper", "--ground-filter", "--first-layer", "1", "--pad", "100", "--report"),
}
UNCACHED = "compiled kernels are not kept: set NUMBA_CACHE_DIR to a folder that can be written"


def prepare(way: str, workers: int, say: Callable[[str], None]) -> None:
    """Compile what a run with workers needs, in a process of its own, unless that was done on this machine.

    Parameters
    ----------
    way : str
        Which kernels the run needs: one of `WAYS`.
    workers : int
        Workers of the run; with none, kernels are compiled as they are called.
    say : callable
        Called with a sentence before kernels are compiled, where that fails, and where they cannot be kept.
    """
    if not numba.config.DISABLE_JIT and cache_folder() is None:
        say(UNCACHED)
    elif workers and not are_compiled([way]):
        say("compiling kernels for this machine, once")
        if error := compile_kernels(way):
            say(f"kernels are compiled as they are called: {error}")


def are_compiled(ways: Iterable[str] = WAYS) -> bool:
    """Return whether `compile_kernels` has done its work with these versions for such a processor."""
    folder = cache_folder()
    stamped = folder is not None and all(_stamp(folder, way).exists() for way in ways)
    return stamped or bool(numba.config.DISABLE_JIT)


def compile_kernels(way: str) -> str:
    """Compile the kernels of a way by a run of the block in a process of its own; gives what failed, or ``""``."""
    inputs = [str(BLOCK / "cloud.laz"), "--footprints", str(BLOCK / "footprints.geojson"), *TILES]
    with tempfile.TemporaryDirectory(prefix="citystitch-") as out:
        options = ["--workers", "0", "--quiet", "--no-dashboard", "--out", f"{out}/run", *WAYS[way]]
        command = [sys.executable, "-m", "tiler.cli", "run", *inputs, *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return f"exit code {done.returncode}: {' '.join(done.stderr.split())}"
    folder = cache_folder()
    if folder is None:
        return UNCACHED
    with suppress(OSError):  # compiled kernels are looked for again the next time
        _stamp(folder, way).touch()
    return ""


def compile_all() -> list[str]:
    """Compile the kernels of all ways, after the first one two at a time; gives what failed."""
    first, *others = WAYS
    with ThreadPoolExecutor(2) as pool:  # each waits for a process
        failed = [compile_kernels(first), *pool.map(compile_kernels, others)]
    return [error for error in failed if error]


def cache_folder() -> Path | None:
    """Folder in which numba keeps the kernels of the first package; None where it may write none."""
    kernel: Any = growth.count_steps
    stats = getattr(kernel, "stats", None)
    return None if stats is None or stats.cache_path is None else Path(stats.cache_path)


def _stamp(folder: Path, way: str) -> Path:
    """Empty file that is there once a way is compiled by these versions for this kind of processor."""
    processor = numba.config.CPU_NAME or binding.get_host_cpu_name()
    state = repr((way, platform.python_version(), code_versions(), processor))
    return folder / f"citystitch-{hashlib.blake2b(state.encode(), digest_size=8).hexdigest()}"
