"""Surfaces for viewers and other meshers: closed, marked, every vertex once, read by VTK and meshio."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.errors import CityError
from pipeline.data.mesh import Boundary, Marker
from tests.helpers.hand_pieces import HandPieces, box_pieces
from tests.helpers.vtk_writers import write_vtp
from tiler.cli.main import main
from tiler.export.export import export_run
from tiler.export.foam_patches import PATCHES
from tiler.export.obj_file import write_obj
from tiler.export.surface import VertexSet, open_surface
from tiler.formats.ply import write_ply
from tiler.formats.stl import write_stl
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.vtk_files import read_vtp

FORMATS = ["stl", "obj", "ply"]
NUMBERS = {name: int(marker) for marker, name in PATCHES.items()}


@dataclass(frozen=True, eq=False)
class Facets:
    """A surface as triangles: corners (f, 3, 3), marker (f,), building (f,) where the format has it."""

    corners: NDArray[np.float64]
    marker: NDArray[np.int64]
    building: NDArray[np.int64] | None = None


@pytest.fixture(scope="module")
def exported(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The small city's boundary in all formats."""
    folder = tmp_path_factory.mktemp("surfaces")
    files = {name: folder / f"city.{name}" for name in FORMATS}
    for name, path in files.items():
        assert main(["export", str(small_run), "--format", name, "-o", str(path)]) == 0
    return files


def facets_of(pieces: Any) -> Facets:
    """All facets of a mesh in pieces."""
    parts = [pieces.read(k) for k in range(len(pieces.names))]
    return Facets(
        np.concatenate([part.points[part.facets] for part in parts]),
        np.concatenate([part.marker for part in parts]).astype(np.int64),
        np.concatenate([part.building for part in parts]),
    )


def read_stl(path: Path) -> Facets:
    corners, marker, name = [], [], ""
    for words in map(str.split, path.read_text().splitlines()):
        if words[0] == "solid":
            name = words[1]
        elif words[0] == "endsolid":
            assert words[1] == name
        elif words[0] == "vertex":
            corners.append([float(word) for word in words[1:]])
        elif words[0] == "facet":
            marker.append(NUMBERS[name])
    return Facets(np.array(corners).reshape(-1, 3, 3), np.array(marker))


def read_obj(path: Path) -> Facets:
    points, faces, marker, name = [], [], [], ""
    for words in map(str.split, path.read_text().splitlines()):
        if words[0] == "g":
            name = words[1]
        elif words[0] == "v":
            points.append([float(word) for word in words[1:]])
        elif words[0] == "f":
            faces.append([int(word) - 1 for word in words[1:]])
            marker.append(NUMBERS[name])
    assert sorted({node for face in faces for node in face}) == list(range(len(points)))
    assert len(set(map(tuple, points))) == len(points)
    return Facets(np.array(points)[np.array(faces)], np.array(marker))


def read_ply(path: Path) -> Facets:
    """Read it as its header says; meshio takes no file with lists and numbers in one element."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    kinds = {"double": "<f8", "int": "<i4", "uchar": "u1"}
    elements: dict[str, tuple[int, list[Any]]] = {}
    for words in map(str.split, head.decode().splitlines()):
        if words[0] == "element":
            fields: list[Any] = []
            elements[words[1]] = int(words[2]), fields
        elif words[:2] == ["property", "list"]:
            fields += [("n", kinds[words[2]]), (words[4], kinds[words[3]], 3)]
        elif words[0] == "property":
            fields.append((words[2], kinds[words[1]]))
    points, faces = (np.dtype(elements[name][1]) for name in ("vertex", "face"))
    n = elements["vertex"][0]
    vertex = np.frombuffer(body, points, n)
    face = np.frombuffer(body[n * points.itemsize :], faces)
    assert len(face) == elements["face"][0]
    assert (face["n"] == 3).all()
    xyz = np.column_stack([vertex[axis] for axis in "xyz"])
    assert np.array_equal(np.unique(face["vertex_indices"]), np.arange(n))
    assert len(np.unique(xyz, axis=0)) == n
    return Facets(xyz[face["vertex_indices"]], face["marker"].astype(np.int64), face["building"].astype(np.int64))


READERS: dict[str, Callable[[Path], Facets]] = {"stl": read_stl, "obj": read_obj, "ply": read_ply}


def rows_of(facets: Facets, *, building: bool) -> list[tuple[float, ...]]:
    """Facets in an order of their own, each turned so that its least corner is first."""
    rows = []
    marks = facets.building if building else np.zeros(len(facets.marker))
    assert marks is not None
    for corners, *mark in zip(facets.corners.tolist(), facets.marker.tolist(), marks.tolist(), strict=True):
        first = corners.index(min(corners))
        rows.append((*mark, *corners[first], *corners[first - 2], *corners[first - 1]))
    return sorted(rows)


def open_edges(facets: Facets) -> int:
    """Count directed edges that the other direction does not answer as often."""
    _, corner = np.unique(facets.corners.reshape(-1, 3), axis=0, return_inverse=True)
    node = corner.reshape(-1, 3)
    edges = np.concatenate([node[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    turned = edges[:, 0] > edges[:, 1]
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    return int(np.count_nonzero(np.bincount(edge.ravel(), np.where(turned, -1, 1))))


def volume(facets: Facets) -> float:
    a, b, c = np.moveaxis(facets.corners - facets.corners.reshape(-1, 3).mean(axis=0), 1, 0)
    return float(np.einsum("ij,ij->", np.cross(a, b), c)) / 6


@pytest.mark.parametrize("name", FORMATS)
def test_every_facet_is_there_with_its_patch(small_run: Path, exported: dict[str, Path], name: str) -> None:
    found, expected = READERS[name](exported[name]), facets_of(open_pieces(small_run))
    assert rows_of(found, building=name == "ply") == rows_of(expected, building=name == "ply")


@pytest.mark.parametrize("name", FORMATS)
def test_the_boundary_is_closed_and_points_out(small_run: Path, exported: dict[str, Path], name: str) -> None:
    found, pieces = READERS[name](exported[name]), open_pieces(small_run)
    cells = 0.0
    for part in map(pieces.read, range(len(pieces.names))):
        a, b, c, d = np.moveaxis(part.points[part.cells], 1, 0)
        cells += float(np.einsum("ij,ij->", np.cross(b - a, c - a), d - a)) / 6
    assert open_edges(found) == 0
    assert volume(found) == pytest.approx(cells, rel=1e-9)
    assert open_edges(Facets(found.corners[1:], found.marker[1:])) == 3


@pytest.mark.parametrize("name", FORMATS)
def test_export_is_the_same_bytes_again(
    small_run: Path, exported: dict[str, Path], tmp_path: Path, name: str
) -> None:
    path = tmp_path / f"again.{name}"
    export_run(small_run, path, name=name)
    assert path.read_bytes() == exported[name].read_bytes()
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", FORMATS)
def test_other_suffixes_are_refused(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert main(["export", str(small_run), "--format", name, "-o", str(tmp_path / "x.vtu")]) == 2
    assert f"x.vtu: a file of format {name} ends with .{name}; give another --output" in capsys.readouterr().err


@pytest.mark.parametrize("name", FORMATS)
def test_vtk_reads_it(small_run: Path, exported: dict[str, Path], name: str) -> None:
    from vtkmodules.vtkFiltersCore import vtkFeatureEdges
    from vtkmodules.vtkIOGeometry import vtkOBJReader, vtkSTLReader
    from vtkmodules.vtkIOPLY import vtkPLYReader

    readers: dict[str, Any] = {"stl": vtkSTLReader, "obj": vtkOBJReader, "ply": vtkPLYReader}
    reader = readers[name]()
    reader.SetFileName(str(exported[name]))
    edges = vtkFeatureEdges()
    edges.SetInputConnection(reader.GetOutputPort())
    edges.FeatureEdgesOff()
    edges.NonManifoldEdgesOff()
    edges.Update()
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    assert reader.GetOutput().GetNumberOfCells() == counts["facets"]
    assert edges.GetOutput().GetNumberOfCells() == 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", FORMATS)
def test_pieces_in_any_order_make_the_same_surface(tmp_path: Path, name: str, seed: int) -> None:
    write = {"stl": write_stl, "obj": write_obj, "ply": write_ply}[name]
    pieces = box_pieces(seed=seed)
    write(tmp_path / f"box.{name}", pieces)
    found = READERS[name](tmp_path / f"box.{name}")
    assert rows_of(found, building=name == "ply") == rows_of(facets_of(pieces), building=name == "ply")
    assert open_edges(found) == 0
    assert volume(found) == pytest.approx(6 * 4 * 2)


def test_stl_keeps_what_is_tiny_or_flat(tmp_path: Path) -> None:
    pieces = box_pieces((1, 1), 1)
    part = pieces.read(0)
    points = part.points.copy()
    points[0] = [-1e-120, -3e5, 1e-7]
    facets = np.vstack((part.facets[1:], [[0, 0, 1]])).astype(np.int32)
    write_stl(
        tmp_path / "x.stl", HandPieces(("a",), pieces.n_points, [replace(part, points=points, facets=facets)])
    )
    found = read_stl(tmp_path / "x.stl")
    points[0, 0] = 0.0
    ordered = facets[np.argsort(part.marker, kind="stable")]
    assert np.array_equal(found.corners, points[ordered])


def test_normals_are_those_of_the_facets(exported: dict[str, Path]) -> None:
    lines = [line.split() for line in exported["stl"].read_text().splitlines()]
    normal = np.array([[float(word) for word in words[2:]] for words in lines if words[0] == "facet"])
    corners = read_stl(exported["stl"]).corners
    computed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    computed /= np.linalg.norm(computed, axis=1, keepdims=True)
    assert np.abs(normal - computed).max() < 1e-6


def test_places_are_ranks() -> None:
    rng = np.random.default_rng(0)
    ids = np.unique(rng.integers(0, 1000, 300))
    vertices = VertexSet(1000)
    for part in np.array_split(rng.permutation(np.concatenate((ids, ids[:50]))), 4):
        vertices.add(part)
    assert vertices.count() == len(ids)
    assert np.array_equal(vertices.places(ids), np.arange(len(ids)))


def test_an_unknown_marker_is_told(small_run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(small_run, tmp_path / "run", ignore=shutil.ignore_patterns("store.zarr"))
    path = sorted((copy / "boundary").glob("*.vtp"))[0]
    piece = read_vtp(path)
    marks = piece.boundary.marker.copy()
    marks[0] = max(Marker) + 1
    write_vtp(
        path,
        piece.points,
        Boundary(piece.boundary.facets, marks, piece.boundary.building),
        point_data=piece.point_data,
    )
    with pytest.raises(CityError, match=r"markers 1\.\.13, known are 1\.\.12; run the tile again"):
        export_run(copy, tmp_path / "x.ply", name="ply")
    assert not (tmp_path / "x.ply").exists()


def test_the_surface_of_a_run_is_that_of_its_cells(small_run: Path) -> None:
    surface, pieces = open_surface(small_run), open_pieces(small_run)
    for k in range(len(surface.names)):
        one, other = surface.read(k), pieces.read(k)
        assert np.array_equal(one.ids[one.facets], other.ids[other.facets])
