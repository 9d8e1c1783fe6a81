"""What each worker process of this machine does before its first task."""

import signal
import threading
from typing import Any

from distributed import WorkerPlugin

from tiler.engine.task_limits import limit_memory


class WorkerSetup(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Sets up a worker process, also one that takes the place of a dead one.

    Parameters
    ----------
    memory : int
        Memory that the process may take (bytes); 0 for no limit.
    """

    name = "citystitch"

    def __init__(self, memory: int) -> None:
        self._memory = memory

    def setup(self, worker: Any) -> None:
        """Leave Ctrl-C to the driver, which lets running tasks end; refuse memory beyond the limit."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        if self._memory:
            limit_memory(self._memory)
