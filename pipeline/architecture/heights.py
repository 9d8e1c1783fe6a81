"""Heights of houses as a flight sees them: the highest place of roofs, overhangs, dormers and chimneys."""

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.architecture.levels import at_eaves
from pipeline.architecture.parameters import BuildingPart, House
from pipeline.architecture.roof_sides import along_wall, list_sides

Array = NDArray[np.float64]


def house_heights(house: House, xy: Array) -> Array:
    """Height of what is seen of a house from above.

    Parameters
    ----------
    xy : float64, (n, 2)
        Places in the CRS of the town (m).

    Returns
    -------
    float64, (n,)
        Heights (m); NaN beside the house. Roofs are seen with their overhangs.
    """
    angle = math.radians(house.rotation)
    east, north = xy[:, 0] - house.x, xy[:, 1] - house.y
    x, y = east * math.cos(angle) + north * math.sin(angle), north * math.cos(angle) - east * math.sin(angle)
    sides = list_sides(house)
    height = _plan_heights(at_eaves(house), x, y) if house.plan else _roof_heights(house, x, y)
    over = np.isfinite(height)
    for dormer in house.dormers:
        u, v = along_wall(house, dormer.side, x, y)
        slope = next(side.slope for side in sides if side.wall == dormer.side)
        half = dormer.width / 2
        tilt = dormer.rise / half
        ridge = house.height + slope * dormer.up + dormer.height + dormer.rise
        top = ridge - tilt * np.abs(u - dormer.along - half)
        inside = (np.abs(u - dormer.along - half) <= half) & (v >= dormer.up) & over
        height = np.where(inside, np.maximum(height, top), height)
    for chimney in house.chimneys:
        u, v = along_wall(house, chimney.side, x, y)
        inside = (np.abs(u - chimney.along - chimney.width / 2) <= chimney.width / 2) & (
            np.abs(v - chimney.up - chimney.width / 2) <= chimney.width / 2
        )
        height[inside] = house.height + house.roof.rise + chimney.top
    for part in house.parts:
        inside = _is_in_part(house, part, x, y)
        height[inside] = np.maximum(height[inside], part.height)
    return np.where(np.isfinite(height), house.z + height, np.nan)


def _roof_heights(house: House, x: Array, y: Array) -> Array:
    """Height of a roof with its overhangs above the ground; -inf beside it."""
    sides, far = list_sides(house), house.roof.overhang
    ends = far * sides[0].slope / sides[1].slope if house.roof.shape == "pyramidal" else far
    over = (x >= -ends) & (x <= house.length + ends) & (y >= -far) & (y <= house.width + far)
    roof = np.full(len(x), np.inf)
    for side in sides:
        roof = np.minimum(roof, house.height + side.slope * along_wall(house, side.wall, x, y)[1])
    return np.where(over, roof, -np.inf)


def _plan_heights(house: House, x: Array, y: Array) -> Array:
    """Height of a roof without overhangs over a plan, as `_roof_heights`: of each side over its own polygon."""
    height = np.full(len(x), -np.inf)
    for side in list_sides(house):
        u, v = along_wall(house, side.wall, x, y)
        over = shapely.intersects_xy(side.polygon, u, v)
        height = np.where(over, np.maximum(height, house.height + side.slope * v), height)
    return height


def _is_in_part(house: House, part: BuildingPart, x: Array, y: Array) -> NDArray[np.bool_]:
    u, v = along_wall(house, part.wall, x, y)
    inside: NDArray[np.bool_] = (u >= part.along) & (u <= part.along + part.width) & (v >= -part.depth) & (v <= 0)
    return inside
