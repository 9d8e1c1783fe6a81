"""Adaptive columns: conforming with party walls, exact where they should be, of the quality that is stated."""

import dataclasses
from typing import get_args

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.city_model.heights import highest_wall_ground, raise_low_roofs
from pipeline.columns.adaptive import AdaptiveOptions, AdaptiveReport, fill_columns, mesh_adaptive
from pipeline.columns.columns import expand_cells, lowest_gap
from pipeline.columns.improve_columns import ColumnSurvey, improve_columns, split_columns
from pipeline.columns.levels import fill_levels, stagger_columns
from pipeline.columns.nodes import (
    FREE,
    GROUND_LEVEL,
    ON_GROUND,
    ROOF_LEVEL,
    TOP_LEVEL,
    Levels,
    SeamColumns,
    Surfaces,
    collect_surfaces,
    no_seam,
    place_nodes,
    take_columns,
)
from pipeline.columns.spacing import SpacingLimits, domain_top, mean_edges, top_reach, vertical_spacing
from pipeline.data.citymodel import CityModel
from pipeline.data.errors import GeometryError
from pipeline.data.mesh import ColumnMesh, Marker, MergeOrder, PlaneMesh, TetMesh
from pipeline.data.roofs import flat_roofs
from pipeline.plane_mesh.edges import plane_edges, sort_triangles, triangle_neighbours
from pipeline.plane_mesh.improve_plane import improve_plane
from pipeline.plane_mesh.plane import mesh_plane, signed_areas
from pipeline.points_terrain.terrain import HEIGHT_UNIT, Dtm, sample_dtm
from pipeline.quality.quality import measure_cells, quality_percentiles
from tests.helpers.cities import Bounds, city_of, crowded_blocks, hilly_dtm, tilted_dtm
from tests.helpers.terraces import prove_conforming, prove_volume, prove_walls, terrace_town
from tests.helpers.whole_city import extract_boundary

LIMITS = SpacingLimits(least=0.1, most=0.8)
OPTIONS = AdaptiveOptions(mesh_size=10.0, domain_height=60.0, limits=LIMITS, stagger=0.8, passes=1)
TRIANGLE = PlaneMesh(
    np.array([[0.0, 0.0], [0.0, 8.0], [7.0, 4.0]]), np.array([[0, 1, 2]], np.int32), np.array([-1], np.int32)
)


def mesh_of(
    city: CityModel, dtm: Dtm, bounds: Bounds, options: AdaptiveOptions = OPTIONS
) -> tuple[ColumnMesh, AdaptiveReport]:
    plane, _ = mesh_plane(
        bounds, city.polygons, mesh_size=options.mesh_size, min_angle=28, refinements=1, passes=4
    )
    return mesh_adaptive(plane, dtm, city.roofs, city.ids, options)


def city_on(dtm: Dtm, bounds: Bounds, n: int, *, seed: int, clearance: float = 2.0) -> CityModel:
    """Crowded blocks of 5 to 40 m on a terrain, roofs raised above their walls' ground."""
    blocks = crowded_blocks(bounds, n, seed=seed)
    city = city_of(blocks, [0.0] * n)
    centres = shapely.get_coordinates(shapely.centroid(city.polygons))
    roof = sample_dtm(dtm, centres) + np.random.default_rng(seed).uniform(5, 40, n)
    roof, _ = raise_low_roofs(roof, highest_wall_ground(city.polygons, dtm), clearance=clearance)
    return dataclasses.replace(city, roofs=flat_roofs(roof))


@pytest.mark.parametrize("stagger", [0.0, 0.8])
@pytest.mark.parametrize("passes", [0, 2])
def test_terraces_conform_and_every_wall_is_the_higher_houses(stagger: float, passes: int) -> None:
    town = terrace_town(ground=3.0)
    dtm = tilted_dtm(town.bounds, height=3.0)
    options = dataclasses.replace(OPTIONS, stagger=stagger, passes=passes)
    mesh, report = mesh_of(town.model, dtm, town.bounds, options)
    assert prove_conforming(mesh, town.model.numbers) > 0  # the corner touches
    prove_volume(mesh, town.model, dtm)
    prove_walls(mesh, town, 3.0)
    assert report.moved_nodes == 0
    assert report.shared_columns > 10


def test_terraces_on_a_slope_keep_ground_and_roofs_bit_for_bit() -> None:
    town = terrace_town(ground=8.0)
    dtm = hilly_dtm(town.bounds, relief=6.0, length=20.0)
    mesh, _ = mesh_of(town.model, dtm, town.bounds)
    prove_conforming(mesh, town.model.numbers)
    prove_volume(mesh, town.model, dtm)
    cells, boundary = expand_cells(mesh), extract_boundary(mesh, town.model.numbers)
    ground = cells.points[boundary.facets[boundary.marker == Marker.GROUND]].reshape(-1, 3)
    assert ground[:, 2].tobytes() == sample_dtm(dtm, ground[:, :2]).tobytes()
    for number, roof in zip(town.model.numbers, town.model.roof, strict=True):
        facets = boundary.facets[(boundary.marker == Marker.ROOF) & (boundary.building == number)]
        assert (cells.points[facets, 2] == roof).all()


def test_a_wall_between_equal_roofs_does_not_exist() -> None:
    pair = [shapely.box(30, 30, 40, 45), shapely.box(40, 30, 52, 45)]
    bounds = (0.0, 0.0, 80.0, 80.0)
    city = city_of(pair, [10.0, 10.0])
    mesh, _ = mesh_of(city, tilted_dtm(bounds), bounds)
    boundary = extract_boundary(mesh, city.numbers)
    wall = mesh.plane.xy[np.repeat(np.arange(len(mesh.plane.xy)), np.diff(mesh.z_start))][boundary.facets]
    inner = (wall[..., 0] == 40).all(axis=1) & (wall[..., 1] > 30).any(axis=1) & (wall[..., 1] < 45).any(axis=1)
    assert not (inner & (boundary.marker == Marker.WALL)).any()
    prove_conforming(mesh, city.numbers)


def test_one_triangle_is_filled_by_hand() -> None:
    dtm = tilted_dtm((-40.0, -40.0, 50.0, 50.0), height=2.0)
    options = dataclasses.replace(OPTIONS, domain_height=16.0, stagger=0.0, passes=0)
    mesh, _ = mesh_adaptive(TRIANGLE, dtm, flat_roofs(np.empty(0)), np.empty(0, np.str_), options)
    # Mean edges are 8.03, 8.03 and 8.06 m, the limit 8 m: levels at 2, 10 and 18 m in each column.
    assert mesh.z.tolist() == [2.0, 10.0, 18.0] * 3
    # All middles are equal, so the highest vertex rises first, as in the paper's order.
    cells = [sorted(row) for row in expand_cells(mesh).cells.tolist()]
    assert cells == [[0, 3, 6, 7], [0, 3, 4, 7], [0, 1, 4, 7], [1, 4, 7, 8], [1, 4, 5, 8], [1, 2, 5, 8]]


def test_the_lowest_middle_is_merged_first() -> None:
    start, z = np.array([0, 2, 4, 6]), np.array([0.0, 3.0, 0.0, 1.0, 0.0, 2.0])
    mesh = ColumnMesh(TRIANGLE, start, z, np.zeros((1, 3), np.int32), "heights")
    cells = [sorted(row) for row in expand_cells(mesh).cells.tolist()]
    assert cells == [[0, 2, 3, 4], [0, 3, 4, 5], [0, 1, 3, 5]]
    assert lowest_gap(mesh) == (1.0, 0)


def test_a_roof_that_slants_past_the_merge_still_closes() -> None:
    """A node far off its roof's height: the sides of the wall lack each other's facets, none is left open."""
    xy = np.array([[0.0, 0.0], [0.0, 10.0], [5.0, 5.0], [-5.0, 5.0]])
    order = np.lexsort((xy[:, 1], xy[:, 0]))
    rank = np.argsort(order)
    triangles = np.sort(rank[np.array([[0, 1, 2], [0, 1, 3]])], axis=1).astype(np.int32)
    plane = PlaneMesh(xy[order], triangles, np.array([-1, 0], np.int32))
    z = [[0.0, 1, 2, 3, 10], [0.0, 1, 2, 3, 10], [0.0, 4, 8, 9, 10], [0.0, 3, 6, 9, 10]]
    start = np.arange(0, 21, 5)
    inside = plane.building >= 0
    for begins in ([1, 1, 3], [1, 3, 1], [3, 1, 1], [3, 3, 1], [1, 1, 1], [0, 0, 0], [2, 3, 1]):
        for order_name in get_args(MergeOrder):
            bottom = np.zeros((2, 3), np.int32)
            bottom[inside] = begins
            mesh = ColumnMesh(plane, start, np.ravel(z), bottom, order_name)
            prove_conforming(mesh, np.array([7]))


@pytest.mark.parametrize(("relief", "least_ratio"), [(38.0, 0.25), (76.0, 0.15), (152.0, 0.03)])
def test_steep_terrain_inverts_nothing(relief: float, least_ratio: float) -> None:
    bounds = (0.0, 0.0, 300.0, 300.0)
    dtm = hilly_dtm(bounds, relief=relief, length=40.0)
    city = city_on(dtm, bounds, 30, seed=3)
    options = dataclasses.replace(OPTIONS, domain_height=250.0)
    mesh, report = mesh_of(city, dtm, bounds, options)
    assert report.moved_nodes == 0
    assert lowest_gap(mesh)[0] > 0
    prove_conforming(mesh, city.numbers)
    prove_volume(mesh, city, dtm)
    assert measure_cells(expand_cells(mesh)).radius_ratio.min() > least_ratio


@pytest.mark.parametrize("seed", [1, 2])
def test_quality_is_as_stated(seed: int) -> None:
    bounds = (0.0, 0.0, 300.0, 300.0)
    dtm = hilly_dtm(bounds, relief=20.0)
    mesh, report = mesh_of(city_on(dtm, bounds, 45, seed=seed), dtm, bounds)
    quality = quality_percentiles(measure_cells(expand_cells(mesh)))
    found = [quality["radius_ratio"][p] for p in ("0", "0.1", "1", "5", "50")]
    assert (np.array(found) >= [0.30, 0.48, 0.57, 0.65, 0.83]).all(), found
    assert quality["min_dihedral"]["0"] >= 12
    assert report.worst_ratio[1] >= report.worst_ratio[0]


def halves(plane: PlaneMesh, x: float) -> list[tuple[PlaneMesh, NDArray[np.int64]]]:
    """Cut a plane mesh along its edges: each half with the vertices of the whole that it has."""
    left = plane.xy[plane.triangles][..., 0].mean(axis=1) < x
    result = []
    for side in (left, ~left):
        used, triangles = np.unique(plane.triangles[side], return_inverse=True)
        part = PlaneMesh(plane.xy[used], triangles.reshape(-1, 3).astype(np.int32), plane.building[side])
        result.append((part, used))
    return result


def test_a_column_depends_on_its_neighbourhood_alone() -> None:
    bounds = (0.0, 0.0, 200.0, 200.0)
    dtm = hilly_dtm(bounds, relief=10.0, noise=0.3)
    city = city_on(dtm, bounds, 12, seed=4)
    options = dataclasses.replace(OPTIONS, stagger=0.0, domain_height=80.0)
    plane, _ = mesh_plane(bounds, city.polygons, mesh_size=10.0)
    whole, _ = fill_columns(plane, dtm, city.roofs, city.ids, options)
    part, used = halves(plane, 100.0)[0]
    reach = int(top_reach(80.0))
    cropped = Dtm(dtm.z[:, : 110 + reach + 2].copy(), dtm.i0, dtm.j0, dtm.spacing)
    alone, _ = fill_columns(part, cropped, city.roofs, city.ids, options)
    inner = np.flatnonzero(part.xy[:, 0] < 80).astype(np.int32)
    one, two = take_columns(whole, used[inner].astype(np.int32)), take_columns(alone, inner)
    assert one.z.tobytes() == two.z.tobytes()
    assert one.kind.tobytes() == two.kind.tobytes()
    assert one.surfaces.building.tobytes() == two.surfaces.building.tobytes()
    assert one.surfaces.level.tobytes() == two.surfaces.level.tobytes()


def two_roofs(heights: list[float]) -> PlaneMesh:
    """A fan of triangles around vertex 0: one of open ground, one for each roof."""
    n = len(heights) + 1
    angle = 2 * np.pi * np.arange(n) / n
    xy = np.concatenate(([[-9.0, 0.0]], np.column_stack((np.cos(angle), np.sin(angle)))))
    triangles = np.array([sorted((0, 1 + k, 1 + (k + 1) % n)) for k in range(n)], np.int32)
    return PlaneMesh(xy, triangles, np.arange(-1, n - 1, dtype=np.int32))


@pytest.mark.parametrize(
    ("roofs", "placed"),
    [
        ([3.0, 7.0], [1.0, 3.0, 7.0]),  # far enough: exact
        ([7.0, 3.0], [1.0, 3.0, 7.0]),  # in any order
        ([1.5, 7.0], [1.0, 2.0, 7.0]),  # a roof close above the ground is raised
        ([0.0, 7.0], [1.0, 2.0, 7.0]),  # and one below it
        ([5.0, 5.5], [1.0, 5.0, 6.0]),  # the higher of two close roofs is raised
        ([1.5, 2.2], [1.0, 2.0, 3.0]),  # and pushes the next one
        ([5.0, 5.0], [1.0, 5.0]),  # equal roofs are one
    ],
)
def test_nodes_that_come_too_close_are_parted_upwards(roofs: list[float], placed: list[float]) -> None:
    plane = two_roofs(roofs)
    ground, gap = np.ones(len(plane.xy)), np.ones(len(plane.xy))
    nodes, moves = place_nodes(plane, flat_roofs(np.array(roofs)), ground, no_seam(), spacing=gap, least_gap=gap)
    assert nodes.z[: nodes.start[1]].tolist() == placed
    of_first = moves.distance[: len(roofs) + 1]
    assert of_first.max() == pytest.approx(max(np.array(placed[1:]) - sorted(set(roofs))))
    wanted = [1.0, *roofs]
    order = np.searchsorted(sorted(set(roofs)), roofs)
    assert nodes.of_corner[:, 0].tolist() == [0, *(1 + order)]
    assert (np.diff(nodes.z[: nodes.start[1]]) >= 1).all()
    assert len(wanted) == len(plane.triangles)


def test_levels_are_even_between_nodes_and_shifted_by_parts_of_a_step() -> None:
    plane = two_roofs([7.0])
    n = len(plane.xy)
    one, roofs = np.ones(n), flat_roofs(np.array([7.0]))
    nodes, _ = place_nodes(plane, roofs, one, no_seam(), spacing=one, least_gap=one)
    levels, bottom = fill_levels(nodes, np.full(n, 13.0), np.full(n, 3.5), np.full(n, 0.25), no_seam())
    first = take_columns(levels, np.array([0], np.int32))
    assert first.z.tolist() == [1.0, 4.75, 7.0, 10.75, 13.0]
    assert first.kind.tolist() == [GROUND_LEVEL, FREE, ROOF_LEVEL, FREE, TOP_LEVEL]
    assert bottom[:, 0].tolist() == [0, 2]


def test_a_seams_nodes_are_taken_over_where_they_stand() -> None:
    plane = two_roofs([7.0])
    n = len(plane.xy)
    one, roofs = np.ones(n), flat_roofs(np.array([7.0, 8.0]))
    z, kind = np.array([1.0, 7.5, 9.0, 12.0]), np.array([GROUND_LEVEL, ROOF_LEVEL, ROOF_LEVEL, TOP_LEVEL], np.int8)
    surfaces = Surfaces(np.array([0, 3]), np.array([ON_GROUND, 0, 1]), np.array([0, 1, 2], np.int32))
    column = Levels(np.array([0, 4]), z, kind, z, surfaces)
    seam = SeamColumns(np.array([0], np.int32), column)
    nodes, moves = place_nodes(plane, roofs, one, seam, spacing=one, least_gap=one)
    assert nodes.z[:2].tolist() == [1.0, 7.5]  # the roof beyond the seam is none of this tile's
    assert moves.distance[:2].tolist() == [0.0, 0.5]
    assert nodes.of_corner[:, 0].tolist() == [0, 1]
    levels, bottom = fill_levels(nodes, np.full(n, 12.0), np.full(n, 2.0), np.zeros(n), seam)
    assert take_columns(levels, seam.vertex).z.tolist() == column.z.tolist()
    assert bottom[:, 0].tolist() == [0, 1]


def test_a_seam_without_the_roof_that_a_tile_has_there_is_refused() -> None:
    plane = two_roofs([7.0])
    n = len(plane.xy)
    one, roofs = np.ones(n), flat_roofs(np.array([7.0]))
    bare = dataclasses.replace(plane, building=np.full(2, ON_GROUND, np.int32))
    open_nodes, _ = place_nodes(bare, roofs, one, no_seam(), spacing=one, least_gap=one)
    levels, bottom = fill_levels(open_nodes, np.full(n, 9.0), np.full(n, 2.0), np.zeros(n), no_seam())
    vertex = np.array([0], np.int32)
    levels = dataclasses.replace(levels, surfaces=collect_surfaces(bare, bottom))
    seam = SeamColumns(vertex, take_columns(levels, vertex))
    with pytest.raises(ValueError, match="surface that the seam's columns lack"):
        place_nodes(plane, roofs, one, seam, spacing=one, least_gap=one)


def test_a_tower_above_the_domain_is_refused() -> None:
    bounds = (0.0, 0.0, 80.0, 80.0)
    city = city_of([shapely.box(30, 30, 50, 50)], [59.0])
    with pytest.raises(GeometryError, match=r"building 1 at \(4.*1\.0 m of air .*raise --domain-height to"):
        mesh_of(city, tilted_dtm(bounds), bounds)


def test_a_spike_of_terrain_above_the_domain_is_refused() -> None:
    bounds = (0.0, 0.0, 80.0, 80.0)
    dtm = tilted_dtm(bounds)
    dtm.z[80, 80] = 70.0
    with pytest.raises(GeometryError, match=r"column at \(80\.0, 80\.0\).* at 70\.0 m .*raise --domain-height"):
        mesh_of(city_of([], []), dtm, bounds)


def test_neighbouring_columns_get_different_thirds() -> None:
    plane, _ = mesh_plane((0.0, 0.0, 100.0, 100.0), city_of([], []).polygons, mesh_size=8.0, passes=2)
    edges, _ = plane_edges(plane.triangles)
    shift = stagger_columns(len(plane.xy), edges)
    assert set((3 * shift).round().tolist()) == {-1.0, 0.0, 1.0}
    assert (shift[edges[:, 0]] == shift[edges[:, 1]]).mean() < 0.15


def test_the_top_is_the_smoothed_terrain_and_does_not_follow_a_mast() -> None:
    bounds = (0.0, 0.0, 200.0, 200.0)
    flat = tilted_dtm(bounds, height=4.0)
    xy = np.array([[100.0, 100.0], [3.3, 190.0]])
    assert domain_top(flat, xy, domain_height=100.0).tolist() == [104.0, 104.0]
    tilted = tilted_dtm(bounds, slope_x=0.1)
    np.testing.assert_allclose(domain_top(tilted, xy[:1], domain_height=100.0), 110.0, atol=1e-3)
    flat.z[100, 100] += 40
    assert 104 < domain_top(flat, xy, domain_height=100.0)[0] < 104.1


@pytest.mark.parametrize("shape", [(41, 30), (3, 7), (1, 1)])
def test_the_top_is_averaged_in_whole_numbers_that_are_rounded_down(shape: tuple[int, int]) -> None:
    z = np.random.default_rng(1).normal(0, 30, shape)
    units, half = np.rint(z / HEIGHT_UNIT).astype(int), 5
    for _ in range(2):
        for axis in range(2):
            lines = np.moveaxis(units, axis, 0)
            means = [lines[max(k - half, 0) : k + half + 1] for k in range(len(lines))]
            units = np.moveaxis(np.array([part.sum(axis=0) // len(part) for part in means]), 0, axis)
    nodes = np.argwhere(np.ones(shape, bool))[:, ::-1].astype(np.float64)
    top = domain_top(Dtm(z, 0, 0, 1.0), nodes, domain_height=20.0)
    assert (top == 20 + units.ravel() * HEIGHT_UNIT).all()


def test_spacing_follows_the_edges_within_limits() -> None:
    edge = np.array([0.5, 4.0, 30.0])
    assert vertical_spacing(edge, 10.0, LIMITS).tolist() == [1.0, 4.0, 8.0]
    assert vertical_spacing(edge, np.array([20.0, 10.0, 40.0]), LIMITS).tolist() == [2.0, 4.0, 30.0]
    assert mean_edges(TRIANGLE)[2] == pytest.approx(np.sqrt(65))


def test_plane_passes_keep_walls_and_make_angles_better() -> None:
    bounds = (0.0, 0.0, 200.0, 150.0)
    city = city_of(crowded_blocks(bounds, 15, seed=2), [9.0] * 15)
    before, _ = mesh_plane(bounds, city.polygons, mesh_size=10.0)
    after, _ = mesh_plane(bounds, city.polygons, mesh_size=10.0, passes=4)
    assert plane_ratios(after).min() > plane_ratios(before).min()
    assert np.percentile(plane_ratios(after), 5) > np.percentile(plane_ratios(before), 5) + 0.05
    assert len(after.xy) == len(before.xy)
    kept = {row.tobytes() for row in after.xy}
    assert {np.array(xy).tobytes() for p in city.polygons for xy in p.exterior.coords} <= kept
    for row, polygon in enumerate(city.polygons):
        area = np.abs(signed_areas(after))[after.building == row].sum()
        assert area == pytest.approx(polygon.area, rel=1e-9)


def plane_ratios(plane: PlaneMesh) -> NDArray[np.float64]:
    """Mean ratio of each triangle: 1 for the equilateral one."""
    corners = plane.xy[plane.triangles]
    squares = sum(((corners[:, k] - corners[:, k - 1]) ** 2).sum(axis=1) for k in range(3))
    ratio: NDArray[np.float64] = 4 * np.sqrt(3) * np.abs(signed_areas(plane)) / squares
    return ratio


def test_flips_reach_delaunay_and_leave_walls() -> None:
    # A kite whose long diagonal is an edge: a flip shortens it, unless the edge is a wall.
    xy = np.array([[0.0, 0.0], [10.0, 0.0], [5.0, 1.0], [5.0, -1.0]])
    triangles = np.array([[0, 1, 2], [1, 0, 3]], np.int32)
    _, flipped = improve_plane(xy, triangles, np.zeros(2, np.int32), mesh_size=1.0, passes=1)
    assert sorted(map(sorted, flipped.tolist())) == [[0, 2, 3], [1, 2, 3]]
    _, kept = improve_plane(xy, triangles, np.array([0, 1], np.int32), mesh_size=1.0, passes=1)
    assert kept.tolist() == triangles.tolist()
    same = improve_plane(xy, triangles, np.zeros(2, np.int32), mesh_size=1.0, passes=0)
    assert same[1].tolist() == triangles.tolist()


def test_flips_and_moves_leave_a_delaunay_mesh_of_the_same_area() -> None:
    side = np.arange(13.0)
    xy = np.column_stack((np.repeat(side, 13), np.tile(side, 13)))
    inner = ((xy > 0) & (xy < 12)).all(axis=1) & (xy[:, 0] != 6)
    xy[inner] += np.random.default_rng(5).uniform(-0.3, 0.3, (inner.sum(), 2))
    wall = xy[:, 0] == 6
    xy[:, 0] += 1.7 * xy[:, 1]  # most edges have to flip, many of them twice
    corner = (13 * np.arange(12)[:, None] + np.arange(12)).ravel()
    squares = np.column_stack((corner, corner + 13, corner + 14, corner + 1))
    triangles = np.concatenate((squares[:, [0, 1, 2]], squares[:, [0, 2, 3]])).astype(np.int32)
    label = (triangles.max(axis=1) > np.flatnonzero(wall).max()).astype(np.int32)
    moved, flipped = improve_plane(xy, triangles, label, mesh_size=1.0, passes=3)
    assert not np.array_equal(np.sort(flipped), np.sort(triangles))
    assert np.array_equal(moved[~inner], xy[~inner])
    u, v = moved[flipped[:, 1]] - moved[flipped[:, 0]], moved[flipped[:, 2]] - moved[flipped[:, 0]]
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    assert area.min() > 0.02
    assert area[label == 0].sum() == pytest.approx(72)
    neighbour = triangle_neighbours(flipped)
    angle = opposite_angles(moved, flipped)
    t, k = np.nonzero((neighbour >= 0) & (label[neighbour] == label[:, None]))
    twin = neighbour[t, k]
    back = (neighbour[twin] == t[:, None]).argmax(axis=1)
    assert (angle[t, k] + angle[twin, back]).max() <= np.pi + 1e-9


def opposite_angles(xy: NDArray[np.float64], triangles: NDArray[np.int32]) -> NDArray[np.float64]:
    """Angle at each corner of each triangle (radians)."""
    corners = xy[triangles]
    angles = []
    for k in range(3):
        u, v = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        cosine = (u * v).sum(axis=1) / np.linalg.norm(u, axis=1) / np.linalg.norm(v, axis=1)
        angles.append(np.arccos(cosine))
    return np.column_stack(angles)


@pytest.mark.parametrize("seed", range(3))
def test_edges_and_triangles_are_sorted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    fan = np.array([[0, k, k + 1] for k in range(1, 40)])  # one vertex has many edges, of triangles in any order
    triangles = rng.permuted(np.concatenate((fan, fan[:, [1, 2, 0]] + [40, 40, 1]))[rng.permutation(78)], axis=1)
    triangles = rng.permutation(triangles.max() + 1)[triangles].astype(np.int32)
    edges, of_triangle = plane_edges(triangles)
    pairs = np.sort(triangles[:, [[0, 1], [0, 2], [1, 2]]], axis=2)
    assert edges.tolist() == np.unique(pairs.reshape(-1, 2), axis=0).tolist()
    assert (edges[of_triangle] == pairs).all()
    rows = sort_triangles(np.sort(triangles, axis=1))
    assert rows.tolist() == np.lexsort(np.sort(triangles, axis=1).T[::-1]).tolist()


def test_neighbours_lie_across_the_opposite_edge() -> None:
    plane, _ = mesh_plane((0.0, 0.0, 60.0, 60.0), city_of([], []).polygons, mesh_size=10.0)
    neighbour = triangle_neighbours(plane.triangles)
    for t, row in enumerate(neighbour.tolist()):
        for k, u in enumerate(row):
            shared = set(plane.triangles[t]) - {plane.triangles[t, k]}
            others = [v for v in range(len(neighbour)) if v != t and shared <= set(plane.triangles[v])]
            assert others == ([] if u < 0 else [u])


def test_levels_move_only_where_they_may_and_the_worst_cell_gets_better() -> None:
    z = np.array([0.0, 4.0, 4.2, 12.0, 0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0])
    start = np.array([0, 4, 8, 12])
    mesh = ColumnMesh(TRIANGLE, start, z, np.zeros((1, 3), np.int32), "heights")
    spacing = np.full(3, 4.0)
    free = np.zeros(12, np.bool_)
    frozen, worst, moved = improve_columns(mesh, mesh.z, _slack(free), spacing, passes=1)
    assert (moved, frozen.z.tolist()) == (0, z.tolist())
    free[2] = True
    better, worst, moved = improve_columns(mesh, mesh.z, _slack(free), spacing, passes=1)
    assert moved == 1
    assert worst[1] > worst[0] + 0.05
    assert 4.2 < better.z[2] < 12
    assert np.array_equal(np.delete(better.z, 2), np.delete(z, 2))
    for found, told in zip((mesh, better), worst, strict=True):
        assert measure_cells(expand_cells(found)).radius_ratio.min() == pytest.approx(told, rel=1e-5)


def test_a_moved_level_ends_where_a_step_either_way_is_worse() -> None:
    z = np.array([0.0, 4.0, 4.2, 12.0, 0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0])
    mesh = ColumnMesh(TRIANGLE, np.array([0, 4, 8, 12]), z, np.zeros((1, 3), np.int32), "heights")
    free = np.arange(12) == 2
    better, _, _ = improve_columns(mesh, z, _slack(free), np.full(3, 4.0), passes=3)
    cells = expand_cells(better)

    def cost(shift: float) -> float:
        points = cells.points.copy()
        points[2, 2] += shift
        return float((measure_cells(TetMesh(points, cells.cells)).radius_ratio.astype(np.float64) ** -8).sum())

    assert cost(0.0) < min(cost(-0.05), cost(0.05))


@pytest.mark.parametrize("flat_cells", [False, True])
def test_what_is_kept_of_triangles_is_what_all_of_them_measured_anew_have(flat_cells: bool) -> None:
    mesh, free, step = _roughened()
    column = np.repeat(np.arange(len(step)), np.diff(mesh.z_start))
    free &= mesh.plane.xy[column, 0] > 80
    survey = ColumnSurvey(mesh, mesh.z, _slack(free), flat_cells)
    before = survey.cost
    z, moved = survey.search(step)
    survey.move(z)
    anew = ColumnSurvey(dataclasses.replace(mesh, z=survey.z), mesh.z, _slack(free), flat_cells)
    assert 0 < (z != mesh.z).sum() <= moved
    assert survey.cost < before
    assert np.array_equal(survey.of_cells, anew.of_cells)
    assert np.array_equal(survey.least, anew.least)


@pytest.mark.parametrize("most", [1, 40, 300])
def test_levels_searched_an_area_at_a_time_get_about_as_good_as_all_together(
    most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, free, step = _roughened()
    column = np.repeat(np.arange(len(step)), np.diff(mesh.z_start))
    free &= mesh.plane.xy[column, 0] > 30
    survey = ColumnSurvey(mesh, mesh.z, _slack(free), flat_cells=False)
    searched = int((survey.bad & free).sum())
    before, (together, _) = survey.cost, survey.search(step)
    monkeypatch.setattr("pipeline.columns.improve_columns.MOST_LEVELS", most)
    z, moved = survey.search(step)
    assert searched > most
    assert not np.array_equal(z, together)
    assert 0.9 * searched < moved <= searched
    assert np.array_equal(z[~free], mesh.z[~free])
    costs = [
        ColumnSurvey(dataclasses.replace(mesh, z=at), mesh.z, _slack(free), flat_cells=False).cost
        for at in (together, z)
    ]
    assert costs[1] < before - 0.9 * (before - costs[0])


@pytest.mark.parametrize("most", [1, 7, 50, 10_000])
def test_areas_hold_every_column_with_levels_once_and_lie_apart(most: int) -> None:
    rng = np.random.default_rng(7)
    xy, count = rng.uniform(0, 100, (300, 2)) * [3, 1], rng.integers(0, 9, 300)
    areas = split_columns(xy, count, most)
    assert sorted(np.concatenate(areas).tolist()) == np.flatnonzero(count).tolist()
    assert all(count[area].sum() <= most or len(area) == 1 for area in areas)
    boxes = [(*xy[area].min(axis=0), *xy[area].max(axis=0)) for area in areas]
    for k, (x0, y0, x1, y1) in enumerate(boxes):
        assert all(x1 < u0 or u1 < x0 or y1 < v0 or v1 < y0 for u0, v0, u1, v1 in boxes[:k])


def test_columns_at_one_place_are_split_too_and_none_make_no_area() -> None:
    areas = split_columns(np.zeros((5, 2)), np.full(5, 3), 6)
    assert sorted(np.concatenate(areas).tolist()) == list(range(5))
    assert max(map(len, areas)) <= 2
    assert split_columns(np.zeros((5, 2)), np.zeros(5, np.int64), 6) == []


def test_rounds_in_one_call_are_those_of_calls_one_after_the_other() -> None:
    mesh, free, spacing = _roughened()
    first, (_, worst), n_first = improve_columns(mesh, mesh.z, _slack(free), spacing, passes=1)
    second, (again, least), n_second = improve_columns(first, mesh.z, _slack(free), spacing, passes=1)
    both, (_, told), n_both = improve_columns(mesh, mesh.z, _slack(free), spacing, passes=2)
    assert not np.array_equal(first.z, mesh.z)
    assert not np.array_equal(second.z, first.z)
    assert again == worst
    assert (both.z.tobytes(), told, n_both) == (second.z.tobytes(), least, n_first + n_second)
    assert measure_cells(expand_cells(both)).radius_ratio.min() == pytest.approx(least, rel=1e-4)


def test_flat_cells_without_a_free_level_do_not_count_where_rounds_are_compared() -> None:
    mesh, free, spacing = _roughened()
    column = np.repeat(np.arange(len(spacing)), np.diff(mesh.z_start))
    free &= mesh.plane.xy[column, 0] > 80
    west = int(mesh.plane.xy[:, 0].argmin())
    z, first = mesh.z.copy(), mesh.z_start[west]
    z[first + 1] = z[first] + 1e-6
    thin = dataclasses.replace(mesh, z=z)
    # A cell that flat is worth more than all others together: whatever gets better, it cannot be seen.
    unseen, _, moved = improve_columns(thin, thin.z, _slack(free), spacing, passes=1)
    assert (moved > 0, unseen is thin) == (True, True)
    better, _, moved_again = improve_columns(thin, thin.z, _slack(free), spacing, passes=1, flat_cells=True)
    assert moved_again == moved
    assert 0 < (better.z != z).sum() <= moved


def _slack(free: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.where(free, np.inf, 0.0)


def test_a_roof_moves_within_its_slack_where_a_cell_is_bad_and_no_further() -> None:
    z = np.array([0.0, 4.0, 4.2, 12.0, 0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0])
    mesh = ColumnMesh(TRIANGLE, np.array([0, 4, 8, 12]), z, np.zeros((1, 3), np.int32), "heights")
    slack = np.zeros(12)
    slack[2] = 0.7
    better, worst, moved = improve_columns(mesh, z, slack, np.full(3, 4.0), passes=20)
    assert moved > 0
    assert worst[0] + 0.01 < worst[1] < 0.3
    assert 4.2 < better.z[2] <= 4.9
    # The price grows with the way: a level that has much slack goes further, a free one furthest.
    slack[2] = 7.0
    far, *_ = improve_columns(mesh, z, slack, np.full(3, 4.0), passes=20)
    slack[2] = np.inf
    furthest, *_ = improve_columns(mesh, z, slack, np.full(3, 4.0), passes=20)
    assert better.z[2] < far.z[2] <= furthest.z[2]
    # Cells that are not bad move free levels alone.
    z[2] = 6.0
    mesh = dataclasses.replace(mesh, z=z)
    for width, expected in ((0.7, 0), (np.inf, 1)):
        slack[2] = width
        _, worst, moved = improve_columns(mesh, z, slack, np.full(3, 4.0), passes=1, worst=0.99)
        assert (worst[0] > 0.3, moved) == (True, expected)


def test_columns_whose_cells_get_bad_by_merging_anew_go_back() -> None:
    mesh, free, _ = _roughened()
    survey = ColumnSurvey(mesh, mesh.z, _slack(free), flat_cells=False)
    z = mesh.z.copy()
    inner = np.flatnonzero(free)[5::40]
    z[inner] = z[inner - 1] + 0.02 * (z[inner + 1] - z[inner - 1])  # thin cells beside some levels
    least = survey.least.copy()
    survey.move(z)
    spoiled = survey.least < np.minimum(least, 0.3) - 1e-12
    around = np.full(len(mesh.plane.xy), np.inf)
    np.minimum.at(around, mesh.plane.triangles.ravel(), np.repeat(least, 3))
    assert (survey.z[inner] != z[inner]).any()
    assert (survey.least[spoiled] >= np.minimum(around[mesh.plane.triangles[spoiled]].min(axis=1), 0.3)).all()


def _roughened() -> tuple[ColumnMesh, NDArray[np.bool_], NDArray[np.float64]]:
    """A mesh with levels moved out of their places, which levels may move, and a scale of small steps (m)."""
    bounds = (0.0, 0.0, 120.0, 120.0)
    dtm = tilted_dtm(bounds, slope_x=0.1)
    mesh, _ = mesh_of(city_on(dtm, bounds, 4, seed=3), dtm, bounds)
    step = np.diff(mesh.z)
    free = np.zeros(len(mesh.z), bool)
    free[1:-1] = (step[1:] > 0) & (step[:-1] > 0)
    moved = free & (np.arange(len(free)) % 3 == 1)
    z = np.where(moved, np.pad(0.2 * mesh.z[1:-1] + 0.8 * mesh.z[2:], 1), mesh.z)
    return dataclasses.replace(mesh, z=z), free, np.full(len(mesh.plane.xy), 0.5)
