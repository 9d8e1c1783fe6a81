"""Roofs of houses as planes from their points: houses divided into parts with a plane each (step 2.0)."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.roofs import ROOF_METHODS, Roofs
from pipeline.geometry.group_order import sort_points, sort_values
from pipeline.geometry.outlines import open_outline
from pipeline.geometry.rings import make_canonical
from pipeline.roofs.families import fit_family
from pipeline.roofs.house_levels import HouseParts
from pipeline.roofs.lines import wall_directions
from pipeline.roofs.local_planes import fit_locally
from pipeline.roofs.partition import Fit, cut_to_cells, join_parts
from pipeline.roofs.plane_search import BAND, MAX_PLANES, misfit, refit_plane, regularise, search_planes
from pipeline.roofs.roof_points import RoofPoints

PLANES, FAMILY, _, FLAT = range(len(ROOF_METHODS))
STRAIGHT = 1e-3  # m, square root of the area of the triangle at a vertex that is dropped as straight
LIMIT_SHARE = 0.02  # of a part's points may lie beyond its limits, on either side
LIMIT_ROOM = 0.5  # m, between these points and the limits
MIN_REFIT = 6  # points that move a face

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RoofOptions:
    """How roofs are fitted to points.

    Attributes
    ----------
    clearance : float
        A new wall passes through a vertex or keeps this distance from it (m).
    min_area : float
        Least area of a part (m²).
    min_points : int
        Least number of roof points of a part.
    min_density : float
        Least number of roof points of a house for each m²; with fewer it has one height.
    max_slope : float
        Greatest slope of a roof.
    cut_price : float
        What a new wall must save: area (m²) of roof that is a metre and more off its points.
    min_step, min_kink : float
        A wall stays where the roof steps by this (m), or its slopes differ by so much.
    max_depth : int
        How often a piece is cut in two.
    """

    clearance: float
    min_area: float = 4.0
    min_points: int = 8
    min_density: float = 0.5
    max_slope: float = 1.7
    cut_price: float = 4.0
    min_step: float = 1.0
    min_kink: float = 0.18
    max_depth: int = 9


@dataclass(frozen=True, eq=False)
class HouseRoofs:
    """Roofs of ``h`` houses.

    Attributes
    ----------
    parts : HouseParts
        Their ``p`` parts.
    roofs : Roofs
        The roof of each part; NaN for a house without points.
    method : int8, (h,)
        Where the roof of each house comes from: index into `ROOF_METHODS`.
    n_planes : int32, (h,)
        Number of different planes of each house.
    """

    parts: HouseParts
    roofs: Roofs
    method: NDArray[np.int8]
    n_planes: NDArray[np.int32]


def fit_roofs(polygons: NDArray[np.object_], points: RoofPoints, options: RoofOptions) -> HouseRoofs:
    """Divide houses into parts with a plane each."""
    _check(polygons, points, options)
    area = shapely.area(polygons)
    bounds = shapely.bounds(polygons).reshape(-1, 4)
    origin = np.floor((bounds[:, :2] + bounds[:, 2:]) / 2)
    count = np.diff(points.start)
    xyz = sort_points(points.start, points.xyz)
    xyz[:, :2] -= np.repeat(origin, count, axis=0)
    local = fit_locally(points.start, xyz, area)
    enough = (count >= 2 * options.min_points) & (count >= options.min_density * area)
    parts: list[shapely.Polygon] = []
    planes, limits, house = [], [], []
    method, n_planes = np.full(len(polygons), FLAT, np.int8), np.ones(len(polygons), np.int32)
    for i, (first, last) in enumerate(pairwise(points.start.tolist())):
        if enough[i]:
            mine, plane, limit, method[i] = _fit_house(
                polygons[i], origin[i], xyz[first:last], local[first:last], options
            )
        else:
            mine, plane = [polygons[i]], np.array([[0.0, 0.0, _median(xyz[first:last, 2])]])
            limit = plane[:, [2, 2]]
        parts += mine
        planes.append(plane)
        limits.append(limit)
        house += [i] * len(mine)
        n_planes[i] = len(np.unique(plane, axis=0))
    result = np.empty(len(parts), dtype=object)
    result[:] = parts
    of_part = np.array(house, np.int64)
    roofs = Roofs(
        np.concatenate([np.empty((0, 3)), *planes]), origin[of_part], np.concatenate([np.empty((0, 2)), *limits])
    )
    return HouseRoofs(HouseParts(result, of_part), roofs, method, n_planes)


def _median(z: Array) -> float:
    """Median of ascending heights; NaN without any."""
    n = len(z)
    return float((z[(n - 1) // 2] + z[n // 2]) / 2) if n else np.nan


def _fit_house(
    polygon: shapely.Polygon, origin: Array, xyz: Array, local: Array, options: RoofOptions
) -> tuple[list[shapely.Polygon], Array, Array, int]:
    outline = open_outline(shapely.transform(polygon, lambda xy: xy - origin))
    density = len(xyz) / outline.area
    least = max(options.min_points, density * options.min_area)
    planes, cost, along, n_family = _find_candidates(
        xyz, local, *outline.ends, density, float(least), options.max_slope
    )
    fit = Fit(xyz, planes, cost, along, options.cut_price * density)
    cells, rows = cut_to_cells(
        outline,
        fit,
        clearance=options.clearance,
        min_area=options.min_area,
        min_points=options.min_points,
        max_depth=options.max_depth,
    )
    region, best = join_parts(
        cells,
        rows,
        fit,
        min_area=options.min_area,
        min_points=options.min_points,
        min_step=options.min_step,
        min_kink=options.min_kink,
    )
    names = np.unique(region)
    used = best[names]
    plane = planes[used]
    limit = np.empty((len(names), 2))
    for k, name in enumerate(names):
        mine = np.sort(np.concatenate([rows[c] for c in np.flatnonzero(region == name)]))
        z = xyz[mine, 2] if len(mine) >= MIN_REFIT else xyz[:, 2]
        limit[k] = _limits(z)
    flat = (plane[:, :2] == 0).all(axis=1)
    limit[flat] = plane[flat][:, [2, 2]]
    method = FLAT if flat.all() else FAMILY if (used < n_family).all() else PLANES
    if len(names) == 1:
        return [polygon], plane, limit, method
    pieces = np.array([cell.polygon for cell in cells], dtype=object)
    dissolved = np.array([shapely.coverage_union_all(pieces[region == k]) for k in names], dtype=object)
    simple = shapely.coverage_simplify(dissolved, STRAIGHT)
    back = shapely.transform(simple, lambda xy: xy + origin)
    if not (shapely.is_valid(back).all() and (shapely.get_type_id(back) == 3).all()):
        z = _median(xyz[:, 2])
        return [polygon], np.array([[0.0, 0.0, z]]), np.array([[z, z]]), FLAT
    return list(make_canonical(back)), plane, limit, method


def _limits(z: Array) -> Array:
    low, high = np.percentile(z, (100 * LIMIT_SHARE, 100 - 100 * LIMIT_SHARE))
    return np.array([low - LIMIT_ROOM, high + LIMIT_ROOM])


@kernel
def _find_candidates(  # noqa: PLR0912
    xyz: Array, local: Array, a: Array, b: Array, density: float, least: float, max_slope: float
) -> tuple[Array, Array, Array, int]:
    """Find the planes that parts may have.

    Gives them, misfits (n, k), directions of walls, and how many planes are of a family: these come first.
    """
    along = wall_directions(a, b)
    family = fit_family(xyz, a, b, along, density, max_slope)
    found = np.empty((MAX_PLANES, 3))
    n_found = search_planes(xyz, local, least, max_slope, found)
    n = len(xyz)
    k_family = len(family)
    planes = np.empty((k_family + n_found + 1, 3))
    for k in range(k_family):
        planes[k, 0], planes[k, 1], planes[k, 2] = family[k, 0], family[k, 1], family[k, 2]
    for k in range(n_found):
        p, q, c = regularise(xyz, (found[k, 0], found[k, 1], found[k, 2]), along)
        if p * p + q * q > max_slope * max_slope:
            p, q, c = found[k, 0], found[k, 1], found[k, 2]
        planes[k_family + k, 0], planes[k_family + k, 1], planes[k_family + k, 2] = p, q, c
    last = k_family + n_found
    planes[last, 0], planes[last, 1], planes[last, 2] = 0.0, 0.0, (xyz[(n - 1) // 2, 2] + xyz[n // 2, 2]) / 2
    nearest = np.empty(n, np.int64)
    for p in range(n):
        low = np.inf
        for k in range(last + 1):
            r = abs(xyz[p, 2] - planes[k, 0] * xyz[p, 0] - planes[k, 1] * xyz[p, 1] - planes[k, 2])
            if r < low:
                low, nearest[p] = r, k
    mine = np.empty((n, 3))
    for k in range(last):
        m = 0
        for p in range(n):
            if nearest[p] == k:
                mine[m, 0], mine[m, 1], mine[m, 2] = xyz[p, 0], xyz[p, 1], xyz[p, 2]
                m += 1
        if m >= 8:
            some = mine[:m]
            start = refit_plane(some, (planes[k, 0], planes[k, 1], planes[k, 2]), 2 * BAND)
            s, t, c = regularise(some, start, along)
            if s * s + t * t <= max_slope * max_slope:
                planes[k, 0], planes[k, 1], planes[k, 2] = s, t, c
    cost = np.empty((n, last + 1))
    for p in range(n):
        for k in range(last + 1):
            cost[p, k] = misfit(xyz[p, 2] - planes[k, 0] * xyz[p, 0] - planes[k, 1] * xyz[p, 1] - planes[k, 2])
    return planes, cost, along, k_family


def refit_roofs(roofs: Roofs, polygons: NDArray[np.object_], points: RoofPoints) -> Roofs:
    """Move the roof of each face to its points, and set its limits by them (step 2.3).

    Parameters
    ----------
    roofs : Roofs
        Roofs of the faces, from the parts that they were made of.
    polygons : object, (n,)
        The faces.
    points : RoofPoints
        Their roof points.

    Returns
    -------
    Roofs
        With the height moved by the median of the points over the plane, and limits of half a metre beyond the
        2nd and the 98th percentile of the points; unchanged with fewer than `MIN_REFIT` points.
    """
    if len(roofs) != len(polygons) or len(points.start) != len(polygons) + 1:
        raise ValueError(
            f"{len(roofs)} roofs, {len(polygons)} polygons and {len(points.start) - 1} sets of points"
        )
    start, count = points.start, np.diff(points.start)
    row = np.repeat(np.arange(len(polygons)), count)
    x, y = (points.xyz[:, :2] - roofs.origin[row]).T
    a, b, c = roofs.plane[row].T
    moved = count >= MIN_REFIT
    shift = _quantile(start, sort_values(start, points.xyz[:, 2] - a * x - b * y - c), 0.5, moved)
    plane, limits = roofs.plane.copy(), roofs.limits.copy()
    plane[moved, 2] += shift
    limits[moved, 0] = _quantile(start, points.z, LIMIT_SHARE, moved) - LIMIT_ROOM
    limits[moved, 1] = _quantile(start, points.z, 1 - LIMIT_SHARE, moved) + LIMIT_ROOM
    flat = (plane[:, :2] == 0).all(axis=1) & moved
    limits[flat] = plane[flat][:, [2, 2]]
    return Roofs(plane, roofs.origin, limits)


def _quantile(start: NDArray[np.int64], ascending: Array, share: float, wanted: NDArray[np.bool_]) -> Array:
    """Quantiles of the ascending values of the wanted groups, none of them empty; linear between values."""
    first, count = start[:-1][wanted], np.diff(start)[wanted]
    at = share * (count - 1)
    below = np.floor(at).astype(np.int64)
    low = ascending[first + below]
    high = ascending[first + np.minimum(below + 1, count - 1)]
    result: Array = low + (at - below) * (high - low)
    return result


def _check(polygons: NDArray[np.object_], points: RoofPoints, options: RoofOptions) -> None:
    if len(points.start) != len(polygons) + 1:
        raise ValueError(f"{len(polygons)} polygons do not match the points of {len(points.start) - 1}")
