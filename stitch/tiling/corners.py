"""Corners: where four tiles meet, in the clearest place around the nominal one (before step 3.1, ours)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.inside import find_inside
from pipeline.plane_mesh.sizes import SizeField, local_sizes, wall_distances
from stitch.tiling.grid import (
    CORNER_SHARE,
    Key,
    TileGrid,
    closest_line,
    corner_reach,
    has_tile,
    nominal_corner,
    tiles_of_corner,
)

SPOKE_OF_CLEARANCE = 0.6  # length of the first edges of seams over the distance to the next wall
LONGEST_SPOKE = 0.8  # mesh sizes
SPOKE_OF_DEPTH = 0.25  # of the distance to the next corner
INSIDE_WORTH = 0.5  # clearance in a building counts for half
SAME = 0.001  # m; distances that differ by less count as equal, so that rounding settles no tie
BEST = 3  # times that; places that are worse than the best by more cannot become it by rounding
DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])  # east, north, west, south


@dataclass(frozen=True, eq=False)
class Corner:
    """Where four tiles meet, or two and the region's border, or one and two of its sides."""

    xy: NDArray[np.float64]  #: (2,): place (m)
    #: (4, 2): where the first edges of the seams eastwards, northwards, westwards and southwards end (m); NaN
    #: where the region does
    tips: NDArray[np.float64]
    building: int  #: row of the building around it, -1 on open ground


def place_corner(
    grid: TileGrid,
    key: Key,
    polygons: NDArray[np.object_],
    walls: NDArray[np.float64],
    *,
    mesh_size: float,
    sizes: SizeField | None = None,
) -> Corner:
    """Choose a corner's place, far from walls, and the first edges of its seams.

    Parameters
    ----------
    grid : TileGrid
        The tile grid.
    key : Key
        The corner.
    polygons : object, (b,)
        Footprints, at least those closer to the nominal corner than `corner_sight`.
    walls : float64, (w, 2, 2)
        Their walls in pieces (`cut_walls`).
    mesh_size : float
        Target edge length (m).
    sizes : SizeField, optional
        Target edge lengths that are not the same everywhere.

    Returns
    -------
    Corner
        Of the places on a 1 m grid around the nominal corner, on the region's border along it, the one
        with the largest distance to a wall; distances beyond `corner_reach` count as that.

    Notes
    -----
    Between equals, the closest to the nominal corner, then the one at the smallest x, then y. A distance
    inside a building counts for half (`INSIDE_WORTH`).
    """
    reach = corner_reach(grid.tile_size)
    nominal = np.array(nominal_corner(grid, key))
    depth = closest_line(grid, key)
    offset = _offsets(grid, key, min(reach, CORNER_SHARE * depth))
    xy = nominal + offset
    walls = _walls_around(walls, xy, reach)
    building = _building_at(polygons, xy)
    share = np.where(building >= 0, INSIDE_WORTH, 1.0)
    close = _find_best(walls, xy, share, reach, BEST * SAME)
    xy, offset, building, share = xy[close], offset[close], building[close], share[close]
    clear = _clearance(walls, xy, reach)
    worth = np.rint(share * clear / SAME)
    best = np.lexsort((offset[:, 1], offset[:, 0], (offset**2).sum(axis=1), -worth))[0]
    free, size = clear[best], mesh_size
    if sizes is not None:
        free = max(free, wall_distances(sizes, xy[[best]])[0])
        size = local_sizes(sizes, xy[[best]], mesh_size=mesh_size)[0]
    length = min(SPOKE_OF_CLEARANCE * free, LONGEST_SPOKE * size, SPOKE_OF_DEPTH * depth)
    tips = xy[best] + length * DIRECTIONS
    there = [has_tile(grid, tile) for tile in tiles_of_corner(key)]
    # Tiles beside the first edges eastwards, northwards, westwards and southwards.
    tips[[not (a or b) for a, b in zip(there, (there[-1], *there), strict=False)]] = np.nan
    return Corner(xy[best], tips, int(building[best]))


def corner_sight(tile_size: float) -> float:
    """How far from its nominal place a corner sees (m)."""
    return 2 * corner_reach(tile_size)


def _offsets(grid: TileGrid, key: Key, reach: float) -> NDArray[np.float64]:
    """Whole metres in a disc; none across the region's border, and none at all where the border turns."""
    upper_right, upper_left, lower_left, lower_right = (has_tile(grid, tile) for tile in tiles_of_corner(key))
    steps = np.arange(-np.floor(reach), np.floor(reach) + 1)
    dx = steps if upper_left == upper_right and lower_left == lower_right else np.zeros(1)
    dy = steps if upper_left == lower_left and upper_right == lower_right else np.zeros(1)
    offset = np.stack(np.meshgrid(dx, dy), axis=-1).reshape(-1, 2)
    disc: NDArray[np.float64] = offset[(offset**2).sum(axis=1) <= reach**2]
    return disc


def _walls_around(walls: NDArray[np.float64], xy: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    low, high = xy.min(axis=0) - reach, xy.max(axis=0) + reach
    around: NDArray[np.float64] = walls[((walls.max(axis=1) >= low) & (walls.min(axis=1) <= high)).all(axis=1)]
    return around


@kernel(error_model="numpy")
def _find_best(
    walls: NDArray[np.float64], xy: NDArray[np.float64], share: NDArray[np.float64], reach: float, margin: float
) -> NDArray[np.int64]:
    """Places whose share of the distance to the next wall is the largest, but for less than a margin.

    A place is given up at the first wall that is too close, and the wall that the one before was given up for is
    tried first.
    """
    value = np.empty(len(xy))
    best, culprit = 0.0, 0
    for i in range(len(xy)):
        bound = (best - margin) / share[i]
        least = reach * reach
        for m in range(-1, len(walls)):
            w = m if m >= 0 else culprit
            if w >= len(walls):
                continue
            dx, dy = walls[w, 1, 0] - walls[w, 0, 0], walls[w, 1, 1] - walls[w, 0, 1]
            px, py = xy[i, 0] - walls[w, 0, 0], xy[i, 1] - walls[w, 0, 1]
            square = dx * dx + dy * dy
            along = min(max((px * dx + py * dy) / square, 0.0), 1.0) if square > 0 else 0.0
            ox, oy = px - along * dx, py - along * dy
            least = min(least, ox * ox + oy * oy)
            if bound > 0 and least < bound * bound:
                culprit = w
                break
        value[i] = share[i] * np.sqrt(least)
        best = max(best, value[i])
    return np.flatnonzero(value >= best - margin)


def _clearance(walls: NDArray[np.float64], xy: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    clear = np.full(len(xy), reach)
    tree = shapely.STRtree(shapely.linestrings(walls))
    (row, _), distance = tree.query_nearest(
        shapely.points(xy), max_distance=reach, return_distance=True, all_matches=False
    )
    clear[row] = np.minimum(distance, reach)
    return clear


def _building_at(polygons: NDArray[np.object_], xy: NDArray[np.float64]) -> NDArray[np.int64]:
    building = np.full(len(xy), -1)
    inside, row = find_inside(xy, polygons)
    building[row] = inside
    return building
