"""From columns to explicit tetrahedra and to the marked boundary (step 3.6): the merge of columns.

In each triangle the segments of its three columns are merged from below, one tetrahedron a step. The
next step goes to the column with the most segments left, ties to the highest vertex. For equal counts
these are the paper's equations 1-3; and because the choice between two columns depends on those two
alone, the faces over an edge are the same from both of its triangles: the mesh conforms.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import GeometryError
from pipeline.mesh import Boundary, ColumnMesh, Marker, PlaneMesh, TetMesh
from pipeline.plane import signed_areas


def count_cells(mesh: ColumnMesh) -> int:
    """Count the tetrahedra that the columns stand for."""
    triangles = mesh.plane.triangles
    levels = np.diff(mesh.z_start)[triangles]
    return int((levels - 1 - mesh.bottom).sum())


def expand_cells(mesh: ColumnMesh) -> TetMesh:
    """Write the columns out as tetrahedra of positive volume.

    Returns
    -------
    TetMesh
        Points in the order of `ColumnMesh.z`: column by column from below. Cells triangle by triangle.
    """
    column = np.repeat(np.arange(len(mesh.plane.xy)), np.diff(mesh.z_start))
    points = np.column_stack((mesh.plane.xy[column], mesh.z))
    cells = np.empty((count_cells(mesh), 4), np.int32)
    clockwise = signed_areas(mesh.plane) < 0
    _merge_columns(mesh.plane.triangles, mesh.bottom, mesh.z_start, clockwise, cells)
    return TetMesh(points, cells)


def lowest_gap(mesh: ColumnMesh) -> tuple[float, int]:
    """Smallest step between two levels of a column (m), and the number of steps that do not ascend.

    A cell's volume is a third of its triangle's area times one such step: no cell is inverted exactly
    when every step is positive.
    """
    gap = np.diff(mesh.z)
    gap[mesh.z_start[1:-1] - 1] = np.inf
    return float(gap.min()), int((gap <= 0).sum())


def extract_boundary(mesh: ColumnMesh, numbers: NDArray[np.int64]) -> Boundary:
    """Extract the boundary of the volume with its markers (step 3.6).

    Parameters
    ----------
    mesh : ColumnMesh
        The mesh; its points are numbered as by `expand_cells`.
    numbers : int64, (b,)
        Number of each building of the city model.

    Returns
    -------
    Boundary
        Facets pointing out of the air: ground and roofs downwards. A wall belongs to the higher building.
    """
    plane = mesh.plane
    first = mesh.z_start[plane.triangles]
    last = mesh.z_start[plane.triangles + 1] - 1
    clockwise = signed_areas(plane) < 0
    floor = _oriented((first + mesh.bottom).astype(np.int32), ~clockwise)
    ceiling = _oriented(last.astype(np.int32), clockwise)
    building = np.where(plane.building >= 0, np.append(numbers, -1)[plane.building], -1)
    floor_marker = np.where(plane.building >= 0, Marker.ROOF, Marker.GROUND)
    sheets, sheet_marker, sheet_building = _vertical_facets(mesh, building)
    return Boundary(
        np.concatenate((floor, ceiling, sheets)),
        np.concatenate((floor_marker, np.full(len(ceiling), Marker.TOP), sheet_marker)).astype(np.int32),
        np.concatenate((building, np.full(len(ceiling), -1), sheet_building)),
    )


def plane_edges(triangles: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Edges of a plane mesh and the triangles beside them.

    Parameters
    ----------
    triangles : int32, (m, 3)
        Ascending vertex indices.

    Returns
    -------
    edges : int32, (e, 2)
        Ascending vertex indices, each edge once, sorted.
    of_triangle : int32, (m, 3)
        Edges of each triangle: those between its corners 0-1, 0-2, 1-2.
    """
    pairs = triangles[:, [[0, 1], [0, 2], [1, 2]]].reshape(-1, 2)
    n = int(triangles.max()) + 1
    key, index = np.unique(pairs[:, 0].astype(np.int64) * n + pairs[:, 1], return_inverse=True)
    edges = np.column_stack((key // n, key % n)).astype(np.int32)
    return edges, index.reshape(-1, 3).astype(np.int32)


def _oriented(facets: NDArray[np.int32], swap: NDArray[np.bool_]) -> NDArray[np.int32]:
    facets[swap] = facets[swap][:, [0, 2, 1]]
    return facets


def _vertical_facets(
    mesh: ColumnMesh, building: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
    """Facets over edges: walls where the two sides begin at different levels, and the region's sides."""
    plane = mesh.plane
    edges, of_triangle = plane_edges(plane.triangles)
    air, other = _edge_sides(of_triangle, mesh.bottom, len(edges))
    sheet = np.flatnonzero((other[:, 0] < 0) | (air[:, 1:] != other[:, 1:]).any(axis=1))
    air, other, ends = air[sheet], other[sheet], edges[sheet]
    outer = other[:, 0] < 0
    bottom = mesh.z_start[ends] + air[:, 1:]
    top = mesh.z_start[ends] + other[:, 1:]
    top[outer] = mesh.z_start[ends[outer] + 1] - 1
    count = (top - bottom).sum(axis=1)
    # Seen from outside, a facet from vertex to vertex to above runs counter-clockwise if the air lies left.
    opposite = plane.xy[plane.triangles[air[:, 0]].sum(axis=1) - ends.sum(axis=1)]
    start, end = plane.xy[ends[:, 0]], plane.xy[ends[:, 1]]
    along, across = end - start, opposite - start
    air_left = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0] > 0
    facets = np.empty((count.sum(), 3), np.int32)
    column_end = mesh.z_start[ends + 1] - 1
    if not _merge_edges(bottom, top, column_end, air_left, facets):
        raise GeometryError(
            "boundary, step 3.6: a wall's levels do not meet the levels of the roof above it; "
            "please report this with the city model"
        )
    # Of two buildings that share a wall, it is the higher one's: the side that begins higher.
    marker = np.where(outer, _side_marker(plane, start, end), Marker.WALL)
    owner = np.where(outer, -1, building[other[:, 0]])
    return facets, np.repeat(marker, count).astype(np.int32), np.repeat(owner, count)


def _side_marker(plane: PlaneMesh, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.int64]:
    low, high = plane.xy.min(axis=0), plane.xy.max(axis=0)
    on = [(start == low) & (end == low), (start == high) & (end == high)]
    sides = [on[0][:, 0], on[1][:, 0], on[0][:, 1], on[1][:, 1]]
    return np.select(sides, [Marker.WEST, Marker.EAST, Marker.SOUTH, Marker.NORTH], 0)


@numba.njit(cache=True, nogil=True)
def _merge_columns(
    triangles: NDArray[np.int32],
    bottom: NDArray[np.int32],
    z_start: NDArray[np.int64],
    clockwise: NDArray[np.bool_],
    cells: NDArray[np.int32],
) -> None:
    cell = 0
    for t in range(len(triangles)):
        a = z_start[triangles[t, 0]] + bottom[t, 0]
        b = z_start[triangles[t, 1]] + bottom[t, 1]
        c = z_start[triangles[t, 2]] + bottom[t, 2]
        left_a = z_start[triangles[t, 0] + 1] - 1 - a
        left_b = z_start[triangles[t, 1] + 1] - 1 - b
        left_c = z_start[triangles[t, 2] + 1] - 1 - c
        while left_a + left_b + left_c > 0:
            cells[cell, 0] = a
            cells[cell, 1] = c if clockwise[t] else b
            cells[cell, 2] = b if clockwise[t] else c
            if left_c >= left_a and left_c >= left_b:
                c += 1
                left_c -= 1
                cells[cell, 3] = c
            elif left_b >= left_a:
                b += 1
                left_b -= 1
                cells[cell, 3] = b
            else:
                a += 1
                left_a -= 1
                cells[cell, 3] = a
            cell += 1


@numba.njit(cache=True, nogil=True)
def _merge_edges(
    bottom: NDArray[np.int64],
    top: NDArray[np.int64],
    column_end: NDArray[np.int64],
    air_left: NDArray[np.bool_],
    facets: NDArray[np.int32],
) -> bool:
    facet = 0
    for e in range(len(bottom)):
        a, b = bottom[e, 0], bottom[e, 1]
        while a < top[e, 0] or b < top[e, 1]:
            facets[facet, 0] = a if air_left[e] else b
            facets[facet, 1] = b if air_left[e] else a
            if column_end[e, 1] - b >= column_end[e, 0] - a:
                b += 1
                facets[facet, 2] = b
            else:
                a += 1
                facets[facet, 2] = a
            if a > top[e, 0] or b > top[e, 1]:
                return False
            facet += 1
    return True


@numba.njit(cache=True, nogil=True)
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
