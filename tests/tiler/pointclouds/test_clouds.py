"""Step 1.1 at the edge: which files are found, what their headers may say, which points are read."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from numpy.typing import ArrayLike

from pipeline.data.errors import InputError
from tests.helpers.whole_clouds import read_points
from tiler.pointclouds import las_chunks
from tiler.pointclouds.clouds import find_clouds, read_header

EVERYWHERE = (-1e9, -1e9, 1e9, 1e9)
ORIGIN = np.array([120000.0, 486000.0, 0.0])


def write_cloud(
    path: Path, xyz: ArrayLike, classes: ArrayLike = 2, *, crs: str = "", version: str = "1.4", fmt: int = 6
) -> Path:
    header = laspy.LasHeader(version=version, point_format=fmt)
    header.scales, header.offsets = np.full(3, 0.01), ORIGIN - (0, 0, 7)
    if crs:
        header.add_crs(pyproj.CRS(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.asarray(xyz, float).reshape(-1, 3).T
    las.classification = np.broadcast_to(np.asarray(classes, np.uint8), len(las.points))
    las.write(path)
    return path


def patch(path: Path, place: int, form: str, *values: float) -> Path:
    data = bytearray(path.read_bytes())
    struct.pack_into("<" + form, data, place, *values)
    path.write_bytes(data)
    return path


@pytest.fixture
def xyz() -> np.ndarray:
    return ORIGIN + np.random.default_rng(1).uniform(0, 100, (5000, 3)).round(2)


@pytest.fixture
def laz(tmp_path: Path, xyz: np.ndarray) -> Path:
    return write_cloud(tmp_path / "a.laz", xyz)


def test_sources_are_files_globs_and_folders(tmp_path: Path) -> None:
    for name in ("b.laz", "a.LAS", "c.copc.laz", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "d.laz").touch()
    folder = [tmp_path / name for name in ("a.LAS", "b.laz", "c.copc.laz")]
    assert find_clouds([tmp_path]) == folder
    assert find_clouds([str(tmp_path / "b.laz"), tmp_path, tmp_path / "*.LAS"]) == folder
    assert find_clouds([tmp_path / "**" / "*.laz"]) == [*folder[1:], tmp_path / "deep" / "d.laz"]
    assert find_clouds([tmp_path / "notes.txt"]) == [tmp_path / "notes.txt"]


def test_two_names_of_one_file_are_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.laz").touch()
    monkeypatch.chdir(tmp_path)
    assert find_clouds(["./a.laz", tmp_path / "a.laz", "a.laz"]) == [tmp_path / "a.laz"]


def test_brackets_in_a_name_are_no_pattern(tmp_path: Path) -> None:
    (tmp_path / "a[1].laz").touch()
    assert find_clouds([tmp_path / "a[1].laz"]) == [tmp_path / "a[1].laz"]


@pytest.mark.parametrize(
    ("source", "message"), [("gone.laz", "no such file"), ("empty", "holds no .las"), ("*.laz", "matches no file")]
)
def test_missing_sources_are_named(tmp_path: Path, source: str, message: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=message) as caught:
        find_clouds([tmp_path / source])
    assert source in str(caught.value)
    with pytest.raises(InputError, match="no point cloud"):
        find_clouds([])


def test_header_says_count_bounds_and_crs(tmp_path: Path, xyz: np.ndarray) -> None:
    header = read_header(write_cloud(tmp_path / "a.laz", xyz, crs="EPSG:28992"))
    assert header.n_points == 5000
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    assert header.bounds == pytest.approx((*low[:2], *high[:2], low[2], high[2]), abs=1e-9)
    assert header.crs == pyproj.CRS("EPSG:28992")


def test_a_crs_that_cannot_be_parsed_is_none(tmp_path: Path, xyz: np.ndarray) -> None:
    path = write_cloud(tmp_path / "a.las", xyz, crs="EPSG:28992")
    path.write_bytes(path.read_bytes().replace(b'PROJCRS["', b'PROJKRS["').replace(b'PROJCS["', b'PROJKS["'))
    assert read_header(path).crs is None


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_no_points_are_fine(tmp_path: Path, suffix: str) -> None:
    path = write_cloud(tmp_path / f"empty.{suffix}", np.empty((0, 3)))
    assert read_header(path).n_points == 0
    assert np.isnan(read_header(path).bounds).all()
    cloud, counts = read_points(path, EVERYWHERE)
    assert cloud.xyz.shape == (0, 3)
    assert set(counts.values()) == {0}


@pytest.mark.parametrize(("version", "fmt"), [("1.2", 0), ("1.2", 3), ("1.4", 6), ("1.4", 7)])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_points_come_back(tmp_path: Path, xyz: np.ndarray, version: str, fmt: int, suffix: str) -> None:
    classes = np.resize([1, 2, 5, 6, 9], len(xyz))
    path = write_cloud(tmp_path / f"a.{suffix}", xyz, classes, version=version, fmt=fmt)
    cloud, counts = read_points(path, EVERYWHERE)
    las = laspy.read(path)
    assert cloud.xyz.tobytes() == np.column_stack((las.x, las.y, las.z)).tobytes()
    np.testing.assert_allclose(cloud.xyz, xyz, atol=1e-6)
    np.testing.assert_array_equal(cloud.classification, classes)
    assert counts == {"read": 5000, "outside": 0, "withheld": 0, "noise": 0, "absurd": 0, "kept": 5000}


def test_each_point_is_dropped_for_one_reason(tmp_path: Path) -> None:
    # One row a point: x, y, z, class, withheld. The box is [0, 10] x [0, 10] around the origin.
    rows = np.array(
        [
            (0, 0, 1, 2, 0),  # kept: the border belongs to the box
            (10, 10, 1, 6, 0),  # kept
            (5, 5, -9999, 2, 0),  # kept: low, but not absurd
            (10.01, 5, 1, 2, 0),  # outside
            (5, -0.01, 1, 7, 1),  # outside, though withheld noise too
            (5, 5, 1, 7, 1),  # withheld, though noise too
            (5, 5, 1, 7, 0),  # noise
            (5, 5, 1, 18, 0),  # noise
            (5, 5, 10000.01, 2, 0),  # absurd
        ]
    )
    path = write_cloud(tmp_path / "a.laz", rows[:, :3] + ORIGIN, rows[:, 3])
    las = laspy.read(path)
    las.withheld = rows[:, 4].astype(np.uint8)
    las.write(path)
    x, y, _ = ORIGIN
    cloud, counts = read_points(path, (x, y, x + 10, y + 10))
    np.testing.assert_allclose(cloud.xyz - ORIGIN, rows[:3, :3], atol=1e-6)
    assert cloud.classification.tolist() == [2, 6, 2]
    assert counts == {"read": 9, "outside": 2, "withheld": 1, "noise": 2, "absurd": 1, "kept": 3}


def test_chunks_do_not_change_the_result(laz: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, counts = read_points(laz, EVERYWHERE)
    monkeypatch.setattr(las_chunks, "CHUNK_POINTS", 999)
    parts, same = read_points(laz, EVERYWHERE)
    assert whole.xyz.tobytes() == parts.xyz.tobytes()
    assert counts == same


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 0.9999])
def test_a_file_cut_off_anywhere_is_refused(tmp_path: Path, xyz: np.ndarray, share: float, suffix: str) -> None:
    path = write_cloud(tmp_path / f"cut.{suffix}", xyz)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    if share < 0.9999 or suffix == "las":  # the last bytes of LAZ are the end of a compressed table
        with pytest.raises(InputError, match="cut"):
            read_header(path)
    with pytest.raises(InputError, match="cut") as caught:
        read_points(path, EVERYWHERE)
    if share >= 0.1:
        assert "of 5000 points could be read" in str(caught.value)
        assert "--skip-unreadable" in str(caught.value)


def test_damaged_points_are_refused(laz: Path) -> None:
    data = bytearray(laz.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    laz.write_bytes(data)
    assert read_header(laz).n_points == 5000
    with pytest.raises(InputError, match=r"damaged|could be read"):
        read_points(laz, EVERYWHERE)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_more_points_claimed_than_held(tmp_path: Path, xyz: np.ndarray, suffix: str) -> None:
    path = patch(write_cloud(tmp_path / f"a.{suffix}", xyz), 247, "Q", 2**60)
    with pytest.raises(InputError, match=f"of {2**60} points could be read"):
        read_points(path, EVERYWHERE)


def test_no_points_claimed_but_many_held(tmp_path: Path, xyz: np.ndarray) -> None:
    with pytest.raises(InputError, match="writer did not finish"):
        read_header(patch(write_cloud(tmp_path / "a.las", xyz), 247, "Q", 0))


@pytest.mark.parametrize(
    ("place", "form", "value", "message"),
    [
        (131, "d", float("nan"), "x scale nan"),
        (139, "d", 0.0, "y scale 0"),
        (147, "d", float("inf"), "z scale inf"),
        (155, "d", 2e8, "x offset 2e\\+08"),
        (163, "d", float("nan"), "y offset nan"),
        (94, "H", 60000, "header of 60000 bytes"),
        (96, "I", 2**31, "points from byte 2147483648"),
        (100, "I", 2**31, "2147483648 records"),
        (105, "H", 0, "point size"),
        (105, "H", 3, "point size"),
        (243, "I", 2**31, "2147483648 extended records"),
    ],
)
def test_absurd_headers_are_refused(laz: Path, place: int, form: str, value: float, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_header(patch(laz, place, form, value))
    assert str(laz) in str(caught.value)


@pytest.mark.parametrize(
    "ends",
    [
        {179: 1e9},
        {187: float("nan")},
        {203: 500000.0},
        {211: float("inf")},
        {187: 0.0, 203: 0.0, 219: 0.0},  # the low ends were never written
        dict.fromkeys((179, 187, 195, 203, 211, 219), 0.0),
        dict.fromkeys((179, 187), 120_000.0) | dict.fromkeys((195, 203), 487_000.0),  # one place for 5000 points
        {179: -1.7e308, 187: 1.7e308, 195: -1.7e308, 203: 1.7e308, 211: -1.7e308, 219: 1.7e308},
    ],
)
def test_a_void_box_of_the_header_is_that_of_the_points(laz: Path, ends: dict[int, float]) -> None:
    sound = read_header(laz)
    assert not sound.box_of_points
    for place, value in ends.items():
        patch(laz, place, "d", value)
    header = read_header(laz)
    assert header.box_of_points
    np.testing.assert_allclose(header.bounds, sound.bounds, atol=0.011)
    assert len(read_points(laz, EVERYWHERE)[0].xyz) == 5000


def test_a_chunk_table_beyond_the_file_is_refused(laz: Path) -> None:
    begin = struct.unpack_from("<I", laz.read_bytes(), 96)[0]
    table = struct.unpack_from("<q", laz.read_bytes(), begin)[0]
    with pytest.raises(InputError, match="4294967295 chunks"):
        read_header(patch(laz, table + 4, "I", 2**32 - 1))
    with pytest.raises(InputError, match="chunk table should begin at byte 7"):
        read_header(patch(laz, begin, "q", 7))


def test_a_chunk_table_may_be_found_from_the_end(laz: Path) -> None:
    whole, _ = read_points(laz, EVERYWHERE)
    begin = struct.unpack_from("<I", laz.read_bytes(), 96)[0]
    table = laz.read_bytes()[begin : begin + 8]
    patch(laz, begin, "q", -1)
    laz.write_bytes(laz.read_bytes() + table)
    assert read_header(laz).n_points == 5000
    assert read_points(laz, EVERYWHERE)[0].xyz.tobytes() == whole.xyz.tobytes()


def test_points_outside_their_header_are_refused(laz: Path) -> None:
    patch(laz, 179, "d", ORIGIN[0] + 50)
    assert read_header(laz).bounds[2] == ORIGIN[0] + 50
    with pytest.raises(InputError, match=r"outside the bounds in its header.*pdal translate a\.laz"):
        read_points(laz, EVERYWHERE)


def test_what_is_no_cloud_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.laz"
    text.write_text("x y z\n" * 1000)
    junk = tmp_path / "junk.laz"
    junk.write_bytes(b"LASF" + b"x y z\n" * 1000)
    for path in (text, junk, tmp_path / "gone.laz", tmp_path):
        with pytest.raises(InputError, match=path.name):
            read_header(path)
        with pytest.raises(InputError, match=path.name):
            read_points(path, EVERYWHERE)


def test_a_panic_of_the_decompressor_is_an_input_error(laz: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class PanicException(BaseException):
        pass

    def fail(error: BaseException) -> None:
        def open_(*_args: object, **_options: object) -> None:
            raise error

        monkeypatch.setattr(laspy, "open", open_)

    fail(PanicException("index out of bounds"))
    with pytest.raises(InputError, match=r"0 of 5000 points could be read \(PanicException: index"):
        read_points(laz, EVERYWHERE)
    fail(MemoryError())
    with pytest.raises(InputError, match="MemoryError"):
        read_points(laz, EVERYWHERE)
    fail(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        read_points(laz, EVERYWHERE)


@pytest.mark.shared
def test_real_clouds(shared_data: Path) -> None:
    paths = find_clouds([shared_data / "amsterdam" / "tiles"])
    headers = [read_header(path) for path in paths]
    assert len(paths) == 13
    assert sum(header.n_points for header in headers) == 1_226_167
    assert [header.path.name for header in headers if header.n_points == 0] == ["unit_25gn1_1.laz"]
    assert {header.crs for header in headers} == {None}
    box = (120800.0, 486000.0, 120900.0, 486100.0)
    cloud, counts = read_points(shared_data / "amsterdam" / "tiles" / "unit_25gn1_8.laz", box)
    assert counts["read"] == 92796
    assert counts["kept"] == len(cloud.xyz) == 92796 - counts["outside"] > 20000
    assert (cloud.xyz[:, :2] >= box[:2]).all()
    assert (cloud.xyz[:, :2] <= box[2:]).all()
    assert set(np.unique(cloud.classification)) <= {1, 2, 6, 9, 26}


def test_copc_is_read_like_any_laz(tmp_path: Path) -> None:
    """A COPC file of another writer, its points spread over two levels of its octree."""
    import copclib as copc

    rng = np.random.default_rng(2)
    xyz = np.round(rng.uniform((318000, 6399000, 0), (318064, 6399064, 20), (500, 3)), 2)
    scale, offset = copc.Vector3(0.01, 0.01, 0.01), copc.Vector3(318000, 6399000, 0)
    writer = copc.FileWriter(str(tmp_path / "a.copc.laz"), copc.CopcConfigWriter(6, scale, offset))
    writer.copc_config.copc_info.halfsize, writer.copc_config.copc_info.spacing = 64.0, 5.0
    for key, rows in (((0, 0, 0, 0), slice(0, 200)), ((1, 0, 0, 0), slice(200, 500))):
        points = copc.Points(writer.copc_config.las_header)
        for x, y, z in xyz[rows].tolist():
            point = points.CreatePoint()
            point.x, point.y, point.z, point.classification = x, y, z, 2
            points.AddPoint(point)
        writer.AddNode(copc.VoxelKey(*key), points)
    header = writer.copc_config.las_header
    header.min, header.max = copc.Vector3(*xyz.min(axis=0)), copc.Vector3(*xyz.max(axis=0))
    writer.Close()
    assert find_clouds([tmp_path]) == [tmp_path / "a.copc.laz"]
    assert read_header(tmp_path / "a.copc.laz").n_points == 500
    cloud, counts = read_points(tmp_path / "a.copc.laz", (318000.0, 6399000.0, 318064.0, 6399064.0))
    assert counts["kept"] == 500
    np.testing.assert_allclose(np.sort(cloud.xyz, axis=0), np.sort(xyz, axis=0), atol=0.006)
