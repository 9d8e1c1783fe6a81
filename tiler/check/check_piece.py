"""One piece of a run folder, read for `citystitch check`: its boundary, its rim, and what its cells say."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Boundary, Marker, Region, TetMesh
from stitch.pieces import conformity
from stitch.pieces.frontier import Rim, find_border, find_edges_below, find_outline, find_points_over
from tiler.check import proofs
from tiler.check.cover_proofs import DensityAt, check_leaves
from tiler.check.proofs import Bounds, Fault, Finding, Mask, Surface, Vertices
from tiler.check.soil_proofs import check_between
from tiler.mesh_files.mesh_pieces import read_leaves, read_regions
from tiler.mesh_files.vtk_files import BoundaryPiece, read_vtp, read_vtu
from tiler.mesh_files.vtk_xml import damaged
from tiler.store.run_folder import PATCH_OF_GROUND, ROOF_MOVED

# Kinds of points over the rim, each counted once: any, of the ground, of the top.
ANY, GROUND, TOP = range(3)


@dataclass(frozen=True, eq=False)
class Piece:
    """What the proofs need of one piece once its cells are let go.

    Attributes
    ----------
    n_cells, n_points : int
        Cells, and points that are not over the rim.
    air, soil, smallest : float
        Volume of all cells of air, of all cells of soil, and of the smallest (m³).
    surface : Surface
        Its boundary file, on the distinct vertices of this and of the exterior faces.
    part_cells, part_soil : int64, bool, (p,)
        Cells of each part, air or soil, that hang together by faces, and whether it is soil.
    outline : float64, (k, 2, 2)
        Edges of its plan.
    rim : Rim
        What it has over those of them that are not on the region's border.
    on_rim : bool, (n,)
        Which of the surface's points are over the rim.
    same_boundary, ground, closed : Finding
        What the piece alone says of these claims; of the ground only with soil below it.
    crowded : float64, (c, 2, 3)
        Boundary edges of more than two facets, paired, not over the rim.
    leaves : Finding
        What it alone says of the leaves in its cells.
    faults : tuple of Fault
        Of its cells.
    patch : int8, (k,), or None
        Patch of the ground of each facet of the surface; None where the file tells of none.
    """

    n_cells: int
    n_points: int
    air: float
    soil: float
    smallest: float
    surface: Surface
    part_cells: NDArray[np.int64]
    part_soil: Mask
    outline: Vertices
    rim: Rim
    on_rim: Mask
    same_boundary: Finding
    ground: Finding
    closed: Finding
    crowded: Vertices
    leaves: Finding
    faults: tuple[Fault, ...]
    patch: NDArray[np.int8] | None


@dataclass(frozen=True, eq=False)
class _Cells:
    """What is kept of the cells of a piece.

    Attributes
    ----------
    n_cells : int
        How many they are.
    points : float64, (n, 3)
        Points of the volume (m).
    air, soil, smallest : float
        As of `Piece`.
    exterior : int32, (k, 3)
        Faces of one cell, as rows of the points.
    between : int32, (g, 3)
        Faces between air and soil, as the air has them.
    of_soil : bool, (k,)
        Which exterior faces are the soil's.
    part : int64, (k,)
        Part of the mesh behind each exterior face.
    part_cells, part_soil
        As of `Piece`.
    leaves : Finding
        What was found of leaves.
    faults : tuple of Fault
        Of cells and faces.
    """

    n_cells: int
    points: Vertices
    air: float
    soil: float
    smallest: float
    exterior: NDArray[np.int32]
    between: NDArray[np.int32]
    of_soil: Mask
    part: NDArray[np.int64]
    part_cells: NDArray[np.int64]
    part_soil: Mask
    leaves: Finding
    faults: tuple[Fault, ...]


def read_piece(
    volume_path: Path,
    boundary_path: Path,
    bounds: Bounds,
    *,
    soil: bool = False,
    density_at: DensityAt | None = None,
) -> Piece:
    """Read the two files of a piece of the region with these bounds (m), each once.

    Parameters
    ----------
    volume_path, boundary_path : Path
        The files.
    bounds : (west, south, east, north)
        Bounds of the region (m).
    soil : bool
        Whether the mesh has soil.
    density_at : callable, optional
        Gives the leaf area density of places, where the mesh has trees.

    Raises
    ------
    InputError
        If one is missing or damaged.
    """
    cells = _survey_cells(volume_path, soil=soil, density_at=density_at)
    file = read_vtp(boundary_path)
    surface, rows = _join(cells.points, np.concatenate((cells.exterior, cells.between)), file)
    faces, between = rows[: len(cells.exterior)], rows[len(cells.exterior) :]
    # Faces of cells whose vertices are there twice meet where coordinates are equal.
    joined = conformity.pair_faces(faces)
    exterior = joined.exterior
    # With soil below it, the ground is no boundary.
    inside = surface.marked(Marker.GROUND) & soil
    facets, ground = surface.boundary.facets[~inside], surface.boundary.facets[inside]
    match = conformity.match_facets(exterior, facets)
    known = np.ones(len(exterior), np.bool_)
    known[match.missing] = False
    of_air = known.copy()
    if soil:
        of_soil = np.ones(len(exterior), np.bool_)
        of_soil[conformity.match_facets(faces[cells.of_soil], exterior).extra] = False
        of_air &= ~of_soil
    outline = find_outline(surface.points, _facing_up(surface.points, exterior[of_air]))
    edges = outline[~find_border(outline, bounds, tolerance=proofs.SIDE_TOLERANCE)]
    on_rim = find_points_over(surface.points, edges)
    over = np.all(on_rim[exterior], axis=1)
    over[over] = find_edges_below(surface.points[exterior[over]], edges) >= 0
    behind = (exterior[over], cells.part[joined.row[over]])
    rim = _find_rim(surface, facets, edges, behind, known=known[over], faces=faces, on_rim=on_rim)
    open_edges, crowded = _pair_edges(surface.points, facets, on_rim)
    inner = len(cells.points) - int(conformity.find_used_points(cells.exterior, len(cells.points)).sum())
    return Piece(
        n_cells=cells.n_cells,
        n_points=inner + int((conformity.find_used_points(faces, len(on_rim)) & ~on_rim).sum()),
        air=cells.air,
        soil=cells.soil,
        smallest=cells.smallest,
        surface=surface,
        part_cells=cells.part_cells,
        part_soil=cells.part_soil,
        outline=outline,
        rim=rim,
        on_rim=on_rim,
        same_boundary=proofs.check_same_boundary(surface.points, facets, exterior, match, over),
        ground=check_between(surface.points, ground, between) if soil else Finding(),
        closed=proofs.check_closed(open_edges, crowded),
        crowded=crowded,
        leaves=cells.leaves,
        faults=proofs.merge_faults(
            [
                *cells.faults,
                *_find_link_faults(cells.points, file),
                *proofs.find_face_faults(surface.points, joined),
            ]
        ),
        patch=file.cell_data.get(PATCH_OF_GROUND),
    )


def _survey_cells(path: Path, *, soil: bool, density_at: DensityAt | None) -> _Cells:
    """Read the volume, and let its cells go."""
    volume = read_vtu(path)
    mesh = volume.mesh
    if not np.isfinite(mesh.points).all():
        raise damaged(path, "a coordinate is not finite")
    region = read_regions(path, volume) if soil else np.full(len(mesh.cells), Region.AIR, np.int8)
    leaves = Finding()
    if density_at is not None:
        leaves = check_leaves(mesh.points, mesh.cells, read_leaves(path, volume), density_at)
    del volume
    sizes = proofs.check_cells(mesh, region)
    pairs = conformity.pair_cell_faces(mesh.cells, len(mesh.points))
    between, of_soil = _part_regions(mesh, region, pairs.exterior) if soil else _no_regions(pairs.exterior)
    label = _label_parts(mesh, region, pairs.part) if soil else pairs.part
    return _Cells(
        n_cells=len(mesh.cells),
        points=mesh.points,
        air=sizes.sums["air"],
        soil=sizes.sums["soil"],
        smallest=-sizes.largest["-smallest"],
        exterior=pairs.exterior,
        between=between,
        of_soil=of_soil,
        part=label[pairs.row].astype(np.int64),
        part_cells=_count_parts(label),
        part_soil=_count_parts(label[region == Region.SOIL], int(label.max(initial=-1)) + 1) > 0,
        leaves=leaves,
        faults=proofs.merge_faults([*proofs.find_face_faults(mesh.points, pairs), *sizes.faults]),
    )


def take_vertices(piece: Piece, marker: Marker) -> Vertices:
    """Return the vertices with a marker (n, 3), but for those over the rim."""
    facets = piece.surface.boundary.facets[piece.surface.marked(marker)]
    vertices: Vertices = piece.surface.points[
        conformity.find_used_points(facets, len(piece.on_rim)) & ~piece.on_rim
    ]
    return vertices


def _count_parts(label: NDArray[Any], n: int = 0) -> NDArray[np.int64]:
    """Count the cells of each part, some cells at a time, as numpy makes numbers of 64 bits of them."""
    n = max(n, int(label.max(initial=-1)) + 1)
    blocks = range(0, len(label), proofs.CELLS_AT_ONCE)
    total = np.zeros(n, np.int64)
    for k in blocks:
        total += np.bincount(label[k : k + proofs.CELLS_AT_ONCE], minlength=n)
    return total


def _no_regions(exterior: NDArray[np.int32]) -> tuple[NDArray[np.int32], Mask]:
    return np.empty((0, 3), np.int32), np.zeros(len(exterior), np.bool_)


def _part_regions(
    mesh: TetMesh, region: NDArray[np.int8], exterior: NDArray[np.int32]
) -> tuple[NDArray[np.int32], Mask]:
    """Find the faces between air and soil (g, 3), as the air has them, and which exterior faces are the soil's."""
    air = conformity.pair_cell_faces(mesh.cells[region == Region.AIR], len(mesh.points)).exterior
    match = conformity.match_facets(exterior, air)
    of_soil = np.zeros(len(exterior), np.bool_)
    of_soil[match.missing] = True
    return air[match.extra], of_soil


def _label_parts(mesh: TetMesh, region: NDArray[np.int8], part: NDArray[np.int32]) -> NDArray[np.int64]:
    """Number the parts of the air and those of the soil; `part` is that of each cell without regions."""
    label = part.astype(np.int64)
    first = 0
    for kind in np.unique(region).tolist() if len(np.unique(region)) > 1 else ():
        rows = np.flatnonzero(region == kind)
        found = conformity.pair_cell_faces(mesh.cells[rows], len(mesh.points)).part
        label[rows] = first + found
        first += int(found.max()) + 1
    return label


def _join(points: Vertices, faces: NDArray[np.int32], file: BoundaryPiece) -> tuple[Surface, NDArray[np.int32]]:
    """Put the boundary and faces (k, 3) of the volume on common points, equal where coordinates are."""
    facets = file.boundary.facets
    used = np.flatnonzero(conformity.find_used_points(faces, len(points)))
    kept = np.flatnonzero(conformity.find_used_points(facets, len(file.points)))
    both = np.concatenate((points[used], file.points[kept]))
    group, n_groups = conformity.group_rows(both)
    common = np.empty((n_groups, 3))
    common[group] = both
    index = group.astype(np.int32)
    of_volume, of_file = np.empty(len(points), np.int32), np.empty(len(file.points), np.int32)
    of_volume[used], of_file[kept] = index[: len(used)], index[len(used) :]
    boundary = Boundary(of_file[facets], file.boundary.marker, file.boundary.building)
    moved = file.point_data.get(ROOF_MOVED, np.zeros(len(file.points)))[facets]
    return proofs.make_surface(common, boundary, moved), of_volume[faces]


def _facing_up(points: Vertices, faces: NDArray[np.int32]) -> NDArray[np.int32]:
    area, _ = conformity.compute_facet_areas(points, faces)
    faces, area = faces[area > 0], area[area > 0]
    return faces[proofs.measure_plan_widths(points[faces], area) > proofs.SIDE_TOLERANCE]


def _find_rim(
    surface: Surface,
    facets: NDArray[np.int32],
    edges: Vertices,
    over: tuple[NDArray[np.int32], NDArray[np.int64]],
    *,
    known: Mask,
    faces: NDArray[np.int32],
    on_rim: Mask,
) -> Rim:
    """Gather what stands over the rim's edges: exterior faces `over` them with their parts, some `known`.

    Those `known` are in the boundary file; of that, `facets` are those that bound the cells.
    """
    boundary, points = surface.boundary, surface.points
    start, end = facets.ravel(), np.roll(facets, -1, axis=1).ravel()
    both = on_rim[start] & on_rim[end]
    kinds = (faces, *(boundary.facets[surface.marked(m)] for m in (Marker.GROUND, Marker.TOP)))
    chosen = [np.flatnonzero(conformity.find_used_points(rows, len(points)) & on_rim) for rows in kinds]
    rows = np.concatenate(chosen)
    return Rim(
        edges=edges,
        faces=points[over[0]],
        is_boundary=known,
        part=over[1],
        lines=points[np.stack((start[both], end[both]), axis=1)],
        points=np.column_stack((points[rows], np.repeat((ANY, GROUND, TOP), [len(row) for row in chosen]))),
    )


def _pair_edges(points: Vertices, facets: NDArray[np.int32], on_rim: Mask) -> tuple[Vertices, Vertices]:
    """Pair the boundary's edges that are not over the rim: those left open, and those of many facets."""
    edges = conformity.pair_edges(facets)
    kept = [rows[~on_rim[rows].all(axis=1)] for rows in (edges.open, edges.non_manifold)]
    return points[kept[0]], points[kept[1]]


def _find_link_faults(points: Vertices, piece: BoundaryPiece) -> list[Fault]:
    """Find boundary points whose `vertex` is not the volume's point in the same place, or that repeat."""
    known = (piece.vertex >= 0) & (piece.vertex < len(points))
    linked = known.copy()
    linked[known] = np.all(points[piece.vertex[known]] == piece.points[known], axis=1)
    unused = conformity.find_unused_points(piece.boundary.facets, len(piece.points))
    duplicate = conformity.find_duplicate_points(piece.points)
    return [
        *proofs.find_faults("vertex-link", piece.points[~linked], "`vertex` is another point of the volume"),
        *proofs.find_faults("vertex-unused", piece.points[unused], "no facet uses it"),
        *proofs.find_faults("vertex-duplicate", piece.points[duplicate], "a boundary vertex is there twice"),
    ]
