"""A seam's way: the shortest path along the edges of a strip (before step 3.1, ours)."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.data.kernel import kernel
from pipeline.plane_mesh.edges import triangle_neighbours
from stitch.tiling.corners import Corner
from stitch.tiling.grid import SeamKey, TileGrid, band_width
from stitch.tiling.shortest import find_shortest
from stitch.tiling.strips import Strip

SLOPES = (0.7, 0.95)  # of the wedges at both corners; the second where the first has no path
OFFSET_COST = 0.3  # added cost of an edge at the band's side
POOR_COST = 2.0  # added cost of an edge at a flat triangle; none where all around are equilateral
WALL_COST = 1.0  # added cost of an edge for each end on a wall
INSIDE_COST = 3.0  # added cost of an edge through a building


def find_path(grid: TileGrid, seam: SeamKey, ends: tuple[Corner, Corner], strip: Strip) -> NDArray[np.int64]:
    """Find the seam between two corners.

    Parameters
    ----------
    grid : TileGrid
        The tile grid.
    seam : SeamKey
        The seam, which is not on the region's border.
    ends : (Corner, Corner)
        Where it starts and ends.
    strip : Strip
        Its strip.

    Returns
    -------
    int64, (k,)
        Vertices of the strip from the first corner to the last.

    Raises
    ------
    GeometryError
        If no path leads through the band.

    Notes
    -----
    The path begins and ends with straight first edges along the axis. Between them it stays in the wedge
    of either corner, where ``|across| <= slope * along``: wedges of seams across each other have only the
    corner in common, so seams never cross. Vertices on open ground are tried alone first, then walls and
    buildings at a cost.
    """
    axis = seam.axis
    along, across = strip.xy[:, axis], strip.xy[:, 1 - axis]
    start, end = ends[0].xy, ends[1].xy
    band = band_width(grid.tile_size, grid.open_size)
    line = grid.lines[1 - axis][seam[2 - axis] - grid.first[1 - axis]]
    first = _spoke(strip, ends[0], ends[0].tips[axis], axis)
    last = _spoke(strip, ends[1], ends[1].tips[2 + axis], axis)[::-1]
    edges, cost, shut = _costs(strip, np.abs(across - line) / band)
    for slope in SLOPES:
        from_start = slope * (along - start[axis]) - np.abs(across - start[1 - axis])
        from_end = slope * (end[axis] - along) - np.abs(across - end[1 - axis])
        within = (from_start > 0) & (from_end > 0) & (np.abs(across - line) < band)
        for open_only in (True, False):
            usable = within & ~shut if open_only else within
            usable[[first[-1], last[0]]] = True
            middle = find_shortest(edges, cost, usable, int(first[-1]), int(last[0]))
            if len(middle):
                return np.concatenate((first, middle[1:-1], last))
    raise GeometryError(
        f"seam from ({start[0]:.1f}, {start[1]:.1f}) to ({end[0]:.1f}, {end[1]:.1f}): no path within "
        f"{band:.0f} m of its line; choose another --tile-size"
    )


def _spoke(strip: Strip, corner: Corner, tip: NDArray[np.float64], axis: int) -> NDArray[np.int64]:
    """Vertices from a corner to the tip of its first edge: these two, if the mesher did not split it."""
    low, high = np.minimum(corner.xy, tip), np.maximum(corner.xy, tip)
    on = np.flatnonzero(((strip.xy >= low) & (strip.xy <= high)).all(axis=1))
    return on[np.argsort(np.abs(strip.xy[on, axis] - corner.xy[axis]), kind="stable")]


def _costs(
    strip: Strip, offset: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Edges of a strip, what each costs, and the vertices on walls or in buildings."""
    neighbour = triangle_neighbours(strip.triangles)
    worst, on_wall, built = _look_at_vertices(strip.xy, strip.triangles, neighbour, strip.building)
    edges, cost = _cost_edges(strip.xy, strip.triangles, neighbour, strip.building, worst, on_wall, offset)
    return edges, cost, on_wall | built


@kernel
def _look_at_vertices(
    xy: NDArray[np.float64],
    triangles: NDArray[np.int32],
    neighbour: NDArray[np.int32],
    building: NDArray[np.int32],
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Find the worst shape of the triangles at each vertex, and the vertices on walls and in buildings.

    A shape is the area over the squared edges, 1 if the triangle is equilateral.
    """
    worst = np.ones(len(xy))
    on_wall, built = np.zeros(len(xy), np.bool_), np.zeros(len(xy), np.bool_)
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        ux, uy = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
        vx, vy = xy[c, 0] - xy[a, 0], xy[c, 1] - xy[a, 1]
        squares = (ux * ux + uy * uy) + (vx * vx + vy * vy) + ((ux - vx) * (ux - vx) + (uy - vy) * (uy - vy))
        shape = 2 * np.sqrt(3.0) * (ux * vy - uy * vx) / squares
        for k in range(3):
            v = triangles[t, k]
            worst[v] = min(worst[v], shape)
            if building[t] >= 0:
                built[v] = True
            u = neighbour[t, k]
            if u >= 0 and building[u] != building[t]:
                on_wall[triangles[t, (k + 1) % 3]] = True
                on_wall[triangles[t, (k + 2) % 3]] = True
    return worst, on_wall, built


@kernel
def _cost_edges(
    xy: NDArray[np.float64],
    triangles: NDArray[np.int32],
    neighbour: NDArray[np.int32],
    building: NDArray[np.int32],
    worst: NDArray[np.float64],
    on_wall: NDArray[np.bool_],
    offset: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Edges, each once, int64 (e, 2), and what each costs."""
    edges, cost = np.empty((3 * len(triangles), 2), np.int64), np.empty(3 * len(triangles))
    n = 0
    for t in range(len(triangles)):
        for k in range(3):
            u = neighbour[t, k]
            if 0 <= u < t:
                continue
            p, q = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
            dx, dy = xy[p, 0] - xy[q, 0], xy[p, 1] - xy[q, 1]
            mean_offset = (offset[p] + offset[q]) / 2
            extra = POOR_COST * (1 - min(worst[p], worst[q])) + WALL_COST * (int(on_wall[p]) + int(on_wall[q]))
            if u >= 0 and building[t] >= 0 and building[u] == building[t]:
                extra += INSIDE_COST
            edges[n, 0], edges[n, 1] = p, q
            cost[n] = np.sqrt(dx * dx + dy * dy) * (1 + OFFSET_COST * mean_offset * mean_offset) * (1 + extra)
            n += 1
    return edges[:n].copy(), cost[:n].copy()
