"""Roofs that a cloud leaves in other classes than that of buildings (step 1.5, ours)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.classes import (
    BUILDING,
    GROUND,
    HIGH_VEGETATION,
    LOW_VEGETATION,
    MEDIUM_VEGETATION,
    NEVER_ROOF,
    WATER,
)
from pipeline.data.kernel import kernel
from pipeline.data.pointcloud import N_CLASSES, PointCloud
from pipeline.geometry.inside import are_inside, find_inside
from pipeline.points_terrain.raster import Dtm, sample_dtm
from pipeline.roofs.roof_points import RoofPoints, make_roof_points

# Classes in which the roof of a house may be that has too few points of class 6.
MAY_BE_ROOF = tuple(number for number in range(N_CLASSES) if number not in (BUILDING, *NEVER_ROOF))
PLANTS = (LOW_VEGETATION, MEDIUM_VEGETATION, HIGH_VEGETATION)
MARK_CELL = 1.0  # m, side of the cells that points of class 6 cover
MARKED_SHARE = 0.2  # of a footprint; a neighbour's roof and stray points cover less of it, a roof of its own more
DENSE = 4.0  # points of class 6 a square metre of footprint, above which a roof is marked without a closer look
LEAST_HEIGHT = 2.0  # m above the terrain; cars, hedges and grass are below
LEAST_POINTS = 10
LEAST_COVER = 0.5  # of a footprint that its roof covers
CELL_POINTS = 10  # that a cell has on average in which points are held against a plane
CELL_SIDES = (1.0, 4.0)  # m, least and greatest side of such a cell
FIT_POINTS = 5  # that tell how far they are from a plane
LEAST_HALF = 0.3  # of the points of a cell that is cut in two: fewer are close to a plane by chance
LEAST_SMOOTH = 0.4  # of the points of a house that are higher than `LEAST_HEIGHT`
NEARLY_ALL = 0.8  # share of smooth points of a house from which cells of fewer points are believed too
# Root mean square distance from the plane of a cell up to which it is one of a roof: so much, and so much for each
# metre of its side, at most. A ridge of 45 degrees has 0.14 a metre, points anywhere in 3 m of a crown 0.87 m.
# With class 6 called class 1, 1,002 of 1,042 houses of Amsterdam (3.5 points a square metre) have a roof by this
# rule, whose median is within 0.05, 0.4 and 0.6 m of that of class 6 in 50, 90 and 95 % of them.
SMOOTH, SMOOTH_SLOPE, MOST_SMOOTH = 0.15, 0.2, 0.6
SPOTS = (
    np.indices((3, 3)).reshape(2, 9).T + 0.5
) / 3  # of a cell of side 1, that tell how much of it is in a house
PART = 500_000  # points that are looked at together; a house is not divided

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


def find_bare(points: RoofPoints, polygons: NDArray[np.object_]) -> Mask:
    """Tell which houses have no points of class 6, or so few that these are strays or of the house next door.

    Parameters
    ----------
    points : RoofPoints
        Points of class 6 inside each house, as from `locate_roof_points`.
    polygons : object, (n,)
        Houses.

    Returns
    -------
    bool, (n,)
        True where they lie in less than a fifth of its square metres.
    """
    count, area = np.diff(points.start), shapely.area(polygons)
    thin = (count > 0) & (count < DENSE * area)
    cells = _count_cells(points.start, points.xyz, thin)
    bare: Mask = (count == 0) | (thin & (cells * MARK_CELL**2 < MARKED_SHARE * area))
    return bare


@kernel
def _count_cells(start: Index, xyz: Array, among: Mask) -> Index:
    """Count the cells of side `MARK_CELL` in which some houses have points; 0 for others."""
    cells = np.zeros(len(among), np.int64)
    for house in np.flatnonzero(among):
        keys = np.empty(start[house + 1] - start[house], np.int64)
        for k in range(len(keys)):
            x, y = xyz[start[house] + k, :2] / MARK_CELL
            keys[k] = int(np.floor(y)) * 2**32 + int(np.floor(x))
        keys.sort()
        for k in range(len(keys)):
            cells[house] += k == 0 or keys[k] != keys[k - 1]
    return cells


@dataclass(frozen=True, eq=False)
class UnmarkedRoofs:
    """What may be the roofs of houses, of points of other classes."""

    smooth: RoofPoints  #: points on smooth surfaces above the terrain
    #: these, and those between the lowest and the highest of them: dormers, ridges and steep gables are rough
    points: RoofPoints


def locate_unmarked(others: PointCloud, polygons: NDArray[np.object_], dtm: Dtm) -> UnmarkedRoofs:
    """Look for smooth surfaces above the terrain in each house, among points of other classes.

    Parameters
    ----------
    others : PointCloud
        Points of the classes that may be a roof.
    polygons : object, (n,)
        Valid shapely Polygons.
    dtm : Dtm
        Terrain without empty nodes.

    Notes
    -----
    Points are held against the plane that fits best in cells of some ten points. A cell that is not smooth is cut
    once at its largest gap in height: a crown above a roof, two roofs. Where less than two fifths of a house's
    points are smooth, it gets none: trees. What a house gets depends on its own points alone, in whatever order
    they come.
    """
    high = others.xyz[:, 2] >= sample_dtm(dtm, others.xyz[:, :2]) + LEAST_HEIGHT
    house, point = find_inside(others.xyz, polygons, among=high)
    xyz = others.xyz[point]
    n = len(polygons)
    smooth = _are_smooth(xyz, house, _cell_sides(house, polygons))
    smooth &= (np.bincount(house[smooth], minlength=n) >= LEAST_SMOOTH * np.bincount(house, minlength=n))[house]
    within = _are_between(xyz[:, 2], house, smooth)
    return UnmarkedRoofs(*(_by_house(xyz[rows], house[rows], n) for rows in (smooth, within)))


def _by_house(xyz: Array, house: Index, n: int) -> RoofPoints:
    start = np.concatenate(([0], np.cumsum(np.bincount(house, minlength=n))))
    return make_roof_points(start, xyz)


def are_roofs(found: UnmarkedRoofs, polygons: NDArray[np.object_], cloud: PointCloud) -> Mask:
    """Tell which houses have a roof of such points.

    Parameters
    ----------
    found : RoofPoints
        Result of `locate_unmarked`.
    polygons : object, (n,)
        The same houses.
    cloud : PointCloud
        Points that include those of ground and water inside the houses.

    Returns
    -------
    bool, (n,)
        True where the smooth ones are ten at least, as many as those of ground inside, and cover half of a house.
    """
    ground = (cloud.classification == GROUND) | (cloud.classification == WATER)
    below, _ = find_inside(cloud.xyz, polygons, among=ground)
    xyz, count = found.smooth.xyz, np.diff(found.smooth.start)
    enough: Mask = (count >= LEAST_POINTS) & (count >= np.bincount(below, minlength=len(polygons)))
    house = np.repeat(np.arange(len(polygons)), count)
    rows = enough[house]
    side = _cell_sides(house, polygons)
    first = np.unique(_cell_keys(xyz[rows], house[rows], side), return_index=True)[1]
    owner, corner = house[rows][first], xyz[rows][first, :2]
    low = np.floor(corner / side[owner, None]) * side[owner, None]
    places = (low[:, None] + side[owner, None, None] * SPOTS).reshape(-1, 2)
    spots = np.repeat(owner, len(SPOTS))
    inside = are_inside(polygons, spots, places, closed=True)
    covered = np.bincount(spots[inside], minlength=len(polygons)) * side**2 / len(SPOTS)
    enough &= covered >= LEAST_COVER * shapely.area(polygons)
    return enough


def _cell_sides(house: Index, polygons: NDArray[np.object_]) -> Array:
    """Side (m) of the cells of each house, for the points that are told to be in it."""
    count = np.bincount(house, minlength=len(polygons))
    sides: Array = np.clip(np.sqrt(CELL_POINTS * shapely.area(polygons) / np.maximum(count, 1)), *CELL_SIDES)
    return sides


def _cell_keys(xyz: Array, house: Index, side: Array) -> Index:
    """Give the points of one house and cell one number: by house, then by cell."""
    cell = np.floor(xyz[:, :2] / side[house, None]).astype(np.int64)
    if len(cell) == 0:
        return house
    column, row = (cell - cell.min(axis=0)).T
    keys: Index = (house * (row.max() + 1) + row) * (column.max() + 1) + column
    return keys


def _are_smooth(xyz: Array, house: Index, side: Array) -> Mask:
    """Tell which points lie on a plane together with others of their cell; `house` ascends."""
    smooth = np.zeros(len(xyz), np.bool_)
    first = 0
    while first < len(xyz):
        last = int(np.searchsorted(house, house[min(first + PART, len(xyz) - 1)], side="right"))
        smooth[first:last] = _are_smooth_together(xyz[first:last], house[first:last], side)
        first = last
    return smooth


def _are_smooth_together(xyz: Array, house: Index, side: Array) -> Mask:
    """As `_are_smooth`, all at once; at least one point."""
    smooth = np.zeros(len(xyz), np.bool_)
    keys = _cell_keys(xyz, house, side)
    order = np.lexsort((xyz[:, 0], xyz[:, 1], xyz[:, 2], keys))
    group = np.cumsum(np.diff(keys[order], prepend=-1) != 0) - 1
    points, owner = xyz[order], house[order]
    limit = np.minimum(SMOOTH + SMOOTH_SLOPE * side, MOST_SMOOTH)[owner]
    flat = _distance_from_planes(points, group)[group] <= limit
    halves = _cut_at_gaps(points[:, 2], group)
    count = np.bincount(halves)[halves]
    half_flat = _distance_from_planes(points, halves)[halves] <= limit
    flat |= half_flat & (count >= LEAST_HALF * np.bincount(group)[group])
    few = count < FIT_POINTS
    few &= ~flat
    smooth[order] = flat | (few & _are_among(points[:, 2], owner, flat, few))
    return smooth


def _are_among(z: Array, owner: Index, flat: Mask, few: Mask) -> Mask:
    """Tell which points are within the heights of the smooth ones of their house, where nearly all are smooth."""
    n = int(owner[-1]) + 1
    share = np.bincount(owner, flat, n) / np.maximum(np.bincount(owner, ~few, n), 1)
    return (share >= NEARLY_ALL)[owner] & _are_between(z, owner, flat)


def _are_between(z: Array, owner: Index, some: Mask) -> Mask:
    """Tell which heights are between the least and the greatest of some of their owner, if any."""
    n = int(owner.max(initial=-1)) + 1
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, owner[some], z[some])
    np.maximum.at(high, owner[some], z[some])
    between: Mask = (low[owner] <= z) & (z <= high[owner])
    return between


def _cut_at_gaps(z: Array, group: Index) -> Index:
    """Cut each group of ascending heights in two where its largest gap is; groups of the halves, ascending."""
    gap = np.zeros(len(z))
    inner = group[1:] == group[:-1]
    gap[1:][inner] = np.diff(z)[inner]
    largest = np.zeros(group[-1] + 1)
    np.maximum.at(largest, group, gap)
    cut = np.zeros(len(z), np.bool_)
    begins = np.flatnonzero((gap == largest[group]) & (gap > 0))
    cut[begins[np.unique(group[begins], return_index=True)[1]]] = True  # the lowest of equal gaps
    first = np.ones(len(z), np.bool_)
    first[1:] = ~inner
    halves: Index = np.cumsum(first | cut) - 1
    return halves


def _distance_from_planes(xyz: Array, group: Index) -> Array:
    """Root mean square distance in height (m) of each group from its best plane; infinite for too few points."""
    n = np.bincount(group)
    centre = np.column_stack([np.bincount(group, column) / n for column in xyz.T])
    x, y, z = (xyz - centre[group]).T
    xx, xy, yy = (np.bincount(group, product) for product in (x * x, x * y, y * y))
    xz, yz, zz = (np.bincount(group, product) for product in (x * z, y * z, z * z))
    least = 1e-6 * n  # points on a line have no slope across it
    xx, yy = xx + least, yy + least
    determinant = xx * yy - xy * xy
    explained = (yy * xz * xz - 2 * xy * xz * yz + xx * yz * yz) / determinant
    squares = np.maximum(zz - explained, 0.0)
    return np.where(n >= FIT_POINTS, np.sqrt(squares / np.maximum(n - 3, 1)), np.inf)
