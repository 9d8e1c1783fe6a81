"""A run that was given footprints and meshes no building fails, and says what was seen and what to do."""

import json
from pathlib import Path

import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from numpy.typing import NDArray

from tests.helpers.bad_input import HOUSE, call, quick_run, write_city
from tests.helpers.cities import Bounds
from tiler.planning.region import Region
from tiler.vectors.layers import Layer
from tiler.workflow.empty_run import find_place

Capture = pytest.CaptureFixture[str]
TO_DEGREES = pyproj.Transformer.from_crs("EPSG:3006", "EPSG:4326", always_xy=True)


def swap(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return xy[:, ::-1]


def to_degrees(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack(TO_DEGREES.transform(*xy.T))


def far(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    moved: NDArray[np.float64] = xy + np.array([50_000.0, 0.0])
    return moved


WAYS = {
    "x and y exchanged": ((swap,), "EPSG:3006", "With x and y exchanged they lie in the region"),
    "latitude first": ((to_degrees, swap), "EPSG:4326", "With x and y exchanged they lie in the region"),
    "degrees without a CRS": ((to_degrees,), None, "Taken as degrees they lie in the region"),
    "latitude first without a CRS": ((to_degrees, swap), None, "Taken as degrees, latitude first"),
    "another place": ((far,), "EPSG:3006", "check --crs"),
}


def write_moved(path: Path, way: str) -> None:
    """Write the house where it is not."""
    steps, crs, _ = WAYS[way]
    moved = HOUSE
    for step in steps:
        moved = shapely.transform(moved, step)
    pyogrio.raw.write(
        path,
        geometry=np.array([shapely.to_wkb(moved)], object),
        field_data=[np.array(["a"], object)],
        fields=["id"],
        geometry_type="Polygon",
        crs=crs,
        driver="GPKG",
    )


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
@pytest.mark.parametrize("way", WAYS)
def test_footprints_elsewhere_end_the_run_with_one(tmp_path: Path, capsys: Capture, way: str) -> None:
    city = write_city(tmp_path / "city")
    write_moved(city / "moved.gpkg", way)
    command = [*quick_run(city, city / "out", "moved.gpkg"), "-q"]
    found = call(capsys, *command)
    assert found.code == 1
    assert found.err.startswith("citystitch: no building was meshed. ")
    assert "has 1 feature, none of them in the region" in found.err
    assert WAYS[way][2] in found.err
    assert "--allow-empty" in found.err
    assert found.err.count("\n") == 1
    record = json.loads((city / "out" / "run.json").read_text())
    assert (record["status"], record["exit_code"]) == ("failed", 1)
    assert record["empty"] == record["error"]
    assert (city / "out" / "mesh.pvtu").is_file()  # for a look


def test_what_was_dropped_is_told(tmp_path: Path, capsys: Capture) -> None:
    city = write_city(tmp_path / "city")
    command = quick_run(city, city / "out")
    found = call(capsys, *command, "--min-building-area", "100000")
    assert found.code == 1
    assert "1 of them in the region" in found.err
    assert "1 footprint smaller than --min-building-area was dropped" in found.err
    # The same folder goes on once that is mended.
    assert call(capsys, *command).code == 0


def test_an_empty_mesh_is_taken_where_it_is_allowed(tmp_path: Path, capsys: Capture) -> None:
    city = write_city(tmp_path / "city")
    command = [*quick_run(city, city / "out", ""), "--min-building-area", "100000"]
    assert call(capsys, *command, "--footprints", city / "house.gpkg", "--allow-empty").code in (0, 3)
    assert call(capsys, *command).code == 0  # without footprints it is terrain, and meant to be


def test_the_place_of_a_layer_without_extent_is_not_known() -> None:
    bounds: Bounds = (0.0, 0.0, 100.0, 100.0)
    layer = Layer(Path("a.parquet"), "", None, (), 3, None)
    assert find_place(layer, Region(bounds, "EPSG:3006", 100.0)).startswith("The file does not say where they lie")


def test_footprints_with_the_numbers_of_the_region_in_another_crs_name_that_crs() -> None:
    layer = Layer(
        Path("a.gpkg"), "a", pyproj.CRS("EPSG:25831"), (), 3, (629_400.0, 5_803_950.0, 629_500.0, 5_804_000.0)
    )
    region = Region((629_353.0, 5_803_892.0, 629_552.0, 5_804_091.0), "EPSG:25832", 500.0)
    assert find_place(layer, region).endswith("may be that of the footprints: --crs EPSG:25831")
