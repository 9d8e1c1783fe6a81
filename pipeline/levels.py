"""The levels of adaptive columns: exact at ground and roofs, evenly spaced between (our steps 3.2 to 3.4).

A surface is what cells stand on: the ground, written as a height of minus infinity, or the roof at some
height. A column has a node for every surface that its vertex touches, and its top.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.mesh import PlaneMesh

GROUND_SURFACE = -np.inf
TOP_SURFACE = np.inf
N_PHASES = 3
PHASE_SWEEPS = 12


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


def fill_levels(
    nodes: Nodes,
    top: NDArray[np.float64],
    spacing: NDArray[np.float64],
    shift: NDArray[np.float64],
    seam: SeamColumns,
) -> tuple[Levels, NDArray[np.int32]]:
    """Space levels evenly between the nodes of each column and up to its top.

    Parameters
    ----------
    nodes : Nodes
        Given heights.
    top : float64, (n,)
        Top of the domain (m), above the last node.
    spacing : float64, (n,)
        Wanted distance of levels (m); the closest whole number of steps is made, at least one.
    shift : float64, (n,)
        By which part of a step, between -1/2 and 1/2, the levels between two nodes are shifted.
    seam : SeamColumns
        Columns that are given: copied bit for bit.

    Returns
    -------
    Levels
        The columns.
    int32, (m, 3)
        For each corner of a triangle, the level of its column where its cells begin.
    """
    given = np.full(len(top), -1, np.int64)
    given[seam.vertex] = np.arange(len(seam.vertex))
    steps, start = _count_levels(nodes.start, nodes.z, top, spacing, given, seam.levels.start)
    z, surface = np.empty(start[-1]), np.full(start[-1], np.nan)
    level = np.empty(len(nodes.z), np.int64)
    _fill(
        nodes.start, nodes.surface, nodes.z, top, shift, steps,
        given, seam.levels.start, seam.levels.z, seam.levels.surface,
        start, z, surface, level,
    )  # fmt: skip
    return Levels(start, z, surface), level[nodes.of_corner].astype(np.int32)


def stagger_columns(n: int, edges: NDArray[np.int32]) -> NDArray[np.float64]:
    """Give neighbouring columns different thirds of a step, as far as three values can.

    Parameters
    ----------
    n : int
        Number of columns.
    edges : int32, (e, 2)
        Edges of the plane mesh.

    Returns
    -------
    float64, (n,)
        -1/3, 0 or 1/3.

    Notes
    -----
    A vertex takes, in turns, the value that the fewest of its neighbours have. Whole numbers only: the
    result is the same on every machine.
    """
    both = np.concatenate((edges, edges[:, ::-1]))
    both = both[np.argsort(both[:, 0], kind="stable")]
    start = np.searchsorted(both[:, 0], np.arange(n + 1)).astype(np.int64)
    phase = (np.arange(n) % N_PHASES).astype(np.int8)
    _repel_phases(start, np.ascontiguousarray(both[:, 1]), phase, PHASE_SWEEPS)
    shift: NDArray[np.float64] = (phase - 1.0) / N_PHASES
    return shift


@numba.njit(cache=True, nogil=True)
def _part_nodes(start: NDArray[np.int64], least_gap: NDArray[np.float64], z: NDArray[np.float64]) -> None:
    for i in range(len(start) - 1):
        for k in range(start[i] + 1, start[i + 1]):
            if z[k] - z[k - 1] < least_gap[i]:
                z[k] = z[k - 1] + least_gap[i]


@numba.njit(cache=True, nogil=True)
def _count_levels(
    node_start: NDArray[np.int64],
    node_z: NDArray[np.float64],
    top: NDArray[np.float64],
    spacing: NDArray[np.float64],
    given: NDArray[np.int64],
    seam_start: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Steps above each node, and the first level of each column."""
    n = len(top)
    steps = np.zeros(len(node_z), np.int64)
    start = np.zeros(n + 1, np.int64)
    for i in range(n):
        count = 1
        for k in range(node_start[i], node_start[i + 1]):
            above = node_z[k + 1] if k + 1 < node_start[i + 1] else top[i]
            steps[k] = max(1, int(np.floor((above - node_z[k]) / spacing[i] + 0.5)))
            count += steps[k]
        if given[i] >= 0:
            count = seam_start[given[i] + 1] - seam_start[given[i]]
        start[i + 1] = start[i] + count
    return steps, start


@numba.njit(cache=True, nogil=True)
def _fill(
    node_start: NDArray[np.int64],
    node_surface: NDArray[np.float64],
    node_z: NDArray[np.float64],
    top: NDArray[np.float64],
    shift: NDArray[np.float64],
    steps: NDArray[np.int64],
    given: NDArray[np.int64],
    seam_start: NDArray[np.int64],
    seam_z: NDArray[np.float64],
    seam_surface: NDArray[np.float64],
    start: NDArray[np.int64],
    z: NDArray[np.float64],
    surface: NDArray[np.float64],
    level: NDArray[np.int64],
) -> None:
    for i in range(len(top)):
        if given[i] >= 0:
            first, node = seam_start[given[i]], node_start[i]
            for k in range(start[i + 1] - start[i]):
                z[start[i] + k] = seam_z[first + k]
                surface[start[i] + k] = seam_surface[first + k]
                if node < node_start[i + 1] and seam_surface[first + k] == node_surface[node]:
                    level[node] = k
                    node += 1
            continue
        at = start[i]
        for node in range(node_start[i], node_start[i + 1]):
            level[node] = at - start[i]
            below = node_z[node]
            above = node_z[node + 1] if node + 1 < node_start[i + 1] else top[i]
            step = (above - below) / steps[node]
            z[at] = below
            surface[at] = node_surface[node]
            for k in range(1, steps[node]):
                z[at + k] = below + (k + shift[i]) * step
            at += steps[node]
        z[at] = top[i]
        surface[at] = TOP_SURFACE


@numba.njit(cache=True, nogil=True)
def _repel_phases(
    start: NDArray[np.int64], neighbour: NDArray[np.int32], phase: NDArray[np.int8], sweeps: int
) -> None:
    count = np.zeros(N_PHASES, np.int64)
    for _ in range(sweeps):
        changed = False
        for i in range(len(phase)):
            count[:] = 0
            for k in range(start[i], start[i + 1]):
                count[phase[neighbour[k]]] += 1
            best = phase[i]
            for candidate in range(N_PHASES):
                if count[candidate] < count[best]:
                    best = candidate
            changed |= best != phase[i]
            phase[i] = best
        if not changed:
            return
