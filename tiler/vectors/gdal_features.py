"""Features of a layer read by GDAL: by batches, and around those that cannot be read (step 1.2)."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from tiler.vectors.features import Box, Features, decode_text, to_objects
from tiler.vectors.gdal_layer import GdalLayer, ask_gpkg, gdal_as_input_error, quote
from tiler.vectors.shapefile import find_near_shapes, is_null_shape, is_shapefile

MOST_BROKEN = 100  # features whose reading fails; of a file with more the storage is damaged
_FEWER = 8  # times smaller a slice is read where one fails
_ASKED = 500  # features that are asked for at once


def scan_features(
    layer: GdalLayer, columns: Sequence[str], box: Box | None, *, geometry: bool, batch: int
) -> Iterator[Features]:
    """Read the features of a layer by batches.

    Parameters
    ----------
    layer : GdalLayer
        From `open_layer`.
    columns : sequence of str
        Attributes to read.
    box : tuple of 4 floats, or None
        Features away from it may be left out; those whose place is unknown are not. None for all features.
    geometry : bool
        False leaves the geometries out: None in every row.
    batch : int
        Features in memory at once.

    Yields
    ------
    Features

    Raises
    ------
    InputError
        If the file is damaged: it cannot be opened, or more than `MOST_BROKEN` features cannot be read.

    Notes
    -----
    The index of a GeoPackage is asked by SQL, as GDAL drops what it cannot parse where it is given a box; features
    that the index does not know are read too. Other files are read by query where they have an index, else from
    end to end. Batches are streamed by Arrow. Without pyarrow the features come as one batch, with arcs that GDAL
    has made segments of 4 degrees.
    """
    filters = _filter(layer, box)
    if "bbox" in filters and geometry and is_shapefile(layer.path):
        yield from _scan_shapefile(layer, columns, batch, filters["bbox"])
        return
    yield from _scan(layer, columns, geometry, batch, filters)


def _scan_shapefile(layer: GdalLayer, columns: Sequence[str], batch: int, box: Box) -> Iterator[Features]:
    """Read by a box, and then what the file's own boxes have there and GDAL did not give, as it is damaged."""
    given = [np.empty(0, np.int64)]
    for part in _scan(layer, columns, True, batch, {"bbox": box}):
        given.append(part.fids)
        yield part
    missing = np.setdiff1d(find_near_shapes(layer.path, box), np.concatenate(given))
    for row in missing.tolist():
        try:
            for part in _read_slice(layer, columns, True, batch, {"fids": [row]}):
                yield _find_broken(layer, part)
        except InputError as error:
            yield _no_feature(columns, row, str(error))


def _scan(
    layer: GdalLayer, columns: Sequence[str], geometry: bool, batch: int, filters: dict[str, Any]
) -> Iterator[Features]:
    read = _read_slice if find_spec("pyarrow") is None else _stream_slice
    done = 0
    try:
        for part in read(layer, columns, geometry, batch, filters):
            done += len(part.wkb)
            yield _find_broken(layer, part) if geometry else part
        return
    except InputError as error:
        failed = error
    for part in _scan_around(layer, columns, geometry, batch, filters | {"skip_features": done}, failed):
        yield _find_broken(layer, part) if geometry else part


def check_readable(layer: GdalLayer) -> None:
    """Read a layer that gave fewer features than it claims in the slow way, which tells of damage.

    A stream of GDAL ends at a damaged page of a GPKG without a word. The number that a layer claims may be
    stale too, and that is no damage.
    """
    import pyogrio

    with gdal_as_input_error(layer.path, []):
        pyogrio.raw.read(
            layer.source, layer=layer.name, columns=[], read_geometry=False, return_fids=True, **layer.options
        )


def _filter(layer: GdalLayer, box: Box | None) -> dict[str, Any]:
    """Give the options of pyogrio that leave features out which are away from a box."""
    if box is None or isinstance(layer.source, bytes):
        return {}
    if layer.index and layer.fid_name:
        fid, table, rows = quote(layer.fid_name), quote(layer.index), quote(f"{layer.index}_rowid")
        xmin, ymin, xmax, ymax = box
        near = f"maxx >= {xmin!r} AND minx <= {xmax!r} AND maxy >= {ymin!r} AND miny <= {ymax!r}"
        unknown = f"NOT EXISTS (SELECT 1 FROM {rows} AS known WHERE known.rowid = {fid})"
        return {"where": f"{fid} IN (SELECT id FROM {table} WHERE {near}) OR {unknown}"}
    by_box = is_shapefile(layer.path) or layer.info["capabilities"]["fast_spatial_filter"]
    if layer.driver != "GPKG" and by_box:
        return {"bbox": box}
    return {}


def _stream_slice(
    layer: GdalLayer, columns: Sequence[str], geometry: bool, batch: int, filters: dict[str, Any]
) -> Iterator[Features]:
    """Read by Arrow, whose streams know no `max_features`: of a slice the first batch is taken."""
    import pyogrio

    given = {name: value for name, value in filters.items() if name != "max_features"}
    with ExitStack() as stack:
        warned: list[str] = []
        with gdal_as_input_error(layer.path, warned):
            stream = pyogrio.raw.open_arrow(
                layer.source,
                layer=layer.name,
                columns=list(columns),
                read_geometry=geometry,
                return_fids=True,
                batch_size=batch,
                use_pyarrow=True,
                **given,
                **_options(layer),
            )
            meta, reader = stack.enter_context(stream)
        while True:
            with gdal_as_input_error(layer.path, warned):
                part = next(reader, None)  # no warning may be caught, and no error be turned, across a yield
                lists = [] if part is None else [_to_list(column, warned) for column in part.columns]
            if part is None:
                break
            names = [str(name) for name in meta["fields"]]  # in the stream behind the number, before the geometry
            wkb = to_objects(lists[-1]) if geometry else np.full(part.num_rows, None, np.object_)
            values = dict(zip(names, map(to_objects, lists[1:]), strict=False))
            yield Features(wkb, values, tuple(dict.fromkeys(warned)), np.array(lists[0], np.int64), {})
            warned.clear()
            if len(given) < len(filters):
                return
    if warned:
        yield _no_features(columns, tuple(warned))


def _read_slice(
    layer: GdalLayer, columns: Sequence[str], geometry: bool, _batch: int, filters: dict[str, Any]
) -> Iterator[Features]:
    import pyogrio

    def read(encoding: str | None) -> tuple[dict[str, Any], Any, Any, list[Any]]:
        found: tuple[dict[str, Any], Any, Any, list[Any]] = pyogrio.raw.read(
            layer.source,
            layer=layer.name,
            columns=list(columns),
            read_geometry=geometry,
            return_fids=True,
            force_2d=False,
            encoding=encoding,
            **filters,
            **_options(layer),
        )
        return found

    warned: list[str] = []
    with gdal_as_input_error(layer.path, warned):
        try:
            encoding = None
            meta, fids, wkb, values = read(encoding)
        except UnicodeDecodeError:
            encoding = "ISO-8859-1"
            meta, fids, wkb, values = read(encoding)
    if "ISO-8859-1" in (
        encoding,
        layer.info["encoding"],
    ):  # each byte a letter: what GDAL takes where none is stated
        values = [to_objects([_decode_again(value, warned) for value in column]) for column in values]
    found = dict(zip((str(name) for name in meta["fields"]), values, strict=True))
    wkb = wkb if geometry else np.full(len(fids), None, np.object_)
    yield Features(wkb, found, tuple(dict.fromkeys(warned)), fids.astype(np.int64), {})


def _scan_around(
    layer: GdalLayer,
    columns: Sequence[str],
    geometry: bool,
    batch: int,
    filters: dict[str, Any],
    error: InputError,
) -> Iterator[Features]:
    """Read in slices that become smaller until they hold but the feature whose reading fails."""
    read = _read_slice if find_spec("pyarrow") is None else _stream_slice
    first, size, n_broken, n_read = filters.get("skip_features", 0), batch, 0, filters.get("skip_features", 0)
    while True:
        try:
            limits = {"skip_features": first, "max_features": size}
            parts = list(read(layer, columns, geometry, size, filters | limits))
        except InputError as failed:
            if size > 1:
                size = max(size // _FEWER, 1)
                continue
            n_broken += 1
            if n_broken > MOST_BROKEN:
                raise error from failed
            yield _no_feature(columns, first, str(failed))
            first += 1
            continue
        yield from parts
        n = sum(len(part.wkb) for part in parts)
        first, n_read = first + n, n_read + n
        if n == 0:
            break
        size = min(size * _FEWER, batch)
    if n_read == 0:
        raise error


def _no_features(columns: Sequence[str], warned: tuple[str, ...]) -> Features:
    nothing = np.empty(0, np.object_)
    return Features(nothing, dict.fromkeys(columns, nothing), warned, np.empty(0, np.int64), {})


def _no_feature(columns: Sequence[str], row: int, reason: str) -> Features:
    nothing = np.full(1, None, np.object_)
    return Features(nothing, dict.fromkeys(columns, nothing), (), np.array([row], np.int64), {0: reason})


def _options(layer: GdalLayer) -> dict[str, str]:
    return {} if isinstance(layer.source, bytes) else layer.options


def _to_list(column: Any, warned: list[str]) -> list[Any]:
    """Give the values of a column; text is decoded here: that of a file without an encoding comes as it is."""
    import pyarrow as pa

    if pa.types.is_string(column.type):
        return [decode_text(value, warned) for value in column.cast(pa.binary()).to_pylist()]
    if pa.types.is_large_string(column.type):
        return [decode_text(value, warned) for value in column.cast(pa.large_binary()).to_pylist()]
    values: list[Any] = column.to_pylist()
    return values


def _decode_again(value: Any, warned: list[str]) -> Any:
    return decode_text(value.encode("latin-1", errors="replace"), warned) if isinstance(value, str) else value


def _find_broken(layer: GdalLayer, part: Features) -> Features:
    """Tell the features without a geometry from those whose geometry cannot be read."""
    rows = np.array(
        [row for row, blob in enumerate(part.wkb) if blob is None and row not in part.broken], np.int64
    )
    if not len(rows):
        return part
    reason = "its geometry cannot be parsed"
    fids = part.fids[rows]
    if is_shapefile(layer.path):
        broken = ~is_null_shape(layer.path, fids)
    elif layer.driver == "GPKG" and layer.geometry_name and layer.fid_name:
        broken = np.isin(fids, _fids_with_geometry(layer, fids))
    else:
        # The others do not tell; a GeoJSON without a geometry is seldom meant.
        broken = np.full(len(rows), "json" in layer.driver.lower())
        reason = "has no geometry, or one that cannot be parsed"
    found = {int(row): reason for row in rows[broken]}
    return Features(part.wkb, part.columns, part.warned, part.fids, part.broken | found)


def _fids_with_geometry(layer: GdalLayer, fids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Give those of features of a GeoPackage that have something in their geometry column."""
    fid, column, table = (quote(name) for name in (layer.fid_name, layer.geometry_name, layer.name))
    found: list[str] = []
    with gdal_as_input_error(layer.path, []):
        for first in range(0, len(fids), _ASKED):
            some = ", ".join(map(str, fids[first : first + _ASKED].tolist()))
            where = f"{column} IS NOT NULL AND {fid} IN ({some})"
            found += ask_gpkg(layer.path, f"SELECT CAST({fid} AS TEXT) AS number FROM {table} WHERE {where}")
    return np.array(found, np.int64)
