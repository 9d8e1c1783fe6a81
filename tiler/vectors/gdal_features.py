"""Features of a layer read by GDAL: by batches, and around those that cannot be read (step 1.2)."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.vectors.features import Box, Features, decode_text, to_objects
from tiler.vectors.gdal_layer import GdalLayer, ask_gpkg, gdal_as_input_error, quote
from tiler.vectors.shapefile import is_null_shape, is_shapefile
from tiler.vectors.wkb import is_curve, parse_wkb

MOST_BROKEN = 100  # features whose reading fails; of a file with more the storage is damaged
_FEWER = 8  # times smaller batches are where one fails
_ASKED = 500  # features that are asked for at once
_UNREADABLE = "its geometry cannot be parsed"


def scan_features(
    layer: GdalLayer, columns: Sequence[str], box: Box | None, *, geometry: bool, batch: int
) -> Iterator[Features]:
    """Read the features of a layer by batches, which GDAL streams by Arrow; parameters as of `layers.scan_layer`.

    Features whose place is unknown are among those of a box.

    Raises
    ------
    InputError
        If the file is damaged: it cannot be opened, or more than `MOST_BROKEN` features cannot be read.

    Notes
    -----
    The index of a GeoPackage is asked by SQL, as GDAL drops what it cannot parse where it is given a box; features
    that the index does not know are read too. Other files are read by query where they have an index, else from
    end to end. Where a batch fails, smaller ones are read, down to the feature that cannot be.
    """
    filters = _filter(layer, box)
    first, n_read, size = 0, 0, batch
    failed: InputError | None = None
    while True:
        try:
            for part in _stream(layer, columns, geometry, size, filters | {"skip_features": first}):
                first, n_read = first + len(part.wkb), n_read + len(part.wkb)
                yield _complete(layer, part) if geometry else part
            break
        except InputError as error:
            failed = failed or error
            if size > 1:
                size = max(size // _FEWER, 1)
                continue
            if first - n_read == MOST_BROKEN:
                raise failed from error
            nothing = np.full(1, None, np.object_)
            values = dict.fromkeys(columns, nothing)
            yield Features(nothing, values, (), np.array([first], np.int64), {0: str(error)})
            first, size = first + 1, batch
    if failed is not None and n_read == 0:
        raise failed


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
    if box is None or isinstance(layer.source, bytes) or not layer.info["capabilities"]["fast_spatial_filter"]:
        return {}
    if layer.driver != "GPKG":
        return {} if is_shapefile(layer.path) else {"bbox": box}  # of a damaged shape a box says nothing
    tree = f"rtree_{layer.name}_{layer.geometry_name}"
    fid, table, rows = quote(layer.fid_name), quote(tree), quote(f"{tree}_rowid")
    xmin, ymin, xmax, ymax = box
    near = f"maxx >= {xmin!r} AND minx <= {xmax!r} AND maxy >= {ymin!r} AND miny <= {ymax!r}"
    unknown = f"NOT EXISTS (SELECT 1 FROM {rows} AS known WHERE known.rowid = {fid})"
    return {"where": f"{fid} IN (SELECT id FROM {table} WHERE {near}) OR {unknown}"}


def _stream(
    layer: GdalLayer, columns: Sequence[str], geometry: bool, batch: int, filters: dict[str, Any]
) -> Iterator[Features]:
    import pyogrio

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
                **filters,
                **layer.options,
            )
            meta, reader = stack.enter_context(stream)
        names = [str(name) for name in meta["fields"]]  # in the stream behind the number, before the geometry
        ended = False
        while not ended:
            with gdal_as_input_error(layer.path, warned):
                part = next(reader, None)  # no warning may be caught, and no error be turned, across a yield
                lists = [] if part is None else [_to_list(column, warned) for column in part.columns]
            ended = part is None
            if ended and not warned:
                return
            fids, *values = lists or [[] for _ in (0, *names)]
            wkb = to_objects(values[-1]) if geometry and not ended else np.full(len(fids), None, np.object_)
            found = dict(zip(names, map(to_objects, values), strict=False))
            yield Features(wkb, found, tuple(dict.fromkeys(warned)), np.array(fids, np.int64), {})
            warned.clear()


def _to_list(column: Any, warned: list[str]) -> list[Any]:
    """Give the values of a column; text is decoded here: that of a file without an encoding comes as it is."""
    import pyarrow as pa

    if pa.types.is_string(column.type):
        return [decode_text(value, warned) for value in column.view(pa.binary()).to_pylist()]
    if pa.types.is_large_string(column.type):
        return [decode_text(value, warned) for value in column.view(pa.large_binary()).to_pylist()]
    values: list[Any] = column.to_pylist()
    return values


def _complete(layer: GdalLayer, part: Features) -> Features:
    """Make arcs segments, and tell the features without a geometry from those whose geometry cannot be read."""
    wkb, broken = part.wkb.copy(), dict[int, str]()
    curved = np.flatnonzero([is_curve(blob) for blob in wkb])
    if len(curved):
        wkb[curved] = _read_straight(layer, part.fids[curved])
        broken = {row: f"{_UNREADABLE}: a curve" for row in curved.tolist() if wkb[row] is None}
    missing = np.flatnonzero([blob is None for blob in part.wkb])
    if len(missing):
        fids, reason = part.fids[missing], _UNREADABLE
        if is_shapefile(layer.path):
            wrong = ~is_null_shape(layer.path, fids)
        elif layer.driver == "GPKG" and layer.geometry_name and layer.fid_name:
            wrong = np.isin(fids, _fids_with_geometry(layer, fids))
        else:
            # The others do not tell; a GeoJSON without a geometry is seldom meant.
            wrong = np.full(len(fids), "json" in layer.driver.lower())
            reason = "has no geometry, or one that cannot be parsed"
        broken |= dict.fromkeys(missing[wrong].tolist(), reason)
    return replace(part, wkb=wkb, broken=broken, curved=frozenset(set(curved.tolist()) - set(broken)))


def _read_straight(layer: GdalLayer, fids: NDArray[np.int64]) -> NDArray[np.object_]:
    """Read geometries with arcs made segments, which a stream does not; None for one that is empty."""
    import pyogrio

    with gdal_as_input_error(layer.path, []):
        wkb: NDArray[np.object_] = pyogrio.raw.read(
            layer.source, layer=layer.name, columns=[], fids=fids, **layer.options
        )[2]
    wkb[shapely.is_empty(parse_wkb(wkb)[0])] = None
    return wkb


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
