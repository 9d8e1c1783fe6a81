"""The file of one result: a zip of numpy's and zarr's files, opened, checked and read.

Small arrays are ``NAME.npy``, large ones zarr (v3) arrays ``NAME/``; the attributes are those of the zarr group at
the top. The zip compresses nothing; Blosc compresses the chunks. The zip has a CRC-32 of each of its files, which
is verified on every read, and its comment is the CRC-32 of the whole (`tiler.store.checksums.seal_file`).
"""

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self
from zipfile import ZIP_STORED, ZipFile

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError, OutputError
from tiler.store.checksums import open_binary

if TYPE_CHECKING:
    import zarr

GROUP = "zarr.json"  # zarr's description of a group or an array
NPY = ".npy"
CHUNK_BYTES = 4 * 2**20  # about what one read or write of a large array moves
MOST_ROW = 2**30  # bytes; the longest row of a terrain has some 10^5
MOST_AXES = 8
KINDS = "biufU"  # of numbers, booleans and strings
BLOSC_SIZES = (4, 12)  # bytes of a chunk that begin its sizes, unpacked and packed, which Blosc takes as true

Span = tuple[int, int]  # first row or column, and the one behind the last


def rows_per_chunk(array: NDArray[Any]) -> int:
    """Count the rows of a chunk of about `CHUNK_BYTES`; it depends on the width of a row alone."""
    row_bytes = array.dtype.itemsize * math.prod(array.shape[1:])
    return max(CHUNK_BYTES // max(row_bytes, 1), 1)


class ResultFile:
    """A result opened for reading.

    Parameters
    ----------
    path : Path
        The file.
    title : str
        Which result it is, for messages.

    Attributes
    ----------
    attributes : dict
        What the writer gave.
    digest : str
        Digest of the content.
    names : list of str
        The arrays, sorted.

    Raises
    ------
    InputError
        From all methods, if the file is not there or what is read of it is damaged; the message names the array.
    """

    def __init__(self, path: Path, title: str) -> None:
        self._path, self._title = path, title
        with self._damage("attributes"):
            self._file = open_binary(path)
            try:
                self._zip = ZipFile(self._file)
                if any(part.compress_type != ZIP_STORED for part in self._zip.infolist()):
                    raise ValueError("a compressed file in the zip")
                self.attributes: dict[str, Any] = json.loads(self._zip.read(GROUP))["attributes"]
                self.digest: str = self.attributes.pop("digest")
                self._files = frozenset(self._zip.namelist())
            except BaseException:
                self._file.close()
                raise
        self.names = sorted(
            name.removesuffix(suffix)
            for name in self._files
            for suffix in (NPY, f"/{GROUP}")
            if name.endswith(suffix)
        )
        self._opened: dict[str, zarr.Array[Any]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._zip.close()
        self._file.close()

    def read(self, name: str, rows: Sequence[Span] | None = None) -> NDArray[Any]:
        """Read an array, or ranges of its rows, one after the other: a chunk is read once.

        ValueError if there is no such array, or a range is not within it.
        """
        array = self._open(name)
        shape = tuple(array.shape)
        for start, stop in rows or ():
            if not 0 <= start <= stop <= (shape[0] if shape else 0):
                raise ValueError(f"{self._title}: rows {start} to {stop} of {name}, which has {shape[:1]}")
        with self._damage(name):
            if isinstance(array, np.ndarray):
                return array if rows is None else np.concatenate([array[:0], *(array[slice(*r)] for r in rows)])
            spans = [(0, n) for n in shape]
            if rows is None:
                return self._read_chunks(name, array, spans)
            if len(rows) == 1:
                return self._read_chunks(name, array, [rows[0], *spans[1:]])
            found = np.empty((sum(stop - start for start, stop in rows), *shape[1:]), array.dtype)
            step, n_found, first = array.chunks[0], 0, -1
            for start, stop in rows:
                for k in range(start // step, -(-stop // step)):
                    if k * step != first:
                        first = k * step
                        chunk = self._read_chunks(name, array, [(first, min(first + step, shape[0])), *spans[1:]])
                    part = chunk[max(start - first, 0) : stop - first]
                    found[n_found : n_found + len(part)] = part
                    n_found += len(part)
            return found

    def read_window(self, name: str, rows: Span, columns: Span) -> NDArray[Any]:
        """Read a window of an array of rows and columns: only the chunks that hold some of it.

        ValueError if there is no such array, or it does not hold the window.
        """
        array = self._open(name)
        shape = tuple(array.shape)
        if len(shape) != 2:
            raise ValueError(f"{self._title}: {name} is no raster but {shape}")
        if not all(0 <= start <= stop <= n for (start, stop), n in zip((rows, columns), shape, strict=True)):
            raise ValueError(f"{self._title}: rows {rows}, columns {columns} of {name}, which has {shape}")
        if isinstance(array, np.ndarray):
            return array[slice(*rows), slice(*columns)].copy()
        with self._damage(name):
            return self._read_chunks(name, array, [rows, columns])

    def blocks(self, name: str) -> Iterator[NDArray[Any]]:
        """Read an array a row of chunks at a time; the first block may have no rows, and tells type and width."""
        array = self._open(name)
        if isinstance(array, np.ndarray):
            yield array
            return
        yield self.read(name, [(0, 0)])
        for start in range(0, array.shape[0], array.chunks[0]):
            yield self.read(name, [(start, min(start + array.chunks[0], array.shape[0]))])

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array."""
        return tuple(self._open(name).shape)

    def _open(self, name: str) -> "NDArray[Any] | zarr.Array[Any]":
        """Read a small array, or open a large one: nothing is allocated by what it says of itself."""
        if name in self._opened:
            return self._opened[name]
        if name not in self.names:
            raise ValueError(f"{self._title}: no array {name}, it has: {', '.join(self.names) or 'none'}")
        with self._damage(name):
            if name + NPY in self._files:
                return _unpack_npy(self._zip.read(name + NPY))
            import zarr
            from zarr.buffer import default_buffer_prototype
            from zarr.storage import MemoryStore

            parts = {GROUP: default_buffer_prototype().buffer.from_bytes(self._zip.read(f"{name}/{GROUP}"))}
            array = zarr.open_array(MemoryStore(parts), mode="r", zarr_format=3)
            _check_array(array, sum(file.startswith(f"{name}/c/") for file in self._files))
            self._opened[name] = array
            return array

    def _read_chunks(self, name: str, array: "zarr.Array[Any]", spans: Sequence[Span]) -> NDArray[Any]:
        """Unpack a part of an array, of those files of the zip that hold some of it.

        zarr itself would take longer to hand a chunk to its threads than it takes to unpack.
        """
        from numcodecs import blosc

        blosc.set_nthreads(1)  # with threads of its own a chunk takes three times as long
        size = math.prod(array.chunks) * array.dtype.itemsize
        found = np.empty([stop - start for start, stop in spans], array.dtype)
        for place in product(*(_pieces_of(*span, step) for span, step in zip(spans, array.chunks, strict=True))):
            key = "/".join(("c", *(str(k) for k, _, _ in place)))
            data = self._zip.read(f"{name}/{key}")
            sizes = [int.from_bytes(data[k : k + 4], "little") for k in BLOSC_SIZES]
            if sizes != [size, len(data)]:
                raise ValueError(f"chunk {key} does not unpack to {size} bytes")
            chunk = np.frombuffer(blosc.decompress(data), array.dtype).reshape(array.chunks)
            found[tuple(into for _, into, _ in place)] = chunk[tuple(of for _, _, of in place)]
        return found

    @contextmanager
    def _damage(self, what: str) -> Iterator[None]:
        """Whatever zip, numpy, zarr and its codecs raise on a broken file becomes one error that says where."""
        try:
            yield
        except (MemoryError, OutputError):  # a bucket that does not answer has no damage
            raise
        except Exception as error:
            state = "is damaged" if self._path.is_file() else "is not there"
            raise InputError(
                f"{self._title}: {what} in {self._path} {state} ({error}); run again: it is made anew"
            ) from error


def _pieces_of(start: int, stop: int, step: int) -> Iterator[tuple[int, slice, slice]]:
    """Give the chunks that hold a part of an axis, and where these places are in what is read, and in them."""
    for k in range(start // step, -(-stop // step) if stop > start else start // step):
        first, last = max(start, k * step), min(stop, (k + 1) * step)
        yield k, slice(first - start, last - start), slice(first - k * step, last - k * step)


def _unpack_npy(data: bytes) -> NDArray[Any]:
    """Read an array of numpy's format; ValueError or TypeError if it is not one, or not as long as it says."""
    stream = BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("another version of numpy's format")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.kind not in KINDS or len(shape) > MOST_AXES or any(n < 0 for n in shape):
        raise ValueError(f"an array of {shape} {dtype}")
    return np.ndarray(shape, dtype, data, stream.tell()).copy()


def _check_array(array: "zarr.Array[Any]", n_files: int) -> None:
    """Raise ValueError unless a large array is one that the store writes, with so many files of chunks."""
    from zarr.codecs import BloscCodec, BytesCodec

    row_bytes = array.dtype.itemsize * math.prod(array.chunks[1:])
    if array.dtype.kind not in KINDS or not 1 <= len(array.shape) <= MOST_AXES:
        raise ValueError(f"an array of {array.shape} {array.dtype}")
    if not 1 <= array.chunks[0] * row_bytes <= max(CHUNK_BYTES, min(row_bytes, MOST_ROW)):
        raise ValueError(f"chunks of {array.chunks[0]} rows of {row_bytes} bytes")
    codecs = [*array.filters, array.serializer, *array.compressors]
    if [type(codec) for codec in codecs] != [BytesCodec, BloscCodec]:
        raise ValueError(f"codecs {', '.join(type(codec).__name__ for codec in codecs)}")
    if array.nchunks != n_files:
        raise ValueError(f"{n_files} files for the {array.nchunks} chunks of {array.shape}")
