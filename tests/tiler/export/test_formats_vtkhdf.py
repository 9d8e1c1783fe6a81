"""VTKHDF: VTK and pyvista read what was written, number for number."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.helpers.hand_pieces import HandPieces, box_pieces
from tests.helpers.vtk_readers import read_vtk
from tests.tiler.export.conftest import Exported
from tiler.formats.vtkhdf import write_vtkhdf
from tiler.mesh_files.mesh_pieces import MeshPieces, open_pieces


def read(path: Path) -> dict[str, Any]:
    """Read with VTK: grids by name."""
    from vtkmodules.vtkCommonDataModel import vtkCompositeDataSet
    from vtkmodules.vtkIOHDF import vtkHDFReader

    blocks = read_vtk(vtkHDFReader(), path).GetOutputDataObject(0)
    names = [blocks.GetMetaData(i).Get(vtkCompositeDataSet.NAME()) for i in range(blocks.GetNumberOfBlocks())]
    return {name: blocks.GetBlock(i) for i, name in enumerate(names)}


def assert_same(path: Path, pieces: HandPieces | MeshPieces) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    found = read(path)
    assert list(found) == ["mesh", "boundary"]
    all_pieces = [pieces.read(k) for k in range(len(pieces.names))]
    mesh, boundary = found["mesh"], found["boundary"]
    points = vtk_to_numpy(mesh.GetPoints().GetData())
    assert points.dtype == np.float64
    assert len(points) == pieces.n_points
    for piece in all_pieces:
        assert np.array_equal(points[piece.ids], piece.points)
    cells = vtk_to_numpy(mesh.GetCells().GetConnectivityArray()).reshape(-1, 4)
    assert np.array_equal(cells, np.concatenate([piece.ids[piece.cells] for piece in all_pieces]))
    assert {mesh.GetCellType(i) for i in range(mesh.GetNumberOfCells())} == {10}
    tile = vtk_to_numpy(mesh.GetCellData().GetArray("tile"))
    assert np.array_equal(tile, np.repeat(np.arange(len(all_pieces)), [len(piece.cells) for piece in all_pieces]))
    corners = vtk_to_numpy(boundary.GetCells().GetConnectivityArray()).reshape(-1, 3)
    places = vtk_to_numpy(boundary.GetPoints().GetData())
    assert np.array_equal(np.unique(corners), np.arange(len(places)))
    expected = np.concatenate([piece.points[piece.facets] for piece in all_pieces])
    assert np.array_equal(places[corners], expected)
    for name, dtype in (("marker", np.int32), ("building", np.int64)):
        array = vtk_to_numpy(boundary.GetCellData().GetArray(name))
        assert array.dtype == dtype
        assert np.array_equal(array, np.concatenate([getattr(piece, name) for piece in all_pieces]))


def test_vtk_reads_numbers_exactly(tmp_path: Path) -> None:
    box = box_pieces()
    # Numbers of buildings that a float64 cannot hold.
    for piece in box.pieces:
        piece.building[piece.building >= 0] += 2**60
    write_vtkhdf(tmp_path / "box.vtkhdf", box, crs="EPSG:28992")
    assert_same(tmp_path / "box.vtkhdf", box)


def test_a_run_is_read_by_vtk_and_pyvista(small_run: Path, exported: Exported) -> None:
    import pyvista

    path = exported(small_run, "vtkhdf")
    assert_same(path, open_pieces(small_run))
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    blocks = pyvista.read(str(path))
    assert (blocks["mesh"].n_cells, blocks["mesh"].n_points) == (counts["cells"], counts["points"])
    assert blocks["boundary"].n_cells == counts["facets"]
