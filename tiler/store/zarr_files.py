"""How zarr (v3) keeps an array of some type and shape: in chunks of rows (and columns), compressed by Blosc.

Chunks are read and written here, by zarr's codec. zarr itself hands each chunk to three threads, one after the
other, and waits: 2 ms to read a small array and 1.4 ms to write it, 18 ms instead of 6 to write a raster of
1,250 x 1,250 nodes, and more where other processes want the same cores. Groups and arrays of plain numbers are
described here, too, as it takes 0.15 s of each start to import zarr, which is asked for arrays of other types.
"""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from numcodecs import Blosc, blosc
from numpy.typing import NDArray

from tiler.objects.places import read_at_most
from tiler.store.packing import CHUNK_HEAD, check_chunk, shorten_chunk

NUMBERS = ("|b1", "|i1", "|u1", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8")  # described here
GROUP = "zarr.json"  # the file of what is said of an array, or of a group
CODECS = ["bytes", "blosc"]  # what chunks are written with
DECODER = Blosc()  # takes how a chunk was compressed from its head
# Bytes of numbers apart, then LZ4: written three times as fast as with zarr's default, a tenth more on disk.
COMPRESSION: Mapping[str, Any] = {"cname": "lz4", "clevel": 5, "shuffle": "shuffle", "blocksize": 0}

blosc.use_threads = False  # as zarr sets it: bytes are always the same

Place = tuple[int, ...]  # of a chunk: its number along each axis


@dataclass(frozen=True)
class ChunkForm:
    """Type and shape of an array, and the shape of its chunks.

    Strings are rows of bytes to zarr, which has no settled type for them.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Self:
        """Take the form from what the store says of an array."""
        shape = tuple(entry["shape"])
        further = (entry["columns"],) if "columns" in entry else (max(n, 1) for n in shape[1:])
        return cls(np.dtype(entry["dtype"]), shape, (entry["chunk"], *further))

    def describe(self) -> bytes:
        """What zarr says of such an array, in its own words: the array's `GROUP`."""
        tail = self._tail
        dtype = np.dtype(np.uint8) if tail else self.dtype
        return _describe(dtype.str, (*self.shape, *tail), (*self.chunk, *tail))

    def check(self, text: bytes) -> None:
        """Hold zarr's own description of the array against the form; ValueError if they differ."""
        found = json.loads(text)
        name = "uint8" if self._tail else self.dtype.name
        shape, expected = tuple(found["shape"]), (*self.shape, *self._tail)
        if shape != expected:
            raise ValueError(f"shape {shape} instead of {expected}")
        chunks = tuple(found["chunk_grid"]["configuration"]["chunk_shape"])
        codecs = [codec["name"] for codec in found["codecs"]]
        if found["data_type"] != name or chunks != (*self.chunk, *self._tail) or codecs != CODECS:
            raise ValueError(f"chunks {chunks} of {found['data_type']} by {', '.join(codecs)}")

    def read(self, folder: Path, *at: int) -> NDArray[Any]:
        """Decompress the chunk at a place, after its size and form are known to be right, cut to the array."""
        n_bytes = math.prod(self.chunk) * self.dtype.itemsize
        at += (0,) * (len(self.chunk) - len(at))
        data = read_at_most(folder / self._file(at), n_bytes + CHUNK_HEAD + 1)
        check_chunk(data, n_bytes)
        left = [size - k * step for size, k, step in zip(self.shape, at, self.chunk, strict=True)]
        rows, row_bytes = min(left[0], self.chunk[0]), n_bytes // self.chunk[0]
        raw = np.frombuffer(DECODER.decode(shorten_chunk(data, rows * row_bytes)), np.uint8)
        whole = raw[: rows * row_bytes].view(self.dtype).reshape(rows, *self.chunk[1:])
        return whole[tuple(map(slice, left))]

    def compress(self, values: NDArray[Any], first: int = 0) -> Iterator[tuple[str, bytes]]:
        """Compress rows of the array, whole chunks from the chunk row ``first`` on: file and bytes of each.

        Notes
        -----
        A chunk that the array does not fill ends with zeros, and chunks of zeros are written too. The bytes are
        those that zarr writes.
        """
        codec = _codec(1 if self._tail else self.dtype.itemsize)
        counts = (-(-size // step) for size, step in zip(values.shape, self.chunk, strict=True))
        for at in np.ndindex(*counts):
            block = values[tuple(slice(k * step, (k + 1) * step) for k, step in zip(at, self.chunk, strict=True))]
            if block.shape != self.chunk:
                whole = np.zeros(self.chunk, self.dtype)
                whole[tuple(map(slice, block.shape))] = block
                block = whole
            raw = np.ascontiguousarray(block).reshape(-1).view(np.uint8)
            yield self._file((first + at[0], *at[1:])), codec.encode(raw)

    @property
    def _tail(self) -> tuple[int, ...]:
        return (self.dtype.itemsize,) if self.dtype.kind == "U" else ()

    def _file(self, at: Place) -> str:
        """Name the file of a chunk, below the array's folder."""
        return "c/" + "/".join(map(str, (*at, *(0 for _ in self._tail))))


def describe_group(attributes: Mapping[str, Any]) -> bytes:
    """What zarr says of a group with such attributes, in its own words: the group's `GROUP`."""
    return _lay_out({"attributes": dict(attributes), "zarr_format": 3, "node_type": "group"})


def _describe(dtype: str, shape: Place, chunk: Place) -> bytes:
    said = _say_of_numbers(np.dtype(dtype)) if dtype in NUMBERS else _ask_of_arrays(dtype, len(shape))
    grid = {**said["chunk_grid"], "configuration": {"chunk_shape": list(chunk)}}
    return _lay_out({**said, "shape": list(shape), "chunk_grid": grid})


def _lay_out(said: Mapping[str, Any]) -> bytes:
    """Lay a description out as zarr does."""
    return json.dumps(said, indent=2).encode()


def _say_of_numbers(dtype: np.dtype[Any]) -> dict[str, Any]:
    """Describe an array as zarr does, but for its sizes; keys are in zarr's order."""
    order = {"configuration": {"endian": "little"}} if dtype.itemsize > 1 else {}
    return {
        "shape": [],
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular"},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": dtype.type(0).item(),
        "codecs": [
            {"name": "bytes", **order},
            {"name": "blosc", "configuration": {"typesize": dtype.itemsize, **COMPRESSION}},
        ],
        "attributes": {},
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


@cache
def _ask_of_arrays(dtype: str, n_axes: int) -> dict[str, Any]:
    """Ask zarr for its description of an array of a type; all of as many axes are alike but for their sizes."""
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.storage import MemoryStore

    said: dict[str, Any] = {}
    codec = BloscCodec(**COMPRESSION, typesize=np.dtype(dtype).itemsize)
    one = (1,) * n_axes
    zarr.create_array(MemoryStore(said), shape=one, dtype=dtype, chunks=one, zarr_format=3, compressors=codec)
    return dict(json.loads(said[GROUP].to_bytes()))


@cache
def _codec(typesize: int) -> Blosc:
    """The codec that zarr has for numbers of so many bytes."""
    return Blosc(**{**COMPRESSION, "shuffle": Blosc.SHUFFLE}, typesize=typesize)
