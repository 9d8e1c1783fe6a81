"""What a process does before its first task: it imports without a search for garbage."""

import gc

from tiler.importing import uncollected


def test_what_is_imported_without_collector_is_left_alone_afterwards() -> None:
    gc.unfreeze()
    try:
        with uncollected():
            assert not gc.isenabled()
        assert gc.isenabled()
        assert gc.get_freeze_count() > 50_000
    finally:
        gc.unfreeze()
