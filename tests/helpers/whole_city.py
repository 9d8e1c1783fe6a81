"""The whole of a small city meshed in memory, as one tile without seams."""

from dataclasses import dataclass

from pipeline.city_model.city import Bounds, City
from pipeline.columns.adaptive import AdaptiveOptions, AdaptiveReport, mesh_adaptive
from pipeline.columns.layered import LayeredOptions, LayeredReport, mesh_layers
from pipeline.data.mesh import ColumnMesh
from pipeline.data.notes import Note
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm
from tiler.config.step_options import ADAPTIVE_ANGLE, ADAPTIVE_PASSES, ADAPTIVE_REFINEMENTS, PAPER_ANGLE


@dataclass(frozen=True, eq=False)
class TileMesh:
    """The columns of a tile and how they were made."""

    columns: ColumnMesh
    report: LayeredReport | AdaptiveReport
    notes: tuple[Note, ...]


def mesh_city(
    city: City, dtm: Dtm, bounds: Bounds, options: LayeredOptions | AdaptiveOptions, *, min_angle: float = 0.0
) -> TileMesh:
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
    columns: ColumnMesh
    report: LayeredReport | AdaptiveReport
    if isinstance(options, AdaptiveOptions):
        columns, report = mesh_adaptive(plane, dtm, city.model.roofs, city.model.ids, options)
    else:
        columns, report = mesh_layers(plane, dtm, city.model, city.wall_ground, bounds, options, group=city.group)
    notes = [] if complete else [Note("plane-refinement-stopped", detail="limit on added vertices reached")]
    return TileMesh(columns, report, tuple(notes))
