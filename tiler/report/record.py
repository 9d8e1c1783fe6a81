"""What the report takes from ``run.json``: small members, tiles as a table, of notes the first of each kind."""

import math
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.store.json_stream import iterate_elements, iterate_members, read_members
from tiler.store.out_folder import RUN_RECORD
from tiler.store.run_folder import SCHEMA, WRONG_FIELD, broken_field

SHOWN = 50  # notes of a kind that the report lists
PLACES = 300  # notes of a kind that its map shows
KEPT = 2_500  # entries of the members below that are read
LISTED = ("unreadable", "missing", "set_aside")  # what failed


@dataclass(frozen=True, eq=False)
class NoteGroup:
    """Notes of one kind."""

    kind: str  #: what happened, in kebab case
    count: int  #: how many there are
    #: the first `SHOWN`: ``subject`` and ``detail``, and ``x`` and ``y`` (m) where there is a place
    items: list[dict[str, Any]]
    places: NDArray[np.float64]  #: (n, 2): places of the first `PLACES` that have one (m)


@dataclass(frozen=True, eq=False)
class TileTable:
    """Tiles that are done."""

    names: tuple[str, ...]  #: their names, in the order of the record
    box: NDArray[np.float64]  #: (n, 4): xmin, ymin, xmax, ymax (m)
    cells: NDArray[np.int64]  #: (n,): cells of each


@dataclass(frozen=True, eq=False)
class RunFacts:
    """A run as its record describes it."""

    members: dict[str, Any]  #: all members of the record but tiles and notes; of `LISTED` ones the first `KEPT`
    lengths: dict[str, int]  #: how many entries those of `LISTED` have
    tiles: TileTable  #: tiles that are done; none where the run failed
    notes: tuple[NoteGroup, ...]  #: what was dropped, repaired or defaulted, by kind

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
    Memory is some hundred bytes a tile, and the notes of one kind, of which a record lists ten thousand at most.
    """
    path = directory / RUN_RECORD
    members, large = read_members(path, lambda name: name not in ("tiles", "notes", *LISTED))
    try:
        lengths = {}
        for name in LISTED:
            if name in large:
                members[name], lengths[name] = _read_first(path, name, large[name])
        tiles = _tabulate([(name, *_of_tile(tile)) for name, tile in iterate_members(path, "tiles")])
        notes = tuple(_group(kind, found) for kind, found in iterate_members(path, "notes"))
        facts = RunFacts(members, lengths, tiles, notes)
        bounds = facts.bounds
    except WRONG_FIELD as error:
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


def _read_first(path: Path, name: str, kind: str) -> tuple[dict[str, Any] | list[Any], int]:
    """Read the first `KEPT` entries of an object or array, and count all."""
    entries = iterate_members(path, name) if kind == "start_map" else iterate_elements(path, name)
    first = list(islice(entries, KEPT))
    return dict(first) if kind == "start_map" else first, len(first) + sum(1 for _ in entries)


def _of_tile(tile: Any) -> tuple[tuple[float, ...], int]:
    """Take the box of a tile (m) and its number of cells."""
    west, south, east, north = map(float, tile["box"])
    return (west, south, east, north), int(tile["counts"]["cells"])


def _tabulate(tiles: list[tuple[str, tuple[float, ...], int]]) -> TileTable:
    names, boxes, cells = zip(*tiles, strict=True) if tiles else ((), (), ())
    return TileTable(names, np.array(boxes, np.float64).reshape(-1, 4), np.array(cells, np.int64))


def _group(kind: str, found: Any) -> NoteGroup:
    items = found.get("items", [])
    places = [(float(item["x"]), float(item["y"])) for item in items if "x" in item][:PLACES]
    shown = [dict(item) for item in items[:SHOWN]]
    return NoteGroup(kind, int(found.get("count", 0)), shown, np.array(places, np.float64).reshape(-1, 2))
