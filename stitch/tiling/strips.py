"""The strip around the nominal line between two corners, and its triangles (before step 3.1, ours)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.geometry.inside import find_inside
from pipeline.plane_mesh.improve_plane import improve_plane
from pipeline.plane_mesh.plane import collect_graph, triangulate_plane
from pipeline.plane_mesh.sizes import SizeField, largest_size, local_sizes
from stitch.tiling.corners import Corner
from stitch.tiling.grid import Bounds, SeamKey, TileGrid, band_width, corner_reach, is_border, seam_bounds
from stitch.tiling.land_cover import find_kept
from stitch.tiling.walls import LONGEST_PIECE, walls_within

RING = 1.5  # mesh sizes; the triangles around a vertex have their centres within that
SECTORS = 5  # four quadrants around a corner, and elsewhere
CORRIDOR = 4  # triangles on either side of a path that are improved
NO_EDGES = np.empty((0, 2, 2))
MARGIN = 0.5  # mesh sizes between the last piece of wall and the strip's sides


@dataclass(frozen=True, eq=False)
class Strip:
    """Triangles around the nominal line of a seam, with walls and the first edges of seams as edges."""

    xy: NDArray[np.float64]  #: (n, 2): vertices (m)
    triangles: NDArray[np.int32]  #: (m, 3): vertex indices, counter-clockwise
    #: (m,): row of the building that holds the triangle, -1 on open ground; true within the strip's core
    building: NDArray[np.int32]
    walls: NDArray[np.float64]  #: (w, 2, 2): pieces of wall, and further edges, that are edges of the strip (m)
    edges: NDArray[np.float64]  #: (e, 2, 2): the further ones (m)


def mesh_strip(
    grid: TileGrid,
    seam: SeamKey,
    ends: tuple[Corner, Corner],
    polygons: NDArray[np.object_],
    walls: NDArray[np.float64],
    *,
    mesh_size: float,
    min_angle: float,
    sizes: SizeField | None = None,
    edges: NDArray[np.float64] = NO_EDGES,
) -> Strip:
    """Triangulate a strip.

    Parameters
    ----------
    grid : TileGrid
        The tile grid.
    seam : SeamKey
        The seam.
    ends : (Corner, Corner)
        Where it starts and ends.
    polygons : object, (b,)
        Footprints, at least those that meet the strip's core.
    walls : float64, (w, 2, 2)
        Their walls in pieces (`cut_walls`).
    mesh_size : float
        Target edge length h (m).
    min_angle : float
        Bound on the angles (degrees).
    sizes : SizeField, optional
        Target edge lengths that are not the same everywhere.
    edges : float64, (e, 2, 2)
        Further edges of the mesh, on open ground (m).

    Raises
    ------
    GeometryError
        As from `triangulate_plane`.

    Notes
    -----
    The core is the band that the seam may use and the triangles around it. All pieces of wall that meet it
    are in the strip, whole; beyond it nothing counts, so what lies there makes no difference.
    """
    core = strip_core(grid, seam, mesh_size=largest_size(sizes, mesh_size=mesh_size))
    inside, further = (walls_within(some, shapely.box(*core)) for some in (walls, edges))
    bounds = seam_bounds(grid, seam)
    outer = _grow(core, (LONGEST_PIECE + MARGIN) * mesh_size, bounds)
    spokes = _spokes(ends, bounds)
    fixed = np.concatenate((_outline(outer, ends), inside, further, spokes))
    xy, triangles, _, _ = triangulate_plane(
        collect_graph(fixed, np.empty((0, 2))), max_area=mesh_size**2 / 2, min_angle=min_angle, sizes=sizes
    )
    building = label_triangles(xy, triangles, polygons)
    # Beyond the core, what holds a triangle is a matter of which houses were given.
    building[~_within(xy, triangles, core)] = -1
    return Strip(xy, triangles, building, np.concatenate((inside, further)), further)


def improve_around(
    strip: Strip,
    path: NDArray[np.int64],
    ends: tuple[Corner, Corner],
    *,
    mesh_size: float,
    passes: int,
    sizes: SizeField | None = None,
) -> Strip:
    """Move vertices and flip edges of a strip for better angles, where a seam can be.

    Parameters
    ----------
    strip : Strip
        A strip as it was triangulated.
    path : int64, (k,)
        Vertices of the best path through it.
    ends, mesh_size, sizes
        As in `mesh_strip`.
    passes : int
        Rounds of `improve_plane`.

    Notes
    -----
    A path on open ground is hardly left any more: what is within `CORRIDOR` triangles of it is improved, and its
    edges cost less then, all others what they did. A path that touches a house is left where better triangles
    let another through a gap, so all are improved.
    """
    rows = _rows_around(strip, path)
    vertex, local = np.unique(strip.triangles[rows], return_inverse=True)
    xy, triangles = strip.xy[vertex], local.reshape(-1, 3).astype(np.int32)
    # Different labels on the two sides of a first edge keep it where it is.
    label = strip.building[rows] * SECTORS + _sectors(xy, triangles, ends)
    size = local_sizes(sizes, xy, mesh_size=mesh_size)
    kept = find_kept(xy, strip.edges, triangles)
    xy, triangles = improve_plane(xy, triangles, label.astype(np.int32), mesh_size=size, passes=passes, kept=kept)
    all_xy, all_triangles = strip.xy.copy(), strip.triangles.copy()
    all_xy[vertex], all_triangles[rows] = xy, vertex[triangles]
    return Strip(all_xy, all_triangles, strip.building, strip.walls, strip.edges)


def _rows_around(strip: Strip, path: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles that are at most `CORRIDOR` away from a path; all, if one at the path is in a house."""
    reached = np.zeros(len(strip.xy), np.bool_)
    reached[path] = True
    near = reached[strip.triangles].any(axis=1)
    if (strip.building[near] >= 0).any():
        return np.arange(len(strip.triangles))
    for _ in range(1, CORRIDOR):
        reached[strip.triangles[near]] = True
        near = reached[strip.triangles].any(axis=1)
    return np.flatnonzero(near)


def strip_core(grid: TileGrid, seam: SeamKey, *, mesh_size: float) -> Bounds:
    """Box of what counts for a seam, within the region (m); `mesh_size` is the largest there."""
    reach = corner_reach(grid.tile_size) + RING * mesh_size
    band = 0.0 if is_border(grid, seam) else band_width(grid.tile_size, grid.open_size)
    i, j = seam.i - grid.first.i, seam.j - grid.first.j
    x, y = grid.lines
    low = (x[i], y[j])
    high = (x[i + (seam.axis == 0)], y[j + (seam.axis == 1)])
    wide = [reach, reach]
    wide[1 - seam.axis] = band + RING * mesh_size
    box = (low[0] - wide[0], low[1] - wide[1], high[0] + wide[0], high[1] + wide[1])
    return _grow((float(box[0]), float(box[1]), float(box[2]), float(box[3])), 0.0, seam_bounds(grid, seam))


def label_triangles(
    xy: NDArray[np.float64], triangles: NDArray[np.int32], polygons: NDArray[np.object_]
) -> NDArray[np.int32]:
    """Row of the building around the centre of each triangle, -1 where none; int32, (m,)."""
    label = np.full(len(triangles), -1, np.int32)
    building, row = find_inside(centres(xy, triangles), polygons)
    label[row] = building
    return label


def centres(xy: NDArray[np.float64], triangles: NDArray[np.int32]) -> NDArray[np.float64]:
    """Centres of triangles (m); float64, (m, 2)."""
    centre: NDArray[np.float64] = (xy[triangles[:, 0]] + xy[triangles[:, 1]] + xy[triangles[:, 2]]) / 3
    return centre


def _within(xy: NDArray[np.float64], triangles: NDArray[np.int32], box: Bounds) -> NDArray[np.bool_]:
    centre = centres(xy, triangles)
    inside: NDArray[np.bool_] = np.all((centre >= box[:2]) & (centre <= box[2:]), axis=1)
    return inside


def _grow(box: Bounds, by: float, within: Bounds) -> Bounds:
    low = max(box[0] - by, within[0]), max(box[1] - by, within[1])
    high = min(box[2] + by, within[2]), min(box[3] + by, within[3])
    return *low, *high


def _outline(box: Bounds, ends: tuple[Corner, Corner]) -> NDArray[np.float64]:
    """Sides of a box, noded where a corner is on them."""
    xy = np.concatenate((shapely.get_coordinates(shapely.box(*box))[:-1], [end.xy for end in ends]))
    low, high = np.array(box[:2]), np.array(box[2:])
    xy = np.unique(xy[((xy == low) | (xy == high)).any(axis=1)], axis=0)
    middle = (low + high) / 2
    ring = xy[np.argsort(np.arctan2(xy[:, 1] - middle[1], xy[:, 0] - middle[0]), kind="stable")]
    return np.stack((ring, np.roll(ring, -1, axis=0)), axis=1)


def _spokes(ends: tuple[Corner, Corner], bounds: Bounds) -> NDArray[np.float64]:
    """First edges of the seams at both corners within bounds, without those on their sides."""
    start = np.concatenate([np.repeat(end.xy[None], 4, axis=0) for end in ends])
    tip = np.concatenate([end.tips for end in ends])
    spokes = np.stack((start, tip), axis=1)
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    on_side = ((spokes == low) | (spokes == high)).all(axis=1).any(axis=1)
    inside = ((tip >= low) & (tip <= high)).all(axis=1)  # none is where the region has ended
    kept: NDArray[np.float64] = spokes[~on_side & inside]
    return kept


def _sectors(
    xy: NDArray[np.float64], triangles: NDArray[np.int32], ends: tuple[Corner, Corner]
) -> NDArray[np.int32]:
    """Number the quadrants around the corners for triangles beside the first edges there; 0 elsewhere."""
    centre = centres(xy, triangles)
    sector = np.zeros(len(triangles), np.int32)
    for end in ends:
        length = np.nanmax(np.abs(end.tips - end.xy))
        on_edges = ((xy == end.xy) & (np.abs(xy - end.xy)[:, ::-1] <= length)).any(axis=1)
        beside = on_edges[triangles].sum(axis=1) > 1
        offset = centre[beside] - end.xy
        sector[beside] = 1 + (offset[:, 0] > 0) + 2 * (offset[:, 1] > 0)
    return sector
