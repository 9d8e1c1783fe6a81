"""One result of the store on its way there: see `tiler.store.store` for what it is made of."""

import base64
import errno
import json
import os
import shutil
import tempfile
import uuid
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from blake3 import blake3
from deflate import crc32
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import OutputError
from tiler.objects.places import in_bucket
from tiler.store.checksums import seal
from tiler.store.packing import (
    INLINE_BYTES,
    PACKED_BYTES,
    SQUARE,
    RowBuffer,
    Table,
    check_name,
    checksums,
    pack,
    plain_array,
    raw_bytes,
    rows_per_chunk,
    square_checksums,
)
from tiler.store.result_reader import PACKED, RESERVED
from tiler.store.zarr_files import GROUP, ChunkForm, describe_group

if TYPE_CHECKING:
    from tiler.objects.path import ObjectPath

PARTIAL = ".partial"
DIGEST_BYTES = 16  # of the 32 that BLAKE3 gives


class Writer:
    """One result on its way into the store; nothing of it is visible before `commit`.

    Leaving the context without a commit, or by an error, leaves nothing behind. The bytes on disk depend on the
    arrays and attributes alone: not on their order, nor on how appended rows were cut into pieces.

    Parameters
    ----------
    folder : Path
        Where the result will be.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._scratch = (
            Path(tempfile.gettempdir()) / f"citystitch-{uuid.uuid4().hex}" if in_bucket(folder) else None
        )
        self._partial = (self._scratch or folder.parent) / f".{folder.name}.{uuid.uuid4().hex}{PARTIAL}"
        self._small: dict[str, NDArray[Any]] = {}
        self._buffers: dict[str, RowBuffer] = {}
        self._table: Table = {}
        self._hashes: dict[str, blake3] = {}
        self._files: dict[str, list[int]] = {}  # size and CRC-32 by path
        self._folders: set[Path] = set()

    def __enter__(self) -> Self:
        with self._disk():
            self._partial.mkdir(parents=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        shutil.rmtree(self._scratch or self._partial, ignore_errors=True)

    def put(self, **arrays: ArrayLike) -> None:
        """Write whole arrays, each name once.

        Raises
        ------
        ValueError
            If a name came before, or an array is of a type that cannot be stored (objects, complex numbers).
        OutputError
            If the disk refuses.
        """
        for name, values in arrays.items():
            self._put(name, self._take(name, values))

    def put_rasters(self, **rasters: ArrayLike) -> None:
        """Write whole arrays of rows and columns, each name once, in square chunks, to read windows of them.

        Raises
        ------
        ValueError
            As from `put`, or if an array has not two axes.
        OutputError
            If the disk refuses.
        """
        for name, values in rasters.items():
            raster = self._take(name, values)
            if raster.ndim != 2 or raster.dtype.kind == "U":
                raise ValueError(f"array {name}: {raster.dtype} {raster.shape} is no raster")
            self._put(name, raster, square=True)

    def append(self, **arrays: ArrayLike) -> None:
        """Append rows to arrays, which grow chunk by chunk on disk: about 4 MB of each are held in memory.

        Raises
        ------
        ValueError
            If the rows differ in type or shape from those before, or the array was put.
        OutputError
            If the disk refuses.
        """
        for name, values in arrays.items():
            check_name(name)
            rows = plain_array(name, values)
            if rows.ndim == 0:
                raise ValueError(f"array {name}: a single value has no rows to append")
            if name not in self._buffers:
                if name in self._small or name in self._table:
                    raise ValueError(f"array {name} is written twice")
                self._buffers[name] = RowBuffer(name, rows)
            chunks = self._buffers[name].add(rows)
            self._hash(name, rows)
            for whole in chunks:
                self._extend(name, whole)

    def discard(self) -> None:
        """Forget all arrays that were written so far."""
        for name in self._table:
            shutil.rmtree(self._partial / name, ignore_errors=True)
        self._small, self._buffers, self._table, self._hashes = {}, {}, {}, {}
        self._files, self._folders = {}, set()

    def commit(self, attributes: Mapping[str, Any] | None = None, *, apart: Collection[str] = ()) -> str:
        """Make the result visible, in place of an earlier one.

        Parameters
        ----------
        attributes : mapping, optional
            Plain JSON values by name, without NaN.
        apart : collection of str
            Attributes that are no content: they do not count for the digest.

        Returns
        -------
        str
            Digest of the content, 32 hexadecimal digits: BLAKE3 of name, type, shape and raw bytes of every array
            and of the attributes. Equal content has equal digests, however it was put.

        Raises
        ------
        ValueError
            If the attributes are no plain JSON, or use a name of `RESERVED`.
        OutputError
            If the disk refuses.
        """
        kept = plain_json(dict(attributes or {}))
        if set(kept) & set(RESERVED):
            raise ValueError(f"attributes may not be named {' or '.join(RESERVED)}")
        for name, buffer in sorted(self._buffers.items()):
            rest = buffer.rest()
            if name not in self._table:
                self._put(name, rest)
            elif len(rest):
                self._extend(name, rest)
        if self._small:
            packed, table = pack(self._small)
            if len(packed) <= INLINE_BYTES:
                self._table[PACKED] = {"base64": base64.b64encode(packed.data).decode()}
            else:
                self._create(PACKED, packed)
            self._table |= table
        digest = self._digest({name: value for name, value in kept.items() if name not in apart})
        kept["digest"] = digest
        kept["arrays"] = plain_json(self._table)
        with self._disk():
            for name, entry in self._table.items():
                if "crc" in entry:
                    self._write(f"{name}/{GROUP}", ChunkForm.of(entry).describe())
            files = dict(sorted(self._files.items(), key=lambda one: one[0].split("/")))
            kept |= {"files": files, "checksum": "0" * 8}
            self._write(GROUP, seal(describe_group(dict(sorted(kept.items())))))
            self._replace()
        return digest

    def _take(self, name: str, values: ArrayLike) -> NDArray[Any]:
        """Check a whole array and hash it."""
        check_name(name)
        if name in self._small or name in self._table or name in self._buffers:
            raise ValueError(f"array {name} is written twice")
        array = plain_array(name, values)
        self._hash(name, array)
        return array

    def _hash(self, name: str, rows: NDArray[Any]) -> None:
        """Hash the bytes of an array as they come: how rows were cut does not show in them."""
        if name not in self._hashes:
            self._hashes[name] = blake3()
        self._hashes[name].update(raw_bytes(rows).data)

    def _digest(self, attributes: Mapping[str, Any]) -> str:
        arrays = [
            [name, self._table[name]["dtype"], self._table[name]["shape"], found.hexdigest(DIGEST_BYTES)]
            for name, found in sorted(self._hashes.items())
        ]
        return hash_content(arrays, attributes)

    def _put(self, name: str, array: NDArray[Any], *, square: bool = False) -> None:
        if array.nbytes <= PACKED_BYTES or array.ndim == 0:
            self._small[name] = array.copy()
        else:
            self._create(name, array, square=square)

    def _create(self, name: str, array: NDArray[Any], *, square: bool = False) -> None:
        chunk, *further = (max(n, 1) for n in array.shape)
        entry: dict[str, Any] = {"dtype": array.dtype.str, "shape": list(array.shape)}
        if square:
            chunk, further = min(chunk, SQUARE), [min(further[0], SQUARE)]
            entry |= {"chunk": chunk, "columns": further[0], "crc": square_checksums(array)}
        else:
            chunk = min(chunk, rows_per_chunk(array))
            entry |= {"chunk": chunk, "crc": checksums(array, chunk)}
        self._table[name] = entry
        self._compress(name, array)

    def _extend(self, name: str, rows: NDArray[Any]) -> None:
        """Add rows to an array on disk that ends with a whole chunk."""
        if name not in self._table:
            self._create(name, rows)
            return
        entry = self._table[name]
        first = len(entry["crc"])
        entry["shape"][0] += len(rows)
        entry["crc"] += checksums(rows, entry["chunk"])
        self._compress(name, rows, first)

    def _compress(self, name: str, values: NDArray[Any], first: int = 0) -> None:
        """Write the chunks of an array, or of further rows of it."""
        with self._disk():
            for file, data in ChunkForm.of(self._table[name]).compress(values, first):
                self._write(f"{name}/{file}", data)

    def _write(self, file: str, data: bytes) -> None:
        path = self._partial / file
        if path.parent not in self._folders:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._folders.add(path.parent)
        path.write_bytes(data)
        self._files[file] = [len(data), crc32(data)]

    def _replace(self) -> None:
        """Rename into place; another writer of the same result may do so at the same moment."""
        if in_bucket(self._folder):
            from tiler.objects.results import publish

            publish(self._partial, self._folder, GROUP)
            return
        old = self._partial.with_name(f".{self._folder.name}.{uuid.uuid4().hex}{PARTIAL}")
        while True:
            try:
                os.replace(self._partial, self._folder)
                return
            except OSError as error:
                if error.errno not in {errno.ENOTEMPTY, errno.EEXIST}:
                    raise
            try:
                os.replace(self._folder, old)
            except FileNotFoundError:
                continue
            delete(old)

    @contextmanager
    def _disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(
                f"{self._folder}: cannot be written ({error}); free space there or choose another folder"
            ) from error


def plain_json(value: Any) -> Any:
    """Bring a value into plain JSON (tuples become lists) with sorted keys.

    Raises
    ------
    ValueError
        If it holds NaN, infinity, or anything but dicts, lists, strings, numbers, booleans and None.
    """
    try:
        return json.loads(json.dumps(value, sort_keys=True, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{error}; give plain JSON values, None for what is not there") from error


def hash_content(arrays: list[list[Any]], attributes: Mapping[str, Any]) -> str:
    """Make the digest of a result: name, type, shape and hash of each array, and the attributes that count."""
    text = json.dumps([arrays, attributes], sort_keys=True)
    return blake3(text.encode()).hexdigest(DIGEST_BYTES)


def delete(path: Path) -> None:
    """Delete a folder or a file, as far as that can be done."""
    if in_bucket(path):
        withdraw(path)
    elif path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def withdraw(path: "ObjectPath") -> None:
    """Delete the objects of a result or a stage, those that make it visible first."""
    from tiler.objects.path import delete_below

    delete_below(path, GROUP)
