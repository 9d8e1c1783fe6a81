"""Memory of a process that runs tasks: it keeps what it freed for the next task, and looks for garbage seldom.

Python's own bounds are for small scripts: 700 new objects are reason to look, and all that there is was looked
through some twenty times in a run. Tasks leave next to no cycles: what they free goes without a look.
"""

import ctypes
import gc

from tiler.executors.fork_server import ENVIRONMENT

GARBAGE = 10_000  # new objects after which cycles are looked for
# Numbers of GNU's mallopt for what workers are given in their environment.
_SETTINGS = ((-1, "MALLOC_TRIM_THRESHOLD_"), (-3, "MALLOC_MMAP_THRESHOLD_"), (-8, "MALLOC_ARENA_MAX"))


def look_seldom() -> None:
    """Let the collector of garbage look after `GARBAGE` new objects, ten times that, and a hundred times."""
    gc.set_threshold(GARBAGE, 10, 10)


def keep_memory() -> None:
    """Keep what is freed in this process, as workers do; nothing happens but with GNU's C library.

    Notes
    -----
    Else every large array is given back at once, and the next one is got page by page: a twentieth of the time of
    steps 1 and 2. It cannot be undone: for processes that are a run's own.
    """
    choose = getattr(ctypes.CDLL(None), "mallopt", None)
    if choose is not None:
        for number, name in _SETTINGS:
            choose(number, ENVIRONMENT[name])
