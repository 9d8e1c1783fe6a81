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
    """

    wkb: NDArray[np.object_]
    columns: dict[str, NDArray[Any]]
    warned: tuple[str, ...]
    fids: NDArray[np.int64]
    broken: dict[int, str]


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


def decode_text(data: bytes | None) -> str | None:
    """Decode text of a file that states no encoding, or a wrong one: UTF-8, else Windows-1252.

    Examples
    --------
    >>> [decode_text(text) for text in (b"Stra\\xc3\\x9fe", b"Stra\\xdfe", b"\\x81", None)]
    ['Straße', 'Straße', '\\x81', None]
    """
    if data is None:
        return None
    for encoding in ("utf-8", "cp1252"):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("latin-1")  # five bytes of Windows-1252 have no letter
