"""From columns to explicit tetrahedra and to the marked boundary (step 3.6): the merge of columns.

In each triangle the segments of its three columns are merged from below, one tetrahedron a step, in the
mesh's order (`ColumnMesh.order`). For columns of equal counts, "levels" is the paper's equations 1-3. Either
order compares two columns by what these two are, so the faces over an edge are the same from both of its
triangles: the mesh conforms. Beside steep tops of walls, keys take the place of heights (`order_keys`).
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.mesh import Boundary, ColumnMesh, Marker, SeamEdges, TetMesh
from pipeline.plane_mesh.edges import plane_edges
from pipeline.plane_mesh.plane import signed_areas

Bounds = tuple[float, float, float, float]


def count_cells(mesh: ColumnMesh) -> int:
    """Count the tetrahedra that the columns stand for."""
    return int(count_by_triangle(mesh).sum())


def count_by_triangle(mesh: ColumnMesh) -> NDArray[np.int64]:
    """Count the tetrahedra over each triangle, int64 (m,)."""
    levels = np.diff(mesh.z_start)[mesh.plane.triangles]
    counts: NDArray[np.int64] = (levels - 1 - mesh.bottom).sum(axis=1)
    return counts


def expand_cells(mesh: ColumnMesh) -> TetMesh:
    """Write the columns out as tetrahedra of positive volume.

    Returns
    -------
    TetMesh
        Points in the order of `ColumnMesh.z`: column by column from below. Cells triangle by triangle.
    """
    column = np.repeat(np.arange(len(mesh.plane.xy)), np.diff(mesh.z_start))
    cells = merge_columns(mesh, slice(None), signed_areas(mesh.plane) < 0, count_cells(mesh))
    return TetMesh(np.column_stack((mesh.plane.xy[column], mesh.z)), cells)


def merge_columns(mesh: ColumnMesh, part: slice, clockwise: NDArray[np.bool_], n_cells: int) -> NDArray[np.int32]:
    """Merge the columns over some triangles.

    Parameters
    ----------
    part : slice
        Triangles, one after the other.
    clockwise : bool, (m,)
        Which of all triangles have a negative area.
    n_cells : int
        Cells over those that are wanted, see `count_by_triangle`.

    Returns
    -------
    int32, (n_cells, 4)
        Levels of `ColumnMesh.z`, triangle by triangle. The first and the last corner of a cell are the ends of its
        upright edge, so that rows repeat what is above them: files of them are smaller, and packed sooner.
    """
    cells = np.empty((n_cells, 4), np.int32)
    triangles, by_height = mesh.plane.triangles[part], mesh.order == "heights"
    _merge_columns(triangles, mesh.bottom[part], mesh.z_start, mesh.merge_keys, by_height, clockwise[part], cells)
    return cells


def find_used_points(mesh: ColumnMesh) -> NDArray[np.bool_]:
    """Tell which points of `expand_cells` belong to a cell, bool (n_points,).

    Notes
    -----
    A column of a seam has a level for the ground or roof of every tile, also where this tile begins higher.
    """
    count = np.diff(mesh.z_start)
    lowest = count.astype(np.int32)
    np.minimum.at(lowest, mesh.plane.triangles, mesh.bottom)
    below = np.flatnonzero(lowest)
    skipped = lowest[below]
    begin = np.cumsum(skipped) - skipped
    used = np.ones(len(mesh.z), np.bool_)
    used[np.arange(skipped.sum()) + np.repeat(mesh.z_start[below] - begin, skipped)] = False
    return used


def lowest_gap(mesh: ColumnMesh) -> tuple[float, int]:
    """Smallest step between two levels of a column (m), and the number of steps that do not ascend.

    A cell's volume is a third of its triangle's area times one such step: no cell is inverted exactly
    when every step is positive.
    """
    gap = np.diff(mesh.z)
    gap[mesh.z_start[1:-1] - 1] = np.inf
    return float(gap.min()), int((gap <= 0).sum())


def split_boundary(
    mesh: ColumnMesh, numbers: NDArray[np.int64], bounds: Bounds, seams: SeamEdges, *, strict: bool = True
) -> tuple[Boundary, NDArray[np.int32]]:
    """Extract the boundary of one tile of a region (step 3.6), without the faces that it shares with others.

    Parameters
    ----------
    numbers : int64, (b,)
        Number of each building, row by row those of `PlaneMesh.building`.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    seams : SeamEdges
        All outer edges of the tile that are not on the region's border.
    strict : bool
        Refuse other outer edges; else facets over them have the marker 0.

    Returns
    -------
    Boundary
        Facets pointing out of this tile's air: ground and roofs downwards. A wall belongs to the higher building;
        there is none where both sides of an edge begin at the same levels. Over a seam, these are the walls that
        only this side has: the one beyond begins higher. If the tile beyond is missing, all facets are MISSING.
    int32, (s, 3)
        The other facets over seams, pointing out of this tile's air. The tile beyond has each of them, bit for
        bit, in the opposite orientation.

    Raises
    ------
    ValueError
        If a seam is no outer edge of the mesh or begins at a level that its columns lack, or an outer edge is
        neither on the region's border nor a seam.

    Notes
    -----
    Walls are the facets over an edge that one of its two sides alone has. Where a roof is not level along a wall,
    the merge may pass it by: then the higher side has facets that the lower lacks, and both are written, each seen
    from its own air. The boundary is closed in any case. A wall on a seam is found like any other: from the levels
    at which the two sides begin. Both tiles have the same columns there, so what one leaves out the other does not
    have.
    """
    plane = mesh.plane
    first = mesh.z_start[plane.triangles]
    last = mesh.z_start[plane.triangles + 1] - 1
    clockwise = signed_areas(plane) < 0
    floor = _oriented((first + mesh.bottom).astype(np.int32), ~clockwise)
    ceiling = _oriented(last.astype(np.int32), clockwise)
    building = np.where(plane.building >= 0, np.append(numbers, -1)[plane.building], -1)
    floor_marker = np.where(plane.building >= 0, Marker.ROOF, Marker.GROUND)
    upright, shared = _upright_facets(mesh, building, bounds, seams, strict)
    boundary = Boundary(
        np.concatenate((floor, ceiling, upright.facets)),
        np.concatenate((floor_marker, np.full(len(ceiling), Marker.TOP), upright.marker)).astype(np.int32),
        np.concatenate((building, np.full(len(ceiling), -1), upright.building)),
    )
    return boundary, shared


def _oriented(facets: NDArray[np.int32], swap: NDArray[np.bool_]) -> NDArray[np.int32]:
    facets[swap] = facets[swap][:, [0, 2, 1]]
    return facets


def _upright_facets(
    mesh: ColumnMesh, building: NDArray[np.int64], bounds: Bounds, seams: SeamEdges, strict: bool
) -> tuple[Boundary, NDArray[np.int32]]:
    """Facets over edges: walls where the two sides begin at different levels, and sides; and the shared ones."""
    plane = mesh.plane
    edges, of_triangle = plane_edges(plane.triangles)
    air, other = _edge_sides(of_triangle, mesh.bottom, len(edges))
    outer = other[:, 0] < 0
    seam = np.full(len(edges), -1)
    seam[_find_seams(mesh, edges, outer, seams)] = np.arange(len(seams.vertices))
    sheet = np.flatnonzero(outer | (air[:, 1:] != other[:, 1:]).any(axis=1))
    air, other, ends, outer, seam = air[sheet], other[sheet], edges[sheet], outer[sheet], seam[sheet]
    on_seam = seam >= 0
    on_seam[on_seam] = ~seams.missing[seam[on_seam]]
    column_end = mesh.z_start[ends + 1] - 1
    low = mesh.z_start[ends] + air[:, 1:]
    high = np.where(outer[:, None], column_end, mesh.z_start[ends] + other[:, 1:])
    high[on_seam] = mesh.z_start[ends[on_seam]] + seams.bottom[seam[on_seam]]
    until = np.where(outer[:, None], column_end, np.maximum(low, high))
    # Seen from outside, a facet from vertex to vertex to above runs counter-clockwise if the air lies left.
    opposite = plane.xy[plane.triangles[air[:, 0]].sum(axis=1) - ends.sum(axis=1)]
    start, end = plane.xy[ends[:, 0]], plane.xy[ends[:, 1]]
    along, across = end - start, opposite - start
    air_left = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0] > 0
    sides = (low, high, until, column_end, mesh.merge_keys, mesh.order == "heights", air_left, on_seam)
    count = np.empty(len(ends), np.int64)
    _merge_edges(*sides, count, np.empty((0, 3), np.int32), np.empty(0, np.bool_))
    facets, shared = np.empty((count.sum(), 3), np.int32), np.empty(count.sum(), np.bool_)
    _merge_edges(*sides, count, facets, shared)
    marker = np.where(outer, _side_marker(start, end, bounds), Marker.WALL)
    if strict and (marker[seam < 0] == 0).any():
        x, y = (start + end)[(marker == 0) & (seam < 0)][0] / 2
        raise ValueError(f"the outer edge at ({x}, {y}) is neither on the region's border nor a seam")
    marker[seam >= 0] = Marker.MISSING
    marker[on_seam] = Marker.WALL
    # Of two buildings that share a wall, it is the higher one's: the side that begins higher.
    owner = np.where(outer, -1, building[other[:, 0]])
    own, beyond = building[air[on_seam, 0]], seams.building[seam[on_seam]]
    higher = np.sign((high - low)[on_seam].sum(axis=1))
    owner[on_seam] = np.select([higher > 0, higher < 0], [beyond, own], np.maximum(own, beyond))
    alone = ~shared
    walls = Boundary(
        facets[alone], np.repeat(marker, count)[alone].astype(np.int32), np.repeat(owner, count)[alone]
    )
    return walls, facets[shared]


def _find_seams(
    mesh: ColumnMesh, edges: NDArray[np.int32], outer: NDArray[np.bool_], seams: SeamEdges
) -> NDArray[np.int64]:
    """Rows of the seams among the edges."""
    n = len(mesh.plane.xy)
    key = edges[:, 0].astype(np.int64) * n + edges[:, 1]
    wanted = seams.vertices[:, 0].astype(np.int64) * n + seams.vertices[:, 1]
    row = np.searchsorted(key, wanted).clip(max=len(key) - 1)
    if (key[row] != wanted).any() or not outer[row].all() or len(np.unique(row)) != len(row):
        raise ValueError("a seam is no outer edge of the mesh, or is given twice")
    last = np.diff(mesh.z_start)[seams.vertices] - 1
    if not (((seams.bottom >= 0) & (seams.bottom <= last)) | seams.missing[:, None]).all():
        raise ValueError("a tile beyond a seam begins at a level that the seam's columns lack")
    return row


def _side_marker(start: NDArray[np.float64], end: NDArray[np.float64], bounds: Bounds) -> NDArray[np.int64]:
    on = [(start == corner) & (end == corner) for corner in (bounds[:2], bounds[2:])]
    sides = [on[0][:, 0], on[1][:, 0], on[0][:, 1], on[1][:, 1]]
    return np.select(sides, [Marker.WEST, Marker.EAST, Marker.SOUTH, Marker.NORTH], 0)


@kernel(inline="always")
def _comes_first(key: NDArray[np.float64], by_height: bool, i: int, end_i: int, j: int, end_j: int) -> bool:
    """Whether a column's segment over level i is merged before the one over j of a later vertex's column."""
    if i == end_i or j == end_j:
        return i < end_i
    if by_height:
        return bool(key[i] + key[i + 1] < key[j] + key[j + 1])
    return end_i - i > end_j - j


@kernel
def merge_triangle(
    triangle: NDArray[np.int32],
    bottom: NDArray[np.int32],
    z_start: NDArray[np.int64],
    key: NDArray[np.float64],
    by_height: bool,
    clockwise: bool,
    cells: NDArray[np.int32],
    cell: int,
) -> int:
    """Write the cells over one triangle, from a row on, and give the row after them; called from compiled code.

    Arguments are rows of `ColumnMesh`: the triangle's vertices, int32 (3,), and the levels where its cells begin.
    """
    a, b, c = z_start[triangle[0]] + bottom[0], z_start[triangle[1]] + bottom[1], z_start[triangle[2]] + bottom[2]
    end_a, end_b, end_c = (
        z_start[triangle[0] + 1] - 1,
        z_start[triangle[1] + 1] - 1,
        z_start[triangle[2] + 1] - 1,
    )
    while a < end_a or b < end_b or c < end_c:
        cells[cell, 0] = a
        cells[cell, 1] = c if clockwise else b
        cells[cell, 2] = b if clockwise else c
        if _comes_first(key, by_height, a, end_a, b, end_b):
            if _comes_first(key, by_height, a, end_a, c, end_c):
                a += 1
                cells[cell, 3] = a
            else:
                c += 1
                cells[cell, 3] = c
        elif _comes_first(key, by_height, b, end_b, c, end_c):
            b += 1
            cells[cell, 3] = b
        else:
            c += 1
            cells[cell, 3] = c
        cell += 1
    return cell


@kernel
def _merge_columns(
    triangles: NDArray[np.int32],
    bottom: NDArray[np.int32],
    z_start: NDArray[np.int64],
    key: NDArray[np.float64],
    by_height: bool,
    clockwise: NDArray[np.bool_],
    cells: NDArray[np.int32],
) -> None:
    cell = 0
    for t in range(len(triangles)):
        first = cell
        cell = merge_triangle(triangles[t], bottom[t], z_start, key, by_height, clockwise[t], cells, first)
        for k in range(first, cell):
            a, b, c = cells[k, 0], cells[k, 1], cells[k, 2]
            below = cells[k, 3] - 1
            if b == below:
                cells[k, 0], cells[k, 1], cells[k, 2] = b, c, a
            elif c == below:
                cells[k, 0], cells[k, 1], cells[k, 2] = c, a, b


@kernel
def _merge_edges(
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    until: NDArray[np.int64],
    column_end: NDArray[np.int64],
    key: NDArray[np.float64],
    by_height: bool,
    air_left: NDArray[np.bool_],
    on_seam: NDArray[np.bool_],
    count: NDArray[np.int64],
    facets: NDArray[np.int32],
    is_shared: NDArray[np.bool_],
) -> None:
    """Count the facets over each edge that one side alone has, and write them where there is room.

    Over a seam, `low` is this tile's side, whatever its height: all facets of it are written, with a mark on
    those that the other has too, and none that the other has alone.

    Both sides merge the same segments in the same order, each from its own first levels on: until a column
    reaches its first level, that is where the column stands. A side's facets differ from the other's where
    a column stands elsewhere; none differ once both sides have begun in both columns.
    """
    facet = 0
    for e in range(len(low)):
        i, j = min(low[e, 0], high[e, 0]), min(low[e, 1], high[e, 1])
        begin = facet
        while i < until[e, 0] or j < until[e, 1]:
            rising = _comes_first(key, by_height, i, column_end[e, 0], j, column_end[e, 1])
            in_low = i >= low[e, 0] if rising else j >= low[e, 1]
            in_high = i >= high[e, 0] if rising else j >= high[e, 1]
            low_i, low_j = max(i, low[e, 0]), max(j, low[e, 1])
            high_i, high_j = max(i, high[e, 0]), max(j, high[e, 1])
            shared = in_low and in_high and low_i == high_i and low_j == high_j
            i, j = (i + 1, j) if rising else (i, j + 1)
            top = i if rising else j
            if in_low and (on_seam[e] or not shared):
                if len(facets) > 0:
                    is_shared[facet] = shared
                    facets[facet, 0] = low_i if air_left[e] else low_j
                    facets[facet, 1] = low_j if air_left[e] else low_i
                    facets[facet, 2] = top
                facet += 1
            if in_high and not (on_seam[e] or shared):
                if len(facets) > 0:
                    is_shared[facet] = False
                    facets[facet, 0] = high_j if air_left[e] else high_i
                    facets[facet, 1] = high_i if air_left[e] else high_j
                    facets[facet, 2] = top
                facet += 1
        count[e] = facet - begin


@kernel
def _edge_sides(
    of_triangle: NDArray[np.int32], bottom: NDArray[np.int32], n_edges: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each edge the triangle and the two first levels on its lower and on its higher side."""
    low = np.full((n_edges, 3), -1, np.int64)
    high = np.full((n_edges, 3), -1, np.int64)
    for t in range(len(of_triangle)):
        for k in range(3):
            e = of_triangle[t, k]
            first = bottom[t, 1] if k == 2 else bottom[t, 0]
            second = bottom[t, 1] if k == 0 else bottom[t, 2]
            if low[e, 0] < 0:
                low[e, 0], low[e, 1], low[e, 2] = t, first, second
            elif first + second >= low[e, 1] + low[e, 2]:
                high[e, 0], high[e, 1], high[e, 2] = t, first, second
            else:
                high[e] = low[e]
                low[e, 0], low[e, 1], low[e, 2] = t, first, second
    return low, high
