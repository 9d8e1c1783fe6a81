"""Imported by a process that workers are forked from: what all of them need, see `tiler.executors.fork_server`."""

import importlib

from tiler.executors.fork_server import SHARED
from tiler.executors.importing import uncollected
from tiler.executors.kept_memory import look_seldom

with uncollected():
    for name in SHARED:
        importlib.import_module(name)
look_seldom()
