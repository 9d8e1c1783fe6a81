"""Steps 3.2 to 3.6 on columns: no inversion, exact heights, parity with finite elements, boundary."""

import dataclasses

import numpy as np
import pytest
import shapely

from pipeline.city_model.groups import adjacent_houses
from pipeline.city_model.heights import highest_wall_ground, raise_low_roofs
from pipeline.columns.columns import count_cells, expand_cells, lowest_gap
from pipeline.columns.layered import LayeredOptions, Smoother, layer_mesh, mesh_layers
from pipeline.columns.neighbours import join_equal_roofs, part_neighbours
from pipeline.columns.trim_layers import count_removed_layers, first_kept, first_levels
from pipeline.data.citymodel import CityModel
from pipeline.data.errors import GeometryError, SolverError
from pipeline.data.mesh import ColumnMesh, Marker, PlaneMesh, TetMesh
from pipeline.data.roofs import flat_roofs
from pipeline.plane_mesh.edges import plane_edges
from pipeline.plane_mesh.plane import mesh_plane, signed_areas
from pipeline.points_terrain.terrain import Dtm, sample_dtm
from pipeline.smoothing.column_smoothing import relax_columns
from pipeline.smoothing.fem import solve_laplace, stiffness_matrix
from pipeline.smoothing.ground_smoothing import smooth_slab
from pipeline.smoothing.repair import repair_columns
from pipeline.smoothing.stencil import assemble_stencil
from tests.helpers.cities import Bounds, city_of, hilly_dtm, random_blocks, random_city, tilted_dtm
from tests.helpers.terraces import prove_conforming, prove_volume, prove_walls, terrace_town
from tests.helpers.whole_city import extract_boundary

BOUNDS = (318000.0, 6399000.0, 318250.0, 6399250.0)
OPTIONS = LayeredOptions(
    mesh_size=10.0, layer_height=10.0, domain_height=100.0, smoother="columns", tolerance=0.003, fem_tolerance=1e-8
)


def mesh_of(city: CityModel, dtm: Dtm, options: LayeredOptions = OPTIONS, bounds: Bounds = BOUNDS) -> ColumnMesh:
    plane, _ = mesh_plane(bounds, city.polygons, mesh_size=options.mesh_size)
    return mesh_layers(plane, dtm, city, highest_wall_ground(city.polygons, dtm), bounds, options)[0]


def volumes(mesh: TetMesh) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    corners = mesh.points[mesh.cells]
    volume: np.ndarray[tuple[int], np.dtype[np.float64]] = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    return volume


def test_a_prism_becomes_the_papers_three_tetrahedra() -> None:
    plane = PlaneMesh(
        np.array([[0.0, 0], [1, 0], [1, 1]]), np.array([[0, 1, 2]], np.int32), np.array([-1], np.int32)
    )
    mesh = layer_mesh(plane, np.array([[0.0, 1]] * 3), np.zeros(1, np.int32))
    # Points 0, 2, 4 are u1, u2, u3 and 1, 3, 5 are v1, v2, v3 of equations 1-3.
    cells = [sorted(row) for row in expand_cells(mesh).cells.tolist()]
    assert cells == [[0, 2, 4, 5], [0, 2, 3, 5], [0, 1, 3, 5]]
    np.testing.assert_allclose(volumes(expand_cells(mesh)), 1 / 6)


def test_flat_ground_without_buildings_fills_the_box() -> None:
    mesh = mesh_of(city_of([], []), tilted_dtm(BOUNDS, height=5.0))
    assert volumes(expand_cells(mesh)).sum() == pytest.approx(250 * 250 * 100, rel=1e-12)
    assert set(np.unique(mesh.z).round(9)) == set(np.arange(5.0, 106.0, 10.0))


@pytest.mark.parametrize(("mesh_size", "layer_height"), [(10.0, 10.0), (10.0, 4.0), (20.0, 10.0)])
def test_no_cell_is_inverted_and_ground_and_roofs_are_exact(mesh_size: float, layer_height: float) -> None:
    city, dtm, _ = random_city(BOUNDS, 20, seed=7, relief=20.0)
    mesh = mesh_of(city, dtm, dataclasses.replace(OPTIONS, mesh_size=mesh_size, layer_height=layer_height))
    cells = expand_cells(mesh)
    assert volumes(cells).min() > 0
    assert lowest_gap(mesh)[0] > 0
    boundary = extract_boundary(mesh, city.numbers)
    ground = cells.points[boundary.facets[boundary.marker == Marker.GROUND]].reshape(-1, 3)
    assert ground[:, 2].tobytes() == sample_dtm(dtm, ground[:, :2]).tobytes()
    for number, roof in zip(city.numbers, city.roof, strict=True):
        facets = boundary.facets[(boundary.marker == Marker.ROOF) & (boundary.building == number)]
        assert (cells.points[facets, 2] == roof).all()


def test_roofs_are_exact_where_adding_a_displacement_would_round() -> None:
    blocks = random_blocks(BOUNDS, 12, seed=6)
    city = city_of(blocks, [2.0 + 0.1 * k for k in range(12)])
    mesh = mesh_of(city, tilted_dtm(BOUNDS, height=0.1))
    boundary = extract_boundary(mesh, city.numbers)
    heights = expand_cells(mesh).points[boundary.facets[boundary.marker == Marker.ROOF], 2]
    assert set(heights.ravel()) == set(city.roof)


def test_the_boundary_is_that_of_the_cells_and_closed() -> None:
    city, dtm, _ = random_city(BOUNDS, 15, seed=2)
    mesh = mesh_of(city, dtm)
    prove_conforming(mesh, city.numbers)
    cells, boundary = expand_cells(mesh), extract_boundary(mesh, city.numbers)
    # Outward: the volume by the divergence theorem is that of the cells.
    p = cells.points[boundary.facets] - cells.points.mean(axis=0)
    assert np.linalg.det(p).sum() / 6 == pytest.approx(volumes(cells).sum(), rel=1e-9)


def test_markers_cover_the_sides_and_every_building_has_walls_and_a_roof() -> None:
    city, dtm, _ = random_city(BOUNDS, 15, seed=2)
    mesh = mesh_of(city, dtm)
    cells, boundary = expand_cells(mesh), extract_boundary(mesh, city.numbers)
    for marker, axis, value in (
        (Marker.WEST, 0, BOUNDS[0]), (Marker.EAST, 0, BOUNDS[2]),
        (Marker.SOUTH, 1, BOUNDS[1]), (Marker.NORTH, 1, BOUNDS[3]),
    ):  # fmt: skip
        assert (cells.points[boundary.facets[boundary.marker == marker]][..., axis] == value).all()
        assert (boundary.marker == marker).any()
    assert set(np.unique(boundary.marker)) == set(range(1, 9))
    for marker in (Marker.WALL, Marker.ROOF):
        assert set(boundary.building[boundary.marker == marker]) == set(city.numbers)
    others = ~np.isin(boundary.marker, (Marker.WALL, Marker.ROOF))
    assert (boundary.building[others] == -1).all()


@pytest.mark.parametrize("relief", [38.0, 76.0, 152.0])
def test_steep_terrain_is_repaired_not_inverted(relief: float) -> None:
    bounds = (0.0, 0.0, 400.0, 400.0)
    dtm = hilly_dtm(bounds, relief=relief, length=25.0)
    blocks = random_blocks(bounds, 30, seed=3)
    city = city_of(blocks, [0.0] * 30)
    wall_ground = highest_wall_ground(city.polygons, dtm)
    roof, _ = raise_low_roofs(city.roof, wall_ground, clearance=2.0)
    city = dataclasses.replace(city, roofs=flat_roofs(roof))
    plane, _ = mesh_plane(bounds, city.polygons, mesh_size=10.0)
    options = dataclasses.replace(OPTIONS, domain_height=300.0)
    mesh, report = mesh_layers(plane, dtm, city, wall_ground, bounds, options)
    assert volumes(expand_cells(mesh)).min() > 0
    if relief > 100:
        assert report.repaired_terrain + report.repaired_roofs > 0


def test_the_fast_path_agrees_with_finite_elements() -> None:
    """The design's bound, 0.02 m in the mean, for steps 3.3 and 3.5 together."""
    city, dtm, _ = random_city(BOUNDS, 25, seed=11, relief=20.0)
    fast = mesh_of(city, dtm)
    exact = mesh_of(city, dtm, dataclasses.replace(OPTIONS, smoother="fem"))
    difference = np.abs(fast.z - exact.z)
    assert difference.mean() < 0.02
    assert difference.max() < 0.15


def test_the_slab_filter_is_finite_elements_in_the_limit() -> None:
    """One cosine of terrain has a known solution: the filter hits it, finite elements converge to it."""
    width, height = 200.0, 100.0
    bounds = (0.0, 0.0, width, width)
    x = np.arange(201.0)
    dtm = Dtm(np.tile(5 * np.cos(np.pi * x / width), (201, 1)), 0, 0, 1.0)
    wave = np.pi / width
    errors = []
    for size in (40.0, 20.0, 10.0):
        plane, _ = mesh_plane(bounds, city_of([], []).polygons, mesh_size=size)
        layers = round(height / size)
        level = np.linspace(0, height, layers + 1)
        exact = level + 5 * np.cos(wave * plane.xy[:, :1]) * np.cosh(wave * (height - level)) / np.cosh(
            wave * height
        )
        flat = np.tile(level, (len(plane.xy), 1))
        cells = expand_cells(layer_mesh(plane, flat, np.zeros(len(plane.triangles), np.int32)))
        fixed = np.zeros(flat.shape, bool)
        fixed[:, 0] = True
        values = np.tile(sample_dtm(dtm, plane.xy)[:, None], layers + 1)
        u, _, _ = solve_laplace(cells, fixed.ravel(), values.ravel(), relative_tolerance=1e-10, step="3.3")
        errors.append(float(np.sqrt(np.mean((flat + u.reshape(flat.shape) - exact) ** 2))))
    filtered = smooth_slab(dtm, plane.xy, bounds, domain_height=height, n_layers=layers, grid_spacing=2.0)
    assert np.abs(filtered - exact).max() < 2e-3
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.7).all(), f"errors {errors}, orders {orders}"


def test_linear_displacement_is_reproduced_exactly() -> None:
    """Linear elements contain linear functions: with them given at two ends, every level between has them."""
    plane, _ = mesh_plane((0.0, 0.0, 60.0, 60.0), city_of([], []).polygons, mesh_size=10.0)
    z = np.tile(np.linspace(0, 50, 6), (len(plane.xy), 1)) + 0.05 * plane.xy[:, :1]
    exact = 0.3 + 0.02 * z
    fixed = np.zeros(z.shape, bool)
    fixed[:, [0, -1]] = True
    first = np.zeros(len(plane.triangles), np.int32)
    u, _, residual = relax_columns(plane, first, z, fixed, np.where(fixed, exact, 0.0), tolerance=1e-11)
    np.testing.assert_allclose(u, exact, atol=1e-8)
    assert residual <= 1.1e-11


def test_the_stencil_is_the_stiffness_matrix_of_the_cells() -> None:
    city, dtm, _ = random_city((0.0, 0.0, 120.0, 120.0), 4, seed=5)
    plane, _ = mesh_plane((0.0, 0.0, 120.0, 120.0), city.polygons, mesh_size=15.0)
    z = sample_dtm(dtm, plane.xy)[:, None] + np.linspace(0, 60, 5)
    removed = np.array([1, 2, 3, 1], np.int32)
    first = first_levels(plane, removed)
    edges, of_triangle = plane_edges(plane.triangles)
    stencil = assemble_stencil(plane, of_triangle, len(edges), first, z)
    mesh = layer_mesh(plane, z, first)
    matrix = stiffness_matrix(expand_cells(mesh)).toarray()
    kept = first_kept(plane, first)
    number = np.full(z.shape, -1)
    number[np.arange(5) >= kept[:, None]] = np.arange(len(mesh.z))
    dense = np.zeros_like(matrix)
    couplings = [
        (number[:, :-1], number[:, 1:], stencil.up),
        (number[edges[:, 0]], number[edges[:, 1]], stencil.level),
        (number[edges[:, 0], :-1], number[edges[:, 1], 1:], stencil.slant),
    ]
    for rows, columns, values in couplings:
        used = (rows >= 0) & (columns >= 0)
        assert (values[~used] == 0).all()
        np.add.at(dense, (rows[used], columns[used]), values[used])
        np.add.at(dense, (columns[used], rows[used]), values[used])
    np.add.at(dense, (number[number >= 0], number[number >= 0]), stencil.diagonal[number >= 0])
    np.testing.assert_allclose(dense, matrix, atol=1e-9 * np.abs(matrix).max())


def test_sweeps_solve_for_the_unknowns_and_leave_what_is_given() -> None:
    """Against a dense solve; single precision alone does not reach the last tolerance, rounds of it do."""
    city, dtm, _ = random_city((0.0, 0.0, 120.0, 120.0), 4, seed=5)
    plane, _ = mesh_plane((0.0, 0.0, 120.0, 120.0), city.polygons, mesh_size=15.0)
    z = sample_dtm(dtm, plane.xy)[:, None] + np.array([0.0, 2.0, 7.0, 30.0, 60.0])
    first = first_levels(plane, np.array([1, 2, 3, 1], np.int32))
    kept = first_kept(plane, first)
    used = np.arange(5) >= kept[:, None]
    fixed = np.arange(5) <= kept[:, None]
    given = np.where(fixed & used, 3.0 * np.sin(plane.xy[:, :1] / 20), 0.0)
    number = np.full(z.shape, -1)
    number[used] = np.arange(used.sum())
    matrix = stiffness_matrix(expand_cells(layer_mesh(plane, z, first))).toarray()
    free, known = number[~fixed], number[fixed & used]
    exact = given.copy()
    exact[~fixed] = np.linalg.solve(matrix[np.ix_(free, free)], -matrix[np.ix_(free, known)] @ given[fixed & used])
    diagonal = matrix.diagonal()[free]
    for tolerance, reach in ((3e-3, 3e-2), (1e-10, 1e-8)):
        u, _, residual = relax_columns(plane, first, z, fixed, given, tolerance=tolerance)
        np.testing.assert_array_equal(u[fixed], given[fixed])
        np.testing.assert_allclose(u, exact, atol=reach)
        assert residual <= tolerance
        true = np.abs(matrix @ u[used])[free] / diagonal
        assert residual == pytest.approx(true.max(), rel=1e-3)


def test_a_tolerance_below_rounding_ends_where_rounds_gain_nothing() -> None:
    plane, _ = mesh_plane((0.0, 0.0, 60.0, 60.0), city_of([], []).polygons, mesh_size=10.0)
    z = np.tile(np.linspace(0, 50, 6), (len(plane.xy), 1))
    fixed = np.zeros(z.shape, bool)
    fixed[:, [0, -1]] = True
    first = np.zeros(len(plane.triangles), np.int32)
    given = np.where(fixed, np.cos(plane.xy[:, :1]), 0.0)
    _, iterations, residual = relax_columns(plane, first, z, fixed, given, tolerance=0.0)
    assert iterations < 200
    assert 0 < residual < 1e-14


def test_a_solver_that_does_not_converge_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.smoothing.column_smoothing.MAX_ITERATIONS", 2)
    city, dtm, _ = random_city(BOUNDS, 10, seed=1)
    with pytest.raises(SolverError, match=r"step 3\.5: residual .* after 2 iterations"):
        mesh_of(city, dtm, dataclasses.replace(OPTIONS, tolerance=1e-9))
    monkeypatch.setattr("pipeline.smoothing.fem.MAX_ITERATIONS", 1)
    with pytest.raises(SolverError, match=r"step 3\.3: relative residual"):
        mesh_of(city, dtm, dataclasses.replace(OPTIONS, smoother="fem"))


def test_a_tower_above_the_domain_is_refused_with_the_height_that_does() -> None:
    city = city_of([shapely.box(318100, 6399100, 318120, 6399120)], [300.0])
    with pytest.raises(GeometryError, match=r"building 1 at \(3181.*raise --domain-height to 315"):
        mesh_of(city, tilted_dtm(BOUNDS))
    mesh = mesh_of(city, tilted_dtm(BOUNDS), dataclasses.replace(OPTIONS, domain_height=315.0))
    assert volumes(expand_cells(mesh)).min() > 0


def test_repair_leaves_ascending_columns_and_given_levels() -> None:
    z = np.array([[0.0, 1, 2, 3], [0.0, -1, 5, 4], [9.0, 9, 9, 1]])
    fixed = np.zeros(z.shape, bool)
    fixed[:, 0] = True
    fixed[1, 2] = True
    fixed[2, 2] = True
    kept = np.array([0, 0, 2], np.int32)
    result, moved = repair_columns(z, kept, fixed, min_gap=0.5)
    assert result.tolist() == [[0, 1, 2, 3], [0, 0.5, 5, 5.5], [9, 9, 9, 9.5]]
    assert moved == 3


def test_repair_squeezes_between_two_given_levels() -> None:
    z = np.array([[0.0, 7, 8, 1, 20]])
    fixed = np.array([[True, False, False, True, False]])
    result, _ = repair_columns(z, np.zeros(1, np.int32), fixed, min_gap=1.0)
    # An even spacing would be 1/3 m; half of it is what the repair keeps.
    np.testing.assert_allclose(result[0], [0, 2 / 3, 5 / 6, 1, 20])


def test_repair_refuses_given_levels_that_do_not_ascend() -> None:
    fixed = np.array([[True, True]])
    with pytest.raises(GeometryError, match="do not ascend"):
        repair_columns(np.array([[2.0, 1.0]]), np.zeros(1, np.int32), fixed, min_gap=0.1)


def test_no_more_layers_are_removed_than_leave_each_two_fifths() -> None:
    levels = np.array([[-10.0], [10.0]]) + np.linspace(0, 100, 11)
    building = np.zeros(2, np.int64)
    for wall, layers in ((0.0, 5), (40.0, 1), (37.0, 2)):
        removed = count_removed_layers(
            levels, building, np.array([46.0]), np.array([wall]), np.zeros(1, np.int32), layer_height=10.0
        )
        assert removed.tolist() == [layers]


def test_counts_are_those_of_the_cells() -> None:
    city, dtm, _ = random_city(BOUNDS, 5, seed=9)
    mesh = mesh_of(city, dtm)
    assert count_cells(mesh) == len(expand_cells(mesh).cells)
    inside = mesh.plane.building >= 0
    area = np.abs(signed_areas(mesh.plane))
    assert area[inside].sum() == pytest.approx(sum(p.area for p in city.polygons))


@pytest.mark.parametrize("smoother", ["columns", "fem"])
@pytest.mark.parametrize("layer_height", [3.0, 6.0, 12.0])
def test_terraces_conform_on_layers_of_their_own(smoother: Smoother, layer_height: float) -> None:
    town = terrace_town(ground=3.0)
    city, dtm = town.model, tilted_dtm(town.bounds, height=3.0)
    options = dataclasses.replace(OPTIONS, domain_height=60.0, layer_height=layer_height, smoother=smoother)
    plane, _ = mesh_plane(town.bounds, city.polygons, mesh_size=10.0)
    ground = np.full(len(city), 3.0)
    mesh, report = mesh_layers(plane, dtm, city, ground, town.bounds, options, group=town.group)
    assert prove_conforming(mesh, city.numbers) > 0
    prove_volume(mesh, city, dtm)
    prove_walls(mesh, town, 3.0)
    if layer_height > 5:
        assert report.parted_groups > 0


def test_roofs_that_meet_rise_one_layer_each_and_equal_ones_share_theirs() -> None:
    row = [shapely.box(10 + 10 * k, 30, 20 + 10 * k, 40) for k in range(5)]
    city = city_of(row, [12.0, 15.0, 15.0, 18.0, 40.0])
    own = np.arange(5, dtype=np.int32)
    pairs = adjacent_houses(city.polygons)
    group = join_equal_roofs(pairs, city.roof, own)
    assert group.tolist() == [0, 1, 1, 2, 3]
    alone = np.array([1, 1, 1, 2, 4], np.int32)
    removed, parted = part_neighbours(pairs, city.roof, group, alone, city.polygons, n_layers=8)
    assert (removed.tolist(), parted) == ([1, 2, 2, 3, 4], 2)
    # Without room above, the lower ones come down.
    full = np.full(5, 4, np.int32)
    crowded, parted = part_neighbours(pairs, city.roof, group, full, city.polygons, n_layers=5)
    assert (crowded.tolist(), parted) == ([1, 2, 2, 3, 4], 3)
    with pytest.raises(GeometryError, match=r"roof at 12\.0 m near \(15.*in 4 layers; lower --layer-height"):
        part_neighbours(pairs, city.roof, group, alone, city.polygons, n_layers=4)
