"""Imported by a process that workers are forked from: what all of them need, see `tiler.fork_server`.

The types and functions that numba knows of are among it: it looks them up at the first kernel, 0.15 s in each.
"""

import importlib

from tiler.fork_server import SHARED
from tiler.importing import uncollected
from tiler.kept_memory import look_seldom

with uncollected():
    for name in (*SHARED, "zarr"):
        importlib.import_module(name)
    from numba.core.registry import cpu_target

    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
look_seldom()
