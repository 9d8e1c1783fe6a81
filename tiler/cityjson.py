"""The city model as a CityJSON 2.0 file, and back (steps 1.7 and 2.4)."""

import json
import uuid
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray
from pyproj.exceptions import CRSError

from pipeline.citymodel import CityModel
from pipeline.errors import ConfigError, InputError
from pipeline.notes import Note
from pipeline.solids import Solids, build_solids
from tiler.atomic import replacing

# Coordinates are whole multiples of this length (m).
GRID = 0.001
# Attributes of every building; further columns may not take their names.
ATTRIBUTES = ("number", "ground_height", "roof_height", "height", "members")
GROUND, ROOF, WALL = range(3)
# Semantic surfaces of every solid, by the numbers above.
SURFACES = ("GroundSurface", "RoofSurface", "WallSurface")


def write_city_model(
    path: Path,
    model: CityModel,
    *,
    crs: str,
    bounds: Sequence[float],
    title: str = "",
    attributes: Mapping[str, Sequence[object]] | None = None,
) -> tuple[Note, ...]:
    """Write the buildings as CityJSON 2.0: LoD0 footprints and LoD1.2 solids.

    Parameters
    ----------
    path : Path
        File to write; it appears whole or not at all.
    model : CityModel
        The buildings. Each becomes a ``Building`` whose key is its id; the parts of a house become
        ``BuildingPart`` objects below a ``Building`` that has no geometry of its own.
    crs : str
        The region's CRS in any form that pyproj reads: ``"EPSG:28992"``, WKT.
    bounds : 6 floats
        Region ``(x0, y0, z0, x1, y1, z1)`` (m). The lower corner, floored, is the file's origin.
    title : str
        Title of the dataset; the file has none if empty.
    attributes : mapping of str to a sequence of n values
        Further attributes, one column each. NaN is written as null.

    Returns
    -------
    tuple of Note
        Those of `pipeline.solids.build_solids`: a building whose footprint is lost has no geometry in the
        file, a flat one has no solid. ``crs-without-epsg``: the file names no reference system.

    Raises
    ------
    ValueError
        If two buildings have one id, a footprint is not a Polygon, a height or bound is not finite,
        or a column of `attributes` has the wrong length or one of our names.
    ConfigError
        If pyproj does not know the CRS.
    OutputError
        If the file cannot be written.

    Notes
    -----
    Coordinates are rounded to 1 mm; the heights among the attributes are not. Equal input gives equal
    bytes: no clock is read, the identifier is a hash of the buildings. An empty model makes a valid file.

    References
    ----------
    CityJSON 2.0.1, https://www.cityjson.org/specs/2.0.1/
    """
    _check(model, bounds)
    columns = _columns(model, attributes or {})
    system = _reference_system(crs)
    origin = np.floor(np.asarray(bounds[:3], dtype=np.float64))
    solids, notes = build_solids(model, origin, grid=GRID)
    geometry = _geometry(solids)
    body = _text(
        {
            "CityObjects": _objects(model, columns, geometry),
            "vertices": solids.vertices.tolist(),
        }
    )
    metadata: dict[str, Any] = {
        "geographicalExtent": _extent(bounds, solids.vertices * GRID + origin),
        "identifier": str(uuid.uuid5(uuid.NAMESPACE_URL, body)),
    }
    if system is not None:
        metadata["referenceSystem"] = system
    else:
        notes = (*notes, Note("crs-without-epsg", detail=f"{crs}: the city model names no reference system"))
    if title:
        metadata["title"] = title
    head = _text(
        {
            "type": "CityJSON",
            "version": "2.0",
            "transform": {"scale": [GRID] * 3, "translate": origin.tolist()},
            "metadata": metadata,
        }
    )
    # Two objects become one, so that the buildings are turned into text only once.
    with replacing(path) as part:
        part.write_text(f"{head[:-1]},{body[1:]}\n", encoding="ascii")
    return notes


def read_city_model(path: Path) -> CityModel:
    """Read a file of `write_city_model`.

    Parameters
    ----------
    path : Path
        CityJSON file.

    Returns
    -------
    CityModel
        The buildings in the file's order: footprints with the file's 1 mm, all else as it was given. A
        building without geometry has an empty Polygon.

    Raises
    ------
    InputError
        If the file cannot be read or is not one of ours.
    """
    try:
        return _parse(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check path and permissions") from error
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise InputError(
            f"{path}: not a city model of citystitch ({type(error).__name__}: {error}); write it again"
        ) from error


def _objects(
    model: CityModel, columns: Mapping[str, Sequence[object]], geometry: Sequence[object]
) -> dict[str, dict[str, Any]]:
    """Make the city objects: a building a row, or a part of the house that the row names."""
    objects: dict[str, dict[str, Any]] = {}
    for i, (name, house) in enumerate(zip(model.ids.tolist(), model.house.tolist(), strict=True)):
        row: dict[str, Any] = {"type": "Building" if name == house else "BuildingPart"}
        row["attributes"] = {key: column[i] for key, column in columns.items()}
        row["geometry"] = geometry[i]
        if name != house:
            row["parents"] = [house]
            objects.setdefault(house, {"type": "Building", "children": []})["children"].append(name)
        objects[name] = row
    return objects


def _check(model: CityModel, bounds: Sequence[float]) -> None:
    names, counts = np.unique(model.ids, return_counts=True)
    if np.any(counts > 1):
        i = np.argmax(counts)
        raise ValueError(f"building {names[i]}: {counts[i]} buildings have this id, at most 1 may")
    mixed = np.intersect1d(model.ids, model.house[model.ids != model.house])
    if len(mixed):
        raise ValueError(f"building {mixed[0]}: is a row and has parts, it may be one of these")
    if len(bounds) != 6 or not np.all(np.isfinite(bounds)):
        raise ValueError(f"bounds {tuple(bounds)} must be 6 finite numbers")


def _columns(model: CityModel, extra: Mapping[str, Sequence[object]]) -> dict[str, list[object]]:
    """Gather the attributes by name, as values that JSON knows."""
    for name, column in extra.items():
        if name in ATTRIBUTES:
            raise ValueError(f"attribute {name!r} is one of ours; rename the column")
        if len(column) != len(model):
            raise ValueError(f"attribute {name!r} has {len(column)} values for {len(model)} buildings")
    own: tuple[Iterable[object], ...] = (
        model.numbers,
        model.ground,
        model.roof,
        model.roof - model.ground,
        [[str(name) for name in names] for names in model.members],
    )
    columns = {**dict(zip(ATTRIBUTES, own, strict=True)), **extra}
    return {name: [_plain(value) for value in column] for name, column in columns.items()}


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _reference_system(crs: str) -> str | None:
    """Name the CRS by its EPSG code as OGC does; None if it has no code."""
    try:
        code = pyproj.CRS.from_user_input(crs).to_epsg()
    except CRSError as error:
        raise ConfigError(f"CRS {crs!r}: unknown to pyproj; give a code such as EPSG:28992") from error
    return None if code is None else f"https://www.opengis.net/def/crs/EPSG/0/{code}"


def _extent(bounds: Sequence[float], points: NDArray[np.floating]) -> list[float]:
    """Box of the region, grown by the points beyond it."""
    box = np.asarray(bounds, dtype=np.float64).reshape(2, 3)
    low, high = np.vstack([box[:1], points]).min(axis=0), np.vstack([box[1:], points]).max(axis=0)
    return [round(float(value), 3) for value in (*low, *high)]


def _geometry(solids: Solids) -> list[list[dict[str, Any]]]:
    """Give the geometry objects of each building: its LoD0 and, if it has a solid, its LoD1.2."""
    floors, roofs = _surfaces(solids, solids.low), _surfaces(solids, solids.high)
    walls = solids.walls[:, None].tolist()
    wall_start = solids.ring_start[solids.building_start]
    geometry: list[list[dict[str, Any]]] = []
    for i, (floor, roof) in enumerate(zip(floors, roofs, strict=True)):
        objects: list[dict[str, Any]] = []
        if floor:
            objects.append({"type": "MultiSurface", "lod": "0", "boundaries": [floor]})
        if floor and solids.has_solid[i]:
            objects.append(_solid(floor, roof, walls[wall_start[i] : wall_start[i + 1]]))
        geometry.append(objects)
    return geometry


def _surfaces(solids: Solids, corners: NDArray[np.int64]) -> list[list[list[int]]]:
    """Nest the corners as rings of buildings."""
    flat, start, building = corners.tolist(), solids.ring_start.tolist(), solids.building_start.tolist()
    rings = [flat[a:b] for a, b in pairwise(start)]
    return [rings[a:b] for a, b in pairwise(building)]


def _solid(floor: list[list[int]], roof: list[list[int]], walls: list[list[list[int]]]) -> dict[str, Any]:
    """Put one closed shell together; the floor is turned over to look down."""
    return {
        "type": "Solid",
        "lod": "1.2",
        "boundaries": [[[ring[::-1] for ring in floor], roof, *walls]],
        "semantics": {
            "surfaces": [{"type": kind} for kind in SURFACES],
            "values": [[GROUND, ROOF] + [WALL] * len(walls)],
        },
    }


def _text(document: dict[str, Any]) -> str:
    return json.dumps(document, separators=(",", ":"), allow_nan=False)


def _parse(document: dict[str, Any]) -> CityModel:
    transform = document["transform"]
    vertices = np.array(document["vertices"], dtype=np.float64).reshape(-1, 3)[:, :2]
    vertices = vertices * transform["scale"][:2] + transform["translate"][:2]
    objects = {name: item for name, item in document["CityObjects"].items() if "children" not in item}
    rows = [item["attributes"] for item in objects.values()]
    polygons = np.empty(len(objects), dtype=np.object_)
    polygons[:] = [_footprint(item["geometry"], vertices) for item in objects.values()]
    return CityModel(
        polygons=polygons,
        ids=np.array(list(objects), dtype=np.str_),
        numbers=np.array([row["number"] for row in rows], dtype=np.int64),
        ground=np.array([row["ground_height"] for row in rows], dtype=np.float64),
        roof=np.array([row["roof_height"] for row in rows], dtype=np.float64),
        members=tuple(tuple(row["members"]) for row in rows),
        house=np.array([item.get("parents", [name])[0] for name, item in objects.items()], dtype=np.str_),
    )


def _footprint(geometry: list[dict[str, Any]], xy: NDArray[np.float64]) -> shapely.Polygon:
    for item in geometry:
        if item["lod"] == "0":
            shell, *holes = (xy[ring] for ring in item["boundaries"][0])
            return shapely.Polygon(shell, holes)
    return shapely.Polygon()
