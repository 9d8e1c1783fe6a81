"""What the store writes of an array: plain little-endian rows, and a checksum for every chunk of them."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from deflate import crc32
from numpy.typing import ArrayLike, NDArray

CHUNK_BYTES = 4 * 2**20  # about what one read or write moves at a time
SQUARE = 256  # rows and columns of a raster's chunks: what a neighbour reads of it is seldom more than a strip
PACKED_BYTES = 128 * 2**10  # smaller arrays share one array of bytes: one of its own takes two files
INLINE_BYTES = 16 * 2**10  # and if all of them are smaller than this, that one is spared too
BLOSC_VERSIONS = (1, 2)  # of its format, in the first byte
CHUNK_HEAD = 16  # bytes of the header of a Blosc chunk
MEMCPYED = 2  # flag of a Blosc chunk that is stored as it was
MOST_ROW = 2**30  # bytes; the longest row of a terrain has some 10^5
MOST_AXES = 8
DTYPE = re.compile(r"[<|][biuf][1248]|[<|]b1|<U[1-9][0-9]{0,6}")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")

Table = dict[str, dict[str, Any]]


def check_name(name: str) -> None:
    """Raise ValueError unless an array may have this name: letters, digits and underscores."""
    if not NAME.fullmatch(name):
        raise ValueError(f"array name {name!r}: letters, digits and underscores only, a letter first")


def plain_array(name: str, values: ArrayLike) -> NDArray[Any]:
    """Bring an array into the form that is stored: contiguous, little-endian, of a fixed size.

    Parameters
    ----------
    name : str
        Its name, for the message.
    values : array_like
        Booleans, integers, floats of at most 8 bytes, or strings of a fixed width (``<U``).

    Raises
    ------
    ValueError
        If it is of another type, such as objects.
    """
    array = np.asarray(values)
    kind, size = array.dtype.kind, array.dtype.itemsize
    if kind not in "biufU" or (kind == "f" and size > 8):
        raise ValueError(f"array {name}: {array.dtype} cannot be stored; give booleans, numbers or <U strings")
    dtype = array.dtype.newbyteorder("<") if size else np.dtype("<U1")
    return np.ascontiguousarray(array, dtype=dtype).reshape(array.shape)


def raw_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """View a plain array as its bytes, (n_bytes,)."""
    return array.reshape(-1).view(np.uint8)


def rows_per_chunk(array: NDArray[Any]) -> int:
    """Count the rows of a chunk of about `CHUNK_BYTES`; it depends on the width of a row alone."""
    row_bytes = array.dtype.itemsize * int(np.prod(array.shape[1:]))
    return max(CHUNK_BYTES // max(row_bytes, 1), 1)


def count_columns(entry: Mapping[str, Any]) -> int:
    """Count the chunks beside each other in an array: more than one in rasters alone."""
    return -(-entry["shape"][1] // entry["columns"]) if "columns" in entry else 1


def square_checksums(raster: NDArray[Any]) -> list[int]:
    """Compute the CRC-32 of every square chunk of a raster, row by row of them."""
    ny, nx = raster.shape
    return [
        crc32(raw_bytes(np.ascontiguousarray(raster[j : j + SQUARE, i : i + SQUARE])).data)
        for j in range(0, ny, SQUARE)
        for i in range(0, nx, SQUARE)
    ]


def checksums(array: NDArray[Any], rows: int) -> list[int]:
    """Compute the CRC-32 of every chunk of so many rows."""
    return [crc32(raw_bytes(array[start : start + rows]).data) for start in range(0, len(array), rows)]


def pack(arrays: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.uint8], Table]:
    """Lay small arrays behind each other, in the order of their names.

    Returns
    -------
    bytes : uint8, (n_bytes,)
        All of them.
    table : dict
        ``dtype``, ``shape`` and ``offset`` (bytes) of each.
    """
    table: Table = {}
    offset = 0
    for name, array in sorted(arrays.items()):
        table[name] = {"dtype": array.dtype.str, "shape": list(array.shape), "offset": offset}
        offset += array.nbytes
    parts = [raw_bytes(array) for _, array in sorted(arrays.items())]
    return np.concatenate(parts) if parts else np.empty(0, np.uint8), table


def check_entry(entry: Mapping[str, Any]) -> None:
    """Check what a store says of an array before anything is allocated by it.

    Raises
    ------
    ValueError, KeyError, TypeError
        If type, shape, chunks or checksums are none that `pack` and the store write.
    """
    dtype, shape = str(entry["dtype"]), entry["shape"]
    if not DTYPE.fullmatch(dtype):
        raise ValueError(f"type {dtype[:20]!r}")
    if not (isinstance(shape, list) and len(shape) <= MOST_AXES and all(type(n) is int and n >= 0 for n in shape)):
        raise ValueError(f"shape {str(shape)[:100]}")
    if "offset" in entry:
        if type(entry["offset"]) is not int or entry["offset"] < 0:
            raise ValueError("place in the packed bytes")
        return
    if "columns" in entry:
        if len(shape) != 2 or type(entry["columns"]) is not int or not 1 <= entry["columns"] <= max(shape[1], 1):
            raise ValueError(f"chunks of {str(entry['columns'])[:20]} columns")
        shape = [shape[0], entry["columns"]]
    chunk, row_bytes = entry["chunk"], np.dtype(dtype).itemsize * math.prod(max(n, 1) for n in shape[1:])
    if type(chunk) is not int or not 1 <= chunk * row_bytes <= max(CHUNK_BYTES, min(row_bytes, MOST_ROW)):
        raise ValueError(f"chunks of {chunk} rows of {row_bytes} bytes")
    if len(entry["crc"]) != -(-shape[0] // chunk) * count_columns(entry):
        raise ValueError(f"{len(entry['crc'])} checksums for {shape[0]} rows in chunks of {chunk}")


def check_chunk(data: bytes, n_bytes: int) -> None:
    """Check that a compressed chunk is whole and unpacks to the bytes that it should, before it is.

    Parameters
    ----------
    data : bytes
        The chunk.
    n_bytes : int
        Uncompressed size that is expected.

    Raises
    ------
    ValueError
        If it is no Blosc chunk, or one of another size.

    References
    ----------
    Blosc, "README_CHUNK_FORMAT": after four bytes of versions and flags come the uncompressed size, the size of a
    block, and the compressed size, 32 bits each.
    """
    if len(data) < CHUNK_HEAD or data[0] not in BLOSC_VERSIONS:
        raise ValueError("is not compressed by Blosc")
    claimed, size = (int.from_bytes(data[k : k + 4], "little") for k in (4, 12))
    if claimed != n_bytes:
        raise ValueError(f"a chunk claims {claimed} bytes instead of {n_bytes}")
    if size != len(data):
        raise ValueError(f"a chunk claims {size} compressed bytes and has {len(data)}")


def shorten_chunk(data: bytes, n_bytes: int) -> bytes:
    """Make a compressed chunk claim no more blocks than its first bytes are in, so that no others are unpacked.

    Parameters
    ----------
    data : bytes
        The chunk, which has passed `check_chunk`.
    n_bytes : int
        Uncompressed bytes that are wanted, from the first on.

    Returns
    -------
    bytes
        A chunk that unpacks to these and the rest of their last block; the same where that is all.

    Notes
    -----
    The last chunk of an array is filled up with zeros, most of it where an array is small. Blocks do not depend on
    each other, and the head tells where each begins; a chunk that is stored as it was is one copy (flag 2). The
    zeros are under no checksum but that of the file: damage there is found by `Store.find_damage` alone.
    """
    claimed, block = (int.from_bytes(data[k : k + 4], "little") for k in (4, 8))
    shorter = -(-n_bytes // block) * block if block else claimed
    if shorter >= claimed or data[2] & MEMCPYED:
        return data
    return data[:4] + shorter.to_bytes(4, "little") + data[8:]


def unpack(packed: NDArray[np.uint8], entry: Mapping[str, Any]) -> NDArray[Any]:
    """Take one array out of the packed bytes."""
    dtype, shape = np.dtype(entry["dtype"]), tuple(entry["shape"])
    size = dtype.itemsize * int(np.prod(shape))
    part: NDArray[Any] = packed[entry["offset"] : entry["offset"] + size].copy().view(dtype)
    return part.reshape(shape)


class RowBuffer:
    """Rows appended piece by piece, given out in whole chunks.

    However the rows were cut into pieces, the same chunks come out.

    Parameters
    ----------
    name : str
        Name of the array, for messages.
    first : array
        A first piece: it settles the type and the shape of a row.
    """

    def __init__(self, name: str, first: NDArray[Any]) -> None:
        self.name = name
        self.dtype, self.row_shape = first.dtype, first.shape[1:]
        self.chunk = rows_per_chunk(first)
        self._pieces: list[NDArray[Any]] = []
        self._count = 0

    def add(self, piece: NDArray[Any]) -> list[NDArray[Any]]:
        """Take rows of the same type and shape; raises ValueError for others.

        Gives what whole chunks there are now, in order, and keeps copies of the rows beyond. Chunks that the piece
        has to itself are views of it.
        """
        if piece.dtype != self.dtype or piece.shape[1:] != self.row_shape:
            raise ValueError(
                f"array {self.name}: rows of {piece.dtype} {piece.shape[1:]} appended to rows of {self.dtype} "
                f"{self.row_shape}; give all pieces one type and width"
            )
        if self._count + len(piece) < self.chunk:
            self._pieces.append(piece.copy())
            self._count += len(piece)
            return []
        first = -self._count % self.chunk  # rows that a begun chunk lacks
        stop = first + (len(piece) - first) // self.chunk * self.chunk
        begun = np.concatenate([*self._pieces, piece[:first]]) if first else piece[:0]
        self._pieces, self._count = [piece[stop:].copy()], len(piece) - stop
        return [rows for rows in (begun, piece[first:stop]) if len(rows)]

    def rest(self) -> NDArray[Any]:
        """Give the rows that are left."""
        empty = np.empty((0, *self.row_shape), self.dtype)
        return np.concatenate([empty, *self._pieces])


def verified_chunks(rows: NDArray[Any], chunk: int, expected: Sequence[int]) -> Iterator[int]:
    """Yield the positions of the chunks whose checksum is not what it should be."""
    found = checksums(rows, chunk)
    yield from (k for k, pair in enumerate(zip(found, expected, strict=True)) if pair[0] != pair[1])
