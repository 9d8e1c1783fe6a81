"""Step 2 composed: the city model simplified, the paper's way or as a planar city model."""

from collections.abc import Set
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import merge_building_points, take_building_points
from pipeline.city_model.city import (
    City,
    CityOptions,
    Trace,
    assemble_city,
    find_places,
    measure_heights,
    no_trace,
    note_heights,
)
from pipeline.city_model.groups import adjacent_houses, group_roofs
from pipeline.city_model.heights import Heights, highest_wall_ground, raise_low_roofs
from pipeline.city_model.houses import Houses, find_fallbacks, name_parts
from pipeline.city_model.model_roofs import MODEL
from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roofs import Roofs, choose_roofs, flat_roofs, highest_roofs, is_flat, take_roofs
from pipeline.points_terrain.terrain import Dtm
from pipeline.roofs.house_roofs import RoofOptions
from pipeline.roofs.refit import refit_roofs
from pipeline.roofs.roof_points import RoofPoints
from pipeline.simplification.fidelity import Fidelity, measure_simplification
from pipeline.simplification.house_clusters import Shapes
from pipeline.simplification.roof_crossings import add_crossings

COVERED = 0.5  # a house without a face is not lost if others cover this part of it
CHANGED = 0.3  # of a house's area: an outline that gained and lost more is told
SETTLE_ROUNDS = 20  # of grouping roofs and raising them over terrain, in turn


def raise_buildings(
    houses: Houses,
    shapes: Shapes,
    dtm: Dtm,
    options: CityOptions,
    *,
    reserved: Set[str],
    roof_points: RoofPoints | None = None,
    trace: Trace = no_trace,
) -> City:
    """Give the buildings of whole clusters their ids and heights (step 2.3).

    Parameters
    ----------
    houses : Houses
        The houses of these clusters.
    shapes : Shapes
        The clusters simplified; members are rows of the houses' parts.
    reserved : set of str
        Ids that no part of a house may get: at least those of all houses that look like one of a part.
    roof_points : RoofPoints, optional
        Roof points of the simplified buildings, to which sloped roofs are fitted once more.
    trace : callable, optional
        Context manager around each step.

    Notes
    -----
    What comes out of a cluster depends on its houses and the terrain at their walls alone.
    """
    with trace("2.3 building heights"):
        if options.simplify == "paper":
            return _raise_merged(houses, shapes, dtm, options)
        return _raise_planar(houses, shapes, dtm, options, reserved, roof_points)


def settle_roofs(
    roof: NDArray[np.float64],
    area: NDArray[np.float64],
    wall_ground: NDArray[np.float64],
    pairs: NDArray[np.int64],
    *,
    key: NDArray[np.str_],
    threshold: float,
    clearance: float,
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Group neighbours of nearly equal height under one roof, all of them clear of the terrain.

    Parameters
    ----------
    roof, area, wall_ground : float64, (b,)
        Roof heights (m), areas (m²), highest terrain at the walls (m).
    pairs : int64, (p, 2)
        Adjacent houses.
    key : str, (b,)
        Unique ids.
    threshold : float
        Least difference of roofs that meet (m).
    clearance : float
        Least height of a roof above the highest terrain at the walls of its group (m).

    Returns
    -------
    roof : float64, (b,)
        Heights (m), the same bits in a group.
    group : int32, (b,)
        Group of each house.

    Notes
    -----
    Raising a group may bring it close to a neighbour, and grouping may lower a house: both are done in turn,
    a group never coming apart again, until nothing changes. That ends, as each round joins groups; after the
    last one allowed every roof is raised, whatever its neighbours.
    """
    floor = wall_ground + clearance
    roof = np.maximum(roof, floor)
    for _ in range(SETTLE_ROUNDS):
        roof, group = group_roofs(roof, area, pairs, key=key, threshold=threshold)
        highest = np.full(len(roof), -np.inf)
        np.maximum.at(highest, group, floor)
        needed = highest[group]
        if (roof >= needed).all():
            break
        roof = np.maximum(roof, needed)
    return roof, group


@dataclass(frozen=True, eq=False)
class _Raised:
    """Roofs of buildings, clear of the terrain.

    ``measured`` is the highest place of each (m) before it was moved, `least` that which `raised` ones got.
    """

    polygons: NDArray[np.object_]
    roofs: Roofs
    group: NDArray[np.int32] | None
    measured: NDArray[np.float64]
    least: NDArray[np.float64]
    raised: NDArray[np.bool_]
    counts: dict[str, int]


def _raise_planar(
    houses: Houses,
    shapes: Shapes,
    dtm: Dtm,
    options: CityOptions,
    reserved: Set[str],
    roof_points: RoofPoints | None,
) -> City:
    """Every house keeps its own faces and points, and its roofs: planes, or one height for each part."""
    row = houses.parts.house[shapes.member]
    ids = name_parts(houses.ids, row, reserved)
    points = take_building_points(houses.points, shapes.member)
    heights = measure_heights(points, shapes.polygons, dtm, houses.given_height[row], options)
    wall_ground = highest_wall_ground(shapes.polygons, dtm)
    if options.roofs == "flat":
        made = _settle_flat(shapes, heights, wall_ground, ids, options)
    else:
        made = _fit_sloped(
            take_roofs(houses.roofs, shapes.member),
            (houses.form[row] >= 0) | (houses.method[row] == MODEL),
            shapes,
            heights,
            wall_ground,
            roof_points,
            options,
        )
    footprints = Footprints(made.polygons, ids, houses.given_height[row])
    members = tuple((str(houses.ids[k]),) for k in row)
    heights = replace(heights, roof=np.where(np.isnan(heights.roof), np.nan, made.measured))
    city = assemble_city(
        footprints,
        points,
        heights,
        members,
        wall_ground,
        roofs=made.roofs,
        house=houses.ids[row],
        group=made.group,
    )
    outline = measure_simplification(houses.polygons, shapes.polygons, row)
    notes = (
        *note_heights("building", footprints, heights),
        *_note_raised(footprints, heights, made.least, made.raised),
        *_note_outlines(houses, shapes.polygons, row, outline.house_error),
        *_note_closed(houses, houses.parts.house[shapes.closed[:, 0]]),
        *_note_finer(houses, shapes, options.clearance),
    )
    divided = int((np.bincount(houses.parts.house, minlength=1) > 1).sum())
    counts = {**shapes.counts, "houses split": divided, **made.counts}
    city = replace(city, notes=notes, counts=counts, outline=_describe_outline(outline, houses))
    if options.roofs == "flat":
        return city
    return replace(
        city,
        roof_method=houses.method[row][city.row],
        roof_fallback=find_fallbacks(houses)[row][city.row],
        roof_form=houses.form[row][city.row],
    )


def _settle_flat(
    shapes: Shapes, heights: Heights, wall_ground: NDArray[np.float64], ids: NDArray[np.str_], options: CityOptions
) -> _Raised:
    """Neighbours of nearly equal height get one roof."""
    roof, group = _settle_clusters(shapes, heights, wall_ground, ids, options)
    raised = wall_ground + options.roof_clearance > heights.roof
    counts = {
        "roof groups": len(np.unique(group[~np.isnan(heights.roof)])),
        "roofs moved by more than 1 m": int((np.abs(roof - heights.roof) > 1).sum()),
    }
    return _Raised(shapes.polygons, flat_roofs(roof), group, heights.roof, roof, raised, counts)


def _fit_sloped(
    roofs: Roofs,
    formed: NDArray[np.bool_],
    shapes: Shapes,
    heights: Heights,
    wall_ground: NDArray[np.float64],
    roof_points: RoofPoints | None,
    options: CityOptions,
) -> _Raised:
    """Every part keeps its plane, fitted to the points of its face; where it has none, one height.

    Roofs of a given form and those of a city model (`formed`) stay as they are, as a whole.
    """
    if roof_points is not None:
        fitted = refit_roofs(roofs, shapes.polygons, roof_points, max_slope=RoofOptions.max_slope)
        roofs = choose_roofs(formed, roofs, fitted)
    roofs = choose_roofs(np.isnan(roofs.plane[:, 2]), flat_roofs(heights.roof), roofs)
    measured = highest_roofs(roofs, shapes.polygons)
    least = wall_ground + options.roof_clearance
    low = is_flat(roofs) & (roofs.plane[:, 2] < least)
    roofs = choose_roofs(low, flat_roofs(least), roofs)
    polygons, n_nodes, n_short = add_crossings(shapes.polygons, roofs, clearance=shapes.clearance)
    counts = {
        "sloped parts": int((~is_flat(roofs)).sum()),
        "nodes where roofs cross": n_nodes,
        "walls without room for one": n_short,
    }
    return _Raised(polygons, roofs, None, measured, least, low, counts)


def _settle_clusters(
    shapes: Shapes, heights: Heights, wall_ground: NDArray[np.float64], ids: NDArray[np.str_], options: CityOptions
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Settle the roofs of each cluster by themselves; groups are numbered through."""
    area = shapely.area(shapes.polygons)
    roof = np.maximum(heights.roof, wall_ground + options.roof_clearance)  # of a building that is alone
    group = np.zeros(len(ids), np.int32)
    order = np.argsort(shapes.cluster, kind="stable")
    cluster, start, count = np.unique(shapes.cluster[order], return_index=True, return_counts=True)
    pairs = adjacent_houses(shapes.polygons)
    pairs = pairs[np.argsort(shapes.cluster[pairs[:, 0]], kind="stable")]
    pair_start = np.searchsorted(shapes.cluster[pairs[:, 0]], [cluster, cluster + 1])
    number, n_groups = np.empty(len(order), np.int64), np.ones(len(cluster), np.int32)
    for k in np.flatnonzero(count > 1):
        rows = order[start[k] : start[k] + count[k]]
        number[rows] = np.arange(len(rows))
        roof[rows], group[rows] = settle_roofs(
            heights.roof[rows],
            area[rows],
            wall_ground[rows],
            number[pairs[slice(*pair_start[:, k])]],
            key=ids[rows],
            threshold=options.roof_group,
            clearance=options.roof_clearance,
        )
        n_groups[k] = group[rows].max() + 1
    group[order] += np.repeat(np.cumsum(n_groups) - n_groups, count).astype(np.int32)
    return roof, group


def _note_outlines(
    houses: Houses, built: NDArray[np.object_], row: NDArray[np.int64], error: NDArray[np.float64]
) -> list[Note]:
    """Tell of the houses that have no face any more, and of those whose outline changed much."""
    polygons = houses.polygons
    area = shapely.area(polygons)
    gone = np.ones(len(houses), np.bool_)
    gone[row] = False
    footprints = Footprints(polygons, houses.ids, area)
    tree = shapely.STRtree(built)
    notes = []
    for k, place in find_places(footprints, gone):
        over = built[tree.query(polygons[k], predicate="intersects")]
        covered = float(shapely.area(shapely.intersection(over, polygons[k])).sum())
        if covered >= COVERED * area[k]:
            notes.append(Note("building-covered-by-others", *place, f"{covered:.1f} of {area[k]:.1f} m2"))
        else:
            notes.append(Note("building-lost", *place, f"{area[k]:.1f} m², no room at this clearance"))
    changed = ~gone & (error > CHANGED * area)
    for k, place in find_places(footprints, changed):
        notes.append(Note("building-outline-changed", *place, f"by {error[k]:.1f} m2 of {area[k]:.1f} m2"))
    return notes


def _note_closed(houses: Houses, rows: NDArray[np.int64]) -> list[Note]:
    """Tell of the houses that were simplified by their closed outline."""
    chosen = np.zeros(len(houses), np.bool_)
    chosen[rows] = True
    places = find_places(Footprints(houses.polygons, houses.ids, houses.given_height), chosen)
    return [
        Note("building-outline-closed", *place, "its walls are closer than the clearance") for _, place in places
    ]


def _note_finer(houses: Houses, shapes: Shapes, clearance: float) -> list[Note]:
    """Tell of the houses whose walls keep less than the clearance."""
    least = np.full(len(houses), clearance)
    np.minimum.at(
        least, houses.parts.house[shapes.member], np.repeat(shapes.clearance, np.diff(shapes.member_start))
    )
    places = find_places(Footprints(houses.polygons, houses.ids, houses.given_height), least < clearance)
    return [Note("building-finer-walls", *place, f"{least[k]:g} m, not {clearance:g} m") for k, place in places]


def _note_raised(
    footprints: Footprints, heights: Heights, roof: NDArray[np.float64], raised: NDArray[np.bool_]
) -> list[Note]:
    """Tell of the roofs that terrain forced up."""
    return [
        Note("building-roof-raised", *place, f"{heights.roof[row]:.2f} m raised to {roof[row]:.2f} m over terrain")
        for row, place in find_places(footprints, raised)
    ]


def _describe_outline(found: Fidelity, houses: Houses) -> dict[str, float]:
    """Area errors with their sums, so that those of several tiles can be joined."""
    values = {
        "area_error": found.area_error,
        "min_clearance": found.min_clearance,
        "sharpest": found.sharpest,
        "area": float(shapely.area(houses.polygons).sum()),
        "changed_area": float(found.house_error.sum()),
    }
    return {name: round(value, 6) for name, value in values.items() if np.isfinite(value)}


def _raise_merged(houses: Houses, shapes: Shapes, dtm: Dtm, options: CityOptions) -> City:
    """Heights of merged buildings (paper, step 2.3).

    A merged building has the id of its largest member, ties to the smaller id; its points are those of all
    members, its given height the members' mean, weighted by area.
    """
    members = tuple(np.split(shapes.member, shapes.member_start[1:-1])) if len(shapes) else ()
    area = shapely.area(houses.polygons)
    leader = np.array([_leader(group, area, houses.ids) for group in members], np.int64)
    given = np.array([_mean_height(houses.given_height[group], area[group]) for group in members])
    footprints = Footprints(shapes.polygons, houses.ids[leader], given.reshape(-1))
    points = merge_building_points(houses.points, members)
    heights = measure_heights(points, shapes.polygons, dtm, footprints.given_height, options)
    wall_ground = highest_wall_ground(shapes.polygons, dtm)
    roof, raised = raise_low_roofs(heights.roof, wall_ground, clearance=options.roof_clearance)
    names = tuple(tuple(sorted(houses.ids[group].tolist())) for group in members)
    city = assemble_city(footprints, points, heights, names, wall_ground, roofs=flat_roofs(roof))
    notes = (*note_heights("building", footprints, heights), *_note_raised(footprints, heights, roof, raised))
    return replace(city, notes=notes, counts=shapes.counts)


def _leader(group: NDArray[np.int64], area: NDArray[np.float64], ids: NDArray[np.str_]) -> int:
    return int(min(group, key=lambda row: (-area[row], str(ids[row]))))


def _mean_height(given: NDArray[np.float64], area: NDArray[np.float64]) -> float:
    known = ~np.isnan(given)
    return float(np.average(given[known], weights=area[known])) if known.any() else float("nan")
