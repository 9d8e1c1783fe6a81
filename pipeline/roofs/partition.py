"""A house divided into parts, each under one of its planes, by cuts that pay (for `house_roofs`)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.inside import INSIDE, side_of
from pipeline.roofs.cut_search import OPEN, find_rectangle, rank_cuts, shift_cuts
from pipeline.roofs.subdivision import (
    FACE,
    FACES,
    HALVES,
    NODE,
    TWIN,
    area_of_edges,
    cut_face,
    edges_of_face,
)

RECTANGLE_BONUS = 0.25  # share of the price of a cut by which the best line goes before a rectangle
MOVED_PRICE = 3  # prices that a line must save which is moved to where it has room: with one, cells are 4 % more
SAME, SMALL, CHEAP, LEVEL, APART = range(5)  # why two regions are joined, the first reason first; or not

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class PartRules(NamedTuple):
    """When a piece is cut, and when parts are joined."""

    clearance: float  #: distance of new walls from others (m)
    #: what a part has at least (m², points)
    min_area: float
    min_points: float
    price: float  #: misfit that a wall must save
    #: a wall stays where the roof steps by this (m), or its slopes differ by so much
    min_step: float
    min_kink: float
    max_depth: float  #: how often a piece is cut


@kernel
def cut_house(
    xyz: Array,
    cost: Array,
    lines: tuple[Array, Array, Array, Index],
    net: tuple[Index, Array, Index],
    rules: PartRules,
) -> tuple[Index, Array]:
    """Cut the only face of a subdivision until no cut pays.

    Parameters
    ----------
    xyz : float64, (n, 3)
        Points of the house (m).
    cost : float64, (n, k)
        Misfit of each point under each of the planes that parts may have.
    lines : tuple
        Along which lines to cut: as for `rank_cuts`.
    net
        As from `open_subdivision`.

    Returns
    -------
    face : int64, (n,)
        Face of each point.
    area : float64, (faces,)
        Areas (m²).
    """
    half, place, count = net
    face, area = np.zeros(len(xyz), np.int64), np.zeros(len(place))
    depth, todo = np.zeros(len(area), np.int64), np.empty(len(area), np.int64)
    _, a, b = edges_of_face(half, place, count[HALVES], 0)
    area[0] = area_of_edges(a, b)
    todo[0], n_todo = 0, 1
    while n_todo:
        n_todo -= 1
        piece = todo[n_todo]
        rows = _points_of(face, piece)
        if depth[piece] >= rules.max_depth or len(rows) < 2 * rules.min_points or area[piece] < 2 * rules.min_area:
            continue
        least = max(int(rules.min_points) // 2, int(0.5 * len(rows) * rules.min_area / area[piece]))
        n_before = count[FACES]
        if not _cut_piece(piece, rows, least, (xyz, cost, face), lines, net, rules):
            continue
        for f in range(n_before, count[FACES]):
            _, a, b = edges_of_face(half, place, count[HALVES], f)
            area[f] = area_of_edges(a, b)
            area[piece] -= area[f]
            for p in rows:
                if side_of(xyz[p, 0], xyz[p, 1], 0, len(a), a, b) == INSIDE:
                    face[p] = f
        depth[piece] += 1
        todo[n_todo] = piece
        n_todo += 1
        for f in range(n_before, count[FACES]):
            depth[f] = depth[piece]
            todo[n_todo] = f
            n_todo += 1
    return face, area[: count[FACES]].copy()


@kernel
def _points_of(face: Index, wanted: int) -> Index:
    rows = np.empty(len(face), np.int64)
    n = 0
    for p in range(len(face)):
        if face[p] == wanted:
            rows[n] = p
            n += 1
    return rows[:n].copy()


@kernel
def _cut_piece(
    piece: int,
    rows: Index,
    least: int,
    points: tuple[Array, Array, Index],
    lines: tuple[Array, Array, Array, Index],
    net: tuple[Index, Array, Index],
    rules: PartRules,
) -> bool:
    """Cut a face along the best line, or along the best rectangle if that saves more; tell whether it is cut."""
    half, place, count = net
    xyz, cost, face = points
    ranked = rank_cuts(xyz, cost, face, rows, lines, least, rules.price)
    saved = ranked[0, 3] + RECTANGLE_BONUS * rules.price if len(ranked) else 0.0
    sides = find_rectangle(xyz, cost, rows, lines[0], least, max(saved, rules.price), rules.clearance)
    cut = False
    if sides[0] > 0:
        x, y, current = sides[1], sides[2], piece
        for side in range(4):
            if abs(sides[3 + side]) >= OPEN:
                continue
            line = (x, y, sides[3 + side]) if side < 2 else (-y, x, sides[3 + side])
            n_before = count[FACES]
            if cut_face(half, place, count, current, line, rules.clearance):
                cut = True
                for f in range(n_before, count[FACES]):
                    _, a, b = edges_of_face(half, place, count[HALVES], f)
                    if side_of(sides[7], sides[8], 0, len(a), a, b) == INSIDE:
                        current = f
    for k in range(len(ranked)):
        if cut:
            break
        cut = cut_face(half, place, count, piece, (ranked[k, 0], ranked[k, 1], ranked[k, 2]), rules.clearance)
    if not cut and len(ranked):
        shifted = shift_cuts(xyz, cost, rows, ranked, least, (MOVED_PRICE * rules.price, rules.clearance))
        for k in range(len(shifted)):
            if cut:
                break
            line = (shifted[k, 0], shifted[k, 1], shifted[k, 2])
            cut = cut_face(half, place, count, piece, line, rules.clearance)
    return cut


@kernel
def join_faces(
    planes: Array, cost: Array, face: Index, area: Array, net: tuple[Index, Array, Index], rules: PartRules
) -> tuple[Index, Index]:
    """Join faces under the same plane, too small ones, and those whose wall does not pay.

    Parameters
    ----------
    planes : float64, (k, 3)
        Planes that parts may have.
    cost, net, rules
        As for `cut_house`.
    face, area
        As from there.

    Returns
    -------
    region : int64, (faces,)
        Region of each face, named by its first face.
    plane : int64, (faces,)
        Row of the plane of each region, by its name.
    """
    half, n = net[0], len(area)
    energy, number, area = np.zeros((n, len(planes))), np.zeros(n, np.int64), area.copy()
    for p in range(len(face)):
        number[face[p]] += 1
        for k in range(len(planes)):
            energy[face[p], k] += cost[p, k]
    region, plane = np.arange(n), np.empty(n, np.int64)
    for f in range(n):
        plane[f] = energy[f].argmin()
    walls, sums = _find_walls(half, net[2][HALVES]), (energy, area, number, plane)
    why, loss = np.empty(len(walls), np.int64), np.empty(len(walls))
    changed = -1  # region whose walls are looked at anew; at first, all are
    while True:
        best = -1
        for w in range(len(walls)):
            one, two = _beside(walls, w, region, half)
            if one == two:
                continue
            if changed < 0 or changed in (one, two):
                why[w], loss[w] = _judge_wall(one, two, planes, sums, rules)
                if why[w] == LEVEL and _step_at(one, two, walls, region, planes, plane, net) >= rules.min_step:
                    why[w] = APART
            if why[w] != APART and (best < 0 or _goes_before(w, best, why, loss, walls, region, half)):
                best = w
        if best < 0:
            return region, plane
        changed, gone = _beside(walls, best, region, half)
        region[region == gone] = changed
        for k in range(len(planes)):
            energy[changed, k] += energy[gone, k]
        area[changed] += area[gone]
        number[changed] += number[gone]
        plane[changed] = energy[changed].argmin()


@kernel
def _find_walls(half: Index, n: int) -> Index:
    """Half-edges on both sides of each wall between two faces, int64 (w, 2)."""
    walls, m = np.empty((n, 2), np.int64), 0
    for h in range(n):
        twin = half[h, TWIN]
        if twin > h and half[h, FACE] != half[twin, FACE]:
            walls[m, 0], walls[m, 1] = h, twin
            m += 1
    return walls[:m].copy()


@kernel
def _beside(walls: Index, w: int, region: Index, half: Index) -> tuple[int, int]:
    """Regions on both sides of a wall, the lesser first."""
    one, two = region[half[walls[w, 0], FACE]], region[half[walls[w, 1], FACE]]
    return min(one, two), max(one, two)


@kernel
def _judge_wall(
    one: int, two: int, planes: Array, sums: tuple[Array, Array, Index, Index], rules: PartRules
) -> tuple[int, float]:
    """Why two regions are joined, whatever the roof's step between them, and the misfit that it costs."""
    energy, area, number, plane = sums
    i, j = plane[one], plane[two]
    low = math.inf
    for k in range(len(planes)):
        low = min(low, energy[one, k] + energy[two, k])
    loss = low - energy[one, i] - energy[two, j]
    why = APART
    if i == j:
        why = SAME
    elif min(area[one], area[two]) < rules.min_area or min(number[one], number[two]) < rules.min_points:
        why = SMALL
    elif loss < rules.price:
        why = CHEAP
    elif math.hypot(planes[i, 0] - planes[j, 0], planes[i, 1] - planes[j, 1]) < rules.min_kink:
        why = LEVEL
    return why, loss


@kernel
def _step_at(
    one: int,
    two: int,
    walls: Index,
    region: Index,
    planes: Array,
    plane: Index,
    net: tuple[Index, Array, Index],
) -> float:
    """Greatest step of the roof at the vertices of the walls between two regions (m)."""
    half, place, _ = net
    i, j = plane[one], plane[two]
    a, b, c = planes[i, 0] - planes[j, 0], planes[i, 1] - planes[j, 1], planes[i, 2] - planes[j, 2]
    step = 0.0
    for w in range(len(walls)):
        if _beside(walls, w, region, half) == (one, two):
            for node in (half[walls[w, 0], NODE], half[walls[w, 1], NODE]):
                step = max(step, abs(a * place[node, 0] + b * place[node, 1] + c))
    return step


@kernel
def _goes_before(w: int, other: int, why: Index, loss: Array, walls: Index, region: Index, half: Index) -> bool:
    """Whether the regions at a wall are joined before those at another one: by reason, cost, then their names."""
    if why[w] != why[other]:
        return bool(why[w] < why[other])
    if loss[w] != loss[other]:
        return bool(loss[w] < loss[other])
    return bool(_beside(walls, w, region, half) < _beside(walls, other, region, half))


@kernel
def limit_parts(xyz: Array, part: Index, n_parts: int, share: float, room: float) -> Array:
    """Heights between which the roof of each part is kept, float64 (n_parts, 2).

    Parameters
    ----------
    xyz : float64, (n, 3)
        Points, ascending by height (m).
    part : int64, (n,)
        Part of each.
    n_parts : int
        Number of parts.
    share : float
        Share of a part's points below the lower limit less the room, and above the upper one.
    room : float
        Distance of the limits from these points (m).

    Returns
    -------
    float64, (n_parts, 2)
        Of all points for a part without any.
    """
    limits = np.empty((n_parts, 2))
    for k in range(n_parts):
        rows = _points_of(part, k)
        if len(rows) == 0:
            rows = np.arange(len(xyz))
        for side in range(2):
            at = (share if side == 0 else 1 - share) * (len(rows) - 1)
            below = int(at)
            low, high = xyz[rows[below], 2], xyz[rows[min(below + 1, len(rows) - 1)], 2]
            limits[k, side] = low + (at - below) * (high - low) + (-room if side == 0 else room)
    return limits
