"""Degraded twins: a house with noise on its parameters, as acquisition has it, and the same id (paper, 4)."""

import uuid
from dataclasses import replace
from typing import TypeVar

import numpy as np

from pipeline.architecture.draw import MARGIN
from pipeline.architecture.parameters import Chimney, Dormer, House, RoofWindow
from pipeline.architecture.roof_sides import list_sides

LEAST = 0.5  # share of a length that noise leaves of it
OnRoof = TypeVar("OnRoof", Dormer, Chimney, RoofWindow)


def degrade_house(house: House, sigma: float, *, seed: int) -> House:
    """Add normal noise to position, sizes and heights.

    Parameters
    ----------
    house : House
        The house.
    sigma : float
        Standard deviation of place, foot, length, width, height of the eaves and rise of the roof (m).
    seed : int
        Not negative; the noise depends on it and the id alone.

    Notes
    -----
    What lies in walls keeps its share of them, what stands on a roof its share of the roof; where a roof of
    another form leaves no room for it, it is gone. Flat roofs stay flat.
    """
    number = uuid.uuid5(uuid.NAMESPACE_OID, house.id).int
    noise = np.random.default_rng([seed, 11, number]).normal(0.0, sigma, 7).tolist()
    length, width, height = (
        round(max(value + more, LEAST * value), 3)
        for value, more in zip((house.length, house.width, house.height), noise[3:6], strict=True)
    )
    rise = house.roof.rise
    rise = round(max(rise + noise[6], LEAST * rise), 3) if rise else 0.0
    x, y, z = (round(value + more, 3) for value, more in zip((house.x, house.y, house.z), noise[:3], strict=True))
    scale = (length / house.length, width / house.width)
    up = height / house.height
    twin = replace(
        house,
        **{"x": x, "y": y, "z": z, "length": length, "width": width, "height": height},
        roof=replace(house.roof, rise=rise),
        parts=tuple(
            replace(
                part,
                along=part.along * scale[part.wall % 2],
                width=part.width * scale[part.wall % 2],
                height=part.height * up,
            )
            for part in house.parts
        ),
        openings=tuple(
            replace(
                one,
                along=one.along * scale[one.wall % 2],
                width=one.width * scale[one.wall % 2],
                sill=one.sill * up,
                height=one.height * up,
            )
            for one in house.openings
        ),
        dormers=(),
        chimneys=(),
        roof_windows=(),
    )
    return replace(
        twin,
        dormers=_move(house.dormers, twin, scale),
        chimneys=_move(house.chimneys, twin, scale),
        roof_windows=_move(house.roof_windows, twin, scale),
    )


def _move(things: tuple[OnRoof, ...], twin: House, scale: tuple[float, float]) -> tuple[OnRoof, ...]:
    """Move things to their share of the twin's roof, with their own size; those that fit."""
    kept: list[OnRoof] = []
    sides = {side.wall: side for side in list_sides(twin)}
    for one in things:
        moved = replace(one, along=one.along * scale[one.side % 2], up=one.up * scale[1 - one.side % 2])
        side = sides[moved.side]
        if isinstance(moved, Dormer):
            deep = (moved.height + moved.rise) / side.slope
        else:
            deep = moved.width if isinstance(moved, Chimney) else moved.depth
        low, high = (moved.along, moved.up), (moved.along + moved.width, moved.up + deep)
        apart = all(
            other.side != moved.side
            or other.along + other.width < moved.along
            or moved.along + moved.width < other.along
            for other in kept
        )
        if apart and side.holds(low, high, MARGIN / 3):
            kept.append(moved)
    return tuple(kept)
