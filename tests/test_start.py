"""What a run brings in before its first task: nothing that it does not need, and without a search for garbage."""

import gc
import subprocess
import sys

from distributed.system import memory_limit

from tiler.importing import uncollected
from tiler.limits import machine_memory

UNNEEDED = ("dask", "distributed", "meshio", "pyamg", "scipy.fft", "scipy.io", "scipy.ndimage")


def test_a_run_in_one_process_imports_what_it_needs_alone() -> None:
    code = (
        "import sys, tiler.run, tiler.terminal; from tiler.limits import machine_memory; machine_memory(); "
        f"print(*(name for name in {UNNEEDED} if name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


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
