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
    """A window or a door in a wall."""

    kind: Literal["window", "door"]  #: ``"window"`` or ``"door"``
    wall: int  #: its wall, as of `House`
    #: its lower left corner, seen from outside: along the wall, and above the ground (m)
    along: float
    sill: float
    #: its size (m)
    width: float
    height: float


@dataclass(frozen=True)
class Dormer:
    """A dormer with a flat or a gabled roof."""

    side: int  #: wall above whose eaves it stands
    #: left end of its front along that wall, and distance of the front from the wall in plan (m)
    along: float
    up: float
    #: of its front wall (m)
    width: float
    height: float
    rise: float = 0.0  #: of its gabled roof (m); 0 for a flat one
    window: float = 0.6  #: width and height of the window in the front, as a share of the front's


@dataclass(frozen=True)
class Chimney:
    """A chimney."""

    side: int  #: wall above whose eaves it stands
    #: its lower left corner in plan, along that wall and away from it (m)
    along: float
    up: float
    width: float  #: of its sides (m)
    top: float  #: its height above the highest place of the roof (m)


@dataclass(frozen=True)
class RoofWindow:
    """A window in a roof."""

    #: as of a chimney
    side: int
    along: float
    up: float
    #: its size in plan, along the wall and away from it (m)
    width: float
    depth: float


@dataclass(frozen=True)
class Roof:
    """A roof."""

    #: one of `ROOF_SHAPES`. The ridge of a gabled or a hipped one goes along the front; a shed rises to the back
    shape: RoofShape
    rise: float = 0.0  #: from the eaves to the highest place (m)
    #: how far it reaches beyond the front and the back, measured in plan (m); all ends of a hipped or pyramidal
    #: roof are at one height
    overhang: float = 0.0


@dataclass(frozen=True)
class BuildingPart:
    """A lower part with a flat roof that stands at a wall."""

    kind: Literal["garage", "alcove"]  #: ``"garage"`` or ``"alcove"``
    wall: int  #: the wall, as of `House`
    along: float  #: its left end along the wall, seen from outside (m)
    #: its size: along the wall, away from it, and upwards (m)
    width: float
    depth: float
    height: float


@dataclass(frozen=True)
class House:
    """A building: everything that its geometry is made of.

    Notes
    -----
    Walls are numbered along the outline: those of a rectangle are the front, the right side, the back and the
    left side. Hipped and gabled roofs over a plan are those of its straight skeleton; flat ones, and sheds that
    rise from wall 0, are one plane.
    """

    id: str  #: ``UUID_`` and a UUID: XML takes no id that begins with a digit
    #: lower left corner of its front, in the CRS of the town (m)
    x: float
    y: float
    z: float
    rotation: float  #: from the x axis to the front, counter-clockwise (degrees)
    #: of the front, and away from it (m)
    length: float
    width: float
    height: float  #: from the ground to the eaves (m)
    storeys: int  #: number of storeys below the eaves
    embrasure: float  #: how deep windows and doors lie in the wall (m)
    wall_thickness: float  #: of outer walls (m), for interiors
    roof: Roof  #: the roof
    #: what it has of these
    parts: tuple[BuildingPart, ...] = ()
    dormers: tuple[Dormer, ...] = ()
    chimneys: tuple[Chimney, ...] = ()
    roof_windows: tuple[RoofWindow, ...] = ()
    openings: tuple[Opening, ...] = ()
    year: int = 2000  #: of construction
    use: str = "residential"  #: what it is used for
    #: outline of the main body with its courtyards in its frame, of any form; none for a rectangle
    plan: Rings = ()

    @property
    def storey_height(self) -> float:
        """Height of a storey (m)."""
        return self.height / self.storeys
