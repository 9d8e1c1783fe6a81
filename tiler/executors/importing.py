"""Imports without the collector of garbage: modules stay, so it need not look through them, then or later.

Its looks take a tenth of the time of all imports, and in a forked process it makes a copy of every page that it
looks at. The garbage that imports leave is kept too: a megabyte.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Collect no garbage meanwhile, and never look at what there is at the end: for the imports of a process."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
