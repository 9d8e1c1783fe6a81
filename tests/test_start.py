"""What a run brings in before its first task: nothing that it does not need, and without a search for garbage."""

import gc
import subprocess
import sys

from distributed.system import memory_limit

from tiler.importing import uncollected
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
    assert find_imported(("distributed", "zarr"), ("tiler.preload",)) == ["distributed", "zarr"]


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
