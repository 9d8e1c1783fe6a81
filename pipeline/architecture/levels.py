"""A house in 16 levels of detail, from an outline to openings (paper, 3.2; the refined levels of CityGML)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import shapely

from pipeline.architecture.parameters import BuildingPart, Chimney, Dormer, Flat, House, Rings, RoofWindow
from pipeline.architecture.roof_sides import (
    along_wall,
    has_room,
    list_sides,
    offset_plan,
    place,
    wall_length,
    wall_rings,
)
from pipeline.architecture.shell import Detail, make_shell
from pipeline.architecture.surfaces import GROUND, ROOF, Surface, level_face, prism, to_town
from pipeline.data.errors import InputError

LEVELS = tuple(f"{whole}.{part}" for whole in range(4) for part in range(4))
LEAST_MARGIN = 0.02  # m, from the ends of a wall, of what lies in it after it was moved
FOOTPRINTS = ("walls", "eaves")
TOPS = {"eaves": 0.0, "third": 1 / 3, "half": 0.5, "two-thirds": 2 / 3, "ridge": 1.0}  # share of the roof's rise

Footprint = Literal["walls", "eaves"]
OnRoof = TypeVar("OnRoof", Dormer, Chimney, RoofWindow)

DETAILS = {
    "2.0": Detail(),
    "2.1": Detail(),
    "2.2": Detail(dormers=True),
    "2.3": Detail(dormers=True, chimneys=True, overhangs=True),
    "3.0": Detail(dormers=True, chimneys=True, overhangs=True, roof_windows=True),
    "3.1": Detail(dormers=True, chimneys=True, overhangs=True, openings=True),
    "3.2": Detail(dormers=True, chimneys=True, overhangs=True, roof_windows=True, openings=True),
    "3.3": Detail(dormers=True, chimneys=True, overhangs=True, roof_windows=True, openings=True, embrasures=True),
}


@dataclass(frozen=True)
class Volume:
    """A house, or a part of it, at a level of detail."""

    part: int  #: index into `House.parts`; -1 for the main body, or all of the house
    closed: bool  #: whether its surfaces are those of a solid
    surfaces: list[Surface]  #: in the CRS of the town (m)


def make_level(
    house: House,
    level: str,
    *,
    footprint: Footprint = "walls",
    top: str = "half",
    solid: bool = True,
) -> list[Volume]:
    """Make the geometry of a house at a level of detail.

    Parameters
    ----------
    level : str
        One of `LEVELS`.
    footprint : str
        Where its walls stand: ``"walls"``, as they are; ``"eaves"``, below the edges of the roof.
    top : str
        Height of the blocks of level 1: one of `TOPS`.
    solid : bool
        As solids, without chimneys and overhangs; else as surfaces with both.

    Returns
    -------
    list of Volume
        The main body first; parts are volumes of their own where the level tells them apart.

    Raises
    ------
    ValueError
        If there is no such level, footprint or height.

    Notes
    -----
    =====  ================================================================================================
    level  what it shows
    =====  ================================================================================================
    0.0    one rectangle around all; 0.1: the main body; 0.2: with its parts; 0.3: and the edges of the roof
    1.0    a block over 0.0; 1.1: over 0.1; 1.2: over 0.2; 1.3: each part as high as it is
    2.0    the roof; 2.1: and parts; 2.2: and dormers; 2.3: and chimneys and overhangs
    3.0    2.3 and windows in the roof; 3.1: 2.3 and windows and doors; 3.2: all of these; 3.3: deep in the wall
    =====  ================================================================================================

    Examples
    --------
    >>> from pipeline.architecture.parameters import Roof
    >>> house = House("h", 0, 0, 0, 0, 10, 8, 6, 2, 0.1, 0.3, Roof("gabled", 3.0))
    >>> [len(make_level(house, level)[0].surfaces) for level in ("0.1", "1.1", "2.0")]
    [1, 6, 7]
    """
    if level not in LEVELS or footprint not in FOOTPRINTS or top not in TOPS:
        raise ValueError(f"level {level}, footprint {footprint}, top {top}")
    shown = at_eaves(house) if footprint == "eaves" else house
    if level[0] in "01":
        volumes = make_blocks(shown, level, shown.height + TOPS[top] * shown.roof.rise)
    else:
        detail = DETAILS[level]
        if solid:
            detail = replace(detail, chimneys=False, overhangs=False)
        elif footprint == "eaves":
            detail = replace(detail, overhangs=False)
        closed = solid or not detail.overhangs or house.roof.overhang == 0
        volumes = [Volume(-1, closed, make_shell(shown, detail))]
        if level != "2.0":
            volumes += make_parts(shown)
    return [replace(volume, surfaces=to_town(shown, volume.surfaces)) for volume in volumes]


def at_eaves(house: House) -> House:
    """Move the walls of a house out below the edges of its roof; what lies in the walls stays where it was."""
    return move_walls(house, house.roof.overhang)


def move_walls(house: House, far: float) -> House:
    """Move the walls of a house out by a distance (m), in if it is negative; the planes of its roof stay."""
    roof = house.roof
    if far == 0:
        return house
    if house.plan:
        return _move_plan(house, far)
    sides = list_sides(house)
    fall = far * sides[0].slope
    ends = fall / sides[1].slope if roof.shape == "pyramidal" else far
    highest = house.height + roof.rise
    height = house.height - fall
    if roof.shape == "shed":
        highest += fall
    moved = replace(
        house,
        length=house.length + 2 * ends,
        width=house.width + 2 * far,
        height=height,
        roof=replace(roof, rise=highest - height, overhang=max(roof.overhang - far, 0.0)),
        parts=tuple(
            replace(part, along=part.along + (ends if part.wall % 2 == 0 else far)) for part in house.parts
        ),
        dormers=_move_in(house.dormers, far, ends),
        chimneys=_move_in(house.chimneys, far, ends),
        roof_windows=_move_in(house.roof_windows, far, ends),
        openings=tuple(
            replace(one, along=one.along + (ends if one.wall % 2 == 0 else far))
            for one in house.openings
            if one.sill + one.height < height
        ),
    )
    corner = to_town(house, [Surface(GROUND, [(-ends, -far, 0.0)], [])])[0].border[0]
    return replace(moved, x=corner[0], y=corner[1])


def _move_plan(house: House, far: float) -> House:
    """Move the walls of a plan; its frame stays where it is, and what lies in a wall that is too short is gone."""
    if not has_room(house, far):
        raise InputError(f"house {house.id}: its walls cannot stand {far:g} m further out; change its plan")
    sides = list_sides(house)
    height = house.height - far * sides[0].slope
    bare = replace(house, plan=offset_plan(house, far), roof=replace(house.roof, rise=1.0))
    rise = sides[0].slope / list_sides(bare)[0].slope if house.roof.shape != "flat" else 0.0

    def shift(wall: int) -> tuple[float, float]:
        along, away = along_wall(bare, wall, *place(house, wall, 0.0, 0.0, 0.0)[:2])
        return float(along), float(away)

    def keep(things: Sequence[OnRoof]) -> tuple[OnRoof, ...]:
        moves = [shift(one.side) for one in things]
        return tuple(
            replace(one, along=one.along + along, up=one.up + away)
            for one, (along, away) in zip(things, moves, strict=True)
        )

    return replace(
        bare,
        length=house.length + 2 * far,
        width=house.width + 2 * far,
        height=height,
        roof=replace(house.roof, rise=rise, overhang=max(house.roof.overhang - far, 0.0)),
        parts=tuple(replace(part, along=part.along + shift(part.wall)[0]) for part in house.parts),
        dormers=keep(house.dormers),
        chimneys=keep(house.chimneys),
        roof_windows=keep(house.roof_windows),
        openings=tuple(
            replace(one, along=along)
            for one in house.openings
            if one.sill + one.height < height
            and (along := one.along + shift(one.wall)[0]) > LEAST_MARGIN
            and along + one.width < wall_length(bare, one.wall) - LEAST_MARGIN
        ),
    )


def _move_in(things: Sequence[OnRoof], far: float, ends: float) -> tuple[OnRoof, ...]:
    """Keep what stands on a roof where it is; front and back walls move out by `far`, the others by `ends`."""
    shifts = ((ends, far), (far, ends))  # along a wall and away from it, by the wall's parity
    return tuple(
        replace(one, along=one.along + shifts[one.side % 2][0], up=one.up + shifts[one.side % 2][1])
        for one in things
    )


def part_ring(house: House, part: BuildingPart) -> list[Flat]:
    """Outline of a part in the frame of the house, counter-clockwise from above."""
    left, right = part.along, part.along + part.width
    flats = ((left, -part.depth), (right, -part.depth), (right, 0.0), (left, 0.0))
    return [place(house, part.wall, along, away, 0.0)[:2] for along, away in flats]


def outline_rings(house: House) -> Rings:
    """Outline of the main body and its parts in the frame of the house: its border, then courtyards."""
    border, *holes = wall_rings(house)
    rings = [shapely.Polygon(border, holes), *(shapely.Polygon(part_ring(house, part)) for part in house.parts)]
    union = shapely.orient_polygons(shapely.union_all(rings, grid_size=1e-6))
    return tuple(
        tuple((float(x), float(y)) for x, y in ring.coords[:-1]) for ring in (union.exterior, *union.interiors)
    )


def _bounding_rings(house: House) -> Rings:
    corners = [wall_rings(house)[0], *(part_ring(house, part) for part in house.parts)]
    xs, ys = zip(*(corner for ring in corners for corner in ring), strict=True)
    low_x, high_x, low_y, high_y = min(xs), max(xs), min(ys), max(ys)
    return (((low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y)),)


def level_rings(house: House, level: str) -> Rings:
    """Outline of a house at level 0 or 1, in its frame, as `outline_rings`."""
    return {"0": _bounding_rings, "1": wall_rings, "2": outline_rings, "3": outline_rings}[level[2]](house)


def make_blocks(house: House, level: str, top: float) -> list[Volume]:
    """Make a house at level 0 or 1, in its frame; blocks of its main body are `top` high (m)."""
    if level[0] == "1":
        ring, *holes = level_rings(house, "1.1" if level == "1.3" else level)
        return [Volume(-1, True, prism(ring, 0.0, top, holes)), *(make_parts(house) if level == "1.3" else [])]
    surfaces = [level_face(GROUND, level_rings(house, level), 0.0)]
    if level == "0.3":
        eaves = at_eaves(house)
        shift = (0.0, 0.0) if house.plan else ((eaves.length - house.length) / 2, (eaves.width - house.width) / 2)
        edges = [[(x - shift[0], y - shift[1]) for x, y in ring] for ring in wall_rings(eaves)]
        surfaces.append(level_face(ROOF, edges, eaves.height))
        surfaces += [level_face(ROOF, [part_ring(house, part)], part.height) for part in house.parts]
    return [Volume(-1, False, surfaces)]


def make_parts(house: House) -> list[Volume]:
    """Make the blocks of the parts of a house, in its frame."""
    return [Volume(k, True, prism(part_ring(house, part), 0.0, part.height)) for k, part in enumerate(house.parts)]
