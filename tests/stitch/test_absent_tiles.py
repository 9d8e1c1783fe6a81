"""Regions that are no box: tiles are absent, and towards them the region has a straight border."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.columns.columns import expand_cells
from stitch.pieces.conformity import compute_cell_volumes, pair_cell_faces, pair_edges
from stitch.tiling.grid import (
    Key,
    SeamKey,
    TileGrid,
    has_tile,
    is_border,
    make_grid,
    seam_keys,
    tile_box,
    tile_keys,
)
from tests.helpers.cities import Bounds
from tests.helpers.stitching import OPTIONS, Scene, glue, mesh_all, prove_seams, random_scene, select_houses

SQUARE: Bounds = (0.0, 0.0, 420.0, 420.0)
NINE = make_grid(SQUARE, tile_size=140.0, mesh_size=10.0)
SHAPES = {
    "a hole in the middle": ["###", "#.#", "###"],
    "an L": ["#..", "#..", "###"],
    "corner to corner": ["#.#", ".#.", "#.#"],
    "one tile": ["...", ".#.", "..."],
    "two rows apart": ["###", "...", "###"],
}


def grid_of(rows: list[str]) -> TileGrid:
    """Rows from north to south, as on a map."""
    present = np.array([[mark == "#" for mark in row] for row in rows[::-1]]).T
    return replace(NINE, present=present)


def region_of(grid: TileGrid) -> shapely.Geometry:
    return shapely.union_all([shapely.box(*tile_box(grid, key)) for key in tile_keys(grid)])


def inside(scene: Scene, region: shapely.Geometry) -> Scene:
    """The scene without the houses on the border, or beyond it."""
    core = shapely.buffer(region, -1.0, join_style="mitre")
    return select_houses(scene, np.flatnonzero(shapely.within(scene.model.polygons, core)))


def on_border(corners: NDArray[np.float64], grid: TileGrid) -> NDArray[np.bool_]:
    """Tell which upright faces lie on the nominal line of a seam at the border."""
    found = np.zeros(len(corners), np.bool_)
    for key in seam_keys(grid):
        if is_border(grid, key):
            line = grid.lines[1 - key.axis][key[2 - key.axis] - grid.first[1 - key.axis]]
            low, high = (grid.lines[key.axis][key[1 + key.axis] - grid.first[key.axis] + k] for k in (0, 1))
            along = corners[..., key.axis].mean(axis=1)
            found |= (corners[..., 1 - key.axis] == line).all(axis=1) & (along > low - 25) & (along < high + 25)
    return found


@pytest.mark.parametrize("name", SHAPES)
def test_regions_with_absent_tiles_are_one_mesh_with_straight_borders(name: str) -> None:
    grid = grid_of(SHAPES[name])
    region = region_of(grid)
    scene = inside(random_scene(SQUARE, 110, seed=7), region)
    tiles = mesh_all(scene, grid)
    assert len(tiles) == "".join(SHAPES[name]).count("#")
    assert prove_seams(tiles) == sum(not is_border(grid, key) for key in seam_keys(grid))
    mesh = glue([tile.mesh for tile in tiles.values()])
    faces = pair_cell_faces(mesh.cells, len(mesh.points))
    assert len(faces.same_side) == len(faces.shared) == len(pair_edges(faces.exterior).open) == 0
    corners = mesh.points[faces.exterior]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    upright = corners[np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) < 1e-4]
    rest = upright[~on_border(upright, grid)]
    walls = shapely.union_all(shapely.boundary(scene.model.polygons))
    assert (shapely.distance(walls, shapely.points(rest[..., :2].mean(axis=1))) < 1e-6).all()
    cells = [expand_cells(tile.mesh) for tile in tiles.values()]
    volume = sum(compute_cell_volumes(part.points, part.cells)[0].sum() for part in cells)
    ground = float(scene.dtm.z[0, 0])
    built = (shapely.area(scene.model.polygons) * (scene.model.roof - ground)).sum()
    np.testing.assert_allclose(volume, region.area * OPTIONS.domain_height - built, rtol=1e-10)


def test_what_the_grid_says_of_absent_tiles() -> None:
    grid = grid_of(["##.", "###", "###"])
    assert not has_tile(grid, Key(2, 2))
    assert not has_tile(grid, Key(-1, 0))
    assert not has_tile(grid, Key(3, 0))
    assert len(tile_keys(grid)) == 8
    assert is_border(grid, SeamKey(1, 2, 2))
    assert not is_border(grid, SeamKey(1, 2, 1))
    assert SeamKey(1, 3, 2) not in seam_keys(grid)
    assert len(seam_keys(grid)) == 24 - 2
