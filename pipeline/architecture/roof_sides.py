"""The sides of a roof: one over each wall that it slopes down to, in the frame of that wall."""

from dataclasses import dataclass

from pipeline.architecture.parameters import House

Point = tuple[float, float, float]
Flat = tuple[float, float]


@dataclass(frozen=True)
class RoofSide:
    """A plane of a roof.

    Attributes
    ----------
    wall : int
        Wall at its eaves.
    slope : float
        Metres up for each metre away from the wall.
    ring : tuple of (float, float)
        Its corners, counter-clockwise from above: along the wall, and away from it (m).
    """

    wall: int
    slope: float
    ring: tuple[Flat, ...]

    def holds(self, low: Flat, high: Flat, margin: float) -> bool:
        """Tell whether a rectangle lies inside, with a margin (m) to the border."""
        corners = (low, (high[0], low[1]), high, (low[0], high[1]))
        for k, (x, y) in enumerate(self.ring):
            to_x, to_y = self.ring[(k + 1) % len(self.ring)]
            along_x, along_y = to_x - x, to_y - y
            far = (along_x**2 + along_y**2) ** 0.5 * margin
            if any(along_x * (v - y) - along_y * (u - x) < far for u, v in corners):
                return False
        return True


def wall_length(house: House, wall: int) -> float:
    """Length of a wall (m)."""
    return house.length if wall % 2 == 0 else house.width


def wall_frame(house: House, wall: int) -> tuple[Flat, Flat]:
    """Where a wall begins and its direction, in the frame of the house; the inside is on its left."""
    length, width = house.length, house.width
    starts = ((0.0, 0.0), (length, 0.0), (length, width), (0.0, width))
    return starts[wall], ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[wall]


def place(house: House, wall: int, along: float, away: float, z: float) -> Point:
    """Give a place in the frame of the house by its place in that of a wall: along it, inwards, and up (m)."""
    (x, y), (u, v) = wall_frame(house, wall)
    return x + along * u - away * v, y + along * v + away * u, z


def list_sides(house: House) -> list[RoofSide]:
    """List the planes of a roof.

    Notes
    -----
    Their corners are those of the walls and of the ridge. A hipped roof whose ridge would have no length is a
    pyramid; ends of a hipped roof are as steep as its sides.
    """
    length, width, rise = house.length, house.width, house.roof.rise
    shape = house.roof.shape
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


def wall_ring(house: House, wall: int) -> list[Flat]:
    """Corners of a wall as seen from outside, counter-clockwise: along it, and up (m)."""
    long, low, high = wall_length(house, wall), house.height, house.height + house.roof.rise
    left, right = low, low
    top: list[Flat] = []
    if house.roof.shape == "shed":
        left = high if wall in (2, 3) else low
        right = high if wall in (1, 2) else low
    elif house.roof.shape == "gabled" and wall % 2:
        top = [(long / 2, high)]
    return [(0.0, 0.0), (long, 0.0), (long, right), *top, (0.0, left)]


def overhang_strips(house: House) -> list[tuple[int, float, list[Flat]]]:
    """List the strips of a roof beyond the walls: the wall, its slope, and corners as of `RoofSide`."""
    far = house.roof.overhang
    if far <= 0:
        return []
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
