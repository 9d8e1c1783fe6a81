"""The whole of a small city meshed in memory, as one tile without seams."""

from pipeline.city_model.city import Bounds, City
from pipeline.columns.adaptive import AdaptiveOptions, mesh_adaptive
from pipeline.columns.layered import LayeredOptions, mesh_layers
from pipeline.data.mesh import ColumnMesh
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm
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
