"""A house divided into parts, each under one of its planes, by cuts that pay (for `house_roofs`)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.geometry.inside import INSIDE, side_of
from pipeline.roofs.cut_search import OPEN, find_rectangle, find_ridges, order_across, rank_cuts
from pipeline.roofs.subdivision import (
    FACE,
    FACES,
    HALVES,
    NEXT,
    NODE,
    TWIN,
    area_of_edges,
    cut_face,
    edges_of_face,
)

RECTANGLE_BONUS = 0.25  # share of the price of a cut by which the best line goes before a rectangle
SAME, SMALL, CHEAP, LEVEL, APART = range(5)  # why two regions are joined, the first reason first; or not

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class PartRules(NamedTuple):
    """When a piece is cut, and when parts are joined.

    Attributes
    ----------
    clearance : float
        Distance of new walls from others (m).
    min_area, min_points : float
        What a part has at least (m², points).
    price : float
        Misfit that a wall must save.
    min_step, min_kink : float
        A wall stays where the roof steps by this (m), or its slopes differ by so much.
    max_depth : float
        How often a piece is cut.
    """

    clearance: float
    min_area: float
    min_points: float
    price: float
    min_step: float
    min_kink: float
    max_depth: float


@kernel
def cut_house(
    xyz: Array, planes: Array, cost: Array, along: Array, net: tuple[Index, Array, Index], rules: PartRules
) -> tuple[Index, Array]:
    """Cut the only face of a subdivision until no cut pays.

    Parameters
    ----------
    xyz : float64, (n, 3)
        Points of the house (m).
    planes : float64, (k, 3)
        Planes that parts may have.
    cost : float64, (n, k)
        Misfit of each point under each.
    along : float64, (d, 2)
        Directions of walls.
    net
        As from `open_subdivision`.
    rules : PartRules
        Thresholds.

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
    lines = (along, find_ridges(planes), *order_across(xyz, along))
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
    ranked = rank_cuts(xyz, cost, face, piece, lines, least, rules.price)
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
    return cut


@kernel
def join_faces(  # noqa: PLR0912, PLR0915
    planes: Array, cost: Array, face: Index, area: Array, net: tuple[Index, Array, Index], rules: PartRules
) -> tuple[Index, Index]:
    """Join faces under the same plane, too small ones, and those whose wall does not pay.

    Parameters
    ----------
    planes, cost, net, rules
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
    half, place, count = net
    n = len(area)
    energy, number, area = np.zeros((n, len(planes))), np.zeros(n, np.int64), area.copy()
    for p in range(len(face)):
        number[face[p]] += 1
        for k in range(len(planes)):
            energy[face[p], k] += cost[p, k]
    region, plane = np.arange(n), np.empty(n, np.int64)
    for f in range(n):
        plane[f] = energy[f].argmin()
    walls = np.empty((count[HALVES], 2), np.int64)
    n_walls = 0
    for h in range(count[HALVES]):
        t = half[h, TWIN]
        if t > h and half[h, FACE] != half[t, FACE]:
            walls[n_walls, 0], walls[n_walls, 1] = h, t
            n_walls += 1
    gap, loss = np.empty((n, n)), np.empty((n, n))
    why = np.empty((n, n), np.int64)
    changed = -1  # region whose walls are looked at anew; at first, all are
    while True:
        for step in range(2):
            for w in range(n_walls):
                h = walls[w, 0]
                one, two = region[half[h, FACE]], region[half[walls[w, 1], FACE]]
                one, two = min(one, two), max(one, two)
                if one == two or (changed >= 0 and changed not in (one, two)):
                    continue
                if step == 0:
                    gap[one, two], why[one, two] = 0.0, -1
                    continue
                i, j = plane[one], plane[two]
                a, b, c = planes[i, 0] - planes[j, 0], planes[i, 1] - planes[j, 1], planes[i, 2] - planes[j, 2]
                for node in (half[h, NODE], half[half[h, NEXT], NODE]):
                    gap[one, two] = max(gap[one, two], abs(a * place[node, 0] + b * place[node, 1] + c))
                if why[one, two] < 0:
                    low = math.inf
                    for k in range(len(planes)):
                        low = min(low, energy[one, k] + energy[two, k])
                    loss[one, two] = low - energy[one, i] - energy[two, j]
                    why[one, two] = APART
                    if i == j:
                        why[one, two] = SAME
                    elif (
                        min(area[one], area[two]) < rules.min_area
                        or min(number[one], number[two]) < rules.min_points
                    ):
                        why[one, two] = SMALL
                    elif loss[one, two] < rules.price:
                        why[one, two] = CHEAP
                    elif math.hypot(a, b) < rules.min_kink:
                        why[one, two] = LEVEL
        best, best_one, best_two = APART, -1, -1
        for w in range(n_walls):
            one, two = region[half[walls[w, 0], FACE]], region[half[walls[w, 1], FACE]]
            one, two = min(one, two), max(one, two)
            if one == two or why[one, two] == APART:
                continue
            if why[one, two] == LEVEL and gap[one, two] >= rules.min_step:
                continue
            if why[one, two] < best or (
                why[one, two] == best
                and (
                    loss[one, two] < loss[best_one, best_two]
                    or (loss[one, two] == loss[best_one, best_two] and (one, two) < (best_one, best_two))
                )
            ):
                best, best_one, best_two = why[one, two], one, two
        if best_one < 0:
            return region, plane
        for f in range(n):
            if region[f] == best_two:
                region[f] = best_one
        for k in range(len(planes)):
            energy[best_one, k] += energy[best_two, k]
        area[best_one] += area[best_two]
        number[best_one] += number[best_two]
        plane[best_one] = energy[best_one].argmin()
        changed = best_one


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
