"""What GDAL does not tell of a Shapefile: parts cut off, null shapes, wide numbers of its table (step 1.2)."""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError

# Digits that a column of whole numbers may have and still be read as int64 by itself; GDAL takes wider ones for
# floats, which keep 15 to 17 digits.
WHOLE_DIGITS = 18


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


def find_wide_columns(path: Path) -> dict[str, int]:
    """Find the columns of whole numbers with more digits than `WHOLE_DIGITS`, and how many these are."""
    table = _beside(path, ".dbf")
    if table is None:
        return {}
    with table.open("rb") as file:
        head = file.read(65_536)
    found = {}
    for place in range(32, len(head) - 31, 32):
        if head[place] == 0x0D:
            break
        kind, width, decimals = head[place + 11 : place + 12], head[place + 16], head[place + 17]
        if kind in (b"N", b"F") and decimals == 0 and width > WHOLE_DIGITS:
            found[head[place : place + 11].split(b"\0")[0].decode("latin-1")] = width
    return found


def is_null_shape(path: Path, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell the shapes that say themselves that they are null from those that cannot be read.

    Of rows without a geometry, int64 (n,), to bool (n,); False too where the index or the file ends before.
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


def _beside(path: Path, suffix: str) -> Path | None:
    both = (path.with_suffix(suffix), path.with_suffix(suffix.upper()))
    return next((part for part in both if part.is_file()), None)
