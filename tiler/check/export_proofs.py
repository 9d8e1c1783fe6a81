"""`citystitch check DIR --export FILE`: prove an exported mesh of prisms, or of any cells, against its run.

Cells become their faces, so prisms, pyramids, tetrahedra and OpenFOAM's polyhedra are one thing.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError
from stitch.pieces import conformity
from tiler.check.check import CheckReport
from tiler.check.proofs import RELATIVE_TOLERANCE, SIDE_TOLERANCE, Fault, Proof, Vertices, find_faults
from tiler.export.export import EXPORT_RECORD
from tiler.export.foam_files import POLY_MESH, read_foam_faces, read_foam_list
from tiler.export.region_faces import find_outer
from tiler.formats.cgns import read_cgns
from tiler.formats.xdmf import read_xdmf
from tiler.mesh_files.air import open_air
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.prisms import list_faces
from tiler.mesh_files.transitions import NO_CORNER, turn_over

Ints = NDArray[np.int64]
SHAPES = {"prisms": 53, "pyramids": 51, "tetrahedra": 40}  # faces, and those of four corners
MIRRORED = [0, 2, 1, 3, 5, 4]
Cells = tuple[NDArray[np.float64], list[tuple[int, Ints]]]  # points, and corners of cells with so many
WIDTHS = {"wedge": 6, "pyramid": 5, "tetra": 4}


@dataclass(frozen=True, eq=False)
class Polyhedra:
    """Cells by their faces."""

    points: Vertices  #: (n, 3): points by their numbers (m)
    #: (k, 4): faces of each cell, counter-clockwise from outside; the last corner of a triangle is `NO_CORNER`
    faces: Ints
    cell: Ints  #: (k,): the cell of each


def check_export(directory: Path, path: Path) -> CheckReport:
    """Prove that an exported mesh fills what the mesh of its run fills.

    Parameters
    ----------
    path : Path
        A VTU, MSH, XDMF or CGNS file, or a case folder of OpenFOAM, whole or decomposed.

    Raises
    ------
    ConfigError
        If it is none of these.
    InputError
        If a file is missing or damaged.

    Notes
    -----
    Memory: the whole exported mesh, some 1,500 bytes a cell.
    """
    mesh = _read(path)
    pieces = open_pieces(directory)
    if (record := path / EXPORT_RECORD).is_file() and "regions" in json.loads(record.read_text()):
        pieces = open_air(pieces)
    n = pieces.n_points
    own, facets, volume = np.full((n, 3), np.nan), [], 0.0
    for k in range(len(pieces.names)):
        piece = pieces.read(k)
        own[piece.ids] = piece.points
        facets.append(piece.ids[piece.facets[find_outer(piece)]])
        volume += float(conformity.compute_cell_volumes(piece.points, piece.cells)[0].sum())
    if len(mesh.points) < n:
        raise InputError(
            f"{path}: has {len(mesh.points)} points, the mesh of {directory} has {n}; is it of this run?"
        )
    origin = np.round(own[0] - mesh.points[0])
    proofs, filled = _prove_cells(mesh)
    claims = (
        *proofs,
        _prove_points(mesh, own, origin),
        *_prove_faces(mesh, np.concatenate(facets)),
        _prove_volume(filled, volume),
    )
    facts = {"cells": float(mesh.cell.max(initial=-1) + 1), "volume": filled}
    return CheckReport(path, claims, facts)


def _read(path: Path) -> Polyhedra:
    parts = sorted(path.glob("processor*"), key=lambda part: int(part.name.removeprefix("processor")))
    if parts or (path / POLY_MESH).is_dir():
        return _join([_read_foam(part / POLY_MESH) for part in parts or [path]])
    readers = {".vtu": _read_meshio, ".msh": _read_meshio, ".xdmf": read_xdmf, ".cgns": read_cgns}
    if path.suffix not in readers:
        kinds = ", ".join(readers)
        raise ConfigError(f"--export {path}: must be a file {kinds}, or a case folder of OpenFOAM")
    try:
        points, rows = readers[path.suffix](path)
    except (SystemExit, ValueError, KeyError, OSError, EOFError, meshio.ReadError) as error:
        raise InputError(f"{path}: cannot be read ({error}); export it again") from None
    cells = np.full((sum(len(some) for _, some in rows), 6), NO_CORNER)
    first = 0
    for width, some in rows:
        cells[first : first + len(some), :width] = some
        first += len(some)
    return _checked(path, Polyhedra(np.asarray(points, np.float64), *list_faces(cells)))


def _read_meshio(path: Path) -> Cells:
    mesh = meshio.read(path)
    rows = [(width, mesh.cells_dict[kind]) for kind, width in WIDTHS.items() if kind in mesh.cells_dict]
    if path.suffix == ".vtu":  # meshio turns VTK's wedges over, as VTK's page of them asks, but not VTK's measures
        rows = [(width, some[:, MIRRORED] if width == 6 else some) for width, some in rows]
    return mesh.points, rows


def _read_foam(folder: Path) -> Polyhedra:
    """Read one polyMesh, with the numbers of the whole mesh if it is a part of one."""
    points, faces = read_foam_list(folder / "points", 3), read_foam_faces(folder / "faces")
    owner, neighbour = (read_foam_list(folder / name, 1)[:, 0] for name in ("owner", "neighbour"))
    inner = faces[: len(neighbour)]
    mesh = Polyhedra(points, np.concatenate((faces, turn_over(inner))), np.concatenate((owner, neighbour)))
    mesh = _checked(folder, mesh)
    if not (number := folder / "pointProcAddressing").exists():
        return mesh
    numbers = read_foam_list(number, 1)[:, 0]
    of_all = np.full((int(numbers.max()) + 1, 3), np.nan)
    of_all[numbers] = points
    return Polyhedra(of_all, np.where(mesh.faces == NO_CORNER, NO_CORNER, numbers[mesh.faces]), mesh.cell)


def _checked(path: Path, mesh: Polyhedra) -> Polyhedra:
    if len(mesh.faces) != len(mesh.cell) or not len(mesh.faces):
        raise InputError(f"{path}: {len(mesh.faces)} faces, of {len(mesh.cell)} of which the cell is known")
    if mesh.faces.max() >= len(mesh.points) or mesh.faces.min() < NO_CORNER:
        raise InputError(f"{path}: a corner that is not among its {len(mesh.points)} points; export it again")
    return mesh


def _join(parts: list[Polyhedra]) -> Polyhedra:
    points = np.full((max(len(part.points) for part in parts), 3), np.nan)
    cells, first = [], 0
    for part in parts:
        known = ~np.isnan(part.points[:, 0])
        points[: len(known)][known] = part.points[known]
        cells.append(part.cell + first)
        first += int(part.cell.max()) + 1
    return Polyhedra(points, np.concatenate([part.faces for part in parts]), np.concatenate(cells))


def _prove_cells(mesh: Polyhedra) -> tuple[tuple[Proof, Proof], float]:
    """Prove that cells are positive at all corners and quadrilaterals upright; gives the volume, too."""
    points, faces, cell = mesh.points, mesh.faces, mesh.cell
    n = int(cell.max()) + 1
    quad = faces[:, 3] != NO_CORNER
    used = np.unique((cell[:, None] * len(points) + faces)[faces != NO_CORNER])
    of, point = used // len(points), used % len(points)
    centre: Vertices = np.stack(
        [np.bincount(of, points[point, k], n).astype(np.float64) for k in range(3)], axis=1
    )
    centre = centre / np.bincount(of, minlength=n)[:, None]

    def seen(rows: Ints, places: tuple[int, int, int]) -> NDArray[np.float64]:
        """Six times the volumes between triangles of faces and the middles of their cells."""
        a, b, c = (points[faces[rows, place]] - centre[cell[rows]] for place in places)
        return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)))

    triangles, quads = np.flatnonzero(~quad), np.flatnonzero(quad)
    flat = seen(triangles, (0, 1, 2))
    corners = np.stack([seen(quads, (k, (k + 1) % 4, (k + 2) % 4)) for k in range(4)], axis=1)
    wrong = np.concatenate((triangles[~(flat > 0)], quads[~(corners > 0).all(axis=1)]))
    volume = float(flat.sum() + corners[:, [0, 2]].sum()) / 6
    plan = points[faces[quads]][:, :, :2]
    edges = np.linalg.norm(np.roll(plan, -1, axis=1) - plan, axis=2) <= SIDE_TOLERANCE
    upright = (edges[:, [0, 2]]).all(axis=1) | (edges[:, [1, 3]]).all(axis=1)
    shape = 10 * np.bincount(cell, minlength=n) + np.bincount(cell[quads], minlength=n)
    kinds = {name: int((shape == value).sum()) for name, value in SHAPES.items()}
    kinds["polyhedra"] = n - sum(kinds.values())
    words = ", ".join(f"{count:,} {name}" for name, count in kinds.items() if count)
    inverted = np.unique(cell[wrong])
    return (
        Proof(
            f"{n:,} cells ({words}): positive at all corners",
            tuple(find_faults("cell-inverted", centre[inverted], "a corner of a face looks inwards or is flat")),
        ),
        Proof(
            f"{len(quads):,} sides of four corners: upright, so planar",
            tuple(
                find_faults("side-not-upright", _middles(mesh, quads[~upright]), f"bound: {SIDE_TOLERANCE:g} m")
            ),
        ),
    ), volume


def _middles(mesh: Polyhedra, rows: Ints) -> Vertices:
    middles: Vertices = mesh.points[mesh.faces[rows, :3]].mean(axis=1)
    return middles


def _prove_points(mesh: Polyhedra, own: Vertices, origin: Vertices) -> Proof:
    """Prove that points are those of the run, less a whole origin, and the others are used."""
    same = (mesh.points[: len(own)] == own - origin).all(axis=1)
    unused = conformity.find_unused_points(
        np.where(mesh.faces < 0, mesh.faces[:, :1], mesh.faces), len(mesh.points)
    )
    more = len(mesh.points) - len(own)
    return Proof(
        f"{len(own):,} points: those of the run, "
        + (f"less {', '.join(f'{part:.0f}' for part in origin)} m, " if origin.any() else "")
        + "bit for bit"
        + (f", and {more:,} in the middle of cells" if more else ""),
        (
            *find_faults("point-moved", own[~same], "another place than in the run"),
            *find_faults("point-unused", mesh.points[unused], "no cell uses it"),
        ),
    )


def _prove_faces(mesh: Polyhedra, facets: Ints) -> tuple[Proof, Proof]:
    """Prove that faces are of two cells, one from each side, or cover the facets of the boundary."""
    group, n = conformity.group_rows(np.sort(mesh.faces, axis=1))
    count = np.bincount(group, minlength=n)
    order = np.argsort(group, kind="stable")
    pairs = order[count[group[order]] == 2].reshape(-1, 2)
    one, two = mesh.faces[pairs[:, 0]], mesh.faces[pairs[:, 1]]
    wide = one[:, 3] != NO_CORNER
    back = np.where(wide[:, None], two[:, ::-1], two[:, [2, 1, 0, 3]])
    same = (_begin(one) == _begin(back)).all(axis=1)
    crowded = np.flatnonzero(count[group] > 2)
    inner = Proof(
        f"{len(pairs):,} faces between two cells: the same from both sides",
        (
            *find_faults("face-same-side", _middles(mesh, pairs[~same, 0]), "both cells are on one side of it"),
            *find_faults("face-shared", _middles(mesh, crowded), "more than 2 cells"),
        ),
    )
    outer = np.flatnonzero(count[group] == 1)
    return inner, Proof(
        f"{len(outer):,} faces of one cell: the {len(facets):,} facets of the boundary of the run, and no others",
        tuple(_find_uncovered(mesh, outer, facets)),
    )


def _begin(faces: Ints) -> Ints:
    """Turn faces so that they begin with their least corner."""
    width = np.where(faces[:, 3:] != NO_CORNER, 4, 3)
    least = np.where(faces == NO_CORNER, np.iinfo(np.int64).max, faces).argmin(axis=1)[:, None]
    places = np.where(np.arange(4) < width, (np.arange(4) + least) % width, 3)
    return np.take_along_axis(faces, places, axis=1)


def _find_uncovered(mesh: Polyhedra, outer: Ints, facets: Ints) -> list[Fault]:
    """Find faces of one cell that are no facet, nor two facets that fill a quadrilateral; and facets left over."""
    faces = mesh.faces[outer]
    wide = faces[:, 3] != NO_CORNER
    rows = np.concatenate((np.flatnonzero(~wide), np.repeat(np.flatnonzero(wide), 4)))
    parts = [np.roll(faces[wide], -k, axis=1)[:, :3] for k in range(4)]
    triangles = np.concatenate((faces[~wide, :3], np.stack(parts, axis=1).reshape(-1, 3)))
    both = np.pad(np.concatenate((triangles, facets)), ((0, 0), (0, 1)), constant_values=NO_CORNER)
    group, n = conformity.group_rows(_begin(both))
    known = np.bincount(group[len(triangles) :], minlength=n)
    halves = np.bincount(rows, known[group[: len(triangles)]] == 1, len(faces))
    met = np.bincount(group[: len(triangles)], minlength=n)
    wrong = outer[halves != np.where(wide, 2, 1)]
    left = facets[met[group[len(triangles) :]] == 0]
    return [
        *find_faults("face-open", _middles(mesh, wrong), "a face of one cell that is not on the boundary"),
        *find_faults("facet-missing", mesh.points[left].mean(axis=1), "no cell has this facet of the run"),
    ]


def _prove_volume(filled: float, volume: float) -> Proof:
    fault = Fault("volume", 1, (), f"{filled:.9g} m³, that of the run's tetrahedra is {volume:.9g} m³")
    right = abs(filled - volume) <= RELATIVE_TOLERANCE * volume
    return Proof(f"volume: {filled:,.3f} m³, as of the run's tetrahedra", () if right else (fault,))
