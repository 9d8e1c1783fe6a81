"""Shape measures against values known from geometry, and against another implementation."""

import numpy as np
import pytest
from vtkmodules.numpy_interface import dataset_adapter
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import VTK_TETRA, vtkUnstructuredGrid
from vtkmodules.vtkFiltersVerdict import vtkMeshQuality

from pipeline.data.mesh import TetMesh
from pipeline.quality.quality import AT_ONCE, measure_cells, quality_percentiles


def tet(*corners: tuple[float, float, float]) -> TetMesh:
    return TetMesh(np.array(corners, dtype=np.float64), np.array([[0, 1, 2, 3]], np.int32))


def least_dihedral(p: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> float:
    """Least angle between the projections of the two other corners along each edge (degrees)."""
    angles = []
    for i, j, k, m in ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 0, 2), (2, 3, 0, 1)):
        edge = (p[j] - p[i]) / np.linalg.norm(p[j] - p[i])
        u, v = p[k] - p[i], p[m] - p[i]
        u, v = u - edge * (u @ edge), v - edge * (v @ edge)
        angles.append(np.degrees(np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v))))
    return float(min(angles))


def test_the_corner_of_a_cube_by_hand() -> None:
    quality = measure_cells(tet((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)))
    # r = 1 / (3 + sqrt 3), R = sqrt 3 / 2; dihedral angles 90 and arccos(1 / sqrt 3); longest edge sqrt 2.
    inner = 1 / (3 + np.sqrt(3))
    assert quality.radius_ratio[0] == pytest.approx(3 * inner / (np.sqrt(3) / 2), rel=1e-6)
    assert quality.min_dihedral[0] == pytest.approx(np.degrees(np.arccos(1 / np.sqrt(3))), rel=1e-6)
    assert quality.aspect_ratio[0] == pytest.approx(np.sqrt(2) / (2 * np.sqrt(6) * inner), rel=1e-6)


def test_measures_are_those_of_vtk() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3))
    cells = np.arange(400, dtype=np.int32).reshape(-1, 4)
    corners = points[cells]
    negative = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    cells[negative] = cells[negative][:, [0, 2, 1, 3]]
    grid, vtk_points = vtkUnstructuredGrid(), vtkPoints()
    vtk_points.SetDataTypeToDouble()
    for point in points:
        vtk_points.InsertNextPoint(*point)
    grid.SetPoints(vtk_points)
    for cell in cells:
        grid.InsertNextCell(VTK_TETRA, 4, cell.tolist())
    quality = measure_cells(TetMesh(points, cells))

    def by_vtk(choose: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        measure = vtkMeshQuality()
        getattr(measure, f"SetTetQualityMeasureTo{choose}")()
        measure.SetInputData(grid)
        measure.Update()
        return np.array(dataset_adapter.WrapDataObject(measure.GetOutput()).CellData["Quality"])

    np.testing.assert_allclose(1 / quality.radius_ratio, by_vtk("RadiusRatio"), rtol=1e-4)
    # vtk's "MinAngle" is not the least of all six dihedral angles: some of these differ from it.
    angles = [least_dihedral(points[cell]) for cell in cells]
    np.testing.assert_allclose(quality.min_dihedral, angles, rtol=1e-5)
    np.testing.assert_allclose(quality.aspect_ratio, by_vtk("AspectRatio"), rtol=1e-4)


@pytest.mark.parametrize("n_cells", [1, AT_ONCE - 1, AT_ONCE, 2 * AT_ONCE + 7])
def test_a_cell_is_measured_alike_beside_any_number_of_others(n_cells: int) -> None:
    rng = np.random.default_rng(n_cells)
    points = rng.normal(size=(50, 3))
    cells = np.array([rng.permutation(50)[:4] for _ in range(n_cells)], np.int32)
    together = measure_cells(TetMesh(points, cells))
    alone = [measure_cells(TetMesh(points, cell[None])) for cell in cells]
    for name in ("radius_ratio", "min_dihedral", "aspect_ratio"):
        wanted = np.concatenate([getattr(quality, name) for quality in alone])
        np.testing.assert_array_equal(getattr(together, name), wanted)


def test_a_flat_cell_has_no_ratio() -> None:
    quality = measure_cells(tet((0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 3, 0)))
    assert (quality.radius_ratio[0], quality.min_dihedral[0], quality.aspect_ratio[0]) == (0.0, 0.0, np.inf)


def test_percentiles_have_minimum_and_maximum() -> None:
    quality = measure_cells(tet((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)))
    table = quality_percentiles(quality)
    assert table["radius_ratio"]["0"] == table["radius_ratio"]["100"] == pytest.approx(0.732, abs=1e-3)
