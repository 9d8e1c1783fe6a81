"""What a run imports before its first task: nothing that it does not need."""

import subprocess
import sys
from pathlib import Path

import pytest
from distributed.system import memory_limit

from tiler.engine.task_limits import machine_memory
from tiler.executors.dask_settings import GARBAGE
from tiler.interface.synth import write_city

DASK = ("dask", "distributed")
SCIPY = tuple(f"scipy.{part}" for part in ("fft", "io", "linalg", "ndimage", "sparse", "spatial", "special"))
UNNEEDED = ("meshio", "numpy.testing", "pyamg", "zarr", *SCIPY)
BY_NUMBA = {"numpy.testing", "scipy.linalg"}  # imported at the first kernel, as numba asks scipy for BLAS
RUN = ("tiler.workflow.run", "tiler.monitoring.terminal", "tiler.planning.own_stages")


def find_imported(names: tuple[str, ...], modules: tuple[str, ...]) -> list[str]:
    """Which of the names there are in a fresh process that has imported some modules, and looked at its memory."""
    code = (
        f"import sys, {', '.join(modules)}; from tiler.engine.task_limits import machine_memory; "
        "machine_memory(); "
        f"print(*(name for name in {names} if name in sys.modules))"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_a_run_imports_what_it_needs_alone() -> None:
    assert find_imported((*DASK, *UNNEEDED), RUN) == []


def test_the_tasks_of_a_run_import_nothing_more(tmp_path: Path) -> None:
    assert set(find_imported_by_a_run(tmp_path, (*DASK, *UNNEEDED), workers=0)) <= {
        *BY_NUMBA,
        "scipy.sparse",
        "zarr",
    }
    assert find_imported_by_a_run(tmp_path, DASK, workers=2) == [], "nothing is to do: no worker is started"


@pytest.mark.parametrize("module", ["tiler.cli.main", "tiler.monitoring.status", "tiler.store.run_folder"])
def test_help_and_status_import_no_numba(module: str) -> None:
    assert find_imported(("numba",), (module,)) == []


def find_imported_by_a_run(tmp_path: Path, names: tuple[str, ...], workers: int) -> list[str]:
    """Which of the names the process of a command has imported when its run is done."""
    folder = tmp_path / "city"
    if not folder.exists():
        write_city(folder, size=300, buildings=15, density=1.0)
    footprints = ("--footprints", str(folder / "footprints.gpkg"))
    words = ["run", str(folder / "tiles"), *footprints, "--out", str(tmp_path / "out")]
    code = f"""
import sys
from tiler.cli.main import main
main({[*words, "--workers", str(workers), "--tile-size", "150", "--quiet"]})
print("imported:", *(name for name in {names} if name in sys.modules))
"""
    told = run_in_fresh_process(code).splitlines()[-1]
    assert (tmp_path / "out" / "run.json").exists()
    return told.removeprefix("imported:").split()


def test_the_memory_of_this_machine_is_what_dask_finds() -> None:
    assert machine_memory() == memory_limit()


def run_in_fresh_process(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_a_serial_run_looks_for_garbage_seldom_and_keeps_freed_memory() -> None:
    code = """
import gc, resource
from tiler.cli.main import main
main(["run", "no/such.laz", "--workers", "0"])
faults = []
for _ in range(3):
    large = [bytearray(24 * 2**20) for _ in range(4)]
    del large
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(gc.get_threshold()[0], faults[2] - faults[1])
"""
    threshold, faults = map(int, run_in_fresh_process(code).split())
    assert threshold == GARBAGE
    assert faults < 1000, "of 24,576 pages"
