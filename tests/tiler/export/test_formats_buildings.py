"""The surface of each building by its number, in every format that can hold it."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.patch_readers import corners_of, patch_of, sorted_rows
from tests.helpers.programs import mesh_is_ok, run_foam
from tests.tiler.export.conftest import Exported
from tests.tiler.export.test_formats_glb import validate
from tests.tiler.export.test_formats_msh import check_with_gmsh
from tiler.cli.main import main
from tiler.export.export import export_run, load_format
from tiler.export.foam_patches import HOUSE, building_name
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.vtk_files import read_vtp

PATCHES = ("--buildings", "patches")


def test_numbers_stand_beside_the_facets_in_vtp(small_run: Path, tmp_path: Path) -> None:
    export_run(small_run, tmp_path / "all.vtp", name="vtp")
    piece = read_vtp(tmp_path / "all.vtp")
    expected = corners_of(open_pieces(small_run), patch_of)
    numbers = np.unique(piece.boundary.building[piece.boundary.building >= 0]).tolist()
    assert sorted(map(building_name, numbers)) == sorted(name for name in expected if name.startswith("building_"))
    for number in numbers:
        rows = (piece.boundary.building == number) & np.isin(piece.boundary.marker, HOUSE)
        found = piece.points[piece.boundary.facets[rows]]
        assert sorted_rows(found) == sorted_rows(expected[building_name(number)])


@pytest.mark.parametrize("name", ["vtp", "ply", "xdmf", "gpkg"])
def test_formats_without_patches_say_so(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    target = tmp_path / f"x{load_format(name).suffix}"
    command = ["export", str(small_run), "--format", name, "-o", str(target), "--buildings", "patches"]
    assert main(command) == 2
    assert f"--buildings: format {name} does not take it" in capsys.readouterr().err
    assert not target.exists()


@pytest.mark.long
@pytest.mark.parametrize("name", ["msh", "msh2"])
def test_gmsh_has_no_complaints(small_run: Path, exported: Exported, name: str) -> None:
    found: dict[str, Any] = check_with_gmsh(exported(small_run, name, *PATCHES))
    assert found["nodes"] > 0
    assert found["complaints"] == 0


@pytest.mark.long
def test_the_gltf_validator_has_no_complaints(
    small_run: Path, exported: Exported, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = validate(exported(small_run, "glb", *PATCHES), monkeypatch)
    assert report["issues"]["messages"] == []
    assert report["info"]["drawCallCount"] > 20


def patch_sizes(case: Path) -> dict[str, int]:
    """Faces by patch, as the file `boundary` says."""
    text = (case / "constant" / "polyMesh" / "boundary").read_text()
    return {name: int(n) for name, n in re.findall(r"(\w+)\s*\{[^}]*nFaces +(\d+);", text)}


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_gmsh_to_foam_has_the_patches_of_our_own_case(small_run: Path, exported: Exported, tmp_path: Path) -> None:
    case = tmp_path / "case"
    export_run(small_run, case, name="openfoam", options={"buildings": "patches"})
    ours = patch_sizes(case)
    shutil.rmtree(case / "constant")
    run_foam("gmshToFoam", case, str(exported(small_run, "msh2", *PATCHES)))
    # checkMesh prints long names and numbers without a space between them.
    assert mesh_is_ok(run_foam("checkMesh", case))
    assert sum(name.startswith("building_") for name in ours) >= 10
    assert patch_sizes(case) == ours
