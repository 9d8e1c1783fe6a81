"""Degraded twins: a house with noise on its parameters, as acquisition has it, and the same id (paper, 4)."""

import math
import uuid
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from pipeline.architecture.draw import MARGIN
from pipeline.architecture.parameters import Chimney, Dormer, Flat, House, RoofWindow
from pipeline.architecture.roof_sides import list_sides, wall_frame

LEAST = 0.5  # share of a length that noise leaves of it
OnRoof = TypeVar("OnRoof", Dormer, Chimney, RoofWindow)


def degrade_house(house: House, sigma: float, *, seed: int) -> House:
    """Add normal noise to position, sizes and heights.

    Parameters
    ----------
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

    def stretch(wall: int) -> Flat:
        """How much longer the twin is along a wall, and away from it."""
        if not house.plan:
            return scale[wall % 2], scale[1 - wall % 2]
        _, (u, v) = wall_frame(house, wall)
        along = math.hypot(u * scale[0], v * scale[1])
        return along, scale[0] * scale[1] / along

    twin = replace(
        house,
        **{"x": x, "y": y, "z": z, "length": length, "width": width, "height": height},
        roof=replace(house.roof, rise=rise),
        plan=tuple(tuple((x * scale[0], y * scale[1]) for x, y in ring) for ring in house.plan),
        parts=tuple(
            replace(
                part,
                along=part.along * stretch(part.wall)[0],
                width=part.width * stretch(part.wall)[0],
                height=part.height * up,
            )
            for part in house.parts
        ),
        openings=tuple(
            replace(
                one,
                along=one.along * stretch(one.wall)[0],
                width=one.width * stretch(one.wall)[0],
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
        dormers=_move(house.dormers, twin, stretch),
        chimneys=_move(house.chimneys, twin, stretch),
        roof_windows=_move(house.roof_windows, twin, stretch),
    )


def _move(things: tuple[OnRoof, ...], twin: House, stretch: Callable[[int], Flat]) -> tuple[OnRoof, ...]:
    """Move things to their share of the twin's roof, with their own size; those that fit."""
    kept: list[OnRoof] = []
    sides = {side.wall: side for side in list_sides(twin)}
    for one in things:
        along, away = stretch(one.side)
        moved = replace(one, along=one.along * along, up=one.up * away)
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
