"""What the store writes without zarr is what zarr writes: the same files, byte for byte."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from tiler.store.packing import shorten_chunk
from tiler.store.store import Store
from tiler.store.zarr_files import DECODER, GROUP, NUMBERS, ChunkForm, describe_group

RNG = np.random.default_rng(5)
ARRAYS: dict[str, tuple[NDArray[Any], tuple[int, ...]]] = {
    "rows": (RNG.standard_normal((1000, 3)), (400, 3)),
    "whole chunks": (RNG.integers(0, 9, 800).astype(np.int32), (400,)),
    "raster": (np.cumsum(RNG.standard_normal((70, 50)).astype(np.float32), axis=0), (32, 32)),
    "nothing but zeros": (np.zeros((70, 50)), (32, 32)),
    "booleans": (RNG.random(900) < 0.5, (256,)),
    "bytes": (RNG.integers(0, 255, 900).astype(np.uint8), (256,)),
    "small integers": (RNG.integers(-99, 99, (300, 2, 2)).astype(np.int16), (100, 2, 2)),
    "negative zero, infinity, no number": (np.array([-0.0, np.inf, np.nan, 1.0]), (3,)),
}


@pytest.mark.parametrize("dtype", [*sorted(NUMBERS), "<c16", "<M8[s]"])
def test_all_types_are_described_as_zarr_does(dtype: str, tmp_path: Path) -> None:
    codec = BloscCodec(cname="lz4", clevel=5, shuffle="shuffle")
    zarr.create_array(
        str(tmp_path), shape=(70, 50), chunks=(32, 16), dtype=dtype, compressors=codec, zarr_format=3
    )
    assert ChunkForm(np.dtype(dtype), (70, 50), (32, 16)).describe() == (tmp_path / GROUP).read_bytes()


@pytest.mark.parametrize("kind", ARRAYS)
def test_files_are_those_of_zarr(kind: str, tmp_path: Path) -> None:
    array, chunk = ARRAYS[kind]
    zarr.create_array(
        str(tmp_path),
        data=array,
        chunks=chunk,
        zarr_format=3,
        compressors=BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"),
        config={"write_empty_chunks": True},
    )
    form = ChunkForm(array.dtype, array.shape, chunk)
    assert dict(form.compress(array)) | {GROUP: form.describe()} == files_below(tmp_path)


def test_further_rows_are_those_of_zarr(tmp_path: Path) -> None:
    array, chunk = ARRAYS["rows"]
    form = ChunkForm(array.dtype, array.shape, chunk)
    assert dict(form.compress(array[:400])) | dict(form.compress(array[400:], 1)) == dict(form.compress(array))


def test_zarr_reads_rows_of_strings(tmp_path: Path) -> None:
    names = np.array([f"house {k}" for k in range(5000)])
    Store(tmp_path).write("houses", "all", {"name": names})
    found = zarr.open_array(str(tmp_path / "houses" / "all" / "name"), mode="r")[:]
    assert (np.asarray(found).view(names.dtype)[:, 0] == names).all()


def test_groups_are_those_of_zarr(tmp_path: Path) -> None:
    attributes = {"key": "0af3", "facts": {"n": 3, "extent": None}}
    zarr.create_group(str(tmp_path), zarr_format=3, attributes=attributes)
    assert describe_group(attributes) == (tmp_path / GROUP).read_bytes()


def files_below(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_chunk_that_the_array_hardly_fills_is_unpacked_as_far_as_it_does(tmp_path: Path) -> None:
    array, chunk = RNG.integers(0, 9, (30_000, 3)).astype(np.int32), (300_000, 3)
    form = ChunkForm(array.dtype, array.shape, chunk)
    ((file, data),) = form.compress(array)
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_bytes(data)
    assert (form.read(tmp_path, 0) == array).all()
    shorter = shorten_chunk(data, array.nbytes)
    unpacked = DECODER.decode(shorter)
    assert len(shorter) == len(data)
    assert array.nbytes <= len(unpacked) < array.nbytes + 2**20
    assert unpacked[: array.nbytes] == array.tobytes()


@pytest.mark.parametrize("rows", [1, 7, 399, 400])
def test_any_number_of_rows_of_any_chunk_is_unpacked(rows: int) -> None:
    for name, (array, _) in ARRAYS.items():
        some = np.ascontiguousarray(array[:rows])
        ((_, data),) = ChunkForm(some.dtype, some.shape, (1000, *some.shape[1:])).compress(some)
        assert DECODER.decode(shorten_chunk(data, some.nbytes))[: some.nbytes] == some.tobytes(), name
