"""The shell of a house: ground, walls and roof, with dormers, chimneys, windows and doors where asked for."""

from dataclasses import dataclass

from pipeline.architecture.parameters import Chimney, Dormer, Flat, House, Opening, RoofWindow
from pipeline.architecture.roof_sides import (
    Point,
    RoofSide,
    count_walls,
    list_sides,
    overhang_strips,
    place,
    wall_ring,
    wall_rings,
)
from pipeline.architecture.surfaces import (
    CLOSURE,
    DOOR,
    GROUND,
    ROOF,
    WALL,
    WINDOW,
    Surface,
    fill_hole,
    level_face,
)


@dataclass(frozen=True)
class Detail:
    """What a shell shows."""

    #: each of these
    dormers: bool = False
    chimneys: bool = False
    overhangs: bool = False
    roof_windows: bool = False
    openings: bool = False
    embrasures: bool = False  #: whether windows and doors lie deep in the wall; else they are flush with it


def make_shell(house: House, detail: Detail) -> list[Surface]:
    """Make the surfaces of the main body, in the frame of the house.

    Notes
    -----
    Without overhangs they are closed: each edge is there once in each direction. What stands on a roof or lies in
    a wall fills a hole that is cut for it. Under a chimney the usable volume ends at a closure surface in the roof
    (paper, 3.2.2), so that it is closed with the chimney or without.
    """
    surfaces: list[Surface] = []
    for wall in range(count_walls(house)):
        ring = wall_ring(house, wall)
        front = Surface(WALL, [place(house, wall, along, 0.0, z) for along, z in ring], [])
        surfaces.append(front)
        if detail.openings:
            for opening in house.openings:
                if opening.wall == wall:
                    surfaces += _set_opening(house, front, opening, house.embrasure if detail.embrasures else 0.0)
    surfaces.append(level_face(GROUND, wall_rings(house), 0.0))
    for side in list_sides(house):
        surfaces += _cover_side(house, side, detail)
    if detail.overhangs:
        for wall, slope, strip in overhang_strips(house):
            surfaces.append(Surface(ROOF, [_on_roof(house, wall, slope, flat) for flat in strip], []))
    return surfaces


def _on_roof(house: House, wall: int, slope: float, flat: Flat) -> Point:
    return place(house, wall, flat[0], flat[1], house.height + slope * flat[1])


def _cover_side(house: House, side: RoofSide, detail: Detail) -> list[Surface]:
    border, *holes = (
        [_on_roof(house, side.wall, side.slope, flat) for flat in ring] for ring in (side.ring, *side.holes)
    )
    if side.rises:
        border = [(x, y, house.height + rise) for (x, y, _), rise in zip(border, side.rises, strict=True)]
    roof = Surface(ROOF, border, holes)
    found = [roof]
    if detail.dormers:
        for dormer in house.dormers:
            if dormer.side == side.wall:
                found += _put_dormer(house, side, roof, dormer, detail)
    if detail.chimneys:
        for chimney in house.chimneys:
            if chimney.side == side.wall:
                found += _put_chimney(house, side, roof, chimney)
    if detail.roof_windows:
        for window in house.roof_windows:
            if window.side == side.wall:
                found.append(_put_roof_window(house, side, roof, window))
    return found


def _set_opening(house: House, wall: Surface, opening: Opening, depth: float) -> list[Surface]:
    """Cut a hole for a window or a door, and fill it: flush, or at some depth behind its reveals."""
    left, right = opening.along, opening.along + opening.width
    low, high = opening.sill, opening.sill + opening.height
    corners = [(left, low), (right, low), (right, high), (left, high)]
    outer = [place(house, opening.wall, along, 0.0, z) for along, z in corners]
    inner = [place(house, opening.wall, along, depth, z) for along, z in corners]
    return fill_hole(wall, outer, inner, WINDOW if opening.kind == "window" else DOOR)


def _put_dormer(house: House, side: RoofSide, roof: Surface, dormer: Dormer, detail: Detail) -> list[Surface]:
    """Put a dormer on a roof: a front wall, two sides, and a flat roof or two that meet in a ridge."""
    left, right, front = dormer.along, dormer.along + dormer.width, dormer.up
    low = house.height + side.slope * front
    high, back = low + dormer.height, front + dormer.height / side.slope
    middle = (left + right) / 2

    def at(along: float, away: float, z: float) -> Point:
        return place(house, side.wall, along, away, z)

    a, b = at(left, front, low), at(right, front, low)
    a_up, b_up = at(left, front, high), at(right, front, high)
    c, d = at(right, back, high), at(left, back, high)
    sides = [Surface(WALL, [b, c, b_up], []), Surface(WALL, [d, a, a_up], [])]
    if dormer.rise > 0:
        ridge = front + (dormer.height + dormer.rise) / side.slope
        tip, end = at(middle, front, high + dormer.rise), at(middle, ridge, high + dormer.rise)
        roof.cut([a, b, c, end, d])
        wall = Surface(WALL, [a, b, b_up, tip, a_up], [])
        tops = [Surface(ROOF, [b_up, c, end, tip], []), Surface(ROOF, [tip, end, d, a_up], [])]
    else:
        roof.cut([a, b, c, d])
        wall = Surface(WALL, [a, b, b_up, a_up], [])
        tops = [Surface(ROOF, [a_up, b_up, c, d], [])]
    found = [wall, *sides, *tops]
    if detail.openings and dormer.window > 0:
        wide, tall = dormer.window * dormer.width / 2, dormer.window * dormer.height / 2
        centre = (low + high) / 2
        pane = [
            at(middle - wide, front, centre - tall),
            at(middle + wide, front, centre - tall),
            at(middle + wide, front, centre + tall),
            at(middle - wide, front, centre + tall),
        ]
        wall.cut(pane)
        found.append(Surface(WINDOW, pane, []))
    return found


def _rectangle(house: House, side: RoofSide, low: Flat, size: Flat) -> list[Point]:
    """Corners of a rectangle in plan on a roof, counter-clockwise from above."""
    (u, v), (du, dv) = low, size
    corners = ((u, v), (u + du, v), (u + du, v + dv), (u, v + dv))
    return [_on_roof(house, side.wall, side.slope, flat) for flat in corners]


def _put_chimney(house: House, side: RoofSide, roof: Surface, chimney: Chimney) -> list[Surface]:
    foot = _rectangle(house, side, (chimney.along, chimney.up), (chimney.width, chimney.width))
    top = house.height + house.roof.rise + chimney.top
    head = [(x, y, top) for x, y, _ in foot]
    roof.cut(foot)
    walls = [Surface(WALL, [foot[k], foot[(k + 1) % 4], head[(k + 1) % 4], head[k]], []) for k in range(4)]
    return [*walls, Surface(CLOSURE, head, [])]


def _put_roof_window(house: House, side: RoofSide, roof: Surface, window: RoofWindow) -> Surface:
    pane = _rectangle(house, side, (window.along, window.up), (window.width, window.depth))
    roof.cut(pane)
    return Surface(WINDOW, pane, [])
