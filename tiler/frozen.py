"""Imported after all others: modules stay, so the collector of garbage need not look through them again.

It takes 50 ms each time, and in a forked process it makes a copy of every page that it looks at.
"""

import gc

gc.collect()
gc.freeze()
