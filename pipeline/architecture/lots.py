"""Lots that houses stand on: where each is, by its numbers alone."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

PLACEMENTS = ("grid", "random", "rows", "blocks")
ROW = 6  # lots of a row, the last of which stays free
BLOCK = (7, 6)  # lots of a block eastwards and northwards; the first column and row are streets
_STREET = 12.0  # m between two rows


@dataclass(frozen=True)
class Lot:
    """A lot."""

    #: its numbers: eastwards and northwards
    i: int
    j: int
    #: its centre (m)
    x: float
    y: float
    size: float  #: diameter of the circle that a house on it has to keep to (m); of a row, its width
    rotation: float  #: of the house (degrees)
    party: tuple[int, ...] = ()  #: walls that its house shares with neighbours: it fills the lot between them
    use: str = "house"  #: ``"house"``, ``"street"`` or ``"court"``
    corner: bool = False  #: whether houses of another side of its block stand beside its back


def list_lots(
    bounds: tuple[float, float, float, float], placement: str, size: float, *, seed: int, depth: float = 0.0
) -> Iterator[Lot]:
    """List the lots whose centre lies in a box, row by row.

    Parameters
    ----------
    bounds : tuple of 4 floats
        West, south, east, north (m); a centre on the western or southern side is inside.
    placement : str
        ``"grid"``: one beside the other, houses along the axes; ``"random"``: turned, and moved within the lot
        such that none can meet its neighbour; ``"rows"``: terraces of five houses that share walls, along streets;
        ``"blocks"``: houses that share walls around courtyards, with streets between.
    size : float
        Of a lot (m); of a row, the width of a house.
    seed : int
        What turns and moves are drawn from.
    depth : float
        How deep the houses of rows are (m).

    Notes
    -----
    A lot depends on seed and numbers alone: the lots of two boxes side by side are those of both.
    """
    if placement not in PLACEMENTS or not size > 0:
        raise ValueError(f"placement {placement!r}, lots of {size} m; placements are {', '.join(PLACEMENTS)}")
    west, south, east, north = bounds
    _, step_y = lot_steps(placement, size, depth)
    for j in range(math.floor(south / step_y) - 1, math.ceil(north / step_y) + 1):
        for i in range(math.floor(west / size) - 1, math.ceil(east / size) + 1):
            lot = _make_lot(i, j, placement, size, step_y, seed)
            if lot is not None and lot.use == "house" and west <= lot.x < east and south <= lot.y < north:
                yield lot


def lot_steps(placement: str, size: float, depth: float) -> tuple[float, float]:
    """Give how far lots are from each other eastwards and northwards (m), as of `list_lots`."""
    return size, depth + _STREET if placement == "rows" else size


def list_corners(
    bounds: tuple[float, float, float, float], placement: str, size: float, *, depth: float = 0.0
) -> Iterator[tuple[int, int, float, float]]:
    """List the lower left corners of lots that lie in a box, as `list_lots`: numbers of the lot, and the place."""
    west, south, east, north = bounds
    _, step_y = lot_steps(placement, size, depth)
    for j in range(math.ceil(south / step_y), math.ceil(north / step_y)):
        for i in range(math.ceil(west / size), math.ceil(east / size)):
            if placement != "blocks" or all(
                _block_lot(i - a, j - b, size).use == "court" for a in (0, 1) for b in (0, 1)
            ):
                yield i, j, i * size, j * step_y


def list_open_lots(bounds: tuple[float, float, float, float], placement: str, size: float) -> Iterator[Lot]:
    """List the lots of streets and courtyards whose centre lies in a box, as `list_lots`."""
    west, south, east, north = bounds
    if placement != "blocks":
        return
    for j in range(math.floor(south / size) - 1, math.ceil(north / size) + 1):
        for i in range(math.floor(west / size) - 1, math.ceil(east / size) + 1):
            lot = _block_lot(i, j, size)
            if lot.use != "house" and west <= lot.x < east and south <= lot.y < north:
                yield lot


def _block_lot(i: int, j: int, size: float) -> Lot:
    """The lot of a block: rows of houses look south and north, columns between them west and east."""
    column, row = i % BLOCK[0], j % BLOCK[1]
    last, top = BLOCK[0] - 1, BLOCK[1] - 1
    centre = (i + 0.5) * size, (j + 0.5) * size
    if column == 0 or row == 0:
        return Lot(i, j, *centre, size, 0.0, use="street")
    if row in (1, top):
        sides = ((3,) if column > 1 else ()) + ((1,) if column < last else ())
        turned = row == top
        party = tuple(sorted(4 - side for side in sides)) if turned else sides
        if column in (1, last):  # a house of the next side stands close behind the back
            party = (*party, 2)
        return Lot(i, j, *centre, size, 180.0 if turned else 0.0, party)
    if column in (1, last):
        south, north = row > 2, row < top - 1
        # A front to the west has the south on its right side, one to the east on its left.
        right, left = (south, north) if column == 1 else (north, south)
        party = ((3,) if left else ()) + ((1,) if right else ())
        corner = row in (2, top - 1)
        return Lot(i, j, *centre, size, 270.0 if column == 1 else 90.0, party, corner=corner)
    return Lot(i, j, *centre, size, 0.0, use="court")


def _make_lot(i: int, j: int, placement: str, size: float, step_y: float, seed: int) -> Lot | None:
    x, y = (i + 0.5) * size, (j + 0.5) * step_y
    if placement == "blocks":
        return _block_lot(i, j, size)
    if placement == "grid":
        return Lot(i, j, x, y, size, 0.0)
    if placement == "rows":
        k = (i + 3 * j) % ROW
        if k == ROW - 1:
            return None
        party = ((3,) if k > 0 else ()) + ((1,) if k < ROW - 2 else ())
        return Lot(i, j, x, y, size, 0.0, party)
    rng = lot_random(seed, i, j, 0)
    rotation, angle, far = rng.random(3)
    room = 0.08 * size
    moved = x + room * far * math.cos(math.tau * angle), y + room * far * math.sin(math.tau * angle)
    return Lot(i, j, *moved, size - 2 * room, 360.0 * float(rotation))


def lot_random(seed: int, i: int, j: int, purpose: int) -> np.random.Generator:
    """Random numbers of a lot: of its seed, its numbers and what they are for, alone."""
    return np.random.default_rng([seed, i % 2**32, j % 2**32, purpose])
