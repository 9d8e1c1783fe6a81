"""A town of terraces made in code: party walls, equal roofs, a courtyard, houses that touch in a corner."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.columns.columns import expand_cells
from pipeline.data.citymodel import CityModel
from pipeline.data.mesh import ColumnMesh, Marker
from pipeline.plane_mesh.plane import signed_areas
from pipeline.points_terrain.terrain import Dtm, sample_dtm
from stitch.pieces.conformity import compute_cell_volumes, match_facets, pair_cell_faces, pair_edges
from tests.helpers.cities import Bounds, city_of
from tests.helpers.whole_city import extract_boundary

# Boxes (west, south, east, north) and roofs (m). Walls are noded where another house's wall ends on them.
HOUSES = (
    ((30, 30, 37, 42), 12.0),
    ((37, 30, 43, 42), 17.5),
    ((43, 30, 50, 42), 12.0),
    ((50, 30, 58, 42), 12.0),  # the same roof as the house beside it: one group
    ((32, 42, 40, 50), 4.0),  # annex behind two houses
    ((58, 30, 66, 60), 9.0),
    ((50, 52, 58, 60), 15.0),
    ((40, 52, 50, 60), 22.0),  # these close a courtyard
    ((40, 42, 43, 52), 7.0),
    ((66, 60, 74, 68), 9.0),  # touches the tall wing in a corner, with the same roof
    ((74, 68, 80, 76), 30.0),  # touches it in a corner, with another roof
    ((20, 60, 34, 70), 6.0),  # stands alone
)
GROUPS = (0, 1, 2, 2, 3, 4, 5, 6, 7, 8, 9, 10)


@dataclass(frozen=True, eq=False)
class Town:
    """A city model, the groups of equal roofs, and the region (m)."""

    model: CityModel
    group: NDArray[np.int32]
    bounds: Bounds


def terrace_town(*, ground: float = 0.0, angle: float = 17.0) -> Town:
    """Build the town, turned by `angle` (degrees), roofs above `ground` (m)."""
    boxes = [shapely.box(*corners) for corners, _ in HOUSES]
    lines = shapely.union_all(shapely.boundary(np.array(boxes, object)))
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(lines)))
    places = shapely.point_on_surface(faces)
    noded = [faces[int(np.flatnonzero(shapely.contains(box, places))[0])] for box in boxes]
    turned = [affinity.rotate(face, angle, origin=(50, 50)) for face in noded]
    roofs = [ground + roof for _, roof in HOUSES]
    return Town(city_of(turned, roofs, ground=ground), np.array(GROUPS, np.int32), (0.0, 0.0, 100.0, 100.0))


def prove_conforming(mesh: ColumnMesh, numbers: NDArray[np.int64]) -> int:
    """Prove on explicit cells that the mesh conforms and its boundary is closed; count edges of four facets."""
    cells, boundary = expand_cells(mesh), extract_boundary(mesh, numbers)
    volume, flat = compute_cell_volumes(cells.points, cells.cells)
    assert volume.min() > 0
    assert not flat.any()
    faces = pair_cell_faces(cells.cells, len(cells.points))
    assert len(faces.same_side) == 0
    assert len(faces.shared) == 0
    matched = match_facets(faces.exterior, boundary.facets)
    faults = [len(rows) for rows in (matched.missing, matched.extra, matched.flipped, matched.duplicate)]
    assert faults == [0, 0, 0, 0]
    edges = pair_edges(boundary.facets)
    assert len(edges.open) == 0
    return len(edges.non_manifold)


def prove_volume(mesh: ColumnMesh, city: CityModel, dtm: Dtm) -> None:
    """Prove that the cells fill the box less ground and buildings, from the plane mesh alone."""
    cells = expand_cells(mesh)
    plane = mesh.plane
    area = np.abs(signed_areas(plane))
    top = mesh.z[mesh.z_start[1:] - 1][plane.triangles].mean(axis=1)
    ground = sample_dtm(dtm, plane.xy)[plane.triangles].mean(axis=1)
    floor = np.where(plane.building >= 0, np.append(city.roof, 0)[plane.building], ground)
    volume, _ = compute_cell_volumes(cells.points, cells.cells)
    np.testing.assert_allclose(volume.sum(), (area * (top - floor)).sum(), rtol=1e-12)


def prove_walls(mesh: ColumnMesh, town: Town, ground: float) -> None:
    """Prove on level ground that every house has the walls above its neighbours' roofs, and no other."""
    city = town.model
    cells, boundary = expand_cells(mesh), extract_boundary(mesh, city.numbers)
    corners = cells.points[boundary.facets]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    for row, number in enumerate(city.numbers):
        own = boundary.building == number
        wall, roof = own & (boundary.marker == Marker.WALL), own & (boundary.marker == Marker.ROOF)
        assert (corners[roof][..., 2] == city.roof[row]).all()
        np.testing.assert_allclose(area[roof].sum(), city.polygons[row].area, rtol=1e-9)
        outline = city.polygons[row].exterior
        distance = shapely.distance(shapely.points(corners[wall][..., :2].reshape(-1, 2)), outline)
        assert distance.max() < 1e-9
        wanted = outline.length * (city.roof[row] - ground)
        for other in np.flatnonzero(np.arange(len(city)) != row):
            shared = shapely.intersection(outline, city.polygons[other].exterior).length
            wanted -= shared * (min(city.roof[row], city.roof[other]) - ground)
        np.testing.assert_allclose(area[wall].sum(), wanted, rtol=1e-9)
