"""Heights of houses as a flight sees them: the highest place of roofs, overhangs, dormers and chimneys."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.architecture.parameters import BuildingPart, House
from pipeline.architecture.roof_sides import list_sides, wall_frame

Array = NDArray[np.float64]


def house_heights(house: House, xy: Array) -> Array:
    """Height of what is seen of a house from above.

    Parameters
    ----------
    house : House
        Its parameters.
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
    far = house.roof.overhang
    ends = far * sides[0].slope / sides[1].slope if house.roof.shape == "pyramidal" else far
    over = (x >= -ends) & (x <= house.length + ends) & (y >= -far) & (y <= house.width + far)
    roof = np.full(len(xy), np.inf)
    for side in sides:
        roof = np.minimum(roof, house.height + side.slope * _along_wall(house, side.wall, x, y)[1])
    height = np.where(over, roof, -np.inf)
    for dormer in house.dormers:
        u, v = _along_wall(house, dormer.side, x, y)
        slope = next(side.slope for side in sides if side.wall == dormer.side)
        half = dormer.width / 2
        tilt = dormer.rise / half
        ridge = house.height + slope * dormer.up + dormer.height + dormer.rise
        top = ridge - tilt * np.abs(u - dormer.along - half)
        inside = (np.abs(u - dormer.along - half) <= half) & (v >= dormer.up) & over
        height = np.where(inside, np.maximum(height, top), height)
    for chimney in house.chimneys:
        u, v = _along_wall(house, chimney.side, x, y)
        inside = (np.abs(u - chimney.along - chimney.width / 2) <= chimney.width / 2) & (
            np.abs(v - chimney.up - chimney.width / 2) <= chimney.width / 2
        )
        height[inside] = house.height + house.roof.rise + chimney.top
    for part in house.parts:
        inside = _is_in_part(house, part, x, y)
        height[inside] = np.maximum(height[inside], part.height)
    return np.where(np.isfinite(height), house.z + height, np.nan)


def _along_wall(house: House, wall: int, x: Array, y: Array) -> tuple[Array, Array]:
    """Places in the frame of a wall: along it, and inwards."""
    (x0, y0), (u, v) = wall_frame(house, wall)
    return (x - x0) * u + (y - y0) * v, (y - y0) * u - (x - x0) * v


def _is_in_part(house: House, part: BuildingPart, x: Array, y: Array) -> NDArray[np.bool_]:
    u, v = _along_wall(house, part.wall, x, y)
    inside: NDArray[np.bool_] = (u >= part.along) & (u <= part.along + part.width) & (v >= -part.depth) & (v <= 0)
    return inside
