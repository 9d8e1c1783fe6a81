"""What GDAL does not tell of a Shapefile: parts cut off, null shapes, wide numbers of its table (step 1.2)."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from tiler.vectors.features import Box

# Digits that a column of whole numbers may have and still be read as int64 by itself; GDAL takes wider ones for
# floats, which keep 15 to 17 digits.
WHOLE_DIGITS = 18
_RECORD_HEAD = 44  # bytes of a line or polygon before its parts: type, box, numbers of parts and points
_WITH_BOX = (3, 5, 13, 15, 23, 25, 31)  # types of lines, polygons and multipatches


@dataclass(frozen=True)
class DbfColumn:
    """A column of the table of a Shapefile: name, type (``N`` and ``F`` are numbers), digits, and decimals."""

    name: str
    kind: str
    width: int
    decimals: int


def is_shapefile(path: Path) -> bool:
    """Whether a file is a Shapefile, by its name."""
    return path.suffix.lower() == ".shp"


def check_complete(path: Path) -> None:
    """Compare the size of .shp and .dbf with their headers: GDAL reads what was cut off as no geometry.

    Raises
    ------
    InputError
        If one is shorter than its header claims.
    """
    claims = []
    with path.open("rb") as file:
        head = file.read(28)
        if len(head) == 28:
            claims.append((path, 2 * struct.unpack_from(">i", head, 24)[0]))
    table = _beside(path, ".dbf")
    if table is not None and table.stat().st_size >= 12:
        with table.open("rb") as file:
            n_rows, n_head, n_row = struct.unpack_from("<IHH", file.read(12), 4)
        claims.append((table, n_head + n_rows * n_row))
    for part, claimed in claims:
        size = part.stat().st_size
        if size < claimed:
            raise InputError(f"{part}: has {size} of the {claimed} bytes that its header claims; copy it again")


def read_dbf_columns(path: Path) -> tuple[DbfColumn, ...]:
    """Read the columns of the table beside a .shp; none where there is no table, or its header is cut off."""
    table = _beside(path, ".dbf")
    if table is None:
        return ()
    with table.open("rb") as file:
        head = file.read(65_536)
    columns = []
    for place in range(32, len(head) - 31, 32):
        if head[place] == 0x0D:
            break
        name = head[place : place + 11].split(b"\0")[0].decode("latin-1")
        columns.append(DbfColumn(name, chr(head[place + 11]), head[place + 16], head[place + 17]))
    return tuple(columns)


def find_wide_columns(path: Path) -> dict[str, int]:
    """Find the columns of whole numbers with more digits than `WHOLE_DIGITS`, and how many these are."""
    return {
        column.name: column.width
        for column in read_dbf_columns(path)
        if column.kind in "NF" and column.decimals == 0 and column.width > WHOLE_DIGITS
    }


def is_null_shape(path: Path, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell the shapes that say themselves that they are null from those that cannot be read.

    Parameters
    ----------
    path : Path
        The .shp, with its index beside it.
    rows : int64, (n,)
        Rows without a geometry.

    Returns
    -------
    bool, (n,)
        False too where the index or the file ends before.
    """
    index = _beside(path, ".shx")
    found = np.zeros(len(rows), np.bool_)
    if index is None:
        return found
    with index.open("rb") as numbers, path.open("rb") as shapes:
        for k, row in enumerate(rows.tolist()):
            numbers.seek(100 + 8 * row)
            entry = numbers.read(4)
            if len(entry) == 4:
                shapes.seek(2 * struct.unpack(">I", entry)[0] + 8)
                found[k] = shapes.read(4) == bytes(4)
    return found


def find_near_shapes(path: Path, box: Box) -> NDArray[np.int64]:
    """Find the rows whose shapes meet a box by their own bounding boxes, and those that have none that is sound.

    Parameters
    ----------
    path : Path
        The .shp, with its index beside it.
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax in the file's CRS.

    Returns
    -------
    int64, (n,)
        Ascending; without null shapes.

    References
    ----------
    ESRI Shapefile Technical Description (1998), "Main File Record Contents".
    """
    index = _beside(path, ".shx")
    if index is None:
        return np.empty(0, np.int64)
    entries = np.frombuffer(index.read_bytes()[100:], ">i4")
    entries = entries[: len(entries) // 2 * 2].reshape(-1, 2).astype(np.int64) * 2
    data = np.memmap(path, np.uint8, "r")
    stated = int(_gather(data, np.array([32]), 0, "<i4")[0])
    if stated not in _WITH_BOX:
        return np.empty(0, np.int64)
    start, length = entries[:, 0] + 8, entries[:, 1]
    whole = (start > 0) & (start + _RECORD_HEAD <= len(data))
    kind, sound = np.full(len(start), -1, np.int32), whole.copy()
    kind[whole] = _gather(data, start[whole], 0, "<i4")
    boxes = np.stack([_gather(data, start[whole], 4 + 8 * k, "<f8") for k in range(4)])
    meets = np.zeros(len(start), np.bool_)
    with np.errstate(invalid="ignore"):
        meets[whole] = (boxes[0] <= box[2]) & (boxes[1] <= box[3]) & (boxes[2] >= box[0]) & (boxes[3] >= box[1])
    sound &= (kind == stated) & (length >= _RECORD_HEAD)
    null = (kind == 0) | (~whole & (length == 4))
    return np.flatnonzero((meets | ~sound) & ~null)


def _gather(data: NDArray[np.uint8], start: NDArray[np.int64], place: int, kind: str) -> NDArray[Any]:
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(data[(start + place)[:, None] + np.arange(size)]).view(kind).ravel()


def _beside(path: Path, suffix: str) -> Path | None:
    both = (path.with_suffix(suffix), path.with_suffix(suffix.upper()))
    return next((part for part in both if part.is_file()), None)
