"""The sides of a roof: one over each wall that it slopes down to, in the frame of that wall."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import shapely

from pipeline.architecture.parameters import Flat, House, Rings
from pipeline.data.errors import GeometryError
from pipeline.skeletons.skeleton_roofs import RoofForm, ShapedRoof, skeleton_roofs
from pipeline.skeletons.straight_skeleton import outline_edges

Point = tuple[float, float, float]

ON_WALL = 1e-6  # m, off a wall, of what stands on it
LEAST_OUT = 0.05  # m, beyond the lowest wall of a shed, that a plan may reach


@dataclass(frozen=True)
class RoofSide:
    """A plane of a roof."""

    wall: int  #: wall at its eaves
    slope: float  #: metres up for each metre away from the wall
    ring: tuple[Flat, ...]  #: its corners, counter-clockwise from above: along the wall, and away from it (m)
    holes: Rings = ()  #: courtyards in it, clockwise
    #: height of each corner above the eaves (m): nodes of a skeleton that are closer than 5 mm are one, and lie
    #: off the plane by as much at most. None where corners lie on it
    rises: tuple[float, ...] = ()

    @property
    def polygon(self) -> shapely.Polygon:
        """Its outline in plan."""
        return shapely.Polygon(self.ring, self.holes)

    def holds(self, low: Flat, high: Flat, margin: float) -> bool:
        """Tell whether a rectangle lies inside, with a margin (m) to the border."""
        if self.holes or len(self.ring) > 4:
            return bool(self.polygon.buffer(-margin).covers(shapely.box(*low, *high)))
        corners = (low, (high[0], low[1]), high, (low[0], high[1]))
        for k, (x, y) in enumerate(self.ring):
            to_x, to_y = self.ring[(k + 1) % len(self.ring)]
            along_x, along_y = to_x - x, to_y - y
            far = (along_x**2 + along_y**2) ** 0.5 * margin
            if any(along_x * (v - y) - along_y * (u - x) < far for u, v in corners):
                return False
        return True


def wall_rings(house: House) -> Rings:
    """Corners of the main body in its frame; walls are numbered along them, each from its own corner."""
    length, width = house.length, house.width
    return house.plan or (((0.0, 0.0), (length, 0.0), (length, width), (0.0, width)),)


def count_walls(house: House) -> int:
    """Number of walls of the main body."""
    return sum(map(len, wall_rings(house)))


@lru_cache(maxsize=64)
def _edges(plan: Rings) -> tuple[tuple[Flat, Flat, float], ...]:
    """Start, direction and length of each wall."""
    found = []
    for ring in plan:
        for k, (x, y) in enumerate(ring):
            to_x, to_y = ring[(k + 1) % len(ring)]
            long = math.hypot(to_x - x, to_y - y)
            found.append(((x, y), ((to_x - x) / long, (to_y - y) / long), long))
    return tuple(found)


def wall_length(house: House, wall: int) -> float:
    """Length of a wall (m)."""
    if house.plan:
        return _edges(house.plan)[wall][2]
    return house.length if wall % 2 == 0 else house.width


def wall_frame(house: House, wall: int) -> tuple[Flat, Flat]:
    """Where a wall begins and its direction, in the frame of the house; the inside is on its left."""
    if house.plan:
        return _edges(house.plan)[wall][:2]
    directions = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
    return wall_rings(house)[0][wall], directions[wall]


def place(house: House, wall: int, along: float, away: float, z: float) -> Point:
    """Give a place in the frame of the house by its place in that of a wall: along it, inwards, and up (m)."""
    (x, y), (u, v) = wall_frame(house, wall)
    return x + along * u - away * v, y + along * v + away * u, z


def along_wall(house: House, wall: int, x: Any, y: Any) -> tuple[Any, Any]:
    """Give places of the frame of the house in that of a wall: along it, and inwards; numbers or arrays (m)."""
    (x0, y0), (u, v) = wall_frame(house, wall)
    return (x - x0) * u + (y - y0) * v, (y - y0) * u - (x - x0) * v


def list_sides(house: House) -> list[RoofSide]:
    """List the planes of a roof.

    Notes
    -----
    Their corners are those of the walls and of the ridge. A hipped roof whose ridge would have no length is a
    pyramid; ends of a hipped roof are as steep as its sides. Over a plan they are the faces of its straight
    skeleton; flat roofs and sheds have one plane, of wall 0.
    """
    length, width, rise = house.length, house.width, house.roof.rise
    shape = house.roof.shape
    if house.plan:
        return _plan_sides(house)
    if shape in ("flat", "shed"):
        slope = rise / width if shape == "shed" else 0.0
        return [RoofSide(0, slope, ((0.0, 0.0), (length, 0.0), (length, width), (0.0, width)))]
    half = width / 2
    if shape == "gabled":
        ring = ((0.0, 0.0), (length, 0.0), (length, half), (0.0, half))
        return [RoofSide(wall, rise / half, ring) for wall in (0, 2)]
    sides = []
    for wall in range(4):
        long = wall_length(house, wall)
        ends = half if shape == "hipped" else long / 2  # of the ridge, from the corners
        if wall % 2:
            ends = long / 2
        run = half if shape == "hipped" or wall % 2 == 0 else length / 2
        top = ((long - ends, run), (ends, run)) if long - 2 * ends > 1e-9 else ((long / 2, run),)
        sides.append(RoofSide(wall, rise / run, ((0.0, 0.0), (long, 0.0), *top)))
    return sides


@lru_cache(maxsize=64)
def _roof_over(plan: Rings, shape: str) -> tuple[ShapedRoof, list[int]]:
    """A roof that rises by 1 m from eaves at 0, by the straight skeleton of a plan, and the wall of each part."""
    roof = skeleton_roofs(shapely.Polygon(plan[0], plan[1:]), 0.0, RoofForm(shape, height=1.0))
    wall = {corner: k for k, (corner, *_) in enumerate(_edges(plan))}
    starts = outline_edges(roof.polygon)[roof.edge, 0].tolist()
    return roof, [wall[x, y] for x, y in starts]


def _plan_sides(house: House) -> list[RoofSide]:
    if house.roof.shape in ("flat", "shed"):
        ring, *holes = (tuple(along_wall(house, 0, x, y) for x, y in ring) for ring in house.plan)
        if house.roof.shape == "shed" and min(v for _, v in ring) < -LEAST_OUT:
            raise GeometryError(
                f"house {house.id}: its plan reaches beyond wall 0, where its shed is lowest; begin it elsewhere"
            )
        deep = max(v for _, v in ring)
        return [RoofSide(0, house.roof.rise / deep if house.roof.shape == "shed" else 0.0, ring, tuple(holes))]
    roof, walls = _roof_over(house.plan, house.roof.shape)
    slopes = (house.roof.rise * (roof.roofs.plane[:, :2] ** 2).sum(axis=1) ** 0.5).tolist()
    sides = []
    for i, (wall, slope) in enumerate(zip(walls, slopes, strict=True)):
        ring = tuple(along_wall(house, wall, x, y) for x, y in roof.nodes[roof.cycle(i)].tolist())
        rises = tuple((house.roof.rise * roof.height[roof.cycle(i)]).tolist())
        sides.append(RoofSide(wall, slope, ring, rises=rises))
    return sorted(sides, key=lambda side: side.wall)


def wall_ring(house: House, wall: int) -> list[Flat]:
    """Corners of a wall as seen from outside, counter-clockwise: along it, and up (m)."""
    long, low, high = wall_length(house, wall), house.height, house.height + house.roof.rise
    if house.plan:
        return [(0.0, 0.0), (long, 0.0), *_plan_top(house, wall)[::-1]]
    left, right = low, low
    top: list[Flat] = []
    if house.roof.shape == "shed":
        left = high if wall in (2, 3) else low
        right = high if wall in (1, 2) else low
    elif house.roof.shape == "gabled" and wall % 2:
        top = [(long / 2, high)]
    return [(0.0, 0.0), (long, 0.0), (long, right), *top, (0.0, left)]


def _plan_top(house: House, wall: int) -> list[Flat]:
    """The upper edge of a wall from its start to its end: along it, and up."""
    long, low = wall_length(house, wall), house.height
    if house.roof.shape in ("flat", "shed"):
        (side,) = _plan_sides(house)
        ends = (
            (along, along_wall(house, 0, *place(house, wall, along, 0.0, 0.0)[:2])[1]) for along in (0.0, long)
        )
        return [(along, low + side.slope * away) for along, away in ends]
    roof, walls = _roof_over(house.plan, house.roof.shape)
    top = {0.0: low, long: low}
    if wall not in walls:  # a gable
        for (x, y), rise in zip(roof.nodes.tolist(), roof.height.tolist(), strict=True):
            along, away = along_wall(house, wall, x, y)
            along = next((end for end in (0.0, long) if abs(along - end) < ON_WALL), along)
            if abs(away) < ON_WALL and 0 <= along <= long:
                top[along] = max(top.get(along, low), low + house.roof.rise * rise)
    return sorted(top.items())


def offset_plan(house: House, far: float) -> Rings:
    """Move the walls of a plan out (m), in where negative, each such that the planes of the roof stay."""
    sides = list_sides(house)
    one_plane = house.roof.shape in ("flat", "shed")
    slopes = {} if one_plane else {side.wall: side.slope for side in sides}
    fall = far * sides[0].slope
    found, first = [], 0
    for ring in house.plan:
        n = len(ring)
        walls = [(_edges(house.plan)[first + k][1], first + k) for k in range(n)]
        normals = [((v, -u), fall / slopes[wall] if wall in slopes else far) for (u, v), wall in walls]
        found.append(tuple(_meet(ring[k], *normals[k - 1], *normals[k]) for k in range(n)))
        first += n
    return tuple(found)


def _meet(corner: Flat, one: Flat, far: float, other: Flat, beyond: float) -> Flat:
    """Where two walls of a corner meet after each has moved along its normal."""
    (a, b), (c, d) = one, other
    det = a * d - b * c
    if abs(det) < 1e-9:  # they are on one line
        return corner[0] + far * a, corner[1] + far * b
    return corner[0] + (far * d - beyond * b) / det, corner[1] + (beyond * a - far * c) / det


def has_room(house: House, far: float) -> bool:
    """Tell whether the walls of a plan are all there after they have moved out (m), and do not cross."""
    moved = offset_plan(house, far)
    ends = [end for ring in moved for end in zip(ring, ring[1:] + ring[:1], strict=True)]
    ahead = all(
        u * (to_x - x) + v * (to_y - y) > ON_WALL
        for (_, (u, v), _), ((x, y), (to_x, to_y)) in zip(_edges(house.plan), ends, strict=True)
    )
    return ahead and bool(shapely.Polygon(moved[0], moved[1:]).is_valid)


def overhang_strips(house: House) -> list[tuple[int, float, list[Flat]]]:
    """List the strips of a roof beyond the walls: the wall, its slope, and corners as of `RoofSide`."""
    far = house.roof.overhang
    if far <= 0:
        return []
    if house.plan:
        return _plan_strips(house)
    sides = list_sides(house)
    strips: list[tuple[int, float, list[Flat]]] = []
    if house.roof.shape in ("hipped", "pyramidal"):
        fall = far * sides[0].slope
        for side in sides:
            mine, next_to = fall / side.slope, fall / sides[(side.wall + 1) % 4].slope
            long = wall_length(house, side.wall)
            ring = [(-next_to, -mine), (long + next_to, -mine), (long, 0.0), (0.0, 0.0)]
            strips.append((side.wall, side.slope, ring))
        return strips
    for side in sides:
        long = wall_length(house, side.wall)
        top = max(v for _, v in side.ring)
        strips.append((side.wall, side.slope, [(-far, -far), (long + far, -far), (long + far, 0.0), (-far, 0.0)]))
        strips.append((side.wall, side.slope, [(-far, 0.0), (0.0, 0.0), (0.0, top), (-far, top)]))
        strips.append((side.wall, side.slope, [(long, 0.0), (long + far, 0.0), (long + far, top), (long, top)]))
        if house.roof.shape != "gabled":
            ring = [(-far, top), (long + far, top), (long + far, top + far), (-far, top + far)]
            strips.append((side.wall, side.slope, ring))
    return strips


def _plan_strips(house: House) -> list[tuple[int, float, list[Flat]]]:
    """Strips over eaves lie on the side above them; those over a gable, from its tip, on the sides beside it."""
    slopes = {side.wall: side.slope for side in list_sides(house)}
    one_plane = house.roof.shape in ("flat", "shed")
    strips, wall = [], 0
    for ring, moved in zip(house.plan, offset_plan(house, house.roof.overhang), strict=True):
        first, n = wall, len(ring)
        for k in range(n):
            eaves = one_plane or wall in slopes
            tips = [] if eaves else [along for along, _ in _plan_top(house, wall)[1:-1]]
            inner = [ring[k], *(place(house, wall, along, 0.0, 0.0)[:2] for along in tips), ring[(k + 1) % n]]
            outer = [place(house, wall, along, -house.roof.overhang, 0.0)[:2] for along in tips]
            outer = [moved[k], *outer, moved[(k + 1) % n]]
            beside = [first + (k - 1) % n, first + (k + 1) % n]
            for j in range(len(inner) - 1):
                owner = 0 if one_plane else wall if eaves else beside[2 * j >= len(inner) - 1]
                corners = (outer[j], outer[j + 1], inner[j + 1], inner[j])
                strips.append((owner, slopes[owner], [along_wall(house, owner, x, y) for x, y in corners]))
            wall += 1
    return strips
