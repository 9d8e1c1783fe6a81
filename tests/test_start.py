"""What a run brings in before its first task: nothing that it does not need, and without a search for garbage."""

import gc
import subprocess
import sys

import pytest
from distributed.system import memory_limit

from tiler.importing import uncollected
from tiler.kept_memory import GARBAGE
from tiler.limits import machine_memory

DRIVER = ("tiler.terminal", "tiler.run", "tiler.worker_setup")
UNNEEDED = ("dask", "distributed", "meshio", "pyamg", "scipy.fft", "scipy.io", "scipy.ndimage")


def find_imported(names: tuple[str, ...], modules: tuple[str, ...]) -> list[str]:
    """Which of the names there are in a fresh process that has imported some modules, and looked at its memory."""
    code = (
        f"import sys, {', '.join(modules)}; from tiler.limits import machine_memory; machine_memory(); "
        f"print(*(name for name in {names} if name in sys.modules))"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_a_run_in_one_process_imports_what_it_needs_alone() -> None:
    assert find_imported(UNNEEDED, ("tiler.run", "tiler.terminal")) == []


def test_what_only_sends_tasks_to_workers_does_not_wait_for_zarr() -> None:
    assert find_imported(("zarr",), DRIVER) == []


def test_workers_are_born_with_what_tasks_import_as_they_run() -> None:
    assert find_imported(("distributed", "zarr"), ("tiler.preload",)) == ["zarr"]
    assert find_imported(("distributed", "zarr"), ("tiler.preload_dask",)) == ["distributed", "zarr"]


def test_a_run_with_workers_imports_no_dask() -> None:
    assert find_imported(("dask", "distributed"), ("tiler.run", "tiler.terminal", "tiler.preload")) == []


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
    assert tell_in_fresh_process("import gc, tiler.preload; print(gc.get_threshold()[0])") == str(GARBAGE)
    nowhere = "main(['run', 'no/such.laz', '--workers', '0'])"
    told = f"import gc; from tiler.cli import main; {nowhere}; print(gc.get_threshold()[0])"
    assert tell_in_fresh_process(told) == str(GARBAGE)


@pytest.mark.skipif(sys.platform != "linux", reason="GNU's C library alone can be told")
def test_a_run_in_one_process_keeps_the_memory_that_it_freed() -> None:
    code = """
import resource
from tiler.cli import main
main(["run", "no/such.laz", "--workers", "0"])
def take(): return [bytearray(30_000_000) for _ in range(4)]
take()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5): take()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    pages_of_one = 30_000_000 // 4096
    assert int(tell_in_fresh_process(code)) < pages_of_one
