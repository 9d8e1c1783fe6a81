"""Seams: tiles meshed alone are one mesh when glued, and depend on their halo alone."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from stitch.grid import Key, make_grid
from tests.cities import Bounds, tilted_dtm
from tests.stitching import (
    glue,
    mesh_all,
    mesh_alone,
    mesh_bytes,
    prove_glued,
    prove_seams,
    prove_volume,
    random_scene,
    scene_of,
    select_houses,
)

SQUARE: Bounds = (0.0, 0.0, 420.0, 420.0)


def test_open_ground_is_cut_straight_and_glued() -> None:
    scene = scene_of([], [], tilted_dtm(SQUARE, height=5.0))
    grid = make_grid(SQUARE, tile_size=210.0, mesh_size=10.0)
    tiles = mesh_all(scene, grid)
    assert prove_seams(tiles) == 4
    prove_glued(glue([tile.mesh for tile in tiles.values()]), scene, SQUARE)
    prove_volume(tiles, scene, SQUARE)


@pytest.mark.parametrize("seed", range(8))
def test_random_cities_are_one_mesh(seed: int) -> None:
    scene = random_scene(SQUARE, 40 + 20 * seed, seed=seed, relief=20.0 * (seed % 3))
    grid = make_grid(SQUARE, tile_size=140.0, mesh_size=10.0)
    tiles = mesh_all(scene, grid)
    assert prove_seams(tiles) == 12
    prove_glued(glue([tile.mesh for tile in tiles.values()]), scene, SQUARE)
    if seed % 3 == 0:
        prove_volume(tiles, scene, SQUARE)


def test_a_tile_is_the_same_alone_and_in_a_larger_region() -> None:
    bounds, inner = (0.0, 0.0, 560.0, 560.0), (70.0, 70.0, 490.0, 490.0)
    scene = random_scene(bounds, 220, seed=3, relief=15.0)
    crossing = shapely.intersects(scene.model.polygons, shapely.box(*inner).exterior)
    scene = select_houses(scene, np.flatnonzero(~crossing))
    within = select_houses(scene, np.flatnonzero(shapely.within(scene.model.polygons, shapely.box(*inner))))
    assert len(within.model) < len(scene.model)
    large, small = (make_grid(box, tile_size=140.0, mesh_size=10.0) for box in (bounds, inner))
    # The small region's outer tiles are half as wide; the two by two within touch its border nowhere.
    for tile in (Key(1, 1), Key(2, 2)):
        alone = mesh_bytes(mesh_alone(scene, large, tile).mesh)
        assert mesh_bytes(mesh_alone(scene, large, tile, clip=False).mesh) == alone
        in_small = mesh_alone(within, small, tile)
        names = np.append(within.model.ids, "")
        mesh = in_small.mesh
        rows = np.searchsorted(scene.model.numbers, np.append(within.model.numbers, -1)).astype(np.int32)
        rows[-1] = -1
        assert (np.append(scene.model.ids, "")[rows] == names).all()
        plane = replace(mesh.plane, building=rows[mesh.plane.building])
        assert mesh_bytes(replace(mesh, plane=plane)) == alone
