"""Watchers of a run: all of them as one, one that hands on sentences, and the command that shows a failure."""

from collections.abc import Iterable
from contextlib import ExitStack

from stitch.tiling.grid import tiles_of_seam
from tiler.engine.run_context import seam_key, tile_name
from tiler.engine.stage import Layout, Scope
from tiler.engine.submission import Item
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart, Watcher
from tiler.store.out_folder import command_alone


class Watchers(Watcher):
    """Several watchers, called one after the other.

    Parameters
    ----------
    watchers : iterable of Watcher
        Those present from the start; later ones may join when the run begins, and get the earlier calls then.
    """

    def __init__(self, watchers: Iterable[Watcher] = ()) -> None:
        self._all = list(watchers)
        self._late: list[Watcher] = []
        self._said: list[str] = []
        self._begun = self._ended = False

    def add(self, watcher: Watcher) -> None:
        """Take one more, before the run begins."""
        self._late.append(watcher)

    def begin(self, start: RunStart) -> None:
        for watcher in (*self._all, *self._late):
            watcher.begin(start)
        for watcher in self._late:
            for text in self._said:
                watcher.say(text)
        self._all, self._late, self._begun = [*self._all, *self._late], [], True

    def laid_out(self, layout: Layout) -> None:
        for watcher in self._all:
            watcher.laid_out(layout)

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        for watcher in self._all:
            watcher.planned(stage, scope, total)

    def submitted(self, stage: str, name: str) -> None:
        for watcher in self._all:
            watcher.submitted(stage, name)

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        for watcher in self._all:
            watcher.done(stage, n_done, total, record)

    def failed(
        self, stage: str, name: str, reason: str, needs: Item | None = None, *, ends_run: bool = False
    ) -> None:
        for watcher in self._all:
            watcher.failed(stage, name, reason, needs, ends_run=ends_run)

    def say(self, text: str) -> None:
        if not self._begun:
            self._said.append(text)
        for watcher in self._all:
            watcher.say(text)

    def end(self, status: str, error: str = "") -> None:
        """Call all, once; where one raises, the others are called all the same."""
        if self._ended:
            return
        self._ended = True
        with ExitStack() as stack:
            for watcher in reversed((*self._all, *self._late)):
                stack.callback(watcher.end, status, error)


def describe_command(start: RunStart, stage: str, scope: Scope, name: str) -> str:
    """Give the command that shows an item's failure: that of a tile alone, else of the whole run, if it has one.

    Parameters
    ----------
    start : RunStart
        The run.
    stage, name : str
        The item.
    scope : Scope
        Scope of the stage.
    """
    tiles = [name] if scope is Scope.TILE else []
    if scope is Scope.SEAM:
        tiles = [tile_name(key) for key in tiles_of_seam(seam_key(name))]
    if stage not in start.whole:
        for tile in tiles:
            if tile in start.tiles:
                return command_alone(start.out, tile)
    return f"{start.command} --traceback" if start.command else ""
