"""Step 3.1: the plane mesh respects walls, areas, angles and labels."""

import numpy as np
import pytest
import shapely
from shapely import affinity

from pipeline.data.errors import GeometryError
from pipeline.data.mesh import PlaneMesh
from pipeline.plane_mesh import plane as plane_room
from pipeline.plane_mesh.plane import collect_graph, mesh_plane, plane_graph, signed_areas, triangulate_plane
from tests.helpers.cities import city_of, crowded_blocks, random_blocks

BOUNDS = (318000.0, 6399000.0, 318200.0, 6399150.0)


def shapes(*polygons: shapely.Polygon) -> np.ndarray[tuple[int], np.dtype[np.object_]]:
    return city_of(list(polygons), [1.0] * len(polygons)).polygons


def smallest_angle(plane: PlaneMesh) -> float:
    corners = plane.xy[plane.triangles]
    angles = []
    for k in range(3):
        u = corners[:, (k + 1) % 3] - corners[:, k]
        v = corners[:, (k + 2) % 3] - corners[:, k]
        cosine = (u * v).sum(axis=1) / np.linalg.norm(u, axis=1) / np.linalg.norm(v, axis=1)
        angles.append(np.degrees(np.arccos(cosine)).min())
    return float(min(angles))


def test_graph_has_each_vertex_and_wall_once() -> None:
    house = shapely.Polygon(shapely.box(10, 10, 30, 30).exterior, [shapely.box(15, 15, 20, 20).exterior])
    neighbour = shapely.box(30, 10, 40, 30)
    graph = plane_graph((0.0, 0.0, 100.0, 100.0), shapes(house, neighbour))
    assert len(graph.xy) == 4 + 8 + 2
    # The party wall between (30, 10) and (30, 30) is one segment.
    assert len(graph.segments) == 4 + 8 + 3
    length = np.linalg.norm(np.diff(graph.xy[graph.segments], axis=1)[:, 0], axis=1).sum()
    assert length == 400 + 80 + 20 + 40


def test_empty_ground_is_meshed_in_order_with_bounded_areas_and_angles() -> None:
    plane, complete = mesh_plane(BOUNDS, shapes(), mesh_size=10.0)
    assert complete
    assert (plane.building == -1).all()
    area = np.abs(signed_areas(plane))
    assert area.max() <= 50.0
    assert area.sum() == pytest.approx(200 * 150, rel=1e-12)
    assert smallest_angle(plane) >= 25.0
    assert np.array_equal(np.lexsort((plane.xy[:, 1], plane.xy[:, 0])), np.arange(len(plane.xy)))
    assert (np.diff(plane.triangles, axis=1) > 0).all()


def test_walls_are_edges_and_buildings_are_labelled() -> None:
    blocks = random_blocks(BOUNDS, 12, seed=4)
    plane, _ = mesh_plane(BOUNDS, shapes(*blocks), mesh_size=10.0)
    area = np.abs(signed_areas(plane))
    for row, block in enumerate(blocks):
        assert area[plane.building == row].sum() == pytest.approx(block.area, rel=1e-9)
        union = shapely.union_all(shapely.polygons(plane.xy[plane.triangles[plane.building == row]]))
        assert union.symmetric_difference(block).area < 1e-6


def test_a_second_run_leaves_no_angle_below_the_bound() -> None:
    bounds = (0.0, 0.0, 500.0, 500.0)
    blocks = shapes(*crowded_blocks(bounds, 125, seed=4))
    once, _ = mesh_plane(bounds, blocks, mesh_size=10.0, min_angle=28)
    twice, _ = mesh_plane(bounds, blocks, mesh_size=10.0, min_angle=28, refinements=1)
    assert smallest_angle(once) < 27.5
    assert smallest_angle(twice) > 28 - 1e-9
    for row, block in enumerate(blocks):
        area = np.abs(signed_areas(twice))[twice.building == row].sum()
        assert area == pytest.approx(block.area, rel=1e-9)


def test_input_vertices_are_kept_bit_for_bit() -> None:
    block = affinity.rotate(shapely.box(318050, 6399050, 318073.3, 6399081.7), 17.3)
    plane, _ = mesh_plane(BOUNDS, shapes(block), mesh_size=10.0)
    found = {row.tobytes() for row in plane.xy}
    assert {np.array(xy).tobytes() for xy in block.exterior.coords} <= found


def test_courtyard_is_open_ground_and_a_house_in_it_is_its_own() -> None:
    ring = shapely.Polygon(
        shapely.box(318020, 6399020, 318120, 6399120).exterior,
        [shapely.box(318040, 6399040, 318100, 6399100).exterior],
    )
    inner = shapely.box(318060, 6399060, 318080, 6399080)
    plane, _ = mesh_plane(BOUNDS, shapes(ring, inner), mesh_size=10.0)
    area = np.abs(signed_areas(plane))
    assert area[plane.building == 0].sum() == pytest.approx(100**2 - 60**2)
    assert area[plane.building == 1].sum() == pytest.approx(400)


def test_same_input_same_bytes() -> None:
    blocks = shapes(*random_blocks(BOUNDS, 8, seed=1))
    one, two = (mesh_plane(BOUNDS, blocks, mesh_size=7.0)[0] for _ in range(2))
    assert one.xy.tobytes() == two.xy.tobytes()
    assert one.triangles.tobytes() == two.triangles.tobytes()


def test_refinement_stops_at_the_limit_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plane_room, "STEINER_FACTOR", 0)
    _, complete = mesh_plane(BOUNDS, shapes(), mesh_size=10.0)
    assert not complete


def test_crossing_buildings_are_refused_with_their_place() -> None:
    one, two = shapely.box(318050, 6399050, 318080, 6399080), shapely.box(318070, 6399070, 318100, 6399100)
    with pytest.raises(GeometryError, match=r"building at \(3180.*--clearance"):
        mesh_plane(BOUNDS, shapes(one, two), mesh_size=10.0)


def test_what_triangle_cannot_take_is_one_error() -> None:
    graph = plane_room.PlaneGraph(np.zeros((1, 2)), np.zeros((0, 2), np.int32), np.zeros((0, 2)))
    with pytest.raises(GeometryError, match=r"step 3\.1: the 2D mesher failed"):
        triangulate_plane(graph, max_area=1.0)


def test_a_graph_across_zero_returns_bit_for_bit_and_a_frozen_border_is_not_split() -> None:
    ring = np.array([(-1000.3, -0.7), (77.123456789, -0.1), (77.3, 40.000000001), (-1000.1, 40.3)])
    graph = collect_graph(np.stack((ring, np.roll(ring, -1, axis=0)), axis=1), np.empty((0, 2)))
    xy, triangles, label, complete = triangulate_plane(graph, max_area=50.0, frozen=True)
    assert complete
    assert xy[:4].tobytes() == graph.xy.tobytes()
    assert (label == -1).all()
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert np.array_equal(unique[count == 1], graph.segments)
