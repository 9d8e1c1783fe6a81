"""A city of many tiles that costs little: coarse cells, few points, few houses; and its runs as processes."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from tests.runs.test_run import hashes
from tiler.config.config import Config, make_config
from tiler.executors.dask_settings import METHOD
from tiler.interface.synth import write_city
from tiler.planning.own_stages import list_stages
from tiler.workflow.run import run

ROOT = Path(__file__).resolve().parents[2]
TILE = 280.0  # m
VALUES = {"tile_size": TILE, "mesh_size": 20.0, "dtm_spacing": 4.0, "domain_height": 60.0}


@dataclass(frozen=True)
class SparseCity:
    """A synthetic city as files, its finished run, and what that has."""

    #: the files, and the reference: a run in one process
    folder: Path
    out: Path
    record: dict[str, Any]  #: its record
    hashes: dict[str, str]  #: hash of each of its files

    def config(self, out: Path, **others: Any) -> Config:
        """Parameters of a run."""
        return make_config(inputs(self.folder) | VALUES | {"out": str(out)} | others)

    def command(self, out: Path, *others: str) -> list[str]:
        """Command of a run."""
        given = inputs(self.folder)
        words = [
            sys.executable,
            "-m",
            "tiler.cli.main",
            "run",
            *given["pointcloud"],
            "--footprints",
            given["footprints"],
        ]
        for name, value in VALUES.items():
            words += [f"--{name.replace('_', '-')}", f"{value:g}"]
        return [*words, "--out", str(out), *others]

    def stages(self) -> dict[str, int]:
        """Number of results of each stage, in the order in which they run."""
        found = count_results(self.out)
        names = [stage.name for stage in list_stages(self.config(self.out))]
        return {name: found[name] for name in [*names, *sorted(found.keys() - set(names))] if name in found}


def inputs(folder: Path) -> dict[str, Any]:
    """Parameters that name the files of a city."""
    return {"pointcloud": [str(folder / "tiles")], "footprints": str(folder / "footprints.gpkg")}


def make_city(folder: Path, n: int, *, buildings: int) -> SparseCity:
    """Write a city of n x n tiles and run it in this process."""
    write_city(folder / "city", size=n * TILE, buildings=buildings, density=0.06, relief=5, seed=3)
    out = folder / "reference"
    record = run(make_config(inputs(folder / "city") | VALUES | {"out": str(out)}))
    assert record["counts"]["tiles"] == n * n
    assert record["exit_code"] == 0
    return SparseCity(folder / "city", out, record, hashes(out))


def count_results(out: Path) -> dict[str, int]:
    """Count the committed results of each stage in the folder of a run, at work or not."""
    store, counts = out / "store.zarr", dict[str, int]()
    if not store.is_dir():
        return counts
    for stage in sorted(os.listdir(store)):
        try:
            counts[stage] = sum(not name.startswith(".") for name in os.listdir(store / stage))
        except (FileNotFoundError, NotADirectoryError):
            continue
    return counts


def front(expected: dict[str, int], counts: dict[str, int]) -> str:
    """Name the last stage that has begun and is not done, else the next one; ``"end"`` if all are done."""
    left = [stage for stage, n in expected.items() if counts.get(stage, 0) < n]
    begun = [stage for stage in left if counts.get(stage, 0)]
    return begun[-1] if begun else left[0] if left else "end"


def start(command: Sequence[str], log: Path) -> "subprocess.Popen[bytes]":
    """Start a process group whose words go to a file, as Python writes to files where nothing else is asked."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": ""}
    with log.open("wb") as words:
        return subprocess.Popen(
            command, stdout=words, stderr=subprocess.STDOUT, start_new_session=True, env=environment, cwd=ROOT
        )


def wait_until_gone(processes: Sequence[psutil.Process], seconds: float) -> list[psutil.Process]:
    """Wait for the end of processes; gives those that live on."""
    living: list[psutil.Process] = psutil.wait_procs(processes, timeout=seconds)[1]
    return living


def children(process: "subprocess.Popen[bytes]") -> list[psutil.Process]:
    """List all processes below one."""
    try:
        found: list[psutil.Process] = psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []
    return found


def workers(process: "subprocess.Popen[bytes]") -> list[psutil.Process]:
    """List the worker processes of a run that lives: those below the process that is there to fork them."""
    found = []
    for child in children(process):
        with suppress(psutil.NoSuchProcess):
            if child.ppid() != process.pid or METHOD != "forkserver":
                found.append(child)
    return sorted(found, key=lambda child: child.pid)


def wait_for_results(
    process: "subprocess.Popen[bytes]", out: Path, n: int, seconds: float = 300.0
) -> dict[str, int]:
    """Wait until a run has so many results, or has ended; gives the number of each stage."""
    end = time.monotonic() + seconds
    while True:
        counts = count_results(out)
        if sum(counts.values()) >= n or process.poll() is not None:
            return counts
        assert time.monotonic() < end, f"only {sum(counts.values())} of {n} results after {seconds:g} s"
        time.sleep(0.01)
