"""Cells made and measured a block at a time are the cells that there are."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.cell_blocks import (
    UNUSED,
    CellBlocks,
    QualityMeter,
    number_used,
    place_points,
    renumber_boundary,
)
from pipeline.columns import count_cells, expand_cells, find_used_points
from pipeline.histograms import quality_histograms
from pipeline.mesh import Boundary, ColumnMesh, MergeOrder, PlaneMesh, TetMesh
from pipeline.plane import mesh_plane
from pipeline.quality import measure_cells
from stitch.conformity import compute_cell_volumes
from tests.cities import city_of
from tiler.vtk_files import read_vtu, write_vtu, write_vtu_blocks


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


def blocks_of(mesh: ColumnMesh) -> tuple[NDArray[np.float64], CellBlocks]:
    """Points and cells as they are written."""
    used = find_used_points(mesh)
    return place_points(mesh, used), CellBlocks([(mesh, number_used(used))])


def make_all(blocks: CellBlocks, step: int) -> NDArray[np.int32]:
    """All cells, some at a time."""
    parts = [blocks.make(k, min(k + step, blocks.n_cells)) for k in range(0, blocks.n_cells, step)]
    return np.concatenate(parts)


@pytest.mark.parametrize("order", ["levels", "heights"])
@pytest.mark.parametrize("step", [1, 7, 64, 100_000])
def test_blocks_of_any_size_are_the_cells_of_the_whole_mesh(order: MergeOrder, step: int) -> None:
    mesh = uneven_columns(order)
    points, blocks = blocks_of(mesh)
    whole = expand_cells(mesh)
    assert 0 < len(points) < len(whole.points)
    assert blocks.n_cells == count_cells(mesh) == len(whole.cells)
    cells = make_all(blocks, step)
    assert cells.dtype == np.int32
    assert np.array_equal(points[cells], whole.points[whole.cells])
    volume, _ = compute_cell_volumes(points, cells)
    assert (volume > 0).all()


def test_points_are_those_that_cells_use_and_keep_their_order() -> None:
    mesh = uneven_columns("heights")
    whole, used = expand_cells(mesh), find_used_points(mesh)
    assert np.flatnonzero(used).tolist() == np.unique(whole.cells).tolist()
    assert np.array_equal(place_points(mesh, used), whole.points[used])
    number = number_used(used)
    assert number[used].tolist() == list(range(int(used.sum())))
    assert (number[~used] == UNUSED).all()
    facets = whole.cells[:9, :3]
    given = Boundary(facets, np.arange(9, dtype=np.int32), np.arange(9))
    boundary = renumber_boundary(given, number)
    assert np.array_equal(place_points(mesh, used)[boundary.facets], whole.points[facets])
    assert boundary.marker is given.marker
    assert boundary.building is given.building


def test_meshes_one_after_the_other_have_one_numbering() -> None:
    one, other = uneven_columns("heights", seed=1), uneven_columns("heights", seed=2)
    shift = len(one.z)
    numbers = np.arange(shift, dtype=np.int32), np.arange(shift, shift + len(other.z), dtype=np.int32)
    blocks = CellBlocks([(one, numbers[0]), (other, numbers[1])])
    wanted = np.concatenate((expand_cells(one).cells, expand_cells(other).cells + shift))
    first = count_cells(one)
    for begin, end in ((0, first), (first, blocks.n_cells), (first - 3, first + 2), (0, blocks.n_cells), (5, 5)):
        assert np.array_equal(blocks.make(begin, end), wanted[begin:end])


@pytest.mark.parametrize("step", [1, 50])
def test_measures_of_blocks_add_up_to_those_of_all_cells(step: int) -> None:
    mesh = uneven_columns("levels")
    points, blocks = blocks_of(mesh)
    meter = QualityMeter(points)
    for k in range(0, blocks.n_cells, step):
        meter.take(blocks.make(k, min(k + step, blocks.n_cells)))
    wanted = quality_histograms(measure_cells(expand_cells(mesh)))
    assert meter.histograms.keys() == wanted.keys()
    for name, found in meter.histograms.items():
        assert found.counts.sum() == blocks.n_cells
        assert np.array_equal(found.counts, wanted[name].counts)
        assert (found.minimum, found.maximum) == (wanted[name].minimum, wanted[name].maximum)


def test_a_file_of_blocks_asks_for_each_cell_once_and_has_the_bytes_of_the_whole(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    points, cells = random.normal(size=(5000, 3)), random.integers(0, 5000, (40_000, 4)).astype(np.int32)
    asked = []

    def make(begin: int, end: int) -> NDArray[np.int32]:
        asked.append((begin, end))
        return cells[begin:end]

    data = {"height": points[:, 2].copy()}
    write_vtu_blocks(tmp_path / "a.vtu", points, len(cells), make, point_data=data)
    write_vtu(tmp_path / "b.vtu", TetMesh(points, cells), point_data=data)
    assert asked == [(0, 16_384), (16_384, 32_768), (32_768, 40_000)]
    assert (tmp_path / "a.vtu").read_bytes() == (tmp_path / "b.vtu").read_bytes()
    assert np.array_equal(read_vtu(tmp_path / "a.vtu").mesh.cells, cells)
