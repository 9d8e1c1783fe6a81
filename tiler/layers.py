"""Vector files: what a layer says about itself, and its features within a box (step 1.2).

pyogrio is imported where it is used: few tasks need it, and it brings pyarrow, where that is there, whose memory
has a thread of its own; a process is forked while it has one thread alone (`tiler.fork_server`).
"""

import os
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

from pipeline.errors import ConfigError, InputError
from tiler import geoparquet
from tiler.objects.local_copy import local_copy
from tiler.places import in_bucket
from tiler.vector_forms import check_form, read_head

Box = tuple[float, float, float, float]

BATCH = 50_000  # features in memory at once

_NAMED = 20  # layers or fields that a message lists


@dataclass(frozen=True)
class Layer:
    """What one layer of a vector file says about itself.

    Attributes
    ----------
    path : Path
        The file.
    name : str
        Name of the layer; ``""`` for Parquet, which has one.
    crs : pyproj.CRS or None
        As stated, None if not.
    fields : tuple of str
        Names of the attributes.
    n_features : int
        Number of features; -1 if the driver would have to read them all to know.
    extent : tuple of 4 floats, or None
        xmin, ymin, xmax, ymax in the file's CRS; None if unknown or if there are no features.
    """

    path: Path
    name: str
    crs: pyproj.CRS | None
    fields: tuple[str, ...]
    n_features: int
    extent: Box | None


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a layer as they are stored.

    Attributes
    ----------
    wkb : object, (n,)
        Geometries as well-known binary (bytes); None where there is none.
    columns : dict of str to (n,) arrays
        Values of the attributes that were asked for.
    warned : tuple of str
        What the reader warned of, each once.
    """

    wkb: NDArray[np.object_]
    columns: dict[str, NDArray[Any]]
    warned: tuple[str, ...]


def describe_layer(path: Path, layer: str = "") -> Layer:
    """Describe a layer without reading its features.

    Parameters
    ----------
    path : Path
        SHP, GPKG, GeoJSON, FlatGeobuf or GeoParquet; see `check_form`. Of an object, Parquet is read by ranges;
        all others are fetched first.
    layer : str
        Name of the layer; ``""`` for the only one that has geometries.

    Returns
    -------
    Layer

    Raises
    ------
    InputError
        If the file is missing, damaged, or has no layer with geometries.
    ConfigError
        If the layer does not exist, or if there are several and none is named.
    """
    if not geoparquet.is_parquet(path):
        path = local_copy(path)
    if not in_bucket(path) and not os.path.exists(path):  # Path.exists raises where a name is too long
        raise InputError(f"{path}: no such file; check the path of the footprints")
    if geoparquet.is_parquet(path):
        if layer:
            raise ConfigError(f"{path}: Parquet has no layers, but layer {layer!r} is asked for; leave it out")
        read_head(path)
        return Layer(path, "", *geoparquet.describe(path))
    check_form(path)
    _check_shapefile(path)
    import pyogrio

    with _gdal_as_input_error(path, []):
        table = pyogrio.list_layers(path)
        name = _choose(path, [str(row[0]) for row in table if row[1] is not None], layer)
        info = pyogrio.read_info(path, layer=name)
    return Layer(
        path,
        name,
        _parse(path, info["crs"]),
        tuple(str(field) for field in info["fields"]),
        int(info["features"]),
        _finite_box(info["total_bounds"]),
    )


def scan_layer(
    layer: Layer, columns: Sequence[str], box: Box | None, *, geometry: bool = True, batch: int = BATCH
) -> Iterator[Features]:
    """Read the features of a layer whose bounding boxes meet a box, once, by batches.

    Parameters
    ----------
    layer : Layer
        From `describe_layer`.
    columns : sequence of str
        Attributes to read.
    box : tuple of 4 floats, or None
        xmin, ymin, xmax, ymax in the file's CRS; None for all features.
    geometry : bool
        False leaves the geometries out: None in every row.
    batch : int
        Features in memory at once.

    Yields
    ------
    Features
        In the order of the file or of its spatial index. Features without geometry have no place and may be
        absent.

    Raises
    ------
    InputError
        If the file is damaged.

    Notes
    -----
    A file with a spatial index is read by query, another from end to end. Batches are streamed by Arrow.
    Without pyarrow the features come as one batch: the same ones, with the memory of all of them.
    """
    if geoparquet.is_parquet(layer.path):
        for wkb, values in geoparquet.scan(layer.path, columns, box, geometry=geometry, batch=batch):
            yield Features(wkb, values, ())
        return
    if box is not None and layer.extent is not None and _holds(box, layer.extent):
        box = None  # all features: then their number is known, and can be checked
    n_read = 0
    read = _read_at_once if find_spec("pyarrow") is None else _stream
    for features in read(layer, columns, box, geometry, batch):
        n_read += len(features.wkb)
        yield features
    if box is None and n_read < layer.n_features:
        _check_readable(layer)


def list_some(names: Sequence[str]) -> str:
    """List names for a message: the first twenty, and how many more."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return (", ".join(names[:_NAMED]) or "none") + more


def _stream(
    layer: Layer, columns: Sequence[str], box: Box | None, geometry: bool, batch: int
) -> Iterator[Features]:
    import pyogrio

    with ExitStack() as stack:
        warned: list[str] = []
        with _gdal_as_input_error(layer.path, warned):
            stream = pyogrio.raw.open_arrow(
                layer.path,
                layer=layer.name,
                columns=list(columns),
                bbox=box,
                read_geometry=geometry,
                batch_size=batch,
                use_pyarrow=True,
            )
            meta, reader = stack.enter_context(stream)
        while True:
            with _gdal_as_input_error(layer.path, warned):
                part = next(reader, None)  # no warning may be caught, and no error be turned, across a yield
                columns_read = [] if part is None else [column.to_pylist() for column in part.columns]
            if part is None:
                break
            lists = [geoparquet.to_objects(column) for column in columns_read]
            names = [str(name) for name in meta["fields"]]  # in the order of the stream, the geometry behind them
            wkb = lists[-1] if geometry else np.full(part.num_rows, None, np.object_)
            yield Features(wkb, dict(zip(names, lists, strict=False)), tuple(dict.fromkeys(warned)))
            warned.clear()
    if warned:
        yield Features(np.empty(0, np.object_), {name: np.empty(0, np.object_) for name in columns}, tuple(warned))


def _read_at_once(
    layer: Layer, columns: Sequence[str], box: Box | None, geometry: bool, _batch: int
) -> Iterator[Features]:
    import pyogrio

    warned: list[str] = []
    with _gdal_as_input_error(layer.path, warned):
        meta, fids, wkb, values = pyogrio.raw.read(
            layer.path,
            layer=layer.name,
            columns=list(columns),
            bbox=box,
            read_geometry=geometry,
            return_fids=True,
            force_2d=True,
        )
    found = dict(zip((str(name) for name in meta["fields"]), values, strict=True))
    yield Features(wkb if geometry else np.full(len(fids), None, np.object_), found, tuple(dict.fromkeys(warned)))


def _check_readable(layer: Layer) -> None:
    """Read a layer that gave fewer features than it claims in the slow way, which tells of damage.

    A stream of GDAL ends at a damaged page of a GPKG without a word. The number that a layer claims may be
    stale too, and that is no damage.
    """
    import pyogrio

    with _gdal_as_input_error(layer.path, []):
        pyogrio.raw.read(layer.path, layer=layer.name, columns=[], read_geometry=False, return_fids=True)


def _holds(box: Box, extent: Box) -> bool:
    low = box[0] <= extent[0] and box[1] <= extent[1]
    return low and box[2] >= extent[2] and box[3] >= extent[3]


def _choose(path: Path, spatial: list[str], asked: str) -> str:
    if asked and asked not in spatial:
        raise ConfigError(f"{path}: has no layer {asked!r}; its layers are: {list_some(spatial)}")
    if not spatial:
        raise InputError(f"{path}: has no layer with geometries; give a file with footprint polygons")
    if not asked and len(spatial) > 1:
        raise ConfigError(f"{path}: has {len(spatial)} layers; name one of them: {list_some(spatial)}")
    return asked or spatial[0]


def _finite_box(extent: Sequence[float] | None) -> Box | None:
    if extent is None or not np.isfinite(extent).all():
        return None
    xmin, ymin, xmax, ymax = (float(value) for value in extent)
    return xmin, ymin, xmax, ymax


def _parse(path: Path, text: str | None) -> pyproj.CRS | None:
    if text is None:
        return None
    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as error:
        raise InputError(
            f"{path}: its CRS cannot be parsed ({text[:60]!r}...); write it anew: "
            f'ogr2ogr -a_srs EPSG:<code> mended.gpkg "{path}"'
        ) from error


def _check_shapefile(path: Path) -> None:
    """Compare the size of .shp and .dbf with their headers: GDAL reads what was cut off as no geometry."""
    if path.suffix.lower() != ".shp":
        return
    claims = []
    with path.open("rb") as file:
        head = file.read(28)
        if len(head) == 28:
            claims.append((path, 2 * struct.unpack_from(">i", head, 24)[0]))
    for table in (path.with_suffix(".dbf"), path.with_suffix(".DBF")):
        if table.is_file() and table.stat().st_size >= 12:
            with table.open("rb") as file:
                n_rows, n_head, n_row = struct.unpack_from("<IHH", file.read(12), 4)
            claims.append((table, n_head + n_rows * n_row))
    for part, claimed in claims:
        size = part.stat().st_size
        if size < claimed:
            raise InputError(f"{part}: has {size} of the {claimed} bytes that its header claims; copy it again")


@contextmanager
def _gdal_as_input_error(path: Path, warned: list[str]) -> Iterator[None]:
    """Turn what GDAL says into an InputError, and collect what it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except (RuntimeError, ValueError, OSError) as error:  # pyogrio's own errors are RuntimeErrors
            move = "check that it is a vector file and complete, or copy it again"
            if path.suffix.lower() == ".shp":
                move = "copy its .shp, .shx, .dbf and .prj together, or make the index anew: "
                move += f'ogr2ogr --config SHAPE_RESTORE_SHX YES mended.gpkg "{path}"'
            raise InputError(f"{path}: cannot be read ({error}); {move}") from error
    warned.extend(str(item.message) for item in caught)
