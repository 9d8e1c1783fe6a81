"""One result on its way into the store: see `tiler.store.result_file` for what its file is made of."""

import json
import shutil
import tempfile
import uuid
from collections.abc import Collection, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self
from zipfile import ZipFile, ZipInfo

import numpy as np
from blake3 import blake3
from numpy.typing import ArrayLike, NDArray

from tiler.objects.places import in_bucket
from tiler.store.atomic import disk_errors, replacing
from tiler.store.checksums import TAIL, seal_file
from tiler.store.result_file import GROUP, KINDS, NPY, rows_per_chunk

if TYPE_CHECKING:
    import zarr
    from zarr.abc.buffer import Buffer

MANY_CHUNKS = {"codec_pipeline.batch_size": 1000}  # of an array are handed to zarr's threads at once
SMALL_BYTES = 512 * 2**10  # zarr takes longer to open and read a smaller array than numpy
SQUARE = 320  # rows and columns of a raster's chunks: a neighbour mostly reads a strip
DIGEST_BYTES = 16  # of the 32 that BLAKE3 gives
DIGEST = "digest"  # the attribute of the store's own


class Writer:
    """One result on its way into the store; nothing of it is visible before `commit`.

    Leaving the context without a commit, or by an error, leaves nothing behind. The bytes on disk depend on the
    arrays and attributes alone: not on their order, nor on how appended rows were cut into pieces.

    Parameters
    ----------
    path : Path
        Where the result will be.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        beside = Path(tempfile.gettempdir()) if in_bucket(path) else path.parent
        self._chunks = beside / f".{path.stem}.{uuid.uuid4().hex}.partial"  # of arrays that grow
        self._parts: dict[str, Buffer] = {}  # what zarr has written
        self._small: dict[str, NDArray[Any]] = {}
        self._large: dict[str, zarr.Array[Any]] = {}
        self._begun: dict[str, list[NDArray[Any]]] = {}  # appended rows that make no whole chunk yet
        self._hashes: dict[str, blake3] = {}

    def __enter__(self) -> Self:
        with disk_errors(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        shutil.rmtree(self._chunks, ignore_errors=True)

    def put(self, **arrays: ArrayLike) -> None:
        """Write whole arrays, each name once.

        ValueError if a name came before, or for objects and complex numbers; OutputError if the disk refuses.
        """
        for name, values in arrays.items():
            self._put(name, self._take(name, values))

    def put_rasters(self, **rasters: ArrayLike) -> None:
        """Write arrays of rows and columns, in square chunks to read windows of them; errors as from `put`."""
        for name, values in rasters.items():
            raster = plain_array(name, values)
            if raster.ndim != 2 or raster.dtype.kind == "U":
                raise ValueError(f"array {name}: {raster.dtype} {raster.shape} is no raster")
            self._put(name, self._take(name, raster), square=True)

    def append(self, **arrays: ArrayLike) -> None:
        """Append rows to arrays, which grow chunk by chunk on disk; errors as from `put`.

        About 4 MB of each are held in memory, of strings all. All rows have one type and width, else ValueError.
        """
        for name, values in arrays.items():
            rows = plain_array(name, values)
            if rows.ndim == 0:
                raise ValueError(f"array {name}: a single value has no rows to append")
            if name not in self._begun:
                self._take(name, rows[:0])
                self._begun[name] = [rows[:0].copy()]
            begun = self._begun[name]
            if rows.dtype != begun[0].dtype or rows.shape[1:] != begun[0].shape[1:]:
                raise ValueError(
                    f"array {name}: rows of {rows.dtype} {rows.shape[1:]} appended to rows of {begun[0].dtype} "
                    f"{begun[0].shape[1:]}; give all pieces one type and width"
                )
            self._hashes[name].update(raw_bytes(rows).data)
            begun.append(rows.copy())
            chunk = rows_per_chunk(rows)
            if rows.dtype.kind != "U" and (count := sum(map(len, begun))) >= chunk:
                joined, whole = np.concatenate(begun), count // chunk * chunk
                self._extend(name, joined[:whole])
                self._begun[name] = [joined[whole:].copy()]

    def discard(self) -> None:
        """Forget all arrays that were written so far."""
        shutil.rmtree(self._chunks, ignore_errors=True)
        self._parts, self._small, self._large, self._begun, self._hashes = {}, {}, {}, {}, {}

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
            If the attributes are no plain JSON, or use the name `DIGEST`.
        OutputError
            If the disk refuses.
        """
        kept = plain_json(dict(attributes or {}))
        if DIGEST in kept:
            raise ValueError(f"attributes may not be named {DIGEST}")
        for name, begun in self._begun.items():
            rest = np.concatenate(begun)
            if name not in self._large:
                self._put(name, rest)
            elif len(rest):
                self._extend(name, rest)
        written: dict[str, Any] = {**self._small, **self._large}
        arrays = [
            [name, array.dtype.str, list(array.shape), self._hashes[name].hexdigest(DIGEST_BYTES)]
            for name, array in sorted(written.items())
        ]
        digest = hash_content(arrays, {name: value for name, value in kept.items() if name not in apart})
        group = {"attributes": dict(sorted((kept | {DIGEST: digest}).items()))}
        text = json.dumps(group | {"zarr_format": 3, "node_type": "group"}).encode()
        with disk_errors(self._path), replacing(self._path) as part:
            self._write_zip(part, text)
        return digest

    def _write_zip(self, part: Path, group: bytes) -> None:
        """Write the file: parts in the order of their names, without the time."""
        kept = {path.relative_to(self._chunks).as_posix() for path in self._chunks.rglob("*") if path.is_file()}
        with ZipFile(part, "w") as file:
            file.comment = b"0" * TAIL
            for name in sorted({GROUP, *kept, *self._parts, *(name + NPY for name in self._small)}):
                with file.open(ZipInfo(name), "w") as entry:
                    if name == GROUP:
                        entry.write(group)
                    elif name in kept:
                        entry.write((self._chunks / name).read_bytes())
                    elif name in self._parts:
                        entry.write(self._parts[name].to_bytes())
                    else:
                        array = self._small[name.removesuffix(NPY)]
                        np.lib.format.write_array(entry, array, version=(1, 0), allow_pickle=False)
        seal_file(part)

    def _take(self, name: str, values: ArrayLike) -> NDArray[Any]:
        """Check a whole array and hash it: how rows were cut does not show in the hash."""
        if not name.isidentifier() or not name.isascii() or name[0] == "_":
            raise ValueError(f"array name {name!r}: letters, digits and underscores only, a letter first")
        if name in self._hashes:
            raise ValueError(f"array {name} is written twice")
        array = plain_array(name, values)
        self._hashes[name] = blake3(raw_bytes(array).data)
        return array

    def _put(self, name: str, array: NDArray[Any], *, square: bool = False) -> None:
        if array.nbytes <= SMALL_BYTES or array.ndim == 0 or array.dtype.kind == "U":
            self._small[name] = array.copy()
        elif square:
            self._create(name, array, (min(len(array), SQUARE), min(array.shape[1], SQUARE)))
        else:
            self._create(name, array, (min(len(array), rows_per_chunk(array)), *array.shape[1:]))

    def _extend(self, name: str, rows: NDArray[Any]) -> None:
        """Add rows to an array that ends with a whole chunk; chunks of arrays that grow go to the disk at once."""
        if name not in self._large:
            self._create(name, rows, (rows_per_chunk(rows), *rows.shape[1:]))
        else:
            self._large[name].append(rows)
        with disk_errors(self._path):
            for key in [key for key in self._parts if key.startswith(f"{name}/c/")]:
                (self._chunks / key).parent.mkdir(parents=True, exist_ok=True)
                (self._chunks / key).write_bytes(self._parts.pop(key).to_bytes())

    def _create(self, name: str, array: NDArray[Any], chunks: tuple[int, ...]) -> None:
        import zarr
        from zarr.codecs import BloscCodec
        from zarr.storage import MemoryStore

        with zarr.config.set(MANY_CHUNKS):
            self._large[name] = zarr.create_array(
                MemoryStore(self._parts),
                name=name,
                data=array,
                chunks=chunks,
                # Bytes of numbers apart, then LZ4: three times as fast as zarr's default, a tenth larger.
                compressors=BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"),
                zarr_format=3,
                config={"write_empty_chunks": True},
            )


def plain_array(name: str, values: ArrayLike) -> NDArray[Any]:
    """Bring an array into the form that is stored: contiguous, little-endian, of a fixed size.

    Booleans, integers, floats of at most 8 bytes and strings (``<U``) can be; ValueError for others.
    """
    array = np.asarray(values)
    kind, size = array.dtype.kind, array.dtype.itemsize
    if kind not in KINDS or (kind == "f" and size > 8):
        raise ValueError(f"array {name}: {array.dtype} cannot be stored; give booleans, numbers or <U strings")
    dtype = array.dtype.newbyteorder("<") if size else np.dtype("<U1")
    return np.ascontiguousarray(array, dtype=dtype).reshape(array.shape)


def raw_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """View a plain array as its bytes, (n_bytes,)."""
    return array.reshape(-1).view(np.uint8)


def plain_json(value: Any) -> Any:
    """Bring a value into plain JSON (tuples become lists) with sorted keys; ValueError if it is none."""
    try:
        return json.loads(json.dumps(value, sort_keys=True, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{error}; give plain JSON values, None for what is not there") from error


def hash_content(arrays: list[list[Any]], attributes: Mapping[str, Any]) -> str:
    """Make the digest of a result: name, type, shape and hash of each array, and the attributes that count."""
    text = json.dumps([arrays, attributes], sort_keys=True)
    return blake3(text.encode()).hexdigest(DIGEST_BYTES)
