"""Surfaces for viewers and other meshers: closed, marked, every vertex once, read by VTK and meshio."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import CityError
from pipeline.data.mesh import Boundary, Marker
from tests.helpers.hand_pieces import HandPieces, box_pieces
from tests.helpers.patch_readers import (
    READERS,
    assert_same_patches,
    corners_of,
    expected_of,
    open_edges,
    read_stl,
    surface_of,
    volume,
    volume_of_cells,
)
from tests.helpers.vtk_readers import read_vtk
from tests.helpers.vtk_writers import write_vtp
from tests.tiler.export.conftest import Exported
from tiler.export.export import export_run, load_format
from tiler.export.obj_file import write_obj
from tiler.export.surface import VertexSet, open_surface
from tiler.formats.cgns import write_cgns
from tiler.formats.glb import write_glb
from tiler.formats.ply import write_ply
from tiler.formats.stl import write_stl
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.vtk_files import read_vtp

PATCHES = ("--buildings", "patches")
KINDS = [
    (name, words)
    for name in READERS
    for words in ((), PATCHES)
    if "buildings" in load_format(name).options or not words
]
SINGLE = {"glb": 1e-5}  # precision of what does not hold coordinates in full


@pytest.mark.parametrize("city", ["small_run", "sloped_run"])
@pytest.mark.parametrize(("name", "words"), KINDS)
def test_every_facet_is_there_with_its_patch_and_the_surface_is_closed(
    request: pytest.FixtureRequest, exported: Exported, city: str, name: str, words: tuple[str, ...]
) -> None:
    run = request.getfixturevalue(city)
    path, pieces = exported(run, name, *words), open_pieces(run)
    found = READERS[name](path)
    assert_same_patches(found, expected_of(pieces, path, name, by_building=bool(words)))
    assert (sum(patch.startswith("building_") for patch in found) >= 10) == bool(words)
    assert not words or not {"walls", "roofs"} & set(found)
    surface, cells = surface_of(found), corners_of(pieces, lambda *_: "")["Internal"]
    assert open_edges(surface) == 0
    assert open_edges(surface[1:]) == 3
    assert volume(surface) == pytest.approx(volume_of_cells(cells), rel=SINGLE.get(name, 1e-9))


@pytest.mark.parametrize("name", ["stl", "obj", "ply"])
def test_vtk_reads_it(small_run: Path, exported: Exported, name: str) -> None:
    from vtkmodules.vtkFiltersCore import vtkFeatureEdges
    from vtkmodules.vtkIOGeometry import vtkOBJReader, vtkSTLReader
    from vtkmodules.vtkIOPLY import vtkPLYReader

    readers: dict[str, Any] = {"stl": vtkSTLReader, "obj": vtkOBJReader, "ply": vtkPLYReader}
    reader = read_vtk(readers[name](), exported(small_run, name))
    edges = vtkFeatureEdges()
    edges.SetInputConnection(reader.GetOutputPort())
    edges.FeatureEdgesOff()
    edges.NonManifoldEdgesOff()
    edges.Update()
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    assert reader.GetOutput().GetNumberOfCells() == counts["facets"]
    assert edges.GetOutput().GetNumberOfCells() == 0


WRITERS: dict[str, Callable[[Path, HandPieces], object]] = {
    "stl": write_stl,
    "obj": write_obj,
    "ply": write_ply,
    "glb": lambda path, pieces: write_glb(path, pieces, crs="EPSG:28992"),
    "cgns": lambda path, pieces: write_cgns(path, pieces, crs="EPSG:28992", buildings="patches"),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", WRITERS)
def test_pieces_in_any_order_make_the_same_surface(tmp_path: Path, name: str, seed: int) -> None:
    path, pieces = tmp_path / f"box.{name}", box_pieces(seed=seed)
    WRITERS[name](path, pieces)
    found = READERS[name](path)
    assert_same_patches(found, expected_of(pieces, path, name, by_building=name == "cgns"))
    surface = surface_of(found)
    assert open_edges(surface) == 0
    assert volume(surface) == pytest.approx(6 * 4 * 2, rel=SINGLE.get(name, 1e-9))


def test_stl_keeps_what_is_tiny_or_flat(tmp_path: Path) -> None:
    pieces = box_pieces((1, 1), 1)
    part = pieces.read(0)
    points = part.points.copy()
    points[0] = [-1e-120, -3e5, 1e-7]
    facets = np.vstack((part.facets[1:], [[0, 0, 1]])).astype(np.int32)
    write_stl(
        tmp_path / "x.stl", HandPieces(("a",), pieces.n_points, [replace(part, points=points, facets=facets)])
    )
    found = surface_of(read_stl(tmp_path / "x.stl"))
    points[0, 0] = 0.0
    ordered = facets[np.argsort(part.marker, kind="stable")]
    assert np.array_equal(found, points[ordered])


def test_normals_are_those_of_the_facets(small_run: Path, exported: Exported) -> None:
    path = exported(small_run, "stl")
    lines = [line.split() for line in path.read_text().splitlines()]
    normal = np.array([[float(word) for word in words[2:]] for words in lines if words[0] == "facet"])
    corners = surface_of(read_stl(path))
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
