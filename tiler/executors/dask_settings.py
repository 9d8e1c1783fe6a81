"""What Dask's schedulers and workers are told, wherever they run: on this machine, in jobs, in anybody's cluster.

No array is in Dask's hands, so there is nothing to spill and nothing to pause for. Its logs of transitions, of
its own load and of what was submitted hold on to memory: they are kept short, and its samples of what a worker's
thread is at, 0.2 MB a second that stay for an hour, are not taken. It looks at itself and at its memory less often
than it would. All tasks in flight lie with the workers, each of which begins with those of the highest priority:
Dask would keep the many of one stage back, behind the few of all others. What waits for a worker that is at work
goes to one that is not within a tenth of a second, not within one.
"""

from collections.abc import Mapping
from typing import Any

from tiler.engine.task_limits import KILL_AT

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


def as_variables(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Name settings as Dask reads them from the environment.

    Examples
    --------
    >>> as_variables({"distributed.worker.memory.monitor-interval": "200ms"})
    {'DASK_DISTRIBUTED__WORKER__MEMORY__MONITOR_INTERVAL': '200ms'}
    """
    return {"DASK_" + name.upper().replace(".", "__").replace("-", "_"): value for name, value in settings.items()}
