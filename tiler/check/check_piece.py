"""One piece of a run folder, read for `citystitch check`: its boundary, its rim, and what its cells say."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import INTERFACES, Boundary, Marker, TetMesh, find_inside
from pipeline.data.regions import Region, Regions
from stitch.pieces import conformity
from stitch.pieces.frontier import (
    MARKED,
    Rim,
    as_places,
    find_border,
    find_edges_below,
    find_outline,
    find_points_over,
)
from tiler.check import proofs
from tiler.check.cover_proofs import DensityAt, check_leaves
from tiler.check.proofs import Bounds, Fault, Finding, Mask, Surface, Vertices
from tiler.check.soil_proofs import check_between, name_interface
from tiler.mesh_files.mesh_pieces import read_leaves, read_regions
from tiler.mesh_files.vtk_files import BoundaryPiece, read_vtp, read_vtu
from tiler.mesh_files.vtk_xml import damaged
from tiler.store.run_folder import PATCH_OF_GROUND, ROOF_MOVED

# Kinds of points over the rim, each counted once: any, of the ground, of the top.
ANY, GROUND, TOP = range(3)


@dataclass(frozen=True, eq=False)
class Piece:
    """What the proofs need of one piece once its cells are let go."""

    #: cells, and points that are not over the rim
    n_cells: int
    n_points: int
    volumes: Mapping[str, float]  #: volume of all cells of each region, ``air`` and so on (m³)
    smallest: float  #: volume of the smallest cell (m³)
    surface: Surface  #: its boundary file, on the distinct vertices of this and of the exterior faces
    #: (p,): cells of each part of a region that hang together by faces, and whether it is air
    part_cells: NDArray[np.int64]
    part_air: Mask
    outline: Vertices  #: (k, 2, 2): edges of its plan
    rim: Rim  #: what it has over those of them that are not on the region's border
    on_rim: Mask  #: (n,): which of the surface's points are over the rim
    #: what the piece alone says of these claims
    same_boundary: Finding
    closed: Finding
    between: Mapping[str, Finding]  #: what it says of each interface of regions, by name
    houses: Vertices  #: (h, 3): a place of a cell of a building over each triangle of the plan that has one (m)
    crowded: Vertices  #: (c, 2, 3): boundary edges of more than two facets, paired, not over the rim
    leaves: Finding  #: what it alone says of the leaves in its cells
    faults: tuple[Fault, ...]  #: of its cells
    #: (c, 4): place of each column of the air, its shortest and longest vertical edge (m); none unless asked for
    upright: NDArray[np.float64]
    #: (k,): patch of the ground of each facet of the surface; None where the file tells of none
    patch: NDArray[np.int8] | None


@dataclass(frozen=True, eq=False)
class _Cells:
    """What is kept of the cells of a piece; other fields are as of `Piece`."""

    n_cells: int
    points: Vertices  # of the volume
    volumes: Mapping[str, float]
    smallest: float
    houses: Vertices
    exterior: NDArray[np.int32]  # (k, 3): faces of one cell, as rows of the points
    between: Mapping[str, NDArray[np.int32]]  # faces of each interface of regions, pointing out of its first
    side: NDArray[np.int8]  # (k,): region of the cell behind each exterior face
    part: NDArray[np.int64]  # (k,): part of the mesh behind each exterior face
    part_cells: NDArray[np.int64]
    part_air: Mask
    leaves: Finding
    upright: NDArray[np.float64]
    faults: tuple[Fault, ...]


def read_piece(
    volume_path: Path,
    boundary_path: Path,
    bounds: Bounds,
    *,
    regions: Regions = (Region.AIR,),
    density_at: DensityAt | None = None,
    upright: bool = False,
) -> Piece:
    """Read the two files of a piece of the region with these bounds (m), each once.

    Parameters
    ----------
    volume_path, boundary_path : Path
        The files.
    bounds : (west, south, east, north)
        Bounds of the region (m).
    regions : tuple of Region
        What the mesh has.
    density_at : callable, optional
        Gives the leaf area density of places, where the mesh has trees.
    upright : bool
        Whether vertical edges are measured.

    Raises
    ------
    InputError
        If one is missing or damaged.
    """
    cells = _survey_cells(volume_path, regions, density_at=density_at, upright=upright)
    file = read_vtp(boundary_path)
    surface, rows = _join(cells.points, np.concatenate((cells.exterior, *cells.between.values())), file)
    counts = [len(cells.exterior), *(len(some) for some in cells.between.values())]
    faces, *between = np.split(rows, np.cumsum(counts)[:-1])
    # Faces of cells whose vertices are there twice meet where coordinates are equal.
    joined = conformity.pair_faces(faces)
    exterior = joined.exterior
    inside = find_inside(surface.boundary.marker, regions)
    facets = surface.boundary.facets[~inside]
    match = conformity.match_facets(exterior, facets)
    known = np.ones(len(exterior), np.bool_)
    known[match.missing] = False
    side = cells.side[joined.row]
    of_air = known & (side == Region.AIR)
    outline = find_outline(surface.points, _facing_up(surface.points, exterior[of_air]))
    edges = outline[~find_border(outline, bounds, tolerance=proofs.SIDE_TOLERANCE)]
    on_rim = find_points_over(surface.points, edges)
    over = np.all(on_rim[exterior], axis=1)
    over[over] = find_edges_below(surface.points[exterior[over]], edges) >= 0
    behind = (exterior[over], cells.part[joined.row[over]])
    found, on_seam = _check_interfaces(surface, dict(zip(cells.between, between, strict=True)), exterior, over)
    side[on_seam] += MARKED
    rim = _find_rim(surface, facets, edges, (*behind, side[over]), known=known[over], faces=faces, on_rim=on_rim)
    open_edges, crowded = _pair_edges(surface.points, facets, on_rim)
    inner = len(cells.points) - int(conformity.find_used_points(cells.exterior, len(cells.points)).sum())
    return Piece(
        n_cells=cells.n_cells,
        n_points=inner + int((conformity.find_used_points(faces, len(on_rim)) & ~on_rim).sum()),
        volumes=cells.volumes,
        smallest=cells.smallest,
        surface=surface,
        part_cells=cells.part_cells,
        part_air=cells.part_air,
        outline=outline,
        rim=rim,
        on_rim=on_rim,
        same_boundary=proofs.check_same_boundary(surface.points, facets, exterior, match, over),
        closed=proofs.check_closed(open_edges, crowded),
        between=found,
        houses=cells.houses,
        crowded=crowded,
        leaves=cells.leaves,
        faults=proofs.merge_faults(
            [
                *cells.faults,
                *_find_link_faults(cells.points, file),
                *proofs.find_face_faults(surface.points, joined),
            ]
        ),
        upright=cells.upright,
        patch=file.cell_data.get(PATCH_OF_GROUND),
    )


def _check_interfaces(
    surface: Surface,
    between: Mapping[str, NDArray[np.int32]],
    exterior: NDArray[np.int32],
    over: Mask,
) -> tuple[dict[str, Finding], NDArray[np.int64]]:
    """Hold the faces between regions against the facets that are marked as such.

    Also gives the rows of exterior faces over the rim, `over`, that are marked so: what lies beyond is the other
    piece's.
    """
    found: dict[str, Finding] = {}
    on_seam = [np.empty(0, np.int64)]
    for sides, markers in INTERFACES.items():
        if (name := name_interface(sides)) in between:
            marked = surface.boundary.facets[surface.marked(*markers)]
            match = conformity.match_facets(marked, exterior)
            rows = np.setdiff1d(np.flatnonzero(over), np.append(match.extra, match.flipped))
            match = conformity.match_facets(exterior[rows], marked)
            marked = marked[np.union1d(match.extra, match.duplicate)]
            found[name] = check_between(surface.points, marked, between[name], sides)
            on_seam.append(rows)
    return found, np.concatenate(on_seam)


def _survey_cells(path: Path, regions: Regions, *, density_at: DensityAt | None, upright: bool) -> _Cells:
    """Read the volume, and let its cells go."""
    volume = read_vtu(path)
    mesh = volume.mesh
    if not np.isfinite(mesh.points).all():
        raise damaged(path, "a coordinate is not finite")
    region = np.full(len(mesh.cells), Region.AIR, np.int8)
    if len(regions) > 1:
        region = read_regions(path, volume, regions)
    leaves = Finding()
    if density_at is not None:
        leaves = check_leaves(mesh.points, mesh.cells, read_leaves(path, volume), density_at)
    del volume
    sizes = proofs.check_cells(mesh, region)
    pairs = conformity.pair_cell_faces(mesh.cells, len(mesh.points))
    label = _label_parts(mesh, region, pairs.part) if len(regions) > 1 else pairs.part
    return _Cells(
        n_cells=len(mesh.cells),
        points=mesh.points,
        volumes=sizes.sums,
        smallest=-sizes.largest["-smallest"],
        houses=_find_houses(mesh, region),
        exterior=pairs.exterior,
        between=_find_between(mesh, region, regions, pairs.exterior),
        side=region[pairs.row],
        part=label[pairs.row].astype(np.int64),
        part_cells=_count_parts(label),
        part_air=_count_parts(label[region == Region.AIR], int(label.max(initial=-1)) + 1) > 0,
        leaves=leaves,
        upright=_measure_columns(mesh, region) if upright else np.empty((0, 4)),
        faults=proofs.merge_faults([*proofs.find_face_faults(mesh.points, pairs), *sizes.faults]),
    )


def _measure_columns(mesh: TetMesh, region: NDArray[np.int8]) -> NDArray[np.float64]:
    """Give place, shortest and longest vertical edge of each column of the air (c, 4)."""
    places, column = np.unique(mesh.points[:, :2], axis=0, return_inverse=True)
    column = column.ravel()
    least, most = np.full(len(places), np.inf), np.zeros(len(places))
    for start in range(0, len(mesh.cells), proofs.CELLS_AT_ONCE):
        rows = slice(start, start + proofs.CELLS_AT_ONCE)
        low, high = mesh.cells[rows][region[rows] == Region.AIR][:, [0, 3]].T
        low, high = low[upright := column[low] == column[high]], high[upright]
        length = np.abs(mesh.points[high, 2] - mesh.points[low, 2])
        np.minimum.at(least, column[low], length)
        np.maximum.at(most, column[low], length)
    found: NDArray[np.float64] = np.column_stack((places, least, most))[most > 0]
    return found


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


def _find_between(
    mesh: TetMesh, region: NDArray[np.int8], regions: Regions, exterior: NDArray[np.int32]
) -> dict[str, NDArray[np.int32]]:
    """Find the faces of each interface of regions (g, 3), pointing out of its first, by name."""
    if len(regions) == 1:
        return {}
    inner = {}
    for kind in regions:
        own = conformity.pair_cell_faces(mesh.cells[region == kind], len(mesh.points)).exterior
        inner[kind] = own[conformity.match_facets(exterior, own).extra]
    return {
        name_interface((one, two)): inner[one][conformity.match_facets(inner[two], inner[one]).flipped]
        for one, two in INTERFACES
        if one in regions and two in regions
    }


def _find_houses(mesh: TetMesh, region: NDArray[np.int8]) -> Vertices:
    """Find the cells of buildings: a place (h, 3) over each triangle of the plan that has one."""
    corners = mesh.points[mesh.cells[region == Region.BUILDING, :3]]
    plan, row = np.unique(np.sort(as_places(corners), axis=1), axis=0, return_index=True)
    middle = plan.mean(axis=1)
    return np.column_stack((middle.real, middle.imag, corners[row, 0, 2]))


def _label_parts(mesh: TetMesh, region: NDArray[np.int8], part: NDArray[np.int32]) -> NDArray[np.int64]:
    """Number the parts of each region; `part` is that of each cell without regions."""
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
    over: tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int8]],
    *,
    known: Mask,
    faces: NDArray[np.int32],
    on_rim: Mask,
) -> Rim:
    """Gather what stands over the rim's edges: exterior faces `over` them with their parts and sides.

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
        side=over[2],
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
