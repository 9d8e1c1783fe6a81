"""A house drawn by rules on its lot, from the whole to its parts (paper, 3.1)."""

import math
import uuid
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import cast

import numpy as np

from pipeline.architecture.lots import Lot, lot_random
from pipeline.architecture.parameters import (
    BuildingPart,
    Chimney,
    Dormer,
    House,
    Opening,
    Rings,
    Roof,
    RoofShape,
    RoofWindow,
)
from pipeline.architecture.roof_sides import RoofSide, count_walls, list_sides, place, wall_length
from pipeline.architecture.rules import Distribution
from pipeline.architecture.surfaces import GROUND, Surface, to_town

CORNER = 1.5  # m, of alcoves from the corner of a courtyard
MARGIN = 0.3  # m between what stands on a roof or lies in a wall, and from its border
SILL, THRESHOLD = 0.9, 0.05  # m above the floor: windows, and the door
LEAST_RISE = 0.3  # m; a roof that rises less is flat
LEAST_WING, MOST_OVERHANG = 3.0, 0.7  # m, of houses that are no rectangles: two roofs fit over a yard
_IDS = uuid.UUID("5b1b7f0e-6f5a-5d0c-9a53-3c6f2c2f7b51")

Rules = Mapping[str, Distribution]
Ground = Callable[[float, float], float]


class _Dice:
    """Draws by rules with the random numbers of one lot."""

    def __init__(self, rules: Rules, rng: np.random.Generator) -> None:
        self._rules, self._rng = rules, rng

    def number(self, name: str) -> float:
        """Draw a length, to the millimetre, or another number."""
        return round(float(self._rules[name].draw(self._rng)), 3)

    def count(self, name: str) -> int:
        """Draw a whole number."""
        return round(float(self._rules[name].draw(self._rng)))

    def word(self, name: str) -> str:
        """Draw a word."""
        return str(self._rules[name].draw(self._rng))

    def happens(self, name: str) -> bool:
        """Draw whether something is there, by its probability."""
        return float(self._rng.random()) < float(self._rules[name].draw(self._rng))

    def between(self, low: float, high: float) -> float:
        """Draw a place between two others, to the millimetre."""
        return round(float(self._rng.uniform(low, max(low, high))), 3)


def draw_house(
    rules: Rules, lot: Lot, ground: Ground, *, seed: int, plan: Rings = (), rise: float | None = None
) -> House:
    """Draw a house.

    Parameters
    ----------
    rules : mapping of str to Distribution
        As from `make_rules`.
    lot : Lot
        Where it stands; a house that is too large for it is made smaller.
    ground : callable
        Gives the height of the ground at x, y (m).
    seed : int
        Not negative. The house depends on it, the rules and the lot alone.
    plan : tuple
        Its outline, as of `House`; by the rules where none is given.
    rise : float, optional
        Of its roof (m), instead of the pitch of the rules.

    Notes
    -----
    From the whole to its parts, as each depends on what was drawn before: size and storeys, roof, parts at walls,
    dormers, chimneys and windows on the roof where they fit, windows and doors last. Flat roofs have no dormers,
    doors are on the ground floor, windows are lower than the storey, dormers of a side are in one line, openings
    keep off parts and shared walls.
    """
    dice = _Dice(rules, lot_random(seed, lot.i, lot.j, 1))
    length, width = dice.number("length"), dice.number("width")
    footprint = dice.word("footprint")
    wing = 0.0 if footprint == "rectangle" else dice.number("wing")
    shape = cast("RoofShape", dice.word("roof_shape"))
    if lot.party:
        length = round(lot.size, 3)
        shape = "gabled" if shape in ("hipped", "pyramidal") else shape
    else:
        length, width = max(length, width), min(length, width)
        shrink = min(1.0, (lot.size - 2.0) / math.hypot(length, width))
        length, width = round(length * shrink, 3), round(width * shrink, 3)
        plan = plan or make_plan(footprint, length, width, wing)
    storeys = max(dice.count("storeys"), 1)
    height = round(storeys * dice.number("storey_height"), 3)
    pitch, overhang = dice.number("roof_pitch"), dice.number("overhang")
    house = House(
        id=f"UUID_{uuid.uuid5(_IDS, f'{seed}/{lot.i}/{lot.j}')}",
        x=0.0,
        y=0.0,
        z=0.0,
        rotation=round(lot.rotation, 3),
        length=length,
        width=width,
        height=height,
        storeys=storeys,
        embrasure=dice.number("embrasure"),
        wall_thickness=dice.number("wall_thickness"),
        roof=Roof("flat"),
        year=dice.count("year"),
        use=dice.word("use"),
        plan=plan,
    )
    roof = _make_roof(house, shape, pitch, 0.0 if lot.party else overhang)
    house = replace(house, roof=roof if rise is None else replace(roof, rise=rise))
    house = _settle(house, lot, ground)
    house = replace(house, parts=_draw_parts(dice, house, lot))
    house = _draw_on_roof(dice, house)
    return replace(house, openings=_draw_openings(dice, house, lot))


def make_plan(footprint: str, length: float, width: float, wing: float) -> Rings:
    """Make an outline whose wings have a depth (m), or less where yards would be narrower than wings.

    None, for a rectangle, if wings would be less than `LEAST_WING` deep.
    """
    lengthwise, across = {"L": (2, 2), "T": (3, 2), "U": (3, 2), "courtyard": (3, 3)}.get(footprint, (1, 1))
    a = math.floor(1000 * min(wing, length / lengthwise, width / across)) / 1000
    if a < LEAST_WING:
        return ()
    left, right = round((length - a) / 2, 3), round((length + a) / 2, 3)
    back, end = round(width - a, 3), round(length - a, 3)
    front = ((0.0, 0.0), (length, 0.0))
    return {
        "L": ((*front, (length, a), (a, a), (a, width), (0.0, width)),),
        "T": ((*front, (length, a), (right, a), (right, width), (left, width), (left, a), (0.0, a)),),
        "U": ((*front, (length, width), (end, width), (end, a), (a, a), (a, width), (0.0, width)),),
        "courtyard": ((*front, (length, width), (0.0, width)), ((end, a), (a, a), (a, back), (end, back))),
    }[footprint]


def _make_roof(house: House, shape: RoofShape, pitch: float, overhang: float) -> Roof:
    run = house.width if shape == "shed" else house.width / 2
    if house.plan:
        shape = "hipped" if shape == "pyramidal" else shape
        run = 1 / (list_sides(replace(house, roof=Roof(shape, 1.0)))[0].slope or math.inf)
        overhang = min(overhang, MOST_OVERHANG)
    rise = round(run * math.tan(math.radians(pitch)), 3)
    if shape == "flat" or rise < LEAST_RISE:
        shape, rise = "flat", 0.0
    if shape == "hipped" and not house.plan and house.length - house.width < 1.0:
        shape = "pyramidal"
    return Roof(shape, rise, overhang)


def _settle(house: House, lot: Lot, ground: Ground) -> House:
    """Put the middle of a house on the middle of its lot, and its foot on the lowest ground at its corners."""
    middle = (-house.length / 2, -house.width / 2, 0.0)
    (corner,) = to_town(replace(house, x=lot.x, y=lot.y), [Surface(GROUND, [middle], [])])[0].border
    house = replace(house, x=corner[0], y=corner[1])
    foot = [place(house, wall, 0.0, 0.0, 0.0) for wall in range(count_walls(house))]
    corners = to_town(house, [Surface(GROUND, foot, [])])[0].border
    return replace(house, z=round(min(float(ground(x, y)) for x, y, _ in corners), 3))


def _draw_parts(dice: _Dice, house: House, lot: Lot) -> tuple[BuildingPart, ...]:
    """Draw a garage at a side wall and an alcove behind a rectangle, lower than the eaves, inside the lot."""
    parts = []
    height = round(min(house.storey_height, house.height - 0.5), 3)
    garage, alcove = dice.happens("garage"), dice.happens("alcove")
    room = lot.size / 2 - 0.5
    depth = round(min(3.5, math.sqrt(max(room**2 - (house.width / 2) ** 2, 0.0)) - house.length / 2), 3)
    if garage and not lot.party and depth >= 2.4:
        wide = min(6.0, wall_length(house, 1) - 1.0)
        parts.append(BuildingPart("garage", 1, round(0.5, 3), round(wide, 3), depth, height))
    wide = round(min(4.0, house.length / 2), 3)
    deep = 1.5 if lot.party else min(2.5, math.sqrt(max(room**2 - (wide / 2 + 2.0) ** 2, 0.0)) - house.width / 2)
    if alcove and deep >= 1.0 and 2 not in lot.party and not house.plan:
        along = dice.between(0.5, house.length - wide - 0.5) if lot.party else round((house.length - wide) / 2, 3)
        if lot.corner:  # clear of alcoves of the next side
            along = min(max(along, CORNER), round(house.length - wide - CORNER, 3))
        parts.append(BuildingPart("alcove", 2, along, wide, round(deep, 3), height))
    return tuple(parts)


def _draw_on_roof(dice: _Dice, house: House) -> House:
    """Draw dormers in one line on the front, a chimney on the back, and windows between them, where they fit."""
    n_dormers, wide, tall = dice.count("dormers"), dice.number("dormer_width"), dice.number("dormer_height")
    gabled, has_chimney, n_windows = (
        dice.happens("dormer_gabled"),
        dice.happens("chimney"),
        dice.count("roof_windows"),
    )
    sides = list_sides(house)
    front, back = sides[0], sides[2] if len(sides) == 4 else sides[-1]
    long, far = wall_length(house, front.wall), wall_length(house, back.wall) * 0.3
    taken: list[tuple[float, float, float, float]] = []
    dormers: list[Dormer] = []
    if front.slope > 0:
        rise = round(wide / 2 * min(front.slope, 0.7), 3) if gabled else 0.0
        deep = (tall + rise) / front.slope
        for k in range(n_dormers):
            along = round((k + 1) * long / (n_dormers + 1) - wide / 2, 3)
            box = (along, 0.8, along + wide, 0.8 + deep)
            if _is_free(front, box, taken):
                taken.append(box)
                dormers.append(Dormer(front.wall, along, 0.8, wide, tall, rise))
    chimneys: list[Chimney] = []
    if has_chimney:
        top = max(v for _, v in back.ring)
        on_front = taken if back is front else []
        box = (far, top - 1.4, far + 0.6, top - 0.8)
        if _is_free(back, box, on_front):
            on_front.append(box)
            chimneys.append(Chimney(back.wall, round(box[0], 3), round(box[1], 3), 0.6, 0.8))
    windows: list[RoofWindow] = []
    if front.slope > 0:
        for _ in range(n_windows):
            along, up = (
                dice.between(0.5, long - 1.5),
                dice.between(0.6, max(v for _, v in front.ring) - 1.5),
            )
            box = (along, up, along + 0.8, up + 0.9)
            if _is_free(front, box, taken):
                taken.append(box)
                windows.append(RoofWindow(front.wall, along, up, 0.8, 0.9))
    return replace(house, dormers=tuple(dormers), chimneys=tuple(chimneys), roof_windows=tuple(windows))


def _is_free(
    side: RoofSide, box: tuple[float, float, float, float], taken: list[tuple[float, float, float, float]]
) -> bool:
    low, high = box[:2], box[2:]
    apart = all(
        box[2] + MARGIN <= other[0]
        or other[2] + MARGIN <= box[0]
        or box[3] + MARGIN <= other[1]
        or other[3] + MARGIN <= box[1]
        for other in taken
    )
    return apart and side.holds(low, high, MARGIN)


def _draw_openings(dice: _Dice, house: House, lot: Lot) -> tuple[Opening, ...]:
    """Draw a door in the front and rows of windows in each storey of each free wall."""
    wide, tall, apart = dice.number("window_width"), dice.number("window_height"), dice.number("window_distance")
    door_wide, door_tall = dice.number("door_width"), dice.number("door_height")
    tall = min(tall, house.storey_height - SILL - MARGIN)
    door_tall = min(door_tall, house.storey_height - MARGIN)
    openings: list[Opening] = []
    front = wall_length(house, 0)
    if front >= door_wide + 2 * MARGIN:
        along = round((front - door_wide) / 2, 3)
        openings.append(Opening("door", 0, along, THRESHOLD, door_wide, round(door_tall, 3)))
    for wall in range(count_walls(house)):
        if wall in lot.party or tall < 0.3:
            continue
        long = wall_length(house, wall)
        n = int((long - 2 * MARGIN + apart) / (wide + apart))
        first = (long - n * wide - (n - 1) * apart) / 2
        for storey in range(house.storeys):
            for k in range(n):
                along, sill = first + k * (wide + apart), storey * house.storey_height + SILL
                window = Opening("window", wall, round(along, 3), round(sill, 3), wide, round(tall, 3))
                if not _is_hidden(house, window) and not any(_is_close(window, other) for other in openings[:1]):
                    openings.append(window)
    return tuple(openings)


def _is_hidden(house: House, opening: Opening) -> bool:
    """Whether a part stands before it."""
    return any(
        part.wall == opening.wall
        and opening.sill < part.height + MARGIN
        and opening.along < part.along + part.width + MARGIN
        and part.along < opening.along + opening.width + MARGIN
        for part in house.parts
    )


def _is_close(one: Opening, other: Opening) -> bool:
    return (
        one.wall == other.wall
        and one.along < other.along + other.width + MARGIN
        and other.along < one.along + one.width + MARGIN
        and one.sill < other.sill + other.height + MARGIN
        and other.sill < one.sill + one.height + MARGIN
    )
