"""The buildings of a city model larger than memory: indexed by number and by place, loaded where needed."""

import json
import os
from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from math import isfinite
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import IO, Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError, OutputError
from pipeline.data.roofs import Roofs
from tiler.store.json_stream import iterate_elements, iterate_members, read_members
from tiler.store.run_folder import WRONG_FIELD, Buildings, broken_field

CITYJSON = "2.0"
MAX_NUMBER = 2**53  # of a building
BLOCK = 1 << 14  # vertices that are read at once
PLANE = "roof_plane"  # attribute of a sloped roof: a, b, c, x0, y0, lowest and highest height
PLANE_VALUES = 7
VERTICES, HEAD_MEMBERS = "vertices.f64", "head.json"  # files of the vertices
SHAPES, COLUMNS = "buildings.wkb", ("numbers", "box", "start", "size")  # files of an index
HEAD = np.dtype([("ground", "<f8"), ("roof", "<f8"), ("plane", "<f8", PLANE_VALUES)])
Box = tuple[float, float, float, float]


class BuildingRow(NamedTuple):
    """What is read of a building or part.

    ``number``; heights ``ground`` and ``roof``, the highest place (m); ``plane``: a, b, c, x0, y0, lowest and
    highest height as `Roofs` has them, those of a flat roof at `roof` where the file states none; ``footprint``,
    a Polygon or MultiPolygon.
    """

    number: int
    ground: float
    roof: float
    plane: tuple[float, ...]
    footprint: Any


@dataclass(frozen=True, eq=False)
class BuildingIndex:
    """All buildings of a city model, by ascending number: 36 bytes of each in memory, the rest in a file."""

    numbers: NDArray[np.int64]  # (n,): attribute ``number``
    # (n, 4): box of the footprint, west, south, east, north (m), rounded; NaN for an empty one
    box: NDArray[np.float32]
    # (n,): where the building lies in the file, and how long it is (bytes)
    start: NDArray[np.int64]
    size: NDArray[np.int32]
    file: IO[bytes]  # heights, roofs and footprints

    def __len__(self) -> int:
        return len(self.numbers)

    def find_rows(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Find the row of each number, (k,) to (k,); -1 where the city model has none."""
        if not len(self):
            return np.full(len(numbers), -1)
        row = np.searchsorted(self.numbers, numbers).clip(max=len(self) - 1)
        return np.where(self.numbers[row] == numbers, row, -1)

    def find_near(self, box: Box) -> NDArray[np.int64]:
        """Find the rows of buildings whose box meets another one (m), or nearly so; ascending."""
        # Rounded alike, boxes that meet still do.
        west, south, east, north = np.array(box, np.float32)
        own = self.box
        near = (own[:, 0] <= east) & (own[:, 1] <= north) & (own[:, 2] >= west) & (own[:, 3] >= south)
        return np.flatnonzero(near)

    def take(self, rows: NDArray[np.int64]) -> Buildings:
        """Load the buildings of ascending rows."""
        head: NDArray[Any] = np.empty(len(rows), HEAD)
        shapes = []
        for k in np.argsort(self.start[rows], kind="stable").tolist():
            self.file.seek(int(self.start[rows[k]]))
            data = self.file.read(int(self.size[rows[k]]))
            head[k] = np.frombuffer(data, HEAD, 1)[0]
            shapes.append((k, data[HEAD.itemsize :]))
        footprints = np.empty(len(rows), np.object_)
        footprints[[k for k, _ in shapes]] = shapely.from_wkb([data for _, data in shapes])
        a, b, c, x0, y0, low, high = head["plane"].T
        roofs = Roofs(np.column_stack((a, b, c)), np.column_stack((x0, y0)), np.column_stack((low, high)))
        return Buildings(self.numbers[rows], footprints, head["ground"].copy(), head["roof"].copy(), roofs)


@contextmanager
def index_buildings(path: Path, folder: Path | None = None) -> Iterator[BuildingIndex]:
    """Index the buildings of a CityJSON file, or their parts: numbers, heights and LoD 0 footprints.

    Parameters
    ----------
    path : Path
        The file, in any layout.
    folder : Path, optional
        Where the index and the vertices are put, for `open_index` and `open_vertices` in other processes.

    Raises
    ------
    InputError
        If the file is missing or damaged, or a building lacks one of these or shares its number.

    Notes
    -----
    The file is read three times, one object at a time: its small members, its vertices, which wait in a temporary
    file too, then what refers to them. Temporary files take about half of its size, where `tempfile` puts them
    (``TMPDIR``).
    """
    with TemporaryFile() if folder is None else (folder / SHAPES).open("w+b") as file:
        with TemporaryFile() if folder is None else (folder / VERTICES).open("w+b") as vertex_file:
            vertices = copy_vertices(path, vertex_file)
            index = _read_objects(path, vertices, file)
        if np.any(index.numbers[1:] == index.numbers[:-1]):
            raise InputError(f"{path}: two buildings have one number; give each its own id and run again")
        if folder is not None:
            file.flush()
            (folder / HEAD_MEMBERS).write_text(json.dumps(vertices.head))
            for name in COLUMNS:
                np.save(folder / f"{name}.npy", getattr(index, name))
        yield index


@contextmanager
def open_index(folder: Path) -> Iterator[BuildingIndex]:
    """Open the index that `index_buildings` put into a folder; its columns are mapped."""
    numbers, box, start, size = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in COLUMNS)
    with (folder / SHAPES).open("rb") as file:
        yield BuildingIndex(numbers, box, start, size, file)


def open_vertices(folder: Path) -> "Vertices":
    """Open the vertices that `index_buildings` put into a folder."""
    with (folder / VERTICES).open("rb") as file:
        return Vertices(file, json.loads((folder / HEAD_MEMBERS).read_text()))


class Vertices:
    """The vertices of a city model, mapped from a file of float64 (n, 3) that has them without the transform.

    `head` has the members ``transform`` and, if it has any, ``metadata`` of the city model.
    """

    def __init__(self, file: IO[bytes], head: Mapping[str, Any]) -> None:
        self.head = head
        transform = head["transform"]
        self._scale, self._translate = (np.array(transform[name], np.float64) for name in ("scale", "translate"))
        np.zeros(3) * self._scale + self._translate  # both fit, or it is told here
        empty = file.seek(0, os.SEEK_END) == 0
        self._rows = np.empty((0, 3)) if empty else np.memmap(file, np.float64, "r").reshape(-1, 3)

    def __len__(self) -> int:
        return len(self._rows)

    def take(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Take vertices (k, 3) in metres."""
        return self.take_raw(rows) * self._scale + self._translate

    def take_raw(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Take vertices (k, 3) as the city model has them: whole numbers."""
        found: NDArray[np.float64] = self._rows[rows]
        return found


def copy_vertices(path: Path, vertex_file: IO[bytes]) -> Vertices:
    """Read all of a CityJSON file, in any layout, but its objects.

    The file is empty, and to be kept open as long as the vertices are used.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    OutputError
        If the file cannot be written.
    """
    try:
        head, large = read_members(path, ("transform", "metadata").__contains__)
        if head["type"] != "CityJSON" or head["version"] != CITYJSON:
            raise InputError(f"{path}: is no CityJSON {CITYJSON} file; run again")
        if large["vertices"] != "start_array" or large["CityObjects"] != "start_map":
            raise TypeError("vertices is no array, or CityObjects no object")
        elements = iterate_elements(path, "vertices")
        while rows := list(islice(elements, BLOCK)):
            data = _rows(rows)
            with _writing():
                vertex_file.write(data.data)
                vertex_file.flush()
        return Vertices(vertex_file, head)
    except WRONG_FIELD as error:
        raise broken_field(path, error) from None


@contextmanager
def _writing() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{gettempdir()}: no temporary file can be written ({error.strerror}); free space there or set TMPDIR"
        ) from error


def _rows(vertices: list[Any]) -> NDArray[np.float64]:
    rows = np.array(vertices, np.float64)
    if rows.shape != (len(vertices), 3):
        raise ValueError(f"vertices of shape {rows.shape[1:]}")
    return rows


def _read_objects(path: Path, vertices: Vertices, file: IO[bytes]) -> BuildingIndex:
    """Read the objects of a CityJSON file that have no parts, and write their heights and footprints."""
    numbers, boxes, starts, sizes = array("q"), array("f"), array("q"), array("i")
    start = 0
    for name, thing in read_objects(path):
        if has_parts(path, thing):
            continue
        row = read_building(path, name, thing, vertices)
        data = np.array([(row.ground, row.roof, row.plane)], HEAD).tobytes() + shapely.to_wkb(row.footprint)
        with _writing():
            file.write(data)
        numbers.append(row.number)
        boxes.extend(shapely.bounds(row.footprint).tolist())
        starts.append(start)
        sizes.append(len(data))
        start += len(data)
    order = np.argsort(np.frombuffer(numbers, np.int64), kind="stable")
    return BuildingIndex(
        np.frombuffer(numbers, np.int64)[order],
        np.frombuffer(boxes, np.float32).reshape(-1, 4)[order],
        np.frombuffer(starts, np.int64)[order],
        np.frombuffer(sizes, np.int32)[order],
        file,
    )


def read_objects(path: Path) -> Iterator[tuple[str, Any]]:
    """Read the objects of a CityJSON file one at a time, by name; InputError if it is missing or no JSON."""
    return iterate_members(path, "CityObjects")


def has_parts(path: Path, thing: Any) -> bool:
    """Tell a house that consists of parts from a building or part with a shape of its own."""
    try:
        return "children" in thing
    except TypeError as error:
        raise broken_field(path, error) from None


def read_building(path: Path, name: str, thing: Mapping[str, Any], vertices: Vertices) -> BuildingRow:
    """Take number, heights (m), roof and footprint of a building; InputError if one is missing or wrong."""
    try:
        values = thing["attributes"]
        if not 0 <= values["number"] < MAX_NUMBER:
            raise ValueError(f"number {values['number']}; bound: {MAX_NUMBER}")
        number, ground, roof = (
            int(values["number"]),
            float(values["ground_height"]),
            float(values["roof_height"]),
        )
        plane = _read_plane(values.get(PLANE), roof)
        (geometry,) = (part for part in thing["geometry"] if str(part["lod"]) == "0")
        surfaces = [_read_polygon(rings, vertices) for rings in geometry["boundaries"]]
    except (*WRONG_FIELD, shapely.GEOSException) as error:
        raise InputError(
            f"{path}: building {name!r}: a field is missing or wrong ({error!r}); run again"
        ) from None
    footprint = surfaces[0] if len(surfaces) == 1 else shapely.multipolygons(surfaces)
    return BuildingRow(number, ground, roof, plane, footprint)


def _read_plane(stated: Any, roof: float) -> tuple[float, ...]:
    """Make numbers of the attribute of a sloped roof; of one height where a building has none."""
    if stated is None:
        return 0.0, 0.0, roof, 0.0, 0.0, roof, roof
    plane = tuple(map(float, stated))
    if len(plane) != PLANE_VALUES or not all(map(isfinite, plane)) or not plane[5] <= roof <= plane[6]:
        raise ValueError(
            f"{PLANE} {stated} with roof_height {roof}; expected {PLANE_VALUES} numbers, the last two around it"
        )
    return plane


def _read_polygon(rings: list[list[int]], vertices: Vertices) -> Any:
    shell, *holes = (vertices.take(check_indices(ring, len(vertices)))[:, :2] for ring in rings)
    return shapely.Polygon(shell, holes)


def check_indices(ring: list[int], n_vertices: int) -> NDArray[np.int64]:
    """Make an array of a ring's vertices; IndexError if the city model has not so many."""
    indices = np.array(ring, np.int64)
    if indices.ndim != 1 or indices.min() < 0 or indices.max() >= n_vertices:
        raise IndexError(f"vertex {indices.min()}..{indices.max()} of {n_vertices}")
    return indices
