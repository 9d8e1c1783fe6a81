"""What is kept beside a tileset, so that an edit of the run makes anew the cells that it touches and no others.

::

    state.json                  what all of it is of; missing while it is changed
    origin.json                 origin of the city model, from where coordinates of buildings were counted
    tree.json                   what the tree tells of each cell by itself
    cells/{level}/{x}/{y}.json  what a cell hands to the one above it
    late/{level}/{x}/{y}.json   what it handed to that before, where the one above was not made anew since
    runs/{tile}.json            what cells took from a tile of the run
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from tiler.citymodels.tables import BUILDING_ARRAYS, Arrays, rows_by_id
from tiler.mesh_files.run_files import RunFiles
from tiler.store.atomic import replacing
from tiler.store.out_folder import CITY_MODEL, MANIFEST_PATH, STORE
from tiler.store.store import Store
from tiler.tiles3d.base import Made, SortedPiece
from tiler.tiles3d.buildings import Part, Unit, make_units
from tiler.tiles3d.cells import Cell
from tiler.tiles3d.subtrees import Tile
from tiler.tiles3d.terrain import Lattice
from tiler.workflow.audit import Entry, read_manifest

LATE = "late"
MOVED = 0.1  # m
MODEL = "model"  # stage of the buildings that a tile owns, as they are meshed


@dataclass(frozen=True)
class RunTile:
    """What cells took from a tile of the run."""

    #: digests of its buildings, and of its piece of the boundary
    model: str
    boundary: str
    ground: dict[str, str]  #: hash of its ground in each cell, by code
    lowest: dict[str, float]  #: lowest wall (m) of each building of the piece, by number
    #: house, number, hash and smallest cell of each building or part that it owns, by id; None without a solid
    parts: dict[str, tuple[str, int, str, int | None]]
    ground_height: float | None  #: lowest ground (m) of these

    @property
    def numbers(self) -> dict[int, float]:
        """`lowest` by number."""
        return {int(number): z for number, z in self.lowest.items()}


class UpdateState:
    """The folder in which that is.

    Parameters
    ----------
    folder : Path
        The folder; made when something is written.
    state : object
        What it must be of; JSON has it.
    """

    def __init__(self, folder: Path, state: Any) -> None:
        self._folder, self._state = folder, json.loads(json.dumps(state))

    def is_sound(self) -> bool:
        """Whether the folder is of that state, and all is there."""
        try:
            return bool(self._read("state") == self._state)
        except (OSError, ValueError):
            return False

    def begin(self) -> None:
        """Say that all of it is being changed: whoever finds it so cannot use it."""
        (self._folder / "state.json").unlink()

    def finish(self, tree: Mapping[Cell, Tile], origin: Sequence[float]) -> None:
        """Say that all is there, and from where the coordinates of the buildings were counted."""
        self._write("origin", origin)
        rows = [[*cell, *tile.region, tile.error] for cell, tile in sorted(tree.items())]
        self._write("tree", rows)
        self._write("state", self._state)

    def end(
        self,
        files: RunFiles,
        tree: Mapping[Cell, Tile],
        pieces: Mapping[str, SortedPiece],
        places: Mapping[str, int],
    ) -> None:
        """Keep what a whole export took from each tile of the run: pieces, and the cell of each part by id."""
        stamps, store = read_stamps(files), Store(files.directory / STORE)
        for name, piece in pieces.items():
            arrays, _ = store.read(MODEL, name)
            parts = {
                one: (house, number, row, places.get(one))
                for one, (house, number, row) in hash_rows(arrays).items()
            }
            self.save_run(name, make_run_tile(stamps[name], piece, parts, lowest_ground(arrays)))
        with (files.directory / CITY_MODEL).open("rb") as file:  # its first line has the origin
            origin = json.loads(file.readline().rstrip(b",\n") + b"}")["transform"]["translate"]
        self.finish(tree, origin)

    def read_origin(self) -> list[float]:
        """Read from where the coordinates of the buildings were counted: the origin of the city model."""
        return list(self._read("origin"))

    def save(self, cell: Cell, made: Made) -> bool:
        """Keep what a cell hands up; returns whether it differs from what it handed up before."""
        return self._write(_name(cell), _describe(made))

    def read_cell(self, cell: Cell) -> Made | None:
        """Read what a cell hands up; None where there is no such cell."""
        return self._read_made(_name(cell))

    def read_handed(self, cell: Cell) -> Made | None:
        """Read what the cell above was made of; None where there was no such cell."""
        return self._read_made(_name(cell, LATE)) or self.read_cell(cell)

    def hold(self, cell: Cell, before: Made) -> None:
        """Keep what the cell above was made of, as it is not made anew though a cell has changed."""
        self._write(_name(cell, LATE), _describe(before))

    def release(self, cell: Cell) -> None:
        """Forget that: the cell above is made anew."""
        (self._folder / f"{_name(cell, LATE)}.json").unlink(missing_ok=True)

    def late_cells(self) -> list[Cell]:
        """List the cells that have changed since the one above was made."""
        paths = (self._folder / LATE).glob("*/*/*.json")
        return sorted((int(path.parts[-3]), int(path.parts[-2]), int(path.stem)) for path in paths)

    def _read_made(self, name: str) -> Made | None:
        try:
            found = self._read(name)
        except FileNotFoundError:
            return None
        lattice = Lattice(np.array(found["lattice"]["height"], np.float64), found["lattice"]["error"])
        return Made(lattice, [_load_unit(unit) for unit in found["units"]])

    def remove(self, cell: Cell) -> None:
        """Forget a cell."""
        (self._folder / f"{_name(cell)}.json").unlink(missing_ok=True)

    def read_tree(self) -> dict[Cell, Tile]:
        """Read what the tree tells of each cell by itself."""
        return {
            (level, x, y): Tile(tuple(region), error, content=True)
            for level, x, y, *region, error in self._read("tree")
        }

    def save_run(self, name: str, tile: RunTile) -> None:
        """Keep what cells took from a tile of the run."""
        self._write(f"runs/{name}", asdict(tile))

    def read_run(self, name: str) -> RunTile:
        """Read what cells took from a tile of the run."""
        return RunTile(**self._read(f"runs/{name}"))

    def _read(self, name: str) -> Any:
        return json.loads((self._folder / f"{name}.json").read_bytes())

    def _write(self, name: str, value: Any) -> bool:
        path, data = self._folder / f"{name}.json", json.dumps(value).encode()
        if path.exists() and path.read_bytes() == data:
            return False
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            part.write_bytes(data)
        return True


def read_stamps(files: RunFiles) -> dict[str, tuple[str, str]]:
    """Read from the manifest of a run the digests of each tile's buildings and of its piece of the boundary."""
    model, boundary = dict[str, str](), dict[str, str]()
    for entry in read_manifest(files.directory / MANIFEST_PATH):
        if isinstance(entry, Entry):
            if entry.stage == MODEL:
                model[entry.name] = entry.digest
            for path, stated in entry.files.items():
                if path.startswith("boundary/"):
                    boundary[Path(path).stem] = json.dumps(stated)
    return {path.stem: (model[path.stem], boundary[path.stem]) for path in files.boundaries}


def make_run_tile(
    stamps: tuple[str, str],
    piece: SortedPiece,
    parts: Mapping[str, tuple[str, int, str, int | None]],
    ground_height: float | None,
) -> RunTile:
    """Put together what is kept of a tile of the run."""
    ground = {str(code): digest for code, digest in piece.digests.items()}
    lowest = {str(number): z for number, z in piece.lowest.items()}
    return RunTile(*stamps, ground, lowest, dict(parts), ground_height)


def lowest_ground(arrays: Arrays) -> float | None:
    """Give the lowest ground (m) of the buildings of the stage `MODEL`; None without any."""
    return float(arrays["ground"].min()) if len(arrays["ground"]) else None


def hash_rows(arrays: Arrays) -> dict[str, tuple[str, int, str]]:
    """Give house, number and hash of all that is known of each building of the stage `MODEL`, by id."""
    rows = rows_by_id(arrays, BUILDING_ARRAYS)
    given = zip(arrays["id"].tolist(), arrays["house"].tolist(), arrays["number"].tolist(), strict=True)
    return {
        name: (house, number, hashlib.sha256(repr(rows[name]).encode()).hexdigest())
        for name, house, number in given
    }


def measure_change(before: Made, after: Made) -> float:
    """Give the share of a cell that has changed: of walls and roofs by area or of nodes of its ground, the larger.

    A building that takes the place of another one counts once, and a node that moved by more than `MOVED`.
    """
    old, new = (
        {
            json.dumps(_unit(unit)): unit.outline.area + unit.outline.length * (unit.high - unit.bottom)
            for unit in some
        }
        for some in (before.units, after.units)
    )
    gone, came = (sum(own[key] for key in own.keys() - other) for own, other in ((old, new), (new, old)))
    whole = max(sum(old.values()), sum(new.values()))
    a, b = before.lattice.height, after.lattice.height
    moved = (np.isnan(a) != np.isnan(b)) | (abs(a - b) > MOVED)
    return max(max(gone, came) / whole if whole else 0.0, float(moved.mean()))


def _name(cell: Cell, kind: str = "cells") -> str:
    return "{}/{}/{}/{}".format(kind, *cell)


def _describe(made: Made) -> dict[str, Any]:
    lattice = {"height": made.lattice.height.tolist(), "error": made.lattice.error}
    return {"lattice": lattice, "units": [_unit(unit) for unit in made.units]}


def _unit(unit: Unit) -> dict[str, Any]:
    if unit.part is not None:
        return {"part": vars(unit.part)}
    return vars(unit) | {"outline": shapely.to_wkb(unit.outline, hex=True)}


def _load_unit(found: dict[str, Any]) -> Unit:
    if found["part"] is not None:
        (unit,) = make_units([Part(**found["part"])])
        return unit
    return Unit(**(found | {"outline": shapely.from_wkb(found["outline"])}))
