"""Broken blocks: each fault of solids by ISO 19107 once, by the codes of val3dity, for validators."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from pipeline.architecture.roof_sides import Point

Rings = list[list[Point]]
Shell = list[Rings]  # its faces, each a border and holes
_X, _Y, _Z = 10.0, 8.0, 6.0  # m, of the block
_INNER: list[Point] = [
    (3.0, 3.0, _Z),
    (3.0, 5.0, _Z),
    (6.0, 5.0, _Z),
    (6.0, 3.0, _Z),
]  # a hole in the roof, clockwise


class Fault(NamedTuple):
    """Solids with a fault."""

    name: str  # code and name
    # "Solid"; "CompositeSolid" of several; or "BuildingPart": each solid is a part of one building
    kind: str
    solids: list[list[Shell]]  # of each its outer shell, then cavities (m)


def list_faults() -> Iterator[Fault]:
    """List broken solids.

    Notes
    -----
    Codes: H. Ledoux, val3dity: validation of 3D GIS primitives according to the international standards (2018).
    """
    for name, shell in _list_shells():
        yield Fault(name, "Solid", [[shell]])
    block, cavity = _block(), _cavity((2.0, 2.0, 2.0))
    yield Fault("401-intersection-shells", "Solid", [[block, _cavity((8.0, 2.0, 2.0))]])
    yield Fault("402-duplicated-shells", "Solid", [[block, cavity, cavity]])
    yield Fault("403-cavity-outside", "Solid", [[block, _cavity((20.0, 2.0, 2.0))]])
    # A cavity that meets ground, roof and two walls along its middle cuts the inside in two.
    middle = [(_X / 2, 0.0, 0.0), (_X / 2, _Y, 0.0), (_X / 2, _Y, _Z), (_X / 2, 0.0, _Z)]
    tips = [(0.5, _Y / 2, _Z / 2), (_X - 0.5, _Y / 2, _Z / 2)]
    pairs = [(middle[k], middle[(k + 1) % 4]) for k in range(4)]
    across = [[[one, other, tips[0]]] for one, other in pairs] + [[[other, one, tips[1]]] for one, other in pairs]
    yield Fault("404-interior-disconnected", "Solid", [[block, across]])
    overlapping = [[block], [_block((5.0, 4.0, 0.0))]]
    yield Fault("501-intersection-solids", "CompositeSolid", overlapping)
    yield Fault("502-duplicated-solids", "CompositeSolid", [[block], [block]])
    yield Fault("503-disconnected-solids", "CompositeSolid", [[block], [_block((30.0, 0.0, 0.0))]])
    yield Fault("601-parts-overlap", "BuildingPart", overlapping)


def _list_shells() -> Iterator[tuple[str, Shell]]:
    ground, *walls, roof = _block()
    (border,) = roof
    side = [ground, *walls]
    yield "101-too-few-points", [*side, [border[:2]]]
    yield "102-consecutive-points-same", [*side, [[border[0], *border]]]
    yield "104-ring-self-intersection", [*side, [[*border[:3], border[0], border[3]]]]
    yield "201-intersection-of-rings", [*side, [border, _move(_INNER, 5.0, 0.0)]]
    yield "202-duplicated-rings", [*side, [border, border[::-1]]]
    lifted = (*border[2][:2], _Z + 0.5)
    yield "203-not-planar", [[[lifted if corner == border[2] else corner for corner in ring] for ring in face]
                             for face in [*side, roof]]  # fmt: skip
    bend: list[Point] = [(0.02, 0.0, _Z + 0.009), (0.04, 0.0, _Z)]
    front = [walls[0][0][:3] + bend[::-1] + walls[0][0][3:]]
    yield "204-not-planar-by-normals", [ground, front, *walls[1:], [border[:1] + bend + border[1:]]]
    across: list[Point] = [(0.0, 4.0, _Z), (5.0, 6.0, _Z), (10.0, 4.0, _Z), (5.0, 2.0, _Z)]
    yield "205-interior-not-connected", [*side, [border, across]]
    yield "206-hole-outside", [*side, [border, _move(_INNER, 20.0, 0.0)]]
    within: list[Point] = [(4.0, 3.5, _Z), (4.0, 4.5, _Z), (5.0, 4.5, _Z), (5.0, 3.5, _Z)]
    yield "207-nested-rings", [*side, [border, _INNER, within]]
    yield "208-orientation-rings-same", [*side, [border, _INNER[::-1]]]
    yield "301-too-few-polygons", [ground, walls[0], roof]
    yield "302-not-closed", side
    yield "303-non-manifold-vertex", [*_block(), *_block((_X, _Y, _Z))]
    yield "304-non-manifold-edge", [*_block(), *_block((_X, _Y, 0.0))]
    yield "305-multiple-components", [*_block(), *_block((30.0, 0.0, 0.0))]
    tip = (5.0, 4.0, -2.0)
    yield "306-self-intersection", [*side, *([[border[k], border[(k + 1) % 4], tip]] for k in range(4))]
    yield "307-polygon-wrong-orientation", [*side, [border[::-1]]]
    yield "405-wrong-orientation-shell", [[ring[::-1] for ring in face] for face in [*side, roof]]


def _block(corner: Point = (0.0, 0.0, 0.0), size: Point = (_X, _Y, _Z)) -> Shell:
    """Ground, walls and roof of a block whose lower left corner is given."""
    (x, y, z), (long, wide, tall) = corner, size
    foot = [(x, y), (x + long, y), (x + long, y + wide), (x, y + wide)]
    low, high = [(*place, z) for place in foot], [(*place, z + tall) for place in foot]
    walls = [[[low[k], low[(k + 1) % 4], high[(k + 1) % 4], high[k]]] for k in range(4)]
    return [[low[::-1]], *walls, [high]]


def _cavity(corner: Point) -> Shell:
    """A block that looks inwards."""
    return [[ring[::-1] for ring in face] for face in _block(corner, (4.0, 3.0, 2.0))]


def _move(ring: Sequence[Point], x: float, y: float) -> list[Point]:
    return [(a + x, b + y, c) for a, b, c in ring]
