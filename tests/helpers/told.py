"""Watchers of a run for tests."""

from collections.abc import Callable

from tiler.engine.task import Record
from tiler.engine.watcher import Watcher


class Told(Watcher):
    """Calls a function with stage, number of items done, number of all items, and record of each item done."""

    def __init__(self, tell: Callable[[str, int, int, Record], object]) -> None:
        self._tell = tell

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        self._tell(stage, n_done, total, record)


class StageEnds(Told):
    """Calls a function with the name of each stage that is done."""

    def __init__(self, tell: Callable[[str], object]) -> None:
        super().__init__(lambda stage, n_done, total, _: tell(stage) if n_done == total else None)


class Listener(Watcher):
    """Hears what the user should read, and nothing else."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say

    def say(self, text: str) -> None:
        self._say(text)
