"""A function of each of many items, on threads of this process, with results in the order of the items.

For work that lets other threads go on meanwhile: kernels, numpy, packing and files. Results may be arrays.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from pipeline.data.errors import ConfigError

Item = TypeVar("Item")
Result = TypeVar("Result")


def check_workers(workers: int) -> None:
    """Raise ConfigError if there cannot be so many workers."""
    if workers < 0:
        raise ConfigError(f"--workers {workers}: expected 0, for this process, or more")


def map_threads(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Generator[Result]:
    """Call a function with each item and give the results in order.

    Parameters
    ----------
    function : callable
        What it raises is raised here.
    items : iterable
        At most two a thread are under way, or wait to be taken.
    threads : int
        With less than 2 it is called in this one.

    Examples
    --------
    >>> list(map_threads(abs, [-3, 1, -2], 2))
    [3, 1, 2]
    """
    if threads < 2:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(threads)
    try:
        yield from take_in_order(lambda item: pool.submit(function, item), items, 2 * threads - 1)
    finally:
        pool.shutdown(cancel_futures=True)


def take_in_order(submit: Callable[[Item], Any], items: Iterable[Item], ahead: int) -> Generator[Any]:
    """Submit items, and give the results of what `submit` returns in order, at most so many items ahead."""
    waiting: deque[Any] = deque()
    for item in items:
        waiting.append(submit(item))
        if len(waiting) > ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
