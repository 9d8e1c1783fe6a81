"""`citystitch check`: prove from the written files that a run's mesh is right."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.mesh import Boundary, TetMesh
from stitch import conformity
from tiler import city_proofs, proofs
from tiler.proofs import Dtm, Fault, Proof, Surface
from tiler.run_folder import read_buildings, read_run_record, read_volume
from tiler.vtk_files import BoundaryPiece, read_piece_paths, read_vtp

RUN_RECORD = "run.json"
STORE = "store.zarr"
CITY_MODEL = "citymodel.city.json"
VOLUME_INDEX = "mesh.pvtu"
BOUNDARY_INDEX = "boundary.pvtp"


@dataclass(frozen=True)
class CheckReport:
    """What was proved of a run folder.

    Attributes
    ----------
    directory : Path
        The folder.
    proofs : tuple of Proof
        All claims, in a fixed order, with the faults of each.
    facts : mapping of str to float
        Numbers read on the way: ``cells``, ``points``, ``facets``, ``buildings``, ``non_manifold_edges``,
        ``volume`` and ``smallest_cell`` (m³).
    """

    directory: Path
    proofs: tuple[Proof, ...]
    facts: Mapping[str, float]

    @property
    def faults(self) -> tuple[Fault, ...]:
        """All faults."""
        return tuple(fault for proof in self.proofs for fault in proof.faults)

    @property
    def ok(self) -> bool:
        """Whether every claim is proved."""
        return not self.faults

    def lines(self) -> list[str]:
        """Return the report as text: one line a claim, and one below it for each of its faults."""
        lines = []
        for proof in self.proofs:
            lines.append(f"{'FAULT' if proof.faults else 'ok   '} {proof.claim}")
            lines += [f"      {_tell(fault)}" for fault in proof.faults]
        n = len({fault.kind for fault in self.faults})
        verdict = "everything is proved" if self.ok else f"{n} {'kind' if n == 1 else 'kinds'} of fault"
        return [*lines, f"{self.directory}: {verdict}"]


@dataclass(frozen=True, eq=False)
class _Piece:
    """What the proofs need of one tile once its cells are let go."""

    n_cells: int
    n_hidden: int  # points inside the piece
    volume: float
    smallest: float
    exterior: NDArray[np.float64]  # (k, 3, 3): the vertices of the exterior faces
    boundary: BoundaryPiece
    faults: list[Fault]


def check_run(directory: Path, load_dtm: Callable[[Path], Dtm]) -> CheckReport:
    """Prove that the mesh in a run folder is conforming, watertight, and that of its city model and DTM.

    Parameters
    ----------
    directory : Path
        The folder of a run.
    load_dtm : callable
        Given the path of the store, returns the terrain, which has ``sample(xy (n, 2)) -> z (n,)``.

    Returns
    -------
    CheckReport
        Claims and faults.

    Raises
    ------
    InputError
        If a file is missing or damaged.

    Notes
    -----
    Pieces are read one after the other: memory holds the cells of one piece, and the boundaries of all.
    """
    record = read_run_record(directory / RUN_RECORD)
    buildings = read_buildings(directory / CITY_MODEL)
    pieces = [_read_piece(volume, boundary) for volume, boundary in _pair_pieces(directory)]
    surface, exterior = _merge(pieces)
    pairs = conformity.pair_faces(exterior)
    dtm = load_dtm(directory / STORE)
    closed, n_non_manifold = proofs.prove_closed(surface)
    volume = sum(piece.volume for piece in pieces)
    counts = {
        "cells": sum(piece.n_cells for piece in pieces),
        "points": sum(piece.n_hidden for piece in pieces) + len(np.unique(exterior)),
        "facets": len(surface.boundary.facets),
        "buildings": len(buildings),
    }
    facts = counts | {
        "non_manifold_edges": n_non_manifold,
        "volume": volume,
        "smallest_cell": min(piece.smallest for piece in pieces),
    }
    found = [
        _prove_cells(pieces, proofs.find_face_faults(surface.points, pairs), facts),
        proofs.prove_same_boundary(surface, pairs.exterior),
        closed,
        city_proofs.prove_marks(surface, buildings),
        proofs.prove_box(surface, record.bounds),
        proofs.prove_top(surface, record.top),
        proofs.prove_ground(surface, dtm),
        city_proofs.prove_roofs(surface, buildings),
        city_proofs.prove_walls(surface, buildings),
        city_proofs.prove_buildings(surface, buildings, record.bounds),
        proofs.prove_plan(surface, record.bounds),
        proofs.prove_volume(surface, volume),
        proofs.prove_record(record, counts),
    ]
    return CheckReport(directory, tuple(found), facts)


def _tell(fault: Fault) -> str:
    places = "; ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in fault.places)
    return f"{fault.kind}: {fault.count}, {fault.detail}" + (f", at {places}" if places else "")


def _pair_pieces(directory: Path) -> list[tuple[Path, Path]]:
    """Return the volume and boundary file of every piece: they have one name."""
    volumes = {path.stem: path for path in read_piece_paths(directory / VOLUME_INDEX)}
    boundaries = {path.stem: path for path in read_piece_paths(directory / BOUNDARY_INDEX)}
    alone = sorted(volumes.keys() ^ boundaries.keys())
    if alone:
        names = f"{VOLUME_INDEX} and {BOUNDARY_INDEX}"
        raise InputError(f"{directory}: only one of {names} names the piece {alone[0]!r}; run again")
    return [(path, boundaries[name]) for name, path in volumes.items()]


def _read_piece(volume_path: Path, boundary_path: Path) -> _Piece:
    mesh, boundary = read_volume(volume_path), read_vtp(boundary_path)
    pairs = conformity.pair_cell_faces(mesh.cells, len(mesh.points))
    volumes, flat = conformity.compute_cell_volumes(mesh.points, mesh.cells)
    faults = [
        *proofs.find_face_faults(mesh.points, pairs),
        *proofs.find_cell_faults(mesh, volumes, flat),
        *_find_link_faults(mesh, boundary),
    ]
    return _Piece(
        n_cells=len(mesh.cells),
        n_hidden=len(mesh.points) - len(np.unique(pairs.exterior)),
        volume=float(volumes.sum()),
        smallest=float(volumes.min(initial=np.inf)),
        exterior=mesh.points[pairs.exterior],
        boundary=boundary,
        faults=faults,
    )


def _find_link_faults(mesh: TetMesh, piece: BoundaryPiece) -> list[Fault]:
    """Find boundary points whose `vertex` is not the volume's point in the same place, or that repeat."""
    known = (piece.vertex >= 0) & (piece.vertex < len(mesh.points))
    linked = known.copy()
    linked[known] = np.all(mesh.points[piece.vertex[known]] == piece.points[known], axis=1)
    unused = conformity.find_unused_points(piece.boundary.facets, len(piece.points))
    duplicate = conformity.find_duplicate_points(piece.points)
    return [
        *proofs.find_faults("vertex-link", piece.points[~linked], "`vertex` is another point of the volume"),
        *proofs.find_faults("vertex-unused", piece.points[unused], "no facet uses it"),
        *proofs.find_faults("vertex-duplicate", piece.points[duplicate], "a boundary vertex is there twice"),
    ]


def _merge(pieces: list[_Piece]) -> tuple[Surface, NDArray[np.int32]]:
    """Join the pieces where coordinates are equal: the surface, and all exterior faces on its points."""
    files = [piece.boundary for piece in pieces]
    faces = np.concatenate([piece.exterior for piece in pieces])
    corners = np.concatenate([file.points[file.boundary.facets] for file in files])
    rows = np.concatenate([faces, corners]).reshape(-1, 3)
    group, n_groups = conformity.group_rows(rows)
    points = np.empty((n_groups, 3))
    points[group] = rows
    index = group.astype(np.int32).reshape(-1, 3)
    marker = np.concatenate([file.boundary.marker for file in files])
    building = np.concatenate([file.boundary.building for file in files])
    boundary = Boundary(index[len(faces) :], marker, building)
    return proofs.make_surface(points, boundary), index[: len(faces)]


def _prove_cells(pieces: list[_Piece], seams: list[Fault], facts: Mapping[str, float]) -> Proof:
    faults = [fault for piece in pieces for fault in piece.faults]
    claim = (
        f"{facts['cells']} cells in {len(pieces)} pieces: every face in one or two of them,"
        f" none inverted or flat (smallest {facts['smallest_cell']:.3g} m³), no vertex unused or duplicate"
    )
    return Proof(claim, proofs.merge_faults([*faults, *seams]))
