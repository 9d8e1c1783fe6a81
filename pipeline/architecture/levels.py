"""A house in 16 levels of detail, from an outline to openings (paper, 3.2; the refined levels of CityGML)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import shapely

from pipeline.architecture.parameters import WALLS, BuildingPart, Chimney, Dormer, House, RoofWindow
from pipeline.architecture.roof_sides import Flat, list_sides, place
from pipeline.architecture.shell import Detail, make_shell
from pipeline.architecture.surfaces import GROUND, ROOF, Surface, prism, to_town

LEVELS = tuple(f"{whole}.{part}" for whole in range(4) for part in range(4))
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
    """A house, or a part of it, at a level of detail.

    Attributes
    ----------
    part : int
        Index into `House.parts`; -1 for the main body, or all of the house.
    closed : bool
        Whether its surfaces are those of a solid.
    surfaces : list of Surface
        In the CRS of the town (m).
    """

    part: int
    closed: bool
    surfaces: list[Surface]


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
    house : House
        Its parameters.
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


def outline_ring(house: House) -> list[Flat]:
    """Outline of the main body and its parts in the frame of the house, counter-clockwise from above."""
    rings = [_body_ring(house), *(part_ring(house, part) for part in house.parts)]
    union = shapely.union_all([shapely.Polygon(ring) for ring in rings], grid_size=1e-6)
    ring = shapely.get_coordinates(shapely.orient_polygons(shapely.get_exterior_ring(union)))
    if not shapely.is_ccw(shapely.linearrings(ring)):
        ring = ring[::-1]
    return [(float(x), float(y)) for x, y in ring[:-1]]


def _body_ring(house: House) -> list[Flat]:
    return [place(house, wall, 0.0, 0.0, 0.0)[:2] for wall in range(WALLS)]


def _bounding_ring(house: House) -> list[Flat]:
    corners = [_body_ring(house), *(part_ring(house, part) for part in house.parts)]
    xs, ys = zip(*(corner for ring in corners for corner in ring), strict=True)
    low_x, high_x, low_y, high_y = min(xs), max(xs), min(ys), max(ys)
    return [(low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y)]


def level_ring(house: House, level: str) -> list[Flat]:
    """Outline of a house at level 0 or 1, in its frame, counter-clockwise from above."""
    return {"0": _bounding_ring, "1": _body_ring, "2": outline_ring, "3": outline_ring}[level[2]](house)


def make_blocks(house: House, level: str, top: float) -> list[Volume]:
    """Make a house at level 0 or 1, in its frame; blocks of its main body are `top` high (m)."""
    ring = level_ring(house, level)
    if level[0] == "1":
        if level == "1.3":
            return [Volume(-1, True, prism(_body_ring(house), 0.0, top)), *make_parts(house)]
        return [Volume(-1, True, prism(ring, 0.0, top))]
    surfaces = [Surface(GROUND, [(x, y, 0.0) for x, y in reversed(ring)], [])]
    if level == "0.3":
        eaves = at_eaves(house)
        shift = (eaves.length - house.length) / 2, (eaves.width - house.width) / 2
        edge = [(x - shift[0], y - shift[1], eaves.height) for x, y in _body_ring(eaves)]
        surfaces.append(Surface(ROOF, edge, []))
        surfaces += [
            Surface(ROOF, [(x, y, part.height) for x, y in part_ring(house, part)], []) for part in house.parts
        ]
    return [Volume(-1, False, surfaces)]


def make_parts(house: House) -> list[Volume]:
    """Make the blocks of the parts of a house, in its frame."""
    return [Volume(k, True, prism(part_ring(house, part), 0.0, part.height)) for k, part in enumerate(house.parts)]
