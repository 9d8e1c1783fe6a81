"""The process that the workers of this machine are forked from: it imports once what all of them need.

Started before the driver's own imports, it is ready when the workers are. Where the system cannot fork well (all
but Linux), workers start from nothing instead, which takes them some seconds.
"""

import multiprocessing
import os
import sys
from collections.abc import Mapping
from multiprocessing import forkserver

# One thread a worker. Dask's own settings of malloc give memory back at once, and it costs a third of a run's
# time to get it again page by page; with these a worker keeps some 200 MB that it does not use, and gives them
# back before a task where it holds much (`tiler.limits`).
ENVIRONMENT: Mapping[str, int] = {
    "OMP_NUM_THREADS": 1,
    "MKL_NUM_THREADS": 1,
    "OPENBLAS_NUM_THREADS": 1,
    "MALLOC_ARENA_MAX": 1,
    "MALLOC_TRIM_THRESHOLD_": 2**28,
    "MALLOC_MMAP_THRESHOLD_": 2**25,
}
PRELOAD, PRELOAD_DASK = "tiler.preload", "tiler.preload_dask"
METHOD = "forkserver" if sys.platform == "linux" else "spawn"


def limit_threads() -> None:
    """Keep the libraries that this process imports from now on to one thread: for one that forks itself."""
    os.environ.update({name: str(value) for name, value in ENVIRONMENT.items() if name.endswith("_THREADS")})


def begin(*, dask: bool = False) -> None:
    """Start it in the background, unless it runs; a second call does nothing.

    Parameters
    ----------
    dask : bool
        Whether the workers are Dask's.
    """
    if METHOD != "forkserver":
        return
    multiprocessing.set_forkserver_preload([PRELOAD_DASK if dask else PRELOAD])
    earlier = {name: os.environ.get(name) for name in ENVIRONMENT}
    os.environ.update({name: str(value) for name, value in ENVIRONMENT.items()})
    try:
        forkserver.ensure_running()
    finally:
        for name, value in earlier.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
