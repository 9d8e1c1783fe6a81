"""Watchers: the calls by which the engine reports what a run does."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tiler.engine.stage import Box, Layout, Scope
from tiler.engine.submission import Item
from tiler.engine.task import Record


@dataclass(frozen=True, eq=False)
class RunStart:
    """What is known when a run begins."""

    out: Path  #: folder of the run
    command: str  #: what a user gives to run it again or to go on; empty where no command does it
    bounds: Box  #: (xmin, ymin, xmax, ymax): the region (m)
    crs: str  #: its CRS
    tile_size: float  #: side of a tile (m)
    workers: int  #: number of workers, 0 where a cluster decides
    #: their boxes by name (m)
    tiles: Mapping[str, Box]
    seams: Mapping[str, Box]
    #: scope and number of items of the stages that are known from the start, in their order
    expected: Mapping[str, tuple[Scope, int]]
    whole: frozenset[str] = frozenset()  #: stages that only the whole run has: ``--only`` leaves them out


class Watcher:
    """The base of all watchers: it does nothing.

    Notes
    -----
    `say` may be called from a signal handler, in the middle of any other call: it must not wait for a lock that
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

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        """Take note of an item that is done, the `n_done`-th of its stage."""

    def failed(
        self, stage: str, name: str, reason: str, needs: Item | None = None, *, ends_run: bool = False
    ) -> None:
        """Take note of an item that failed, or that is not run because it needs one that is not there.

        With `ends_run` the run ends by this failure, and raises it.
        """

    def say(self, text: str) -> None:
        """Take note of a sentence for the user."""

    def end(self, status: str, error: str = "") -> None:
        """Take note that the run has ended: ``"done"``, ``"stopped"`` or ``"failed"``, and why."""
