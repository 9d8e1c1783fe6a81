"""Seams: the common border of two tiles, its vertices and the triangles that it was found in (before step 3.1)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.mesh import PlaneMesh
from pipeline.plane_mesh.plane import order_plane
from pipeline.plane_mesh.sizes import SizeField, largest_size, local_sizes
from stitch.tiling.corners import Corner
from stitch.tiling.grid import Bounds, SeamKey, TileGrid, is_border
from stitch.tiling.paths import find_path
from stitch.tiling.strips import NO_EDGES, Strip, centres, improve_around, mesh_strip, strip_core
from stitch.tiling.walls import find_on_walls

SURROUNDINGS = 2.0  # mesh sizes; how far around a seam triangles count for the layers of its columns
ON_WALL = 1e-6  # m; closer than that, a vertex of a strip is on the wall, but for rounding


@dataclass(frozen=True, eq=False)
class Seam:
    """Border of two tiles, or of one on the region's border."""

    xy: NDArray[np.float64]  #: (k, 2): vertices (m) from the first corner to the last, east- or northwards
    #: (w, 2): those of them at which both tiles node a wall that has no vertex there
    wall_nodes: NDArray[np.float64]
    #: whether it is a part of the region's border: then no other tile has its columns, but for the corners
    border: bool
    ring: PlaneMesh  #: the strip's triangles around its vertices; empty on the region's border
    vertex: NDArray[np.int32]  #: (k,): the seam's vertices in `ring`; empty on the region's border
    #: the strip's triangles as far around it as was asked, with those of `ring`; empty on the region's border
    surroundings: PlaneMesh


def trace_seam(
    grid: TileGrid,
    key: SeamKey,
    ends: tuple[Corner, Corner],
    polygons: NDArray[np.object_],
    walls: NDArray[np.float64],
    *,
    mesh_size: float,
    min_angle: float,
    passes: int,
    sizes: SizeField | None = None,
    surroundings: float = SURROUNDINGS,
    edges: NDArray[np.float64] = NO_EDGES,
) -> Seam:
    """Find a seam in the triangles of its strip.

    Parameters
    ----------
    grid, key, ends, polygons, walls, mesh_size, min_angle, sizes, edges
        As in `mesh_strip`, with its errors and those of `find_path`.
    passes : int
        Rounds of `improve_plane` around the seam.
    surroundings : float
        How far around the seam triangles are kept for the layers of its columns (mesh sizes); with 0 none are but
        those at its vertices.

    Notes
    -----
    The best path is found twice: in the strip as it was triangulated, and again when the triangles around that
    path are improved. Along the region's border, the seam is all vertices of the strip there. Cost is that of the
    strip.
    """
    border = is_border(grid, key)
    strip = mesh_strip(
        grid,
        key,
        ends,
        polygons,
        walls,
        mesh_size=mesh_size,
        min_angle=min_angle,
        sizes=sizes,
        edges=edges,
    )
    if border:
        nothing = PlaneMesh(np.empty((0, 2)), np.empty((0, 3), np.int32), np.empty(0, np.int32))
        xy = _border_vertices(strip, key.axis, ends)
        return Seam(xy, np.empty((0, 2)), True, nothing, np.empty(0, np.int32), nothing)
    path = find_path(grid, key, ends, strip)
    if passes:
        strip = improve_around(strip, path, ends, mesh_size=mesh_size, passes=passes, sizes=sizes)
        path = find_path(grid, key, ends, strip)
    xy = strip.xy[path]
    on, _ = find_on_walls(strip.walls, xy, reach=ON_WALL)
    around = np.isin(strip.triangles, path).any(axis=1)
    ring = order_plane(strip.xy, strip.triangles[around], strip.building[around])
    near = ring
    if surroundings:
        centre = centres(strip.xy, strip.triangles)
        core = strip_core(grid, key, mesh_size=largest_size(sizes, mesh_size=mesh_size))
        reach = surroundings * np.broadcast_to(local_sizes(sizes, centre, mesh_size=mesh_size), len(centre))
        rows = around | _are_near(centre, core, xy, reach)
        near = order_plane(strip.xy, strip.triangles[rows], strip.building[rows])
    return Seam(xy, xy[np.unique(on)], False, ring, find_vertices(ring.xy, xy), near)


def find_vertices(among: NDArray[np.float64], xy: NDArray[np.float64]) -> NDArray[np.int32]:
    """Find places among vertices that hold each of them once, bit for bit.

    Parameters
    ----------
    among : float64, (n, 2)
        Vertices (m), no two alike.
    xy : float64, (k, 2)
        Places.

    Raises
    ------
    ValueError
        If a place is missing.

    Examples
    --------
    >>> find_vertices(np.array([[0.0, 1.0], [0.0, 2.0]]), np.array([[0.0, 2.0]]))
    array([1], dtype=int32)
    """
    # Complex numbers compare as (x, y) do; vertices that are sorted already cost one look at each.
    place, wanted = (np.ascontiguousarray(part).view(np.complex128)[:, 0] for part in (among, xy))
    order = np.argsort(place, kind="stable")
    at = np.searchsorted(place, wanted, sorter=order)
    row: NDArray[np.int64] = order[at.clip(max=len(order) - 1)]
    missing = np.flatnonzero(place[row] != wanted)
    if len(missing):
        x, y = xy[missing[0]]
        raise ValueError(f"the mesh has no vertex at ({x}, {y})")
    return row.astype(np.int32)


def _are_near(
    centre: NDArray[np.float64], core: Bounds, line: NDArray[np.float64], reach: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether triangles have their centres close to a line, and where it is known what holds them."""
    near: NDArray[np.bool_] = np.all((centre >= core[:2]) & (centre <= core[2:]), axis=1)
    longest = float(np.sqrt((np.diff(line, axis=0) ** 2).sum(axis=1).max()))
    _leave_near(centre, line, longest, reach, near)
    return near


@kernel
def _leave_near(
    centre: NDArray[np.float64],
    line: NDArray[np.float64],
    longest: float,
    reach: NDArray[np.float64],
    near: NDArray[np.bool_],
) -> None:
    """Clear the marks of places that are farther than their reach from all pieces of a line, `longest` at most."""
    for i in range(len(centre)):
        if not near[i]:
            continue
        near[i] = False
        for k in range(len(line) - 1):
            ax, ay = centre[i, 0] - line[k, 0], centre[i, 1] - line[k, 1]
            if max(abs(ax), abs(ay)) > longest + reach[i]:
                continue
            dx, dy = line[k + 1, 0] - line[k, 0], line[k + 1, 1] - line[k, 1]
            share = min(max((ax * dx + ay * dy) / (dx * dx + dy * dy), 0.0), 1.0)
            ax, ay = ax - share * dx, ay - share * dy
            if ax * ax + ay * ay <= reach[i] * reach[i]:
                near[i] = True
                break


def _border_vertices(strip: Strip, axis: int, ends: tuple[Corner, Corner]) -> NDArray[np.float64]:
    low, high = ends[0].xy, ends[1].xy
    on = np.flatnonzero(((strip.xy >= low) & (strip.xy <= high)).all(axis=1))
    return strip.xy[on[np.argsort(strip.xy[on, axis], kind="stable")]]
