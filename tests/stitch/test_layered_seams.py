"""Seams of layers: tiles meshed alone are one mesh when glued, and depend on terrain in reach and layers alone."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.city_model.groups import adjacent_houses
from pipeline.columns.layered import LayeredOptions, choose_layers, fill_layers, mesh_layers, terrain_reach
from pipeline.columns.nodes import SeamColumns, take_columns
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm
from pipeline.smoothing.ground_smoothing import (
    SlabShape,
    _find_levels,
    lift_places,
    slab_reach,
    slab_window,
    smooth_slab,
)
from stitch.seams.layered_seams import fill_corner_layers
from stitch.seams.seams import find_vertices
from stitch.tiling.corners import place_corner
from stitch.tiling.grid import Key, SeamKey
from stitch.tiling.patches import mesh_patch
from stitch.tiling.walls import cut_walls
from tests.helpers.cities import Bounds, city_of, hilly_dtm, tilted_dtm
from tests.helpers.stitching import (
    LAYERED,
    NINE,
    SQUARE,
    Scene,
    layers_of,
    mesh_alone,
    prove_tiles,
    random_scene,
    scene_of,
    select_houses,
)


def test_steep_terrain_is_repaired_on_seams_too() -> None:
    dtm = hilly_dtm(SQUARE, relief=80.0, length=20.0)
    houses = random_scene(SQUARE, 60, seed=4).model.polygons
    scene = scene_of(list(houses), [6.0] * len(houses), dtm)
    prove_tiles(scene, NINE, replace(LAYERED, domain_height=150.0))


def rows_of_terraces(bounds: Bounds) -> Scene:
    """Terraces of five houses with shared walls, one beside the other, on hills."""
    houses, roofs = [], []
    rng = np.random.default_rng(7)
    for x in np.arange(bounds[0] + 20, bounds[2] - 70, 90):
        for y in np.arange(bounds[1] + 20, bounds[3] - 30, 45):
            houses += [shapely.box(x + 10 * k, y, x + 10 * k + 10, y + 12) for k in range(5)]
            roofs += rng.choice([5.0, 5.0, 8.0, 11.0, 19.0], 5).tolist()
    model = city_of(houses, [20.0 + roof for roof in roofs])
    return Scene(model, np.arange(len(model), dtype=np.int32), hilly_dtm(bounds, relief=30.0, length=60.0))


def choose(scene: Scene, dtm: Dtm, bounds: Bounds) -> NDArray[np.int32]:
    return layers_of(replace(scene, dtm=dtm), bounds, LOW_TOWN)


LOW_TOWN = replace(LAYERED, layer_height=3.0)


def test_layers_are_those_of_the_cluster_and_the_terrain_in_reach_alone() -> None:
    bounds = (0.0, 0.0, 900.0, 900.0)
    scene = rows_of_terraces(bounds)
    dtm = scene.dtm
    layers = choose(scene, dtm, bounds)
    assert len(np.unique(layers)) > 4
    order = np.random.default_rng(1).permutation(len(layers))
    assert (choose(select_houses(scene, order), dtm, bounds) == layers[order]).all()
    reach = int(terrain_reach(LOW_TOWN)) + 2
    for cluster in (140, 200, 300):
        rows = np.arange(cluster, cluster + 5)
        alone = select_houses(scene, rows)
        low = np.floor(shapely.total_bounds(alone.model.polygons)[:2]).astype(int) - reach
        high = np.ceil(shapely.total_bounds(alone.model.polygons)[2:]).astype(int) + reach
        west, south = np.maximum(low, 0)
        clipped = Dtm(dtm.z[south : high[1], west : high[0]].copy(), int(west), int(south), 1.0)
        assert (choose(alone, clipped, bounds) == layers[rows]).all()


def test_roofs_that_meet_are_on_layers_in_order() -> None:
    bounds = (0.0, 0.0, 900.0, 900.0)
    scene = rows_of_terraces(bounds)
    layers, roof = choose(scene, scene.dtm, bounds), scene.model.roof
    a, b = adjacent_houses(scene.model.polygons).T
    assert (np.sign(roof[a] - roof[b]) == np.sign(layers[a] - layers[b])).all()


def test_windows_differ_by_little_from_the_region() -> None:
    """Terrain out of reach moves no level by more than exp(-3 pi / 2) of the relief, about 1 %."""
    bounds = (0.0, 0.0, 1500.0, 1500.0)
    dtm = hilly_dtm(bounds, relief=40.0, length=80.0, noise=1.0)
    xy = np.random.default_rng(0).uniform(600, 900, (300, 2))
    shape = {"domain_height": 60.0, "grid_spacing": 10.0}
    whole = smooth_slab(dtm, xy, bounds, domain_height=60.0, n_layers=12, grid_spacing=10.0)
    window = slab_window(xy, bounds, **shape)
    assert window[0] > 400
    near = smooth_slab(dtm, xy, window, domain_height=60.0, n_layers=12, grid_spacing=10.0)
    assert np.abs(near - whole).max() < 0.01 * 40
    placed = lift_places(dtm, xy, bounds, domain_height=60.0, n_layers=12, grid_spacing=10.0)
    assert np.abs(placed - whole).max() < 0.045 * 40
    alone = lift_places(dtm, xy[7:8], bounds, domain_height=60.0, n_layers=12, grid_spacing=10.0)
    assert alone.tobytes() == placed[7:8].tobytes()
    reach = int(slab_reach(60.0, grid_spacing=10.0)) + 1
    west, south = np.floor(xy[7]).astype(int) - reach
    clipped = Dtm(dtm.z[south : south + 2 * reach, west : west + 2 * reach].copy(), int(west), int(south), 1.0)
    near = lift_places(clipped, xy[7:8], bounds, domain_height=60.0, n_layers=12, grid_spacing=10.0)
    assert near.tobytes() == alone.tobytes()


@pytest.mark.parametrize("size", [(150.0, 120.0), (163.7, 97.3), (118.0, 60.0)])
@pytest.mark.parametrize("shaped", [False, True])
def test_places_are_lifted_as_meshes_where_both_see_the_region(size: tuple[float, float], shaped: bool) -> None:
    bounds = (300.0, 240.0, 300.0 + size[0], 240.0 + size[1])
    dtm = hilly_dtm(bounds, relief=40.0, length=80.0, noise=1.0)
    shape = SlabShape(np.array([0.0, 4.0, 12.0, 20.0, 40.0, 60.0]), 12.0, 90.0) if shaped else None
    xy = np.random.default_rng(0).uniform(bounds[:2], bounds[2:], (300, 2))
    xy[:3] = bounds[:2], bounds[2:], (360.0, 300.0)
    lifted, meshed = (
        way(dtm, xy, bounds, domain_height=60.0, n_layers=5, grid_spacing=10.0, shape=shape)
        for way in (lift_places, smooth_slab)
    )
    np.testing.assert_allclose(lifted, meshed, rtol=0, atol=1e-5)
    assert np.ptp(lifted[:, 3]) > 1


@pytest.mark.parametrize(("height", "n"), [(100.0, 10), (100.0, 30), (83.7, 7), (143.21, 23)])
def test_equal_layers_are_equal_bit_for_bit(height: float, n: int) -> None:
    """What fades from one level to the next is then computed once; differences of levels would not do."""
    levels, rises = _find_levels(height, n, None)
    assert np.unique(rises).tolist() == [height / n]
    np.testing.assert_allclose(np.diff(levels), rises, rtol=1e-12)


@pytest.mark.parametrize("box", [(0.0, 0.0, 9.0, 9.0), (700.0, 40.0, 725.0, 690.0), (0.0, 380.0, 700.0, 410.0)])
def test_sums_for_a_few_nodes_give_what_the_transform_gives(box: Bounds, monkeypatch: pytest.MonkeyPatch) -> None:
    bounds = (0.0, 0.0, 730.0, 690.0)
    dtm = hilly_dtm(bounds, relief=40.0, length=80.0, noise=1.0)
    xy = np.random.default_rng(0).uniform(box[:2], box[2:], (50, 2))
    xy[:2] = box[:2], box[2:]

    def smooth() -> NDArray[np.float64]:
        return smooth_slab(dtm, xy, bounds, domain_height=60.0, n_layers=12, grid_spacing=10.0)

    with monkeypatch.context() as patch:
        patch.setattr("pipeline.smoothing.ground_smoothing._sum_modes", None)
        patch.setattr("pipeline.smoothing.ground_smoothing.SUMS", 0.0)
        transformed = smooth()
    with monkeypatch.context() as patch:
        patch.setattr("scipy.fft.idctn", None)
        summed = smooth()
    np.testing.assert_allclose(summed, transformed, rtol=0, atol=1e-12)
    assert np.ptp(summed[:, 3]) > 0.3


GROWN = np.array([0.0, 0.5, 1.25, 2.5, 5.0, 9.0, 20.0, 60.0])


@pytest.mark.parametrize(
    ("levels", "shaped"),
    [(np.linspace(0, 60, 13), False), (GROWN, True), (np.array([0.0, 4000.0, 8000.0]), False)],
    ids=["equal", "growing", "coarse"],
)
def test_a_wave_of_the_terrain_fades_as_the_equation_says(levels: NDArray[np.float64], shaped: bool) -> None:
    east, north = np.meshgrid(np.arange(81.0), np.arange(61.0))
    wave = np.pi * np.hypot(3 / 80, 2 / 60)
    z = 5.0 * np.cos(np.pi * 3 * east / 80) * np.cos(np.pi * 2 * north / 60)
    xy = np.random.default_rng(3).integers((0, 0), (81, 61), (40, 2)).astype(np.float64)
    found = smooth_slab(
        Dtm(z, 0, 0, 1.0),
        xy,
        (0.0, 0.0, 80.0, 60.0),
        domain_height=levels[-1],
        n_layers=len(levels) - 1,
        grid_spacing=1.0,
        shape=SlabShape(levels, 0.0, None) if shaped else None,
    )
    height = levels[-1]
    share = (np.exp(-wave * levels) + np.exp(wave * (levels - 2 * height))) / (1 + np.exp(-2 * wave * height))
    ground = z[xy[:, 1].astype(int), xy[:, 0].astype(int)]
    np.testing.assert_allclose(found, levels + ground[:, None] * share, rtol=0, atol=1e-11)


STREET = [shapely.box(100, 90, 130, 180), shapely.box(152, 90, 180, 180), shapely.box(300, 300, 310, 310)]


@pytest.mark.parametrize("key", [Key(1, 1), Key(1, 0)])
def test_a_corner_sees_the_houses_around_it(key: Key) -> None:
    moved = [affinity.translate(house, 0, -85 * (key.j == 0)) for house in STREET]
    scene = scene_of(moved, [13.0, 13.0, 13.0], tilted_dtm(SQUARE))
    model = scene.model
    walls = cut_walls(model.polygons, mesh_size=10.0)
    corner = place_corner(NINE, key, model.polygons, walls, mesh_size=10.0)
    patch, fewer = (
        mesh_patch(corner, houses, cut_walls(houses, mesh_size=10.0), SQUARE, mesh_size=10.0, min_angle=28.0)
        for houses in (model.polygons, model.polygons[:2])
    )
    assert patch.xy.tobytes() == fewer.xy.tobytes()
    assert patch.triangles.tobytes() == fewer.triangles.tobytes()
    assert set(patch.building) == {-1, 0, 1}
    ends = corner.tips[~np.isnan(corner.tips[:, 0])]
    find_vertices(patch.xy, np.concatenate((corner.xy[None], ends[ends[:, 1] > 0])))
    removed = layers_of(scene, SQUARE, LAYERED)
    levels = fill_corner_layers(corner, patch, scene.dtm, model.roof, model.ids, removed, SQUARE, LAYERED)
    # Roofs at 13 m are layer 3, at 15 m without them: the layers sink between the houses, not at the ground.
    assert levels.z[0] == 0
    assert (levels.z[3:6] < 5.0 * np.arange(3, 6) - 0.2).all()


def test_a_seam_keeps_the_triangles_around_it() -> None:
    seam = mesh_alone(random_scene(SQUARE, 60, seed=1), NINE, Key(1, 1), LAYERED).seams[SeamKey(0, 1, 1)]
    plane, line = seam.surroundings, shapely.LineString(seam.xy)
    distance = shapely.distance(line, shapely.points(plane.xy[plane.triangles].mean(axis=1)))
    assert 18 < distance.max() <= 20
    rings = {xy.tobytes() for xy in seam.ring.xy[seam.ring.triangles]}
    assert rings < {xy.tobytes() for xy in plane.xy[plane.triangles]}


def test_wrong_seams_and_layers_are_refused() -> None:
    bounds = (0.0, 0.0, 60.0, 60.0)
    city = city_of([shapely.box(20, 20, 30, 40), shapely.box(30, 20, 40, 40)], [12.0, 22.0])
    dtm, ground = tilted_dtm(bounds), np.zeros(2)
    plane, _ = mesh_plane(bounds, city.polygons, mesh_size=10.0)
    removed = choose_layers(
        city.polygons, city.roof, ground, np.arange(2, dtype=np.int32), np.array([[0, 1]]), dtm, bounds, LAYERED
    )[0]
    assert removed.tolist() == [2, 4]
    levels = fill_layers(plane, dtm, city.roof, city.ids, removed, bounds, LAYERED)

    def mesh(seam: SeamColumns, removed: NDArray[np.int32] = removed, options: LayeredOptions = LAYERED) -> None:
        mesh_layers(plane, dtm, city, ground, bounds, options, removed=removed, seam=seam)

    everywhere = SeamColumns(np.arange(len(plane.xy), dtype=np.int32), levels)
    mesh(everywhere)
    with pytest.raises(ValueError, match="finite elements"):
        mesh(everywhere, options=replace(LAYERED, smoother="fem"))
    with pytest.raises(ValueError, match="lack"):
        mesh(everywhere, np.array([3, 4], np.int32))
    with pytest.raises(ValueError, match="share a layer"):
        mesh(everywhere, np.array([4, 4], np.int32))
    with pytest.raises(ValueError, match="has 13 levels, those of 6 layers"):
        mesh(everywhere, options=replace(LAYERED, layer_height=10.0))
    # A vertex in a house has no level for the ground.
    inside = int(np.flatnonzero((plane.xy == (30, 20)).all(axis=1))[0])
    lifted = SeamColumns(np.array([inside], np.int32), take_columns(levels, np.array([inside], np.int32)))
    lifted.levels.surfaces.building[0] = 7
    with pytest.raises(ValueError, match="lack"):
        mesh(lifted)
