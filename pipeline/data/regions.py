"""Regions of a mesh: what its cells are filled with."""

from enum import IntEnum


class Region(IntEnum):
    """What a cell is filled with."""

    AIR = 0
    SOIL = 1
    BUILDING = 2


Regions = tuple[Region, ...]
