"""Steps 1.4 to 1.6 composed: from points and footprints to the city model with its heights."""

from dataclasses import replace

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
from pipeline.data.citymodel import Footprints, take_footprints
from pipeline.data.notes import Note
from pipeline.data.pointcloud import PointCloud
from pipeline.points_terrain.terrain import Dtm
from pipeline.roofs.roof_points import RoofPoints


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


def _apply_border_rule(
    footprints: Footprints, region: shapely.Geometry, options: CityOptions
) -> tuple[Footprints, tuple[Note, ...]]:
    """Keep footprints that lie inside by the clearance; drop or clip those on the border."""
    inner = shapely.buffer(region, -options.clearance, join_style="mitre")
    shapely.prepare([inner, region])
    polygons = footprints.polygons
    inside = shapely.contains_properly(inner, polygons)
    touching = ~inside & shapely.intersects(region, polygons)
    rule = "dropped" if options.border == "drop" else "clipped"
    notes = tuple(Note(f"footprint-on-border-{rule}", *place) for _, place in find_places(footprints, touching))
    if options.border == "drop":
        return take_footprints(footprints, inside), notes
    kept = inside | touching
    clipped = polygons[kept].copy()
    cut = touching[kept]
    clipped[cut] = shapely.intersection(clipped[cut], inner)
    cleaned, clip_notes = clean_footprints(
        replace(take_footprints(footprints, kept), polygons=clipped),
        min_area=options.min_building_area,
        tolerance=options.vertex_tolerance,
    )
    return cleaned, (*notes, *clip_notes)
