"""A small city in memory, as one tile without seams: simplified as tiles do together, and meshed."""

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.city_model.building_points import has_building_class
from pipeline.city_model.city import Bounds, City, CityOptions
from pipeline.city_model.houses import divide_houses, find_model_roofs
from pipeline.columns.adaptive import AdaptiveOptions, mesh_adaptive
from pipeline.columns.columns import split_boundary
from pipeline.columns.layered import LayeredOptions, mesh_layers
from pipeline.data.mesh import Boundary, ColumnMesh, SeamEdges
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roofs import Roofs
from pipeline.geometry.components import join_pairs
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm
from pipeline.roofs.house_levels import HouseParts
from pipeline.roofs.roof_points import locate_roof_points
from pipeline.simplification.house_clusters import Shapes, find_close, join_shapes, leave_out, shape_clusters
from pipeline.simplification.simplify import raise_buildings
from tiler.config.step_options import ADAPTIVE_ANGLE, ADAPTIVE_PASSES, ADAPTIVE_REFINEMENTS, PAPER_ANGLE


def mesh_city(
    city: City, dtm: Dtm, bounds: Bounds, options: LayeredOptions | AdaptiveOptions, *, min_angle: float = 0.0
) -> ColumnMesh:
    """Mesh a city; the bound on the angles of the plane mesh is in degrees, 0 takes the mesher's own."""
    adaptive = isinstance(options, AdaptiveOptions)
    plane, complete = mesh_plane(
        bounds,
        city.model.polygons,
        mesh_size=options.mesh_size,
        min_angle=min_angle or (ADAPTIVE_ANGLE if adaptive else PAPER_ANGLE),
        refinements=ADAPTIVE_REFINEMENTS if adaptive else 0,
        passes=ADAPTIVE_PASSES if adaptive else 0,
    )
    assert complete
    if isinstance(options, AdaptiveOptions):
        return mesh_adaptive(plane, dtm, city.model.roofs, city.model.ids, options)[0]
    return mesh_layers(plane, dtm, city.model, city.wall_ground, bounds, options, group=city.group)[0]


def simplify_city(city: City, cloud: PointCloud, dtm: Dtm, options: CityOptions) -> City:
    """Give the simplified model (steps 2.0 to 2.3) of a city that `build_city` made."""
    houses = divide_houses(city, cloud, options)
    shapes = simplify_houses(houses.parts, houses.polygons, options, find_model_roofs(houses))
    located = locate_roof_points(cloud, shapes.polygons, building_class=has_building_class(cloud))
    reserved = set(city.model.ids.tolist())
    simple = raise_buildings(houses, shapes, dtm, options, reserved=reserved, roof_points=located)
    notes, counts = (*city.notes, *houses.notes, *simple.notes), {**city.counts, **simple.counts}
    return replace(simple, notes=notes, counts=counts)


def simplify_houses(
    parts: HouseParts, outlines: NDArray[np.object_], options: CityOptions, roofs: Roofs | None = None
) -> Shapes:
    """Simplify all houses, by their outlines (m), in rounds."""
    cluster = join_pairs(len(outlines), find_close(outlines, options.clearance))
    shapes, todo, counts = join_shapes([]), cluster, Counter[str]()
    while True:
        piece = shape_clusters(parts, todo, options, roofs)
        counts.update(piece.counts)
        shapes = join_shapes([shapes, piece])
        close = shapes.cluster[find_close(shapes.polygons, options.clearance)]
        joined = join_pairs(len(cluster), close[close[:, 0] != close[:, 1]])[cluster]
        touched = np.isin(joined, joined[joined != cluster])
        counts["clusters joined"] += len(np.unique(cluster)) - len(np.unique(joined))
        if not touched.any():
            return replace(shapes, counts=dict(counts))
        shapes = leave_out(shapes, np.unique(cluster[touched]))
        cluster, todo = joined, np.where(touched, joined, -1)


def extract_boundary(mesh: ColumnMesh, numbers: NDArray[np.int64]) -> Boundary:
    """Extract the boundary of a mesh without seams; `numbers` are those of its buildings."""
    low, high = mesh.plane.xy.min(axis=0), mesh.plane.xy.max(axis=0)
    pairs = np.empty((0, 2), np.int32)
    seams = SeamEdges(pairs, pairs, np.empty(0, np.int64), np.empty(0, np.bool_))
    return split_boundary(mesh, numbers, (*low, *high), seams, strict=False)[0]
