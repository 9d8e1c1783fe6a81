"""Where the levels of a column are given: ground, roofs, and the columns of seams (our steps 3.2 to 3.4).

A surface is what cells stand on: the ground, or the roof of one building (a part of a house). A column has a node
for every surface that its vertex touches, and surfaces of one height share a node; its top comes on top of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.weld import least_steps, weld_heights
from pipeline.data.mesh import PlaneMesh
from pipeline.data.roofs import Roofs, Weld, roof_heights
from pipeline.plane_mesh.edges import plane_edges

# What a level is.
FREE, GROUND_LEVEL, ROOF_LEVEL, TOP_LEVEL = range(4)
ON_GROUND = -1  # in place of a building's row: open ground
ORDER_ROUNDS = 20  # of joining two roofs at one end of an edge, where they change order along it


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surfaces that each of ``n`` columns touches, and at which level."""

    start: NDArray[np.int64]  #: (n + 1,): column ``i`` has the surfaces ``start[i]`` to ``start[i + 1]``
    #: (start[-1],): row of the building whose roof it is, `ON_GROUND` for the ground; ascending in every column
    building: NDArray[np.int64]
    level: NDArray[np.int32]  #: (start[-1],): level of the column, counted from below


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels of ``n`` columns."""

    start: NDArray[np.int64]  #: (n + 1,): column ``i`` has the levels ``start[i]`` to ``start[i + 1]``
    z: NDArray[np.float64]  #: (start[-1],): heights (m), ascending in every column
    #: (start[-1],): `GROUND_LEVEL`, `ROOF_LEVEL`, `TOP_LEVEL`, or `FREE`: a level that may move
    kind: NDArray[np.int8]
    #: (start[-1],): what columns are merged by (`ColumnMesh.key`); for most levels their heights
    key: NDArray[np.float64]
    surfaces: Surfaces  #: which levels stand for which ground or roof


@dataclass(frozen=True, eq=False)
class Nodes:
    """The given heights of ``n`` columns, without their tops."""

    start: NDArray[np.int64]  #: (n + 1,): column ``i`` has the nodes ``start[i]`` to ``start[i + 1]``
    z: NDArray[np.float64]  #: (start[-1],): where each stands (m); ascending in every column
    kind: NDArray[np.int8]  #: (start[-1],): `GROUND_LEVEL` or `ROOF_LEVEL`
    level: NDArray[np.int32]  #: (start[-1],): its level in a column that is given; -1 in others
    of_corner: NDArray[np.int64]  #: (m, 3): the node where a triangle's cells begin at each corner


@dataclass(frozen=True, eq=False)
class NodeMoves:
    """How nodes differ from the surfaces that they are for."""

    #: (k,): how far the node of each surface of each column stands above that surface (m); 0 for most
    distance: NDArray[np.float64]
    #: pairs of roofs that were joined at one end of an edge, since they change order along it
    joined_for_order: int
    crossed: int  #: edges along which two roofs still change order, both ends being given


@dataclass(frozen=True, eq=False)
class SeamColumns:
    """Columns that a tile takes over as they are."""

    vertex: NDArray[np.int32]  #: (k,): vertices of the tile's plane mesh, each once
    levels: Levels  #: their ``k`` columns, with a level for each surface that any tile has there


def no_seam() -> SeamColumns:
    """Return the seam of a mesh without neighbours."""
    return SeamColumns(np.empty(0, np.int32), join_levels([]))


def bare_levels(start: NDArray[np.int64], z: NDArray[np.float64]) -> Levels:
    """Levels that stand for no surface, all free, merged by their heights."""
    none = Surfaces(np.zeros(len(start), np.int64), np.empty(0, np.int64), np.empty(0, np.int32))
    return Levels(start, z, np.zeros(len(z), np.int8), z, none)


def collect_surfaces(plane: PlaneMesh, bottom: NDArray[np.int32]) -> Surfaces:
    """Collect the surfaces of each column from the triangles that stand on them.

    Parameters
    ----------
    bottom : int32, (m, 3)
        Level where a triangle's cells begin at each corner.
    """
    key, first = np.unique(_surface_keys(plane), return_index=True)
    column, building = _split_keys(key, plane)
    start = np.searchsorted(column, np.arange(len(plane.xy) + 1)).astype(np.int64)
    return Surfaces(start, building, bottom.ravel()[first])


def find_surface_levels(levels: Levels, row: NDArray[np.int64], building: NDArray[np.int64]) -> NDArray[np.int32]:
    """Find the level that stands for the ground or a building's roof in some columns.

    Parameters
    ----------
    row : int64, (k,)
        The columns that are asked.
    building : int64, (k,)
        Row of the building, or `ON_GROUND`.

    Returns
    -------
    int32, (k,)
        Level of the column, counted from below; -1 where it has none.
    """
    surfaces = levels.surfaces
    column = np.repeat(np.arange(len(surfaces.start) - 1), np.diff(surfaces.start))
    width = max(int(surfaces.building.max(initial=-1)), int(building.max(initial=-1))) + 2
    have = column * width + surfaces.building + 1
    wanted = row * width + building + 1
    if not len(have):
        return np.full(len(wanted), -1, np.int32)
    at = np.searchsorted(have, wanted).clip(max=len(have) - 1)
    found: NDArray[np.int32] = np.where(have[at] == wanted, surfaces.level[at], -1).astype(np.int32)
    return found


def take_columns(levels: Levels, vertices: NDArray[np.int32]) -> Levels:
    """Return the columns of some vertices, in the order of these."""
    start, rows = _take_rows(levels.start, vertices)
    surface_start, surface_rows = _take_rows(levels.surfaces.start, vertices)
    surfaces = levels.surfaces
    return Levels(
        start,
        levels.z[rows],
        levels.kind[rows],
        levels.key[rows],
        Surfaces(surface_start, surfaces.building[surface_rows], surfaces.level[surface_rows]),
    )


def join_levels(parts: Sequence[Levels]) -> Levels:
    """Put the columns of several parts one after the other."""
    surfaces = [part.surfaces for part in parts]
    return Levels(
        _join_starts([part.start for part in parts]),
        np.concatenate([np.empty(0), *(part.z for part in parts)]),
        np.concatenate([np.empty(0, np.int8), *(part.kind for part in parts)]),
        np.concatenate([np.empty(0), *(part.key for part in parts)]),
        Surfaces(
            _join_starts([part.start for part in surfaces]),
            np.concatenate([np.empty(0, np.int64), *(part.building for part in surfaces)]),
            np.concatenate([np.empty(0, np.int32), *(part.level for part in surfaces)]),
        ),
    )


def place_nodes(
    plane: PlaneMesh,
    roofs: Roofs,
    ground: NDArray[np.float64],
    seam: SeamColumns,
    *,
    spacing: NDArray[np.float64],
    least_gap: NDArray[np.float64],
    weld: Weld | None = None,
) -> tuple[Nodes, NodeMoves]:
    """Find the given heights of every column: those of its surfaces, joined or parted where they are close.

    Parameters
    ----------
    roofs : Roofs
        Roof of each building.
    ground : float64, (n,)
        Terrain at each vertex (m).
    seam : SeamColumns
        Columns whose nodes are given.
    spacing : float64, (n,)
        Vertical spacing of each column (m).
    least_gap : float64, (n,)
        Least distance of two nodes of a column (m).
    weld : Weld, optional
        How roofs that meet at a vertex are joined and parted. Without it, equal heights alone are joined.

    Returns
    -------
    Nodes
        Nodes of all columns.
    NodeMoves
        How far they are from the surfaces.

    Raises
    ------
    ValueError
        If a triangle stands on a surface that a given column lacks.

    Notes
    -----
    The ground never moves. From there upwards, a node that is not `least_gap` above the one before it is put that
    much above it: where roofs keep that distance from each other and from the terrain at their walls, all are
    exact. The rule sees one column alone.

    Two roofs that change order along an edge between their buildings would cross there, and each would have a
    wall in the other's air: they are joined at the end where they are closer, unless that end is given, until none
    cross.
    """
    given = np.zeros(len(plane.xy), np.bool_)
    given[seam.vertex] = True
    own, index = np.unique(_surface_keys(plane), return_inverse=True)
    vertex, building = _split_keys(own, plane)
    start = np.searchsorted(vertex, np.arange(len(plane.xy) + 1)).astype(np.int64)
    on_ground = building == ON_GROUND
    wanted = np.where(on_ground, ground[vertex], np.nan)
    wanted[~on_ground] = roof_heights(roofs, building[~on_ground], plane.xy[vertex[~on_ground]])
    z = wanted.copy()
    level = np.full(len(own), -1, np.int32)
    at_seam = np.flatnonzero(given[vertex])
    row = np.full(len(plane.xy), -1, np.int64)
    row[seam.vertex] = np.arange(len(seam.vertex))
    level[at_seam] = find_surface_levels(seam.levels, row[vertex[at_seam]], building[at_seam])
    if (level[at_seam] < 0).any():
        raise ValueError("a triangle at a seam stands on a surface that the seam's columns lack")
    z[at_seam] = seam.levels.z[seam.levels.start[row[vertex[at_seam]]] + level[at_seam]]
    law = (given, least_steps(weld, spacing), least_gap, 0.0 if weld is None else weld.clearance)
    node_start, node_z, node_of = weld_heights(start, on_ground, z, *law)
    joined = 0
    ends = _party_ends(plane, own, given) if weld is not None else np.empty((0, 2, 2), np.int64)
    crossed = _find_crossed(node_of, ends)
    for _ in range(ORDER_ROUNDS):
        free = ~given[vertex[ends[crossed, :, 0]]]
        mine = crossed[free.any(axis=1)]
        if not len(mine):
            break
        gap = np.abs(z[ends[mine, :, 0]] - z[ends[mine, :, 1]])
        gap[~free[free.any(axis=1)]] = np.inf
        for e, k in zip(mine.tolist(), gap.argmin(axis=1).tolist(), strict=True):
            one, two = ends[e, k]
            z[one] = z[two] = 0.5 * (z[one] + z[two])
        joined += len(mine)
        node_start, node_z, node_of = weld_heights(start, on_ground, z, *law)
        crossed = _find_crossed(node_of, ends)
    kind = np.full(len(node_z), ROOF_LEVEL, np.int8)
    kind[node_of[on_ground]] = GROUND_LEVEL
    node_level = np.full(len(node_z), -1, np.int32)
    node_level[node_of[at_seam]] = level[at_seam]
    nodes = Nodes(node_start, node_z, kind, node_level, node_of[index.reshape(-1, 3)])
    return nodes, NodeMoves(node_z[node_of] - wanted, joined, len(crossed))


def add_floors(
    nodes: Nodes, ground: NDArray[np.float64], given: NDArray[np.bool_], gap: NDArray[np.float64]
) -> Nodes:
    """Give each column that begins at a roof a node below it, at the terrain: the floor of the building there.

    Parameters
    ----------
    nodes : Nodes
        Nodes of ``n`` columns.
    ground : float64, (n,)
        Terrain at each vertex (m).
    given : bool, (n,)
        Columns that are given: they have their floors.
    gap : float64, (n,)
        Least distance of two nodes (m): where terrain inside a building comes closer to its roof, the floor is
        that much below it.
    """
    first = nodes.start[:-1]
    bare = (nodes.kind[first] != GROUND_LEVEL) & ~given
    floor = np.minimum(ground, nodes.z[first] - gap)[bare]
    at, before = first[bare], np.cumsum(bare)
    column = np.repeat(np.arange(len(bare)), np.diff(nodes.start))
    return Nodes(
        nodes.start + np.concatenate(([0], before)),
        np.insert(nodes.z, at, floor),
        np.insert(nodes.kind, at, GROUND_LEVEL),
        np.insert(nodes.level, at, -1),
        nodes.of_corner + before[column[nodes.of_corner]],
    )


def _surface_keys(plane: PlaneMesh) -> NDArray[np.int64]:
    """Vertex and building of every corner of every triangle as one number, (3 m,)."""
    width = int(plane.building.max(initial=-1)) + 2
    keys: NDArray[np.int64] = plane.triangles.astype(np.int64) * width + (plane.building[:, None] + np.int64(1))
    return keys.ravel()


def _split_keys(key: NDArray[np.int64], plane: PlaneMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Vertex and building of such numbers."""
    width = int(plane.building.max(initial=-1)) + 2
    return key // width, key % width - 1


def _party_ends(plane: PlaneMesh, own: NDArray[np.int64], given: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Surfaces of both buildings at both ends of each edge between two buildings: rows, (e, end, building)."""
    edges, of_triangle = plane_edges(plane.triangles)
    order = np.argsort(of_triangle.ravel(), kind="stable")
    first = np.searchsorted(of_triangle.ravel()[order], np.arange(len(edges)))
    two = np.flatnonzero(np.bincount(of_triangle.ravel(), minlength=len(edges)) == 2)
    sides = plane.building[np.stack((order[first[two]], order[first[two] + 1]), axis=1) // 3].astype(np.int64)
    party = (sides >= 0).all(axis=1) & (sides[:, 0] != sides[:, 1])
    edge, sides = two[party], sides[party]
    width = int(plane.building.max(initial=-1)) + 2
    wanted = edges[edge].astype(np.int64)[:, :, None] * width + sides[:, None, :] + 1
    rows: NDArray[np.int64] = np.searchsorted(own, wanted)
    return rows


def _find_crossed(node_of: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges along which two roofs change order."""
    order = np.sign(node_of[ends[:, :, 0]] - node_of[ends[:, :, 1]])
    return np.flatnonzero(order[:, 0] * order[:, 1] < 0)


def _take_rows(start: NDArray[np.int64], chosen: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where the rows of chosen groups start when put one after the other, and these rows."""
    count = np.diff(start)[chosen]
    first = np.concatenate(([0], np.cumsum(count))).astype(np.int64)
    return first, np.arange(first[-1]) + np.repeat(start[chosen] - first[:-1], count)


def _join_starts(starts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    count = np.concatenate([np.empty(0, np.int64), *(np.diff(start) for start in starts)])
    return np.concatenate(([0], np.cumsum(count))).astype(np.int64)
