"""What the report measures itself: against answers worked out by hand, and against the run's own stages."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely

from pipeline.columns.columns import expand_cells
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from pipeline.plane_mesh.surface_points import measure_surface
from pipeline.quality.histograms import quality_histograms
from pipeline.quality.quality import Quality, measure_cells
from pipeline.quality.residuals import conclude
from tests.helpers.columns import read_columns
from tiler.report import samples
from tiler.report.samples import NEAR, Samples, measure_samples
from tiler.store.store import Store


def ramp() -> ColumnMesh:
    """Two triangles over a square of 10 m; the ground rises by 0.1 m a metre of x, the first is a roof."""
    xy = np.array([[0.0, 0], [0, 10], [10, 0], [10, 10]])
    plane = PlaneMesh(xy, np.array([[0, 1, 2], [1, 2, 3]], np.int32), np.array([0, -1], np.int32))
    z = (xy[:, :1] * 0.1 + [0.0, 5.0, 20.0]).ravel()
    bottom = np.array([[1, 1, 1], [0, 0, 0]], np.int32)
    return ColumnMesh(plane, np.arange(0, 13, 3), z, bottom, "levels")


def test_points_are_measured_against_the_triangle_below_them() -> None:
    xyz = np.array([[2.0, 2.0, 1.2], [8.0, 9.0, 1.0], [5.0, 5.0, 0.5], [11.0, 2.0, 0.0], [9.0, 2.0, 0.9]])
    triangle, residual = measure_surface(ramp(), xyz)
    assert triangle.tolist() == [0, 1, 0, -1, 1]
    assert residual[[0, 1, 2, 4]] == pytest.approx([5.2 - 1.2, 0.8 - 1.0, 5.5 - 0.5, 0.9 - 0.9])
    assert np.isnan(residual[3])


def test_no_points_and_no_triangles_give_nothing() -> None:
    assert [len(found) for found in measure_surface(ramp(), np.empty((0, 3)))] == [0, 0]


def measure(out: Path) -> Samples:
    bounds = json.loads((out / "run.json").read_text())["region"]["bounds"]
    return measure_samples(out, tuple(bounds), ground_filter=False)


def test_the_mesh_has_the_points_that_the_city_model_has(small_run: Path) -> None:
    """Roofs of the mesh are those of the model, so the numbers are those of the run; the ground is triangles."""
    found, told = measure(small_run), json.loads((small_run / "run.json").read_text())["fidelity"]
    roof, ground = conclude(found.points["roof on roof"]), conclude(found.points["ground on ground"])
    assert roof.n == told["roof"]["n"]
    assert roof.rmse == pytest.approx(told["roof"]["rmse"], abs=2e-3)
    water = conclude(found.points["water on ground"])
    assert ground.n + water.n == told["ground"]["n"]
    assert told["ground"]["rmse"] < ground.rmse < 1.0
    assert (found.tiles, found.all_tiles) == (4, 4)


def test_cells_near_seams_are_those_of_a_search_through_all(small_run: Path) -> None:
    store = Store(small_run / "store.zarr")
    lines = []
    for name in store.names("seams"):
        arrays, attributes = store.read("seams", name, names=("xy",))
        if not attributes["facts"]["border"]:
            lines.append(shapely.LineString(arrays["xy"]))
    ratio = []
    for tile in store.names("columns"):
        mesh = expand_cells(read_columns(store, tile)[0])
        centre = mesh.points[mesh.cells, :2].mean(axis=1)
        near = shapely.dwithin(shapely.points(centre), shapely.union_all(lines), NEAR)
        ratio.append(measure_cells(mesh).radius_ratio[near])
    wanted = np.concatenate(ratio)
    found = measure(small_run).near["radius_ratio"]
    # Cells are chosen by their own centre there, by their triangle's here.
    assert found.counts.sum() == pytest.approx(len(wanted), rel=0.1)
    everywhere = quality_histograms(Quality(wanted, wanted, 1 + wanted))["radius_ratio"]
    shares = [counts.reshape(20, -1).sum(axis=1) / counts.sum() for counts in (found.counts, everywhere.counts)]
    assert np.abs(shares[0] - shares[1]).max() < 0.02


def test_of_many_tiles_some_are_looked_at(small_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "MOST_TILES", 2)
    monkeypatch.setattr(samples, "MOST_POINTS", 1000)
    found = measure(small_run)
    assert (found.tiles, found.all_tiles) == (2, 4)
    assert sum(sums.n for sums in found.points.values()) <= 2 * 1000


def test_one_tile_has_no_seams(small_run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(small_run, tmp_path / "run")
    store = Store(copy / "store.zarr")
    for name in store.names("columns"):
        arrays, attributes = store.read("columns", name)
        arrays |= {"edge_missing": np.ones(len(arrays["edge"]), np.bool_)}
        store.write("columns", name, arrays, key=attributes["key"], facts=attributes["facts"], notes=[])
    assert measure(copy).near == {}
