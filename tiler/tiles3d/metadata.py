"""Metadata of 3D Tiles as binary property tables: of the features in a content, and of the tiles in a subtree."""

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

ALIGNMENT = 8  # bytes
NO_NUMBER = -9999.0  # where a feature has no value
Column = Sequence[str] | NDArray[Any]
# Types of columns by that of their arrays.
COMPONENTS = {"float32": "FLOAT32", "float64": "FLOAT64"}


class Blob:
    """A buffer that grows, and its views, each at a multiple of `ALIGNMENT`."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []

    def add(self, data: bytes, **words: Any) -> int:
        """Append a view with further members; gives its number."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data)} | words)
        self._parts.append(data + b"\0" * (-len(data) % ALIGNMENT))
        self.size += len(self._parts[-1])
        return len(self.views) - 1

    def bytes(self) -> bytes:
        """Give the whole buffer."""
        return b"".join(self._parts)


def add_table(blob: Blob, name: str, columns: Mapping[str, Column]) -> dict[str, Any]:
    """Append the columns of a property table.

    Parameters
    ----------
    blob : Blob
        The buffer.
    name : str
        Class of its rows.
    columns : mapping of str to sequence of str, or float32 or float64 array (n,) or (n, k)
        Values of its properties.

    Returns
    -------
    dict
        The table as JSON.
    """
    properties: dict[str, Any] = {}
    n = 0
    for key, values in columns.items():
        n = len(values)
        if isinstance(values, np.ndarray):
            properties[key] = {"values": blob.add(values.astype(values.dtype.newbyteorder("<")).tobytes())}
            continue
        texts = [value.encode() for value in values]
        ends = np.cumsum([0, *map(len, texts)]).astype("<u4")
        # A view of no bytes is not allowed.
        properties[key] = {"values": blob.add(b"".join(texts) or b"\0"), "stringOffsets": blob.add(ends.tobytes())}
    return {"class": name, "count": n, "properties": properties}


def describe_class(columns: Mapping[str, Column], **semantics: str) -> dict[str, Any]:
    """Give the class of a table, with the meanings that the specification has for some properties."""
    properties: dict[str, Any] = {}
    for key, values in columns.items():
        if isinstance(values, np.ndarray):
            kind: dict[str, Any] = {"type": "SCALAR", "componentType": COMPONENTS[values.dtype.name]}
            if values.ndim == 2:
                kind |= {"array": True, "count": values.shape[1]}
            elif key not in semantics:
                kind |= {"noData": NO_NUMBER}
        else:
            kind = {"type": "STRING"}
        properties[key] = kind | ({"semantic": semantics[key]} if key in semantics else {"name": key})
    return {"properties": properties}


def frame_chunks(magic: bytes, document: bytes, data: bytes) -> bytes:
    """Put a JSON document and a buffer into a binary subtree."""
    document += b" " * (-len(document) % ALIGNMENT)
    return struct.pack("<4sIQQ", magic, 1, len(document), len(data)) + document + data
