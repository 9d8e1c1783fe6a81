"""Roofs of houses as planes from their points: houses divided into parts with a plane each (step 2.0)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.roofs import ROOF_METHODS, Roofs, join_roofs, take_roofs
from pipeline.geometry.group_order import percentile_by_group, sort_points
from pipeline.geometry.inside import read_rings
from pipeline.geometry.rings import make_canonical
from pipeline.roofs.cut_search import find_ridges, order_across
from pipeline.roofs.families import fit_family
from pipeline.roofs.house_levels import HouseParts
from pipeline.roofs.lines import wall_directions
from pipeline.roofs.local_planes import fit_locally
from pipeline.roofs.partition import PartRules, cut_house, join_faces, limit_parts
from pipeline.roofs.plane_search import (
    BAND,
    MAX_LEVELS,
    MAX_PLANES,
    misfit,
    refit_plane,
    regularise,
    search_levels,
    search_planes,
)
from pipeline.roofs.refit import LIMIT_ROOM, LIMIT_SHARE
from pipeline.roofs.roof_points import RoofPoints
from pipeline.roofs.subdivision import (
    HALVES,
    NODES,
    area_of_edges,
    edges_of_face,
    open_subdivision,
    outline_regions,
)

WALL_ROOM = 1.5  # clearances between a new wall and others: with one, cells are a third more for the same fit
PLANES, FAMILY, FLAT = (ROOF_METHODS.index(name) for name in ("planes", "family", "flat"))
MIN_FITTED = 8  # points to which a plane is fitted again
MIN_NEAREST = 4  # points of a house to which a plane is the nearest
DENSITY = 6.0  # points a m², of which denser ones are thinned to up to twice as many

Array = NDArray[np.float64]

# Parts of a house, their roofs, and where they come from: an index into `ROOF_METHODS`.
NewRoof = tuple[NDArray[np.object_], Roofs, int]

# Slopes and heights, and limits of the parts of a house; vertices of closed rings, their rings, the part of each
# ring and whether it is a shell; and whether all planes are of a family.
_Division = tuple[Array, Array, Array, NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_], bool]


@dataclass(frozen=True)
class RoofOptions:
    """How roofs are fitted to points."""

    clearance: float  #: a new wall passes through a vertex or keeps 1.5 times this distance from it (m)
    min_area: float = 4.0  #: least area of a part (m²)
    min_points: int = 8  #: least number of roof points of a part
    min_density: float = 0.5  #: least number of roof points of a house for each m²; with fewer it has one height
    max_slope: float = 1.7  #: greatest slope of a roof
    cut_price: float = 4.0  #: what a new wall must save: area (m²) of roof that is half a metre off its points
    #: a wall stays where the roof steps by this (m), or its slopes differ by so much
    min_step: float = 0.3
    min_kink: float = 0.18
    max_depth: int = 9  #: how often a piece is cut in two


@dataclass(frozen=True, eq=False)
class HouseRoofs:
    """Roofs of ``h`` houses."""

    parts: HouseParts  #: their ``p`` parts
    roofs: Roofs  #: the roof of each part; NaN for a house without points
    method: NDArray[np.int8]  #: (h,): where the roof of each house comes from: index into `ROOF_METHODS`
    n_planes: NDArray[np.int32]  #: (h,): number of different planes of each house
    too_few: NDArray[np.bool_]  #: (h,): houses with too few points for planes: one flat part


def fit_roofs(
    polygons: NDArray[np.object_],
    points: RoofPoints,
    options: RoofOptions,
    finer: tuple[float, float] | None = None,
) -> tuple[HouseRoofs, HouseRoofs | None]:
    """Divide houses into parts, each under a plane, by their points and outlines alone.

    Parameters
    ----------
    polygons : object, (h,)
        Valid shapely Polygons (m), courtyards as holes.
    points : RoofPoints
        Their roof points, as from `locate_roof_points`.
    finer : (float, float), optional
        Clearance and price of cuts of a second division by the same planes.

    Returns
    -------
    HouseRoofs
        Parts in canonical form that cover each house without overlap and share their vertices to the bit; a
        house that is not divided keeps its polygon, to the bit.
    HouseRoofs or None
        The second division.

    Raises
    ------
    ValueError
        If the options are out of range, or polygons and points do not match.

    Notes
    -----
    1. A plane is fitted to the neighbours of each point (`fit_locally`), and of these the planes that most points
       support are taken one after the other (`search_planes`); flat, or uphill across a wall, where they nearly
       are. Flat planes at heights where many other points lie (`search_levels`), the planes of the best family
       of roofs (`fit_family`) and a flat one at the median are added.
    2. Each point has a misfit under each plane: the square of its distance over half a metre, linear beyond.
       The outline is cut in two where both sides fall best under a plane each (`cut_house`), along walls or
       where planes meet, or along a rectangle under another plane, as long as a cut saves `cut_price`. Where
       no line has room, the best are moved by up to the distance that walls keep (`shift_cuts`).
    3. Neighbouring faces are joined (`join_faces`): under the same plane, too small, or not worth their wall.

    Points are put in an order of their own first, so theirs does not matter. Of dense points every second, third
    (...) is looked at. A house with fewer than `min_points` or `min_density` has one height, and so has one
    whose best roof is flat: `too_few` tells them apart. O(n k) for n points and k planes of a house, a cut.
    """
    _check(polygons, points, options)
    second = options if finer is None else replace(options, clearance=finer[0], cut_price=finer[1])
    _check(polygons, points, second)
    area = shapely.area(polygons)
    bounds = shapely.bounds(polygons).reshape(-1, 4)
    origin = np.floor((bounds[:, :2] + bounds[:, 2:]) / 2)
    count = np.diff(points.start)
    too_few = (count < options.min_points) | (count < options.min_density * area)
    xyz = sort_points(points.start, points.xyz)
    heights = percentile_by_group(points.start, points.z, 50)
    start, kept = _thin_out(points.start, np.where(too_few, np.inf, count / (area * DENSITY)))
    xyz = xyz[kept]
    xyz[:, :2] -= np.repeat(origin, np.diff(start), axis=0)
    local = fit_locally(start, xyz, area)
    several = (options,) if finer is None else (options, second)
    fitted = _fit_houses(polygons, origin, start, (xyz, local), np.flatnonzero(~too_few), several)
    first, *rest = [_assemble(polygons, origin, heights, too_few, one) for one in fitted]
    return first, rest[0] if rest else None


def replace_roofs(fitted: HouseRoofs, new: Mapping[int, NewRoof]) -> HouseRoofs:
    """Put other roofs in the place of those of some houses.

    Parameters
    ----------
    new : mapping of int to NewRoof
        By the row of the house.
    """
    if not new:
        return fitted
    rows = list(new)
    gone = np.zeros(len(fitted.method), np.bool_)
    gone[rows] = True
    kept = np.flatnonzero(~gone[fitted.parts.house])
    house = np.concatenate(
        [fitted.parts.house[kept], *(np.full(len(parts), row) for row, (parts, _, _) in new.items())]
    )
    order = np.argsort(house, kind="stable")
    pieces = np.concatenate([fitted.parts.polygons[kept], *(parts for parts, _, _ in new.values())])
    roofs = join_roofs([take_roofs(fitted.roofs, kept), *(roofs for _, roofs, _ in new.values())])
    method, n_planes = fitted.method.copy(), fitted.n_planes.copy()
    method[rows] = [code for _, _, code in new.values()]
    n_planes[rows] = [len(np.unique(roofs.plane, axis=0)) for _, roofs, _ in new.values()]
    parts = HouseParts(pieces[order], house[order])
    return HouseRoofs(parts, take_roofs(roofs, order), method, n_planes, fitted.too_few)


def take_roof(fitted: HouseRoofs, row: int) -> NewRoof:
    """Take the roof of a house, for `replace_roofs`."""
    first, last = np.searchsorted(fitted.parts.house, [row, row + 1])
    mine = np.arange(first, last)
    return fitted.parts.polygons[mine], take_roofs(fitted.roofs, mine), int(fitted.method[row])


def _thin_out(start: NDArray[np.int64], share: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Keep one in so many points of each house: `share` rounded down, 1 at least; none where it is infinite.

    Gives where those of each house start, and bool (n,) which they are.
    """
    count = np.diff(start)
    every = np.repeat(np.maximum(np.floor(share), 1), count)
    kept: NDArray[np.bool_] = (np.arange(start[-1]) - np.repeat(start[:-1], count)) % every == 0
    kept &= np.isfinite(every)
    return np.concatenate(([0], np.cumsum(kept)))[start], kept


@dataclass(frozen=True, eq=False)
class _FittedHouse:
    """Parts of a house, as from `_fit_house`."""

    house: int
    plane: Array
    limits: Array
    xy: Array
    ring: NDArray[np.int64]
    part: NDArray[np.int64]
    shell: NDArray[np.bool_]
    of_family: bool


def _fit_houses(
    polygons: NDArray[np.object_],
    origin: Array,
    start: NDArray[np.int64],
    points: tuple[Array, Array],
    rows: NDArray[np.int64],
    several: Sequence[RoofOptions],
) -> list[list[_FittedHouse]]:
    """Divide the houses of some rows by each of the options, which differ in clearance and price alone."""
    rings, options = read_rings(polygons[rows]), several[0]
    levels = np.array([(WALL_ROOM * one.clearance, one.cut_price) for one in several])
    rules = PartRules(
        math.nan,
        float(options.min_area),
        float(options.min_points),
        math.nan,
        float(options.min_step),
        float(options.min_kink),
        float(options.max_depth),
    )
    found: list[list[_FittedHouse]] = [[] for _ in several]
    for k, i in enumerate(rows.tolist()):
        begin, end = rings.start[k], rings.start[k + 1]
        first, last = start[i], start[i + 1]
        divisions = _fit_house(
            points[0][first:last],
            points[1][first:last],
            rings.xy[begin:end] - origin[i],
            rings.ring[begin:end],
            rules,
            levels,
            float(options.max_slope),
        )
        for fitted, division in zip(found, divisions, strict=True):
            fitted.append(_FittedHouse(i, *division))
    return found


def _assemble(
    polygons: NDArray[np.object_],
    origin: Array,
    height: Array,
    too_few: NDArray[np.bool_],
    fitted: list[_FittedHouse],
) -> HouseRoofs:
    """Put the parts of all houses together: those fitted, and one flat part of each other house."""
    n = len(polygons)
    n_parts, n_planes, method = np.ones(n, np.int64), np.ones(n, np.int32), np.full(n, FLAT, np.int8)
    for one in fitted:
        flat = bool((one.plane[:, :2] == 0).all())
        method[one.house] = FLAT if flat else FAMILY if one.of_family else PLANES
        n_parts[one.house], n_planes[one.house] = len(one.plane), len(np.unique(one.plane, axis=0))
    first = np.cumsum(n_parts) - n_parts
    house = np.repeat(np.arange(n), n_parts)
    parts, plane, limits = polygons[house], np.zeros((len(house), 3)), np.empty((len(house), 2))
    plane[first, 2] = height
    for one in fitted:
        plane[first[one.house] : first[one.house] + len(one.plane)] = one.plane
        limits[first[one.house] : first[one.house] + len(one.plane)] = one.limits
    flat = (plane[:, :2] == 0).all(axis=1)
    limits[flat] = plane[flat][:, [2, 2]]
    divided = [one for one in fitted if len(one.plane) > 1]
    if divided:
        n_rings = np.cumsum([0, *(len(one.part) for one in divided)])
        owner = np.concatenate([first[one.house] + one.part for one in divided])
        xy = np.concatenate([one.xy + origin[one.house] for one in divided])
        ring = np.concatenate([one.ring + begin for one, begin in zip(divided, n_rings, strict=False)])
        shell = np.concatenate([one.shell for one in divided])
        order = np.lexsort((~shell, owner))
        rings = shapely.linearrings(xy, indices=ring)[order]
        rows, index = np.unique(owner[order], return_inverse=True)
        parts[rows] = make_canonical(shapely.polygons(rings, indices=index))
    return HouseRoofs(HouseParts(parts, house), Roofs(plane, origin[house], limits), method, n_planes, too_few)


@kernel
def _fit_house(
    xyz: Array,
    local: Array,
    vertices: Array,
    ring: NDArray[np.int64],
    rules: PartRules,
    levels: Array,
    max_slope: float,
) -> list[_Division]:
    """Fit planes to a house, and divide it by the rules with each clearance and price for each m² of `levels`."""
    net = open_subdivision(vertices, ring, len(xyz))
    n_given = net[2][NODES]
    _, a, b = edges_of_face(net[0], net[1], net[2][HALVES], 0)
    density = len(xyz) / area_of_edges(a, b)
    least = max(rules.min_points, density * rules.min_area)
    planes, cost, along, n_family = _find_candidates(xyz, local, a, b, density, least, max_slope)
    lines = (along, find_ridges(planes), *order_across(xyz, along))
    divisions = []
    for level in levels:
        net = open_subdivision(vertices, ring, len(xyz))
        rules = PartRules(
            level[0],
            rules.min_area,
            rules.min_points,
            level[1] * density,
            rules.min_step,
            rules.min_kink,
            rules.max_depth,
        )
        face, area = cut_house(xyz, cost, lines, net, rules)
        region, best = join_faces(planes, cost, face, area, net, rules)
        divisions.append(_take_parts(xyz, (planes, n_family), face, (region, best), net, n_given))
    return divisions


@kernel
def _take_parts(
    xyz: Array,
    planes: tuple[Array, int],
    face: NDArray[np.int64],
    joined: tuple[NDArray[np.int64], NDArray[np.int64]],
    net: tuple[NDArray[np.int64], Array, NDArray[np.int64]],
    n_given: int,
) -> _Division:
    """Make parts of faces that are joined."""
    region, best = joined
    part = np.empty(len(region), np.int64)
    n_parts = 0
    for f in range(len(region)):
        if region[f] == f:
            part[f] = n_parts
            n_parts += 1
    used, of_family = np.empty((n_parts, 3)), True
    for f in range(len(region)):
        part[f] = part[region[f]]
        if region[f] == f:
            of_family &= best[f] < planes[1]
            for q in range(3):
                used[part[f], q] = planes[0][best[f], q]
    limits = limit_parts(xyz, part[face], n_parts, LIMIT_SHARE, LIMIT_ROOM)
    xy, of_ring, owner, shell = outline_regions(net[0], net[1], net[2], part, n_given)
    return used, limits, xy, of_ring, owner, shell, of_family


@kernel
def _is_known(xyz: Array, plane: Array, others: Array) -> bool:
    """Whether a plane is, over the points near it, close to another one."""
    n, far = 0, np.zeros(len(others))
    for p in range(len(xyz)):
        z = plane[0] * xyz[p, 0] + plane[1] * xyz[p, 1] + plane[2]
        if abs(xyz[p, 2] - z) < 2 * BAND:
            n += 1
            for k in range(len(others)):
                far[k] += abs(others[k, 0] * xyz[p, 0] + others[k, 1] * xyz[p, 1] + others[k, 2] - z)
    known = False
    for k in range(len(others)):
        known |= far[k] < BAND * n
    return known


@kernel
def _find_candidates(
    xyz: Array, local: Array, a: Array, b: Array, density: float, least: float, max_slope: float
) -> tuple[Array, Array, Array, int]:
    """Find the planes that parts may have.

    Gives them, misfits (n, k), directions of walls, and how many planes are of a family: these come first.
    """
    along = wall_directions(a, b)
    family = fit_family(xyz, a, b, along, density, max_slope)
    found = np.empty((MAX_PLANES + MAX_LEVELS, 3))
    n_found = search_planes(xyz, local, least, max_slope, found[:MAX_PLANES])
    n_found = search_levels(xyz, least, found, n_found)
    planes = np.empty((len(family) + n_found + 1, 3))
    n_family = n = 0
    for k in range(len(family)):
        if not _is_known(xyz, family[k], found[:n_found]):
            planes[n, 0], planes[n, 1], planes[n, 2] = family[k, 0], family[k, 1], family[k, 2]
            n += 1
    n_family = n
    for k in range(n_found):
        s, t, c = _regularise_gently(xyz, (found[k, 0], found[k, 1], found[k, 2]), along, max_slope)
        planes[n, 0], planes[n, 1], planes[n, 2] = s, t, c
        n += 1
    planes[n, 0], planes[n, 1] = 0.0, 0.0
    planes[n, 2] = (xyz[(len(xyz) - 1) // 2, 2] + xyz[len(xyz) // 2, 2]) / 2
    planes, n_family = _refit_nearest(xyz, planes[: n + 1], along, max_slope, n_family)
    cost = np.empty((len(xyz), len(planes)))
    for p in range(len(xyz)):
        for k in range(len(planes)):
            cost[p, k] = misfit(xyz[p, 2] - planes[k, 0] * xyz[p, 0] - planes[k, 1] * xyz[p, 1] - planes[k, 2])
    return planes, cost, along, n_family


@kernel
def _regularise_gently(
    xyz: Array, plane: tuple[float, float, float], along: Array, max_slope: float
) -> tuple[float, float, float]:
    """Give a plane as `regularise` does, or as it was where that is too steep."""
    a, b, c = regularise(xyz, plane, along)
    if a * a + b * b > max_slope * max_slope:
        return plane
    return a, b, c


@kernel
def _refit_nearest(xyz: Array, planes: Array, along: Array, max_slope: float, n_family: int) -> tuple[Array, int]:
    """Fit each plane but the last, flat one to the points nearest to it; those with hardly any point go.

    Gives the planes that are left, and how many of them are of a family.
    """
    nearest, count = np.empty(len(xyz), np.int64), np.zeros(len(planes), np.int64)
    for p in range(len(xyz)):
        low = math.inf
        for k in range(len(planes)):
            far = abs(xyz[p, 2] - planes[k, 0] * xyz[p, 0] - planes[k, 1] * xyz[p, 1] - planes[k, 2])
            if far < low:
                low, nearest[p] = far, k
        count[nearest[p]] += 1
    kept = np.empty((len(planes), 3))
    n = left_family = 0
    mine = np.empty((len(xyz), 3))
    for k in range(len(planes)):
        last = k == len(planes) - 1
        if count[k] < MIN_NEAREST and not last:
            continue
        a, b, c = planes[k, 0], planes[k, 1], planes[k, 2]
        if count[k] >= MIN_FITTED and not last:
            m = 0
            for p in range(len(xyz)):
                if nearest[p] == k:
                    mine[m, 0], mine[m, 1], mine[m, 2] = xyz[p, 0], xyz[p, 1], xyz[p, 2]
                    m += 1
            s, t, height = regularise(mine[:m], refit_plane(mine[:m], (a, b, c), 2 * BAND), along)
            if s * s + t * t <= max_slope * max_slope:
                a, b, c = s, t, height
        kept[n, 0], kept[n, 1], kept[n, 2] = a, b, c
        n += 1
        left_family += k < n_family
    return kept[:n].copy(), left_family


def _check(polygons: NDArray[np.object_], points: RoofPoints, options: RoofOptions) -> None:
    if len(points.start) != len(polygons) + 1:
        raise ValueError(f"{len(polygons)} polygons do not match the points of {len(points.start) - 1}")
    positive = (options.clearance, options.min_area, options.min_points, options.max_slope, options.cut_price)
    others = (options.min_density, options.min_step, options.min_kink, options.max_depth)
    if not (all(value > 0 for value in positive) and all(value >= 0 for value in others)):
        raise ValueError(f"options of roofs must be positive, min_density to max_depth not negative: {options}")
