"""Columns as prisms: a third of the cells, the same air and boundary, in every format that can hold them."""

import json
import re
from itertools import permutations
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
import pyvista

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.mesh import Marker
from stitch.pieces.conformity import compute_cell_volumes
from tests.conftest import Once
from tests.helpers.programs import mesh_is_ok, read_check, run_foam, run_program
from tests.helpers.synthetic import run_city
from tests.helpers.vtk_readers import read_vtk
from tests.tiler.export.conftest import Exported
from tiler.export.export import export_run
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.prisms import PrismMesh, combine_cells, read_prisms
from tiler.mesh_files.transitions import NO_CORNER

PRISMS = ("--cells", "prism")
UPRIGHT = {Marker.WALL, Marker.WEST, Marker.EAST, Marker.SOUTH, Marker.NORTH}


@pytest.fixture(scope="module")
def layered_run(once: Once) -> Path:
    """Finished run of a synthetic city on four tiles in layers that grow."""
    return once("layered", lambda folder: run_city(folder, mesher="layered", first_layer=2.0)) / "out"


@pytest.fixture(scope="module")
def prisms(layered_run: Path) -> PrismMesh:
    return read_prisms(open_pieces(layered_run))


def counts_of(run: Path) -> dict[str, int]:
    counts: dict[str, int] = json.loads((run / "run.json").read_text())["counts"]
    return counts


def test_three_cells_are_a_prism_in_any_order_of_columns() -> None:
    low, high = np.array([0, 2, 4]), np.array([1, 3, 5])
    for first, second, third in permutations(range(3)):
        around = [first, (first + 1) % 3, (first + 2) % 3]
        three = np.array(
            [
                [*low[around], high[first]],
                [low[second], high[first], low[third], high[second]],
                [low[third], high[first], high[second], high[third]],
            ],
            np.int32,
        )
        found, whole = combine_cells(three)
        assert whole.tolist() == [True]
        assert found[0].tolist() == [*low[around], *high[around]]
        wrong = three.copy()
        wrong[2, 3] = 7
        wrong[1, 1] = 7
        assert not combine_cells(wrong)[1].any()
        assert not combine_cells(three[[1, 0, 2]])[1].any()


def test_prisms_fill_the_same_air_with_a_third_of_the_cells(layered_run: Path, prisms: PrismMesh) -> None:
    pieces = open_pieces(layered_run)
    volume = 0.0
    for k in range(len(pieces.names)):
        piece = pieces.read(k)
        volume += compute_cell_volumes(piece.points, piece.cells)[0].sum()
    assert 3 * len(prisms.cells) == counts_of(layered_run)["cells"]
    corner = prisms.points[prisms.cells]
    for k in range(3):  # positive at all corners
        around = [k, (k + 1) % 3, (k + 2) % 3]
        for plane, up in ((around, k + 3), ([n + 3 for n in around], k)):
            edges = corner[:, [plane[1], plane[2], up]] - corner[:, [plane[0]]]
            assert ((np.linalg.det(edges) > 0) == (up > 2)).all()
    u, v = corner[:, 1, :2] - corner[:, 0, :2], corner[:, 2, :2] - corner[:, 0, :2]
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    heights = (corner[:, 3:, 2] - corner[:, :3, 2]).mean(axis=1)
    assert (area * heights).sum() == pytest.approx(volume, rel=1e-9)


def test_faces_are_in_order_and_those_of_the_boundary_have_their_markers(
    layered_run: Path, prisms: PrismMesh
) -> None:
    assert (prisms.owner < prisms.neighbour).all()
    order = np.lexsort((prisms.neighbour, prisms.owner))
    assert (order == np.arange(len(order))).all()
    assert 5 * len(prisms.cells) == 2 * len(prisms.inner) + len(prisms.outer)
    triangles, marker, building = prisms.facets(3)
    assert set(marker.tolist()) == {Marker.GROUND, Marker.ROOF, Marker.TOP}
    assert ((building >= 0) == (marker == Marker.ROOF)).all()
    sides, upright, of = prisms.facets(4)
    assert set(upright.tolist()) == UPRIGHT
    assert ((of >= 0) == (upright == Marker.WALL)).all()
    assert len(triangles) + 2 * len(sides) == counts_of(layered_run)["facets"]
    normal = np.zeros(3)
    for face, corners in ((triangles, [0, 1, 2]), (sides, [0, 1, 2]), (sides, [0, 2, 3])):
        a, b, c = (prisms.points[face[:, k]] - prisms.points[0] for k in corners)
        normal += np.cross(b - a, c - a).sum(axis=0)
    np.testing.assert_allclose(normal, 0, atol=1e-5)  # closed, and all of it one way round
    west = prisms.points[sides[upright == Marker.WEST]]
    assert (np.cross(west[:, 1] - west[:, 0], west[:, 2] - west[:, 0])[:, 0] < 0).all()


def test_readers_find_prisms_and_quadrilaterals(layered_run: Path, prisms: PrismMesh, exported: Exported) -> None:
    grid = pyvista.read(exported(layered_run, "vtu", *PRISMS))
    assert set(grid.celltypes.tolist()) == {pyvista.CellType.WEDGE}
    volume = grid.compute_cell_sizes(length=False, area=False)["Volume"]
    assert volume.min() > 0
    mesh = meshio.read(exported(layered_run, "msh", *PRISMS))
    assert (mesh.cells_dict["wedge"] == prisms.cells).all()
    for kind, width in (("triangle", 3), ("quad", 4)):
        corners, marker, _ = prisms.facets(width)
        order = np.argsort(marker, kind="stable")
        assert (mesh.cells_dict[kind] == corners[order]).all()
        assert (mesh.cell_data_dict["gmsh:physical"][kind] == marker[order]).all()
    with h5py.File(exported(layered_run, "xdmf", *PRISMS).with_suffix(".h5")) as file:
        assert (file["cells"][:] == prisms.cells).all()
        assert (file["sides"][:] == prisms.facets(4)[0]).all()
        assert (file["side_marker"][:] == prisms.facets(4)[1]).all()
    with h5py.File(exported(layered_run, "cgns", *PRISMS)) as file:
        zone = file["city/air"]
        assert zone["cells/ data"][0] == 14
        assert (zone["cells/ElementConnectivity/ data"][:].reshape(-1, 6) == prisms.cells + 1).all()
        assert zone["walls_quadrilaterals/ data"][0] == 7


def test_xdmf_has_three_grids_that_vtk_reads(layered_run: Path, prisms: PrismMesh, exported: Exported) -> None:
    from vtkmodules.vtkIOXdmf2 import vtkXdmfReader

    blocks = read_vtk(vtkXdmfReader(), exported(layered_run, "xdmf", *PRISMS)).GetOutputDataObject(0)
    grids = [blocks.GetBlock(k) for k in range(blocks.GetNumberOfBlocks())]
    found = [(grid.GetCellType(0), grid.GetNumberOfCells()) for grid in grids]
    expected = [(13, len(prisms.cells)), (5, len(prisms.facets(3)[0])), (9, len(prisms.facets(4)[0]))]
    assert found == expected
    assert [grids[2].GetCellData().GetArrayName(k) for k in (0, 1)] == ["marker", "building"]


def test_openfoam_has_faces_of_three_and_of_four_corners(
    layered_run: Path, prisms: PrismMesh, exported: Exported
) -> None:
    case = exported(layered_run, "openfoam", *PRISMS)
    reader = pyvista.POpenFOAMReader(str(case / "case.foam"))
    grid = reader.read()["internalMesh"]
    assert set(grid.celltypes.tolist()) == {pyvista.CellType.WEDGE}
    assert grid.n_cells == len(prisms.cells)
    record = json.loads((case / "export.json").read_text())["meshes"][0]
    assert record["faces"] == len(prisms.inner) + len(prisms.outer)
    # With as many layers all of a hybrid mesh is prisms, also over seams: each side is one face.
    hybrid = exported(layered_run, "openfoam", "--cells", "hybrid", "--prism-layers", "1000")
    assert json.loads((hybrid / "export.json").read_text())["meshes"] == [record]
    assert record["patches"]["ground"] == (prisms.marker == Marker.GROUND).sum()
    quads = (prisms.outer[:, 3] != NO_CORNER) & (prisms.marker == Marker.WALL)
    assert record["patches"]["walls"] == quads.sum()


def test_columns_whose_levels_merge_are_refused(small_run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"tile .*: its cells are not all thirds of prisms.*--mesher layered"):
        export_run(small_run, tmp_path / "a.vtu", name="vtu", options={"cells": "prism"})
    with pytest.raises(ConfigError, match=r"--prism-layers 3: is for --cells hybrid"):
        export_run(small_run, tmp_path / "a.vtu", name="vtu", options={"cells": "prism", "prism_layers": 3})
    assert list(tmp_path.iterdir()) == []


def test_hybrid_cells_fill_the_air_of_any_columns_and_meet_face_to_face(
    small_run: Path, prisms: PrismMesh, layered_run: Path, exported: Exported
) -> None:
    # Reading them proves that all faces but those of the boundary are those of two cells, quadrilaterals too.
    mesh = read_prisms(open_pieces(small_run), "hybrid", 4)
    count = {width: len(rows) for width, rows in mesh.by_width()}
    assert set(count) == {4, 5, 6}
    words = ("--cells", "hybrid", "--prism-layers", "4")
    grid = pyvista.read(exported(small_run, "vtu", *words))
    assert {kind: int((grid.celltypes == kind).sum()) for kind in (10, 14, 13)} == {
        10: count[4],
        14: count[5],
        13: count[6],
    }
    volume = grid.compute_cell_sizes(length=False, area=False)["Volume"]
    assert volume.min() > 0
    pieces = open_pieces(small_run)
    parts = [pieces.read(k) for k in range(len(pieces.names))]
    total = sum(compute_cell_volumes(piece.points, piece.cells)[0].sum() for piece in parts)
    assert volume.sum() == pytest.approx(total, rel=1e-9)
    msh = meshio.read(exported(small_run, "msh", *words))
    assert [len(msh.cells_dict[kind]) for kind in ("tetra", "pyramid", "wedge")] == [count[n] for n in (4, 5, 6)]
    with h5py.File(exported(small_run, "cgns", *words)) as file:
        kinds = [file[f"city/air/{name}/ data"][0] for name in ("cells", "pyramids", "tetrahedra")]
    assert kinds == [14, 12, 10]
    with h5py.File(exported(small_run, "xdmf", *words).with_suffix(".h5")) as file:
        assert len(file["cells"]) == sum((width + 1) * n for width, n in count.items())
    # In layers no prism is lost where there are enough of them.
    assert (read_prisms(open_pieces(layered_run), "hybrid", 1000).cells == prisms.cells).all()


def test_parts_of_a_hybrid_mesh_share_the_faces_between_them(small_run: Path, exported: Exported) -> None:
    options = ("--cells", "hybrid")
    (whole,) = json.loads((exported(small_run, "openfoam", *options) / "export.json").read_text())["meshes"]
    case = exported(small_run, "openfoam", *options, "--parts", "3")
    record = json.loads((case / "export.json").read_text())
    parts = record["meshes"]
    assert sum(part["cells"] for part in parts) == whole["cells"]
    between = sum(n for _, _, n in record["interfaces"])
    assert between > 0
    assert sum(part["faces"] for part in parts) == whole["faces"] + between
    assert sum(part["inner_faces"] for part in parts) == whole["inner_faces"] - between
    for name, n in whole["patches"].items():
        assert sum(part["patches"][name] for part in parts) == n


@pytest.mark.long
def test_programs_are_content(layered_run: Path, prisms: PrismMesh, tmp_path: Path) -> None:
    options = {"cells": "prism", "case": "wind", "direction": [240.0], "buildings": "patches"}
    export_run(layered_run, tmp_path / "case", name="openfoam", options=options)
    text = run_foam("checkMesh", tmp_path / "case")
    assert mesh_is_ok(text)
    assert read_check(text)["cells"] == len(prisms.cells)
    control = tmp_path / "case" / "system" / "controlDict"
    control.write_text(re.sub(r"endTime +\d+;", "endTime 20;", control.read_text()))
    run_foam("simpleFoam", tmp_path / "case")
    for name, command in (("msh", ["gmsh", "-check"]), ("cgns", ["cgnscheck"])):
        export_run(layered_run, tmp_path / f"a.{name}", name=name, options={"cells": "prism"})
        said = run_program([*command, f"a.{name}"], tmp_path)
        assert "rror" not in said, said[-2000:]
