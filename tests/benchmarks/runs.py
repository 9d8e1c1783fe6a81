"""Runs of the program, as all benchmarks make them: fresh processes on some cores."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

COMMAND = [sys.executable, "-m", "tiler.cli.main"]
PARTS_MISSING = 3  # exit code; of 50,000 houses on 6 km² two find no room


def citystitch(*arguments: str, cores: int = 2) -> None:
    """Run a command on some cores, without further threads of the numerical libraries; modules compiled once."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    fixed = threads | {"PYTHONDONTWRITEBYTECODE": ""}
    pin: Callable[[], None] | None = None
    if hasattr(os, "sched_setaffinity"):
        chosen = sorted(os.sched_getaffinity(0))[:cores]
        pin = lambda: os.sched_setaffinity(0, chosen)  # noqa: E731
    ended = subprocess.run(
        [*COMMAND, *arguments], check=False, env=os.environ | fixed, preexec_fn=pin, stdout=subprocess.DEVNULL
    )
    if ended.returncode not in (0, PARTS_MISSING):
        ended.check_returncode()


def set_aside(out: Path) -> None:
    """Make room for a run: empty the files of an earlier one, and move its folder beside it.

    They are not deleted: a file system without a journal looks past each file that was deleted in the last minutes
    for the place of a new one, and a run after thousands of them took a tenth longer. What was written before is
    on the disk on return.
    """
    if out.exists():
        home = out.parent / "emptied"
        home.mkdir(exist_ok=True)
        before = out.rename(tempfile.mkdtemp(dir=home))
        for path in before.rglob("*"):
            if path.is_file():
                os.truncate(path, 0)
    os.sync()


def record_of(city: Path, out: Path, *options: str, cores: int = 2, command: str = "run") -> dict[str, Any]:
    """Mesh the city into a new folder; what run.json says, and how long the command took (s)."""
    footprints = ("--footprints", str(city / "footprints.shp"))
    set_aside(out)
    start = time.perf_counter()
    citystitch(command, str(city / "tiles"), *footprints, "--out", str(out), *options, cores=cores)
    seconds = round(time.perf_counter() - start, 3)
    record: dict[str, Any] = json.loads((out / "run.json").read_text())
    return record | {"seconds_of_command": seconds}
