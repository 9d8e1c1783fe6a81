"""Inputs are read once: points dealt out to cells, footprints to a grid, both found again by box."""

from pathlib import Path

import laspy
import numpy as np
import pytest

from pipeline.errors import InputError
from pipeline.pointcloud import PointCloud
from tests.test_clouds import EVERYWHERE, ORIGIN, patch, write_cloud
from tiler import clouds
from tiler.cells import Box, select_cells
from tiler.clouds import find_clouds, read_points
from tiler.copc import read_index
from tiler.ingest import CELL, PointBlock, crop_cloud, read_cells
from tiler.lasheader import read_promise

SIDE = 1000.0


def sorted_rows(cloud: PointCloud) -> np.ndarray:
    rows = np.column_stack((cloud.xyz, cloud.classification))
    return rows[np.lexsort(rows.T)]


def whole(blocks: list[PointBlock]) -> PointCloud:
    xyz = np.concatenate([block.xyz for block in blocks])
    return PointCloud(xyz, np.concatenate([block.classification for block in blocks]))


def found(blocks: list[PointBlock], box: Box, size: float = CELL) -> PointCloud:
    """Read a box back as a reader of the store does: the ranges of rows, then the crop."""
    parts = [
        PointCloud(block.xyz[first:stop], block.classification[first:stop])
        for block in blocks
        for first, stop in select_cells(block.cell, block.start, box, size=size)
    ]
    xyz = np.concatenate([np.empty((0, 3)), *(part.xyz for part in parts)])
    classes = np.concatenate([np.empty(0, np.uint8), *(part.classification for part in parts)])
    return crop_cloud(PointCloud(xyz, classes), box)


def total(blocks: list[PointBlock]) -> dict[str, int]:
    return {key: sum(block.counts[key] for block in blocks) for key in blocks[0].counts}


@pytest.fixture(scope="module")
def cloud_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A square km around a corner of the grid, with withheld points, noise and one building point."""
    rng = np.random.default_rng(3)
    xyz = ORIGIN + rng.uniform((-SIDE / 2, -SIDE / 2, 0), (SIDE / 2, SIDE / 2, 20), (20000, 3)).round(2)
    xyz[:200, :2] = ORIGIN[:2] + CELL * rng.integers(-6, 6, (200, 2))  # on the corners of cells
    path = write_cloud(tmp_path_factory.mktemp("cloud") / "a.laz", xyz, rng.choice([1, 2, 7, 9], len(xyz)))
    las = laspy.read(path)
    las.withheld = (rng.random(len(xyz)) < 0.1).astype(np.uint8)
    las.write(path)
    return path


@pytest.mark.parametrize("size", [50.0, CELL, 300.0])
def test_cells_are_sorted_and_hold_their_points(cloud_file: Path, size: float) -> None:
    (block,) = read_cells(cloud_file, EVERYWHERE, size=size)
    kept, counts = read_points(cloud_file, EVERYWHERE)
    cell = np.floor(kept.xyz[:, :2] / size)
    order = np.lexsort((np.arange(len(cell)), cell[:, 0], cell[:, 1]))
    np.testing.assert_array_equal(block.xyz, kept.xyz[order])
    np.testing.assert_array_equal(block.classification, kept.classification[order])
    np.testing.assert_array_equal(np.repeat(block.cell, np.diff(block.start), axis=0), cell[order])
    assert (np.diff(block.start) > 0).all()
    assert block.counts == counts
    assert counts["withheld"] > 0 < counts["noise"]


def test_cells_are_the_same_in_every_region(cloud_file: Path) -> None:
    x, y, _ = ORIGIN
    (small,) = read_cells(cloud_file, (x - 100, y - 100, x + 100, y + 100))
    assert small.cell[0].tolist() == np.floor(np.array([x - 100, y - 100]) / CELL).tolist()
    (large,) = read_cells(cloud_file, EVERYWHERE)
    for k, (i, j) in enumerate(small.cell):
        if (np.abs(np.array([i + 0.5, j + 0.5]) * CELL - ORIGIN[:2]) < 60).all():  # wholly in the small region
            (row,) = np.flatnonzero((large.cell == (i, j)).all(axis=1))
            mine = small.xyz[small.start[k] : small.start[k + 1]]
            assert mine.tobytes() == large.xyz[large.start[row] : large.start[row + 1]].tobytes()


def test_a_box_finds_all_its_points(cloud_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clouds, "CHUNK_POINTS", 3000)
    blocks = list(read_cells(cloud_file, EVERYWHERE))
    assert len(blocks) == 7
    x, y, _ = ORIGIN
    for a, b in ((0, 0), (64, 64), (64, 0), (1, 200), (333.3, 17), (9999, 9999)):
        box = (x - a, y - b, x + b, y + a)
        expected, _ = read_points(cloud_file, box)
        assert len(expected.xyz) > 0
        np.testing.assert_array_equal(sorted_rows(found(blocks, box)), sorted_rows(expected))
    assert len(found(blocks, (x + 5000, y, x + 6000, y + 10)).xyz) == 0


def test_blocks_add_up_to_the_file(cloud_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = (ORIGIN[0] - 100, ORIGIN[1] - 100, ORIGIN[0] + 100, ORIGIN[1] + 100)
    monkeypatch.setattr(clouds, "CHUNK_POINTS", 999)
    blocks = list(read_cells(cloud_file, box))
    kept, counts = read_points(cloud_file, box)
    assert len(blocks) == 21
    assert total(blocks) == counts
    np.testing.assert_array_equal(sorted_rows(whole(blocks)), sorted_rows(kept))


def test_classes_are_told_before_the_cut(tmp_path: Path) -> None:
    xyz = ORIGIN + np.array([(0, 0, 0), (500, 500, 0), (9, 9, 0)])
    path = write_cloud(tmp_path / "a.laz", xyz, [2, 6, 7])
    (block,) = read_cells(path, (ORIGIN[0], ORIGIN[1], ORIGIN[0] + 10, ORIGIN[1] + 10))
    assert block.classification.tolist() == [2]
    assert block.classes.tolist() == [2, 6, 7]
    assert block.classes.dtype == np.uint8


def test_ranges_of_rows_are_merged() -> None:
    cell = np.array([[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 2]])
    start = np.array([0, 2, 3, 7, 8, 9, 11])
    assert select_cells(cell, start, (0, 0, 200, 200), size=64.0) == [(0, 11)]
    assert select_cells(cell, start, (64, 64, 64, 64), size=64.0) == [(8, 9)]
    assert select_cells(cell, start, (70, 0, 200, 70), size=64.0) == [(2, 7), (8, 9)]
    assert select_cells(cell, start, (-9, -9, -1, -1), size=64.0) == []


def test_no_points_are_one_empty_block(tmp_path: Path) -> None:
    (block,) = read_cells(write_cloud(tmp_path / "a.laz", np.empty((0, 3))), EVERYWHERE)
    assert block.xyz.shape == (0, 3)
    assert block.cell.shape == (0, 2)
    assert block.start.tolist() == [0]
    assert len(block.classes) == 0
    assert set(block.counts.values()) == {0}
    assert select_cells(block.cell, block.start, EVERYWHERE, size=CELL) == []


def test_bad_files_and_sizes_are_refused(tmp_path: Path, cloud_file: Path) -> None:
    cut = tmp_path / "cut.laz"
    cut.write_bytes(cloud_file.read_bytes()[:-5000])
    with pytest.raises(InputError, match="cut"):
        list(read_cells(cut, EVERYWHERE))
    with pytest.raises(ValueError, match="size of cells 0"):
        next(read_cells(cloud_file, EVERYWHERE, size=0))


def write_copc(path: Path, xyz: np.ndarray, classes: np.ndarray, *, depth: int = 3, shift: float = 0.0) -> Path:
    """Write a COPC file with the points spread over the levels of its octree."""
    import copclib as copc

    side = 1024.0
    corner = ORIGIN - (side / 2, side / 2, 0) + (shift, shift, 0)
    writer = copc.FileWriter(
        str(path), copc.CopcConfigWriter(6, copc.Vector3(0.01, 0.01, 0.01), copc.Vector3(*ORIGIN))
    )
    info = writer.copc_config.copc_info
    info.halfsize, info.spacing = side / 2, 10.0
    info.center_x, info.center_y, info.center_z = corner + side / 2
    level = np.arange(len(xyz)) % depth
    key = np.floor((xyz - ORIGIN + (side / 2, side / 2, 0)) / (side / 2.0 ** level[:, None])).astype(int)
    rows = np.column_stack((level, key))
    for node in np.unique(rows, axis=0):
        points = copc.Points(writer.copc_config.las_header)
        for row in np.flatnonzero((rows == node).all(axis=1)):
            point = points.CreatePoint()
            point.x, point.y, point.z = xyz[row].tolist()
            point.classification = int(classes[row])
            points.AddPoint(point)
        writer.AddNode(copc.VoxelKey(*node.tolist()), points)
    header = writer.copc_config.las_header
    header.min, header.max = copc.Vector3(*xyz.min(axis=0)), copc.Vector3(*xyz.max(axis=0))
    writer.Close()
    return path


@pytest.fixture(scope="module")
def copc_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(5)
    xyz = ORIGIN + rng.uniform((-500, -500, 0), (500, 500, 20), (6000, 3)).round(2)
    return write_copc(tmp_path_factory.mktemp("copc") / "plain.laz", xyz, rng.choice([1, 2, 6, 7], len(xyz)))


def test_copc_by_query_is_copc_from_end_to_end(copc_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    x, y, _ = ORIGIN
    box = (x - 100, y - 300, x + 30.5, y - 128)
    monkeypatch.setattr(clouds, "CHUNK_POINTS", 500)
    looked = [len(chunk) for chunk, _, _ in clouds.read_chunks(copc_file, box)]
    assert max(looked) < 2500  # a node here has 2000 points at most
    assert len(looked) > 1
    assert sum(looked) < 0.6 * 6000
    query = list(read_cells(copc_file, box))
    monkeypatch.setattr(clouds, "QUERY_SHARE", 0.0)
    plain = list(read_cells(copc_file, box))
    assert total(query) == total(plain)
    assert total(query)["kept"] > 50
    np.testing.assert_array_equal(sorted_rows(whole(query)), sorted_rows(whole(plain)))
    monkeypatch.setattr(clouds, "CHUNK_POINTS", 10**6)
    (once,) = read_cells(copc_file, box)
    monkeypatch.setattr(clouds, "QUERY_SHARE", 0.5)
    (same,) = read_cells(copc_file, box)
    assert once.xyz.tobytes() == same.xyz.tobytes()  # in the same order, too
    assert set(same.classes) == {1, 2, 6, 7}


def test_copc_is_queried_only_where_that_saves_half(copc_file: Path) -> None:
    x, y, _ = ORIGIN
    skipped = [
        next(clouds.read_chunks(copc_file, (x - 600, y - 600, right, y + 600)))[2] for right in (x - 20, x + 20)
    ]
    assert skipped[0] > 1000
    assert skipped[1] == 0


def test_copc_away_from_the_box_is_not_read(copc_file: Path) -> None:
    (block,) = read_cells(copc_file, (0.0, 0.0, 100.0, 100.0))
    assert block.counts == {"read": 6000, "outside": 6000, "withheld": 0, "noise": 0, "absurd": 0, "kept": 0}
    assert len(block.classes) == 0


def test_an_octree_that_does_not_fit_is_not_used(copc_file: Path, tmp_path: Path) -> None:
    x, y, _ = ORIGIN
    box = (x - 100, y - 300, x + 30.5, y - 128)
    data = copc_file.read_bytes()
    assert read_index(copc_file, read_promise(copc_file)) is not None
    expected = sorted_rows(whole(list(read_cells(copc_file, box))))
    info = 375 + 54
    for place, form, value in (
        (info, "d", float("nan")),  # centre
        (info, "d", x + 300),
        (info + 24, "d", 200.0),  # half side
        (info + 40, "Q", 2**60),  # first page
        (info + 48, "Q", 32),  # its size: the root node alone
        (info + 48, "Q", 0),
    ):
        bad = tmp_path / "bad.laz"
        bad.write_bytes(data)
        patch(bad, place, form, value)
        assert read_index(bad, read_promise(bad)) is None
        np.testing.assert_array_equal(sorted_rows(whole(list(read_cells(bad, box)))), expected)


def test_points_outside_their_node_are_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    xyz = ORIGIN + rng.uniform((-400, -400, 0), (400, 400, 20), (300, 3)).round(2)
    path = write_copc(tmp_path / "a.copc.laz", xyz, np.full(300, 2), shift=50.0)
    with pytest.raises(InputError, match=r"outside their node of the COPC index.*plain\.laz"):
        list(read_cells(path, (ORIGIN[0], ORIGIN[1], ORIGIN[0] + 100, ORIGIN[1] + 100)))


@pytest.mark.shared
def test_real_clouds_come_back(shared_data: Path) -> None:
    box = (120800.0, 486000.0, 121000.0, 486200.0)
    n_found = 0
    for path in find_clouds([shared_data / "amsterdam" / "tiles"])[:8]:
        blocks = list(read_cells(path, EVERYWHERE))
        kept, counts = read_points(path, box)
        assert total(blocks)["read"] == counts["read"]
        np.testing.assert_array_equal(sorted_rows(found(blocks, box)), sorted_rows(kept))
        n_found += len(kept.xyz)
    assert n_found > 30000
