"""The surface of each building by its number, in every format that can hold it."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from tests.helpers.programs import mesh_is_ok, run_foam
from tests.tiler.export.test_formats_cgns import corners_of, read_with_vtk
from tests.tiler.export.test_formats_glb import read_document, turned, validate
from tests.tiler.export.test_formats_msh import check_with_gmsh
from tiler.cli.main import main
from tiler.export.export import export_run, load_format
from tiler.export.foam_patches import HOUSE, building_name
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.vtk_files import read_vtp

Corners = NDArray[np.float64]
PER_PATCH = ["stl", "obj", "glb", "msh", "msh2", "cgns"]


@pytest.fixture(scope="module")
def exported(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The small city with a patch a building, in all formats that have one."""
    folder = tmp_path_factory.mktemp("buildings")
    files = {name: folder / f"{name}{load_format(name).suffix}" for name in PER_PATCH}
    for name, path in files.items():
        command = ["export", str(small_run), "--format", name, "-o", str(path)]
        assert main([*command, "--buildings", "patches"]) == 0
    return files


def read_stl(path: Path) -> dict[str, Corners]:
    found: dict[str, list[list[float]]] = {}
    name = ""
    for words in map(str.split, path.read_text().splitlines()):
        if words[0] == "solid":
            name = words[1]
            assert name not in found
            found[name] = []
        elif words[0] == "endsolid":
            assert words[1] == name
        elif words[0] == "vertex":
            found[name].append([float(word) for word in words[1:]])
    return {name: np.array(rows).reshape(-1, 3, 3) for name, rows in found.items()}


def read_obj(path: Path) -> dict[str, Corners]:
    points: list[list[float]] = []
    found: dict[str, list[list[int]]] = {}
    name = ""
    for words in map(str.split, path.read_text().splitlines()):
        if words[0] == "g":
            name = words[1]
        elif words[0] == "v":
            points.append([float(word) for word in words[1:]])
        elif words[0] == "f":
            found.setdefault(name, []).append([int(word) - 1 for word in words[1:]])
    return {name: np.array(points)[np.array(rows)] for name, rows in found.items()}


def read_msh(path: Path) -> dict[str, Corners]:
    mesh = meshio.read(path)
    names = {(tag, dimension): name for name, (tag, dimension) in mesh.field_data.items()}
    found: dict[str, list[Corners]] = {}
    for block, groups in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True):
        for tag in np.unique(groups).tolist() if block.type == "triangle" else []:
            found.setdefault(names[tag, 2], []).append(mesh.points[block.data[groups == tag]])
    return {name: np.concatenate(rows) for name, rows in found.items()}


def read_glb(path: Path) -> dict[str, Corners]:
    """Triangles of each node, or of each material of the node that is no building."""
    document, take = read_document(path)
    found: dict[str, list[Corners]] = {}
    points = take(0).reshape(-1, 3).astype(np.float64)
    assert document["scenes"] == [{"nodes": list(range(len(document["nodes"])))}]
    for node in document["nodes"]:
        mesh = document["meshes"][node["mesh"]]
        assert mesh["name"] == node["name"]
        for primitive in mesh["primitives"]:
            material, name = document["materials"][primitive["material"]]["name"], node["name"]
            if name == "boundary":
                name = material
            else:
                assert name == building_name(node["extras"]["building"])
                assert material == {Marker.WALL: "walls", Marker.ROOF: "roofs"}[primitive["extras"]["marker"]]
            found.setdefault(name, []).append(points[take(primitive["indices"]).reshape(-1, 3)])
    return {name: np.concatenate(rows) for name, rows in found.items()}


READERS: dict[str, Callable[[Path], dict[str, Corners]]] = {
    "stl": read_stl,
    "obj": read_obj,
    "glb": read_glb,
    "msh": read_msh,
    "msh2": read_msh,
    "cgns": read_with_vtk,
}


def sorted_rows(corners: Corners) -> list[list[float]]:
    return sorted(corners.reshape(len(corners), -1).tolist())


@pytest.mark.parametrize("name", PER_PATCH)
def test_each_building_has_its_facets(small_run: Path, exported: dict[str, Path], name: str) -> None:
    found = READERS[name](exported[name])
    expected = corners_of(open_pieces(small_run), by_building=True)
    if name != "cgns":
        del expected["Internal"]
    if name == "glb":
        origin = read_document(exported[name])[0]["asset"]["extras"]["origin"]
        expected = {patch: turned(corners, origin) for patch, corners in expected.items()}
    assert sum(patch.startswith("building_") for patch in found) >= 10
    assert not {"walls", "roofs"} & set(found)
    assert sorted(found) == sorted(expected)
    for patch, corners in expected.items():
        assert sorted_rows(found[patch]) == sorted_rows(corners), patch


@pytest.mark.parametrize("name", PER_PATCH)
def test_the_same_bytes_again(small_run: Path, exported: dict[str, Path], tmp_path: Path, name: str) -> None:
    path = tmp_path / exported[name].name
    export_run(small_run, path, name=name, options={"buildings": "patches"})
    assert path.read_bytes() == exported[name].read_bytes()


def test_numbers_stand_beside_the_facets_in_vtp(small_run: Path, tmp_path: Path) -> None:
    export_run(small_run, tmp_path / "all.vtp", name="vtp")
    piece = read_vtp(tmp_path / "all.vtp")
    expected = corners_of(open_pieces(small_run), by_building=True)
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
def test_gmsh_has_no_complaints(exported: dict[str, Path], name: str) -> None:
    found: dict[str, Any] = check_with_gmsh(exported[name])
    assert found["nodes"] > 0
    assert found["complaints"] == 0


@pytest.mark.long
def test_the_gltf_validator_has_no_complaints(exported: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    report = validate(exported["glb"], monkeypatch)
    assert report["issues"]["messages"] == []
    assert report["info"]["drawCallCount"] > 20


def patch_sizes(case: Path) -> dict[str, int]:
    """Faces by patch, as the file `boundary` says."""
    text = (case / "constant" / "polyMesh" / "boundary").read_text()
    return {name: int(n) for name, n in re.findall(r"(\w+)\s*\{[^}]*nFaces +(\d+);", text)}


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_gmsh_to_foam_has_the_patches_of_our_own_case(
    small_run: Path, exported: dict[str, Path], tmp_path: Path
) -> None:
    case = tmp_path / "case"
    export_run(small_run, case, name="openfoam", options={"buildings": "patches"})
    ours = patch_sizes(case)
    shutil.rmtree(case / "constant")
    run_foam("gmshToFoam", case, str(exported["msh2"]))
    # checkMesh prints long names and numbers without a space between them.
    assert mesh_is_ok(run_foam("checkMesh", case))
    assert sum(name.startswith("building_") for name in ours) >= 10
    assert patch_sizes(case) == ours
