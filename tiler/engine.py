"""The engine: tiles to processes and their records back. The one place that knows Dask."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Job = TypeVar("Job")
Record = TypeVar("Record")


def run_jobs(function: Callable[[Job], Record], jobs: Iterable[Job], *, workers: int) -> Iterator[Record]:
    """Apply a function to every job, in this process or in worker processes.

    Parameters
    ----------
    function : callable
        Top-level function; it returns a small record, arrays go to the store.
    jobs : iterable
        Its arguments, picklable.
    workers : int
        Number of worker processes of one thread each; 0 for none.

    Yields
    ------
    Record
        Results in the order of the jobs.
    """
    if workers == 0:
        yield from map(function, jobs)
        return
    from dask import config
    from distributed import Client, LocalCluster

    # The dashboard is off; a page of the run's own takes its place later.
    with (
        config.set({"distributed.worker.daemon": False}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            silence_logs="ERROR",
        ) as cluster,
        Client(cluster) as client,
    ):
        futures = [client.submit(function, job, pure=False) for job in jobs]
        for future in futures:
            yield future.result()
