"""Cities with roofs of all types, run in tiles: they are proved, and bytes depend on no region or worker."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.mesh import Marker
from stitch.tiling.grid import Bounds
from tests.helpers.campaigns import keep_outcome, rounds
from tests.helpers.cities import crowded_blocks
from tests.helpers.tiles import X, Y, around, box, make_town, prove, put_roofs, run_of, terraces, write_town
from tiler.mesh_files.vtk_files import read_vtp

SIZE, MESH = 84.0, 6.0  # least tile for cells of 6 m
TILE = (3786, 76179)
WITH_WORKERS = range(0, 50, 13)


def mesh_bytes(out: Path) -> dict[str, bytes]:
    """All that a run wrote of the mesh: pieces of volume and boundary."""
    files = sorted([*(out / "mesh").iterdir(), *(out / "boundary").iterdir()])
    assert files
    return {f"{path.parent.name}/{path.name}": path.read_bytes() for path in files}


def sloped_terraces(folder: Path, region: Bounds, *, seed: int) -> dict[str, Any]:
    """Terraces with roofs of all types, in cells of 6 m."""
    town = put_roofs(make_town(region, terraces(region, seed=seed), relief=15, seed=seed), seed=seed)
    values = {"roofs": "planes", "tile_size": SIZE, "mesh_size": MESH, "domain_height": 40.0}
    return write_town(folder, town, files=(2, 1)) | values


def test_a_sloped_town_in_tiles_is_proved(tmp_path: Path) -> None:
    west, south, _, _ = around(TILE, 0, size=SIZE)
    values = sloped_terraces(tmp_path / "city", box(2 * SIZE, 2 * SIZE, west=west, south=south), seed=4)
    record = run_of(values, tmp_path / "out")
    prove(tmp_path / "out")
    assert record["counts"]["tiles"] == 4
    pieces = [read_vtp(path) for path in (tmp_path / "out" / "boundary").iterdir()]
    tilted = 0
    for piece in pieces:
        z = piece.points[piece.boundary.facets[piece.boundary.marker == Marker.ROOF]][..., 2]
        tilted += int((np.ptp(z, axis=1) > 0.5).sum())
    assert tilted > 100


@pytest.mark.long
def test_a_tile_of_sloped_roofs_depends_on_its_surroundings_alone(tmp_path: Path) -> None:
    values = sloped_terraces(tmp_path / "city", around(TILE, 2, size=SIZE), seed=5)
    name = f"{TILE[0]}_{TILE[1]}"
    run_of(values, tmp_path / "large")
    run_of(values | {"bounds": around(TILE, 1, size=SIZE)}, tmp_path / "small")
    large, small = mesh_bytes(tmp_path / "large"), mesh_bytes(tmp_path / "small")
    assert len(large) == 50
    assert len(small) == 18
    for file in (f"mesh/{name}.vtu", f"boundary/{name}.vtp"):
        assert small[file] == large[file], file


@pytest.mark.long
@pytest.mark.parametrize("seed", rounds(range(2), range(2, 50)))
def test_random_sloped_cities_are_meshed_and_proved(tmp_path: Path, seed: int) -> None:
    """Rows and blocks of any density and relief in 9 to 25 tiles, from files to files."""
    rng = np.random.default_rng([seed, 3])
    tile_size = float(rng.integers(60, 121))
    mesh_size = tile_size / float(rng.uniform(14, 15))
    across = rng.uniform(2.95, 3.95, 2) * tile_size
    west, south = X + float(rng.integers(500)), Y + float(rng.integers(500))
    region = box(*np.rint(across).tolist(), west=west, south=south)
    if rng.random() < 0.5:
        houses = terraces(region, seed=seed, angle=float(rng.uniform(0, 90)))
        keep = rng.random(len(houses)) < min(1.0, 150 / len(houses))
        houses = [house for house, kept in zip(houses, keep, strict=True) if kept]
    else:
        n = int(rng.uniform(300, 1200) * across.prod() / 1e6)
        houses = crowded_blocks(region, n, seed=seed, clearance=float(rng.choice([0.0, 0.2, 1.0])))
    town = put_roofs(make_town(region, houses, relief=float(rng.uniform(0, 40)), seed=seed), seed=seed)
    files = tuple(rng.integers(1, 4, 2).tolist())
    values = write_town(tmp_path / "city", town, files=files, spacing=float(rng.uniform(0.45, 1.0))) | {
        "roofs": "planes",
        "tile_size": tile_size,
        "mesh_size": mesh_size,
        "domain_height": 40.0,
        "border": str(rng.choice(["drop", "clip"])),
        "manifold": bool(rng.random() < 0.2),
    }
    record = run_of(values, tmp_path / "out")
    counts = record["counts"]
    assert 9 <= counts["tiles"] <= 25
    assert counts["buildings"] > 0
    if seed in WITH_WORKERS:
        run_of(values, tmp_path / "two", workers=2)
        assert mesh_bytes(tmp_path / "two") == mesh_bytes(tmp_path / "out")
    prove(tmp_path / "out")
    quality = record["quality"]
    keep_outcome(
        "sloped",
        seed=seed,
        **{what: counts[what] for what in ("tiles", "buildings", "cells")},
        radius_ratio={share: quality["radius_ratio"][share] for share in ("0", "0.1", "1", "50")},
        least_dihedral=quality["min_dihedral"]["0"],
    )
