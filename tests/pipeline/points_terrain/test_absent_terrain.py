"""Terrain where no tile is: all tasks that compute a column see the same, however far each of them reads."""

from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import InputError
from pipeline.points_terrain.raster import Dtm, NodeWindow
from pipeline.points_terrain.terrain import cut_terrain
from pipeline.smoothing.ground_smoothing import lift_places
from stitch.tiling.grid import Bounds, Key, ends_of_seam
from tests.helpers.campaigns import rounds
from tests.helpers.cities import crowded_blocks, hilly_dtm
from tests.helpers.tiles import make_town, prove, run_of, write_town
from tiler.engine.run_context import seam_key
from tiler.store.store import Store

WEST, SOUTH, SIZE = 318_000.0, 6_399_000.0, 560.0  # m
DIAGONAL = [(0, 1), (1, 0)]


def write_sparse(folder: Path, *, files: int, gone: list[tuple[int, int]], seed: int = 1) -> dict[str, Any]:
    """Write a hilly town in files x files point clouds, but some."""
    region: Bounds = (WEST, SOUTH, WEST + SIZE, SOUTH + SIZE)
    town = make_town(region, crowded_blocks(region, 30, seed=seed), relief=12)
    return write_town(folder, town, files=(files, files), without=gone, spacing=1.5)


def corner_columns(out: Path) -> dict[Key, list[bytes]]:
    """Column of each corner, from all seams that end there."""
    store, found = Store(out / "store.zarr"), defaultdict(list)
    for name in sorted(store.names("seams")):
        arrays, attributes = store.read("seams", name)
        ends = ends_of_seam(seam_key(name))
        if not attributes["facts"]["border"]:
            start, z = arrays["level_start"], arrays["level_z"]
            found[ends[0]].append(z[start[0] : start[1]].tobytes())
            found[ends[1]].append(z[start[-2] : start[-1]].tobytes())
        for k, _ in attributes["facts"].get("pinched", []):
            found[ends[k]].append(arrays[f"end{k}_z"].tobytes())
    return dict(found)


def prove_sparse(values: dict[str, Any], out: Path, **others: Any) -> tuple[int, int]:
    """Run, and prove all of it; returns the numbers of absent tiles and of corners that several seams found."""
    record = run_of(values, out, domain_height=100.0, **others)
    corners = corner_columns(out)
    assert [tuple(key) for key, columns in corners.items() if len(set(columns)) > 1] == []
    prove(out)
    return len(record["region"]["absent"]), sum(len(columns) > 1 for columns in corners.values())


def test_seams_beside_absent_tiles_find_the_same_corners(tmp_path: Path) -> None:
    values = write_sparse(tmp_path / "town", files=2, gone=DIAGONAL)
    absent, corners = prove_sparse(values, tmp_path / "out", tile_size=157.5, mesher="layered")
    assert absent > 0
    assert corners > 4


def test_a_place_beside_absent_tiles_depends_on_its_own_window_alone() -> None:
    bounds = (0.0, 0.0, 1000.0, 1000.0)
    dtm = hilly_dtm(bounds, relief=40.0, length=80.0)
    dtm.z[:, 500:700] = np.nan
    xy = np.array([[480.0, 420.0]])
    lift = partial(lift_places, region=bounds, domain_height=60.0, n_layers=12, grid_spacing=10.0)
    window = NodeWindow(290, 230, 400, 400)
    near = Dtm(dtm.z[230:630, 290:690].copy(), 290, 230, 1.0)
    far = lift(dtm, xy)
    assert np.isfinite(far).all()
    assert lift(near, xy).tobytes() == far.tobytes()
    # What is filled within the window is not what a wider one would give.
    assert (cut_terrain(dtm, window).z != cut_terrain(dtm, NodeWindow(0, 0, 1001, 1001)).z[230:630, 290:690]).any()


def test_a_window_without_any_tile_is_an_error() -> None:
    dtm = Dtm(np.array([[1.0, np.nan, np.nan]]), 0, 0, 1.0)
    with pytest.raises(InputError, match="none of the 2 nodes has a ground point"):
        cut_terrain(dtm, NodeWindow(1, 0, 2, 1))


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "mesher"), rounds([(0, "adaptive"), (1, "layered")], [(2, "adaptive"), (3, "layered")])
)
def test_any_tiles_may_be_absent(seed: int, mesher: str, tmp_path: Path) -> None:
    """Tile sizes and sets of absent files: four in a square and three others, off most tiles' lines."""
    rng = np.random.default_rng([seed, 5])
    a, b = rng.integers(0, 3, 2).tolist()
    square = [(a + i, b + j) for i in range(2) for j in range(2)]
    gone = [*square, *(divmod(k, 4) for k in rng.integers(0, 16, 3).tolist())]
    values = write_sparse(tmp_path / "town", files=4, gone=gone, seed=seed)
    absent = 0
    for k, size in enumerate([140.0, round(float(rng.uniform(140, 180)), 1), 141.5]):
        absent += prove_sparse(values, tmp_path / f"out{k}", tile_size=size, mesher=mesher)[0]
    assert absent > 0
