"""Integrals of roofs over outlines: mean heights, the area where limits cut a plane, heights of block models."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import CityModel
from pipeline.data.roofs import Roofs, is_flat, plane_heights, roof_heights

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RoofAreas:
    """Roofs over their ``n`` polygons."""

    mean: Array  #: (n,): mean height (m): that of the flat roof of equal volume
    #: (n,): area (m²) where the plane is below the lowest or above the highest height, and the roof flat; 0 where
    #: all of it is
    at_low: Array
    at_high: Array


def measure_roof_areas(polygons: NDArray[np.object_], roofs: Roofs) -> RoofAreas:
    """Integrate roofs over polygons, exactly but for rounding.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons (m).
    roofs : Roofs
        A roof of each.

    Notes
    -----
    With the part of the polygon where the plane is above a height h, the volume of the plane above h is the area
    of that part times the height of the plane over its centroid. The volume under the roof is that under `low`,
    and what the plane has above `low` without what it has above `high`.

    Examples
    --------
    >>> shed = Roofs(np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 2)), np.array([[1.0, 3.0]]))
    >>> found = measure_roof_areas(np.array([shapely.box(0, 0, 4, 2)]), shed)
    >>> found.mean.tolist(), found.at_low.tolist(), found.at_high.tolist()
    ([2.0], [2.0], [2.0])
    """
    first = np.arange(len(roofs))
    mean = roof_heights(roofs, first, roofs.origin)
    at_low, at_high = np.zeros(len(roofs)), np.zeros(len(roofs))
    rows = np.flatnonzero(~is_flat(roofs))
    if len(rows):
        area = shapely.area(polygons[rows])
        above_low, over_low = _measure_above(polygons[rows], roofs, rows, roofs.limits[rows, 0])
        above_high, over_high = _measure_above(polygons[rows], roofs, rows, roofs.limits[rows, 1])
        mean[rows] = roofs.limits[rows, 0] + (over_low - over_high) / area
        at_low[rows], at_high[rows] = area - above_low, above_high
    return RoofAreas(mean, at_low, at_high)


def block_heights(model: CityModel) -> Array:
    """Heights of the flat roofs of block models of buildings (m), float64 (n, 2): of LoD1.2 and LoD1.3.

    The first is one height for all parts of a house, the second one for each part: those of equal volume under
    the roofs. All parts of each house must be among the rows.
    """
    mean = measure_roof_areas(model.polygons, model.roofs).mean
    _, house, times = np.unique(model.house, return_inverse=True, return_counts=True)
    house = house.reshape(-1)
    area = shapely.area(model.polygons)
    order = np.argsort(model.ids, kind="stable")  # sums must not depend on the order of the rows
    total = np.bincount(house[order], (area * mean)[order], minlength=len(times))
    share = np.bincount(house[order], area[order], minlength=len(times))
    several = times[house] > 1
    return np.column_stack((np.where(several, (total / np.where(share > 0, share, 1))[house], mean), mean))


def _measure_above(
    polygons: NDArray[np.object_], roofs: Roofs, rows: NDArray[np.int64], level: Array
) -> tuple[Array, Array]:
    """Area (m²) of polygons where the plane of sloped roofs is above a height, and its volume above that (m³)."""
    slope = roofs.plane[rows, :2]
    steepness = np.hypot(slope[:, 0], slope[:, 1])
    along = slope / steepness[:, None]
    bounds = shapely.bounds(polygons).reshape(-1, 4)
    centre, size = (bounds[:, :2] + bounds[:, 2:]) / 2, np.hypot(*(bounds[:, 2:] - bounds[:, :2]).T)
    distance = (level - plane_heights(roofs, rows, centre)) / steepness  # from the centre up to the level
    parts = polygons.copy()
    parts[distance >= size] = shapely.Polygon()
    cut = np.abs(distance) < size
    if cut.any():
        at = (centre + distance[:, None] * along)[cut]
        across = (np.column_stack((-along[:, 1], along[:, 0])) * size[:, None])[cut]
        onward = 2 * (along * size[:, None])[cut]
        half = np.stack((at - across, at + across, at + across + onward, at - across + onward), axis=1)
        parts[cut] = shapely.intersection(polygons[cut], shapely.polygons(half))
    area = shapely.area(parts)
    middle = shapely.get_coordinates(shapely.centroid(parts[area > 0]))
    volume = np.zeros(len(rows))
    some = np.flatnonzero(area > 0)
    volume[some] = area[some] * (plane_heights(roofs, rows[some], middle) - level[some])
    return area, volume
