"""Ctrl-C: once lets running tasks end, twice ends at once."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

WORDS = "stopping when what runs is done; once more ends at once"


@contextmanager
def stops(stop: Callable[[], None], say: Callable[[str], None]) -> Iterator[None]:
    """Ask for a stop at the first SIGINT or SIGTERM, and raise KeyboardInterrupt at the second.

    Parameters
    ----------
    stop : callable
        Asks for the stop; called from the signal's handler.
    say : callable
        Called with a sentence that the user should read.

    Notes
    -----
    Python lets only the main thread handle signals; in another one nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        stop()
        say(WORDS)

    earlier = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)
