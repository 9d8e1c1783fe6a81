"""The store: whole or not at all, any plain array, every damage found, the same bytes for the same result."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import InputError, OutputError
from tiler.store.packing import CHUNK_BYTES, CHUNK_HEAD, INLINE_BYTES, PACKED_BYTES, SQUARE, verified_chunks
from tiler.store.store import Store

RNG = np.random.default_rng(7)
N_CHUNK = CHUNK_BYTES // 24  # rows of three float64 in a chunk
BIG = RNG.normal(size=(2 * N_CHUNK + 5, 3))  # three chunks, the last one short
DTYPES = ["f8", "f4", "i8", "i4", "u1", "?", "<U7"]
SIZES = [0, 1, 3, PACKED_BYTES]  # in rows: inline, and an array of its own


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store.zarr")


def contents(path: Path) -> dict[str, bytes]:
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def sample(dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    return RNG.integers(-3, 100, shape).astype(dtype)


def chunk_files(store: Store, array: str) -> list[Path]:
    return sorted(p for p in (store.path / "s" / "n" / array / "c").rglob("*") if p.is_file())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n_rows", SIZES)
def test_every_type_comes_back_as_it_was(store: Store, dtype: str, n_rows: int) -> None:
    flat, table, none = sample(dtype, (n_rows,)), sample(dtype, (n_rows, 3)), sample(dtype, (n_rows, 0))
    store.write("s", "n", {"flat": flat, "table": table, "none": none}, size=1.5)
    arrays, attributes = store.read("s", "n")
    assert attributes == {"size": 1.5}
    assert list(arrays) == ["flat", "none", "table"]
    for name, values in {"flat": flat, "table": table, "none": none}.items():
        assert arrays[name].dtype == values.dtype
        np.testing.assert_array_equal(arrays[name], values)
    assert store.shapes("s", "n") == {"flat": (n_rows,), "none": (n_rows, 0), "table": (n_rows, 3)}


def test_bits_come_back_as_they_were(store: Store) -> None:
    odd = np.array([-0.0, np.nan, np.inf, 5e-324])
    negative_zeros = np.full(PACKED_BYTES, -0.0)
    store.write("s", "n", {"odd": odd, "zeros": negative_zeros, "single": np.float64(2.5)})
    arrays, _ = store.read("s", "n")
    assert arrays["odd"].tobytes() == odd.tobytes()
    assert arrays["zeros"].tobytes() == negative_zeros.tobytes()
    assert arrays["single"].shape == ()
    assert arrays["single"] == 2.5


def test_views_and_foreign_byte_order_are_stored_by_value(store: Store) -> None:
    grid = np.arange(12.0).reshape(3, 4)
    store.write("s", "n", {"turned": grid.T, "strided": grid[:, ::2], "big_endian": grid.astype(">f8")})
    arrays, _ = store.read("s", "n")
    np.testing.assert_array_equal(arrays["turned"], grid.T)
    np.testing.assert_array_equal(arrays["strided"], grid[:, ::2])
    np.testing.assert_array_equal(arrays["big_endian"], grid)


@pytest.mark.parametrize("n_small", [10, 400, 3000])
def test_small_arrays_share_one(store: Store, n_small: int) -> None:
    arrays: dict[str, Any] = {f"a{k}": np.arange(n_small) + k for k in range(5)}
    store.write("s", "n", arrays)
    n_files = len(contents(store.path))
    assert n_files == (1 if 40 * n_small <= INLINE_BYTES else 3)
    read, _ = store.read("s", "n", names=["a3"])
    assert list(read) == ["a3"]
    np.testing.assert_array_equal(read["a3"], arrays["a3"])


def test_only_named_arrays_are_read(store: Store) -> None:
    store.write("s", "n", {"big": BIG, "small": np.arange(3)})
    shutil.rmtree(store.path / "s" / "n" / "big" / "c")
    assert list(store.read("s", "n", names=["small"])[0]) == ["small"]
    assert store.read("s", "n", names=[])[0] == {}
    with pytest.raises(ValueError, match="no array huge, it has: big, small"):
        store.read("s", "n", names=["huge"])


def test_appended_rows_are_the_bytes_of_one_put(store: Store) -> None:
    ids = np.array([f"b{k}" for k in range(len(BIG))], dtype="<U9")
    store.write("put", "n", {"big": BIG, "ids": ids, "few": BIG[:7]}, a=1)
    for case, cuts in enumerate([[1], [N_CHUNK], [5, 5, N_CHUNK + 1, 2 * N_CHUNK], range(0, len(BIG), 40_000)]):
        with store.writer(f"append{case}", "n") as writer:
            for piece, names in zip(np.split(BIG, cuts), np.split(ids, cuts), strict=True):
                given = piece.copy()
                writer.append(big=given, ids=names)
                given[:] = 0  # the caller's own again
            writer.append(few=BIG[:0])
            writer.append(few=BIG[:7])
            writer.commit({"a": 1})
        assert contents(store.path / f"append{case}") == contents(store.path / "put")


def test_rows_of_a_part(store: Store) -> None:
    store.write("s", "n", {"big": BIG, "small": BIG[:9], "ids": np.array(["a", "bcd"] * 40_000)})
    for start, stop in [
        (0, 0),
        (0, 1),
        (N_CHUNK - 1, N_CHUNK + 1),
        (2 * N_CHUNK, len(BIG)),
        (0, len(BIG)),
        (7, 7),
    ]:
        np.testing.assert_array_equal(store.read_rows("s", "n", "big", start, stop), BIG[start:stop])
    np.testing.assert_array_equal(store.read_rows("s", "n", "small", 2, 9), BIG[2:9])
    assert store.read_rows("s", "n", "ids", 1, 3).tolist() == ["bcd", "a"]
    for start, stop in [(-1, 2), (3, 2), (0, len(BIG) + 1)]:
        with pytest.raises(ValueError, match="rows"):
            store.read_rows("s", "n", "big", start, stop)


@pytest.mark.parametrize(
    "ranges",
    [
        [],
        [(3, 3)],
        [(0, 2), (5, 9)],
        [(0, 2), (N_CHUNK - 1, N_CHUNK + 1), (N_CHUNK + 7, N_CHUNK + 8), (2 * N_CHUNK, len(BIG))],
        [(1, N_CHUNK), (N_CHUNK, N_CHUNK + 1), (2 * N_CHUNK + 1, 2 * N_CHUNK + 2)],
    ],
)
def test_ranges_are_read_at_once_and_chunks_once(
    store: Store, monkeypatch: pytest.MonkeyPatch, ranges: list[tuple[int, int]]
) -> None:
    numbers = np.arange(len(BIG), dtype=np.uint8)
    store.write("s", "n", {"big": BIG, "numbers": numbers, "few": BIG[:9]})
    rows = np.concatenate([np.empty(0, int), *(np.arange(*pair) for pair in ranges)])
    checked: list[int] = []

    def watch(rows: NDArray[Any], chunk: int, expected: list[int]) -> Iterator[int]:
        checked.extend(expected)
        return verified_chunks(rows, chunk, expected)

    monkeypatch.setattr("tiler.store.result_reader.verified_chunks", watch)
    found = store.read_ranges("s", "n", ["numbers", "big"], ranges)
    assert list(found) == ["big", "numbers"]
    assert found["big"].tobytes() == BIG[rows].tobytes()
    assert found["numbers"].tolist() == numbers[rows].tolist()
    assert len(checked) == len(set(checked))
    assert store.read_ranges("s", "n", ["few"], [(0, 2), (5, 8)])["few"].tolist() == BIG[[0, 1, 5, 6, 7]].tolist()
    with pytest.raises(ValueError, match="rows"):
        store.read_ranges("s", "n", ["few"], [(0, 10)])


def write_raster(store: Store, raster: NDArray[Any]) -> None:
    with store.writer("s", "n") as writer:
        writer.put_rasters(z=raster)
        writer.commit()


@pytest.mark.parametrize(
    "shape", [(2 * SQUARE, 3 * SQUARE), (2 * SQUARE + 1, 700), (5, 90_000), (90_000, 3), (4, 5), (0, 9)]
)
@pytest.mark.parametrize("dtype", ["f8", "i4"])
def test_windows_of_a_raster(store: Store, dtype: str, shape: tuple[int, int]) -> None:
    raster = sample(dtype, shape)
    write_raster(store, raster)
    assert np.array_equal(store.read("s", "n")[0]["z"], raster)
    assert np.array_equal(store.read_rows("s", "n", "z", shape[0] // 3, shape[0]), raster[shape[0] // 3 :])
    for _ in range(20):
        top, bottom = sorted(RNG.integers(0, shape[0] + 1, 2).tolist())
        left, right = sorted(RNG.integers(0, shape[1] + 1, 2).tolist())
        found = store.read_window("s", "n", "z", (top, bottom), (left, right))
        assert found.dtype == raster.dtype
        assert np.array_equal(found, raster[top:bottom, left:right])
    store.write("t", "n", {"z": raster})
    assert store.describe("s", "n") == store.describe("t", "n")
    assert store.compute_digest("s", "n") == store.describe("s", "n")[1]
    window = (0, shape[0]), (1, 4 if shape[1] > 3 else 3)
    assert np.array_equal(store.read_window("t", "n", "z", *window), raster[:, slice(*window[1])])


def test_a_window_reads_its_own_chunks_alone(store: Store) -> None:
    raster = RNG.normal(size=(3 * SQUARE, 3 * SQUARE - 7))
    write_raster(store, raster)
    files = chunk_files(store, "z")
    assert [path.relative_to(path.parents[1]).as_posix() for path in files] == [
        f"{j}/{i}" for j in range(3) for i in range(3)
    ]
    for path in files:
        if path.parts[-2:] != ("1", "2"):
            path.write_bytes(b"not read")
    window = (SQUARE, 2 * SQUARE), (2 * SQUARE, 3 * SQUARE - 7)
    assert np.array_equal(store.read_window("s", "n", "z", *window), raster[slice(*window[0]), slice(*window[1])])
    for (top, bottom), (left, right) in [((SQUARE - 1, SQUARE + 1), window[1]), (window[0], (5, 2 * SQUARE + 1))]:
        with pytest.raises(InputError, match=r"stage s, n: z in .* is damaged"):
            store.read_window("s", "n", "z", (top, bottom), (left, right))


def test_chunks_of_a_raster_in_each_others_place_are_found(store: Store) -> None:
    write_raster(store, RNG.normal(size=(2 * SQUARE, 2 * SQUARE)))
    one, other = chunk_files(store, "z")[1:3]
    data = one.read_bytes(), other.read_bytes()
    one.write_bytes(data[1])
    other.write_bytes(data[0])
    with pytest.raises(InputError, match="checksum differs in chunk 0/1"):
        store.read("s", "n")


def test_what_is_no_raster_or_beyond_it(store: Store) -> None:
    with store.writer("s", "n") as writer:
        for wrong in (np.zeros(3), np.zeros((3, 3, 3)), np.array([["a"]])):
            with pytest.raises(ValueError, match="no raster"):
                writer.put_rasters(z=wrong)
        writer.put(flat=BIG[0])
        writer.put_rasters(z=np.zeros((SQUARE, 2 * SQUARE)))
        with pytest.raises(ValueError, match="twice"):
            writer.put_rasters(z=np.zeros((2, 2)))
        writer.commit()
    with pytest.raises(ValueError, match="no raster"):
        store.read_window("s", "n", "flat", (0, 1), (0, 1))
    for rows, columns in [((-1, 2), (0, 1)), ((0, 1), (0, 2 * SQUARE + 1)), ((2, 1), (0, 1)), ((0, 1), (3, 2))]:
        with pytest.raises(ValueError, match="which has"):
            store.read_window("s", "n", "z", rows, columns)


def test_a_damaged_chunk_is_found_where_it_is_read_and_only_there(store: Store) -> None:
    ends = [(0, 1), (N_CHUNK, N_CHUNK + 1), (2 * N_CHUNK, len(BIG))]
    store.write("s", "n", {"big": BIG})
    for chunk, file in enumerate(chunk_files(store, "big")):
        whole = file.read_bytes()
        # In the rows: of the short chunk the zeros behind them are not unpacked (`shorten_chunk`).
        k = int.from_bytes(whole[CHUNK_HEAD : CHUNK_HEAD + 4], "little") + 8
        for damage in (None, b"", whole[:-9], whole[:k] + bytes([whole[k] ^ 1]) + whole[k + 1 :]):
            file.unlink() if damage is None else file.write_bytes(damage)
            for other, (start, stop) in enumerate(ends):
                if other == chunk:
                    with pytest.raises(InputError, match=r"stage s, n: big in .* is damaged"):
                        store.read_rows("s", "n", "big", start, stop)
                else:
                    store.read_rows("s", "n", "big", start, stop)
        with pytest.raises(InputError, match="big"):
            store.read("s", "n")
        file.write_bytes(whole)
    np.testing.assert_array_equal(store.read("s", "n")[0]["big"], BIG)


def test_damaged_attributes_are_found(store: Store) -> None:
    store.write("s", "n", {"small": np.arange(5)}, height=3.5)
    file = store.path / "s" / "n" / "zarr.json"
    whole = file.read_text()
    for damage in (whole[:-20], "", whole.replace("3.5", "3.6"), whole.replace('"base64": "A', '"base64": "B')):
        assert damage != whole
        file.write_text(damage)
        with pytest.raises(InputError, match=r"stage s, n: attributes .*damaged"):
            store.attributes("s", "n")
    file.write_text(whole)
    assert store.attributes("s", "n") == {"height": 3.5}


def test_an_array_that_is_gone_or_changed_its_shape_is_found(store: Store) -> None:
    store.write("s", "n", {"big": BIG})
    file = store.path / "s" / "n" / "big" / "zarr.json"
    metadata = json.loads(file.read_text())
    metadata["shape"][0] -= 1
    file.write_text(json.dumps(metadata))
    with pytest.raises(InputError, match="shape"):
        store.read("s", "n")
    shutil.rmtree(file.parent)
    with pytest.raises(InputError, match="big"):
        store.read("s", "n")


def test_what_is_not_there(store: Store) -> None:
    assert store.names("s") == []
    assert not store.has("s", "n")
    with pytest.raises(InputError, match="is not there"):
        store.read("s", "n")
    for name in ("", "..", ".x", "a/b"):
        with pytest.raises(ValueError, match="cannot name"):
            store.has("s", name)


def test_nothing_is_seen_before_commit_nor_left_without(store: Store) -> None:
    with store.writer("s", "n") as writer:
        writer.put(big=BIG)
        assert store.names("s") == []
        assert not store.has("s", "n")
    assert list((store.path / "s").iterdir()) == []
    with pytest.raises(ValueError, match="cannot be stored"), store.writer("s", "n") as writer:
        writer.put(big=BIG, bad=np.array([None]))
    assert list((store.path / "s").iterdir()) == []


def test_an_error_keeps_the_earlier_result_and_a_commit_replaces_it(store: Store) -> None:
    store.write("s", "n", {"a": np.arange(3), "old": BIG})
    before = contents(store.path)
    with pytest.raises(ValueError, match="cannot be stored"), store.writer("s", "n") as writer:
        writer.put(a=BIG, bad=np.array([None]))
    assert contents(store.path) == before
    store.write("s", "n", {"a": np.arange(4)})
    assert list(store.read("s", "n")[0]) == ["a"]
    assert [p.name for p in (store.path / "s").iterdir()] == ["n"]


def test_two_writers_of_one_result(store: Store) -> None:
    with store.writer("s", "n") as first, store.writer("s", "n") as second:
        first.put(a=np.arange(3))
        second.put(a=np.arange(3))
        first.commit()
        second.commit()
    assert store.read("s", "n")[0]["a"].tolist() == [0, 1, 2]
    assert [p.name for p in (store.path / "s").iterdir()] == ["n"]


def test_what_killed_writers_left_is_swept(store: Store) -> None:
    store.write("s", "n", {})
    writer = store.writer("s", "m").__enter__()
    writer.put(big=BIG)
    store.sweep("s")
    assert [p.name for p in (store.path / "s").iterdir()] == ["n"]


def test_the_order_of_arrays_and_attributes_does_not_show(store: Store) -> None:
    arrays: dict[str, Any] = {"b": np.arange(3), "a": BIG, "c": np.arange(50)}
    store.write("s", "n", arrays, x=1, y={"q": 1, "p": (2, 3)})
    store.write("t", "n", dict(reversed(arrays.items())), y={"p": [2, 3], "q": 1}, x=1)
    assert contents(store.path / "s") == contents(store.path / "t")


def test_wrong_arguments(store: Store) -> None:
    with store.writer("s", "n") as writer:
        writer.put(a=np.arange(3))
        for name, values, message in [
            ("a", np.arange(3), "twice"),
            ("o", np.array([None]), "cannot be stored"),
            ("z", np.array([1j]), "cannot be stored"),
            ("_packed", np.arange(3), "letters"),
        ]:
            with pytest.raises(ValueError, match=message):
                writer.put(**{name: values})
        writer.append(b=np.zeros((2, 3)))
        for rows in (np.zeros((2, 2)), np.zeros((2, 3), dtype=np.float32), np.array(1.0)):
            with pytest.raises(ValueError, match="append"):
                writer.append(b=rows)
        with pytest.raises(ValueError, match="twice"):
            writer.append(a=np.arange(3))
        with pytest.raises(ValueError, match="may not be named"):
            writer.commit({"checksum": 1})
        for bad in (float("nan"), {1, 2}, np.arange(3)):
            with pytest.raises(ValueError, match="plain JSON"):
                writer.commit({"x": bad})


def test_a_disk_that_refuses(tmp_path: Path) -> None:
    (tmp_path / "store.zarr").write_text("a file where the folder should be")
    with pytest.raises(OutputError, match="cannot be written"):
        Store(tmp_path / "store.zarr").write("s", "n", {})


def digest(store: Store, *, cut: tuple[int, ...] = (), apart: tuple[str, ...] = (), **attributes: Any) -> str:
    """Digest of a small and a large array, the large one appended in pieces."""
    with store.writer("s", "n") as writer:
        for piece in np.split(BIG, cut):
            writer.append(big=piece)
        writer.put(small=np.arange(3))
        found = writer.commit(attributes, apart=apart)
    assert store.describe("s", "n") == (attributes, found)
    return found


def test_the_digest_tells_content_and_not_how_it_was_put(store: Store) -> None:
    first = digest(store, size=1.5)
    assert digest(store, cut=(7, N_CHUNK + 3), size=1.5) == first
    assert digest(store, size=1.5, key="a", apart=("key",)) == first
    assert len({first, digest(store, size=1.6), digest(store, size=1.5, key="a")}) == 3
    store.write("s", "n", {"small": np.arange(3), "big": BIG}, size=1.5)
    assert store.describe("s", "n")[1] == first
    others: list[dict[str, NDArray[Any]]] = [
        {"small": np.arange(3), "big": -BIG},
        {"small": np.arange(3, dtype=np.int32), "big": BIG},
        {"small": np.arange(3).reshape(3, 1), "big": BIG},
        {"little": np.arange(3), "big": BIG},
        {"small": np.arange(3), "big": np.where(np.arange(len(BIG))[:, None] == 5, 0.0, BIG)},
    ]
    digests = []
    for arrays in others:
        store.write("s", "n", arrays, size=1.5)
        digests.append(store.describe("s", "n")[1])
    assert len({first, *digests}) == len(others) + 1


def test_discarded_rows_do_not_count_for_the_digest(store: Store) -> None:
    with store.writer("s", "n") as writer:
        writer.append(rows=np.arange(5))
        writer.discard()
        writer.append(rows=np.arange(2))
        found = writer.commit()
    store.write("s", "other", {"rows": np.arange(2)})
    assert store.describe("s", "other")[1] == found


def test_results_and_stages_are_removed_whole(store: Store) -> None:
    for stage, name in (("s", "a"), ("s", "b"), ("t", "a")):
        store.write(stage, name, {"big": BIG})
    store.remove("s", "a")
    store.remove("s", "a")
    assert (store.names("s"), store.stages()) == (["b"], ["s", "t"])
    store.remove("t")
    store.remove("none")
    assert store.stages() == ["s"]
    assert [path.name for path in store.path.iterdir()] == ["s"]
