"""The steps composed: from points and footprints to the city model, and to the columns of one tile."""

from dataclasses import dataclass, replace

import shapely

from pipeline.city_model.building_points import extract_building_points, has_building_class
from pipeline.city_model.city import (
    Bounds,
    City,
    CityOptions,
    Trace,
    assemble_city,
    find_places,
    measure_heights,
    no_trace,
    note_heights,
)
from pipeline.city_model.footprints import clean_footprints
from pipeline.city_model.heights import highest_wall_ground
from pipeline.columns.adaptive import AdaptiveOptions, AdaptiveReport, mesh_adaptive
from pipeline.columns.layered import LayeredOptions, LayeredReport, mesh_layers
from pipeline.data.citymodel import Footprints
from pipeline.data.mesh import ColumnMesh
from pipeline.data.notes import Note
from pipeline.data.pointcloud import PointCloud
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm
from pipeline.roofs.roof_points import RoofPoints

# Plane meshes: the paper's, and ours, which Triangle refines again and vertices are moved in.
PAPER_ANGLE = 25.0  # degrees
ADAPTIVE_ANGLE = 28.0  # degrees
ADAPTIVE_REFINEMENTS = 1
ADAPTIVE_PASSES = 4


@dataclass(frozen=True, eq=False)
class TileMesh:
    """The columns of a tile and how they were made."""

    columns: ColumnMesh
    report: LayeredReport | AdaptiveReport
    notes: tuple[Note, ...]


def build_city(
    cloud: PointCloud,
    footprints: Footprints,
    dtm: Dtm,
    bounds: Bounds,
    options: CityOptions,
    trace: Trace = no_trace,
) -> City:
    """Generate the city model (paper, steps 1.4 to 1.6), in memory.

    Parameters
    ----------
    cloud : PointCloud
        Points of the region.
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
        inner, notes = prepare_footprints(footprints, shapely.box(*bounds), options)
    city = measure_city(cloud, inner, dtm, options, building_class=has_building_class(cloud), trace=trace)
    counts = {"footprints read": len(footprints.polygons)}
    return replace(city, notes=(*notes, *city.notes), counts=counts)


def prepare_footprints(
    footprints: Footprints, region: shapely.Geometry, options: CityOptions
) -> tuple[Footprints, tuple[Note, ...]]:
    """Clean footprints, and drop or clip those on the region's border (step 1.4).

    Parameters
    ----------
    footprints : Footprints
        As read: all that meet some box, so that what becomes of each depends on those around it alone.
    region : shapely Polygon or MultiPolygon
        What is meshed (m), at least as far as the footprints reach.
    options : CityOptions
        Parameters.

    Returns
    -------
    Footprints
        Those that are inside by the clearance.
    tuple of Note
        What was dropped, repaired, split, filled, renamed or clipped.
    """
    cleaned, notes = clean_footprints(
        footprints, min_area=options.min_building_area, tolerance=options.vertex_tolerance
    )
    inner, border_notes = _apply_border_rule(cleaned, region, options)
    return inner, (*notes, *border_notes)


def measure_city(
    cloud: PointCloud,
    footprints: Footprints,
    dtm: Dtm,
    options: CityOptions,
    *,
    building_class: bool,
    roofs: RoofPoints | None = None,
    trace: Trace = no_trace,
) -> City:
    """Give footprints their points and heights (steps 1.5 and 1.6).

    Parameters
    ----------
    cloud : PointCloud
        Points of all footprints and `ground_margin` around them.
    footprints : Footprints
        Clean footprints.
    dtm : Dtm
        Terrain.
    options : CityOptions
        Parameters.
    building_class : bool
        Whether the cloud marks buildings.
    roofs : RoofPoints, optional
        Roof points of the footprints, where they are known.
    trace : callable, optional
        Context manager around each step.
    """
    with trace("1.5 extract building points"):
        points = extract_building_points(
            cloud,
            footprints.polygons,
            margin=options.ground_margin,
            building_class=building_class,
            roof=None if roofs is None else (roofs.start, roofs.z),
        )
    with trace("1.6 building heights"):
        heights = measure_heights(points, footprints.polygons, dtm, footprints.given_height, options)
        members = tuple((str(name),) for name in footprints.ids)
        wall_ground = highest_wall_ground(footprints.polygons, dtm)
        city = assemble_city(footprints, points, heights, members, wall_ground)
    return replace(city, notes=tuple(note_heights("footprint", footprints, heights)))


def mesh_city(
    city: City,
    dtm: Dtm,
    bounds: Bounds,
    options: LayeredOptions | AdaptiveOptions,
    *,
    min_angle: float = 0.0,
    trace: Trace = no_trace,
) -> TileMesh:
    """Mesh the air over the terrain and between the buildings (paper, steps 3.1 to 3.5, or our columns).

    Parameters
    ----------
    city : City
        Result of `simplify_city`.
    dtm : Dtm
        Terrain.
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    options : LayeredOptions or AdaptiveOptions
        Parameters of the mesher, which choose it.
    min_angle : float
        Bound on the angles of the plane mesh (degrees); 0 takes the mesher's own.
    trace : callable, optional
        Context manager around each step.
    """
    adaptive = isinstance(options, AdaptiveOptions)
    with trace("3.1 plane mesh"):
        plane, complete = mesh_plane(
            bounds,
            city.model.polygons,
            mesh_size=options.mesh_size,
            min_angle=min_angle or (ADAPTIVE_ANGLE if adaptive else PAPER_ANGLE),
            refinements=ADAPTIVE_REFINEMENTS if adaptive else 0,
            passes=ADAPTIVE_PASSES if adaptive else 0,
        )
    columns: ColumnMesh
    report: LayeredReport | AdaptiveReport
    with trace("3.2-3.5 columns"):
        if isinstance(options, AdaptiveOptions):
            columns, report = mesh_adaptive(plane, dtm, city.model.roofs, city.model.ids, options)
        else:
            columns, report = mesh_layers(
                plane, dtm, city.model, city.wall_ground, bounds, options, group=city.group
            )
    notes = [] if complete else [Note("plane-refinement-stopped", detail="limit on added vertices reached")]
    return TileMesh(columns, report, tuple(notes))


def _apply_border_rule(
    footprints: Footprints, region: shapely.Geometry, options: CityOptions
) -> tuple[Footprints, tuple[Note, ...]]:
    """Keep footprints that lie inside by the clearance; drop or clip those on the border."""
    inner = shapely.buffer(region, -options.clearance, join_style="mitre")
    shapely.prepare([inner, region])
    polygons, ids = footprints.polygons, footprints.ids
    inside = shapely.contains_properly(inner, polygons)
    touching = ~inside & shapely.intersects(region, polygons)
    rule = "dropped" if options.border == "drop" else "clipped"
    notes = tuple(Note(f"footprint-on-border-{rule}", *place) for _, place in find_places(footprints, touching))
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
