"""Stages of the user's own in a run: the example of docs/stages.md, as printed."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from tiler.config.config import Config, make_config
from tiler.engine.stage import Scope, Stage
from tiler.interface.synth import write_city
from tiler.monitoring.status import read_status
from tiler.planning.own_stages import check_own
from tiler.store.results import StoredTerrain
from tiler.store.store import Store
from tiler.workflow.run import run

ROOT = Path(__file__).resolve().parents[3]
CELL = 2.0


@pytest.fixture(scope="module")
def example() -> Iterator[Any]:
    """The first Python block of the page, as a module."""
    code = (ROOT / "docs" / "stages.md").read_text().split("```python\n")[1].split("```")[0]
    module = ModuleType("canopy_example")
    sys.modules["canopy_example"] = module
    exec(compile(code, "docs/stages.md", "exec"), module.__dict__)
    yield module
    del sys.modules["canopy_example"]


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("canopy") / "city"
    write_city(folder, size=400, buildings=8, density=0.6, relief=6, seed=5)
    return folder


def config(city: Path, out: Path, tile_size: float) -> Config:
    values = {"pointcloud": [str(city / "tiles")], "footprints": str(city / "footprints.gpkg"), "out": str(out)}
    return make_config(values | {"tile_size": tile_size, "mesh_size": 14.0, "domain_height": 80.0})


def canopy_of(out: Path) -> tuple[NDArray[np.float64], int, int]:
    """Put the tiles together: heights, and the first column and row."""
    store = Store(out / "store.zarr")
    parts = []
    for name in store.names("canopy"):
        arrays, attributes = store.read("canopy", name)
        parts.append((attributes["facts"], arrays["height"]))
        assert attributes["facts"]["highest (m)"] == arrays["height"].max()
    i0, j0 = (min(facts[name] for facts, _ in parts) for name in ("i0", "j0"))
    ny = max(facts["j0"] - j0 + len(height) for facts, height in parts)
    nx = max(facts["i0"] - i0 + height.shape[1] for facts, height in parts)
    whole = np.full((ny, nx), np.nan)
    for facts, height in parts:
        i, j = facts["i0"] - i0, facts["j0"] - j0
        assert np.isnan(whole[j : j + height.shape[0], i : i + height.shape[1]]).all()
        whole[j : j + height.shape[0], i : i + height.shape[1]] = height
    return whole, i0, j0


def test_the_documented_stage_is_the_same_for_any_tiles(city: Path, tmp_path: Path, example: Any) -> None:
    found = {}
    for size in (200.0, 600.0):
        out = tmp_path / f"{size:g}"
        record = run(config(city, out, size), stages=[example.CANOPY], parameters={"canopy_cell": CELL})
        assert record["counts"]["tiles"] == len(Store(out / "store.zarr").names("canopy"))
        found[record["counts"]["tiles"]] = canopy_of(out)
        status = read_status(out)
        assert (status["command"], status["stages"]["canopy"]["done"]) == ("", record["counts"]["tiles"])
    (small, i0, j0), (large, *corner) = (found[n] for n in sorted(found, reverse=True))
    assert len(found) == 2
    assert corner == [i0, j0]
    assert small.tobytes() == large.tobytes()
    # The same from the files alone, without tiles.
    clouds = [laspy.read(path) for path in sorted((city / "tiles").iterdir())]
    xyz = np.concatenate([np.column_stack((cloud.x, cloud.y, cloud.z)) for cloud in clouds])
    kind = np.concatenate([np.asarray(cloud.classification) for cloud in clouds])
    trees = xyz[np.isin(kind, (3, 4, 5))]
    i, j = np.floor(trees[:, :2].T / CELL).astype(int) - np.array([[i0], [j0]])
    there = (i >= 0) & (j >= 0) & (i < large.shape[1]) & (j < large.shape[0])
    height = np.zeros(large.shape)
    ground = StoredTerrain(tmp_path / "200" / "store.zarr").sample(trees[there, :2])
    np.maximum.at(height, (j[there], i[there]), trees[there, 2] - ground)
    expected = maximum_filter(height, size=3)
    # Cells at the region's border may have trees beyond the last whole cell in their neighbourhood.
    inner = slice(1, -1)
    np.testing.assert_allclose(large[inner, inner], expected[inner, inner], atol=1e-9)
    assert 3 < large.max() < 50


def test_an_interrupted_stage_of_ones_own_goes_on(city: Path, tmp_path: Path, example: Any) -> None:
    """What failed was the user's stage: mended, it alone is run."""
    broken = Stage("canopy", Scope.TILE, divides, example.READS)
    out = tmp_path / "out"
    record = run(config(city, out, 600.0), stages=[broken])
    assert record["exit_code"] == 3
    assert record["missing"] == {}
    assert {found["stage"] for found in record["set_aside"]} == {"canopy"}
    assert all(found["reason"].startswith("ZeroDivisionError") for found in record["set_aside"])
    record = run(config(city, out, 600.0), stages=[example.CANOPY], parameters={"canopy_cell": CELL})
    assert "canopy" not in record["reused"]
    store = Store(out / "store.zarr")
    assert record["reused"] == {stage: len(store.names(stage)) for stage in store.stages() if stage != "canopy"}


def divides(_: Any) -> dict[str, Any]:
    return {"n": 1 // 0}


@pytest.mark.parametrize("name", ["terrain", "lakes", "near-7", "pieces"])
def test_names_of_ours_are_taken(name: str) -> None:
    with pytest.raises(ValueError, match=f"stage {name}: a stage of citystitch has such a name"):
        check_own(make_config({"pointcloud": ["a.laz"]}), [Stage(name, Scope.TILE, divides)], {})
    with pytest.raises(ValueError, match="parameter tile_size: the run has one of this name"):
        check_own(make_config({"pointcloud": ["a.laz"]}), [], {"tile_size": 3.0})
