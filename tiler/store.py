"""The store: results by stage and name in zarr (v3), written whole or not at all, verified on every read.

A result is a zarr group ``<stage>/<name>``. Arrays above 32 kB are arrays of their own; smaller ones lie in one
array of bytes, ``_packed``, and if all of them are less than 16 kB, in the group's attributes. These hold what the
writer gave, ``arrays`` (type and shape of each array and the CRC-32 of the raw bytes of each chunk), ``digest``, a
hash of the content, ``files``, size and CRC-32 of every file of the arrays as it lies on disk, and ``checksum``,
the CRC-32 of the file that the attributes are in. In a bucket each file is an object, and that of the attributes
is put last (`tiler.objects.results`).
"""

import base64
import errno
import hashlib
import json
import math
import os
import shutil
import tempfile
import uuid
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import zarr
from numcodecs import Blosc
from numpy.typing import ArrayLike, NDArray
from zarr.codecs import BloscCodec

from pipeline.errors import InputError, OutputError
from tiler.packing import (
    CHUNK_HEAD,
    INLINE_BYTES,
    PACKED_BYTES,
    RowBuffer,
    Table,
    as_rows,
    check_chunk,
    check_entry,
    check_name,
    checksums,
    pack,
    plain_array,
    raw_bytes,
    rows_per_chunk,
    unpack,
    verified_chunks,
)
from tiler.places import in_bucket, read_at_most
from tiler.seal import is_sealed, seal
from tiler.written import GONE, find_changed_files, state_files

if TYPE_CHECKING:
    from tiler.objects.path import ObjectPath

PACKED = "_packed"
# Bytes of numbers apart, then LZ4: written three times as fast as with zarr's default, a tenth more on disk. zarr
# calls it from threads of its own, where Blosc uses one thread: the bytes are always the same.
COMPRESSION = BloscCodec(cname="lz4", clevel=5, shuffle="shuffle")
CODECS = ["bytes", "blosc"]  # what chunks are written with
DECODER = Blosc()  # takes how a chunk was compressed from its head
RESERVED = ("arrays", "checksum", "digest", "files")
PARTIAL = ".partial"
GROUP = "zarr.json"  # the file of a result's attributes
MANIFEST = "manifest.jsonl"  # the only file beside the stages, see `tiler.manifest`


class Store:
    """Results by stage and name below one folder.

    Parameters
    ----------
    path : Path
        Folder of the store; made when first written to.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def folder(self, stage: str, name: str) -> Path:
        """Say where a result lies; ValueError for a name that is no plain folder name."""
        for part in (stage, name):
            if not part or part[0] == "." or any(sign in part for sign in "/\\\0"):
                raise ValueError(f"{part!r} cannot name a folder of the store")
        return self.path / stage / name

    def writer(self, stage: str, name: str) -> "Writer":
        """Begin a result: a context manager with ``put``, ``append`` and ``commit``."""
        return Writer(self.folder(stage, name))

    def write(self, stage: str, name: str, arrays: Mapping[str, ArrayLike], **attributes: Any) -> None:
        """Write one result; it becomes visible at once and whole."""
        with self.writer(stage, name) as writer:
            writer.put(**arrays)
            writer.commit(attributes)

    def read(
        self, stage: str, name: str, *, names: Collection[str] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Read one result: its arrays and its attributes.

        Parameters
        ----------
        stage, name : str
            Which result.
        names : collection of str, optional
            Arrays to read; all by default, none for an empty collection.

        Raises
        ------
        InputError
            If it is not there or damaged; the message names stage, name and array.
        ValueError
            If it has no array of such a name.
        """
        folder = self.folder(stage, name)
        table, attributes, _ = _open(folder, stage, name)
        wanted = sorted(set(names)) if names is not None else sorted(set(table) - {PACKED})
        entries = {array: _entry(folder, table, array, stage, name) for array in wanted}
        packed = None
        if any("offset" in entry for entry in entries.values()):
            packed = _read_packed(folder, stage, name, table)
        arrays: dict[str, NDArray[Any]] = {}
        for array, entry in entries.items():
            if packed is not None and "offset" in entry:
                with _damage(folder, stage, name, array):
                    arrays[array] = unpack(packed, entry)
            else:
                arrays[array] = _read_chunks(folder, stage, name, array, entry)
        return arrays, attributes

    def read_rows(self, stage: str, name: str, array: str, start: int, stop: int) -> NDArray[Any]:
        """Read some rows of one array; only the chunks that hold them are decompressed and verified.

        Raises
        ------
        InputError
            If the result is not there, or a chunk that is needed is damaged.
        ValueError
            If there is no such array, or not ``0 <= start <= stop <= n_rows``.
        """
        return self.read_ranges(stage, name, [array], [(start, stop)])[array]

    def read_ranges(
        self, stage: str, name: str, names: Collection[str], ranges: Sequence[tuple[int, int]]
    ) -> dict[str, NDArray[Any]]:
        """Read ranges of rows of some arrays, put one after the other; errors as for `read_rows`.

        Parameters
        ----------
        stage, name : str
            Which result.
        names : collection of str
            Arrays to read.
        ranges : sequence of (start, stop)
            Rows, ascending and apart from each other. A chunk that holds rows of several of them is read once.
        """
        folder = self.folder(stage, name)
        table, _, _ = _open(folder, stage, name)
        found = {}
        for array in sorted(set(names)):
            entry = _entry(folder, table, array, stage, name)
            n_rows = entry["shape"][0] if entry["shape"] else 0
            for start, stop in ranges:
                if not 0 <= start <= stop <= n_rows:
                    raise ValueError(
                        f"stage {stage}, {name}: rows {start} to {stop} of {array}, which has {n_rows}"
                    )
            if "offset" in entry:
                packed = _read_packed(folder, stage, name, table)
                with _damage(folder, stage, name, array):
                    rows = unpack(packed, entry)
                found[array] = _join_rows([rows[start:stop] for start, stop in ranges], rows)
            else:
                found[array] = _read_chunks(folder, stage, name, array, entry, ranges)
        return found

    def attributes(self, stage: str, name: str) -> dict[str, Any]:
        """Read the attributes of a result and no array; InputError as for `read`."""
        return _open(self.folder(stage, name), stage, name)[1]

    def describe(self, stage: str, name: str) -> tuple[dict[str, Any], str]:
        """Read the attributes of a result and the digest of its content; InputError as for `read`."""
        _, attributes, digest = _open(self.folder(stage, name), stage, name)
        return attributes, digest

    def shapes(self, stage: str, name: str) -> dict[str, tuple[int, ...]]:
        """Tell the shape of every array of a result without reading any; InputError as for `read`."""
        table, _, _ = _open(self.folder(stage, name), stage, name)
        return {array: tuple(entry["shape"]) for array, entry in sorted(table.items()) if array != PACKED}

    def has(self, stage: str, name: str) -> bool:
        """Whether there is a committed result; its arrays are not looked at."""
        return (self.folder(stage, name) / GROUP).is_file()

    def names(self, stage: str) -> list[str]:
        """List the names that have a result of the stage, sorted."""
        folder = self.path / stage
        return sorted(entry.name for entry in folder.iterdir() if entry.name[0] != ".") if folder.is_dir() else []

    def stages(self) -> list[str]:
        """List the stages that have a folder, sorted."""
        return sorted(entry.name for entry in self.path.iterdir() if entry.is_dir()) if self.path.is_dir() else []

    def remove(self, stage: str, name: str | None = None) -> None:
        """Remove a result, or all of a stage; it is gone at once and whole. Nothing happens if it is not there."""
        folder = self.path / stage if name is None else self.folder(stage, name)
        if in_bucket(folder):
            _withdraw(folder)
            return
        gone = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}{PARTIAL}")
        try:
            os.replace(folder, gone)
        except FileNotFoundError:
            return
        except OSError as error:
            raise OutputError(f"{folder}: cannot be removed ({error}); check its permissions") from error
        _delete(gone)

    def sweep(self, stage: str) -> None:
        """Remove what killed writers of the stage left behind; no writer may be at work.

        In a bucket that lies where the result will be, and goes when it is put or pruned.
        """
        if in_bucket(self.path):
            return
        for folder in (self.path / stage).glob(f".*{PARTIAL}"):
            _delete(folder)

    def find_strays(self) -> list[Path]:
        """List what no writer of results has made: hidden entries of stages, and files beside these."""
        if not self.path.is_dir():
            return []
        beside = [entry for entry in self.path.iterdir() if not entry.is_dir() and entry.name != MANIFEST]
        if in_bucket(self.path):  # nothing is hidden there
            return sorted(beside)
        return sorted(beside + [entry for stage in self.stages() for entry in (self.path / stage).glob(".*")])

    def remove_strays(self) -> None:
        """Remove what `find_strays` lists; no writer may be at work."""
        for path in self.find_strays():
            _delete(path)

    def find_damage(self, stage: str, name: str) -> dict[str, str]:
        """Hold every file of a result against its checksum.

        Returns
        -------
        dict of str to str
            What is wrong, by path below the result's folder; empty for a sound result.

        Notes
        -----
        Bytes are read as they lie on disk, a megabyte at a time; nothing is decompressed. Strange files are named
        too.
        """
        folder = self.folder(stage, name)
        try:
            files = _read_group(folder)["files"]
        except FileNotFoundError:
            return {GROUP: GONE}
        except (OSError, ValueError, KeyError, TypeError) as error:
            return {GROUP: f"is damaged ({error})"}
        found = find_changed_files(folder, files)
        there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
        return found | dict.fromkeys(sorted(there - {GROUP, *files}), "is not of this result")

    def compute_digest(self, stage: str, name: str, *, apart: Collection[str] = ()) -> str:
        """Compute the digest of a result anew from all that is stored, a chunk at a time.

        Parameters
        ----------
        stage, name : str
            Which result.
        apart : collection of str
            Attributes that do not count, as for `Writer.commit`.

        Raises
        ------
        InputError
            If it is not there or damaged.
        """
        folder = self.folder(stage, name)
        table, attributes, _ = _open(folder, stage, name)
        packed = _read_packed(folder, stage, name, table) if PACKED in table else np.empty(0, np.uint8)
        arrays = []
        for array in sorted(set(table) - {PACKED}):
            entry = _entry(folder, table, array, stage, name)
            found = hashlib.blake2b(digest_size=16)
            if "offset" in entry:
                found.update(raw_bytes(unpack(packed, entry)).data)
            else:
                for start in range(0, entry["shape"][0], entry["chunk"]):
                    stop = min(start + entry["chunk"], entry["shape"][0])
                    rows = _read_chunks(folder, stage, name, array, entry, [(start, stop)])
                    found.update(raw_bytes(rows).data)
            arrays.append([array, entry["dtype"], entry["shape"], found.hexdigest()])
        return _hash_content(arrays, {key: value for key, value in attributes.items() if key not in apart})


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
        self._hashes: dict[str, hashlib.blake2b] = {}

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
            check_name(name)
            if name in self._small or name in self._table or name in self._buffers:
                raise ValueError(f"array {name} is written twice")
            array = plain_array(name, values)
            self._hash(name, array)
            self._put(name, array)

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
            self._buffers[name].add(rows)
            self._hash(name, rows)
            whole = self._buffers[name].whole_chunks()
            if whole is not None:
                self._extend(name, whole)

    def discard(self) -> None:
        """Forget all arrays that were written so far."""
        for name in self._table:
            shutil.rmtree(self._partial / name, ignore_errors=True)
        self._small, self._buffers, self._table, self._hashes = {}, {}, {}, {}

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
            Digest of the content, 32 hexadecimal digits: BLAKE2b of name, type, shape and raw bytes of every array
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
            files = sorted(path for path in self._partial.rglob("*") if path.is_file())
            kept |= {"files": state_files(self._partial, files), "checksum": "0" * 8}
            zarr.create_group(str(self._partial), zarr_format=3, attributes=dict(sorted(kept.items())))
            group = self._partial / GROUP
            group.write_bytes(seal(group.read_bytes()))
            self._replace()
        return digest

    def _hash(self, name: str, rows: NDArray[Any]) -> None:
        """Hash the bytes of an array as they come: how rows were cut does not show in them."""
        if name not in self._hashes:
            self._hashes[name] = hashlib.blake2b(digest_size=16)
        self._hashes[name].update(raw_bytes(rows).data)

    def _digest(self, attributes: Mapping[str, Any]) -> str:
        arrays = [
            [name, self._table[name]["dtype"], self._table[name]["shape"], found.hexdigest()]
            for name, found in sorted(self._hashes.items())
        ]
        return _hash_content(arrays, attributes)

    def _put(self, name: str, array: NDArray[Any]) -> None:
        if array.nbytes <= PACKED_BYTES or array.ndim == 0:
            self._small[name] = array.copy()
        else:
            self._create(name, array)

    def _create(self, name: str, array: NDArray[Any]) -> None:
        rows, chunk = as_rows(array), min(rows_per_chunk(array), max(len(array), 1))
        self._table[name] = {
            "dtype": array.dtype.str,
            "shape": list(array.shape),
            "chunk": chunk,
            "crc": checksums(array, chunk),
        }
        with self._disk():
            # Chunks of zeros are written too: how zarr tells -0.0 from 0.0 is its versions' own affair.
            zarr.create_array(
                str(self._partial / name),
                data=rows,
                chunks=(chunk, *(max(n, 1) for n in rows.shape[1:])),
                zarr_format=3,
                compressors=COMPRESSION,
                config={"write_empty_chunks": True},
            )

    def _extend(self, name: str, rows: NDArray[Any]) -> None:
        """Add rows to an array on disk that ends with a whole chunk."""
        if name not in self._table:
            self._create(name, rows)
            return
        entry = self._table[name]
        n_old, n_new = entry["shape"][0], entry["shape"][0] + len(rows)
        with self._disk():
            array = zarr.open_array(str(self._partial / name), mode="r+", config={"write_empty_chunks": True})
            array.resize((n_new, *array.shape[1:]))
            array[n_old:n_new] = as_rows(rows)
        entry["shape"][0] = n_new
        entry["crc"] += checksums(rows, entry["chunk"])

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
            _delete(old)

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


def _hash_content(arrays: list[list[Any]], attributes: Mapping[str, Any]) -> str:
    """Make the digest of a result: name, type, shape and hash of each array, and the attributes that count."""
    text = json.dumps([arrays, attributes], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _delete(path: Path) -> None:
    """Delete a folder or a file, as far as that can be done."""
    if in_bucket(path):
        _withdraw(path)
    elif path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _withdraw(path: "ObjectPath") -> None:
    from tiler.objects.path import delete_below

    delete_below(path, GROUP)


def _read_group(folder: Path) -> dict[str, Any]:
    """Read all attributes of a result; ValueError if its file is not as it was written."""
    text = (folder / GROUP).read_bytes()
    if not is_sealed(text):
        raise ValueError("checksum of the attributes differs")
    attributes: dict[str, Any] = json.loads(text)["attributes"]
    return attributes


def _open(folder: Path, stage: str, name: str) -> tuple[Table, dict[str, Any], str]:
    """Read the table of arrays, the attributes and the digest of a result."""
    with _damage(folder, stage, name, "attributes"):
        attributes = _read_group(folder)
        table, digest = attributes["arrays"], attributes["digest"]
        return table, {key: value for key, value in attributes.items() if key not in RESERVED}, digest


def _entry(folder: Path, table: Table, array: str, stage: str, name: str) -> dict[str, Any]:
    if array not in table or array == PACKED:
        names = ", ".join(sorted(set(table) - {PACKED})) or "none"
        raise ValueError(f"stage {stage}, {name}: no array {array}, it has: {names}")
    with _damage(folder, stage, name, array):
        check_entry(table[array])
    return table[array]


def _read_packed(folder: Path, stage: str, name: str, table: Table) -> NDArray[Any]:
    with _damage(folder, stage, name, PACKED):
        entry = table[PACKED]
        if "base64" not in entry:
            check_entry(entry)
    if "base64" in entry:  # under the checksum of the attributes
        return np.frombuffer(base64.b64decode(entry["base64"]), dtype=np.uint8)
    return _read_chunks(folder, stage, name, PACKED, entry)


def _read_chunks(
    folder: Path,
    stage: str,
    name: str,
    array: str,
    entry: Mapping[str, Any],
    ranges: Sequence[tuple[int, int]] | None = None,
) -> NDArray[Any]:
    """Read rows of one zarr array, all by default, and verify every chunk that was read."""
    n_rows, chunk = entry["shape"][0], entry["chunk"]
    wanted = [(0, n_rows)] if ranges is None else ranges
    parts = []
    with _damage(folder, stage, name, array):
        form = _ChunkForm.of(entry)
        form.check((folder / array / GROUP).read_bytes())
        for first, last, inside in _chunks_of_ranges(wanted, chunk):
            low, high = first * chunk, min(last * chunk, n_rows)
            rows = np.empty((max(high - low, 0), *form.shape[1:]), form.dtype)
            for k in range(first, last):
                start = k * chunk
                rows[start - low : start - low + chunk] = form.read(folder / array, k)[: high - start]
            wrong = [first + k for k in verified_chunks(rows, chunk, entry["crc"][first:last])]
            if wrong:
                raise ValueError(f"checksum differs in {len(wrong)} chunks, first in chunk {wrong[0]}")
            parts += [rows[start - low : stop - low] for start, stop in inside]
    return _join_rows(parts, rows)


@dataclass(frozen=True)
class _ChunkForm:
    """How zarr keeps an array of some type and shape: in chunks of so many rows, compressed by Blosc.

    zarr itself needs 2 ms to open and read a small array, a fifth of a run: its files are read here, by its codec.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Self:
        """Take the form from what the store says of an array."""
        shape = tuple(entry["shape"])
        return cls(np.dtype(entry["dtype"]), shape, (entry["chunk"], *(max(n, 1) for n in shape[1:])))

    def check(self, text: bytes) -> None:
        """Hold zarr's own description of the array against the form; ValueError if they differ."""
        found = json.loads(text)
        tail = (self.dtype.itemsize,) if self.dtype.kind == "U" else ()
        name = "uint8" if tail else self.dtype.name
        shape, expected = tuple(found["shape"]), (*self.shape, *tail)
        if shape != expected:
            raise ValueError(f"shape {shape} instead of {expected}")
        chunks = tuple(found["chunk_grid"]["configuration"]["chunk_shape"])
        codecs = [codec["name"] for codec in found["codecs"]]
        if found["data_type"] != name or chunks != (*self.chunk, *tail) or codecs != CODECS:
            raise ValueError(f"chunks {chunks} of {found['data_type']} by {', '.join(codecs)}")

    def read(self, folder: Path, k: int) -> NDArray[Any]:
        """Decompress a chunk, after its size and form are known to be right."""
        n_bytes = math.prod(self.chunk) * self.dtype.itemsize
        further = (0,) * (len(self.chunk) - 1 + (self.dtype.kind == "U"))
        data = read_at_most(folder / "c" / "/".join(map(str, (k, *further))), n_bytes + CHUNK_HEAD + 1)
        check_chunk(data, n_bytes)
        raw = np.frombuffer(DECODER.decode(data), np.uint8)
        return raw.view(self.dtype).reshape(self.chunk)[(slice(None), *map(slice, self.shape[1:]))]


def _chunks_of_ranges(
    ranges: Sequence[tuple[int, int]], chunk: int
) -> Iterator[tuple[int, int, list[tuple[int, int]]]]:
    """Group ascending ranges of rows that share chunks: first chunk, last and one more, and the ranges."""
    first, last, inside = 0, 0, list[tuple[int, int]]()
    for start, stop in ranges:
        begin, end = start // chunk, -(-stop // chunk)
        if inside and begin >= last:
            yield first, last, inside
            inside = []
        first, last = (first, max(last, end)) if inside else (begin, max(begin, end))
        inside.append((start, stop))
    yield first, last, inside


def _join_rows(parts: Sequence[NDArray[Any]], like: NDArray[Any]) -> NDArray[Any]:
    """Put rows one after the other in memory of their own, so that no chunk stays with a few of them."""
    if len(parts) == 1 and len(parts[0]) == len(like):
        return parts[0]
    return np.concatenate([like[:0], *parts])


@contextmanager
def _damage(folder: Path, stage: str, name: str, array: str) -> Iterator[None]:
    """Whatever zarr and its codecs raise on broken files becomes one error that says where."""
    try:
        yield
    except (MemoryError, OutputError):  # a bucket that does not answer has no damage
        raise
    except Exception as error:
        state = "is damaged" if (folder / GROUP).is_file() else "is not there"
        raise InputError(
            f"stage {stage}, {name}: {array} in {folder} {state} ({error}); run again: it is made anew"
        ) from error
