"""Inputs are read once: points dealt out to cells, footprints to a grid, both found again by box."""

import dataclasses
import struct
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import laspy
import numpy as np
import pyogrio
import pyproj
import pytest
import shapely

from pipeline.data.citymodel import Footprints, make_ids
from pipeline.data.errors import InputError
from pipeline.data.notes import Note, count_notes
from pipeline.data.pointcloud import PointCloud
from pipeline.points_terrain.las_points import cut_units
from tests.helpers.footprint_reading import read_footprints
from tests.helpers.whole_clouds import read_points
from tests.tiler.pointclouds.test_clouds import EVERYWHERE, ORIGIN, patch, write_cloud
from tests.tiler.vectors.test_vectors import RD, square, write, write_parquet
from tiler.citymodels.tables import unpack_polygons
from tiler.config.config import Config
from tiler.engine.engine import Engine
from tiler.engine.executor import Serial
from tiler.engine.stage import Layout
from tiler.footprints.footprint_index import (
    FOOTPRINT_CELL,
    FootprintBlock,
    FootprintRows,
    join_footprints,
    scan_footprints,
)
from tiler.footprints.footprint_source import open_source
from tiler.footprints.repeated_ids import find_repeated_ids
from tiler.georeference.frame import AS_IT_IS, Frame
from tiler.pointclouds import las_chunks
from tiler.pointclouds.cells import Box, ranges_near, select_cells
from tiler.pointclouds.clouds import find_clouds
from tiler.pointclouds.ingest import CELL, PointBlock, read_cells
from tiler.pointclouds.las_chunks import nodes_near, read_chunks, read_octree
from tiler.pointclouds.las_header import read_las_header
from tiler.stages import inputs
from tiler.stages.inputs import input_stages
from tiler.store.store import Store
from tiler.vectors.layers import describe_layer, scan_layer

SIDE = 1000.0
NEAR = [(-2, -2), (-1, 0), (0, 0), (1, 1), (4, 4)]  # tiles, the last one empty


def take_rows(rows: FootprintRows, first: int, stop: int) -> FootprintRows:
    """Take a range of rows, as a partial read of a store gives it."""
    base, begin, end = (int(rows.wkb_start[row]) for row in (0, first, stop))
    return FootprintRows(
        rows.wkb[begin - base : end - base],
        rows.wkb_start[first : stop + 1],
        rows.ids[first:stop],
        rows.given_height[first:stop],
        rows.forms[first:stop],
        rows.box[first:stop],
    )


def sorted_rows(cloud: PointCloud) -> np.ndarray:
    rows = np.column_stack((cloud.xyz, cloud.classification))
    return rows[np.lexsort(rows.T)]


def coordinates(block: PointBlock) -> np.ndarray:
    return np.asarray(block.units * np.array(block.scale) + np.array(block.offset))


def whole(blocks: list[PointBlock]) -> PointCloud:
    xyz = np.concatenate([coordinates(block) for block in blocks])
    return PointCloud(xyz, np.concatenate([block.classification for block in blocks]))


def found(blocks: list[PointBlock], box: Box, size: float = CELL) -> PointCloud:
    """Read a box back as a reader of the store does: the ranges of rows, then the crop."""
    n, room = 0, sum(len(block.units) for block in blocks)
    xyz, classes = np.empty((room, 3)), np.empty(room, np.uint8)
    for block in blocks:
        for first, stop in select_cells(block.cell, block.start, box, size=size):
            rows = block.units[first:stop], block.classification[first:stop], block.scale, block.offset
            n += cut_units(*rows, box, np.arange(256, dtype=np.int16), None, xyz[n:], classes[n:])
    return PointCloud(xyz[:n], classes[:n])


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
    np.testing.assert_array_equal(coordinates(block), kept.xyz[order])
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
            mine = small.units[small.start[k] : small.start[k + 1]]
            assert mine.tobytes() == large.units[large.start[row] : large.start[row + 1]].tobytes()


def test_a_box_finds_all_its_points(cloud_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(las_chunks, "CHUNK_POINTS", 3000)
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
    monkeypatch.setattr(las_chunks, "CHUNK_POINTS", 999)
    blocks = list(read_cells(cloud_file, box))
    kept, counts = read_points(cloud_file, box)
    assert len(blocks) == 21
    assert total(blocks) == counts
    np.testing.assert_array_equal(sorted_rows(whole(blocks)), sorted_rows(kept))


@pytest.mark.parametrize("name", ["many.laz", "many.las", "plain.laz"])
def test_shares_add_up_to_the_file(
    name: str, copc_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(las_chunks, "SOME_POINTS", 7000)
    path, region = copc_file, (*(ORIGIN[:2] - SIDE), *(ORIGIN[:2] + SIDE))
    if name != copc_file.name:  # three chunks, the last one not full
        xyz = ORIGIN + np.random.default_rng(2).uniform(0, 400, (120_000, 3)).round(2)
        path = write_cloud(tmp_path / name, xyz, np.arange(len(xyz)) % 9)
    for box in (region, (*(ORIGIN[:2] - 100), *(ORIGIN[:2] + 30))):  # that of less than half is read by the octree
        parts = [list(read_cells(path, box, share=(k, 4))) for k in range(4)]
        everything, shares = list(read_cells(path, box)), [block for part in parts for block in part]
        assert len([part for part in parts if sum(block.counts["kept"] for block in part)]) > 1
        assert total(shares) == total(everything)
        np.testing.assert_array_equal(sorted_rows(whole(shares)), sorted_rows(whole(everything)))


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
    assert block.units.shape == (0, 3)
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


def write_copc(
    path: Path,
    xyz: np.ndarray,
    classes: np.ndarray,
    *,
    depth: int = 3,
    shift: float = 0.0,
    origin: np.ndarray = ORIGIN,
) -> Path:
    """Write a COPC file with the points spread over the levels of its octree."""
    import copclib as copc

    side = 1024.0
    corner = origin - (side / 2, side / 2, 0) + (shift, shift, 0)
    writer = copc.FileWriter(
        str(path), copc.CopcConfigWriter(6, copc.Vector3(0.01, 0.01, 0.01), copc.Vector3(*origin))
    )
    info = writer.copc_config.copc_info
    info.halfsize, info.spacing = side / 2, 10.0
    info.center_x, info.center_y, info.center_z = corner + side / 2
    level = np.arange(len(xyz)) % depth
    key = np.floor((xyz - origin + (side / 2, side / 2, 0)) / (side / 2.0 ** level[:, None])).astype(int)
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
    monkeypatch.setattr(las_chunks, "CHUNK_POINTS", 500)
    header = read_las_header(copc_file)
    looked = [len(chunk) for chunk in read_chunks(copc_file, header, nodes_near(copc_file, header, box))]
    assert max(looked) < 2500  # a node here has 2000 points at most
    assert len(looked) > 1
    assert sum(looked) < 0.6 * 6000
    query = list(read_cells(copc_file, box))
    monkeypatch.setattr(las_chunks, "QUERY_SHARE", 0.0)
    plain = list(read_cells(copc_file, box))
    assert total(query) == total(plain)
    assert total(query)["kept"] > 50
    np.testing.assert_array_equal(sorted_rows(whole(query)), sorted_rows(whole(plain)))
    monkeypatch.setattr(las_chunks, "CHUNK_POINTS", 10**6)
    (once,) = read_cells(copc_file, box)
    monkeypatch.setattr(las_chunks, "QUERY_SHARE", 0.5)
    (same,) = read_cells(copc_file, box)
    assert once.units.tobytes() == same.units.tobytes()  # in the same order, too
    assert set(same.classes) == {1, 2, 6, 7}


def test_copc_in_feet_is_queried_by_the_box_of_the_region(copc_file: Path) -> None:
    x, y, _ = ORIGIN
    foot, box = 0.3048, (x - 100, y - 300, x + 30.5, y - 128)
    feet = Frame((0, foot), (1, foot), foot)
    plain = list(read_cells(copc_file, box))
    xmin, ymin, xmax, ymax = (value * foot for value in box)
    metric = list(read_cells(copc_file, (xmin, ymin, xmax, ymax), frame=feet))
    assert total(metric) == total(plain)
    np.testing.assert_allclose(sorted_rows(whole(metric)), sorted_rows(whole(plain)) * (foot, foot, foot, 1))
    assert metric[0].scale == tuple(value * foot for value in plain[0].scale)


def test_copc_is_queried_only_where_that_saves_half(copc_file: Path) -> None:
    x, y, _ = ORIGIN
    header = read_las_header(copc_file)
    nodes = nodes_near(copc_file, header, (x - 600, y - 600, x - 20, y + 600))
    assert nodes is not None
    assert nodes.count.sum() < 5000
    assert nodes_near(copc_file, header, (x - 600, y - 600, x + 20, y + 600)) is None


def test_copc_away_from_the_box_is_not_read(copc_file: Path) -> None:
    (block,) = read_cells(copc_file, (0.0, 0.0, 100.0, 100.0))
    assert block.counts == {"read": 6000, "outside": 6000, "withheld": 0, "noise": 0, "absurd": 0, "kept": 0}
    assert len(block.classes) == 0


def test_an_octree_that_does_not_fit_is_not_used(copc_file: Path, tmp_path: Path) -> None:
    x, y, _ = ORIGIN
    box = (x - 100, y - 300, x + 30.5, y - 128)
    data = copc_file.read_bytes()
    assert read_octree(copc_file, read_las_header(copc_file)) is not None
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
        assert read_octree(bad, read_las_header(bad)) is None
        np.testing.assert_array_equal(sorted_rows(whole(list(read_cells(bad, box)))), expected)


def test_laspy_seeks_to_other_points_in_copc(copc_file: Path) -> None:
    """Why nodes are not read by `laspy.LasReader.seek`."""
    header = read_las_header(copc_file)
    nodes = read_octree(copc_file, header)
    assert nodes is not None
    first, count = int(nodes.count[0]), int(nodes.count[1])
    with laspy.open(copc_file, laz_backend=laspy.LazBackend.Lazrs) as reader:
        reader.seek(first)
        found = reader.read_points(count).array
    assert (found != laspy.read(copc_file).points.array[first : first + count]).any()


def test_pages_in_a_circle_are_not_followed(copc_file: Path, tmp_path: Path) -> None:
    data = copc_file.read_bytes()
    offset, size = struct.unpack_from("<QQ", data, 375 + 54 + 40)
    bad = tmp_path / "bad.laz"
    bad.write_bytes(data)
    for entry in range(offset, offset + size, 32):
        patch(bad, entry + 16, "Qii", offset, size, -1)
    header = read_las_header(bad)
    assert read_octree(bad, header) is None


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


X, Y = 120000.0, 486000.0
REGION = (X - 3000, Y - 3000, X + 3000, Y + 3000)
FORMATS = ["a.shp", "a.gpkg", "a.geojson", "a.fgb", "a.parquet"]


def houses(n: int = 400) -> tuple[list[shapely.Polygon], dict[str, np.ndarray]]:
    """Houses over a few cells of the grid, in no order; one is larger than a cell, one far away."""
    rng = np.random.default_rng(7)
    place = rng.integers(-10000, 10000, (n, 2)) / 4  # exact in every format
    size = rng.integers(20, 240, n) / 4
    size[3], place[5] = 1500.0, (9000, 9000)
    shapes = [square(x, y, side) for (x, y), side in zip(place, size, strict=True)]
    heights = np.where(rng.random(n) < 0.1, -1.0, rng.uniform(3, 30, n).round(3))
    shapes[4] = shapely.Polygon([(X - 90, Y + 50), (X + 50, Y - 90), (X - 90, Y - 90)])  # beside its box's corner
    return shapes, {"id": np.array([f"h{k:04}" for k in rng.permutation(n)], object), "h": heights}


def write_any(path: Path, shapes: list[shapely.Polygon], fields: dict[str, np.ndarray]) -> Path:
    if path.suffix != ".parquet":
        return write(path, shapes, fields, geometry_type="Polygon")
    return write_parquet(path, shapes, {k: list(v) for k, v in fields.items()}, crs=RD.to_json_dict())


def scan(path: Path, bounds: Box = REGION, *, batch: int = 1000) -> list[FootprintBlock]:
    height = "h" if "h" in describe_layer(path).fields else ""
    return list(scan_footprints(open_source(path, crs=RD, bounds=bounds, height_attribute=height), batch=batch))


def in_box(blocks: list[FootprintBlock], box: Box) -> Footprints:
    """Read a box back as a reader of the store does: ranges of rows, then the join."""
    ranges = [(block, ranges_near(block.cell_box, block.start, box)) for block in blocks]
    return join_footprints([take_rows(block.rows, *pair) for block, pairs in ranges for pair in pairs], box)


def notes_of(blocks: list[FootprintBlock]) -> list[Note]:
    return [note for block in blocks for note in block.notes]


def assert_same(one: Footprints, two: Footprints) -> None:
    assert one.ids.tolist() == two.ids.tolist()
    np.testing.assert_array_equal(one.given_height, two.given_height)
    np.testing.assert_array_equal(one.forms, two.forms)
    assert shapely.equals_identical(shapely.normalize(one.polygons), shapely.normalize(two.polygons)).all()


@pytest.mark.parametrize("name", FORMATS)
def test_footprints_of_a_box_are_those_that_meet_it(tmp_path: Path, name: str) -> None:
    shapes, fields = houses()
    path = write_any(tmp_path / name, shapes, fields)
    blocks = scan(path, batch=150)
    assert len(blocks) == 3
    assert sum(len(block.rows) for block in blocks) == 399
    order = np.argsort(fields["id"].astype(str))
    heights = np.where(fields["h"] > 0, fields["h"], np.nan)
    for box in (REGION, (X - 100, Y - 100, X + 200, Y + 300), (X, Y, X + 9, Y + 9), (X - 2600, Y, X, Y + 1)):
        meets = order[shapely.intersects(np.array(shapes, object)[order], shapely.box(*box))]
        expected = Footprints(np.array(shapes, object)[meets], fields["id"][meets].astype(str), heights[meets])
        assert_same(in_box(blocks, box), expected)
        assert_same(read_footprints(path, crs=RD, bounds=box, height_attribute="h")[0], expected)
    assert len(in_box(blocks, (X + 2900, Y + 2900, X + 3000, Y + 3000)).ids) == 0
    assert count_notes(notes_of(blocks)) == {"footprint-height-missing": int(np.isnan(heights).sum())}


def test_a_tile_reads_the_rows_of_its_cells_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shapes, fields = houses()
    fields["id"] = np.array([f"{name}{'é' * (len(name) + k % 3)}" for k, name in enumerate(fields["id"])], object)
    path = write_any(tmp_path / "houses.gpkg", shapes, fields)
    monkeypatch.setattr(inputs, "scan_footprints", partial(scan_footprints, batch=150))
    tiles = {f"{i}_{j}": (X + 900.0 * i, Y + 900.0 * j, X + 900.0 * (i + 1), Y + 900.0 * (j + 1)) for i, j in NEAR}
    parameters = SimpleNamespace(
        footprints=str(path),
        footprints_identity="",
        footprints_frame=dataclasses.astuple(AS_IT_IS),
        footprints_shift=(0.0, 0.0),
        align=False,
        layer="",
        id_attribute="",
        height_attribute="h",
        roof_attribute="",
    )
    context = SimpleNamespace(crs=RD.to_wkt(), bounds=REGION)
    layout = Layout(tiles=tiles, bounds=REGION)
    engine = Engine(tmp_path / "s.zarr", layout, parameters=parameters, context=context, executor=Serial())
    given = Config(("points",), str(path))
    footprints, outlines = (stage for stage in input_stages(given) if stage.name in ("footprints", "outlines"))
    engine.run(footprints)
    asked = record_rows(monkeypatch)
    engine.run(outlines)
    for name, box in tiles.items():
        arrays, _ = engine.store.read("outlines", name)
        found = Footprints(
            unpack_polygons(arrays, "outline"), arrays["ids"], arrays["given_height"], arrays["forms"]
        )
        assert_same(found, read_footprints(path, crs=RD, bounds=box, height_attribute="h")[0])
        assert (len(found.ids) > 3) == (name != "4_4")
    assert {array for array, _ in asked} == {"wkb", "wkb_end", "id", "id_end", "given_height", "forms", "box"}
    assert max(count for array, count in asked if array.endswith("_end")) < 100


def record_rows(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """List the arrays and numbers of rows that are read from now on."""
    asked, read = list[tuple[str, int]](), Store.read_ranges

    def read_ranges(
        store: Store, stage: str, name: str, names: tuple[str, ...], ranges: list[tuple[int, int]]
    ) -> dict[str, np.ndarray]:
        asked.extend((array, sum(last - first for first, last in ranges)) for array in names)
        return read(store, stage, name, names, ranges)

    monkeypatch.setattr(Store, "read_ranges", read_ranges)
    return asked


def test_rows_are_sorted_by_cell_and_id(tmp_path: Path) -> None:
    shapes, fields = houses()
    (block,) = scan(write_any(tmp_path / "a.gpkg", shapes, fields))
    rows = block.rows
    centre = (rows.box[:, :2] + rows.box[:, 2:]) / 2
    cell = np.repeat(block.cell, np.diff(block.start), axis=0)
    np.testing.assert_array_equal(cell, np.floor(centre / FOOTPRINT_CELL))
    keys = [(int(j), int(i), str(name)) for (i, j), name in zip(cell, rows.ids, strict=True)]
    assert keys == sorted(keys)
    assert len(block.cell) > 10
    for k, box in enumerate(block.cell_box):
        mine = rows.box[block.start[k] : block.start[k + 1]]
        assert box.tolist() == [*mine[:, :2].min(axis=0), *mine[:, 2:].max(axis=0)]
    pieces = np.split(rows.wkb, rows.wkb_start[1:-1])
    polygons = shapely.from_wkb([piece.tobytes() for piece in pieces])
    np.testing.assert_array_equal(shapely.bounds(polygons), rows.box)


def test_batches_and_the_order_of_the_file_change_nothing(tmp_path: Path) -> None:
    shapes, fields = houses(400)
    fields["id"][10] = fields["id"][9]
    shapes[10] = shapely.Polygon(
        [*shapes[9].exterior.coords[1:], shapes[9].exterior.coords[1]]
    )  # the same, turned
    fields["h"][[9, 10]] = 8.0, 5.0
    one = in_box(scan(write_any(tmp_path / "a.gpkg", shapes, fields)), REGION)
    back = {key: values[::-1] for key, values in fields.items()}
    for batch in (7, 1000):
        two = in_box(scan(write_any(tmp_path / f"b{batch}.gpkg", shapes[::-1], back), batch=batch), REGION)
        assert shapely.to_wkb(one.polygons).tolist() == shapely.to_wkb(two.polygons).tolist()
        assert_same(one, two)
    assert (one.ids[1:] == one.ids[:-1]).sum() == 1
    (block,) = scan(tmp_path / "a.gpkg")
    single = [take_rows(block.rows, row, row + 1) for row in range(len(block.rows))]
    three, four = join_footprints(single, REGION), join_footprints(single[::-1], REGION)
    assert shapely.to_wkb(three.polygons).tolist() == shapely.to_wkb(four.polygons).tolist()
    assert_same(three, four)


@pytest.mark.parametrize("name", FORMATS)
def test_repeated_ids_are_a_fact_of_the_whole_file(tmp_path: Path, name: str) -> None:
    shapes = [square(5, 5), square(900, 5), square(35, 5), square(35, 5), square(50, 5), square(5, 900)]
    fields = {"id": np.array(["a", "a", "twin", "twin", None, None], object)}
    path = write_any(tmp_path / name, shapes, fields)
    assert find_repeated_ids(describe_layer(path), "id", batch=2) == {"a"}
    assert find_repeated_ids(describe_layer(path), "") == set()
    made = make_ids(np.array(shapes, object))
    small = (X, Y, X + 100, Y + 100)
    expected = sorted(["a-" + made[0], "twin", "twin", made[4]])
    assert read_footprints(path, crs=RD, bounds=small)[0].ids.tolist() == expected  # though one "a" is there
    assert in_box(scan(path, batch=2), small).ids.tolist() == expected
    assert count_notes(notes_of(scan(path, small))) == {"footprint-id-missing": 1, "footprint-id-repeated": 1}


def test_ids_of_what_is_no_polygon_do_not_count(tmp_path: Path) -> None:
    shapes = [square(5, 5), shapely.Point(X + 1, Y + 2), None, square(20, 5)]
    path = write(tmp_path / "a.gpkg", shapes, {"id": [7, 7, 7, 2**60 + 1]})
    assert find_repeated_ids(describe_layer(path), "id") == set()
    assert in_box(scan(path), REGION).ids.tolist() == [str(2**60 + 1), "7"]


def test_notes_of_the_file_come_once(tmp_path: Path) -> None:
    shapes, fields = houses(30)
    forward = pyproj.Transformer.from_crs(RD, "EPSG:4326", always_xy=True)
    there = list(shapely.transform(np.array(shapes, object), forward.transform, interleaved=False))
    path = write(tmp_path / "a.gpkg", there, {"id": fields["id"]}, crs="EPSG:4326")
    assert count_notes(notes_of(scan(path, batch=7))) == {"footprints-reprojected": 1}
    far = scan(path, (X + 90000, Y, X + 90010, Y + 10), batch=7)
    assert count_notes(notes_of(far)) == {"footprints-reprojected": 1, "footprints-outside": 1}
    assert [len(block.rows) for block in far] == [0]
    assert len(in_box(far, REGION).ids) == 0
    assert far[0].cell_box.shape == (0, 4)


def test_warnings_come_once_a_file(tmp_path: Path) -> None:
    ring = f"[[{X},{Y}],[{X + 9},{Y + 9}],[{X + 9},{Y}]]"
    shape = f'{{"type":"Feature","properties":{{}},"geometry":{{"type":"Polygon","coordinates":[{ring}]}}}}'
    crs = '"crs":{"type":"name","properties":{"name":"EPSG:28992"}}'
    path = tmp_path / "a.geojson"
    path.write_text(f'{{"type":"FeatureCollection",{crs},"features":[{",".join([shape] * 9)}]}}')
    blocks = scan(path, batch=2)
    assert len(blocks) == 5
    assert count_notes(notes_of(blocks)) == {"footprints-reader-warning": 1}


def test_a_region_around_the_file_asks_for_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    true = pyogrio.raw.open_arrow

    def watch(path: Path, **options: Any) -> Any:
        asked.append(options.get("where", "all"))
        return true(path, **options)

    monkeypatch.setattr(pyogrio.raw, "open_arrow", watch)
    layer = describe_layer(write_any(tmp_path / "a.gpkg", *houses(20)))
    for box in (REGION, (X - 9e4, Y - 9e4, X + 9e4, Y + 9e4)):
        list(scan_layer(layer, ["id"], box))
    assert [where.count("rtree_a_geom") for where in asked] == [2, 0]  # its boxes, and what it does not know


def test_a_damaged_page_is_no_end_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tiler.vectors.gdal_features.MOST_BROKEN", 10)
    shapes, fields = houses(600)
    path = write_any(tmp_path / "a.gpkg", shapes, fields)
    data = bytearray(path.read_bytes())
    middle = len(data) // 3 // 4096 * 4096
    data[middle : middle + 4096] = bytes(4096)
    path.write_bytes(data)
    for box in ((X - 9e4, Y - 9e4, X + 9e4, Y + 9e4), REGION, (X - 2000, Y - 2000, X + 2000, Y + 2000)):
        with pytest.raises(InputError, match="cannot be read"):
            list(scan_layer(describe_layer(path), ["id"], box))
        with pytest.raises(InputError, match="cannot be read"):
            scan(path, box)


def test_a_stale_number_of_features_is_no_damage(tmp_path: Path) -> None:
    import sqlite3

    shapes, fields = houses(20)
    path = write_any(tmp_path / "a.gpkg", shapes, fields)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE gpkg_ogr_contents SET feature_count = 99")
    database.close()
    assert describe_layer(path).n_features == 99
    assert sum(len(block.rows) for block in scan(path)) == 19


def test_row_groups_away_from_the_box_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import json

    import pyarrow as pa
    import pyarrow.parquet as pq

    shapes = np.array([square(100 * k, 5) for k in range(20)], object)
    names = ("xmin", "ymin", "xmax", "ymax")
    box = pa.StructArray.from_arrays([pa.array(side) for side in shapely.bounds(shapes).T], names)
    column = {"encoding": "WKB", "crs": RD.to_json_dict(), "covering": {"bbox": {k: ["bbox", k] for k in names}}}
    table = pa.table(
        {"id": [f"{k:02}" for k in range(20)], "geometry": shapely.to_wkb(shapes).tolist(), "bbox": box}
    )
    meta = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    path = tmp_path / "a.parquet"
    pq.write_table(table.replace_schema_metadata({"geo": json.dumps(meta)}), path, row_group_size=4)
    asked = []
    true = pq.ParquetFile.iter_batches

    def watch(self: object, batch: int, *, row_groups: list[int], columns: list[str]) -> object:
        asked.append((tuple(columns), row_groups))
        return true(self, batch, row_groups=row_groups, columns=columns)

    monkeypatch.setattr(pq.ParquetFile, "iter_batches", watch)
    footprints, _ = read_footprints(path, crs=RD, bounds=(X + 710, Y, X + 800, Y + 100))
    assert footprints.ids.tolist() == ["07", "08"]
    assert asked == [(("id",), [0, 1, 2, 3, 4]), (("geometry", "id"), [1, 2])]


@pytest.mark.shared
@pytest.mark.parametrize("name", ["footprints.shp", "footprints.gpkg"])
def test_real_footprints_come_back(shared_data: Path, name: str) -> None:
    path = shared_data / "amsterdam" / name
    blocks = scan(path, (120500.0, 485800.0, 121400.0, 486700.0), batch=500)
    _, _, wkb, _ = pyogrio.raw.read(path, force_2d=True)
    whole_file = shapely.from_wkb(wkb)
    for box, n in (
        ((120625.0, 485936.8, 121250.46, 486523.26), 1128),
        ((120900.0, 486100.0, 121000.0, 486200.0), 0),
    ):
        footprints = in_box(blocks, box)
        meets = whole_file[shapely.intersects(whole_file, shapely.box(*box))]
        assert len(footprints.ids) == (n or len(meets)) == len(meets) > 20
        assert_same(footprints, read_footprints(path, crs=RD, bounds=box)[0])
        assert set(shapely.to_wkb(footprints.polygons)) == set(shapely.to_wkb(meets))
