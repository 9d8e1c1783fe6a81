"""What a run in a bucket has beside one on a disk: its events are put now and then, and its waits are told."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import OutputError
from tiler.engine.task import WAITED, Record
from tiler.monitoring.events import EventLog, begin_file
from tiler.monitoring.watchers import Watcher
from tiler.objects.path import ObjectPath
from tiler.objects.requests import WAITS

PUT_EVERY = 60.0  # s between two puts of the events
PUT_BYTES = 16 * 2**20  # size up to which they are put before the end


class BucketEvents(EventLog):
    """`EventLog` of a run in a bucket: a file on a disk, put at the end, and once a minute while it is small.

    Parameters
    ----------
    target : ObjectPath
        The object.
    folder : Path
        Where the file is.
    """

    def __init__(self, target: ObjectPath, folder: Path) -> None:
        self._local, self._target, self._put = folder / target.name, target, time.monotonic()
        super().__init__(self._local, begin_file(self._local))

    def _write(self) -> None:
        super()._write()
        if time.monotonic() - self._put >= PUT_EVERY and self._local.stat().st_size <= PUT_BYTES:
            self._put = time.monotonic()
            with suppress(OSError, OutputError):  # tried again; the run learns by its results
                self._target.put_file(self._local)

    def end(self, status: str, error: str = "") -> None:
        """Write how the run ended, and put the file."""
        try:
            super().end(status, error)
            self._target.put_file(self._local)
        except OSError as problem:
            raise OutputError(
                f"{self._target}: cannot be written ({problem.strerror}); check the rights there"
            ) from problem


class WaitWatch(Watcher):
    """Adds up what all processes of a run have waited for the store, and ends a run that has lost its lease.

    Parameters
    ----------
    check : callable
        Raises OutputError if it has, as `tiler.store.folder_lock.only_run` gives it.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        self._check = check

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Take note of an item that is done."""
        self._check()
        waited = record.seconds.get(WAITED, 0.0)
        WAITS.task_seconds += waited
        WAITS.tasks += waited > 0


def describe_waits() -> dict[str, float]:
    """Give what this run waited for, for its record: tasks and their seconds, and requests of the driver."""
    return {
        "tasks": WAITS.tasks,
        "task_seconds": round(WAITS.task_seconds, 3),
        "driver_retries": WAITS.retries,
        "driver_pauses": WAITS.pauses,
        "driver_seconds": round(WAITS.seconds, 3),
    }


def tell_waits() -> str:
    """Give a sentence on what was waited for; none where that was nothing."""
    if not (WAITS.tasks or WAITS.retries):
        return ""
    return (
        f"the store did not answer at once: {WAITS.tasks} tasks waited {WAITS.task_seconds:.1f} s in all, the "
        f"driver repeated {WAITS.retries} requests in {WAITS.seconds:.1f} s; nothing is lost by it"
    )


@contextmanager
def telling(say: Callable[[str], None]) -> Iterator[None]:
    """Tell the user when a request of this process waits for the store."""
    WAITS.retries = WAITS.pauses = WAITS.tasks = 0
    WAITS.seconds = WAITS.task_seconds = 0.0
    WAITS.tell = say
    try:
        yield
    finally:
        WAITS.tell = None
