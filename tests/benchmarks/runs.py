"""Runs of the program, as all benchmarks make them: fresh processes on some cores."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

COMMAND = [sys.executable, "-m", "tiler.cli"]


def citystitch(*arguments: str, cores: int = 2) -> None:
    """Run a command on some cores, without further threads of the numerical libraries; modules compiled once."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    fixed = threads | {"PYTHONDONTWRITEBYTECODE": ""}
    pin: Callable[[], None] | None = None
    if hasattr(os, "sched_setaffinity"):
        chosen = sorted(os.sched_getaffinity(0))[:cores]
        pin = lambda: os.sched_setaffinity(0, chosen)  # noqa: E731
    subprocess.run(
        [*COMMAND, *arguments], check=True, env=os.environ | fixed, preexec_fn=pin, stdout=subprocess.DEVNULL
    )


def record_of(city: Path, out: Path, *options: str, cores: int = 2, command: str = "run") -> dict[str, Any]:
    """Mesh the city into an empty folder and return what run.json says."""
    footprints = ("--footprints", str(city / "footprints.shp"))
    shutil.rmtree(out, ignore_errors=True)
    citystitch(command, str(city / "tiles"), *footprints, "--out", str(out), *options, cores=cores)
    record: dict[str, Any] = json.loads((out / "run.json").read_text())
    return record
