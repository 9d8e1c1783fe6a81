"""OpenFOAM cases: the order of faces, patches, parts and their addresses; read by VTK and by OpenFOAM itself."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError, OutputError
from stitch.pieces import face_mates
from stitch.pieces.cell_faces import find_cell_faces
from tests.conftest import Once
from tests.helpers.foam_reader import PolyMesh, read_field, read_header, read_labels, read_poly_mesh, read_zones
from tests.helpers.hand_pieces import HandPieces, box_pieces
from tests.helpers.patch_readers import INTERNAL, corners_of, expected_of, volume_of_cells
from tests.helpers.programs import mesh_is_ok, read_check, run_foam
from tests.helpers.synthetic import run_city
from tests.helpers.vtk_readers import read_vtk
from tiler.cli.main import main
from tiler.export import region_faces
from tiler.export.export import export_run
from tiler.export.foam_patches import PATCHES
from tiler.export.pieces import Pieces
from tiler.formats import openfoam
from tiler.formats.openfoam import write_openfoam
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.store.atomic import replacing_folder

MESH = "constant/polyMesh"
Corners = NDArray[np.float64]


@pytest.fixture(scope="module")
def box() -> HandPieces:
    """Six tiles."""
    return box_pieces()


def write(folder: Path, pieces: Pieces, **options: Any) -> Path:
    folder.mkdir()
    write_openfoam(folder, pieces, **options)
    return folder


def whole(folder: Path) -> PolyMesh:
    return read_poly_mesh(folder / MESH)


def sorted_rows(corners: Corners) -> Corners:
    """Sort the points of each row by place, so that order and orientation do not count."""
    flat = corners.reshape(-1, 3)
    row = np.repeat(np.arange(len(corners)), corners.shape[1])
    rows: Corners = flat[np.lexsort((flat[:, 2], flat[:, 1], flat[:, 0], row))].reshape(corners.shape)
    return rows


def cells_of(mesh: PolyMesh) -> NDArray[np.int64]:
    """Vertices (m, 4) of each cell, ascending; fails if a cell is no tetrahedron."""
    cell = np.concatenate([mesh.owner, mesh.neighbour])
    faces = np.concatenate([mesh.faces, mesh.faces[: len(mesh.neighbour)]])
    assert (np.bincount(cell, minlength=mesh.n_cells) == 4).all()
    corners: NDArray[np.int64] = np.sort(faces[np.argsort(cell, kind="stable")].reshape(-1, 12), axis=1)
    assert (corners[:, 0::3] == corners[:, 1::3]).all()
    assert (corners[:, 0::3] == corners[:, 2::3]).all()
    return corners[:, ::3]


def areas_of(mesh: PolyMesh) -> Corners:
    a, b, c = (mesh.points[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def volumes_of(mesh: PolyMesh) -> NDArray[np.float64]:
    """Volume of each cell by the divergence theorem: positive only if all faces point out of their owners."""
    centre = mesh.points[mesh.faces].mean(axis=1) - mesh.points.mean(axis=0)
    flux = np.einsum("ij,ij->i", centre, areas_of(mesh)) / 3
    inner = flux[: len(mesh.neighbour)]
    outward = np.bincount(mesh.owner, flux, mesh.n_cells).astype(np.float64)
    return outward - np.bincount(mesh.neighbour, inner, mesh.n_cells)


def assert_in_order(mesh: PolyMesh) -> None:
    """Hold the faces against what OpenFOAM asks of them."""
    owner, neighbour = mesh.owner[: len(mesh.neighbour)], mesh.neighbour
    assert (owner < neighbour).all()
    assert (np.diff(owner * mesh.n_cells + neighbour) > 0).all()
    start = len(neighbour)
    for patch in mesh.patches.values():
        assert patch.start == start
        start += patch.n
    assert start == len(mesh.faces) == len(mesh.owner)
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.points)))
    # Normals point from a cell to the face, for every face, not in the sum only.
    middle = mesh.points[cells_of(mesh)].mean(axis=1)
    out = mesh.points[mesh.faces].mean(axis=1) - middle[mesh.owner]
    assert (np.einsum("ij,ij->i", out, areas_of(mesh)) > 0).all()


def expected_cells(pieces: Pieces) -> tuple[Corners, NDArray[np.float64]]:
    corners = np.concatenate(
        [piece.points[piece.cells] for piece in (pieces.read(k) for k in range(len(pieces.names)))]
    )
    a, b, c, d = (corners[:, k] for k in range(4))
    return corners, np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6


def test_whole_mesh_is_that_of_the_pieces(box: HandPieces, tmp_path: Path) -> None:
    mesh = whole(write(tmp_path / "case", box))
    assert_in_order(mesh)
    corners, volumes = expected_cells(box)
    assert (volumes > 0).all()
    assert np.array_equal(sorted_rows(mesh.points[cells_of(mesh)]), sorted_rows(corners))
    assert np.allclose(volumes_of(mesh), volumes, rtol=1e-9)
    assert len(mesh.faces) == (4 * len(corners) + sum(len(piece.facets) for piece in box.pieces)) // 2
    for piece in box.pieces:
        assert np.array_equal(mesh.points[piece.ids], piece.points)
    assert [path.name for path in tmp_path.iterdir()] == ["case"]
    assert sorted(path.name for path in (tmp_path / "case").rglob("*")) == [
        "boundary",
        "constant",
        "faces",
        "neighbour",
        "owner",
        "points",
        "polyMesh",
    ]


def test_patches_have_the_facets_of_their_markers(box: HandPieces, tmp_path: Path) -> None:
    mesh = whole(write(tmp_path / "case", box))
    assert list(mesh.patches) == ["ground", "roofs", "top", "west", "south", "north", "missing"]
    for marker, name in PATCHES.items():
        if name not in mesh.patches:
            continue
        corners = np.concatenate([piece.points[piece.facets[piece.marker == marker]] for piece in box.pieces])
        found = mesh.points[mesh.faces[mesh.patch_of(name)]]
        assert np.array_equal(sorted_rows(found), sorted_rows(corners))
    kinds = {name: (patch.kind, patch.groups) for name, patch in mesh.patches.items()}
    assert kinds["ground"] == ("wall", ("wall",))
    assert kinds["roofs"] == ("wall", ("wall", "buildings"))
    assert kinds["top"] == kinds["missing"] == ("patch", ())


def test_buildings_as_patches_and_as_zones(box: HandPieces, tmp_path: Path) -> None:
    patches = whole(write(tmp_path / "patches", box, buildings="patches"))
    assert_in_order(patches)
    zoned = whole(write(tmp_path / "zones", box, buildings="zones"))
    zones = read_zones(tmp_path / "zones" / MESH / "faceZones")
    names = ["building_11", "building_12", "building_13"]
    assert list(zones) == names
    assert [name for name in patches.patches if name.startswith("building")] == names
    assert "roofs" not in patches.patches
    assert patches.patches["building_12"].groups == ("wall", "buildings")
    for number, name in enumerate(names, start=11):
        corners = [piece.points[piece.facets[piece.building == number]] for piece in box.pieces]
        expected = sorted_rows(np.concatenate(corners))
        assert len(expected) == (8 if number == 13 else 16)
        assert np.array_equal(sorted_rows(patches.points[patches.faces[patches.patch_of(name)]]), expected)
        assert np.array_equal(sorted_rows(zoned.points[zoned.faces[zones[name]]]), expected)
    plain = write(tmp_path / "plain", box)
    assert (plain / MESH / "faces").read_bytes() == (tmp_path / "zones" / MESH / "faces").read_bytes()


@pytest.mark.parametrize(
    ("tiles", "cubes", "parts", "buildings"),
    [
        ((3, 2), 2, 1, None),
        ((3, 2), 2, 2, "zones"),
        ((3, 2), 2, 3, None),
        ((3, 2), 2, 6, "zones"),
        # Cells with faces towards two other tiles.
        ((3, 3), 1, 4, None),
        ((3, 3), 1, 9, "zones"),
        # More parts than tiles: each tile is divided, and each part has cells of several.
        ((1, 1), 4, 3, "zones"),
        ((2, 1), 3, 5, "zones"),
        ((2, 2), 2, 7, None),
    ],
)
def test_parts_are_the_whole_taken_apart(
    tmp_path: Path, tiles: tuple[int, int], cubes: int, parts: int, buildings: str | None
) -> None:
    box = box_pieces(tiles, cubes)
    all_of_it = whole(write(tmp_path / "whole", box, buildings=buildings))
    folder = write(tmp_path / "parts", box, parts=parts, buildings=buildings)
    assert sorted(path.name for path in folder.iterdir()) == [f"processor{n}" for n in range(parts)]
    meshes = [read_poly_mesh(folder / f"processor{n}" / MESH) for n in range(parts)]
    whole_cells = cells_of(all_of_it)
    seen_cells, seen_faces = [], []
    for n, mesh in enumerate(meshes):
        assert_in_order(mesh)
        place = folder / f"processor{n}" / MESH
        point, cell, face, patch = (
            read_labels(place / f"{name}ProcAddressing") for name in ("point", "cell", "face", "boundary")
        )
        assert np.array_equal(mesh.points, all_of_it.points[point])
        assert np.array_equal(np.sort(point[cells_of(mesh)], axis=1), whole_cells[cell])
        # A face that is turned has its owner in another part: 1 stands for face 0, -1 for face 0 turned.
        own, turned = np.abs(face) - 1, face < 0
        expected = all_of_it.faces[own]
        expected[turned] = expected[turned][:, [0, 2, 1]]
        assert np.array_equal(point[mesh.faces], expected)
        n_inner = len(mesh.neighbour)
        assert not turned[:n_inner].any()
        assert np.array_equal(cell[mesh.owner[~turned]], all_of_it.owner[own[~turned]])
        assert np.array_equal(cell[mesh.owner[turned]], all_of_it.neighbour[own[turned]])
        names, whole_names = list(mesh.patches), list(all_of_it.patches)
        assert [whole_names[row] if row >= 0 else "" for row in patch] == [
            "" if name.startswith("procBoundary") else name for name in names
        ]
        seen_cells.append(cell)
        seen_faces.append(own)
        if buildings:
            zones = read_zones(place / "faceZones")
            whole_zones = read_zones(tmp_path / "whole" / MESH / "faceZones")
            assert list(zones) == list(whole_zones)
            assert all(np.isin(own[zones[name]], whole_zones[name]).all() for name in zones)
    assert np.array_equal(np.sort(np.concatenate(seen_cells)), np.arange(all_of_it.n_cells))
    count = np.bincount(np.concatenate(seen_faces), minlength=len(all_of_it.faces))
    n_between = sum(p.n for mesh in meshes for p in mesh.patches.values() if p.kind == "processor")
    assert count.min() == 1
    assert n_between == 2 * int((count == 2).sum())
    assert (parts == 1) == (n_between == 0)
    assert_sides_agree(meshes)


def assert_sides_agree(meshes: list[PolyMesh]) -> None:
    """Both sides of a processor patch have the same faces in the same order, from the same vertex on."""
    for n, mesh in enumerate(meshes):
        for name, patch in mesh.patches.items():
            if patch.kind != "processor":
                continue
            other = int(patch.words["neighbProcNo"])
            assert (name, patch.words["myProcNo"]) == (f"procBoundary{n}to{other}", str(n))
            beyond = meshes[other]
            here = mesh.points[mesh.faces[mesh.patch_of(name)]]
            there = beyond.points[beyond.faces[beyond.patch_of(f"procBoundary{other}to{n}")]]
            assert np.array_equal(here, there[:, [0, 2, 1]])


def test_long_labels_where_short_ones_would_overflow(
    box: HandPieces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = whole(write(tmp_path / "short", box))
    assert read_header(tmp_path / "short" / MESH / "owner")["arch"] == "LSB,label=32,scalar=64"
    monkeypatch.setattr(openfoam, "LABEL_LIMIT", 3 * len(short.faces) - 1)
    long = whole(write(tmp_path / "long", box))
    assert read_header(tmp_path / "long" / MESH / "owner")["arch"] == "LSB,label=64,scalar=64"
    assert np.array_equal(long.faces, short.faces)
    assert np.array_equal(long.neighbour, short.neighbour)
    monkeypatch.setattr(openfoam, "LABEL_LIMIT", 3 * len(short.faces))
    write(tmp_path / "again", box)
    assert read_header(tmp_path / "again" / MESH / "owner")["arch"] == "LSB,label=32,scalar=64"


def damaged(box: HandPieces, k: int, **arrays: Any) -> HandPieces:
    pieces = list(box.pieces)
    pieces[k] = replace(pieces[k], **arrays)
    return replace(box, pieces=pieces)


def test_pieces_that_do_not_fit_are_refused(box: HandPieces, tmp_path: Path) -> None:
    piece = box.read(2)
    cut = damaged(box, 2, cells=piece.cells[1:])
    with pytest.raises(InputError, match=r"tile \d_\d: .*; run citystitch check"):
        write(tmp_path / "cut", cut)
    with pytest.raises(InputError, match=r"tile 1_0: the facet .* is no exterior face of a cell"):
        write(tmp_path / "facet", damaged(box, 2, facets=np.roll(piece.cells[:, :3], 1, axis=0)))
    lost = damaged(box, 2, facets=piece.facets[1:], marker=piece.marker[1:], building=piece.building[1:])
    with pytest.raises(InputError, match="tile 1_0: 1 faces at seams have no other cell; run citystitch check"):
        write(tmp_path / "lost", lost)
    twice = damaged(box, 2, cells=np.concatenate([piece.cells, piece.cells[:1]]))
    with pytest.raises(InputError, match="tile 1_0: more than two cells have the face"):
        write(tmp_path / "twice", twice)


def test_faces_of_cells_are_found_whatever_their_order() -> None:
    piece = box_pieces((1, 1), cubes=3, seed=5).read(0)
    faces = find_cell_faces(piece.cells, piece.facets, len(piece.points))
    assert len(faces.shared) == 0
    assert len(faces.owner) == (4 * len(piece.cells) - len(piece.facets)) // 2
    for corners, cell in (
        (faces.inner, faces.owner),
        (faces.inner, faces.neighbour),
        (piece.facets, faces.facet_cell),
    ):
        assert (corners[:, :, None] == piece.cells[cell][:, None, :]).any(axis=2).all()
    key = faces.owner.astype(np.int64) * len(piece.cells) + faces.neighbour
    assert (np.diff(key) > 0).all()
    assert (faces.owner < faces.neighbour).all()
    with pytest.raises(ValueError, match="a facet is there twice"):
        find_cell_faces(piece.cells, piece.facets[[0, 0]], len(piece.points))


def test_more_cells_than_their_faces_have_numbers_for_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    piece = box_pieces((1, 1)).read(0)
    monkeypatch.setattr(face_mates, "MOST_CELLS", len(piece.cells))
    find_cell_faces(piece.cells, piece.facets, len(piece.points))
    monkeypatch.setattr(face_mates, "MOST_CELLS", len(piece.cells) - 1)
    with pytest.raises(ValueError, match=f"{len(piece.cells)} cells in one piece, at most {len(piece.cells) - 1}"):
        find_cell_faces(piece.cells, piece.facets, len(piece.points))


@pytest.mark.parametrize("parts", [None, 3])
def test_the_size_of_blocks_changes_no_byte(
    box: HandPieces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parts: int | None
) -> None:
    at_once = write(tmp_path / "at_once", box, parts=parts)
    monkeypatch.setattr(region_faces, "BLOCK_CELLS", 7)
    monkeypatch.setattr(face_mates, "AT_ONCE", 11)
    by_seven = write(tmp_path / "by_seven", box, parts=parts)
    files = sorted(path.relative_to(at_once) for path in at_once.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(by_seven) for path in by_seven.rglob("*") if path.is_file())
    assert [path for path in files if (at_once / path).read_bytes() != (by_seven / path).read_bytes()] == []


def read_with_vtk(case: Path) -> dict[str, Any]:
    """Read a case as ParaView does: blocks by name."""
    from vtkmodules.vtkCommonDataModel import vtkCompositeDataSet
    from vtkmodules.vtkIOGeometry import vtkOpenFOAMReader

    reader = vtkOpenFOAMReader()

    def take_all() -> None:
        reader.UpdateInformation()
        reader.EnableAllPatchArrays()

    output = read_vtk(reader, case / "case.foam", take_all).GetOutput()
    blocks = {"cells": output.GetBlock(0)}
    boundary = output.GetBlock(1)
    for i in range(boundary.GetNumberOfBlocks()):
        blocks[boundary.GetMetaData(i).Get(vtkCompositeDataSet.NAME())] = boundary.GetBlock(i)
    return blocks


def counts_by_patch(run: Path) -> dict[str, int]:
    return {name: len(corners) for name, corners in expected_of(open_pieces(run), run, "openfoam").items()}


def volume_of(run: Path) -> float:
    return volume_of_cells(corners_of(open_pieces(run), lambda *_: "")[INTERNAL])


def test_export_of_a_run_is_read_by_vtk(small_run: Path, tmp_path: Path) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    case = tmp_path / "case"
    assert main(["export", str(small_run), "--format", "openfoam", "-o", str(case), "--case", "wind"]) == 0
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    blocks = read_with_vtk(case)
    cells = blocks.pop("cells")
    assert (cells.GetNumberOfPoints(), cells.GetNumberOfCells()) == (counts["points"], counts["cells"])
    assert {name: block.GetNumberOfCells() for name, block in blocks.items()} == counts_by_patch(small_run)
    mesh = whole(case)
    assert_in_order(mesh)
    assert volumes_of(mesh).min() > 0
    assert volumes_of(mesh).sum() == pytest.approx(volume_of(small_run), rel=1e-9)
    # VTK reads single precision unless told, so places are compared loosely.
    assert np.allclose(vtk_to_numpy(cells.GetPoints().GetData()), mesh.points, atol=1.0)
    record = json.loads((case / "export.json").read_text())
    assert record["meshes"][0]["cells"] == counts["cells"]
    assert "numberOfSubdomains" in (case / "system" / "decomposeParDict").read_text()
    ground = next(line for line in (case / "constant" / "wind").read_text().splitlines() if "zGround" in line)
    west = mesh.points[mesh.faces[mesh.patch_of("west")]]
    assert float(ground.split()[2].rstrip(";")) == pytest.approx(west[..., 2].min())


def test_options_and_targets_that_cannot_be(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", str(small_run), "--format", "openfoam", "-o", str(tmp_path / "case")]
    assert main([*command, "--parts", "0"]) == 2
    assert "--parts 0: must be 1 or more" in capsys.readouterr().err
    assert main([*command, "--parts", "100000"]) == 2
    assert "cells stand in columns, which are not divided, and these are too few" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert main(["export", str(small_run), "--format", "vtu", "-o", str(tmp_path / "x"), "--parts", "2"]) == 2
    assert "--parts: format vtu does not take it; its options: --scalars" in capsys.readouterr().err
    mine = tmp_path / "case" / "mine"
    mine.mkdir(parents=True)
    assert main(command) == 2
    assert "case: exists; give another --output, or --overwrite" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 2
    assert "case: holds no export.json, so it was not exported" in capsys.readouterr().err
    assert mine.is_dir()
    shutil.rmtree(tmp_path / "case")
    assert main(command) == 0
    assert main([*command, "--parts", "2", "--overwrite"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["case"]
    assert not (tmp_path / "case" / "constant").exists()
    assert (tmp_path / "case" / "processor1").is_dir()
    with pytest.raises(ConfigError, match="format xdmf does not take it"):
        export_run(small_run, tmp_path / "x.xdmf", name="xdmf", options={"case": "wind"})


def test_folders_appear_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "case"

    def fail(error: BaseException) -> None:
        with replacing_folder(target) as part:
            (part / "new").touch()
            raise error

    with pytest.raises(KeyboardInterrupt):
        fail(KeyboardInterrupt())
    assert list(tmp_path.iterdir()) == []
    with replacing_folder(target) as part:
        (part / "old").touch()
    with pytest.raises(OutputError, match=r"case: cannot be written \(No space left on device\)"):
        fail(OSError(28, "No space left on device"))
    assert [path.name for path in tmp_path.rglob("*")] == ["case", "old"]
    with replacing_folder(target) as part:
        (part / "new").touch()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["case", "new"]


TIGHT = """solvers
{
    "(p|Phi|T)" { solver PCG; preconditioner DIC; tolerance 1e-11; relTol 0; maxIter 3000; }
    "(U|k|epsilon)" { solver PBiCGStab; preconditioner DILU; tolerance 1e-10; relTol 0; }
}
SIMPLE { nNonOrthogonalCorrectors 0; }
potentialFlow { nNonOrthogonalCorrectors 2; }
relaxationFactors { fields { p 0.3; } equations { U 0.5; "(k|epsilon)" 0.4; } }
"""
HEAD = "FoamFile { version 2.0; format ascii; class %s; object %s; }\n"
HEAT = """dimensions [0 0 0 1 0 0 0];
internalField uniform 0;
boundaryField
{
    ".*" { type zeroGradient; }
    "procBoundary.*" { type processor; value uniform 0; }
    ground { type fixedValue; value uniform 1; }
    top { type fixedValue; value uniform 0; }
}
"""


def set_control(case: Path, **words: object) -> None:
    path = case / "system" / "controlDict"
    text = path.read_text()
    for name, value in words.items():
        text, n = re.subn(rf"^{name} .*;", f"{name} {value};", text, flags=re.MULTILINE)
        assert n == 1
    path.write_text(text)


def export_cases(run: Path, folder: Path) -> tuple[Path, Path]:
    """Export a wind case whole and for two processes."""
    one, two = folder / "one", folder / "two"
    export_run(run, one, name="openfoam", options={"case": "wind"})
    export_run(run, two, name="openfoam", options={"case": "wind", "parts": 2})
    return one, two


def assert_check_mesh_is_content(run: Path, one: Path, two: Path) -> None:
    counts, patches = json.loads((run / "run.json").read_text())["counts"], counts_by_patch(run)
    for case, parts in ((one, None), (two, 2)):
        text = run_foam("checkMesh", case, parts=parts)
        assert mesh_is_ok(text), text[-3000:]
        found = read_check(text)
        assert found["regions"] == 1
        assert found["cells"] == found["tetrahedra"] == counts["cells"]
        assert found["volume"] == pytest.approx(volume_of(run), rel=1e-9)
        assert {name[6:]: n for name, n in found.items() if name.startswith("patch ")} == patches
    assert read_check(run_foam("checkMesh", one))["points"] == counts["points"]


def solve(case: Path, parts: int | None) -> None:
    """Run three solvers on a case, with linear systems solved to rounding."""
    (case / "system" / "fvSolution").write_text(HEAD % ("dictionary", "fvSolution") + TIGHT)
    (case / "constant" / "transportProperties").write_text(
        HEAD % ("dictionary", "transportProperties")
        + "transportModel Newtonian; nu 1.5e-5; DT DT [0 2 -1 0 0 0 0] 1;\n"
    )
    starts = [case / "0"] if parts is None else [case / f"processor{n}" / "0" for n in range(parts)]
    for start in starts:
        (start / "T").write_text(HEAD % ("volScalarField", "T") + HEAT)
        shutil.copytree(start, start.parent / "kept")
    set_control(case, endTime=1, writeInterval=1)
    run_foam("laplacianFoam", case, parts=parts)
    for start in starts:
        shutil.move(start.parent / "1" / "T", start.parent / "T")
        shutil.rmtree(start.parent / "1")
        (start / "T").unlink()
    run_foam("potentialFoam", case, "-writephi", parts=parts)
    # potentialFoam of Debian's OpenFOAM 1912 makes wrong velocities of right fluxes on tetrahedra of any origin.
    for start in starts:
        shutil.move(start / "phi", start.parent / "phi")
        shutil.rmtree(start)
        shutil.move(start.parent / "kept", start)
        (start / "T").unlink(missing_ok=True)
    set_control(case, endTime=2, writeInterval=2)
    run_foam("simpleFoam", case, parts=parts)


def gather(case: Path, name: str, width: int, n_cells: int, *, parts: int = 2) -> Corners:
    """Put the values of all processes where the whole mesh has them."""
    values = np.full((n_cells, width), np.nan)
    for part in range(parts):
        folder = case / f"processor{part}"
        values[read_labels(folder / MESH / "cellProcAddressing")] = read_field(folder / name, width)
    return values


def assert_solvers_agree(one: Path, two: Path) -> None:
    solve(one, None)
    solve(two, 2)
    for name, width, bound in (("T", 1, 1e-8), ("2/U", 3, 1e-4), ("2/p", 1, 1e-4), ("2/k", 1, 2e-4)):
        serial = read_field(one / name, width)
        parallel = gather(two, name, width, len(serial))
        assert np.ptp(serial) > 0
        assert np.linalg.norm(parallel - serial) <= bound * np.linalg.norm(serial), name
    temperature = read_field(one / "T", 1)
    assert temperature.min() >= -1e-6
    assert temperature.max() <= 1 + 1e-6
    flux = read_field(one / "phi", 1)[:, 0]
    for part in range(2):
        folder = two / f"processor{part}"
        own = read_field(folder / "phi", 1)[:, 0]
        face = read_labels(folder / MESH / "faceProcAddressing")[: len(own)] - 1
        assert np.linalg.norm(flux[face] - own) <= 1e-6 * np.linalg.norm(flux)


def assert_reconstructed(one: Path, two: Path) -> None:
    """OpenFOAM itself puts the parts together by our addresses; the whole mesh comes from the other export."""
    shutil.copytree(one / MESH, two / MESH)
    run_foam("reconstructPar", two, "-latestTime")
    serial, joined = (read_field(case / "2" / "U", 3) for case in (one, two))
    assert np.array_equal(joined, gather(two, "2/U", 3, len(serial)))
    assert mesh_is_ok(run_foam("checkMesh", two))


@pytest.fixture(scope="module")
def one_tile_run(once: Once) -> Path:
    """Finished run of a synthetic city on one tile."""
    city = {"size": 200, "buildings": 8, "density": 1.0}
    return once("one_tile", lambda folder: run_city(folder, city, tile_size=200.0)) / "out"


def test_one_tile_is_divided_evenly_and_interfaces_are_counted(one_tile_run: Path, tmp_path: Path) -> None:
    for parts in (2, 3, 4):
        case = tmp_path / str(parts)
        export_run(one_tile_run, case, name="openfoam", options={"parts": parts})
        record = json.loads((case / "export.json").read_text())
        cells = [mesh["cells"] for mesh in record["meshes"]]
        assert sum(cells) == json.loads((one_tile_run / "run.json").read_text())["counts"]["cells"]
        assert record["balance"] == pytest.approx(max(cells) * parts / sum(cells), rel=1e-6)
        assert record["balance"] <= 1.03
        assert record["interfaces"]
        for low, high, n in record["interfaces"]:
            mesh = read_poly_mesh(case / f"processor{low}" / MESH)
            assert mesh.patches[f"procBoundary{low}to{high}"].n == n
        found = sum(n for *_, n in record["interfaces"])
        patches = [mesh["patches"] for mesh in record["meshes"]]
        assert 2 * found == sum(n for p in patches for name, n in p.items() if name.startswith("procBoundary"))
        assert f"numberOfSubdomains {parts};" in (case / "system" / "decomposeParDict").read_text()


@pytest.mark.long
def test_decompose_par_divides_a_whole_case_as_it_comes(small_run: Path, tmp_path: Path) -> None:
    case = tmp_path / "case"
    export_run(small_run, case, name="openfoam", options={})
    run_foam("decomposePar", case)
    cells = [len(read_labels(case / f"processor{n}" / MESH / "cellProcAddressing")) for n in range(4)]
    assert sum(cells) == json.loads((small_run / "run.json").read_text())["counts"]["cells"]
    assert max(cells) < 1.01 * min(cells)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_openfoam_reads_and_solves_a_small_city(small_run: Path, tmp_path: Path) -> None:
    one, two = export_cases(small_run, tmp_path)
    assert_check_mesh_is_content(small_run, one, two)
    assert_solvers_agree(one, two)
    assert_reconstructed(one, two)


def assert_decompose_par_does_the_same(start: Path, ours: Path, case: Path, parts: int) -> None:
    """Hold parts against those that OpenFOAM makes of the whole mesh with the same cells: lists, and results.

    Serial results differ by more, also from those of OpenFOAM's own parts.
    """
    shutil.copytree(start, case)
    cells = [read_labels(ours / f"processor{n}" / MESH / "cellProcAddressing") for n in range(parts)]
    part = np.empty(sum(map(len, cells)), np.int64)
    for number, rows in enumerate(cells):
        part[rows] = number
    lines = "\n".join(map(str, part.tolist()))
    (case / "constant" / "cells").write_text(HEAD % ("labelList", "cells") + f"{len(part)}\n(\n{lines}\n)\n")
    words = f'numberOfSubdomains {parts}; method manual; manualCoeffs {{ dataFile "cells"; }}\n'
    (case / "system" / "decomposeParDict").write_text(HEAD % ("dictionary", "decomposeParDict") + words)
    (case / "system" / "fvSolution").write_text(HEAD % ("dictionary", "fvSolution") + TIGHT)
    set_control(case, endTime=2, writeInterval=2)
    run_foam("decomposePar", case)
    run_foam("simpleFoam", case, parts=parts)
    for number in range(parts):
        for name in ("owner", "neighbour", "faceProcAddressing"):
            place = Path(f"processor{number}") / MESH / name
            assert np.array_equal(read_labels(ours / place), read_labels(case / place)), (number, name)
        for name, width in (("2/U", 3), ("2/p", 1), ("2/k", 1)):
            values = read_field(case / f"processor{number}" / name, width)
            difference = read_field(ours / f"processor{number}" / name, width) - values
            assert np.linalg.norm(difference) <= 1e-6 * np.linalg.norm(values), (number, name)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_openfoam_solves_one_tile_in_any_number_of_parts(one_tile_run: Path, tmp_path: Path) -> None:
    one = tmp_path / "one"
    export_run(one_tile_run, one, name="openfoam", options={"case": "wind"})
    shutil.copytree(one, tmp_path / "start")
    solve(one, None)
    serial = {name: read_field(one / name, width) for name, width in (("T", 1), ("2/U", 3), ("2/p", 1))}
    for parts in (2, 3, 4):
        case = tmp_path / str(parts)
        export_run(one_tile_run, case, name="openfoam", options={"case": "wind", "parts": parts})
        record = json.loads((case / "export.json").read_text())
        assert record["balance"] <= 1.03
        text = run_foam("checkMesh", case, parts=parts)
        assert mesh_is_ok(text), text[-3000:]
        assert read_check(text)["regions"] == 1
        solve(case, parts)
        for name, values in serial.items():
            parallel = gather(case, name, values.shape[1], len(values), parts=parts)
            bound = 1e-8 if name == "T" else 1e-3
            assert np.linalg.norm(parallel - values) <= bound * np.linalg.norm(values), (parts, name)
        assert_decompose_par_does_the_same(tmp_path / "start", case, tmp_path / f"decomposed_{parts}", parts)


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.timeout(1800)
def test_openfoam_reads_amsterdam(amsterdam_run: Path, tmp_path: Path) -> None:
    assert_check_mesh_is_content(amsterdam_run, *export_cases(amsterdam_run, tmp_path))


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.timeout(1800)
def test_openfoam_solves_on_real_blocks(amsterdam_blocks_run: Path, tmp_path: Path) -> None:
    one, two = export_cases(amsterdam_blocks_run, tmp_path)
    assert_check_mesh_is_content(amsterdam_blocks_run, one, two)
    assert_solvers_agree(one, two)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_check_mesh_reads_buildings_in_four_parts(small_run: Path, tmp_path: Path) -> None:
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    for kind in ("patches", "zones"):
        case = tmp_path / kind
        export_run(small_run, case, name="openfoam", options={"parts": 4, "buildings": kind})
        text = run_foam("checkMesh", case, parts=4)
        assert mesh_is_ok(text), text[-3000:]
        assert read_check(text)["cells"] == counts["cells"]
        # Of names alone: checkMesh glues long ones to what follows them.
        found = [int(n) for n in re.findall(r"^    (?:boundary patches|face zones): +(\d+)", text, re.MULTILINE)]
        plain, n = len(counts_by_patch(small_run)), counts["building parts"]
        assert found == ([plain - 2 + n, 0] if kind == "patches" else [plain, n])


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_check_mesh_says_so_where_a_mesh_is_broken(small_run: Path, tmp_path: Path) -> None:
    case = tmp_path / "case"
    export_run(small_run, case, name="openfoam")
    good = run_foam("checkMesh", case)
    assert mesh_is_ok(good)
    path = case / MESH / "neighbour"
    data, labels = path.read_bytes(), read_labels(path).astype("<i4")
    at = data.index(labels.tobytes())
    swapped = labels.copy()
    swapped[[0, 1]] = swapped[[1, 0]]
    path.write_bytes(data[:at] + swapped.tobytes() + data[at + len(swapped.tobytes()) :])
    assert not mesh_is_ok(run_foam("checkMesh", case))


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_wind_case_runs_as_it_comes(small_run: Path, tmp_path: Path) -> None:
    case = tmp_path / "case"
    export_run(small_run, case, name="openfoam", options={"case": "wind"})
    set_control(case, endTime=100)
    text = run_foam("simpleFoam", case)
    residual = [float(value) for value in re.findall(r"Solving for Ux, Initial residual = ([-.\deE]+)", text)]
    assert len(residual) == 100
    assert residual[-1] < 0.1 * max(residual[:10])
    velocity = read_field(case / "100" / "U", 3)
    assert np.isfinite(velocity).all()
    assert np.linalg.norm(velocity, axis=1).max() < 20.0
    assert velocity[:, 0].mean() > 2.0
