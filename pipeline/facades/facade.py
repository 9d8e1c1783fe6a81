"""Rules executed on a façade: products in the rectangle around a wall, and the polygons of those in the wall."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.architecture.parameters import Flat
from pipeline.facades.assets import Made, build, count_steps, least_size, polygons, reach
from pipeline.facades.graph import ConditionalLod, Graph, Insert, InsertLod, Repeat, Split

GAP = 0.03  # m, from an asset to the border of its rectangle and of its wall
LEAST = 0.1  # m, side of a rectangle that rules are executed on
NEAR = 0.02  # m, of other faces to the box of an asset
Array = NDArray[np.float64]
Decide = Callable[[Flat, frozenset[str]], tuple[int, ...]]


@dataclass(frozen=True, eq=False)
class Frame:
    """Where a façade is: the lower left corner of its rectangle, seen from outside, and its directions."""

    #: (3,): the corner (m), the unit vector along the wall, and that outwards; both are horizontal
    origin: Array
    along: Array
    normal: Array

    def place(self, local: Array) -> Array:
        """Put points (n, 3), along the wall, inwards and upwards, into the CRS."""
        found: Array = self.origin + local[:, :1] * self.along - local[:, 1:2] * self.normal
        found[:, 2] += local[:, 2]
        return found

    def to_local(self, xyz: Array) -> Array:
        """Give points (n, 3) in the frame."""
        near = xyz - self.origin
        return np.column_stack(((near * self.along).sum(axis=1), -(near * self.normal).sum(axis=1), near[:, 2]))


@dataclass(frozen=True)
class Product:
    """An asset at its place on a façade."""

    insert: Insert  #: the asset
    corner: Flat  #: its lower left corner in the frame (m)
    shares: tuple[int, ...]  #: per cent of its polygons by each criterion that was asked for

    @property
    def box(self) -> tuple[Flat, Flat]:
        """Its lower left and upper right corners."""
        u, v = self.corner
        return (u, v), (u + self.insert.width, v + self.insert.height)


def execute(graph: Graph, start: str, size: Flat, decide: Decide) -> Iterator[Product]:
    """Execute rewritten rules on a rectangle; gives each product that has room in its own.

    Parameters
    ----------
    graph : Graph
        Of `rewrite`.
    start : str
        The rule to begin with; ``""`` gives nothing.
    size : (float, float)
        Width and height of the rectangle (m).
    decide : callable
        What a ConditionalLoD evaluates: from the middle of a product in the rectangle and its labels to per cent.
    """
    waiting: list[tuple[str, Flat, Flat, frozenset[str]]] = [(start, (0.0, 0.0), size, frozenset())]
    while waiting:
        name, (u, v), (du, dv), labels = waiting.pop()
        if not name or min(du, dv) < LEAST:
            continue
        name, _, port = name.partition(":")
        node = graph.nodes[name]
        labels |= {node.label} - {""}
        if isinstance(node, ConditionalLod):
            chosen = graph.nodes[port]
            shares = decide((u + du / 2, v + dv / 2), labels | {chosen.label})
            if isinstance(chosen, InsertLod):
                yield from _insert(chosen.insert, (u, v), (du, dv), shares)
        elif isinstance(node, Split | Repeat):
            pieces = list(_divide(node, du if node.axis == "u" else dv))
            for to, first, length in reversed(pieces):
                if node.axis == "u":
                    waiting.append((to, (u + first, v), (length, dv), labels))
                else:
                    waiting.append((to, (u, v + first), (du, length), labels))


def _insert(one: Insert, corner: Flat, size: Flat, shares: tuple[int, ...]) -> Iterator[Product]:
    (u, v), (du, dv), up = corner, size, max(one.sill, GAP)
    if one.width + 2 * GAP <= du and up + one.height + GAP <= dv:
        yield Product(one, (u + (du - one.width) / 2, v + up), shares)


def _divide(node: Split | Repeat, length: float) -> Iterator[tuple[str, float, float]]:
    """Give target, begin and size of each piece; what does not fit is left out."""
    if isinstance(node, Repeat):
        whole = int(length / node.size + (0.5 if node.stretch else 1e-9))
        n = max(1, whole) if node.stretch else whole
        size = length / n if node.stretch else node.size
        yield from ((node.to, k * size, size) for k in range(n))
        return
    shares = sum(part.share for part in node.parts)
    left = max(length - sum(part.size for part in node.parts), 0.0)
    place = 0.0
    for part in node.parts:
        size = part.size or left * part.share / shares
        if place + size > length + 1e-9:
            return
        yield part.to, place, size
        place += size


def find_frame(rings: Sequence[Array], area: Array, *, most_off: float) -> Frame | None:
    """Give the frame of a wall by its rings and area vector; None where it leans or is not flat.

    Parameters
    ----------
    rings : sequence of float64 (n, 3)
        Border first, then holes.
    area : float64, (3,)
        By the right-hand rule around the border.
    most_off : float
        Distance of a vertex to the vertical plane (m).
    """
    length = float(np.hypot(area[0], area[1]))
    if not length:
        return None
    normal = np.array([area[0] / length, area[1] / length, 0.0])
    along = np.array([-normal[1], normal[0], 0.0])
    border = rings[0]
    local = Frame(border.mean(axis=0), along, normal).to_local(np.concatenate(rings))
    if np.abs(local[:, 1]).max() > most_off:
        return None
    return Frame(border.mean(axis=0) + local[:, 0].min() * along + [0.0, 0.0, local[:, 2].min()], along, normal)


def keep_in_wall(products: Sequence[Product], frame: Frame, rings: Sequence[Array]) -> list[Product]:
    """Keep the products that lie in a wall, away from its border and holes."""
    flat = [frame.to_local(ring)[:, [0, 2]] for ring in rings]
    wall = shapely.Polygon(flat[0], flat[1:])
    if not products or not wall.is_valid:
        return []
    room = shapely.buffer(wall, -GAP, join_style="mitre")
    shapely.prepare(room)
    boxes = shapely.box(*np.array([[*low, *high] for low, high in (one.box for one in products)]).T)
    return [one for one, inside in zip(products, shapely.contains(room, boxes), strict=True) if inside]


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Borders of all faces of a building."""

    xyz: Array  #: (n, 3): their vertices (m), one face after the other
    start: NDArray[np.int64]  #: (f,): the first vertex of each
    #: (f, 3): unit normal, or zero for a face without area, and a place in the plane of each
    normal: Array
    centre: Array


def find_free(products: Sequence[Product], frame: Frame, faces: Obstacles, wall: int) -> list[bool]:
    """Tell which products have room before and behind the wall.

    Parameters
    ----------
    products : sequence of Product
        In the wall.
    frame : Frame
        Of the wall.
    faces : Obstacles
        Of its building.
    wall : int
        Which of them the wall is.

    Returns
    -------
    list of bool
        False where another face may meet the box of the asset: the two are not apart along an axis of the frame,
        and the box is not on one side of the face's plane.
    """
    if not products:
        return []
    ends = []
    for one in products:
        out, deep = reach(one.insert)
        (u, v), (u2, v2) = one.box
        ends.append([[u - NEAR, -out - NEAR, v - NEAR], [u2 + NEAR, deep + NEAR, v2 + NEAR]])
    box: Array = np.array(ends)
    local = frame.to_local(faces.xyz)
    low: Array = np.minimum.reduceat(local, faces.start)
    high: Array = np.maximum.reduceat(local, faces.start)
    apart: NDArray[np.bool_] = np.logical_or.reduce((box[:, None, 0] > high) | (box[:, None, 1] < low), axis=2)
    apart[:, wall] = True
    near = np.flatnonzero(~apart.all(axis=0))
    centre = frame.to_local(faces.centre[near])
    normal = frame.to_local(faces.normal[near] + frame.origin)
    which = np.array(list(np.ndindex(2, 2, 2)))  # corners of a box: its low or high end by axis
    height: Array = np.zeros((len(products), 8, len(near)))
    for k in range(3):
        height += normal[:, k] * (box[:, which[:, k], k][:, :, None] - centre[:, k])
    apart[:, near] |= (height > NEAR).all(axis=1) | (height < -NEAR).all(axis=1)
    free: list[bool] = np.logical_and.reduce(apart, axis=1).tolist()
    return free


def count_polygons(products: Sequence[Product], criterion: int) -> int:
    """Give the number of polygons of assets by a criterion, each at least flat."""
    return sum(polygons(one.insert)[count_steps(one.insert, one.shares[criterion]) - 1] for one in products)


def make_facade(products: Sequence[Product], criterion: int) -> Made:
    """Make the polygons of a façade; where all assets are flat it is a plain wall (He et al., facade level)."""
    made = Made()
    if any(one.shares[criterion] for one in products):
        for one in products:
            build(made, one.insert, one.corner, one.shares[criterion])
    return made


def has_room(insert: Insert) -> bool:
    """Tell whether an asset has room for its frames and panes."""
    wide, tall = least_size(insert)
    return insert.width >= wide and insert.height >= tall
