"""Parameters of a building, from its place to its windows: what rules draw and geometry is made of."""

from dataclasses import dataclass
from typing import Literal

RoofShape = Literal["flat", "shed", "gabled", "hipped", "pyramidal"]
ROOF_SHAPES: tuple[RoofShape, ...] = ("flat", "shed", "gabled", "hipped", "pyramidal")
PLANS = ("rectangle", "L", "T", "U", "courtyard")
Flat = tuple[float, float]
Rings = tuple[tuple[Flat, ...], ...]  # border counter-clockwise, then holes clockwise (m)


@dataclass(frozen=True)
class Opening:
    """A window or a door in a wall.

    Attributes
    ----------
    kind : str
        ``"window"`` or ``"door"``.
    wall : int
        Its wall, as of `House`.
    along, sill : float
        Its lower left corner, seen from outside: along the wall, and above the ground (m).
    width, height : float
        Its size (m).
    """

    kind: Literal["window", "door"]
    wall: int
    along: float
    sill: float
    width: float
    height: float


@dataclass(frozen=True)
class Dormer:
    """A dormer with a flat or a gabled roof.

    Attributes
    ----------
    side : int
        Wall above whose eaves it stands.
    along, up : float
        Left end of its front along that wall, and distance of the front from the wall in plan (m).
    width, height : float
        Of its front wall (m).
    rise : float
        Of its gabled roof (m); 0 for a flat one.
    window : float
        Width and height of the window in the front, as a share of the front's.
    """

    side: int
    along: float
    up: float
    width: float
    height: float
    rise: float = 0.0
    window: float = 0.6


@dataclass(frozen=True)
class Chimney:
    """A chimney.

    Attributes
    ----------
    side : int
        Wall above whose eaves it stands.
    along, up : float
        Its lower left corner in plan, along that wall and away from it (m).
    width : float
        Of its sides (m).
    top : float
        Its height above the highest place of the roof (m).
    """

    side: int
    along: float
    up: float
    width: float
    top: float


@dataclass(frozen=True)
class RoofWindow:
    """A window in a roof.

    Attributes
    ----------
    side, along, up
        As of a chimney.
    width, depth : float
        Its size in plan, along the wall and away from it (m).
    """

    side: int
    along: float
    up: float
    width: float
    depth: float


@dataclass(frozen=True)
class Roof:
    """A roof.

    Attributes
    ----------
    shape : str
        One of `ROOF_SHAPES`. The ridge of a gabled or a hipped one goes along the front; a shed rises to the back.
    rise : float
        From the eaves to the highest place (m).
    overhang : float
        How far it reaches beyond the front and the back, measured in plan (m); all ends of a hipped or pyramidal
        roof are at one height.
    """

    shape: RoofShape
    rise: float = 0.0
    overhang: float = 0.0


@dataclass(frozen=True)
class BuildingPart:
    """A lower part with a flat roof that stands at a wall.

    Attributes
    ----------
    kind : str
        ``"garage"`` or ``"alcove"``.
    wall : int
        The wall, as of `House`.
    along : float
        Its left end along the wall, seen from outside (m).
    width, depth, height : float
        Its size: along the wall, away from it, and upwards (m).
    """

    kind: Literal["garage", "alcove"]
    wall: int
    along: float
    width: float
    depth: float
    height: float


@dataclass(frozen=True)
class House:
    """A building: everything that its geometry is made of.

    Attributes
    ----------
    id : str
        ``UUID_`` and a UUID: XML takes no id that begins with a digit.
    x, y, z : float
        Lower left corner of its front, in the CRS of the town (m).
    rotation : float
        From the x axis to the front, counter-clockwise (degrees).
    length, width : float
        Of the front, and away from it (m).
    height : float
        From the ground to the eaves (m).
    storeys : int
        Number of storeys below the eaves.
    embrasure : float
        How deep windows and doors lie in the wall (m).
    wall_thickness : float
        Of outer walls (m), for interiors.
    roof : Roof
        The roof.
    parts, dormers, chimneys, roof_windows, openings : tuple
        What it has of these.
    year : int
        Of construction.
    use : str
        What it is used for.
    plan : tuple
        Outline of the main body with its courtyards in its frame, of any form; none for a rectangle.

    Notes
    -----
    Walls are numbered along the outline: those of a rectangle are the front, the right side, the back and the
    left side. Hipped and gabled roofs over a plan are those of its straight skeleton; flat ones, and sheds that
    rise from wall 0, are one plane.
    """

    id: str
    x: float
    y: float
    z: float
    rotation: float
    length: float
    width: float
    height: float
    storeys: int
    embrasure: float
    wall_thickness: float
    roof: Roof
    parts: tuple[BuildingPart, ...] = ()
    dormers: tuple[Dormer, ...] = ()
    chimneys: tuple[Chimney, ...] = ()
    roof_windows: tuple[RoofWindow, ...] = ()
    openings: tuple[Opening, ...] = ()
    year: int = 2000
    use: str = "residential"
    plan: Rings = ()

    @property
    def storey_height(self) -> float:
        """Height of a storey (m)."""
        return self.height / self.storeys
