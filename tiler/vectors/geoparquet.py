"""GeoParquet by pyarrow, as most builds of GDAL have no driver for it (step 1.2)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.objects.places import source_of
from tiler.vectors.features import Box, Features, to_objects
from tiler.vectors.parquet_geometry import GeometryColumn, find_geometry, read_geometry

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


def describe(path: Path) -> tuple[GeometryColumn, tuple[str, ...], int, Box | None]:
    """Read from a Parquet file its column of geometries, attributes, number of features, and extent or None.

    Raises
    ------
    InputError
        If the file is damaged, or has no geometries that are known.
    """
    with _arrow_as_input_error(path):
        table, column = _open(path)
        bbox = column.bbox
        return (
            column,
            tuple(field for field in table.schema_arrow.names if field != column.name),
            table.metadata.num_rows,
            None if bbox is None else (bbox[0], bbox[1], bbox[len(bbox) // 2], bbox[len(bbox) // 2 + 1]),
        )


def scan(path: Path, columns: Sequence[str], box: Box | None, *, geometry: bool, batch: int) -> Iterator[Features]:
    """Read the features of the groups of rows that may meet a box, by batches, as `layers.scan_layer`.

    Features are numbered by their rows in the file, from 0. Row groups are left out where the file has a bounding
    box column, and its statistics say that the group is away from the box.
    """
    with _arrow_as_input_error(path):
        table, column = _open(path, columns)
        groups = [group for group in range(table.num_row_groups) if _near(table, group, column, box)]
        read = [column.name, *columns] if geometry else list(columns)
        parts = table.iter_batches(batch, row_groups=groups, columns=list(dict.fromkeys(read)))
        rows = _rows_of(table, groups)
    while True:
        with _arrow_as_input_error(path):
            part = next(parts, None)
            if part is None:
                return
            _check_expanded(path, part)
            fids, rows = rows[: part.num_rows], rows[part.num_rows :]
            stored = (
                read_geometry(part.column(column.name), column.encoding) if geometry else [None] * part.num_rows
            )
            values = {field: to_objects(part.column(field).to_pylist()) for field in columns}
        yield Features(to_objects(stored), values, (), fids, {})


def _rows_of(table: Any, groups: list[int]) -> NDArray[np.int64]:
    """List the rows of row groups."""
    sizes = np.array([table.metadata.row_group(group).num_rows for group in range(table.num_row_groups)], np.int64)
    first = np.cumsum(sizes) - sizes
    return np.concatenate([np.empty(0, np.int64), *(first[group] + np.arange(sizes[group]) for group in groups)])


def _near(table: Any, group: int, column: GeometryColumn, box: Box | None) -> bool:
    """Whether a row group may hold features that meet a box, by the statistics of its bounding box column."""
    covering = column.covering
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


def _open(path: Path, columns: Sequence[str] = ()) -> tuple[Any, GeometryColumn]:
    import pyarrow.parquet

    table = pyarrow.parquet.ParquetFile(source_of(path))
    size, n_rows = path.stat().st_size, table.metadata.num_rows
    if n_rows > size:
        raise InputError(f"{path}: claims {n_rows} features in {size} bytes; copy the file again")
    column = find_geometry(path, table)
    kept = [*columns, *([column.name] if column.encoding == "WKB" else [])]
    return pyarrow.parquet.ParquetFile(source_of(path), read_dictionary=kept), column


@contextmanager
def _arrow_as_input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        raise InputError(f"{path}: cannot be read as GeoParquet ({error}); copy the file again") from error
