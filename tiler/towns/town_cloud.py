"""A town as an airborne laser scanner sees it from above."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.architecture.heights import house_heights
from pipeline.architecture.levels import at_eaves
from pipeline.architecture.parameters import House
from pipeline.data.classes import BUILDING, GROUND
from pipeline.data.pointcloud import PointCloud
from tiler.towns.styles import Box, Town

GROUND_SIGMA, ROOF_SIGMA = 0.03, 0.05  # m


def scan_town(
    town: Town, box: Box, houses: Sequence[House], part: tuple[int, int], *, density: float
) -> PointCloud:
    """Draw the points of one file of a flight, given its box (m), numbers `part` and points per square metre.

    From right above: the highest of roof, overhang, dormer, chimney and ground at each place, of all houses that
    reach into the box, with normal noise of 3 cm on the ground and 5 cm on houses. Classes are without errors.
    """
    west, south, east, north = box
    rng = np.random.default_rng([town.seed, 5, part[0] % 2**32, part[1] % 2**32])
    n = round(density * (east - west) * (north - south))
    xy = np.round(np.column_stack((rng.uniform(west, east, n), rng.uniform(south, north, n))), 2)
    z = np.asarray(town.ground(xy[:, 0], xy[:, 1]), np.float64)
    high = np.full(n, -np.inf)
    order = np.argsort(xy[:, 0], kind="stable")
    sorted_x = xy[order, 0]
    for house in houses:
        whole = at_eaves(house)
        reach = float(np.hypot(whole.length, whole.width)) + max((one.depth for one in house.parts), default=0.0)
        rows = order[np.searchsorted(sorted_x, house.x - reach) : np.searchsorted(sorted_x, house.x + reach)]
        rows = rows[np.abs(xy[rows, 1] - house.y) <= reach]
        found = house_heights(house, xy[rows])
        high[rows] = np.fmax(high[rows], found)
    built = high > z
    z = np.where(built, high, z) + rng.normal(0.0, 1.0, n) * np.where(built, ROOF_SIGMA, GROUND_SIGMA)
    xyz: NDArray[np.float64] = np.column_stack((xy, np.round(z, 2)))
    return PointCloud(xyz, np.where(built, BUILDING, GROUND).astype(np.uint8))
