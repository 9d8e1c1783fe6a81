"""Surfaces of a building: polygons in space, each of a kind, in the frame of the house or the CRS of the town."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from pipeline.architecture.parameters import House
from pipeline.architecture.roof_sides import Point

GROUND, WALL, ROOF, WINDOW, DOOR, CLOSURE = (
    "GroundSurface",
    "WallSurface",
    "RoofSurface",
    "Window",
    "Door",
    "ClosureSurface",
)


@dataclass
class Surface:
    """A polygon in space.

    Attributes
    ----------
    kind : str
        As CityGML names it: `GROUND`, `WALL`, `ROOF`, `WINDOW`, `DOOR` or `CLOSURE`.
    border : list of (float, float, float)
        Its corners, counter-clockwise as seen from outside (m).
    holes : list of such lists
        Clockwise.
    """

    kind: str
    border: list[Point]
    holes: list[list[Point]]

    def cut(self, hole: Sequence[Point]) -> None:
        """Cut a hole by its corners, counter-clockwise as seen from outside."""
        self.holes.append(list(reversed(hole)))


def prism(ring: Sequence[tuple[float, float]], low: float, high: float) -> list[Surface]:
    """Give the surfaces of a block over an outline: ground, roof and walls.

    Parameters
    ----------
    ring : sequence of (float, float)
        Corners, counter-clockwise from above (m).
    low, high : float
        Heights (m).
    """
    down, up = [(x, y, low) for x, y in ring], [(x, y, high) for x, y in ring]
    walls = []
    for k in range(len(ring)):
        following = (k + 1) % len(ring)
        walls.append(Surface(WALL, [down[k], down[following], up[following], up[k]], []))
    return [Surface(GROUND, down[::-1], []), *walls, Surface(ROOF, up, [])]


def to_town(house: House, surfaces: Sequence[Surface]) -> list[Surface]:
    """Place surfaces in the frame of the house in the CRS of the town, with coordinates on whole millimetres."""
    angle = math.radians(house.rotation)
    cos, sin = math.cos(angle), math.sin(angle)
    x, y, z = np.array([place for one in surfaces for ring in (one.border, *one.holes) for place in ring]).T
    moved = np.round(np.column_stack((house.x + x * cos - y * sin, house.y + x * sin + y * cos, house.z + z)), 3)
    places = iter(map(tuple, moved.tolist()))

    def take(ring: Sequence[Point]) -> list[Point]:
        return list(islice(places, len(ring)))

    return [Surface(one.kind, take(one.border), [take(hole) for hole in one.holes]) for one in surfaces]
