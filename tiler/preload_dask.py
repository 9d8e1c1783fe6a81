"""Imported by the process that Dask's workers are forked from: what they need besides `tiler.preload`."""

import importlib

from tiler.importing import uncollected

with uncollected():
    for name in ("distributed.nanny", "tiler.preload", "tiler.scheduler.executor", "tiler.worker_setup"):
        importlib.import_module(name)
