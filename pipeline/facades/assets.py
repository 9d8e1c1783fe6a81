"""Assets: windows, doors and balconies as steps that each add some polygons, the most important first.

Coordinates are those of a façade: along the wall, inwards, upwards (m).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from itertools import islice, product

from pipeline.architecture.parameters import Flat
from pipeline.architecture.roof_sides import Point
from pipeline.architecture.surfaces import DOOR, WALL, WINDOW, Surface, fill_hole, prism
from pipeline.facades.graph import Insert

SILL, SILL_OUT, SILL_GAP = 0.06, 0.08, 0.03  # height and projection of a window's sill, and what is above it (m)
FRAME, PANE = 0.06, 0.03  # width of frames, and how deep panes lie in them (m)
SLAB, SLAB_GAP, RAIL, RAIL_TOP = 0.15, 0.05, 0.05, 1.0  # of a balcony (m)
POST, POST_STEP = 0.03, 0.15  # width of balusters, and the distance between them (m)
LEAST_PANE = 0.1  # m


@dataclass
class Made:
    """What assets have made of a façade."""

    #: its holes are those of the wall; its border is not used
    wall: Surface = field(default_factory=lambda: Surface(WALL, [], []))
    #: fill these holes: together with the wall they are closed
    surfaces: list[Surface] = field(default_factory=list)
    installations: list[list[Surface]] = field(default_factory=list)  #: balconies, each closed
    #: the flat assets, with their lower left corners (m), by the number of their surface
    flat: dict[int, tuple[Insert, Flat]] = field(default_factory=dict)

    def count(self) -> int:
        """Give the number of polygons, without the wall."""
        return len(self.surfaces) + sum(map(len, self.installations))


def build(made: Made, insert: Insert, corner: Flat, percent: int) -> None:
    """Put an asset on a façade.

    Parameters
    ----------
    made : Made
        Gets its surfaces.
    insert : Insert
        The asset.
    corner : (float, float)
        Its lower left corner, along the wall and upwards (m).
    percent : int
        Of its polygons; see `count_steps`.
    """
    n = count_steps(insert, percent)
    if n == 1:
        made.flat[len(made.surfaces)] = (insert, corner)
    for _ in islice(_steps(made, insert, corner), n):
        pass


def count_steps(insert: Insert, percent: int) -> int:
    """Give how many steps have at most `percent` of the polygons; one, which is flat, where even that has more."""
    numbers = polygons(insert)
    return max(1, sum(100 * n <= percent * numbers[-1] for n in numbers))


@cache
def polygons(insert: Insert) -> tuple[int, ...]:
    """Give the number of polygons of an asset after each of its steps.

    Examples
    --------
    >>> polygons(Insert("window", 1.2, 1.4, columns=2, rows=1))
    (1, 5, 10, 15, 20)
    """
    made = Made()
    return tuple(made.count() for _ in _steps(made, insert, (0.0, 0.0)))


def reach(insert: Insert) -> tuple[float, float]:
    """Give how far an asset reaches out of the wall and into it (m)."""
    out = {"balcony": insert.projection, "window": SILL_OUT}.get(insert.asset, 0.0)
    return out, insert.depth + PANE


def least_size(insert: Insert) -> tuple[float, float]:
    """Give the least width and height that an asset has room in, for its frames and panes (m)."""
    below = {"balcony": SLAB + SLAB_GAP + RAIL_TOP, "window": SILL + SILL_GAP}.get(insert.asset, 0.0)
    pane = LEAST_PANE + FRAME
    return insert.columns * pane + 3 * FRAME, insert.rows * pane + 3 * FRAME + below


def _steps(made: Made, insert: Insert, corner: Flat) -> Iterator[None]:
    (left, low), (right, high) = corner, (corner[0] + insert.width, corner[1] + insert.height)
    below = {"balcony": SLAB + SLAB_GAP, "window": SILL + SILL_GAP}.get(insert.asset, 0.0)
    inset = FRAME if below else 0.0
    kind = WINDOW if insert.asset == "window" else DOOR
    sides = (left + inset, right - inset, low + below, high)
    opening = _rectangle(*sides, 0.0)
    made.surfaces += fill_hole(made.wall, opening, opening, kind)
    pane = made.surfaces[-1]
    yield
    if insert.asset == "balcony":
        yield from _balcony(made, insert, left, low)
    pane.border = _rectangle(*sides, insert.depth)
    made.surfaces += fill_hole(Surface(WALL, [], []), opening, pane.border, kind)[:-1]
    yield
    if insert.asset == "window":
        outer, front = (_rectangle(left, right, low, low + SILL, away) for away in (0.0, -SILL_OUT))
        made.surfaces += fill_hole(made.wall, outer, front, WALL)
        yield
    wide, tall = ((sides[1] - sides[0] - FRAME) / insert.columns, (sides[3] - sides[2] - FRAME) / insert.rows)
    for row, column in product(range(insert.rows), range(insert.columns)):
        u, v = sides[0] + FRAME + column * wide, sides[2] + FRAME + row * tall
        outer, back = (
            _rectangle(u, u + wide - FRAME, v, v + tall - FRAME, insert.depth + more) for more in (0.0, PANE)
        )
        made.surfaces += fill_hole(pane, outer, back, kind)
        yield


def _balcony(made: Made, insert: Insert, left: float, low: float) -> Iterator[None]:
    """Add a slab; then a rail on two balusters; then the others, evenly spread at any number of them."""
    right, front, top = left + insert.width, -insert.projection, low + SLAB
    slab = prism([(left, front), (right, front), (right, 0.0), (left, 0.0)], low, top)
    made.installations.append(slab)
    yield
    u, v, back = left + RAIL, right - RAIL, front + RAIL
    inside = [(right, 0.0), (v, 0.0), (v, back), (u, back), (u, 0.0), (left, 0.0)]
    rail = prism([(left, front), (right, front), *inside], top + RAIL_TOP - RAIL, top + RAIL_TOP)
    first, second, *others = _places(insert.width, insert.projection)
    slab += rail
    for place in (first, second):
        _post(slab, rail[0], (left + place[0], front + place[1]))
    yield
    for place in others:
        _post(slab, rail[0], (left + place[0], front + place[1]))
        yield


def _post(slab: list[Surface], rail: Surface, corner: Flat) -> None:
    (x, y), n = corner, 4
    low, high = slab[5].border[0][2], rail.border[0][2]
    flat = [(x, y), (x + POST, y), (x + POST, y + POST), (x, y + POST)]
    foot, head = ([(a, b, z) for a, b in flat] for z in (low, high))
    slab[5].cut(foot)
    rail.cut(head[::-1])
    slab += [Surface(WALL, [foot[k], foot[(k + 1) % n], head[(k + 1) % n], head[k]], []) for k in range(n)]


@cache
def _places(width: float, projection: float) -> list[Flat]:
    """Give the places of balusters along the rail, both ends of the front first."""
    gap = (RAIL - POST) / 2
    n, m = (max(2, int(length / POST_STEP)) for length in (width, projection))
    front = [(gap + k * (width - RAIL) / n, gap) for k in range(n + 1)]
    sides = [(u, gap + k * (projection - RAIL) / m) for k in range(1, m) for u in (gap, width - RAIL + gap)]
    inner = front[1:-1] + sides
    return [front[0], front[-1], *(inner[k] for k in sorted(range(len(inner)), key=_reversed_bits))]


def _reversed_bits(k: int) -> int:
    return int(f"{k:016b}"[::-1], 2)


def _rectangle(left: float, right: float, low: float, high: float, away: float) -> list[Point]:
    return [(left, away, low), (right, away, low), (right, away, high), (left, away, high)]
