"""Order keys: where a wall's top edge is steep, columns are merged so that both sides of the wall agree.

Columns are merged by the middles of their segments. Beside a wall the two sides begin at different levels, and
above the wall's top edge both must make the same faces. They do if the merge of the side that begins lower passes
through both ends of that edge: the segment above its end in one column comes after the segment below its end in
the other column, and the other way round. For level top edges this is so; steep ones may be passed by, and both
sides then have facets above the roof that overlap: a baffle in the air that is closed: no volume tells of it.

So levels beside such edges get keys of their own: columns are merged by keys, cells stand at the heights. A key
function of the column alone keeps the mesh conforming, and ascending keys keep every cell upright.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.mesh import ColumnMesh
from pipeline.plane_mesh.edges import plane_edges

SWEEPS = 400
LEAST_STEP = 0.02  # m between keys of a column, and by which one middle must be above another


def wall_gates(mesh: ColumnMesh, *, floors: bool = False) -> NDArray[np.int64]:
    """Find the edges over which the two sides begin at different levels, within the mesh.

    Parameters
    ----------
    floors : bool
        Whether buildings have cells, which begin at the lowest level of each column: then those of the higher one
        must make the same faces as those of a lower one beside it, up to the lower roof.

    Returns
    -------
    int64, (g, 2, 2)
        For each such edge, at each of its ends, the level of `ColumnMesh.z` where the lower side begins and that
        where the upper side does. Edges along which the sides change order are left out. With floors, rows follow
        for edges between two buildings: the floor, and the lower roof.
    """
    edges, of_triangle = plane_edges(mesh.plane.triangles)
    corners = np.array([[0, 1], [0, 2], [1, 2]])  # of a triangle, at the ends of each of its edges
    first = mesh.z_start[mesh.plane.triangles] + mesh.bottom
    order = np.argsort(of_triangle.ravel(), kind="stable")
    begin = np.searchsorted(of_triangle.ravel()[order], np.arange(len(edges)))
    two = np.flatnonzero(np.bincount(of_triangle.ravel(), minlength=len(edges)) == 2)
    sides = np.stack((order[begin[two]], order[begin[two] + 1]), axis=1)
    levels = first[sides[:, :, None] // 3, corners[sides % 3]]  # edge, side, end
    rise = levels[:, 1] - levels[:, 0]
    gates = (rise != 0).any(axis=1) & ~((rise > 0).any(axis=1) & (rise < 0).any(axis=1))
    ends = np.stack((levels.min(axis=1), levels.max(axis=1)), axis=2)
    result: NDArray[np.int64] = ends[gates]
    if floors:
        lower = result[:, :, 0]
        floor = mesh.z_start[np.searchsorted(mesh.z_start, lower, side="right") - 1]
        party = (lower > floor).all(axis=1)
        result = np.concatenate((result, np.stack((floor, lower), axis=2)[party]))
    return result


def set_order_keys(
    mesh: ColumnMesh, key: NDArray[np.float64], given: NDArray[np.bool_], gates: NDArray[np.int64]
) -> tuple[ColumnMesh, int]:
    """Give the levels beside steep wall tops keys by which both sides of the wall agree.

    Parameters
    ----------
    mesh : ColumnMesh
        Columns that are merged by heights.
    key : float64, (z_start[-1],)
        Keys to begin with: heights, those of columns that are given, or those that were set before levels moved.
    given : bool, (n,)
        Columns whose keys stay.
    gates : int64, (g, 2, 2)
        Edges to see to, of those of `wall_gates`.

    Returns
    -------
    ColumnMesh
        The mesh, with keys where one differs from its level's height.
    int
        Ends of edges that the merge still passes by.

    Notes
    -----
    Keys are pushed apart in sweeps over the edges, both ends alike where both are free. The highest key of a
    column stays, and so does the lowest one where it is the ground, which soil has too. Between two roofs the
    lowest one may sink: a wall that begins there may taper to nothing at a given column that stands lower.
    A sweep costs O(edges).
    """
    key = key.copy()
    column = np.repeat(np.arange(len(mesh.plane.xy)), np.diff(mesh.z_start))
    outdoors = np.zeros(len(given), np.bool_)
    outdoors[mesh.plane.triangles[mesh.plane.building < 0]] = True
    _sort_keys(key, mesh.z_start, given, LEAST_STEP)
    unmet = _push_apart(gates, mesh.z_start, column, given, outdoors, key, SWEEPS, LEAST_STEP) if len(gates) else 0
    return replace(mesh, key=None if np.array_equal(key, mesh.z) else key), unmet


@kernel
def _sort_keys(key: NDArray[np.float64], start: NDArray[np.int64], given: NDArray[np.bool_], least: float) -> None:
    """Make keys ascend where they do not, in columns that are not given; the ends of a column stay."""
    for i in range(len(start) - 1):
        if given[i]:
            continue
        low, high = start[i], start[i + 1] - 1
        for k in range(low + 1, high):
            if key[k] <= key[k - 1]:
                key[k] = key[k - 1] + least
        for k in range(high - 1, low, -1):
            if key[k] >= key[k + 1]:
                key[k] = key[k + 1] - least


@kernel
def _push_apart(
    gates: NDArray[np.int64],
    start: NDArray[np.int64],
    column: NDArray[np.int64],
    given: NDArray[np.bool_],
    outdoors: NDArray[np.bool_],
    key: NDArray[np.float64],
    sweeps: int,
    least: float,
) -> int:
    """Move keys until the merge passes through both ends of every gate; how many conditions are left."""
    for _ in range(sweeps):
        moved = False
        for g in range(len(gates)):
            for k in range(2):
                a, b = gates[g, k, 1], gates[g, 1 - k, 1]
                if b == gates[g, 1 - k, 0]:
                    continue  # no wall at that end: nothing lies below its top
                missing = key[b - 1] + key[b] + least - key[a] - key[a + 1]
                if missing <= 0.5 * least:
                    continue
                free_a, free_b = not given[column[a]], not given[column[b]]
                if not (free_a or free_b):
                    continue
                moved = True
                part = missing / (4.0 if free_a and free_b else 2.0)
                if free_a:
                    _raise_keys(key, a, start[column[a]], start[column[a] + 1] - 1, part, least)
                if free_b:
                    low, high = start[column[b]], start[column[b] + 1] - 1
                    _lower_keys(key, b, low, high, not outdoors[column[b]], part, least)
        if not moved:
            break
    left = 0
    for g in range(len(gates)):
        for k in range(2):
            a, b = gates[g, k, 1], gates[g, 1 - k, 1]
            left += b != gates[g, 1 - k, 0] and key[b - 1] + key[b] >= key[a] + key[a + 1]
    return left


@kernel(inline="always")
def _raise_keys(key: NDArray[np.float64], a: int, low: int, high: int, part: float, least: float) -> None:
    """Raise the keys of level `a` and the one above it, and what is in their way; the ends of the column stay."""
    if a > low:
        key[a] += part
    if a + 1 < high:
        key[a + 1] += part
    for i in range(a + 2, high):
        if key[i] >= key[i - 1] + least:
            break
        key[i] = key[i - 1] + least
    for i in range(high - 1, low, -1):
        if key[i] <= key[i + 1] - least:
            break
        key[i] = key[i + 1] - least


@kernel(inline="always")
def _lower_keys(
    key: NDArray[np.float64], b: int, low: int, high: int, sinks: bool, part: float, least: float
) -> None:
    """Lower the keys of level `b` and the one below it, and what is in their way; the lowest if it may sink."""
    if b < high:
        key[b] -= part
    if b - 1 > low or sinks:
        key[b - 1] -= part
    for i in range(b - 2, low - sinks, -1):
        if key[i] <= key[i + 1] - least:
            break
        key[i] = key[i + 1] - least
    for i in range(low + 1, high):
        if key[i] >= key[i - 1] + least:
            break
        key[i] = key[i - 1] + least
