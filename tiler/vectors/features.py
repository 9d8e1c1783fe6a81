"""Features of a vector layer as they are stored (step 1.2)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Box = tuple[float, float, float, float]


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
    fids : int64, (n,)
        The numbers that the file, or its reader, gives them: rows of a Shapefile and of Parquet count from 0.
    broken : dict of int to str
        Why a geometry that is None cannot be read, by row; None in another row means that the file has none.
    curved : frozenset of int
        Rows whose arcs GDAL made segments of 4 degrees.
    """

    wkb: NDArray[np.object_]
    columns: dict[str, NDArray[Any]]
    warned: tuple[str, ...]
    fids: NDArray[np.int64]
    broken: dict[int, str]
    curved: frozenset[int] = frozenset()


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


def decode_text(data: bytes | None, warned: list[str]) -> str | None:
    """Decode text of a file that states no encoding, or a wrong one: UTF-8, else Windows-1252.

    Parameters
    ----------
    data : bytes or None
        As stored.
    warned : list of str
        Gets a line for a text that is no UTF-8.

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
