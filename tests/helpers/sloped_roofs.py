"""Houses with sloped roofs whose planes are known, and points on them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.roofs.roof_points import RoofPoints, make_roof_points

Array = NDArray[np.float64]
Roof = Callable[[Array, Array], Array]


@dataclass(frozen=True, eq=False)
class SlopedHouse:
    """A house: outline, heights over x and y, and the number of its planes."""

    outline: shapely.Polygon
    roof: Roof
    n_planes: int


def gable(x: Array, low: float, high: float, eave: float, slope: float) -> Array:
    """Two slopes that meet in the middle between `low` and `high`."""
    return eave + slope * np.minimum(x - low, high - x)


SHAPES = {
    "flat": SlopedHouse(shapely.box(0, 0, 10, 14), lambda x, y: 8.0 + 0 * x, 1),
    "shed": SlopedHouse(shapely.box(0, 0, 8, 12), lambda x, y: 6.0 + 0.35 * x, 1),
    "gable": SlopedHouse(shapely.box(0, 0, 9, 14), lambda x, y: gable(x, 0, 9, 6.0, 0.9), 2),
    "hip": SlopedHouse(
        shapely.box(0, 0, 10, 18),
        lambda x, y: 5.0 + 0.7 * np.minimum(np.minimum(x, 10 - x), np.minimum(y, 18 - y)),
        4,
    ),
    "pyramid": SlopedHouse(
        shapely.box(0, 0, 10, 10),
        lambda x, y: 7.0 + 0.6 * np.minimum(np.minimum(x, 10 - x), np.minimum(y, 10 - y)),
        4,
    ),
    "mansard": SlopedHouse(
        shapely.box(0, 0, 12, 15),
        lambda x, y: 6.0 + np.minimum(1.5 * np.minimum(x, 12 - x), 3.0 + 0.3 * np.minimum(x, 12 - x)),
        4,
    ),
    # A lower gable runs into the side of a higher one, with two valleys.
    "L": SlopedHouse(
        shapely.Polygon([(0, 0), (18, 0), (18, 6), (8, 6), (8, 20), (0, 20)]),
        lambda x, y: np.maximum(
            np.where(x <= 8, gable(x, 0, 8, 5.0, 0.8), -np.inf),
            np.where((x >= 4) & (y <= 6), gable(y, 0, 6, 5.0, 0.8), -np.inf),
        ),
        4,
    ),
    "flat with a low annex": SlopedHouse(shapely.box(0, 0, 10, 20), lambda x, y: np.where(y < 12, 12.0, 4.0), 2),
}


def scan_roof(house: SlopedHouse, *, density: float = 14.0, noise: float = 0.05, seed: int = 0) -> Array:
    """Points at random places of a house, with noise of that deviation in their heights (m)."""
    rng = np.random.default_rng(seed)
    low_x, low_y, high_x, high_y = house.outline.bounds
    n = round(density * (high_x - low_x) * (high_y - low_y))
    xy = rng.uniform((low_x, low_y), (high_x, high_y), (n, 2))
    xy = xy[shapely.contains_xy(house.outline, xy[:, 0], xy[:, 1])]
    return np.column_stack((xy, house.roof(xy[:, 0], xy[:, 1]) + rng.normal(0, noise, len(xy))))


def turn(xy: Array, angle: float, at: tuple[float, float]) -> Array:
    """Turn places counter-clockwise by an angle (degrees) about the origin, then move them."""
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.column_stack((cos * xy[:, 0] - sin * xy[:, 1] + at[0], sin * xy[:, 0] + cos * xy[:, 1] + at[1]))


def town_of_slopes(
    n: int, *, density: float = 14.0, noise: float = 0.05, seed: int = 0
) -> tuple[NDArray[np.object_], RoofPoints]:
    """Houses of all shapes in rows, each turned by an angle of its own, and points on their roofs."""
    rng = np.random.default_rng(seed)
    houses = list(SHAPES.values())
    outlines, points = np.empty(n, object), []
    for k in range(n):
        house, angle = houses[k % len(houses)], rng.uniform(0, 90)
        at = 120000.0 + 40 * (k % 10), 480000.0 + 40 * (k // 10)
        moved = affinity.rotate(house.outline, angle, origin=(0, 0))
        outlines[k] = affinity.translate(moved, *at)
        xyz = scan_roof(house, density=density, noise=noise, seed=seed + k)
        xyz[:, :2] = turn(xyz[:, :2], angle, at)
        inside = shapely.contains_xy(outlines[k], xyz[:, 0], xyz[:, 1])
        points.append(xyz[inside])
    start = np.cumsum([0, *(len(xyz) for xyz in points)])
    return outlines, make_roof_points(start, np.concatenate(points))
