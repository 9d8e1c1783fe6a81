"""The journal of a run folder: numbered, dated edits of its footprints, one file each."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.data.errors import InputError
from tiler.objects.places import in_bucket
from tiler.store.atomic import replacing
from tiler.store.checksums import is_sealed, seal

JOURNAL = "edits"  # folder below a run's
Box = tuple[float, float, float, float]
# A roof surface: well-known binary of its polygon in hexadecimal digits; slopes, height, origin and limits (m) of
# its plane, see `pipeline.data.roofs.Roofs`.
Surface = tuple[str, tuple[float, ...]]
Place = tuple[str, Box]


class Outline(NamedTuple):
    """A footprint that comes."""

    id: str
    polygon: str  # well-known binary in hexadecimal digits
    height: float | None  # above ground (m), None where none is given
    form: tuple[float | None, ...]  # of its roof, a row of `pipeline.data.roof_forms`
    base: float | None = None  # lowest height of a model (m)
    surfaces: tuple[Surface, ...] = ()  # its roof

    @property
    def tells(self) -> bool:
        """Whether it states its height: roof points in the cloud are those of what stood there before."""
        return self.height is not None


@dataclass(frozen=True)
class Edit:
    """One edit: what is taken away, and what comes."""

    number: int  #: from 1, ascending
    date: str  #: day from which on it holds, YYYY-MM-DD
    action: str  #: ``"replace"``, ``"remove"`` or ``"add"``
    source: str  #: name of the file that was uploaded; ``""`` for none
    removed: tuple[Place, ...]  #: each (str, box): ids that are taken away, each with the box of its outline (m)
    outlines: tuple[Outline, ...]  #: footprints that come, in the region's CRS
    boxes: tuple[Box, ...]  #: that of each of these (m)
    #: name that a client gave it, and a hash of what it sent: who asks once more is told that it is done
    request: str = ""
    digest: str = ""

    @property
    def ids(self) -> list[str]:
        """Buildings that it touches, sorted."""
        return sorted({*(name for name, _ in self.removed), *(outline.id for outline in self.outlines)})


@dataclass(frozen=True)
class Edits:
    """What all edits of a journal come to."""

    #: each (str, box): footprints of the input, and of earlier edits, that are gone; sorted
    removed: tuple[Place, ...] = ()
    outlines: tuple[tuple[Outline, Box], ...] = ()  #: each (Outline, box): those that are there, by id

    @property
    def boxes(self) -> list[Box]:
        """Where something changed (m)."""
        return [box for _, box in (*self.removed, *self.outlines)]


def add_up(journal: Sequence[Edit]) -> Edits:
    """Apply edits one after the other.

    Examples
    --------
    >>> box = (0.0, 0.0, 1.0, 1.0)
    >>> added = Edit(1, "2027-01-01", "add", "a.gpkg", (), (Outline("a", "00", None, ()),), (box,))
    >>> gone = Edit(2, "2027-01-02", "remove", "", (("a", box),), (), ())
    >>> len(add_up([added]).outlines), len(add_up([added, gone]).outlines)
    (1, 0)
    """
    removed: set[Place] = set()
    there: dict[str, tuple[Outline, Box]] = {}
    for edit in journal:
        removed |= set(edit.removed)
        for name, _ in edit.removed:
            there.pop(name, None)
        there |= {row.id: (row, box) for row, box in zip(edit.outlines, edit.boxes, strict=True)}
    return Edits(tuple(sorted(removed)), tuple(there[name] for name in sorted(there)))


def read_journal(out: Path) -> list[Edit]:
    """Read the edits of a run folder, by number; none where there is no journal, and in a bucket.

    Raises
    ------
    InputError
        If an edit cannot be read, or is not as it was written.
    """
    if in_bucket(out):
        return []
    return [_read(path) for path in sorted((out / JOURNAL).glob("[0-9]*.json"))]


def edit_path(out: Path, number: int) -> Path:
    """Path of the edit of a number."""
    return out / JOURNAL / f"{number:06d}.json"


def write_edit(out: Path, edit: Edit) -> None:
    """Write an edit into the journal of a folder: whole or not at all, on the disk when this returns."""
    path = edit_path(out, edit.number)
    path.parent.mkdir(exist_ok=True)
    with replacing(path, durable=True) as part:
        part.write_bytes(seal(json.dumps({"checksum": "0" * 8} | asdict(edit), indent=1).encode() + b"\n"))


def _read(path: Path) -> Edit:
    try:
        text = path.read_bytes()
        found = json.loads(text)
        if not is_sealed(text) or found.pop("checksum") is None or path.stem != f"{found['number']:06d}":
            raise ValueError("its checksum differs")
        removed = tuple((str(name), _box(box)) for name, box in found.pop("removed"))
        outlines = tuple(map(_outline, found.pop("outlines")))
        boxes = tuple(map(_box, found.pop("boxes")))
        return Edit(**found, removed=removed, outlines=outlines, boxes=boxes)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: is no edit as it was written ({error}); put it back from a copy") from None


def _box(values: Sequence[float]) -> Box:
    xmin, ymin, xmax, ymax = map(float, values)
    return xmin, ymin, xmax, ymax


def _outline(row: Sequence[Any]) -> Outline:
    name, polygon, height, form, base, surfaces = row
    surfaces = tuple((blob, tuple(plane)) for blob, plane in surfaces)
    return Outline(name, polygon, height, tuple(form), base, surfaces)
