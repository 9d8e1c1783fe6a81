"""Events as lines of a file: ``events.jsonl`` in the folder of a run, and `--log-json`."""

import json
import os
import threading
from collections import deque
from pathlib import Path

from pipeline.data.errors import OutputError
from tiler.monitoring.events import Event
from tiler.monitoring.run_state import RunState
from tiler.monitoring.watchers import EventWatcher

EVERY = 1.0  # s between two writes
_encode = json.JSONEncoder(separators=(",", ":"), default=str).encode


class EventLog(EventWatcher):
    """Writes the events of a run.

    Parameters
    ----------
    path : Path
        The file, for messages.
    file : int
        Descriptor to write to, from `begin_file` or `open_log`; closed at the end.
    every : float
        Seconds between two writes; with 0 each line is written at once.

    Raises
    ------
    OutputError
        From any call, if the file cannot be written.

    Notes
    -----
    Lines wait in a queue, which a thread of its own writes: a signal's handler may add one at any moment.
    """

    def __init__(self, path: Path, file: int, *, every: float = EVERY) -> None:
        self.path, self._file, self._every = path, file, every
        self._queue: deque[str] = deque()
        self._writing = threading.RLock()
        self._stop = threading.Event()
        self._error: OSError | None = None
        self._busy = False
        self._cut = False  # the last line was written in part
        self._thread = threading.Thread(target=self._write_now_and_then, name="events", daemon=True)
        if every:
            self._thread.start()

    def take(self, event: Event, state: RunState) -> None:
        """Write an event."""
        if not state.ended:  # at the end the file is tried once more
            self._raise()
        self._queue.append(_encode(event) + "\n")
        if not self._every and not state.ended:
            self._write()

    def end(self, status: str, error: str = "") -> None:
        """Write what is left, and close the file."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        try:
            self._error = None
            self._write()
            self._raise()
        finally:
            os.close(self._file)

    def _write_now_and_then(self) -> None:
        while not self._stop.wait(self._every):
            self._write()

    def _write(self) -> None:
        """Write what waits; an error is kept, to be raised where the run can end by it."""
        with self._writing:
            if self._busy:
                return  # a handler came in between: who is writing takes its line too
            self._busy = True
            try:
                while self._queue:
                    self._write_all([self._queue.popleft() for _ in range(len(self._queue))])
            except OSError as error:
                self._error, self._cut = error, True
            finally:
                self._busy = False

    def _write_all(self, lines: list[str]) -> None:
        left = memoryview(("\n" * self._cut + "".join(lines)).encode())
        while left:
            left = left[os.write(self._file, left) :]
        self._cut = False

    def _raise(self) -> None:
        if self._error is not None:
            raise OutputError(
                f"{self.path}: cannot be written ({self._error.strerror}); free space or choose another place"
            )
