"""The engine: tiles to processes and their records back. The one place that knows Dask."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from pipeline.errors import CityError

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

    # Everything is bound to this machine, on free ports: two runs do not meet.
    with (
        config.set({"distributed.worker.daemon": False}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            silence_logs="ERROR",
        ) as cluster,
        Client(cluster) as client,
    ):
        futures = [client.submit(_attempt, function, job, pure=False) for job in jobs]
        for future in futures:
            result, error = future.result()
            if error is not None:
                raise error
            yield result


def _attempt(function: Callable[[Job], Record], job: Job) -> tuple[Record | None, CityError | None]:
    """Give an error that data caused back as a value: Dask would print where in the code it arose."""
    try:
        return function(job), None
    except CityError as error:
        return None, error
