"""Watchers of a run: each is told what is planned, begun, done and said, and does its own with it.

The engine knows none of them: it tells one `Progress`, which here is all of them together.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from stitch.tiling.grid import tiles_of_seam
from tiler.engine.run_context import seam_key, tile_name
from tiler.engine.stage import Box, Layout, Scope
from tiler.engine.task import Record
from tiler.store.out_folder import command_alone

Item = tuple[str, str]  # stage and name


@dataclass(frozen=True, eq=False)
class RunStart:
    """What is known when a run begins.

    Attributes
    ----------
    out : Path
        Folder of the run.
    command : str
        What a user gives to run it again or to go on; empty where no command does it.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    crs : str
        Its CRS.
    tile_size : float
        Side of a tile (m).
    workers : int
        Number of workers, 0 where a cluster decides.
    tiles, seams : mapping of str to (xmin, ymin, xmax, ymax)
        Their boxes by name (m).
    expected : mapping of str to (Scope, int)
        Scope and number of items of the stages that are known from the start, in their order.
    whole : frozenset of str
        Stages that only the whole run has: ``--only`` leaves them out.
    """

    out: Path
    command: str
    bounds: Box
    crs: str
    tile_size: float
    workers: int
    tiles: Mapping[str, Box]
    seams: Mapping[str, Box]
    expected: Mapping[str, tuple[Scope, int]]
    whole: frozenset[str] = frozenset()


class Watcher:
    """Looks on at a run; what a watcher does not care for, it leaves as it is here: nothing happens.

    `say` may be called from a signal's handler, in the middle of any other call: it must not wait for a lock that
    is not reentrant.
    """

    def begin(self, start: RunStart) -> None:
        """Take note that the run begins: its inputs are there, and its folder is its own."""

    def laid_out(self, layout: Layout) -> None:
        """Take note of tiles and seams that the run did not begin with, beside those that it did."""

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        """Take note of how many items a stage has."""

    def submitted(self, stage: str, name: str) -> None:
        """Take note of an item that was given to a worker."""

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Take note of an item that is done, the `done`-th of its stage."""

    def failed(self, stage: str, name: str, reason: str, needs: Item | None = None) -> None:
        """Take note of an item that failed, or that is not run because it needs one that is not there."""

    def say(self, text: str) -> None:
        """Take note of a sentence that the user should read."""

    def end(self, status: str, error: str = "") -> None:
        """Take note that the run has ended: ``"done"``, ``"stopped"`` or ``"failed"``, and why."""


class Listener(Watcher):
    """Hears what the user should read, and nothing else."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say

    def say(self, text: str) -> None:
        """Hand it on."""
        self._say(text)


class Watchers(Watcher):
    """Several watchers, told one after the other.

    Parameters
    ----------
    watchers : iterable of Watcher
        Those who are there from the start; others may come when the run begins, and are told then what was said.
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
        """Tell all."""
        for watcher in (*self._all, *self._late):
            watcher.begin(start)
        for watcher in self._late:
            for text in self._said:
                watcher.say(text)
        self._all, self._late, self._begun = [*self._all, *self._late], [], True

    def laid_out(self, layout: Layout) -> None:
        """Tell all."""
        for watcher in self._all:
            watcher.laid_out(layout)

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        """Tell all."""
        for watcher in self._all:
            watcher.planned(stage, scope, total)

    def submitted(self, stage: str, name: str) -> None:
        """Tell all."""
        for watcher in self._all:
            watcher.submitted(stage, name)

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        """Tell all."""
        for watcher in self._all:
            watcher(stage, done, total, record)

    def failed(self, stage: str, name: str, reason: str, needs: Item | None = None) -> None:
        """Tell all."""
        for watcher in self._all:
            watcher.failed(stage, name, reason, needs)

    def say(self, text: str) -> None:
        """Tell all."""
        if not self._begun:
            self._said.append(text)
        for watcher in self._all:
            watcher.say(text)

    def end(self, status: str, error: str = "") -> None:
        """Tell all, once; where one raises, the others are told all the same."""
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
