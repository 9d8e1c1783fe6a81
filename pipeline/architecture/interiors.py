"""The inside of a house in three levels of detail (Boeters et al. 2015): floors, one volume, or storeys."""

from dataclasses import dataclass, replace

from pipeline.architecture.levels import Volume, move_walls
from pipeline.architecture.parameters import House
from pipeline.architecture.roof_sides import has_room, list_sides, wall_rings
from pipeline.architecture.shell import Detail, make_shell
from pipeline.architecture.surfaces import GROUND, level_face, prism, to_town

INTERIORS = ("0", "1", "2.2", "2.3")
JOIST, ROOF = 0.2, 0.2  # m, thickness of ceilings, and of roofs measured upwards
LEAST_KNEE, LEAST_ATTIC = 0.05, 1.5  # m, height of an attic at its walls and below the ridge


@dataclass(frozen=True)
class Room:
    """A storey, or all that is inside: its number from the ground, -1 for all, and its geometry."""

    storey: int
    volume: Volume


def make_interior(house: House, level: str) -> list[Room]:
    """Make what is inside the outer walls of the main body.

    Parameters
    ----------
    house : House
        Its parameters.
    level : str
        ``"0"``: the floor of each storey; ``"1"``: one volume up to the roof; ``"2.2"``: a volume a storey;
        ``"2.3"``: these and the attic, where it is 1.5 m high or more. Dormers are no part of it.

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
        return [Room(-1, Volume(-1, True, to_town(inner, shell)))]
    ring, *holes = wall_rings(inner)
    rooms = []
    for storey in range(house.storeys):
        low = storey * house.storey_height
        if level == "0":
            surfaces = [level_face(GROUND, [ring, *holes], low)]
        else:
            surfaces = prism(ring, low, low + house.storey_height - JOIST, holes)
        rooms.append(Room(storey, Volume(-1, level != "0", to_town(inner, surfaces))))
    if level == "2.3" and (attic := _attic(house)) is not None:
        rooms.append(Room(house.storeys, Volume(-1, True, to_town(attic, make_shell(attic, Detail())))))
    return rooms


def _attic(house: House) -> House | None:
    """The room below a sloped roof, as a house whose walls are its knee walls."""
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
    return replace(inner, z=house.z + house.height, height=knee)
