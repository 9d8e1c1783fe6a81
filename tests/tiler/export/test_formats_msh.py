"""Gmsh's files: groups with names, every element once, read by meshio and by Gmsh and OpenFOAM themselves."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from tests.helpers.patch_readers import expected_of
from tests.helpers.programs import mesh_is_ok, read_check, run_foam, run_program
from tests.tiler.export.conftest import Exported
from tiler.export.export import export_run
from tiler.export.foam_patches import PATCHES
from tiler.formats.msh import AIR
from tiler.mesh_files.mesh_pieces import open_pieces

FORMATS = ["msh", "msh2"]


def groups_of(mesh: Any, kind: str) -> dict[int, NDArray[np.int64]]:
    """Nodes of the elements of one kind by physical group, in their order."""
    found: dict[int, list[Any]] = {}
    for block, physical in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True):
        if block.type == kind:
            for group in np.unique(physical).tolist():
                found.setdefault(group, []).append(block.data[physical == group])
    return {group: np.concatenate(rows) for group, rows in found.items()}


@pytest.mark.parametrize("name", FORMATS)
def test_meshio_reads_points_cells_and_groups(small_run: Path, exported: Exported, name: str) -> None:
    mesh = meshio.read(exported(small_run, name))
    pieces = open_pieces(small_run)
    parts = [pieces.read(k) for k in range(len(pieces.names))]
    assert len(mesh.points) == pieces.n_points
    for part in parts:
        assert np.array_equal(mesh.points[part.ids], part.points)
    cells = groups_of(mesh, "tetra")
    assert list(cells) == [AIR]
    assert np.array_equal(cells[AIR], np.concatenate([part.ids[part.cells] for part in parts]))
    facets = groups_of(mesh, "triangle")
    markers = np.unique(np.concatenate([part.marker for part in parts])).tolist()
    assert sorted(facets) == markers
    for marker, found in facets.items():
        expected = np.concatenate([part.ids[part.facets[part.marker == marker]] for part in parts])
        assert np.array_equal(found, expected)
    names = {group: (tag, dimension) for group, (tag, dimension) in mesh.field_data.items()}
    assert names == {**{PATCHES[Marker(m)]: (m, 2) for m in markers}, "air": (AIR, 3)}


def check_with_gmsh(path: Path) -> dict[str, int]:
    """What Gmsh says of a file, complaints included; it ends with 0 either way."""
    text = run_program(["gmsh", "-check", str(path)], path.parent)
    counts = {word: re.search(rf"(\d+) {word}$", text, re.MULTILINE) for word in ("nodes", "elements")}
    found = {word: int(match[1]) if match else 0 for word, match in counts.items()}
    assert "Done checking mesh coherence" in text, text
    return found | {"complaints": len(re.findall(r"^(?:Warning|Error)", text, re.MULTILINE))}


@pytest.mark.long
@pytest.mark.parametrize("name", FORMATS)
def test_gmsh_has_no_complaints(small_run: Path, exported: Exported, name: str) -> None:
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    elements = counts["cells"] + counts["facets"]
    assert check_with_gmsh(exported(small_run, name)) == {
        "nodes": counts["points"],
        "elements": elements,
        "complaints": 0,
    }


@pytest.mark.long
def test_gmsh_complains_of_a_broken_file(small_run: Path, exported: Exported, tmp_path: Path) -> None:
    lines = exported(small_run, "msh2").read_text().splitlines()
    at = lines.index("$Nodes") + 2
    # Two nodes at one place.
    lines[at] = " ".join([lines[at].split()[0], *lines[at + 1].split()[1:]])
    (tmp_path / "broken.msh").write_text("\n".join([*lines, ""]))
    assert check_with_gmsh(tmp_path / "broken.msh")["complaints"] > 0


def assert_gmsh_to_foam(run: Path, path: Path, case: Path) -> None:
    export_run(run, case, name="openfoam")
    shutil.rmtree(case / "constant")
    run_foam("gmshToFoam", case, str(path))
    text = run_foam("checkMesh", case)
    assert mesh_is_ok(text), text[-3000:]
    found, counts = read_check(text), json.loads((run / "run.json").read_text())["counts"]
    assert (found["cells"], found["points"], found["regions"]) == (counts["cells"], counts["points"], 1)
    expected = {patch: len(corners) for patch, corners in expected_of(open_pieces(run), path, "msh2").items()}
    assert {name[6:]: n for name, n in found.items() if name.startswith("patch ")} == expected


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_gmsh_to_foam_makes_the_same_patches(small_run: Path, exported: Exported, tmp_path: Path) -> None:
    assert_gmsh_to_foam(small_run, exported(small_run, "msh2"), tmp_path / "case")


@pytest.mark.long
@pytest.mark.shared
@pytest.mark.timeout(3600)
def test_gmsh_and_gmsh_to_foam_read_amsterdam(amsterdam_run: Path, tmp_path: Path) -> None:
    counts = json.loads((amsterdam_run / "run.json").read_text())["counts"]
    for name in FORMATS:
        path = tmp_path / f"{name}.msh"
        export_run(amsterdam_run, path, name=name)
        found = check_with_gmsh(path)
        assert found == {
            "nodes": counts["points"],
            "elements": counts["cells"] + counts["facets"],
            "complaints": 0,
        }
    assert_gmsh_to_foam(amsterdam_run, path, tmp_path / "case")
