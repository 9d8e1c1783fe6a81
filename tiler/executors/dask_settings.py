"""Settings of Dask for schedulers and workers, on this machine, in jobs, or in any cluster (`deploy/dask.yaml`).

Nothing is spilled and no worker pauses, as Dask holds no array here. Logs of transitions, of its load and of what
was submitted are kept short, and no samples of the call stack are taken (0.2 MB/s that stay for an hour). Memory
and load are looked at less often. All submitted tasks are sent to workers at once, which begin those of highest
priority first; idle workers steal within 0.1 s. Dask does not send the tasks of a dead worker again by itself:
`tiler.executors.dask_executor` tells by their trace files which of them had begun.
"""

import ctypes
import os
import sys
from collections.abc import Mapping
from multiprocessing import forkserver
from typing import Any

from tiler.engine.task_limits import KILL_AT

# Of worker processes, before Python starts. One thread each. malloc keeps what was freed for the next task (some
# 200 MB): Dask's own settings give it back at once, which costs a third of a run in page faults.
ENVIRONMENT: Mapping[str, int] = {
    "OMP_NUM_THREADS": 1,
    "MKL_NUM_THREADS": 1,
    "OPENBLAS_NUM_THREADS": 1,
    "RAYON_NUM_THREADS": 1,
    "MALLOC_ARENA_MAX": 1,
    "MALLOC_TRIM_THRESHOLD_": 2**28,
    "MALLOC_MMAP_THRESHOLD_": 2**25,
}
MALLOPT: Mapping[str, int] = {  # numbers of the same in glibc's malloc.h
    "MALLOC_TRIM_THRESHOLD_": -1,
    "MALLOC_MMAP_THRESHOLD_": -3,
    "MALLOC_ARENA_MAX": -8,
}
SCHEDULER: Mapping[str, Any] = {
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.worker-saturation": "inf",
    "distributed.scheduler.work-stealing-interval": "100ms",
    "distributed.diagnostics.computations.max-history": 1,
}
WORKER: Mapping[str, Any] = {
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "200ms",
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": KILL_AT,
}
BOTH: Mapping[str, Any] = {
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.system-monitor.log-length": 600,
    "distributed.admin.system-monitor.interval": "2s",
    "distributed.admin.tick.interval": "500ms",
}
GARBAGE = 10_000  # new objects after which Python looks for cycles, of which tasks leave next to none
METHOD = "forkserver" if sys.platform == "linux" else "spawn"
# A dead process shows by its closed connection, so a worker that is silent because its task holds the interpreter
# is not given up. The nanny of a dead one starts another: the cluster would give up one that is still starting
# 15 s after its predecessor died.
LOCAL: Mapping[str, Any] = {
    **SCHEDULER,
    **WORKER,
    **BOTH,
    "distributed.nanny.pre-spawn-environ": dict(ENVIRONMENT),
    "distributed.worker.multiprocessing-method": METHOD,
    "distributed.worker.daemon": False,
    "distributed.scheduler.worker-ttl": None,
    "distributed.deploy.lost-worker-timeout": "3650 days",
}
PRELOADED = ("distributed.nanny", "tiler.executors.local_cluster")
OF_RUN = "tiler.planning.own_stages"  # imports what tasks of a run need
# Of workers whose tasks take arrays of many sizes, each a few times: what is freed goes back at once.
FREED: Mapping[str, int] = {**ENVIRONMENT, "MALLOC_TRIM_THRESHOLD_": 2**24, "MALLOC_MMAP_THRESHOLD_": 2**19}


def as_variables(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Name settings as Dask reads them from the environment.

    Examples
    --------
    >>> as_variables({"distributed.worker.memory.monitor-interval": "200ms"})
    {'DASK_DISTRIBUTED__WORKER__MEMORY__MONITOR_INTERVAL': '200ms'}
    """
    return {"DASK_" + name.upper().replace(".", "__").replace("-", "_"): value for name, value in settings.items()}


def keep_memory(environment: Mapping[str, int] = ENVIRONMENT) -> None:
    """Apply the settings of malloc to this process, which runs tasks itself; with glibc alone."""
    choose = getattr(ctypes.CDLL(None), "mallopt", None)
    if choose is not None:
        for name, number in MALLOPT.items():
            choose(number, environment[name])


def start_fork_server(module: str = OF_RUN) -> None:
    """Start Python's fork server in the background: it imports `PRELOADED` and a module once for all workers.

    A second call does nothing. `ENVIRONMENT` is set in this process, as Dask's nanny does it too.
    """
    if METHOD == "forkserver":
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, str(value))
        forkserver.set_forkserver_preload([*PRELOADED, module])
        forkserver.ensure_running()
