"""The pieces of a run as exporters read them: numbered from 0 on, one place a number, and damage is told."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from stitch.pieces.conformity import pair_cell_faces
from tests.helpers.vtk_writers import write_vtu
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.vtk_files import read_vtp, read_vtu


@pytest.fixture
def copy(small_run: Path, tmp_path: Path) -> Path:
    """The run, to be damaged."""
    return shutil.copytree(small_run, tmp_path / "run", ignore=shutil.ignore_patterns("store.zarr"))


def test_pieces_glued_by_their_numbers_are_the_whole_mesh(small_run: Path) -> None:
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    pieces = open_pieces(small_run)
    xyz = np.full((pieces.n_points, 3), np.nan)
    cells, facets = [], []
    for k, name in enumerate(pieces.names):
        piece = pieces.read(k)
        assert piece.name == name
        known = ~np.isnan(xyz[piece.ids, 0])
        assert (xyz[piece.ids[known]] == piece.points[known]).all()
        assert known.any() == (k > 0)
        xyz[piece.ids] = piece.points
        cells.append(piece.ids[piece.cells])
        facets.append(piece.ids[piece.facets])
        assert (np.isin(piece.marker, (Marker.WALL, Marker.ROOF)) == (piece.building >= 0)).all()
    assert pieces.names == tuple(sorted(pieces.names))
    assert len(pieces.names) == 4
    assert not np.isnan(xyz).any()
    assert len(np.unique(xyz, axis=0)) == len(xyz) == counts["points"]
    assert [sum(map(len, rows)) for rows in (cells, facets)] == [counts["cells"], counts["facets"]]
    # Over the seams the faces pair up, so what is left on one side alone is the boundary.
    exterior = pair_cell_faces(np.concatenate(cells).astype(np.int32), len(xyz)).exterior
    boundary = np.concatenate(facets)
    assert np.array_equal(np.unique(np.sort(exterior), axis=0), np.unique(np.sort(boundary), axis=0))


def test_cells_facets_and_marks_are_those_of_the_files(small_run: Path) -> None:
    pieces = open_pieces(small_run)
    for k, name in enumerate(pieces.names):
        piece, mesh = pieces.read(k), read_vtu(small_run / "mesh" / f"{name}.vtu").mesh
        assert piece.points.tobytes() == mesh.points.tobytes()
        assert piece.cells.tobytes() == mesh.cells.tobytes()
        side = read_vtp(small_run / "boundary" / f"{name}.vtp")
        assert piece.points[piece.facets].tobytes() == side.points[side.boundary.facets].tobytes()
        assert np.array_equal(piece.marker, side.boundary.marker)
        assert np.array_equal(piece.building, side.boundary.building)


def unfinished(out: Path) -> None:
    record = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(record | {"status": "running"}))


def without_piece(out: Path) -> None:
    next((out / "boundary").iterdir()).unlink()


def other_tiles(out: Path) -> None:
    index = out / "boundary.pvtp"
    lines = index.read_text().splitlines(keepends=True)
    lines.remove(next(line for line in lines if "<Piece" in line))
    index.write_text("".join(lines))


def cut(out: Path) -> None:
    first = sorted((out / "mesh").iterdir())[0]
    first.write_bytes(first.read_bytes()[:-999])


def without_numbers(out: Path) -> None:
    first = sorted((out / "mesh").iterdir())[0]
    write_vtu(first, read_vtu(first).mesh)


def beyond(out: Path) -> None:
    first = sorted((out / "mesh").iterdir())[0]
    piece = read_vtu(first)
    write_vtu(first, piece.mesh, point_data={"vertex_id": piece.point_data["vertex_id"] + 10**7})


def boundary_of_another(out: Path) -> None:
    first, second, *_ = sorted((out / "boundary").iterdir())
    shutil.copy(second, first)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (unfinished, "the run is 'running', not 'done'"),
        (without_piece, "is missing"),
        (other_tiles, "name other tiles"),
        (cut, "damaged"),
        (without_numbers, "has no point array vertex_id"),
        (beyond, "different vertex_id, run.json says .* points"),
        (boundary_of_another, "its points are not those of the volume|vertex .* of the volume's"),
    ],
)
def test_what_is_damaged_is_told(copy: Path, damage: Callable[[Path], None], message: str) -> None:
    damage(copy)
    with pytest.raises(InputError, match=message):
        open_pieces(copy).read(0)
