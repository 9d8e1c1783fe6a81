"""Imported by a process that workers are forked from: what all of them need, see `tiler.fork_server`."""

import importlib

from tiler.fork_server import SHARED
from tiler.importing import uncollected
from tiler.kept_memory import look_seldom
from tiler.numba_registry import look_up

with uncollected():
    for name in SHARED:
        importlib.import_module(name)
    look_up()
look_seldom()
