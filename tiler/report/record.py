"""What the report takes from ``run.json``: small members, tiles as a table, of notes the first of each kind."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from tiler.citymodels.json_stream import JsonStream
from tiler.workflow.out_folder import RUN_RECORD
from tiler.workflow.run_folder import SCHEMA, WRONG_FIELD, broken_field, opened_json

SHOWN = 50  # notes of a kind that the report lists
PLACES = 300  # notes of a kind that its map shows
KEPT = 2_500  # entries of the members below that are read
LISTED = ("unreadable", "missing", "set_aside")  # what failed


@dataclass(frozen=True, eq=False)
class NoteGroup:
    """Notes of one kind.

    Attributes
    ----------
    kind : str
        What happened, in kebab case.
    count : int
        How many there are.
    items : list of dict
        The first `SHOWN`: ``subject`` and ``detail``, and ``x`` and ``y`` (m) where there is a place.
    places : float64, (n, 2)
        Places of the first `PLACES` that have one (m).
    """

    kind: str
    count: int
    items: list[dict[str, Any]]
    places: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TileTable:
    """Tiles that are done.

    Attributes
    ----------
    names : tuple of str
        Their names, in the order of the record.
    box : float64, (n, 4)
        xmin, ymin, xmax, ymax (m).
    cells : int64, (n,)
        Cells of each.
    """

    names: tuple[str, ...]
    box: NDArray[np.float64]
    cells: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RunFacts:
    """A run as its record tells it.

    Attributes
    ----------
    members : dict
        All members of the record but tiles and notes; of `LISTED` ones the first `KEPT`.
    lengths : dict of str to int
        How many entries those of `LISTED` have.
    tiles : TileTable
        Tiles that are done; none where the run failed.
    notes : tuple of NoteGroup
        What was dropped, repaired or defaulted, by kind.
    """

    members: dict[str, Any]
    lengths: dict[str, int]
    tiles: TileTable
    notes: tuple[NoteGroup, ...]

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Borders of the region (m): west, south, east, north; None where the run did not get so far."""
        region = self.members.get("region")
        if region is None:
            return None
        west, south, east, north = (float(value) for value in region["bounds"])
        return west, south, east, north


def read_run_facts(directory: Path) -> RunFacts:
    """Read the record of a run for its report.

    Parameters
    ----------
    directory : Path
        Folder of a run.

    Raises
    ------
    InputError
        If the record is missing, damaged or of another schema, or says that the run is at work.

    Notes
    -----
    Memory is some hundred bytes a tile, and of notes what is shown.
    """
    path = directory / RUN_RECORD
    reading = _Reading()
    with opened_json(path) as stream:
        try:
            for key in stream.members():
                reading.take(stream, key)
            stream.finish()
            facts = reading.finish()
            bounds = facts.bounds
        except WRONG_FIELD as error:
            if isinstance(error, ValueError) and type(error) is not ValueError:
                raise  # no JSON: the context tells
            raise broken_field(path, error) from None
    if facts.members.get("schema") != SCHEMA:
        raise InputError(f"{path}: schema {facts.members.get('schema')!r}, expected {SCHEMA}; run again")
    status = facts.members.get("status")
    if status == "running":
        raise InputError(f"{path}: the run is at work, or was ended without a word; wait, or run again")
    if status == "done" and bounds is None:
        raise InputError(f"{path}: tells no region; run again")
    if bounds is not None and not (
        all(map(math.isfinite, bounds)) and bounds[0] < bounds[2] and bounds[1] < bounds[3]
    ):
        raise InputError(f"{path}: region bounds {bounds} are no box; run again")
    return facts


@dataclass
class _Reading:
    """What was read so far."""

    members: dict[str, Any] = field(default_factory=dict)
    lengths: dict[str, int] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    boxes: list[tuple[float, ...]] = field(default_factory=list)
    cells: list[int] = field(default_factory=list)
    notes: list[NoteGroup] = field(default_factory=list)

    def take(self, stream: JsonStream, key: str) -> None:
        if key == "tiles":
            self._take_tiles(stream)
        elif key == "notes":
            self.notes = [_take_notes(stream, kind) for kind in stream.members()]
        elif key in LISTED and stream.peek() == "{":
            found = ((name, stream.value()) for name in stream.members())
            self.members[key] = dict(self._count(key, found))
        elif key in LISTED and stream.peek() == "[":
            self.members[key] = list(self._count(key, stream.elements()))
        else:
            self.members[key] = stream.value()

    def _count(self, key: str, values: Iterator[Any]) -> Iterator[Any]:
        """Count all, give the first."""
        self.lengths[key] = 0
        for value in values:
            self.lengths[key] += 1
            if self.lengths[key] <= KEPT:
                yield value

    def finish(self) -> RunFacts:
        table = TileTable(
            tuple(self.names), np.array(self.boxes, np.float64).reshape(-1, 4), np.array(self.cells, np.int64)
        )
        return RunFacts(self.members, self.lengths, table, tuple(self.notes))

    def _take_tiles(self, stream: JsonStream) -> None:
        for name in stream.members():
            tile = stream.value()
            west, south, east, north = map(float, tile["box"])
            self.names.append(name)
            self.boxes.append((west, south, east, north))
            self.cells.append(int(tile["counts"]["cells"]))


def _take_notes(stream: JsonStream, kind: str) -> NoteGroup:
    count = 0
    items: list[dict[str, Any]] = []
    places: list[tuple[float, float]] = []
    for key in stream.members():
        if key == "items":
            for item in stream.elements():
                if len(items) < SHOWN:
                    items.append({str(name): value for name, value in item.items()})
                if len(places) < PLACES and "x" in item:
                    places.append((float(item["x"]), float(item["y"])))
        elif key == "count":
            count = int(stream.value())
        else:
            stream.skip()
    return NoteGroup(kind, count, items, np.array(places, np.float64).reshape(-1, 2))
