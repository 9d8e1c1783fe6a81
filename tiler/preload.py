"""Imported by the process that workers are forked from: what all of them need, see `tiler.fork_server`."""

import importlib

from tiler.importing import uncollected
from tiler.kept_memory import look_seldom

MODULES = ("distributed.nanny", "tiler.cli", "tiler.run", "zarr")

with uncollected():
    for name in MODULES:
        importlib.import_module(name)
look_seldom()
