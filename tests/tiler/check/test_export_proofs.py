"""An exported mesh of prisms and other cells is proved from its file, and each fault of it is found."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.tiler.export.conftest import Exported, exported
from tiler.check.export_proofs import check_export
from tiler.cli.main import main
from tiler.export.foam_files import FoamList, foam_header, read_foam_faces, read_foam_list

__all__ = ["exported"]
HYBRID = ("--cells", "hybrid")
LAYERS = (*HYBRID, "--prism-layers", "4")


@pytest.mark.parametrize(
    ("name", "words"),
    [("xdmf", LAYERS), ("cgns", LAYERS), ("openfoam", HYBRID), ("openfoam", (*HYBRID, "--parts", "3"))],
)
def test_exports_of_a_run_are_proved(
    small_run: Path, exported: Exported, capsys: pytest.CaptureFixture[str], name: str, words: tuple[str, ...]
) -> None:
    path = exported(small_run, name, *words)
    assert main(["check", str(small_run), "--export", str(path)]) == 0
    assert "everything is proved" in capsys.readouterr().out


def test_the_origin_of_an_export_is_told(
    small_run: Path, exported: Exported, capsys: pytest.CaptureFixture[str]
) -> None:
    path = exported(small_run, "msh", *HYBRID, "--origin", "5,-7,2")
    assert main(["check", str(small_run), "--export", str(path)]) == 0
    assert "those of the run, less 5, -7, 2 m, bit for bit" in capsys.readouterr().out


def test_parts_have_the_cells_and_faces_of_the_whole(small_run: Path, exported: Exported) -> None:
    found = []
    whole = exported(small_run, "openfoam", *HYBRID) / "constant/polyMesh"
    faces, owner = read_foam_faces(whole / "faces"), read_foam_list(whole / "owner", 1)
    for part in exported(small_run, "openfoam", *HYBRID, "--parts", "3").glob("processor*/constant/polyMesh"):
        of_face, of_cell, of_point = (
            read_foam_list(part / f"{name}ProcAddressing", 1)[:, 0] for name in ("face", "cell", "point")
        )
        mine, row = read_foam_faces(part / "faces"), np.abs(of_face) - 1
        found.append(row)
        turned = np.where(mine < 0, mine, of_point[mine])
        assert (np.sort(turned, axis=1) == np.sort(faces[row], axis=1)).all()
        kept = of_face > 0
        assert (of_cell[read_foam_list(part / "owner", 1)[kept, 0]] == owner[row[kept], 0]).all()
    assert (np.unique(np.concatenate(found)) == np.arange(len(faces))).all()


def move_points(case: Path) -> None:
    points = read_foam_list(case / "points", 3).copy()
    faces = read_foam_faces(case / "faces")
    sides = faces[faces[:, 3] >= 0]
    points[sides[0, 0], 2] += 200  # above the prism
    points[sides[-1, 0], 0] += 1e-3  # so that its sides are no longer upright
    rewrite(case / "points", "vectorField", points)


def give_a_face_away(case: Path) -> None:
    owner = read_foam_list(case / "owner", 1).copy()
    owner[0] = owner.max()
    rewrite(case / "owner", "labelList", owner)


def double_a_face(case: Path) -> None:
    data = (case / "faces").read_bytes()
    face = read_foam_faces(case / "faces")
    face = face[(face[:, 3] >= 0).argmax()].astype("<i4")
    (case / "faces").write_bytes(data.replace(face.tobytes(), face[::-1].tobytes(), 1))


def rewrite(path: Path, kind: str, rows: NDArray[Any]) -> None:
    header = foam_header(path.name, kind, location="constant/polyMesh", binary=True)
    with FoamList(path, header, "f8" if rows.shape[1] == 3 else "i4", width=rows.shape[1], n=len(rows)) as file:
        file.write(0, rows)


@pytest.mark.parametrize(
    ("damage", "kinds"),
    [
        (move_points, {"cell-inverted", "side-not-upright", "point-moved"}),
        (give_a_face_away, {"cell-inverted"}),
        (double_a_face, {"cell-inverted"}),
    ],
)
def test_a_fault_of_a_case_is_found(
    small_run: Path, exported: Exported, tmp_path: Path, damage: Callable[[Path], None], kinds: set[str]
) -> None:
    case = tmp_path / "case"
    shutil.copytree(exported(small_run, "openfoam", *HYBRID), case)
    damage(case / "constant" / "polyMesh")
    assert kinds <= {fault.kind for fault in check_export(small_run, case).faults}


def test_a_fault_of_a_file_is_found(small_run: Path, exported: Exported, tmp_path: Path) -> None:
    assert check_export(small_run, exported(small_run, "vtu", *LAYERS)).ok
    mesh = meshio.read(exported(small_run, "msh", *LAYERS))

    def kinds_with(wedges: NDArray[Any]) -> set[str]:
        cells = [("wedge", wedges), *((kind, mesh.cells_dict[kind]) for kind in ("tetra", "pyramid"))]
        meshio.write(tmp_path / "a.msh", meshio.Mesh(mesh.points, cells), file_format="gmsh22")
        return {fault.kind for fault in check_export(small_run, tmp_path / "a.msh").faults}

    wedges = mesh.cells_dict["wedge"]
    assert kinds_with(wedges) == set()
    assert kinds_with(wedges[1:]) == {"face-open", "facet-missing", "volume"}
    turned = np.concatenate((wedges[:1, [3, 4, 5, 0, 1, 2]], wedges[1:], wedges[-1:]))
    assert {"cell-inverted", "face-same-side", "face-shared", "volume"} <= kinds_with(turned)
    for suffix in ("vtu", "cgns", "xdmf"):
        (tmp_path / f"text.{suffix}").write_text("no mesh")
        assert main(["check", str(small_run), "--export", str(tmp_path / f"text.{suffix}")]) == 1
    assert main(["check", str(small_run), "--export", str(tmp_path / "a.stl")]) == 2
