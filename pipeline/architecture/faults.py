"""Broken blocks: each fault of a solid by ISO 19107 once, by the codes of val3dity, for validators."""

from collections.abc import Iterator, Sequence

from pipeline.architecture.roof_sides import Point

Rings = list[list[Point]]
_X, _Y, _Z = 10.0, 8.0, 6.0  # m, of the block
_INNER: list[Point] = [
    (3.0, 3.0, _Z),
    (3.0, 5.0, _Z),
    (6.0, 5.0, _Z),
    (6.0, 3.0, _Z),
]  # a hole in the roof, clockwise


def list_faults() -> Iterator[tuple[str, list[Rings]]]:
    """List broken solids: code with name, and the faces of its shell, each a border and holes (m).

    Notes
    -----
    Codes: H. Ledoux, val3dity: validation of 3D GIS primitives according to the international standards (2018).
    """
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


def _block(corner: Point = (0.0, 0.0, 0.0)) -> list[Rings]:
    """Ground, walls and roof of a block whose lower left corner is given."""
    x, y, z = corner
    foot = [(x, y), (x + _X, y), (x + _X, y + _Y), (x, y + _Y)]
    low, high = [(*place, z) for place in foot], [(*place, z + _Z) for place in foot]
    walls = [[[low[k], low[(k + 1) % 4], high[(k + 1) % 4], high[k]]] for k in range(4)]
    return [[low[::-1]], *walls, [high]]


def _move(ring: Sequence[Point], x: float, y: float) -> list[Point]:
    return [(a + x, b + y, c) for a, b, c in ring]
