"""What a run brings in before its first task: nothing that it does not need, and without a search for garbage."""

import gc
import subprocess
import sys
from pathlib import Path

import pytest
from distributed.system import memory_limit
from numba.np import linalg

from tiler.engine.task_limits import machine_memory
from tiler.executors.importing import uncollected
from tiler.executors.kept_memory import GARBAGE
from tiler.executors.numba_registry import look_up
from tiler.interface.synth import write_city

DASK = ("dask", "distributed")
SCIPY = tuple(f"scipy.{part}" for part in ("fft", "io", "linalg", "ndimage", "sparse", "spatial", "special"))
UNNEEDED = ("meshio", "numpy.testing", "pyamg", "zarr", *SCIPY)


def find_imported(names: tuple[str, ...], modules: tuple[str, ...]) -> list[str]:
    """Which of the names there are in a fresh process that has imported some modules, and looked at its memory."""
    code = (
        f"import sys, {', '.join(modules)}; from tiler.engine.task_limits import machine_memory; "
        "machine_memory(); "
        f"print(*(name for name in {names} if name in sys.modules))"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_a_run_imports_what_it_needs_alone() -> None:
    assert (
        find_imported(UNNEEDED, ("tiler.workflow.run", "tiler.monitoring.terminal", "tiler.executors.preload"))
        == []
    )


def test_what_only_sends_tasks_to_workers_does_not_wait_for_zarr() -> None:
    assert (
        find_imported(
            ("zarr",), ("tiler.monitoring.terminal", "tiler.workflow.run", "tiler.executors.worker_setup")
        )
        == []
    )


def test_workers_of_dask_are_born_with_dask_alone() -> None:
    assert find_imported(("distributed", "zarr"), ("tiler.executors.preload",)) == []
    assert find_imported(("distributed", "zarr"), ("tiler.executors.preload_dask",)) == ["distributed"]


def test_what_all_tasks_need_has_all_that_numba_knows_with_blas() -> None:
    code = """
import sys, tiler.executors.preload
from numba.np import arraymath, linalg
from numba.core.registry import cpu_target
before = len(sys.modules)
cpu_target.target_context.refresh()
print(len(sys.modules) - before, arraymath._HAVE_BLAS, linalg.ensure_blas.__name__)
"""
    assert tell_in_fresh_process(code) == "0 True ensure_blas"


def test_a_numba_that_looks_for_blas_otherwise_has_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    look_up()  # else numba's own modules would miss what is taken away
    monkeypatch.delattr(linalg, "ensure_blas")
    look_up()
    assert not hasattr(linalg, "ensure_blas")


def test_a_kernel_of_the_user_calls_blas_in_a_process_that_runs_tasks() -> None:
    code = """
import sys, tiler.executors.preload, numpy, numba
product = numba.njit(lambda a, b: numpy.dot(a, b))(numpy.eye(2), numpy.full((2, 2), 3.0))
print(product.sum(), "scipy.linalg" in sys.modules)
"""
    assert tell_in_fresh_process(code) == "12.0 True"


def test_the_tasks_of_a_run_import_nothing_more(tmp_path: Path) -> None:
    found = find_imported_by_a_run(tmp_path, (*DASK, *UNNEEDED), workers=0)
    assert found in ([], ["zarr"])  # which is imported where an array is large


def test_the_driver_of_workers_imports_no_numba(tmp_path: Path) -> None:
    assert find_imported_by_a_run(tmp_path, ("numba", *DASK, *UNNEEDED), workers=1) == []


def find_imported_by_a_run(tmp_path: Path, names: tuple[str, ...], workers: int) -> list[str]:
    """Which of the names the process of a command has imported when its run is done."""
    city = write_city(tmp_path / "city", size=300, buildings=15, density=1.0)
    words = ["run", *map(str, city.clouds), "--footprints", str(city.footprints), "--out", str(tmp_path / "out")]
    code = f"""
import sys
from tiler.cli.main import main
main({[*words, "--workers", str(workers), "--tile-size", "150", "--quiet"]})
print("imported:", *(name for name in {names} if name in sys.modules))
"""
    told = tell_in_fresh_process(code).splitlines()[-1]
    assert (tmp_path / "out" / "run.json").exists()
    return told.removeprefix("imported:").split()


def test_a_run_with_workers_imports_no_dask() -> None:
    assert (
        find_imported(DASK, ("tiler.workflow.run", "tiler.monitoring.terminal", "tiler.executors.preload")) == []
    )


def test_the_memory_of_this_machine_is_what_dask_finds() -> None:
    assert machine_memory() == memory_limit()


def test_what_is_imported_without_collector_is_left_alone_afterwards() -> None:
    gc.unfreeze()
    try:
        with uncollected():
            assert not gc.isenabled()
        assert gc.isenabled()
        assert gc.get_freeze_count() > 50_000
    finally:
        gc.unfreeze()


def tell_in_fresh_process(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_workers_and_a_run_in_one_process_look_for_garbage_seldom() -> None:
    assert tell_in_fresh_process("import gc, tiler.executors.preload; print(gc.get_threshold()[0])") == str(
        GARBAGE
    )
    nowhere = "main(['run', 'no/such.laz', '--workers', '0'])"
    told = f"import gc; from tiler.cli.main import main; {nowhere}; print(gc.get_threshold()[0])"
    assert tell_in_fresh_process(told) == str(GARBAGE)


@pytest.mark.skipif(sys.platform != "linux", reason="GNU's C library alone can be told")
def test_a_run_in_one_process_keeps_the_memory_that_it_freed() -> None:
    code = """
import resource
from tiler.cli.main import main
main(["run", "no/such.laz", "--workers", "0"])
def take(): return [bytearray(30_000_000) for _ in range(4)]
take()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5): take()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    pages_of_one = 30_000_000 // 4096
    assert int(tell_in_fresh_process(code)) < pages_of_one
