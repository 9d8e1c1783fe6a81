"""Fitted roofs of a synthetic city beside the true ones, type by type."""

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import roof_heights
from pipeline.points_terrain.synthetic import ORIGIN, SyntheticCity, city_points, make_city
from pipeline.points_terrain.synthetic_roofs import ROOF_TYPES, shape_heights
from pipeline.roofs.house_roofs import HouseRoofs, RoofOptions, fit_roofs
from pipeline.roofs.roof_points import locate_roof_points

# Median distance (m) and share within 0.25 m that the roofs of each type must have, 0.3 m and more inside walls.
BARS = {
    "flat": (0.01, 0.999),
    "shed": (0.06, 0.98),
    "gable": (0.04, 0.95),
    "hip": (0.04, 0.85),
    "pyramid": (0.06, 0.9),
    "mansard": (0.08, 0.85),
}


def distances(city: SyntheticCity, fitted: HouseRoofs, house: int) -> NDArray[np.float64]:
    """Fitted less true heights (m) on a grid of half a metre within a house."""
    inner = shapely.buffer(city.polygons[house], -0.3)
    west, south, east, north = shapely.bounds(inner)
    x, y = (side.ravel() for side in np.meshgrid(np.arange(west, east, 0.5), np.arange(south, north, 0.5)))
    xy = np.column_stack((x, y))[shapely.contains_xy(inner, x, y)]
    found = np.full(len(xy), np.nan)
    for part in np.flatnonzero(fitted.parts.house == house):
        mine = shapely.intersects_xy(fitted.parts.polygons[part], *xy.T)
        found[mine] = roof_heights(fitted.roofs, np.full(int(mine.sum()), part), xy[mine])
    found -= shape_heights(city.shapes, np.full(len(xy), house), xy)
    return found


@pytest.mark.parametrize("density", [2.0, 6.0])
def test_fitted_roofs_are_the_true_ones(density: float) -> None:
    city = make_city(size=250.0, buildings=90, density=density, relief=10.0, seed=5, roofs="mixed")
    x, y = ORIGIN
    cloud = city_points(city, (x, y, x + 250, y + 250), (0, 0))
    points = locate_roof_points(cloud, city.polygons, building_class=True)
    fitted, _ = fit_roofs(city.polygons, points, RoofOptions(clearance=1.0))
    covered = np.bincount(shapely.STRtree(city.polygons).query(city.polygons, "overlaps")[0], minlength=90) > 0
    for kind, (name, (most, least)) in enumerate(BARS.items()):
        assert ROOF_TYPES[kind] == name
        houses = np.flatnonzero((city.shapes.kind == kind) & ~covered)
        assert len(houses) > 3
        off = np.abs(np.concatenate([distances(city, fitted, house) for house in houses.tolist()]))
        assert np.isfinite(off).all()
        assert np.median(off) <= most, name
        assert np.mean(off <= 0.25) >= least, name
