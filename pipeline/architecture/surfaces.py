"""Surfaces of a building: polygons in space, each of a kind, in the frame of the house or the CRS of the town."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from pipeline.architecture.parameters import Flat, House
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
    """A polygon in space."""

    kind: str  #: as CityGML names it: `GROUND`, `WALL`, `ROOF`, `WINDOW`, `DOOR` or `CLOSURE`
    border: list[Point]  #: its corners, counter-clockwise as seen from outside (m)
    holes: list[list[Point]]  #: clockwise

    def cut(self, hole: Sequence[Point]) -> None:
        """Cut a hole by its corners, counter-clockwise as seen from outside."""
        self.holes.append(list(reversed(hole)))


def fill_hole(surface: Surface, outer: Sequence[Point], inner: Sequence[Point], kind: str) -> list[Surface]:
    """Cut a hole into a surface and close it again: by a pane in it, or with sides to one before or behind it.

    Parameters
    ----------
    surface : Surface
        Gets the hole.
    outer : sequence of (float, float, float)
        Corners of the hole, counter-clockwise as seen from outside (m).
    inner : sequence of (float, float, float)
        Those of the pane, each opposite the one of `outer`.
    kind : str
        Of the pane; sides are walls.

    Returns
    -------
    list of Surface
        The sides, none where the pane is in the hole, then the pane.
    """
    surface.cut(outer)
    n = len(outer)
    sides = [
        Surface(WALL, [outer[k], outer[(k + 1) % n], inner[(k + 1) % n], inner[k]], [])
        for k in range(n if list(inner) != list(outer) else 0)
    ]
    return [*sides, Surface(kind, list(inner), [])]


def level_face(kind: str, rings: Sequence[Sequence[Flat]], z: float) -> Surface:
    """Give a level polygon of a border and courtyards, as of `wall_rings`: it looks down if it is ground."""
    border, *holes = ([(x, y, z) for x, y in ring[:: -1 if kind == GROUND else 1]] for ring in rings)
    return Surface(kind, border, holes)


def prism(ring: Sequence[Flat], low: float, high: float, holes: Sequence[Sequence[Flat]] = ()) -> list[Surface]:
    """Give the surfaces of a block over an outline: ground, roof and walls.

    Parameters
    ----------
    ring : sequence of (float, float)
        Corners, counter-clockwise from above (m).
    low, high : float
        Heights (m).
    holes : sequence of rings
        Courtyards, clockwise.
    """
    rings = [ring, *holes]
    walls = [
        Surface(WALL, [(*one, low), (*other, low), (*other, high), (*one, high)], [])
        for each in rings
        for one, other in zip(each, [*each[1:], each[0]], strict=True)
    ]
    return [level_face(GROUND, rings, low), *walls, level_face(ROOF, rings, high)]


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
