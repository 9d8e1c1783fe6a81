"""Features of a vector layer as they are stored (step 1.2)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a layer as they are stored."""

    wkb: NDArray[np.object_]  # (n,): geometries as well-known binary (bytes); None where there is none
    columns: dict[str, NDArray[Any]]  # values of the attributes that were asked for
    warned: tuple[str, ...]  # what the reader warned of, each once
    # (n,): the numbers that the file, or its reader, gives them: rows of a Shapefile and of Parquet count from 0
    fids: NDArray[np.int64]
    # Why a geometry that is None cannot be read, by row; None in another row means that the file has none.
    broken: dict[int, str]
    curved: frozenset[int] = frozenset()  # rows whose arcs GDAL made segments of 4 degrees


def to_objects(items: list[Any]) -> NDArray[np.object_]:
    """Put values, lists and None included, into an array of objects (n,), each as it is."""
    array = np.empty(len(items), dtype=np.object_)
    array[:] = items
    return array


def text_of(value: Any) -> str:
    """Write a value as text without spaces around it; whole floats as integers, ``""`` for none, as NaN is.

    Examples
    --------
    >>> text_of(" Flat "), text_of(1030.0), text_of(None), text_of(float("nan"))
    ('Flat', '1030', '', '')
    """
    if isinstance(value, float | np.floating):
        return f"{value:.17g}" if np.isfinite(value) else ""
    return "" if value is None else str(value).strip()


def decode_text(data: bytes | None, warned: list[str]) -> str | None:
    """Decode text of a file that states no encoding, or a wrong one: UTF-8, else Windows-1252, which is told.

    Examples
    --------
    >>> [decode_text("Straße".encode(name), []) for name in ("utf-8", "cp1252")]
    ['Straße', 'Straße']
    """
    if data is None:
        return None
    try:
        return data.decode()
    except UnicodeDecodeError:
        warned.append("text that is no UTF-8 is read as Windows-1252")
    try:
        return data.decode("cp1252")
    except UnicodeDecodeError:
        return data.decode("latin-1")  # five bytes of Windows-1252 have no letter
