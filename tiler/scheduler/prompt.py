"""A scheduler in this process that tells its workers at once, for runs whose tasks wait for one another."""

from typing import Any

from distributed import SchedulerPlugin


class Prompt(SchedulerPlugin):  # type: ignore[misc]  # distributed has no types
    """Sends what workers are told as it comes, also to those that come later.

    Dask lets 5 ms pass between two messages to a worker, so that more go together. What goes together here is in
    batches already (`tiler.scheduler.executor.Dask`), and a task that another waits for would wait that long.
    """

    name = "citystitch-prompt"

    def __init__(self, scheduler: Any) -> None:
        scheduler.add_plugin(self)
        for to_worker in list(scheduler.stream_comms.values()):
            to_worker.interval = 0.0

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Take the pause from what a worker is sent by."""
        scheduler.stream_comms[worker].interval = 0.0
