"""GeoPackage of the simplified footprints: a row a building, or part of one, with heights and all attributes."""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import date
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import pyogrio
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import OutputError
from tiler.citymodels.building_index import copy_vertices, has_parts, read_building, read_objects
from tiler.export.export import Format
from tiler.mesh_files.run_files import RUN_RECORD
from tiler.store.atomic import replacing
from tiler.store.out_folder import CITY_MODEL
from tiler.store.run_folder import read_crs

LAYER = "buildings"
BATCH = 5000  # rows that are written at once
# GeoPackage says when it was written; equal input gives equal bytes.
DAY = date(2000, 1, 1)
Kinds = dict[str, set[type]]
Column = tuple[NDArray[Any], NDArray[np.bool_] | None]  # values, and where there is none


def export_gpkg(output: Path, directory: Path) -> None:
    """Write the footprints of a finished run's simplified city model as GeoPackage.

    Parameters
    ----------
    output : Path
        The file; it appears whole or not at all.
    directory : Path
        Folder of the run.

    Raises
    ------
    InputError
        If the city model or the run's record is missing or damaged.
    OutputError
        If the file cannot be written.
    """
    crs = read_crs(directory / RUN_RECORD)
    with replacing(output) as part:
        write_gpkg(part, directory / CITY_MODEL, crs=crs)


def write_gpkg(path: Path, model: Path, *, crs: str) -> None:
    """Write the footprints of a CityJSON file as GeoPackage, layer `LAYER`.

    Parameters
    ----------
    path : Path
        The file; not there yet.
    model : Path
        CityJSON 2.0 of buildings with numbers, heights and LoD 0 footprints.
    crs : str
        CRS of its coordinates.

    Raises
    ------
    InputError
        If the city model is missing or damaged.
    OutputError
        If the file cannot be written.

    Notes
    -----
    ``id`` is the building's or part's, ``house`` that of the building; further columns are the attributes, lists
    as JSON text. The city model is read three times, an object at a time; memory holds `BATCH` rows.
    """
    kinds = _survey(model)
    with TemporaryFile() as vertex_file, fixed_time():
        vertices = copy_vertices(model, vertex_file)
        rows = (
            (name, thing, read_building(model, name, thing, vertices).footprint) for name, thing in _objects(model)
        )
        batch = list(islice(rows, BATCH))
        _append(path, batch, kinds, crs)
        while batch := list(islice(rows, BATCH)):
            _append(path, batch, kinds, crs, append=True)


def _objects(model: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    return ((name, thing) for name, thing in read_objects(model) if not has_parts(model, thing))


def _survey(model: Path) -> Kinds:
    """Find the attributes, and the types of their values."""
    kinds: Kinds = {}
    for _, thing in _objects(model):
        for name, value in thing.get("attributes", {}).items():
            kinds.setdefault(name, set()).add(type(value))
    return kinds


def _append(
    path: Path, rows: Sequence[tuple[str, Mapping[str, Any], Any]], kinds: Kinds, crs: str, *, append: bool = False
) -> None:
    ids = [name for name, _, _ in rows]
    houses = [thing["parents"][0] if thing.get("parents") else name for name, thing, _ in rows]
    columns: dict[str, Column] = {
        "id": (np.array(ids, np.object_), None),
        "house": (np.array(houses, np.object_), None),
    }
    for name, found in kinds.items():
        columns[name] = make_column([thing["attributes"].get(name) for _, thing, _ in rows], found)
    footprints = shapely.to_wkb(np.array([footprint for _, _, footprint in rows], np.object_))
    write_rows(path, footprints, columns, layer=LAYER, crs=crs, append=append)


def write_rows(
    path: Path,
    wkb: NDArray[np.object_],
    columns: Mapping[str, Column],
    *,
    layer: str,
    crs: str | None,
    kind: str = "Polygon",
    append: bool = False,
) -> None:
    """Write rows of a layer, or append them: geometries of one kind as WKB, and columns by name."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="'crs' was not provided")
            pyogrio.raw.write(
                path,
                wkb,
                [values for values, _ in columns.values()],
                list(columns),
                field_mask=[mask for _, mask in columns.values()],
                geometry_type=kind,
                crs=crs,
                layer=layer,
                driver="GPKG",
                append=append,
            )
    except (RuntimeError, ValueError) as error:  # pyogrio's own errors are RuntimeErrors
        # What GDAL says names the file.
        raise OutputError(
            f"GeoPackage cannot be written ({error}); free space or choose another folder"
        ) from error


def make_column(values: list[Any], kinds: set[type]) -> Column:
    """Make a column, and say where it has no value."""
    none = np.array([value is None for value in values], np.bool_)
    known = kinds - {type(None)}
    if known and known <= {int, float}:
        dtype: type = np.int64 if known == {int} else np.float64
        return np.array([0 if value is None else value for value in values], dtype), none
    texts = [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
    return np.array(texts, np.object_), None


@contextmanager
def fixed_time(day: date = DAY) -> Iterator[None]:
    """Let GDAL write one time of writing, midnight of a day, whenever that is."""
    time = {"OGR_CURRENT_DATE": f"{day.isoformat()}T00:00:00.000Z"}
    pyogrio.set_gdal_config_options(time)
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options(dict.fromkeys(time))


FORMAT = Format(
    "the simplified footprints with heights as GeoPackage",
    lambda path, files: export_gpkg(path, files.directory),
    suffix=".gpkg",
)
