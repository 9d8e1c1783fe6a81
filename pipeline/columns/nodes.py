"""Where the levels of a column are given: ground, roofs, and the columns of seams (our steps 3.2 to 3.4).

A surface is what cells stand on: the ground, written as a height of minus infinity, or the roof at some
height. A column has a node for every surface that its vertex touches, and its top.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.mesh import PlaneMesh

GROUND_SURFACE = -np.inf
TOP_SURFACE = np.inf


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels of ``n`` columns.

    Attributes
    ----------
    start : int64, (n + 1,)
        Column ``i`` has the levels ``start[i]`` to ``start[i + 1]``.
    z : float64, (start[-1],)
        Heights (m), ascending in every column.
    surface : float64, (start[-1],)
        What a level stands for: the ground (-inf), the roof at that height (m), the top of the domain (inf),
        or nothing (NaN): it is free to move.
    """

    start: NDArray[np.int64]
    z: NDArray[np.float64]
    surface: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Nodes:
    """The given heights of ``n`` columns, without their tops.

    Attributes
    ----------
    start : int64, (n + 1,)
        Column ``i`` has the nodes ``start[i]`` to ``start[i + 1]``.
    surface : float64, (start[-1],)
        What a node stands for, as in `Levels`; ascending in every column.
    z : float64, (start[-1],)
        Where it stands (m); ascending in every column.
    of_corner : int64, (m, 3)
        The node where a triangle's cells begin at each corner.
    """

    start: NDArray[np.int64]
    surface: NDArray[np.float64]
    z: NDArray[np.float64]
    of_corner: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SeamColumns:
    """Columns that a tile takes over as they are.

    Attributes
    ----------
    vertex : int32, (k,)
        Vertices of the tile's plane mesh, each once.
    levels : Levels
        Their ``k`` columns, with a level for each surface that any tile has there.
    """

    vertex: NDArray[np.int32]
    levels: Levels


def no_seam() -> SeamColumns:
    """Return the seam of a mesh without neighbours."""
    return SeamColumns(np.empty(0, np.int32), Levels(np.zeros(1, np.int64), np.empty(0), np.empty(0)))


def triangle_surfaces(plane: PlaneMesh, roof: NDArray[np.float64]) -> NDArray[np.float64]:
    """Surface under each triangle: its building's roof height (m), -inf on open ground."""
    return np.where(plane.building >= 0, np.append(roof, GROUND_SURFACE)[plane.building], GROUND_SURFACE)


def take_columns(levels: Levels, vertices: NDArray[np.int32]) -> Levels:
    """Return the columns of some vertices, in the order of these."""
    count = np.diff(levels.start)[vertices]
    start = np.concatenate(([0], np.cumsum(count)))
    rows = np.arange(start[-1]) + np.repeat(levels.start[vertices] - start[:-1], count)
    return Levels(start, levels.z[rows], levels.surface[rows])


def join_levels(parts: Sequence[Levels]) -> Levels:
    """Put the columns of several parts one after the other."""
    count = np.concatenate([np.diff(part.start) for part in parts] or [np.empty(0, np.int64)])
    return Levels(
        np.concatenate(([0], np.cumsum(count))).astype(np.int64),
        np.concatenate([part.z for part in parts] or [np.empty(0)]),
        np.concatenate([part.surface for part in parts] or [np.empty(0)]),
    )


def place_nodes(
    plane: PlaneMesh,
    surface: NDArray[np.float64],
    ground: NDArray[np.float64],
    seam: SeamColumns,
    *,
    least_gap: NDArray[np.float64],
) -> tuple[Nodes, NDArray[np.float64]]:
    """Find the given heights of every column, and part those that come too close.

    Parameters
    ----------
    plane : PlaneMesh
        Plane mesh.
    surface : float64, (m,)
        Surface under each triangle (`triangle_surfaces`).
    ground : float64, (n,)
        Terrain at each vertex (m).
    seam : SeamColumns
        Columns whose nodes are given.
    least_gap : float64, (n,)
        Least distance of two nodes of a column (m).

    Returns
    -------
    Nodes
        Nodes of all columns.
    float64, (start[-1],)
        How far each stands above the ground or roof that it is for (m); 0 for most.

    Raises
    ------
    ValueError
        If a triangle stands on a surface that a given column lacks.

    Notes
    -----
    The ground never moves, nor does the lowest roof of a column without ground. From there upwards, a node
    that is not `least_gap` above the one before it is put that much above it: where roofs keep that distance
    from each other and from the terrain at their walls, all are exact. The rule sees one column alone, and
    leaves its nodes in the order of the surfaces, so both sides of a wall agree in it everywhere.
    """
    inner = ~np.isnan(seam.levels.surface) & (seam.levels.surface != TOP_SURFACE)
    seam_of_level = np.repeat(seam.vertex, np.diff(seam.levels.start))[inner]
    heights, rank = np.unique(np.concatenate((surface, seam.levels.surface[inner])), return_inverse=True)
    n = len(heights)
    own = (plane.triangles.astype(np.int64) * n + rank[: len(surface), None]).ravel()
    given = seam_of_level.astype(np.int64) * n + rank[len(surface) :]
    if np.isin(np.setdiff1d(own, given) // n, seam.vertex).any():
        raise ValueError("a triangle at a seam stands on a surface that the seam's columns lack")
    key, index = np.unique(np.concatenate((own, given)), return_inverse=True)
    vertex, node_surface = key // n, heights[key % n]
    start = np.searchsorted(vertex, np.arange(len(plane.xy) + 1)).astype(np.int64)
    wanted = np.where(node_surface == GROUND_SURFACE, ground[vertex], node_surface)
    z = wanted.copy()
    _part_nodes(start, least_gap, z)
    z[index[len(own) :]] = seam.levels.z[inner]
    return Nodes(start, node_surface, z, index[: len(own)].reshape(-1, 3)), z - wanted


@kernel
def _part_nodes(start: NDArray[np.int64], least_gap: NDArray[np.float64], z: NDArray[np.float64]) -> None:
    for i in range(len(start) - 1):
        for k in range(start[i] + 1, start[i + 1]):
            if z[k] - z[k - 1] < least_gap[i]:
                z[k] = z[k - 1] + least_gap[i]
