"""The 392 representations of a house of Random3Dcity: level, place of walls, height, semantics, solid or not."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import shapely

from pipeline.architecture.levels import (
    DETAILS,
    Volume,
    at_eaves,
    level_rings,
    make_blocks,
    make_level,
    make_parts,
    move_walls,
    part_ring,
)
from pipeline.architecture.parameters import House
from pipeline.architecture.roof_sides import list_sides
from pipeline.architecture.shell import make_shell
from pipeline.architecture.surfaces import GROUND, ROOF, level_face, to_town

# Where walls stand, by the names of the paper's data: as a share of the overhang.
WALLS_AT = {"F0": 0.0, "F1": 1.0, "Fd": 0.5}
HEIGHTS = {
    "H0": "lowest edge of the roof",
    "H1": "eaves, at the walls",
    "H2": "a third of the roof",
    "H3": "half of the roof",
    "H4": "two thirds of the roof",
    "H5": "ridge",
    "H6": "top of the chimneys, or the ridge",
    "HAvg": "mean of the roof",
    "HMed": "median of the roof",
    "HMin": "lowest roof of body and parts",
    "HMax": "ridge, of the whole",
    "HAvgAll": "mean of all roofs",
    "HMedian": "median of all roofs",
}
USUAL = ("H0", "H1", "H2", "H3", "H4", "H5", "H6", "HAvg", "HMed")  # of levels 0.1 to 0.3 and 1.1 to 1.3
_SHARES = {"H1": 0.0, "H2": 1 / 3, "H3": 0.5, "H4": 2 / 3, "H5": 1.0}


@dataclass(frozen=True)
class Representation:
    """A representation of a house."""

    name: str  #: of its file, as Random3Dcity names it
    level: str  #: one of `pipeline.architecture.levels.LEVELS`, or of `pipeline.architecture.interiors.INTERIORS`
    walls: str = "F0"  #: one of `WALLS_AT`; empty for interiors
    height: str = ""  #: one of `HEIGHTS`, where levels 0 and 1 have one
    kind: str = "semantics"  #: ``"surfaces"`` without semantics, ``"semantics"``: surfaces with it, or ``"solid"``
    dormers: bool = True  #: whether level 2.3 has dormers and chimneys
    interior: bool = False  #: whether it is the inside


def list_representations() -> list[Representation]:
    """List all 392.

    Examples
    --------
    >>> found = list_representations()
    >>> len(found), found[1].name, found[-1].name
    (392, 'LOD0_1_F0_H0', 'interior-LOD2_3')
    """
    found = [Representation("LOD0_0", "0.0")]
    for part, walls, top in product("123", WALLS_AT, USUAL):
        found.append(Representation(f"LOD0_{part}_{walls}_{top}", f"0.{part}", walls, top))
    for kind, end in {"surfaces": "", "semantics": "_semantics", "solid": "_solid"}.items():
        for top, height in (("HMin", "HMin"), ("HAvg", "HAvgAll"), ("HMax", "HMax"), ("HMedian", "HMedian")):
            found.append(Representation(f"LOD1_0_{top}{end}", "1.0", "F0", height, kind))
        for part, walls, top in product("123", WALLS_AT, USUAL):
            found.append(Representation(f"LOD1_{part}_{walls}_{top}{end}", f"1.{part}", walls, top, kind))
    for kind, end in {"surfaces": "_S0", "semantics": "", "solid": "_solid"}.items():
        for part, walls in product("012", WALLS_AT):
            found.append(Representation(f"LOD2_{part}_{walls}{end}", f"2.{part}", walls, "", kind))
        for walls, (dormers, more) in product(("F0", "Fd"), ((False, ""), (True, "_with_dormers"))):
            found.append(Representation(f"LOD2_3_{walls}{end}{more}", "2.3", walls, "", kind, dormers))
        found += [Representation(f"LOD3_{part}{end}", f"3.{part}", "F0", "", kind) for part in "0123"]
    for level in ("0", "1", "2.2", "2.3"):
        kind = "surfaces" if level == "0" else "solid"
        found.append(Representation(f"interior-LOD{level.replace('.', '_')}", level, "", "", kind, interior=True))
    return found


def make_representation(house: House, asked: Representation) -> list[Volume]:
    """Make the geometry of a house; not that of its inside, which is `make_interior`'s."""
    solid = asked.kind == "solid"
    shown = move_walls(house, WALLS_AT[asked.walls] * house.roof.overhang)
    if asked.level == "0.0":
        return make_level(house, "0.0")
    if asked.level[0] == "0":
        volumes = [_outlines(shown, asked.level, reference_height(house, asked.height))]
    elif asked.level[0] == "1":
        volumes = make_blocks(shown, asked.level, reference_height(house, asked.height))
    else:
        detail = DETAILS[asked.level]
        if not asked.dormers:
            detail = replace(detail, dormers=False, chimneys=False)
        if solid:
            detail = replace(detail, chimneys=False, overhangs=False)
        volumes = [Volume(-1, solid, make_shell(shown, detail))]
        if asked.level != "2.0":
            volumes += make_parts(shown)
    return [replace(one, closed=solid, surfaces=to_town(shown, one.surfaces)) for one in volumes]


def _outlines(house: House, level: str, top: float) -> Volume:
    """The outline on the ground, and that of the roof at some height."""
    surfaces = [level_face(GROUND, level_rings(house, level), 0.0)]
    surfaces.append(level_face(ROOF, level_rings(house, "0.1" if level == "0.3" else level), top))
    if level == "0.3":
        surfaces += [level_face(ROOF, [part_ring(house, part)], part.height) for part in house.parts]
    return Volume(-1, False, surfaces)


def reference_height(house: House, name: str) -> float:
    """Give a height of `HEIGHTS` above the ground of a house (m); it does not depend on where walls are shown."""
    low, rise = house.height, house.roof.rise
    if name in _SHARES:
        return low + _SHARES[name] * rise
    tops = [low + rise, *(part.height for part in house.parts)]
    simple = {
        "H0": at_eaves(house).height,
        "H6": low + rise + max((one.top for one in house.chimneys), default=0.0),
        "HMax": max(tops),
        "HMin": min([low, *tops]),
    }
    if name in simple:
        return simple[name]
    if name not in HEIGHTS:
        raise ValueError(f"height {name!r}; one of {', '.join(HEIGHTS)}")
    parts = [(part.width * part.depth, part.height) for part in house.parts if name in ("HAvgAll", "HMedian")]
    body = sum(_areas(house)) if house.plan else house.length * house.width
    whole = body + sum(area for area, _ in parts)
    if name.startswith("HAvg"):
        return (body * (low + rise * _mean_share(house)) + sum(area * high for area, high in parts)) / whole
    least, most = 0.0, max(tops)
    for _ in range(50):
        middle = (least + most) / 2
        above = body * _share_above(house, middle) + sum(area for area, high in parts if high > middle)
        least, most = (middle, most) if above > whole / 2 else (least, middle)
    return most


def _areas(house: House, within: Sequence[shapely.Polygon] = ()) -> list[float]:
    """Area in plan of each side of a roof (m2), or of its share within a polygon in the frame of its wall."""
    found = [side.polygon for side in list_sides(house)]
    return [one.intersection(other).area for one, other in zip(found, within or found, strict=True)]


def _mean_share(house: House) -> float:
    """Mean height of a roof above the eaves, over its rise."""
    if house.plan:
        steep = replace(house, roof=replace(house.roof, rise=1.0))
        up = [side.slope * side.polygon.centroid.y for side in list_sides(steep)]
        return float(np.average(up, weights=_areas(house)))
    if house.roof.shape == "hipped":
        return 1 / 2 - house.width / (6 * house.length)
    return {"flat": 0.0, "shed": 1 / 2, "gabled": 1 / 2, "pyramidal": 1 / 3}[house.roof.shape]


def _share_above(house: House, height: float) -> float:
    """Share of a roof's area in plan that is higher than a height above the ground (m)."""
    if height < house.height:
        return 1.0
    up = (height - house.height) / house.roof.rise if house.roof.rise else 1.0
    if up >= 1:
        return 0.0
    if house.plan:
        far = 2 * (house.length + house.width)
        above = [shapely.box(-far, (height - house.height) / side.slope, far, far) for side in list_sides(house)]
        return sum(_areas(house, above)) / sum(_areas(house))
    if house.roof.shape in ("shed", "gabled"):
        return 1 - up
    ends = house.width / house.length if house.roof.shape == "hipped" else 1.0
    return (1 - up) * (1 - up * ends)
