"""Points and cells made and measured a block at a time are those that there are."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.columns.cell_blocks import UNUSED, CellBlocks, QualityMeter, UsedPoints, number_used
from pipeline.columns.columns import count_cells, expand_cells, find_used_points
from pipeline.data.mesh import ColumnMesh, MergeOrder, PlaneMesh, TetMesh
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.quality.histograms import quality_histograms
from pipeline.quality.quality import measure_cells
from stitch.pieces.conformity import compute_cell_volumes
from tests.helpers.cities import city_of
from tests.helpers.vtk_writers import write_vtu
from tiler.mesh_files.vtk_files import Rows, Values, read_vtu, write_vtu_blocks


def uneven_columns(order: MergeOrder, seed: int = 5) -> ColumnMesh:
    """Columns of three to six levels, many of which begin above their lowest; triangles turn both ways."""
    plane, _ = mesh_plane((0.0, 0.0, 60.0, 60.0), city_of([], []).polygons, mesh_size=10.0)
    random = np.random.default_rng(seed)
    triangles = plane.triangles.copy()
    triangles[::2] = triangles[::2, [0, 2, 1]]
    n = len(plane.xy)
    count, first = random.integers(3, 7, n), random.integers(0, 3, n).astype(np.int32)
    start = np.concatenate(([0], np.cumsum(count)))
    z = np.concatenate([np.cumsum(random.uniform(3, 9, k)) for k in count])
    turned = PlaneMesh(plane.xy, triangles, plane.building)
    return ColumnMesh(turned, start, z, first[triangles], order)


def make_all(make: Callable[[int, int], NDArray[Any]], n: int, step: int) -> NDArray[Any]:
    """All rows, some at a time."""
    return np.concatenate([make(k, min(k + step, n)) for k in range(0, n, step)])


@pytest.mark.parametrize("order", ["levels", "heights"])
@pytest.mark.parametrize("step", [1, 7, 64, 100_000])
def test_blocks_of_any_size_are_the_cells_of_the_whole_mesh(order: MergeOrder, step: int) -> None:
    mesh = uneven_columns(order)
    blocks, whole = CellBlocks([(mesh, None)]), expand_cells(mesh)
    assert blocks.n_cells == count_cells(mesh) == len(whole.cells)
    cells = make_all(blocks.make, blocks.n_cells, step)
    assert cells.dtype == np.int32
    assert np.array_equal(cells, whole.cells)
    volume, _ = compute_cell_volumes(whole.points, cells)
    assert (volume > 0).all()
    # A cell's upright edge goes from its first corner to its last: rows repeat each other, and files are small.
    assert (cells[:, 3] == cells[:, 0] + 1).all()


@pytest.mark.parametrize("step", [1, 10, 100_000])
def test_points_are_those_that_cells_use_and_keep_their_order(step: int) -> None:
    mesh = uneven_columns("heights")
    whole, used = expand_cells(mesh), find_used_points(mesh)
    assert np.flatnonzero(used).tolist() == np.unique(whole.cells).tolist()
    points = UsedPoints(mesh, used)
    assert 0 < points.n_points == used.sum() < len(used)
    levels = make_all(points.levels, points.n_points, step)
    assert levels.dtype == np.int32
    assert levels.tolist() == np.flatnonzero(used).tolist()
    assert np.array_equal(points.place(levels), whole.points[used])
    assert points.numbers(levels).tolist() == list(range(points.n_points))
    assert number_used(used)[levels].tolist() == list(range(points.n_points))
    assert (number_used(used)[~used] == UNUSED).all()
    assert np.array_equal(mesh.plane.xy[points.column], whole.points[:, :2])


@pytest.mark.parametrize("all_or_none", [True, False])
def test_points_of_columns_that_are_used_wholly_or_not_at_all(all_or_none: bool) -> None:
    mesh = uneven_columns("heights")
    points = UsedPoints(mesh, np.full(len(mesh.z), all_or_none))
    assert points.levels(0, points.n_points).tolist() == list(range(len(mesh.z) if all_or_none else 0))


def test_meshes_one_after_the_other_have_one_numbering() -> None:
    one, other = uneven_columns("heights", seed=1), uneven_columns("heights", seed=2)
    shift = len(one.z)
    levels = np.arange(shift, shift + len(other.z), dtype=np.int32)
    blocks = CellBlocks([(one, None), (other, levels)])
    wanted = np.concatenate((expand_cells(one).cells, expand_cells(other).cells + shift))
    first = count_cells(one)
    for begin, end in ((0, first), (first, blocks.n_cells), (first - 3, first + 2), (0, blocks.n_cells), (5, 5)):
        assert np.array_equal(blocks.make(begin, end), wanted[begin:end])


@pytest.mark.parametrize("step", [1, 50])
def test_measures_of_blocks_add_up_to_those_of_all_cells(step: int) -> None:
    mesh = uneven_columns("levels")
    points, blocks = UsedPoints(mesh, find_used_points(mesh)), CellBlocks([(mesh, None)])
    meter = QualityMeter()
    for k in range(0, blocks.n_cells, step):
        meter.take(points.place(blocks.make(k, min(k + step, blocks.n_cells)).ravel()))
    wanted = quality_histograms(measure_cells(expand_cells(mesh)))
    assert meter.histograms.keys() == wanted.keys()
    for name, found in meter.histograms.items():
        assert found.counts.sum() == blocks.n_cells
        assert np.array_equal(found.counts, wanted[name].counts)
        assert (found.minimum, found.maximum) == (wanted[name].minimum, wanted[name].maximum)


def test_a_file_of_blocks_asks_for_each_cell_once_and_has_the_bytes_of_the_whole(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    points, cells = random.normal(size=(20_000, 3)), random.integers(0, 20_000, (40_000, 4)).astype(np.int32)
    asked = []

    def make(begin: int, end: int) -> NDArray[np.int32]:
        asked.append((begin, end))
        return cells[begin:end]

    data, mark = {"height": points[:, 2].copy()}, np.arange(len(cells), dtype=np.int8)
    write_vtu_blocks(
        tmp_path / "a.vtu",
        Rows.of(points),
        Rows(len(cells), 4, cells.dtype, make),
        point_data={"height": Values(1, points.dtype, lambda k: points[k, 2]).rows(len(points), np.arange)},
        cell_data={"mark": Rows.of(mark)},
    )
    write_vtu(tmp_path / "b.vtu", TetMesh(points, cells), point_data=data, cell_data={"mark": mark})
    assert asked == [(0, 16_384), (16_384, 32_768), (32_768, 40_000)]
    assert (tmp_path / "a.vtu").read_bytes() == (tmp_path / "b.vtu").read_bytes()
    found = read_vtu(tmp_path / "a.vtu")
    assert np.array_equal(found.mesh.cells, cells)
    assert np.array_equal(found.mesh.points, points)
    assert np.array_equal(found.point_data["height"], points[:, 2])
    assert np.array_equal(found.cell_data["mark"], mark)
