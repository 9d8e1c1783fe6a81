"""GeoParquet by pyarrow, as most builds of GDAL have no driver for it (step 1.2)."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.errors import InputError
from tiler.places import source_of
from tiler.wkb import parse_wkb

Box = tuple[float, float, float, float]

BATCH_BYTES = 2**30  # of the values of one column in a batch; 50,000 footprints take some 10 MB
_SUFFIXES = {".parquet", ".geoparquet", ".pq"}
# What pyarrow, json and pyproj raise on metadata that are wrong or nested too deep.
_DAMAGE = (
    *(OSError, ValueError, TypeError, KeyError, IndexError, AttributeError, MemoryError, OverflowError),
    *(RecursionError, pyproj.exceptions.CRSError),
)


def is_parquet(path: Path) -> bool:
    """Whether a file is Parquet, by its name.

    Examples
    --------
    >>> is_parquet(Path("houses.GeoParquet"))
    True
    """
    return path.suffix.lower() in _SUFFIXES


def describe(path: Path) -> tuple[pyproj.CRS | None, tuple[str, ...], int, Box | None]:
    """Read the metadata of a GeoParquet file.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    pyproj.CRS or None
        None where the file says that the CRS is unknown; longitude and latitude where it says nothing.
    tuple of str
        Names of the attributes.
    int
        Number of features.
    tuple of 4 floats, or None
        xmin, ymin, xmax, ymax as stated.

    Raises
    ------
    InputError
        If the file is damaged, is not GeoParquet with geometries as WKB, or if pyarrow is not installed.

    References
    ----------
    GeoParquet 1.1, section "Column metadata".
    """
    with _arrow_as_input_error(path):
        table = _open(path)
        name, column = _geometry(path, table)
        crs = column.get("crs", "OGC:CRS84")
        bbox = column.get("bbox")
        return (
            None if crs is None else pyproj.CRS.from_user_input(crs),
            tuple(field for field in table.schema_arrow.names if field != name),
            table.metadata.num_rows,
            None if bbox is None else (bbox[0], bbox[1], bbox[len(bbox) // 2], bbox[len(bbox) // 2 + 1]),
        )


def scan(
    path: Path, columns: Sequence[str], box: Box | None, *, geometry: bool, batch: int
) -> Iterator[tuple[NDArray[np.object_], dict[str, NDArray[Any]]]]:
    """Read the features whose bounding boxes meet a box, by batches.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of str
        Attributes to read.
    box : tuple of 4 floats, or None
        xmin, ymin, xmax, ymax in the file's CRS; None for all features.
    geometry : bool
        False leaves the geometries out: None in every row; the box must be None then.
    batch : int
        Features in memory at once, beside those that are kept.

    Yields
    ------
    object, (n,)
        Geometries as well-known binary (bytes).
    dict of str to (n,) arrays
        Values of the attributes.

    Raises
    ------
    InputError
        As `describe`.
    ValueError
        If a box is asked for without geometries.

    Notes
    -----
    Row groups are left out where the file has a bounding box column, and its statistics say that the group
    is away from the box.
    """
    if box is not None and not geometry:
        raise ValueError("a box needs the geometries")
    with _arrow_as_input_error(path):
        table = _open(path, [*columns])
        name, column = _geometry(path, table)
        groups = [group for group in range(table.num_row_groups) if _near(table, group, column, box)]
        parts = table.iter_batches(
            batch, row_groups=groups, columns=[name, *columns] if geometry else list(columns)
        )
    while True:
        with _arrow_as_input_error(path):
            part = next(parts, None)
            if part is None:
                return
            _check_expanded(path, part)
            blobs = to_objects(part.column(name).to_pylist() if geometry else [None] * part.num_rows)
            if box is not None:
                hits = np.flatnonzero(_meets(blobs, box))
                blobs, part = blobs[hits], part.take(hits)
            values = {field: to_objects(part.column(field).to_pylist()) for field in columns}
        yield blobs, values


def to_objects(items: list[Any]) -> NDArray[np.object_]:
    """Put values into an array of objects, each as it is.

    Parameters
    ----------
    items : list
        Anything, lists and None included.

    Returns
    -------
    object, (n,)
    """
    array = np.empty(len(items), dtype=np.object_)
    array[:] = items
    return array


def _meets(wkb: NDArray[np.object_], box: Box) -> NDArray[np.bool_]:
    xmin, ymin, xmax, ymax = shapely.bounds(parse_wkb(wkb)).T
    meets: NDArray[np.bool_] = (xmin <= box[2]) & (xmax >= box[0]) & (ymin <= box[3]) & (ymax >= box[1])
    return meets


def _near(table: Any, group: int, column: dict[str, Any], box: Box | None) -> bool:
    """Whether a row group may hold features that meet a box, by the statistics of its bounding box column."""
    covering = column.get("covering", {}).get("bbox")
    if box is None or covering is None:
        return True
    rows = table.metadata.row_group(group)
    by_path = {rows.column(k).path_in_schema: rows.column(k).statistics for k in range(rows.num_columns)}
    found: list[Any] = [by_path.get(".".join(covering[side])) for side in ("xmin", "ymin", "xmax", "ymax")]
    if any(each is None or not each.has_min_max for each in found):
        return True
    west, south, east, north = found
    low = west.min <= box[2] and south.min <= box[3]
    return bool(low and east.max >= box[0] and north.max >= box[1])


def _check_expanded(path: Path, part: Any) -> None:
    """Refuse a batch whose values, each written once in the file, take more memory than a batch may.

    Parquet keeps equal values once, in a dictionary: a small file may hold a large polygon a million times.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    for column in part.columns:
        if pa.types.is_dictionary(column.type):
            length = pc.take(pc.binary_length(column.dictionary), column.indices)
            n_bytes = pc.sum(length.cast(pa.int64())).as_py() or 0
            if n_bytes > BATCH_BYTES:
                raise InputError(
                    f"{path}: {len(column)} rows expand to {n_bytes} bytes > {BATCH_BYTES}; write footprints "
                    "once, and with fewer vertices"
                )


def _open(path: Path, columns: Sequence[str] = ()) -> Any:
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise InputError(
            f"{path}: Parquet needs pyarrow; pip install 'citystitch[parquet]', or convert the file to GPKG"
        ) from error
    table = pyarrow.parquet.ParquetFile(source_of(path))
    size, n_rows = path.stat().st_size, table.metadata.num_rows
    if n_rows > size:
        raise InputError(f"{path}: claims {n_rows} features in {size} bytes; copy the file again")
    geometry = _geometry(path, table)[0]
    return pyarrow.parquet.ParquetFile(source_of(path), read_dictionary=[geometry, *columns])


def _geometry(path: Path, table: Any) -> tuple[str, dict[str, Any]]:
    """Give the name and the metadata of the geometry column."""
    geo = json.loads((table.schema_arrow.metadata or {}).get(b"geo", b"{}"))
    name = geo.get("primary_column", "")
    column = geo.get("columns", {}).get(name)
    if column is None or column.get("encoding") != "WKB":
        raise InputError(
            f"{path}: is no GeoParquet file with geometries as WKB (encoding: "
            f"{None if column is None else column.get('encoding')}); convert it to GPKG"
        )
    return name, column


@contextmanager
def _arrow_as_input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        raise InputError(f"{path}: cannot be read as GeoParquet ({error}); copy the file again") from error
