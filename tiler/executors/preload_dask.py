"""Imported by the process that Dask's workers are forked from: what they need besides `preload`."""

import importlib

from tiler.executors.importing import uncollected

with uncollected():
    for name in (
        "distributed.nanny",
        "tiler.executors.preload",
        "tiler.scheduler.executor",
        "tiler.executors.worker_setup",
    ):
        importlib.import_module(name)
