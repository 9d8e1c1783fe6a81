"""What lies beyond a tile's seams: where the neighbours' cells begin there, for the boundary (step 3.6)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import GROUND_SURFACE, SeamColumns
from pipeline.data.mesh import PlaneMesh, SeamEdges
from pipeline.plane_mesh.edges import plane_edges
from stitch.seams.seams import Seam, find_vertices


@dataclass(frozen=True, eq=False)
class Side:
    """A seam as one of its two tiles sees it.

    Attributes
    ----------
    seam : Seam
        A seam within the region.
    left : bool
        Whether the tile is on the seam's left, looking from its first corner to its last. A tile is on the
        left of its southern and eastern seam, and on the right of its northern and western one.
    missing : bool
        Whether the tile on the other side is not there.
    """

    seam: Seam
    left: bool
    missing: bool = False


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
    roof: NDArray[np.float64],
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
    roof : float64, (b,)
        Roof heights (m) of the city model that the seams were found with.
    numbers : int64, (b,)
        Numbers of its buildings.

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
    A column of a seam tells for each level which ground or roof it stands for, so heights are not searched for:
    also a roof that stands higher in a column than it should is found.
    """
    vertices, surface, building, missing = [], [], [], []
    for side in sides:
        row = label_beyond(side.seam, left=side.left)
        at = find_vertices(plane.xy, side.seam.xy)
        vertices.append(np.sort(np.stack((at[:-1], at[1:]), axis=1), axis=1))
        surface.append(np.append(roof, GROUND_SURFACE)[row])
        building.append(np.append(numbers, -1)[row])
        missing.append(np.full(len(row), side.missing))
    ends = np.concatenate([np.empty((0, 2), np.int32), *vertices])
    bottom = find_levels(columns, ends, np.concatenate([np.empty(0), *surface]))
    return SeamEdges(
        ends,
        bottom,
        np.concatenate([np.empty(0, np.int64), *building]),
        np.concatenate([np.empty(0, np.bool_), *missing]),
    )


def find_levels(
    columns: SeamColumns, vertices: NDArray[np.int32], surface: NDArray[np.float64]
) -> NDArray[np.int32]:
    """Find the level that stands for the ground or a roof in given columns.

    Parameters
    ----------
    columns : SeamColumns
        The columns.
    vertices : int32, (k, 2)
        Vertices that have such a column.
    surface : float64, (k,)
        The roof's height (m), or `GROUND_SURFACE`.

    Returns
    -------
    int32, (k, 2)
        Levels, counted from below.

    Raises
    ------
    ValueError
        If a vertex has no given column, or its column no such level.
    """
    wanted = np.repeat(surface, 2)
    order = np.argsort(columns.vertex)
    row = order[np.searchsorted(columns.vertex, vertices.ravel(), sorter=order).clip(max=max(len(order) - 1, 0))]
    start, count = columns.levels.start[row], np.diff(columns.levels.start)[row]
    level = np.full(len(row), -1, np.int32)
    for k in range(int(count.max(initial=0))):
        there = k < count
        there[there] = columns.levels.surface[start[there] + k] == wanted[there]
        level[there] = k
    if (columns.vertex[row] != vertices.ravel()).any() or (level < 0).any():
        raise ValueError("a column of a seam lacks a level for the ground or roof beyond the seam")
    return level.reshape(-1, 2)
