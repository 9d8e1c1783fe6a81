"""One piece of a run folder, read for `citystitch check`: its boundary, its rim, and what its cells say."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Boundary, Marker, Region, TetMesh
from stitch.pieces import conformity
from stitch.pieces.frontier import Rim, as_places, find_border, find_edges_below, find_outline
from tiler.check import proofs
from tiler.check.proofs import Bounds, Fault, Finding, Mask, Surface, Vertices
from tiler.check.soil_proofs import check_between
from tiler.mesh_files.vtk_files import BoundaryPiece, read_vtp
from tiler.store.run_folder import PATCH_OF_GROUND, ROOF_MOVED, read_volume

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
    faults: tuple[Fault, ...]
    patch: NDArray[np.int8] | None


def read_piece(volume_path: Path, boundary_path: Path, bounds: Bounds, *, soil: bool = False) -> Piece:
    """Read the two files of a piece of the region with these bounds (m), which has soil or has not.

    Raises
    ------
    InputError
        If one is missing or damaged.
    """
    (mesh, region), file = read_volume(volume_path, regions=soil), read_vtp(boundary_path)
    pairs = conformity.pair_cell_faces(mesh.cells, len(mesh.points))
    volumes, flat = conformity.compute_cell_volumes(mesh.points, mesh.cells)
    between, of_soil = _part_regions(mesh, region, pairs.exterior)
    label = _label_parts(mesh, region, pairs.part)
    surface, rows = _join(mesh.points[np.concatenate((pairs.exterior, between))], file)
    faces, between = rows[: len(pairs.exterior)], rows[len(pairs.exterior) :]
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
    of_air[np.setdiff1d(np.arange(len(exterior)), conformity.match_facets(faces[of_soil], exterior).extra)] = False
    outline = find_outline(surface.points, _facing_up(surface.points, exterior[of_air]))
    edges = outline[~find_border(outline, bounds, tolerance=proofs.SIDE_TOLERANCE)]
    over = find_edges_below(surface.points[exterior], edges) >= 0
    part = label[pairs.row[joined.row]]
    rim, on_rim = _find_rim(surface, facets, edges, (exterior[over], part[over]), known[over], faces)
    open_edges, crowded = _pair_edges(surface.points, facets, on_rim)
    return Piece(
        n_cells=len(mesh.cells),
        n_points=len(mesh.points) - len(np.unique(pairs.exterior)) + int((~on_rim[np.unique(faces)]).sum()),
        air=float(volumes[region == Region.AIR].sum()),
        soil=float(volumes[region == Region.SOIL].sum()),
        smallest=float(volumes.min(initial=np.inf)),
        surface=surface,
        part_cells=np.bincount(label),
        part_soil=np.bincount(label, region == Region.SOIL) > 0,
        outline=outline,
        rim=rim,
        on_rim=on_rim,
        same_boundary=proofs.check_same_boundary(surface.points, facets, exterior, match, over),
        ground=check_between(surface.points, ground, between) if soil else Finding(),
        closed=proofs.check_closed(open_edges, crowded),
        crowded=crowded,
        faults=proofs.merge_faults(
            [
                *proofs.find_face_faults(mesh.points, pairs),
                *proofs.find_cell_faults(mesh, volumes, flat),
                *_find_link_faults(mesh, file),
                *proofs.find_face_faults(surface.points, joined),
            ]
        ),
        patch=file.cell_data.get(PATCH_OF_GROUND),
    )


def take_vertices(piece: Piece, marker: Marker, kind: int, fresh: Mask) -> Vertices:
    """Return the vertices with a marker (n, 3), but for those over the rim that an earlier piece had."""
    row = np.unique(piece.surface.boundary.facets[piece.surface.marked(marker)])
    rest = piece.rim.points[fresh & (piece.rim.points[:, 3] == kind), :3]
    return np.concatenate((piece.surface.points[row[~piece.on_rim[row]]], rest))


def _part_regions(
    mesh: TetMesh, region: NDArray[np.int8], exterior: NDArray[np.int32]
) -> tuple[NDArray[np.int32], Mask]:
    """Find the faces between air and soil (g, 3), as the air has them, and which exterior faces are the soil's."""
    if (region == Region.AIR).all():
        return np.empty((0, 3), np.int32), np.zeros(len(exterior), np.bool_)
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


def _join(exterior: Vertices, file: BoundaryPiece) -> tuple[Surface, NDArray[np.int32]]:
    """Put the boundary and the exterior faces (k, 3, 3) on common points, equal where coordinates are."""
    corners = file.points[file.boundary.facets]
    rows = np.concatenate([exterior, corners]).reshape(-1, 3)
    group, n_groups = conformity.group_rows(rows)
    points = np.empty((n_groups, 3))
    points[group] = rows
    index = group.astype(np.int32).reshape(-1, 3)
    boundary = Boundary(index[len(exterior) :], file.boundary.marker, file.boundary.building)
    moved = file.point_data.get(ROOF_MOVED, np.zeros(len(file.points)))[file.boundary.facets]
    return proofs.make_surface(points, boundary, moved), index[: len(exterior)]


def _facing_up(points: Vertices, faces: NDArray[np.int32]) -> NDArray[np.int32]:
    area, _ = conformity.compute_facet_areas(points, faces)
    return faces[(area > 0) & (proofs.measure_plan_widths(points[faces], area) > proofs.SIDE_TOLERANCE)]


def _find_rim(
    surface: Surface,
    facets: NDArray[np.int32],
    edges: Vertices,
    over: tuple[NDArray[np.int32], NDArray[np.int64]],
    known: Mask,
    faces: NDArray[np.int32],
) -> tuple[Rim, Mask]:
    """Gather what stands over the rim's edges: exterior faces `over` them with their parts, some `known`.

    Those `known` are in the boundary file; of that, `facets` are those that bound the cells.
    """
    boundary, points = surface.boundary, surface.points
    on_rim = np.isin(as_places(points), as_places(edges))
    start, end = facets.ravel(), np.roll(facets, -1, axis=1).ravel()
    both = on_rim[start] & on_rim[end]
    kinds = [
        np.unique(faces),
        *(np.unique(boundary.facets[surface.marked(m)]) for m in (Marker.GROUND, Marker.TOP)),
    ]
    chosen = [row[on_rim[row]] for row in kinds]
    rows = np.concatenate(chosen)
    rim = Rim(
        edges=edges,
        faces=points[over[0]],
        is_boundary=known,
        part=over[1],
        lines=points[np.stack((start[both], end[both]), axis=1)],
        points=np.column_stack((points[rows], np.repeat((ANY, GROUND, TOP), [len(row) for row in chosen]))),
    )
    return rim, on_rim


def _pair_edges(points: Vertices, facets: NDArray[np.int32], on_rim: Mask) -> tuple[Vertices, Vertices]:
    """Pair the boundary's edges that are not over the rim: those left open, and those of many facets."""
    edges = conformity.pair_edges(facets)
    kept = [rows[~on_rim[rows].all(axis=1)] for rows in (edges.open, edges.non_manifold)]
    return points[kept[0]], points[kept[1]]


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
