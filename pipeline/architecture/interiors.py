"""The inside of a house in three levels of detail (Boeters et al. 2015): floors, one volume, or storeys."""

from dataclasses import dataclass, replace

from pipeline.architecture.draw import MARGIN
from pipeline.architecture.levels import Volume, move_walls
from pipeline.architecture.parameters import Dormer, House
from pipeline.architecture.roof_sides import has_room, list_sides, place, wall_rings
from pipeline.architecture.shell import Detail, make_shell
from pipeline.architecture.surfaces import GROUND, level_face, prism, to_town

INTERIORS = ("0", "1", "2.2", "2.3")
JOIST, ROOF = 0.2, 0.2  # m, thickness of ceilings, and of roofs measured upwards
LEAST_KNEE, LEAST_ATTIC = 0.05, 1.5  # m, height of an attic at its walls and below the ridge
LEAST_ROOM = 0.3  # m, width and height of rooms in parts and dormers


@dataclass(frozen=True)
class Room:
    """A storey, or all that is inside: its number from the ground, -1 for all, and its geometry."""

    storey: int
    volume: Volume


def make_interior(house: House, level: str) -> list[Room]:
    """Make what is inside the outer walls of a house and of its parts.

    Parameters
    ----------
    level : str
        ``"0"``: the floor of each storey; ``"1"``: one volume up to the roof; ``"2.2"``: a volume a storey, and
        the attic where it is 1.5 m high or more; ``"2.3"``: the attic with its dormers.

    Returns
    -------
    list of Room
        Those of the main body, then one of each part that its walls leave room in. Garages lie behind the wall of
        the house; alcoves are open to it: both rooms have a border there.

    Raises
    ------
    ValueError
        If there is no such level.
    """
    if level not in INTERIORS:
        raise ValueError(f"interior {level}; one of {', '.join(INTERIORS)}")
    inner = move_walls(replace(house, openings=(), parts=()), -house.wall_thickness)
    if level == "1":
        shell = make_shell(replace(inner, height=inner.height - ROOF), Detail())
        return [Room(-1, Volume(-1, True, to_town(inner, shell))), *_part_rooms(house, level)]
    ring, *holes = wall_rings(inner)
    rooms = []
    for storey in range(house.storeys):
        low = storey * house.storey_height
        if level == "0":
            surfaces = [level_face(GROUND, [ring, *holes], low)]
        else:
            surfaces = prism(ring, low, low + house.storey_height - JOIST, holes)
        rooms.append(Room(storey, Volume(-1, level != "0", to_town(inner, surfaces))))
    if level != "0" and (attic := _attic(house)) is not None:
        shell = make_shell(attic, Detail(dormers=level == "2.3"))
        rooms.append(Room(house.storeys, Volume(-1, True, to_town(attic, shell))))
    return [*rooms, *_part_rooms(house, level)]


def _part_rooms(house: House, level: str) -> list[Room]:
    """The room of each part, on the ground: floor or volume."""
    thick, rooms = house.wall_thickness, []
    for k, part in enumerate(house.parts):
        left, right, front, high = (
            part.along + thick,
            part.along + part.width - thick,
            thick - part.depth,
            part.height - ROOF,
        )
        if min(right - left, -front, high) < LEAST_ROOM:
            continue
        back = thick if part.kind == "alcove" else 0.0
        corners = ((left, front), (right, front), (right, back), (left, back))
        ring = [place(house, part.wall, along, away, 0.0)[:2] for along, away in corners]
        surfaces = [level_face(GROUND, [ring], 0.0)] if level == "0" else prism(ring, 0.0, high)
        rooms.append(Room(-1 if level == "1" else 0, Volume(k, level != "0", to_town(house, surfaces))))
    return rooms


def _attic(house: House) -> House | None:
    """The room below a sloped roof, as a house whose walls are its knee walls, with the inside of its dormers."""
    slope = list_sides(house)[0].slope
    if house.roof.rise < LEAST_ATTIC + ROOF:
        return None
    far = -max(house.wall_thickness, (ROOF + LEAST_KNEE) / slope)
    if house.plan and not has_room(house, far):
        return None
    inner = move_walls(house, far)
    knee = inner.height - house.height - ROOF
    if knee + inner.roof.rise < LEAST_ATTIC or min(inner.length, inner.width) < LEAST_ATTIC:
        return None
    attic = replace(inner, z=house.z + house.height, height=knee)
    sides = {side.wall: side for side in list_sides(attic)}
    dormers = []
    for dormer in attic.dormers:
        side, thick = sides[dormer.side], house.wall_thickness
        width, height = dormer.width - 2 * thick, dormer.height - thick * side.slope
        if min(width, height) < LEAST_ROOM:
            continue
        low, rise = (dormer.along + thick, dormer.up + thick), dormer.rise * width / dormer.width
        if side.holds(low, (low[0] + width, low[1] + (height + rise) / side.slope), MARGIN):
            dormers.append(Dormer(dormer.side, *low, width, height, rise))
    return replace(attic, dormers=tuple(dormers))
