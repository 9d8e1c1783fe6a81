"""What a run folder says about itself: its record, its buildings, its volume pieces."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.mesh import TetMesh

SCHEMA = 1  # of run.json
CITYJSON = "2.0"
MAX_NUMBER = 2**53  # of a building
# How a field that is missing, or of another type, or too large, shows when it is used.
WRONG_FIELD = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)


@dataclass(frozen=True)
class RunRecord:
    """The part of ``run.json`` that the files can be held against.

    Attributes
    ----------
    status : str
        ``"done"`` when every tile is.
    bounds : tuple of 4 floats
        West, south, east and north border of the region (m).
    top : float
        Absolute height of the top (m) where the mesher makes it flat, NaN where it does not.
    counts : mapping of str to int
        ``cells``, ``points``, ``facets`` and ``buildings``.
    """

    status: str
    bounds: tuple[float, float, float, float]
    top: float
    counts: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class Buildings:
    """The buildings of a CityJSON file, by ascending number.

    Attributes
    ----------
    numbers : int64, (n,)
        Attribute ``number``: what the boundary's array ``building`` refers to.
    footprints : object, (n,)
        shapely Polygons, or MultiPolygons where the file has several surfaces (m).
    ground, roof : float64, (n,)
        Attributes ``ground_height`` and ``roof_height``, absolute (m).
    """

    numbers: NDArray[np.int64]
    footprints: NDArray[np.object_]
    ground: NDArray[np.float64]
    roof: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.numbers)

    @cached_property
    def tree(self) -> shapely.STRtree:
        """Footprints by place."""
        return shapely.STRtree(self.footprints)


def read_run_record(path: Path) -> RunRecord:
    """Read ``run.json``.

    Raises
    ------
    InputError
        If it is missing or damaged, or has another schema.
    """
    record = _read_json(path)
    try:
        if record["schema"] != SCHEMA:
            raise InputError(f"{path}: schema {record['schema']!r}, expected {SCHEMA}; run again")
        if record["status"] == "failed":
            raise InputError(f"{path}: the run failed ({record['error']}); mend that and run again")
        if "region" not in record:
            raise InputError(f"{path}: the run is {record['status']} and has no mesh yet; wait, or run again")
        west, south, east, north = (float(value) for value in record["region"]["bounds"])
        top = float(record["region"].get("top", math.nan))
        names = ("cells", "points", "facets", "buildings")
        counts = {name: int(record["counts"][name]) for name in names}
        status = str(record["status"])
    except WRONG_FIELD as error:
        raise _broken(path, error) from None
    if not (west < east and south < north and math.isfinite(west + south + east + north)):
        raise InputError(f"{path}: region bounds {west, south, east, north} are no box; run again")
    return RunRecord(status, (west, south, east, north), top, counts)


def read_buildings(path: Path) -> Buildings:
    """Read the buildings of a CityJSON file, or their parts: numbers, heights and LoD 0 footprints.

    Raises
    ------
    InputError
        If the file is missing or damaged, or a building lacks one of these or shares its number.
    """
    model = _read_json(path)
    try:
        if model["type"] != "CityJSON" or model["version"] != CITYJSON:
            raise InputError(f"{path}: is no CityJSON {CITYJSON} file; run again")
        transform = model["transform"]
        vertices = np.array(model["vertices"], np.float64).reshape(-1, 3)
        vertices = vertices * np.array(transform["scale"]) + np.array(transform["translate"])
        objects = [(name, thing) for name, thing in model["CityObjects"].items() if "children" not in thing]
    except WRONG_FIELD as error:
        raise _broken(path, error) from None
    rows = [_read_building(path, name, thing, vertices) for name, thing in objects]
    order = sorted(range(len(rows)), key=lambda i: rows[i][0])
    numbers = np.array([rows[i][0] for i in order], np.int64)
    if np.any(numbers[1:] == numbers[:-1]):
        raise InputError(f"{path}: two buildings have one number; give each its own id and run again")
    footprints = np.empty(len(rows), np.object_)
    footprints[:] = [rows[i][3] for i in order]
    ground, roof = (np.array([rows[i][k] for i in order], np.float64) for k in (1, 2))
    return Buildings(numbers, footprints, ground, roof)


def read_volume(path: Path) -> TetMesh:
    """Read a VTU piece with meshio: a reader that is not ours.

    Raises
    ------
    InputError
        If meshio cannot read it, or if it holds something else than finite points and tetrahedra.

    Notes
    -----
    meshio takes some 130 bytes a cell for a moment.
    """
    try:
        mesh = meshio.vtu.read(str(path))
    # A damaged file shows in many ways, SystemExit among them.
    except (Exception, SystemExit) as error:
        raise InputError(
            f"{path}: meshio cannot read it ({type(error).__name__}: {error}); run the tile again"
        ) from None
    blocks = [block.data for block in mesh.cells if block.type == "tetra"]
    if len(blocks) != len(mesh.cells) or mesh.points.ndim != 2 or mesh.points.shape[1] != 3:
        kinds = ", ".join(block.type for block in mesh.cells)
        raise InputError(f"{path}: holds {kinds}, not tetrahedra; run the tile again")
    cells = np.concatenate(blocks) if blocks else np.empty((0, 4), np.int64)
    if cells.size and (cells.min() < 0 or cells.max() >= len(mesh.points)):
        raise InputError(
            f"{path}: vertex {cells.min()}..{cells.max()} of {len(mesh.points)} points; run the tile again"
        )
    if not np.isfinite(mesh.points).all():
        raise InputError(f"{path}: a coordinate is not finite; run the tile again")
    return TetMesh(mesh.points.astype(np.float64, copy=False), cells.astype(np.int32))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); run again") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({error}); run again") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: is no JSON object; run again")
    return content


def _broken(path: Path, error: Exception) -> InputError:
    return InputError(f"{path}: a field is missing or wrong ({error!r}); run again")


def _read_building(
    path: Path, name: str, thing: Mapping[str, Any], vertices: NDArray[np.float64]
) -> tuple[int, float, float, Any]:
    try:
        values = thing["attributes"]
        if not 0 <= values["number"] < MAX_NUMBER:
            raise ValueError(f"number {values['number']}; bound: {MAX_NUMBER}")
        number, ground, roof = (
            int(values["number"]),
            float(values["ground_height"]),
            float(values["roof_height"]),
        )
        (geometry,) = (part for part in thing["geometry"] if str(part["lod"]) == "0")
        surfaces = [_read_polygon(rings, vertices) for rings in geometry["boundaries"]]
    except (*WRONG_FIELD, shapely.GEOSException) as error:
        raise InputError(
            f"{path}: building {name!r}: a field is missing or wrong ({error!r}); run again"
        ) from None
    return number, ground, roof, surfaces[0] if len(surfaces) == 1 else shapely.multipolygons(surfaces)


def _read_polygon(rings: list[list[int]], vertices: NDArray[np.float64]) -> Any:
    shell, *holes = (vertices[_checked(ring, len(vertices)), :2] for ring in rings)
    return shapely.Polygon(shell, holes)


def _checked(ring: list[int], n_vertices: int) -> NDArray[np.int64]:
    indices = np.array(ring, np.int64)
    if indices.ndim != 1 or indices.min() < 0 or indices.max() >= n_vertices:
        raise IndexError(f"vertex {indices.min()}..{indices.max()} of {n_vertices}")
    return indices
