"""The event stream of a run: each call of the engine becomes an event, is folded into a state, and handed on."""

import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from itertools import islice
from typing import Any

from stitch.tiling.grid import tiles_of_seam
from tiler.engine.run_context import seam_key, tile_name
from tiler.engine.stage import Box, Layout, Scope
from tiler.engine.submission import Item
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart, Watcher
from tiler.monitoring.events import Event, list_numbers
from tiler.monitoring.run_state import RunState
from tiler.store.out_folder import command_alone

CHUNK = 1000  # tiles or seams an event


class EventWatcher(Watcher):
    """A watcher of events, as `tiler.monitoring.events` lists them, rather than of the engine's calls."""

    def take(self, event: Event, state: RunState) -> None:
        """Take note of an event; `state` has it already."""


class Watchers(Watcher):
    """Makes the events of a run, and calls several watchers one after the other.

    Parameters
    ----------
    watchers : iterable of Watcher
        Those present from the start; later ones may join before the run begins, and get the earlier messages then.

    Attributes
    ----------
    state : RunState
        What all events so far come to, without what only a map shows.
    """

    def __init__(self, watchers: Iterable[Watcher] = ()) -> None:
        self.state = RunState(mapped=False)
        self._all = list(watchers)
        self._late: list[Watcher] = []
        self._said: list[Event] = []
        self._start: RunStart | None = None
        self._ended = False

    def add(self, watcher: Watcher) -> None:
        """Take one more, before the run begins."""
        self._late.append(watcher)

    def begin(self, start: RunStart) -> None:
        """Tell what the run is, its tiles and seams, and the stages that it will have."""
        self._start = start
        late, self._late = self._late, []
        self._all += late
        self._emit(self._describe_run("running", ""))
        self._emit_boxes(start.tiles, start.seams)
        for stage, (scope, total) in start.expected.items():
            self._emit(_event("planned", stage=stage, scope=scope.value, total=total))
        for watcher in self._all:
            watcher.begin(start)
        for event in self._said:
            for watcher in late:
                watcher.say(event["text"])
            self._hand_on(event, late)

    def laid_out(self, layout: Layout) -> None:
        """Tell the tiles and seams of another layout; those that were there keep their boxes."""
        for watcher in self._all:
            watcher.laid_out(layout)
        self._emit_boxes(layout.tiles, layout.seams)

    def planned(self, stage: str, scope: Scope, total: int) -> None:
        for watcher in self._all:
            watcher.planned(stage, scope, total)
        self._emit(_event("planned", stage=stage, scope=scope.value, total=total))

    def submitted(self, stage: str, name: str) -> None:
        for watcher in self._all:
            watcher.submitted(stage, name)
        self._emit(_event("submitted", stage=stage, name=name))

    def done(self, stage: str, n_done: int, total: int, record: Record) -> None:
        for watcher in self._all:
            watcher.done(stage, n_done, total, record)
        event = _event(
            "done",
            stage=stage,
            name=record.name,
            done=n_done,
            total=total,
            seconds=round(record.seconds.get("all", 0.0), 3),
            memory=record.peak_memory,
            reused=record.reused,
            notes=record.notes,
            facts=list_numbers(record.facts),
        )
        self._emit(event | ({"ago": record.ago} if record.ago else {}))

    def failed(
        self, stage: str, name: str, reason: str, needs: Item | None = None, *, ends_run: bool = False
    ) -> None:
        for watcher in self._all:
            watcher.failed(stage, name, reason, needs, ends_run=ends_run)
        command = ""
        if needs is None and self._start is not None:
            command = describe_command(self._start, stage, Scope(self.state.stages[stage].scope), name)
        more = ({"needs": needs} if needs else {}) | ({"ends_run": True} if ends_run else {})
        self._emit(_event("failed", stage=stage, name=name, reason=reason, command=command) | more)

    def say(self, text: str) -> None:
        event = _event("message", text=text)
        if self._start is None:
            self._said.append(event)
        for watcher in self._all:
            watcher.say(text)
        self._emit(event)

    def end(self, status: str, error: str = "") -> None:
        """Call all, once; where one raises, the others are called all the same."""
        if self._ended:
            return
        self._ended = True
        event = self._describe_run(status, error)
        self.state.fold(event)
        with ExitStack() as stack:
            for watcher in reversed((*self._all, *self._late)):
                stack.callback(watcher.end, status, error)
                stack.callback(self._hand_on, event, [watcher])

    def _describe_run(self, status: str, error: str) -> Event:
        start = self._start
        if start is None:
            return _event("run", status=status, error=error)
        about = {"command": start.command, "bounds": start.bounds, "crs": start.crs}
        size = {"tile_size": start.tile_size, "workers": start.workers}
        return _event("run", status=status, error=error, **about, **size)

    def _emit_boxes(self, tiles: Mapping[str, Box], seams: Mapping[str, Box]) -> None:
        for kind, boxes in (("tiles", tiles), ("seams", seams)):
            places = ((name, *box) for name, box in boxes.items())
            while chunk := list(islice(places, CHUNK)):
                self._emit(_event(kind, **{kind: chunk}))

    def _emit(self, event: Event) -> None:
        self.state.fold(event)
        self._hand_on(event, self._all)

    def _hand_on(self, event: Event, watchers: Iterable[Watcher]) -> None:
        for watcher in watchers:
            if isinstance(watcher, EventWatcher):
                watcher.take(event, self.state)


def _event(kind: str, **content: Any) -> Event:
    return {"t": round(time.time(), 3), "event": kind, **content}


def describe_command(start: RunStart, stage: str, scope: Scope, name: str) -> str:
    """Give the command that shows an item's failure: of a tile alone, else of the whole run, if it has one."""
    tiles = [name] if scope is Scope.TILE else []
    if scope is Scope.SEAM:
        tiles = [tile_name(key) for key in tiles_of_seam(seam_key(name))]
    if stage not in start.whole:
        for tile in tiles:
            if tile in start.tiles:
                return command_alone(start.out, tile)
    return f"{start.command} --traceback" if start.command else ""
