"""What is asked for, held against the city and its journal: ids, dates, and edits that came between."""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pipeline.data.errors import ConfigError, InputError
from tiler.editing.uploads import Uploaded, as_outlines
from tiler.engine.stage import REGION_ITEM
from tiler.engine.task import notes_from_json
from tiler.store.edit_journal import Box, Edit, add_up
from tiler.store.out_folder import STORE
from tiler.store.store import Store

ACTIONS = ("replace", "remove", "add")


@dataclass(frozen=True, eq=False)
class Asked:
    """An edit as it is asked for."""

    action: str  #: one of `ACTIONS`
    building: str = ""  #: id of the building; ``""`` to add those of the upload
    upload: Uploaded | None = None  #: what comes
    source: str = ""  #: name of its file
    date: str = ""  #: day from which on it holds, YYYY-MM-DD; today by default
    base: int | None = None  #: number of the last edit that the client knows of; by default of all
    #: name that a client gave it, and a hash of what it sent; empty without one
    request: str = ""
    digest: str = ""


class ConflictError(ConfigError):
    """A later edit is of the same building: look at `edits`, and ask again."""

    def __init__(self, message: str, edits: Sequence[Edit] = ()) -> None:
        super().__init__(message)
        self.edits = tuple(edits)


def read_buildings(out: Path) -> dict[str, Box]:
    """List the footprints of the input of a city: id and box (m) of each."""
    store = Store(out / STORE)
    found: dict[str, Box] = {}
    if store.attributes("footprints", REGION_ITEM)["facts"]["n"]:
        arrays, _ = store.read("footprints", REGION_ITEM, names=("id", "id_end", "box"))
        text, ends = arrays["id"].tobytes(), [0, *arrays["id_end"].tolist()]
        for (first, last), box in zip(pairwise(ends), arrays["box"].tolist(), strict=True):
            found[text[first:last].decode()] = tuple(box)
    return found


def edit_buildings(given: Mapping[str, Box], journal: Sequence[Edit]) -> dict[str, Box]:
    """List the footprints of a city as its edits have left those of the input, `given`."""
    found, edits = dict(given), add_up(journal)
    for name, _ in edits.removed:
        found.pop(name, None)
    return found | {outline.id: box for outline, box in edits.outlines}


def describe_uploads(out: Path, edit: Edit) -> list[str]:
    """Say what to know of uploads that tell their height: points that do not count, a foot off the ground."""
    ids = {outline.id for outline in edit.outlines if outline.tells}
    store, found = Store(out / STORE), list[str]()
    for tile in store.names("houses") if ids else []:
        notes = notes_from_json(store.attributes("houses", tile)["notes"])
        told = (note for note in notes if note.subject in ids and note.kind.startswith(("upload-", "model-")))
        found += [f"{note.subject}: {note.detail}" for note in told]
    return sorted(found)


def read_date(text: str) -> str:
    """Check a date, by default today's; ConfigError unless it is YYYY-MM-DD."""
    try:
        return (datetime.date.fromisoformat(text) if text else datetime.date.today()).isoformat()
    except ValueError:
        raise ConfigError(f"date {text!r}: is no day; give YYYY-MM-DD") from None


def make_edit(asked: Asked, *, buildings: Mapping[str, Box], journal: Sequence[Edit]) -> Edit:
    """Make the next edit of a journal.

    Parameters
    ----------
    asked : Asked
        What is asked for.
    buildings : mapping of str to box
        From `edit_buildings`.
    journal : sequence of Edit
        All earlier edits.

    Raises
    ------
    ConflictError
        For a building that an edit after ``base`` has touched.
    ConfigError
        For an id that is not there, or is there already; for a date before that of its last edit.
    InputError
        If an id comes twice, or several footprints take the place of one building.
    """
    action, name, upload, base = asked.action, asked.building, asked.upload, asked.base
    date = read_date(asked.date)
    last = journal[-1].number if journal else 0
    if base is not None and not 0 <= base <= last:
        raise ConfigError(
            f"base {base}: the last edit is number {last}; give one up to it, the list of edits tells all"
        )
    if action == "replace" and upload is not None:
        upload = upload.with_ids(name)
    outlines, boxes = ((), ()) if upload is None else as_outlines(upload)
    ids = {name} if action != "add" else {outline.id for outline in outlines}
    _refuse_conflicts(ids, journal, date, last if base is None else base)
    if action == "add":
        if there := sorted(ids.intersection(buildings)):
            raise ConfigError(f"building {there[0]!r}: is there already; replace it, or give another id")
        if len(ids) < len(outlines):
            raise InputError(f"{asked.source}: an id comes twice; give each building its own")
        # The parts of a house get such names: a footprint of the input with one makes all tiles look for it.
        if parts := sorted(one for one in ids if "-part" in one):
            raise ConfigError(f"building {parts[0]!r}: ids with '-part' are those of parts; give another id")
        removed: tuple[tuple[str, Box], ...] = ()
    else:
        if name not in buildings:
            raise ConfigError(f"building {name!r}: is not in the city; ids are those of its footprints")
        if action == "replace" and len(outlines) != 1:
            raise InputError(
                f"{asked.source}: has {len(outlines)} footprints, one takes the place of a building; give one"
            )
        removed = ((name, buildings[name]),)
    return Edit(
        *(last + 1, date, action, asked.source, removed, outlines, boxes),
        request=asked.request,
        digest=asked.digest,
    )


def _refuse_conflicts(ids: set[str], journal: Sequence[Edit], date: str, base: int) -> None:
    """Refuse an edit of a building that a later edit than `base` has touched, or one of a later day."""
    same = [edit for edit in journal if ids.intersection(edit.ids)]
    later = [edit for edit in same if edit.number > base]
    for edit in later or same:
        told = f"building {min(ids.intersection(edit.ids))!r}: edit {edit.number} of {edit.date} ({edit.action}"
        told += f", {edit.source})" if edit.source else ")"
        if later:
            last = journal[-1].number
            raise ConflictError(f"{told} came after state {base}; look at it, then give {last} as base", later)
        if date < edit.date:
            raise ConfigError(f"{told} is later than {date}; give a date from {edit.date} on")
