"""What lies beyond a tile's seams: where the neighbours' cells begin there, for the boundary (step 3.6)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import SeamColumns, find_surface_levels
from pipeline.data.mesh import PlaneMesh, SeamEdges
from pipeline.plane_mesh.edges import plane_edges
from stitch.seams.seams import Seam, find_vertices


@dataclass(frozen=True, eq=False)
class Side:
    """A seam as one of its two tiles sees it."""

    seam: Seam  #: a seam within the region
    #: whether the tile is on the seam's left, looking from its first corner to its last. A tile is on the left of
    #: its southern and eastern seam, and on the right of its northern and western one
    left: bool
    missing: bool = False  #: whether the tile on the other side is not there


def label_beyond(seam: Seam, *, left: bool) -> NDArray[np.int32]:
    """Tell which building lies beyond each edge of a seam.

    Parameters
    ----------
    seam : Seam
        A seam within the region.
    left : bool
        As in `Side`.

    Returns
    -------
    int32, (k - 1,)
        Row of the building on the other side of the edge from vertex ``i`` to ``i + 1``, -1 on open ground.

    Raises
    ------
    ValueError
        If the seam's triangles lack one beside an edge.

    Notes
    -----
    The seam was found in a mesh whose edges are walls too, so a triangle of it beside an edge lies in the same
    house as the neighbour's. Cost is that of the seam's triangles.
    """
    ring, ends = seam.ring, np.stack((seam.vertex[:-1], seam.vertex[1:]), axis=1)
    edges, of_triangle = plane_edges(ring.triangles)
    n = np.int64(len(ring.xy))
    low, high = ends.min(axis=1), ends.max(axis=1)
    key = edges[:, 0] * n + edges[:, 1]
    row = np.searchsorted(key, low * n + high).clip(max=len(key) - 1)
    edge_to_seam = np.full(len(edges), -1)
    edge_to_seam[row[key[row] == low * n + high]] = np.flatnonzero(key[row] == low * n + high)
    triangle, side = np.nonzero(edge_to_seam[of_triangle] >= 0)
    at = edge_to_seam[of_triangle[triangle, side]]
    start, end = ring.xy[ends[at, 0]], ring.xy[ends[at, 1]]
    opposite = ring.xy[ring.triangles[triangle].sum(axis=1) - ends[at].sum(axis=1)]
    along, across = end - start, opposite - start
    is_left = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0] > 0
    beyond = is_left != left
    if len(np.unique(at[beyond])) != len(ends) or beyond.sum() != len(ends):
        raise ValueError("the seam's triangles lack one beside an edge")
    label = np.empty(len(ends), np.int32)
    label[at[beyond]] = ring.building[triangle[beyond]]
    return label


def find_seam_edges(
    plane: PlaneMesh,
    sides: Sequence[Side],
    columns: SeamColumns,
    numbers: NDArray[np.int64],
) -> SeamEdges:
    """Find a tile's seams among its edges, and where the cells beyond them begin.

    Parameters
    ----------
    plane : PlaneMesh
        The tile's plane mesh.
    sides : sequence of Side
        Its seams within the region, each with the side that the tile is on.
    columns : SeamColumns
        Their columns (`tile_columns`).
    numbers : int64, (b,)
        Numbers of the buildings of the city model that the seams were found with.

    Returns
    -------
    SeamEdges
        In the order of the seams.

    Raises
    ------
    ValueError
        If the mesh lacks a vertex of a seam, or a column a level for the ground or roof beyond.

    Notes
    -----
    A column of a seam tells at which level which ground or roof is, so heights are not searched for: also a roof
    that stands higher or lower in a column than it should is found.
    """
    vertices, rows, missing = [], [], []
    for side in sides:
        row = label_beyond(side.seam, left=side.left)
        at = find_vertices(plane.xy, side.seam.xy)
        vertices.append(np.sort(np.stack((at[:-1], at[1:]), axis=1), axis=1))
        rows.append(row.astype(np.int64))
        missing.append(np.full(len(row), side.missing))
    ends = np.concatenate([np.empty((0, 2), np.int32), *vertices])
    building = np.concatenate([np.empty(0, np.int64), *rows])
    bottom = find_levels(columns, ends, building)
    return SeamEdges(
        ends,
        bottom,
        np.append(numbers, -1)[building],
        np.concatenate([np.empty(0, np.bool_), *missing]),
    )


def find_levels(
    columns: SeamColumns, vertices: NDArray[np.int32], building: NDArray[np.int64]
) -> NDArray[np.int32]:
    """Find the level that stands for the ground or a roof in given columns.

    Parameters
    ----------
    columns : SeamColumns
        The columns.
    vertices : int32, (k, 2)
        Vertices that have such a column.
    building : int64, (k,)
        Row of the building whose roof it is, -1 for the ground.

    Returns
    -------
    int32, (k, 2)
        Levels, counted from below.

    Raises
    ------
    ValueError
        If a vertex has no given column, or its column no such level.
    """
    order = np.argsort(columns.vertex)
    row = order[np.searchsorted(columns.vertex, vertices.ravel(), sorter=order).clip(max=max(len(order) - 1, 0))]
    level = find_surface_levels(columns.levels, row, np.repeat(building, 2))
    if (columns.vertex[row] != vertices.ravel()).any() or (level < 0).any():
        raise ValueError("a column of a seam lacks a level for the ground or roof beyond the seam")
    return level.reshape(-1, 2)
