"""A function of each of many items, on workers of this machine, with results in the order of the items."""

from collections.abc import Callable, Generator, Iterable, Mapping
from typing import TypeVar

from tiler.engine.task_limits import Limits, share_memory
from tiler.executors.dask_executor import ClusterError
from tiler.executors.dask_settings import ENVIRONMENT
from tiler.mesh_files.threads import take_in_order

AHEAD = 4  # items for each worker that are submitted before the first of them is taken

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int,
    *,
    malloc: Mapping[str, int] = ENVIRONMENT,
) -> Generator[Result]:
    """Call a function with each item and give small results in order.

    Parameters
    ----------
    function : callable
        Of a module, so that workers can import it. What it raises is raised here.
    items : iterable
        Small, too: arrays belong into files.
    workers : int
        Number of processes; with 0 it is called here, without Dask.
    malloc : mapping of str to int
        Settings of malloc in these, as `ENVIRONMENT` has them.

    Raises
    ------
    ClusterError
        If a worker process died.
    """
    if workers == 0:
        yield from map(function, items)
        return
    from distributed import KilledWorker

    from tiler.executors.local_cluster import open_cluster

    with open_cluster(workers, Limits(memory=share_memory(workers)), malloc=malloc) as (client, _):
        try:
            yield from take_in_order(
                lambda item: client.submit(function, item, pure=False), items, AHEAD * workers
            )
        except KilledWorker as error:
            raise ClusterError(f"a worker process died ({error.last_worker}); give fewer --workers") from error
