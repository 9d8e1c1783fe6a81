"""The store: whole or not at all, any plain array, every damage found, the same bytes for the same result."""

import json
import os
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from zarr.storage import ZipStore

from pipeline.data.errors import InputError, OutputError
from tests.helpers.result_parts import parts, write_parts
from tiler.store.remembered import remembering
from tiler.store.result_file import CHUNK_BYTES
from tiler.store.result_writer import SMALL_BYTES, SQUARE
from tiler.store.store import SMALL, Store

RNG = np.random.default_rng(7)
N_CHUNK = CHUNK_BYTES // 24  # rows of three float64 in a chunk
BIG = RNG.normal(size=(2 * N_CHUNK + 5, 3))  # three chunks, the last one short
DTYPES = ["f8", "f4", "i8", "i4", "u1", "?", "<U7"]
SIZES = [0, 1, 3, SMALL_BYTES + 1]  # in rows: in the form of numpy, and in that of zarr


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store.zarr")


def contents(path: Path) -> dict[str, bytes]:
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def sample(dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    return RNG.integers(-3, 100, shape).astype(dtype)


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


def test_a_process_that_remembers_reads_a_small_result_once_and_gives_copies(store: Store) -> None:
    with remembering():
        for answer in (1.0, 2.0):
            store.write("s", "n", {"a": np.full(3, answer)}, answer=answer)
            for _ in range(2):
                arrays, attributes = store.read("s", "n")
                assert (arrays["a"].tolist(), attributes) == ([answer] * 3, {"answer": answer})
                arrays["a"][:], attributes["answer"] = -1, -1
        store.write("s", "large", {"a": RNG.normal(size=SMALL)})
        store.read("s", "large")
        for path in (store.file("s", "n"), store.file("s", "large")):
            stat = path.stat()
            with path.open("r+b") as file:  # damage that changes neither inode nor size nor time
                file.write(b"x" * stat.st_size)
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        assert store.read("s", "n")[0]["a"].tolist() == [2.0] * 3
        with pytest.raises(InputError):
            store.read("s", "large")
    with pytest.raises(InputError):
        store.read("s", "n")


def test_bits_come_back_as_they_were(store: Store) -> None:
    odd = np.array([-0.0, np.nan, np.inf, 5e-324])
    negative_zeros = np.full(SMALL_BYTES, -0.0)
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


def test_a_result_is_one_file_that_numpy_and_zarr_read(store: Store) -> None:
    arrays: dict[str, Any] = {f"a{k}": np.arange(400) + k for k in range(50)}
    with store.writer("s", "n") as writer:
        writer.put(**arrays, big=BIG)
        writer.put_rasters(z=BIG[:1000, :2] @ np.ones((2, 900)))
        writer.commit({"facts": {"n": 3}})
    (file,) = contents(store.path)
    assert file == "s/n.zip"
    with np.load(store.path / file) as found:
        np.testing.assert_array_equal(found["a3"], arrays["a3"])
    group = zarr.open_group(ZipStore(store.path / file, mode="r"), mode="r")
    assert group.attrs["facts"] == {"n": 3}
    np.testing.assert_array_equal(group["big"][:], BIG)  # type: ignore[index]
    assert group["z"].chunks == (SQUARE, SQUARE)  # type: ignore[union-attr]
    assert len(parts(store.path / file)) == 1 + 50 + (1 + 3) + (1 + 4 * 3)


def test_only_named_arrays_are_read(store: Store) -> None:
    store.write("s", "n", {"big": BIG, "small": np.arange(3)})
    file = store.file("s", "n")
    write_parts(file, {name: data for name, data in parts(file).items() if "/c/" not in name})
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
    read: list[str] = []
    original = ZipFile.read

    def watch(self: ZipFile, name: Any, pwd: Any = None) -> bytes:
        read.append(name)
        return original(self, name, pwd)

    monkeypatch.setattr(ZipFile, "read", watch)
    found = store.read_ranges("s", "n", ["numbers", "big"], ranges)
    assert list(found) == ["big", "numbers"]
    assert found["big"].tobytes() == BIG[rows].tobytes()
    assert found["numbers"].tolist() == numbers[rows].tolist()
    assert len(read) == len(set(read))
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
    found = parts(store.file("s", "n"))
    assert sorted(name for name in found if "/c/" in name) == [f"z/c/{j}/{i}" for j in range(3) for i in range(3)]
    for name in found:
        if "/c/" in name and name != "z/c/1/2":
            found[name] = b"not read"
    write_parts(store.file("s", "n"), found)
    window = (SQUARE, 2 * SQUARE), (2 * SQUARE, 3 * SQUARE - 7)
    assert np.array_equal(store.read_window("s", "n", "z", *window), raster[slice(*window[0]), slice(*window[1])])
    for (top, bottom), (left, right) in [((SQUARE - 1, SQUARE + 1), window[1]), (window[0], (5, 2 * SQUARE + 1))]:
        with pytest.raises(InputError, match=r"stage s, n: z in .* is damaged"):
            store.read_window("s", "n", "z", (top, bottom), (left, right))


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
    file = store.file("s", "n")
    whole, found = file.read_bytes(), parts(file)
    for chunk in range(3):
        name = f"big/c/{chunk}/0"
        begin = whole.index(found[name])
        flipped = bytearray(whole)
        flipped[begin + int(RNG.integers(len(found[name])))] ^= 1
        write_parts(file, {key: data for key, data in found.items() if key != name})
        with pytest.raises(InputError, match="2 files for the 3 chunks"):
            store.read_rows("s", "n", "big", 0, 1)
        damages = [bytes(flipped)]
        for part in (b"", found[name][:-9]):  # under right checksums
            write_parts(file, found | {name: part})
            damages.append(file.read_bytes())
        for damage in damages:
            file.write_bytes(damage)
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


@pytest.mark.parametrize("seed", range(3))
def test_no_changed_byte_is_read_as_another_value(store: Store, seed: int) -> None:
    """Each is found by the checksum of the file; a read gives the values that were written, or an error."""
    rng = np.random.default_rng(seed)
    arrays = {"big": np.arange(50_000.0), "few": np.arange(9), "text": np.array(["a", "bc"])}
    store.write("s", "n", arrays, height=3.5)
    file = store.file("s", "n")
    whole = file.read_bytes()
    assert store.find_damage("s", "n") == ""
    ends = len(whole) - 1 - rng.integers(0, 2000, 150)  # the list of files, the comment
    for place in [*ends.tolist(), *rng.integers(0, len(whole), 50).tolist()]:
        data = bytearray(whole)
        data[place] ^= int(rng.integers(1, 256))
        file.write_bytes(data)
        assert store.find_damage("s", "n") == "its checksum differs"
        try:
            found, attributes = store.read("s", "n", names=arrays)
        except (InputError, ValueError):
            continue
        assert attributes == {"height": 3.5}
        assert all(found[name].tobytes() == values.tobytes() for name, values in arrays.items())
    for size in rng.integers(0, len(whole), 20).tolist():
        for rest in (whole[:size], whole[:size] + bytes(len(whole) - size)):
            file.write_bytes(rest)
            assert store.find_damage("s", "n") == "its checksum differs"
            with pytest.raises(InputError, match="is damaged"):
                store.read("s", "n")
    file.unlink()
    assert store.find_damage("s", "n") == "is not there"


def test_an_array_that_is_gone_or_changed_its_shape_is_found(store: Store) -> None:
    store.write("s", "n", {"big": BIG})
    file = store.file("s", "n")
    found = parts(file)
    metadata = json.loads(found["big/zarr.json"])
    metadata["shape"][0] -= N_CHUNK
    write_parts(file, found | {"big/zarr.json": json.dumps(metadata).encode()})
    with pytest.raises(InputError, match="3 files for the 2 chunks"):
        store.read("s", "n")
    del found["big/zarr.json"]
    write_parts(file, found)
    with pytest.raises(ValueError, match="no array big, it has: none"):
        store.read("s", "n", names=["big"])


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
    assert [p.name for p in (store.path / "s").iterdir()] == ["n.zip"]


def test_two_writers_of_one_result(store: Store) -> None:
    with store.writer("s", "n") as first, store.writer("s", "n") as second:
        first.put(a=np.arange(3))
        second.put(a=np.arange(3))
        first.commit()
        second.commit()
    assert store.read("s", "n")[0]["a"].tolist() == [0, 1, 2]
    assert [p.name for p in (store.path / "s").iterdir()] == ["n.zip"]


def test_what_killed_writers_left_is_swept(store: Store) -> None:
    store.write("s", "n", {})
    writer = store.writer("s", "m").__enter__()
    writer.put(big=BIG)
    store.sweep("s")
    assert [p.name for p in (store.path / "s").iterdir()] == ["n.zip"]


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
            ("_a", np.arange(3), "letters"),
            ("a/b", np.arange(3), "letters"),
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
            writer.commit({"digest": "1"})
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
