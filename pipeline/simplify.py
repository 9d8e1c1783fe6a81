"""Step 2 composed: the city model simplified, the paper's way or as a planar city model."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.building_points import (
    extract_building_points,
    has_building_class,
    merge_building_points,
    take_building_points,
)
from pipeline.city import (
    City,
    CityOptions,
    Trace,
    assemble_city,
    find_places,
    measure_heights,
    no_trace,
    note_heights,
)
from pipeline.citymodel import Footprints
from pipeline.fidelity import Fidelity, measure_simplification
from pipeline.groups import adjacent_houses, group_roofs
from pipeline.heights import Heights, highest_wall_ground, raise_low_roofs
from pipeline.house_levels import HouseParts, LevelOptions, split_levels
from pipeline.merge import merge_footprints
from pipeline.notes import Note
from pipeline.planar import PlanarCity, simplify_planar
from pipeline.pointcloud import PointCloud
from pipeline.roof_points import locate_roof_points
from pipeline.terrain import Dtm

KEPT = 0.5  # a house that keeps less of its area than this is simplified again by its closed outline
COVERED = 0.5  # a house without a face is not lost if others cover this part of it
CHANGED = 0.3  # of a house's area: an outline that gained and lost more is told
SETTLE_ROUNDS = 20  # of grouping roofs and raising them over terrain, in turn


def simplify_city(city: City, cloud: PointCloud, dtm: Dtm, options: CityOptions, trace: Trace = no_trace) -> City:
    """Simplify the city model so that it can be meshed (steps 2.1 to 2.3).

    Parameters
    ----------
    city : City
        Result of `build_city`.
    cloud : PointCloud
        Points of the tile and its halo.
    dtm : Dtm
        Terrain.
    options : CityOptions
        Parameters; `simplify` chooses the way.
    trace : callable, optional
        Context manager around each step.
    """
    if options.simplify == "paper":
        return _merge_city(city, dtm, options, trace)
    return _planar_city(city, cloud, dtm, options, trace)


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


def _planar_city(city: City, cloud: PointCloud, dtm: Dtm, options: CityOptions, trace: Trace) -> City:
    """Simplify as one planar graph of walls; every house keeps its own faces, points and height."""
    model = city.model
    parts = HouseParts(model.polygons, np.arange(len(model)))
    points = city.points
    if options.split_levels and len(model):
        with trace("2.0 split levels"):
            parts = _split(model.polygons, cloud, options)
            points = extract_building_points(
                cloud,
                parts.polygons,
                margin=options.ground_margin,
                building_class=has_building_class(cloud),
            )
    with trace("2.1 planar city model"):
        planar, closed = _simplify_or_close(parts.polygons, options)
    with trace("2.3 building heights"):
        row = parts.house[planar.house]
        ids, house = _name_parts(model.ids, row)
        footprints = Footprints(planar.polygons, ids, city.given_height[row])
        face_points = take_building_points(points, planar.house)
        heights = measure_heights(face_points, planar.polygons, dtm, footprints.given_height, options)
        wall_ground = highest_wall_ground(planar.polygons, dtm)
        roof, group = settle_roofs(
            heights.roof,
            shapely.area(planar.polygons),
            wall_ground,
            adjacent_houses(planar.polygons),
            key=ids,
            threshold=options.roof_group,
            clearance=options.roof_clearance,
        )
        members = tuple(model.members[k] for k in row)
        settled = assemble_city(
            footprints, face_points, heights, members, wall_ground, roof=roof, house=house, group=group
        )
    with trace("2.3 outline errors"):
        outline = measure_simplification(model.polygons, replace(planar, house=row))
    raised = wall_ground + options.roof_clearance > heights.roof
    notes = (
        *city.notes,
        *note_heights("building", footprints, heights),
        *_note_raised(footprints, heights, roof, raised),
        *_note_outlines(city, planar, row, outline.house_error),
        *_note_closed(model.ids, model.polygons, parts.house[closed]),
    )
    counts = {**city.counts, **_count(planar, parts, settled)}
    return replace(settled, notes=notes, counts=counts, outline=_describe_outline(outline))


def _simplify_or_close(
    polygons: NDArray[np.object_], options: CityOptions
) -> tuple[PlanarCity, NDArray[np.int64]]:
    """Simplify; where a house loses most of itself, as a comb of thin walls does, take its closed outline.

    Returns the city and the rows of the polygons that were closed. Other clusters come out as before, to the bit.
    """

    def simplify(shapes: NDArray[np.object_]) -> PlanarCity:
        return simplify_planar(
            shapes,
            clearance=options.clearance,
            min_area=options.min_building_area,
            min_courtyard_area=options.min_courtyard_area,
            manifold=options.manifold,
        )

    planar = simplify(polygons)
    area = shapely.area(polygons)
    kept = shapely.area(shapely.intersection(planar.polygons, polygons[planar.house]))
    share = np.bincount(planar.house, kept, len(polygons)) / area
    poor = np.flatnonzero(share < KEPT)
    if len(poor) == 0:
        return planar, poor
    built = shapely.union_all(planar.polygons)
    poor = poor[shapely.area(shapely.intersection(polygons[poor], built)) < KEPT * area[poor]]
    outlines = close_outlines(polygons[poor], options.clearance)
    # A wall without width stays one: closing helps only where there is something between the walls.
    helps = shapely.area(outlines) > 1.2 * area[poor]
    if not helps.any():
        return planar, poor[:0]
    shapes = polygons.copy()
    shapes[poor[helps]] = outlines[helps]
    return simplify(shapes), poor[helps]


def close_outlines(polygons: NDArray[np.object_], clearance: float) -> NDArray[np.object_]:
    """Fill the gaps of each polygon that are narrower than twice the clearance.

    Examples
    --------
    >>> slot = shapely.box(0, 0, 10, 10) - shapely.box(4, 2, 5, 10)
    >>> shapely.area(close_outlines(np.array([slot], dtype=object), 1.0))
    array([100.])
    """
    grown = shapely.buffer(polygons, clearance, join_style="mitre")
    shrunk = shapely.buffer(grown, -clearance, join_style="mitre")
    closed = polygons.copy()
    for row, shape in enumerate(shrunk):
        parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon" and part.area > 0]
        if parts:
            closed[row] = shapely.normalize(max(parts, key=lambda part: float(part.area)))
    return closed


def _split(polygons: NDArray[np.object_], cloud: PointCloud, options: CityOptions) -> HouseParts:
    points = locate_roof_points(cloud, polygons, building_class=has_building_class(cloud))
    return split_levels(polygons, points, LevelOptions(clearance=options.clearance))


def _name_parts(ids: NDArray[np.str_], row: NDArray[np.int64]) -> tuple[NDArray[np.str_], NDArray[np.str_]]:
    """Ids of faces, and the houses that they belong to; a house of several has numbered parts."""
    house = ids[row]
    count = np.bincount(row, minlength=len(ids))
    seen = np.zeros(len(ids), np.int64)
    taken = set(ids.tolist())
    names = []
    for k, name in zip(row.tolist(), house.tolist(), strict=True):
        seen[k] += 1
        part = name if count[k] == 1 else f"{name}-part{seen[k]}"
        while count[k] > 1 and part in taken:
            part += "-"
        taken.add(part)
        names.append(part)
    return np.array(names, dtype=np.str_), house


def _note_outlines(
    city: City, planar: PlanarCity, row: NDArray[np.int64], error: NDArray[np.float64]
) -> list[Note]:
    """Tell of the houses that have no face any more, and of those whose outline changed much."""
    polygons, ids = city.model.polygons, city.model.ids
    area = shapely.area(polygons)
    gone = np.ones(len(ids), np.bool_)
    gone[row] = False
    footprints = Footprints(polygons, ids, area)
    built = shapely.STRtree(planar.polygons)
    notes = []
    for k, place in find_places(footprints, gone):
        over = planar.polygons[built.query(polygons[k], predicate="intersects")]
        covered = float(shapely.area(shapely.intersection(over, polygons[k])).sum())
        if covered >= COVERED * area[k]:
            notes.append(Note("building-covered-by-others", *place, f"{covered:.1f} of {area[k]:.1f} m2"))
        else:
            notes.append(Note("building-lost", *place, f"{area[k]:.1f} m², no room at this clearance"))
    changed = ~gone & (error > CHANGED * area)
    for k, place in find_places(footprints, changed):
        notes.append(Note("building-outline-changed", *place, f"by {error[k]:.1f} m2 of {area[k]:.1f} m2"))
    return notes


def _note_closed(ids: NDArray[np.str_], polygons: NDArray[np.object_], rows: NDArray[np.int64]) -> list[Note]:
    """Tell of the houses that were simplified by their closed outline."""
    chosen = np.zeros(len(ids), np.bool_)
    chosen[rows] = True
    places = find_places(Footprints(polygons, ids, np.zeros(len(ids))), chosen)
    return [
        Note("building-outline-closed", *place, "its walls are closer than the clearance") for _, place in places
    ]


def _note_raised(
    footprints: Footprints, heights: Heights, roof: NDArray[np.float64], raised: NDArray[np.bool_]
) -> list[Note]:
    """Tell of the roofs that terrain forced up."""
    return [
        Note("building-roof-raised", *place, f"{heights.roof[row]:.2f} m raised to {roof[row]:.2f} m over terrain")
        for row, place in find_places(footprints, raised)
    ]


def _count(planar: PlanarCity, parts: HouseParts, city: City) -> dict[str, int]:
    moved = np.abs(city.model.roof - city.measured_roof)
    return {f"planar {how}": n for how, n in planar.counts.items()} | {
        "houses split": int((np.bincount(parts.house) > 1).sum()) if len(parts.house) else 0,
        "roof groups": len(np.unique(city.group)),
        "roofs moved by more than 1 m": int((moved > 1).sum()),
    }


def _describe_outline(found: Fidelity) -> dict[str, float]:
    values = {"area_error": found.area_error, "min_clearance": found.min_clearance, "sharpest": found.sharpest}
    return {name: round(value, 6) for name, value in values.items() if np.isfinite(value)}


def _merge_city(city: City, dtm: Dtm, options: CityOptions, trace: Trace) -> City:
    """Merge close buildings (paper, Algorithms 1-3).

    A merged building has the id of its largest member, ties to the smaller id; its points are those of all
    members, its given height the members' mean, weighted by area.
    """
    model = city.model
    with trace("2.1 merge footprints"):
        merged = merge_footprints(
            model.polygons,
            clearance=options.clearance,
            min_hole_area=options.min_courtyard_area,
            floor=options.clearance_floor,
            tolerance=options.vertex_tolerance,
        )
    with trace("2.3 building heights"):
        area = shapely.area(model.polygons)
        leader = np.array([_leader(group, area, model.ids) for group in merged.members], np.int64)
        given = np.array([_mean_height(city.given_height[group], area[group]) for group in merged.members])
        footprints = Footprints(merged.polygons, model.ids[leader], given.reshape(-1))
        points = merge_building_points(city.points, merged.members)
        heights = measure_heights(points, merged.polygons, dtm, footprints.given_height, options)
        wall_ground = highest_wall_ground(merged.polygons, dtm)
        roof, raised = raise_low_roofs(heights.roof, wall_ground, clearance=options.roof_clearance)
        members = _join_members(model.members, merged.members)
        simplified = assemble_city(footprints, points, heights, members, wall_ground, roof=roof)
    counts = {**city.counts, **{f"merge {how}": n for how, n in sorted(merged.counts.items())}}
    notes = (
        *city.notes,
        *note_heights("building", footprints, heights),
        *_note_raised(footprints, heights, roof, raised),
    )
    return replace(simplified, notes=notes, counts=counts)


def _join_members(
    names: Sequence[tuple[str, ...]], groups: Sequence[NDArray[np.int64]]
) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(sorted(name for row in group for name in names[row])) for group in groups)


def _leader(group: NDArray[np.int64], area: NDArray[np.float64], ids: NDArray[np.str_]) -> int:
    return int(min(group, key=lambda row: (-area[row], str(ids[row]))))


def _mean_height(given: NDArray[np.float64], area: NDArray[np.float64]) -> float:
    known = ~np.isnan(given)
    return float(np.average(given[known], weights=area[known])) if known.any() else float("nan")
