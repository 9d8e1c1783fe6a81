"""The steps composed: from points and footprints to the city model and the columns of one tile."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.building_points import (
    BuildingPoints,
    extract_building_points,
    has_building_class,
    merge_building_points,
)
from pipeline.citymodel import CityModel, Footprints, number_ids
from pipeline.footprints import clean_footprints
from pipeline.heights import (
    ROOF_SOURCES,
    Heights,
    compute_building_heights,
    highest_wall_ground,
    raise_low_roofs,
)
from pipeline.layered import LayeredOptions, LayeredReport, mesh_layers
from pipeline.merge import merge_footprints
from pipeline.mesh import ColumnMesh
from pipeline.notes import Note
from pipeline.plane import mesh_plane
from pipeline.pointcloud import PointCloud
from pipeline.terrain import Dtm

Bounds = tuple[float, float, float, float]
# Called with the name of a step around it: the caller's clock.
Trace = Callable[[str], AbstractContextManager[object]]


def no_trace(_: str) -> AbstractContextManager[object]:
    """Do nothing around a step."""
    return nullcontext()


@dataclass(frozen=True)
class CityOptions:
    """Parameters of steps 1.4 to 2.3; their meaning, units and defaults stand in the configuration."""

    min_building_area: float
    vertex_tolerance: float
    ground_margin: float
    ground_percentile: float
    roof_percentile: float
    default_height: float
    roof_clearance: float
    border: Literal["drop", "clip"]
    clearance: float
    clearance_floor: float
    min_courtyard_area: float


@dataclass(frozen=True, eq=False)
class City:
    """A city model with what is needed to go on from it.

    Attributes
    ----------
    model : CityModel
        The buildings.
    points : BuildingPoints
        Their roof and ground points.
    given_height : float64, (n,)
        Height above ground (m) from an attribute, NaN where none.
    roof_source : int8, (n,)
        Where the roof's height comes from: index into `heights.ROOF_SOURCES`.
    wall_ground : float64, (n,)
        Highest terrain at the walls (m).
    notes : tuple of Note
        What was dropped, repaired or defaulted on the way.
    counts : dict
        Numbers by name, for the report.
    """

    model: CityModel
    points: BuildingPoints
    given_height: NDArray[np.float64]
    roof_source: NDArray[np.int8]
    wall_ground: NDArray[np.float64]
    notes: tuple[Note, ...]
    counts: dict[str, int]


@dataclass(frozen=True, eq=False)
class TileMesh:
    """The columns of a tile and how they were made."""

    columns: ColumnMesh
    report: LayeredReport
    notes: tuple[Note, ...]


def build_city(
    cloud: PointCloud,
    footprints: Footprints,
    dtm: Dtm,
    bounds: Bounds,
    options: CityOptions,
    trace: Trace = no_trace,
) -> City:
    """Generate the city model (paper, steps 1.4 to 1.6).

    Parameters
    ----------
    cloud : PointCloud
        Points of the tile and its halo.
    footprints : Footprints
        As read.
    dtm : Dtm
        Terrain.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m); what to do with buildings on its border is an option.
    options : CityOptions
        Parameters.
    trace : callable, optional
        Context manager around each step.
    """
    with trace("1.4 clean footprints"):
        cleaned, notes = clean_footprints(
            footprints, min_area=options.min_building_area, tolerance=options.vertex_tolerance
        )
        inner, border_notes = _apply_border_rule(cleaned, bounds, options)
    with trace("1.5 extract building points"):
        points = extract_building_points(
            cloud, inner.polygons, margin=options.ground_margin, building_class=has_building_class(cloud)
        )
    with trace("1.6 building heights"):
        heights = _heights(points, inner.polygons, dtm, inner.given_height, options)
        members = tuple((str(name),) for name in inner.ids)
        notes_of_heights = _note_heights("footprint", inner, heights)
        wall_ground = highest_wall_ground(inner.polygons, dtm)
        city = _assemble(inner, points, heights, members, wall_ground)
    counts = {"footprints read": len(footprints.polygons), "footprints cleaned": len(cleaned.polygons)}
    return replace(city, notes=(*notes, *border_notes, *notes_of_heights), counts=counts)


def simplify_city(city: City, dtm: Dtm, options: CityOptions, trace: Trace = no_trace) -> City:
    """Simplify the city model by merging close buildings (paper, steps 2.1 to 2.3).

    Parameters
    ----------
    city : City
        Result of `build_city`.
    dtm : Dtm
        Terrain.
    options : CityOptions
        Parameters.
    trace : callable, optional
        Context manager around each step.

    Notes
    -----
    A merged building has the id of its largest member, ties to the smaller id; its points are those of
    all members, its given height the members' mean, weighted by area.
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
        heights = _heights(points, merged.polygons, dtm, footprints.given_height, options)
        members = tuple(
            tuple(sorted(name for row in group for name in model.members[row])) for group in merged.members
        )
        wall_ground = highest_wall_ground(merged.polygons, dtm)
        raised, raise_notes = _raise_roofs(footprints, heights, wall_ground, options)
        simplified = _assemble(footprints, points, raised, members, wall_ground)
    counts = {**city.counts, **{f"merge {how}": n for how, n in sorted(merged.counts.items())}}
    notes = (*city.notes, *_note_heights("building", footprints, heights), *raise_notes)
    return replace(simplified, notes=notes, counts=counts)


def mesh_city(
    city: City,
    dtm: Dtm,
    bounds: Bounds,
    options: LayeredOptions,
    *,
    min_angle: float,
    trace: Trace = no_trace,
) -> TileMesh:
    """Mesh the air over the terrain and between the buildings (paper, steps 3.1 to 3.5).

    Parameters
    ----------
    city : City
        Result of `simplify_city`.
    dtm : Dtm
        Terrain.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    options : LayeredOptions
        Parameters of the layered mesher.
    min_angle : float
        Bound on the angles of the plane mesh (degrees).
    trace : callable, optional
        Context manager around each step.
    """
    with trace("3.1 plane mesh"):
        plane, complete = mesh_plane(bounds, city.model.polygons, mesh_size=options.mesh_size, min_angle=min_angle)
    with trace("3.2-3.5 layers"):
        columns, report = mesh_layers(plane, dtm, city.model, city.wall_ground, bounds, options)
    notes = [] if complete else [Note("plane-refinement-stopped", detail="limit on added vertices reached")]
    return TileMesh(columns, report, tuple(notes))


def _apply_border_rule(
    footprints: Footprints, bounds: Bounds, options: CityOptions
) -> tuple[Footprints, tuple[Note, ...]]:
    """Keep footprints that lie inside by the clearance; drop or clip those on the border."""
    margin = options.clearance
    inner = shapely.box(bounds[0] + margin, bounds[1] + margin, bounds[2] - margin, bounds[3] - margin)
    shapely.prepare(inner)
    polygons, ids = footprints.polygons, footprints.ids
    inside = shapely.contains_properly(inner, polygons)
    touching = ~inside & shapely.intersects(shapely.box(*bounds), polygons)
    rule = "dropped" if options.border == "drop" else "clipped"
    notes = tuple(Note(f"footprint-on-border-{rule}", *place) for _, place in _places(footprints, touching))
    if options.border == "drop":
        return Footprints(polygons[inside], ids[inside], footprints.given_height[inside]), notes
    kept = inside | touching
    clipped = polygons[kept].copy()
    cut = touching[kept]
    clipped[cut] = shapely.intersection(clipped[cut], inner)
    cleaned, clip_notes = clean_footprints(
        Footprints(clipped, ids[kept], footprints.given_height[kept]),
        min_area=options.min_building_area,
        tolerance=options.vertex_tolerance,
    )
    return cleaned, (*notes, *clip_notes)


def _heights(
    points: BuildingPoints,
    polygons: NDArray[np.object_],
    dtm: Dtm,
    given_height: NDArray[np.float64],
    options: CityOptions,
) -> Heights:
    return compute_building_heights(
        points,
        polygons,
        dtm,
        ground_percentile=options.ground_percentile,
        roof_percentile=options.roof_percentile,
        given_height=given_height,
        default_height=options.default_height,
    )


def _raise_roofs(
    footprints: Footprints, heights: Heights, wall_ground: NDArray[np.float64], options: CityOptions
) -> tuple[Heights, list[Note]]:
    """Raise the roofs that terrain forces up, and tell."""
    roof, raised = raise_low_roofs(heights.roof, wall_ground, clearance=options.roof_clearance)
    notes = [
        Note("building-roof-raised", *place, f"{heights.roof[row]:.2f} m raised to {roof[row]:.2f} m over terrain")
        for row, place in _places(footprints, raised)
    ]
    return replace(heights, roof=roof), notes


def _assemble(
    footprints: Footprints,
    points: BuildingPoints,
    heights: Heights,
    members: tuple[tuple[str, ...], ...],
    wall_ground: NDArray[np.float64],
) -> City:
    """Make the city of all buildings that have a roof."""
    kept = np.flatnonzero(~np.isnan(heights.roof))
    ids = footprints.ids[kept]
    model = CityModel(
        footprints.polygons[kept],
        ids,
        number_ids(ids),
        heights.ground[kept],
        heights.roof[kept],
        tuple(members[row] for row in kept),
        ids,
    )
    return City(
        model,
        merge_building_points(points, tuple(np.array([row]) for row in kept)),
        footprints.given_height[kept],
        heights.roof_source[kept],
        wall_ground[kept],
        (),
        {},
    )


def _note_heights(what: str, footprints: Footprints, heights: Heights) -> list[Note]:
    """Tell of the heights that do not come from points; `what` is "footprint" or "building"."""
    notes = []
    for source, name in enumerate(ROOF_SOURCES[1:], start=1):
        kind = f"{what}-without-height-dropped" if name == "none" else f"{what}-roof-from-{name}"
        places = _places(footprints, heights.roof_source == source)
        notes += [Note(kind, *place, "no roof points") for _, place in places]
    places = _places(footprints, heights.ground_from_dtm)
    return notes + [Note(f"{what}-ground-from-dtm", *place, "no ground points") for _, place in places]


def _places(footprints: Footprints, chosen: NDArray[np.bool_]) -> list[tuple[int, tuple[str, float, float]]]:
    """Row, and id and place, of each chosen footprint."""
    rows = np.flatnonzero(chosen)
    xy = shapely.get_coordinates(shapely.point_on_surface(footprints.polygons[rows]))
    return [
        (int(row), (str(footprints.ids[row]), float(x), float(y))) for row, (x, y) in zip(rows, xy, strict=True)
    ]


def _leader(group: NDArray[np.int64], area: NDArray[np.float64], ids: NDArray[np.str_]) -> int:
    return int(min(group, key=lambda row: (-area[row], str(ids[row]))))


def _mean_height(given: NDArray[np.float64], area: NDArray[np.float64]) -> float:
    known = ~np.isnan(given)
    return float(np.average(given[known], weights=area[known])) if known.any() else float("nan")
