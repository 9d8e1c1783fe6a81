"""A town scanned in strips: points on true surfaces, empty shadows, and boxes with the points of the whole."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import laspy
import numpy as np
import pytest
import shapely

from pipeline.architecture.heights import house_heights
from pipeline.architecture.parameters import House
from pipeline.architecture.scanner import FLIGHT, FORWARD, SPACING
from pipeline.data.errors import ConfigError
from pipeline.data.pointcloud import PointCloud
from tiler.towns.parameter_files import read_json
from tiler.towns.styles import LOWEST
from tiler.towns.town import make_output, open_town, write_houses, write_town
from tiler.towns.town_scan import Scan, describe_truth, scan_strips
from tiler.towns.town_tile import ModelOptions

TOWN = open_town(100.0, "detached", rules=None, seed=5, relief=12, trees=0.6, water=0.15)


def join(parts: Iterable[Scan]) -> Scan:
    """All parts of a scan."""
    clouds, fields = zip(*parts, strict=True)
    xyz, classes = (np.concatenate([getattr(one, name) for one in clouds]) for name in ("xyz", "classification"))
    return Scan(
        PointCloud(xyz, classes), {name: np.concatenate([one[name] for one in fields]) for name in fields[0]}
    )


def test_points_lie_on_what_the_scanner_sees() -> None:
    houses, trees = list(TOWN.houses(TOWN.bounds)), list(TOWN.plants(TOWN.bounds))
    scan = join(scan_strips(TOWN, TOWN.bounds, houses, trees, density=3.0, errors=0.0))
    (x, y, z), classes = scan.cloud.xyz.T, scan.cloud.classification

    def seen(town: list[House], east: np.ndarray, north: np.ndarray) -> np.ndarray:
        places = np.column_stack((east, north))
        return np.asarray(np.fmax.reduce([house_heights(house, places) for house in town]))

    roof, ground = seen(houses, x, y), np.asarray(TOWN.ground(x, y))
    off = z - np.fmax(roof, ground)
    on_roof = (classes == 6) & np.isfinite(roof)
    assert np.abs(off[classes == 2][np.isnan(roof[classes == 2])]).max() < 0.3
    assert np.mean(np.abs(off[on_roof]) < 0.2) > 0.8  # the others are below overhangs: on walls
    facade = on_roof & (off < -1.0)
    assert facade.sum() > 50
    assert np.mean(z[classes == 6] > ground[classes == 6] - 0.3) == 1
    assert not (ground[classes == 2] < TOWN.water_level - 0.1).any()
    # What is above a point on its way to the sensor is no house: shadows are empty.
    low = (classes == 2) & (scan.fields["number_of_returns"] == 1)
    strip = scan.fields["point_source_id"].astype(int)
    bare = [replace(house, roof=replace(house.roof, overhang=0.0)) for house in houses]
    blocked = np.zeros(low.sum(), bool)
    for up in np.arange(0.6, 14.0, 0.4):
        h = z[low] - LOWEST
        sensor, tilt = (strip[low] + 0.5) * SPACING, np.where(strip[low] % 2, FORWARD, -FORWARD)
        east = x[low] + (sensor - x[low]) / (FLIGHT - h) * up
        blocked |= np.nan_to_num(seen(bare, east, y[low] + tilt * up)) > z[low] + up + 0.4
    assert blocked.mean() < 1e-3  # 0.05 without shadows
    returns, number = scan.fields["number_of_returns"], scan.fields["return_number"]
    assert (number <= returns).all()
    assert 0.005 < np.mean(returns > 1) < 0.2
    assert (classes == 5).sum() > 30
    # A box has the points of the whole, and wrong classes are as many as asked for.
    west, south, _, north = TOWN.bounds
    half = (west, south, west + 55.0, north)
    part = join(scan_strips(TOWN, half, houses, trees, density=3.0, errors=0.1))
    np.testing.assert_array_equal(part.cloud.xyz, scan.cloud.xyz[x < west + 55.0])
    assert np.mean(part.cloud.classification != classes[x < west + 55.0]) == pytest.approx(0.1, abs=0.01)


def test_truth_has_the_planes_of_the_roof() -> None:
    house = max(TOWN.houses(TOWN.bounds), key=lambda house: len(house.dormers))
    told = describe_truth(house)
    x0, y0 = told["origin"]
    for plane in told["planes"][: told["main"]]:
        a, b, c = plane["plane"]
        for x, y, z in plane["ring"]:
            assert a * (x - x0) + b * (y - y0) + c == pytest.approx(z, abs=0.005)
    assert len(told["planes"]) > told["main"] + len(house.parts)
    rings = [[place[:2] for place in plane["ring"]] for plane in told["planes"][: told["main"]]]
    assert shapely.area(shapely.polygons(rings)).sum() == pytest.approx(house.length * house.width, rel=0.01)
    tops = [z for plane in told["planes"][: told["main"]] for *_, z in plane["ring"]]
    assert max(tops) == pytest.approx(told["ridge"], abs=0.002)
    assert min(tops) == pytest.approx(told["eaves"], abs=0.002)


def test_what_a_flight_cannot_scan_is_told(tmp_path: Path) -> None:
    for change, told in (({"relief": 200.0}, "--relief 200 m hides ground"), ({"lidar": -1.0}, "--lidar -1")):
        town = replace(TOWN, relief=change.get("relief", 0.0))
        lidar = change.get("lidar", 1.0)
        with pytest.raises(ConfigError, match=told):
            write_town(tmp_path / "t", town, make_output(ModelOptions(), truth=True), density=0.0, lidar=lidar)


def test_parameters_are_scanned_as_the_town_is(tmp_path: Path) -> None:
    west, south = 317_955.0, 6_398_970.0
    town = open_town(60.0, "wings", rules=None, seed=5, relief=12)
    town = replace(town, bounds=(west, south, west + 90.0, south + 60.0))  # on both sides of a border of tiles
    output = make_output(ModelOptions(("1.2",)), truth=True)
    drawn = write_town(tmp_path / "drawn", town, output, density=0.0, lidar=1.0)
    houses = partial(read_json, drawn.parameters)
    given = write_houses(tmp_path / "given", houses, output, town=town, lidar=1.0)
    assert len(given.clouds) > 1
    assert given.houses == drawn.houses > 1
    for one, other in ((drawn.parameters, given.parameters), (drawn.truth, given.truth)):
        assert one.read_bytes() == other.read_bytes()
    points, more = (np.concatenate([laspy.read(path).xyz for path in each.clouds]) for each in (drawn, given))
    west, south, east, north = town.bounds
    inside = (more[:, 0] >= west) & (more[:, 0] < east) & (more[:, 1] >= south) & (more[:, 1] < north)
    np.testing.assert_array_equal(np.unique(points, axis=0), np.unique(more[inside], axis=0))
    assert not (tmp_path / "given/part-given").exists()


@pytest.mark.long
def test_workers_make_the_same_bytes(tmp_path: Path) -> None:
    town = replace(TOWN, bounds=(317_900.0, 6_398_900.0, 318_100.0, 6_399_100.0))  # four tiles
    for name, workers in (("one", 0), ("two", 2)):
        write_town(
            tmp_path / name, town, make_output(ModelOptions(), truth=True), density=0.0, lidar=1.0, workers=workers
        )
    houses = partial(read_json, tmp_path / "one/parameters.jsonl")
    for name, workers in (("three", 0), ("four", 2)):
        output = make_output(ModelOptions(), truth=True)
        write_houses(tmp_path / name, houses, output, town=town, lidar=1.0, workers=workers)
    for first, second in (("one", "two"), ("three", "four")):
        files = sorted(path for path in (tmp_path / first).rglob("*") if path.is_file())
        assert len(files) == 5 + 4
        for path in files:
            other = tmp_path / second / path.relative_to(tmp_path / first)
            assert path.read_bytes() == other.read_bytes(), path
