"""XDMF and HDF5: the mesh of a run as ParaView, scikit-fem and DOLFINx take it."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.helpers.programs import MPI, PACKAGES, run_program
from tests.helpers.vtk_readers import read_vtk
from tests.tiler.export.conftest import Exported
from tiler.cli.main import main
from tiler.export.export import export_run
from tiler.mesh_files.mesh_pieces import open_pieces

POISSON = Path(__file__).resolve().parents[2] / "helpers" / "poisson_dolfinx.py"
GRADIENT = np.array([0.3, -0.2, 1.0])


@pytest.fixture(scope="module")
def city(small_run: Path, exported: Exported) -> Path:
    """The XDMF file of the small city."""
    return exported(small_run, "xdmf")


def load(path: Path) -> dict[str, NDArray[Any]]:
    with h5py.File(path.with_suffix(".h5")) as file:
        return {name: data[()] for name, data in file.items()}


def test_vtk_reads_cells_and_marked_facets(small_run: Path, city: Path) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXdmf2 import vtkXdmfReader

    counts = json.loads((small_run / "run.json").read_text())["counts"]
    output = read_vtk(vtkXdmfReader(), city).GetOutputDataObject(0)
    cells, facets = (output.GetBlock(i) for i in range(output.GetNumberOfBlocks()))
    assert (cells.GetNumberOfPoints(), cells.GetNumberOfCells()) == (counts["points"], counts["cells"])
    assert facets.GetNumberOfCells() == counts["facets"]
    assert {cells.GetCellType(0), facets.GetCellType(0)} == {10, 5}
    pieces = open_pieces(small_run)
    parts = [pieces.read(k) for k in range(len(pieces.names))]
    for grid, rows in ((cells, "cells"), (facets, "facets")):
        found = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
        places = vtk_to_numpy(grid.GetPoints().GetData())[found].reshape(-1, 3)
        expected = np.concatenate([part.points[getattr(part, rows)].reshape(-1, 3) for part in parts])
        assert places.dtype == np.float64
        assert np.array_equal(places, expected)
    for name in ("marker", "building"):
        found = vtk_to_numpy(facets.GetCellData().GetArray(name))
        assert np.array_equal(found, np.concatenate([getattr(part, name) for part in parts]))


def test_pyvista_reads_both_grids(small_run: Path, city: Path) -> None:
    import pyvista

    counts = json.loads((small_run / "run.json").read_text())["counts"]
    grids = pyvista.read(city)
    assert [grid.n_cells for grid in grids] == [counts["cells"], counts["facets"]]
    assert grids[1].array_names == ["marker", "building"]


def test_scikit_fem_solves_a_linear_problem_exactly(city: Path) -> None:
    import skfem
    from skfem.helpers import dot, grad

    data = load(city)
    points = data["points"] - data["points"].mean(axis=0)
    mesh = skfem.MeshTet(points.T.copy(), data["cells"].T.copy())
    assert np.allclose(mesh.p.T, points)
    facet = {tuple(nodes): i for i, nodes in enumerate(np.sort(mesh.facets, axis=0).T.tolist())}
    rows = np.array([facet[tuple(nodes)] for nodes in np.sort(data["facets"], axis=1).tolist()])
    assert np.array_equal(np.sort(rows), np.sort(mesh.boundary_facets()))
    mesh = mesh.with_boundaries({str(m): rows[data["marker"] == m] for m in np.unique(data["marker"])})
    basis = skfem.Basis(mesh, skfem.ElementTetP1())
    sides = skfem.FacetBasis(mesh, basis.elem, facets=np.concatenate([mesh.boundaries[m] for m in "5678"]))
    stiffness = skfem.BilinearForm(lambda u, v, w: dot(grad(u), grad(v))).assemble(basis)
    flux = skfem.LinearForm(lambda v, w: np.einsum("i,i...->...", GRADIENT, w.n) * v).assemble(sides)
    exact = mesh.p.T @ GRADIENT
    fixed = basis.get_dofs([m for m in mesh.boundaries if m in "1234"])
    solution = skfem.solve(*skfem.condense(stiffness, flux, x=exact, D=fixed))
    assert len(fixed.flatten()) < 0.7 * len(exact)
    assert np.abs(solution - exact).max() < 1e-9 * np.abs(exact).max()


def test_both_files_are_replaced_together(
    small_run: Path, city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "city.xdmf"
    command = ["export", str(small_run), "--format", "xdmf", "-o", str(target)]
    (tmp_path / "city.h5").write_text("mine")
    assert main(command) == 2
    assert "city.h5: exists; give another --output, or --overwrite" in capsys.readouterr().err
    assert (tmp_path / "city.h5").read_text() == "mine"
    assert main([*command, "--overwrite"]) == 0
    for suffix in (".h5", ".xdmf"):
        assert target.with_suffix(suffix).read_bytes() == city.with_suffix(suffix).read_bytes()


def solve_with_dolfinx(path: Path, parts: int | None) -> dict[str, Any]:
    script = ["/usr/bin/python3", str(POISSON), str(path)]
    text = run_program(script if parts is None else [*MPI, str(parts), *script], path.parent, timeout=1500)
    lines = [line for line in text.splitlines() if line.startswith("{")]
    if not lines and "No module named 'dolfinx'" in text:
        pytest.fail(f"no dolfinx; {PACKAGES}")
    assert len(lines) == 1, text[-3000:]
    found: dict[str, Any] = json.loads(lines[0])
    return found


def assert_dolfinx_solves(run: Path, path: Path) -> None:
    counts, data = json.loads((run / "run.json").read_text())["counts"], load(path)
    corners = data["points"][data["facets"]]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    for parts in (None, 2):
        found = solve_with_dolfinx(path, parts)
        assert found["processes"] == (parts or 1)
        assert (found["cells"], found["facets"]) == (counts["cells"], counts["facets"])
        for marker in np.unique(data["marker"]).tolist():
            assert found["areas"][str(marker)] == pytest.approx(areas[data["marker"] == marker].sum(), rel=1e-9)
        assert sum(found["areas"].values()) == pytest.approx(found["boundary"], rel=1e-9)
        assert found["error"] < 1e-9 * found["size"]


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_dolfinx_solves_a_linear_problem_exactly(small_run: Path, city: Path) -> None:
    assert_dolfinx_solves(small_run, city)


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.timeout(3600)
def test_dolfinx_solves_on_amsterdam(amsterdam_run: Path, tmp_path: Path) -> None:
    path = tmp_path / "city.xdmf"
    export_run(amsterdam_run, path, name="xdmf")
    assert_dolfinx_solves(amsterdam_run, path)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_dolfinx_says_so_where_tags_are_wrong(city: Path, tmp_path: Path) -> None:
    path = tmp_path / "city.xdmf"
    path.write_bytes(city.read_bytes())
    path.with_suffix(".h5").write_bytes(city.with_suffix(".h5").read_bytes())
    with h5py.File(path.with_suffix(".h5"), "r+") as file:
        marker = file["marker"][()]
        file["marker"][()] = np.where(marker == 5, 6, marker)
    found = solve_with_dolfinx(path, None)
    assert found["areas"]["5"] == 0
    with h5py.File(path.with_suffix(".h5"), "r+") as file:
        file["points"][: len(file["points"]) // 2] = file["points"][()][::-1][: len(file["points"]) // 2]
    found = solve_with_dolfinx(path, None)
    assert sum(found["areas"].values()) != pytest.approx(solve_with_dolfinx(city, None)["boundary"], rel=1e-3)
