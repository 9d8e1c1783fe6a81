"""The synthetic city: same seed same bytes, and what the readers get back is what was made."""

import hashlib
import json
import time
from datetime import date
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
import shapely

from pipeline.data.errors import ConfigError
from pipeline.points_terrain.synthetic import ORIGIN, SyntheticCity, city_points, make_city, terrain_height
from tests.helpers.footprint_reading import read_footprint_crs, read_footprints
from tests.helpers.whole_clouds import read_points
from tiler.config.config import Config
from tiler.interface.synth import SynthFiles, write_city
from tiler.planning.establish_georeference import establish_georeference
from tiler.pointclouds.clouds import find_clouds, read_header

SWEREF = pyproj.CRS("EPSG:3006")
X, Y = ORIGIN


def city(**changes: Any) -> SyntheticCity:
    return make_city(**{"size": 400.0, "buildings": 80, "density": 1.5, "relief": 20.0, "seed": 1, **changes})


def box(size: float) -> tuple[float, float, float, float]:
    return X, Y, X + size, Y + size


def hashes(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SynthFiles]:
    folder = tmp_path_factory.mktemp("city")
    return folder, write_city(folder, size=800, buildings=200, density=0.5)


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    first = tmp_path / "first"
    city: Any = {"size": 600, "buildings": 60, "density": 0.1}
    write_city(first, **city)
    time.sleep(1.1)  # a clock in a file would show
    write_city(tmp_path / "again", **city | {"workers": 1})
    write_city(tmp_path / "other", **city, seed=2)
    ours, again, other = hashes(first), hashes(tmp_path / "again"), hashes(tmp_path / "other")
    assert ours == again
    assert ours.keys() == other.keys()
    differ = {name for name in ours if ours[name] != other[name]}
    same = {"footprints.cpg", "footprints.prj", "footprints.dbf", "footprints.shx"}
    assert set(ours) - differ <= same
    write_city(first, **city)
    assert hashes(first) == ours


def test_the_readers_get_back_what_was_made(written: tuple[Path, SynthFiles]) -> None:
    folder, files = written
    made = city(size=800.0, buildings=200, density=0.5)
    assert find_clouds([folder / "tiles"]) == files.clouds
    with laspy.open(files.clouds[0]) as reader:
        assert reader.header.creation_date == date(2022, 1, 1)  # not today
    assert [path.name for path in files.clouds] == [
        f"{x}_{y}.laz" for x in (318000, 318400) for y in (6399000, 6399400)
    ]
    headers = [read_header(path) for path in files.clouds]
    found = establish_georeference(Config(), headers, read_footprint_crs(files.footprints), None)
    assert (found.crs, found.messages) == (SWEREF, [])
    bounds = box(800)
    for path in (files.footprints, files.shapefile):
        footprints, notes = read_footprints(path, crs=SWEREF, bounds=bounds)
        assert notes == ()
        assert footprints.ids.tolist() == made.ids.tolist()
        same = shapely.equals_exact(shapely.normalize(footprints.polygons), shapely.normalize(made.polygons), 1e-9)
        assert same.all()
    cloud, counts = read_points(files.clouds[0], bounds)
    part = city_points(made, (X, Y, X + 400, Y + 400), (0, 0))
    kept = ~np.isin(part.classification, (7, 18))
    np.testing.assert_allclose(cloud.xyz, part.xyz[kept], atol=0.00501)
    np.testing.assert_array_equal(cloud.classification, part.classification[kept])
    assert counts["noise"] == np.count_nonzero(~kept) > 10


def test_truth_is_what_the_points_show(written: tuple[Path, SynthFiles]) -> None:
    _, files = written
    truth = json.loads(files.truth.read_text())
    assert len(truth["buildings"]) == truth["n_buildings"] == 200
    assert truth["bounds"] == list(box(800))
    made = city(size=800.0, buildings=200, density=0.5)
    clear = np.bincount(shapely.STRtree(made.polygons).query(made.polygons, "intersects")[0]) == 1
    xyz = np.concatenate([read_points(path, box(800))[0].xyz for path in files.clouds])
    inner = shapely.buffer(made.polygons, -0.1)
    house, point = shapely.STRtree(shapely.points(xyz[:, :2])).query(inner, "contains")
    seen = [np.median(xyz[point[house == row], 2]) for row in np.flatnonzero(clear)]
    told = [entry["roof"] for entry, free in zip(truth["buildings"], clear, strict=True) if free]
    np.testing.assert_allclose(seen, told, atol=0.05)


def test_buildings_touch_and_overlap() -> None:
    made = city()
    assert shapely.is_valid(made.polygons).all()
    assert len(made.polygons) == len(set(made.ids.tolist())) == 80
    assert shapely.contains(shapely.box(*box(400)), made.polygons).all()
    i, j = shapely.STRtree(made.polygons).query(made.polygons, predicate="intersects")
    i, j = i[i < j], j[i < j]
    common = shapely.intersection(made.polygons[i], made.polygons[j])
    touching = shapely.area(common) == 0
    assert np.count_nonzero(touching) == 6  # 8 pairs in a hundred
    assert (shapely.length(common[touching]) > 1).all()  # along a wall
    assert np.count_nonzero(~touching) == 1  # 2 in a hundred
    assert shapely.area(common[~touching])[0] > 1
    n_corners = shapely.get_num_coordinates(made.polygons) - 1
    assert set(n_corners.tolist()) == {4, 6}


def test_heights_and_relief() -> None:
    made = city(relief=35.0)
    height = made.roof - made.ground
    assert 5 <= height.min() < 10
    assert 35 < height.max() <= 40
    x, y = (side.ravel() for side in np.meshgrid(*[np.linspace(0, 400, 201)] * 2))
    z = terrain_height(made, x + X, y + Y)
    assert z.max() - z.min() == pytest.approx(35, rel=0.1)
    angle, (x0, y0, radius, level) = np.linspace(0, 2 * np.pi, 99), made.pond
    for share, reach in ((0.0, 0.0), (0.9, 0.0), (1.001, 1e-3)):  # of the radius; above the level
        shore = share * radius * np.column_stack((np.cos(angle), np.sin(angle))) + (x0, y0)
        assert np.abs(terrain_height(made, *shore.T) - level).max() <= reach
    slope = np.hypot(*np.gradient(z.reshape(201, 201), 2.0))
    assert slope.max() < 1.5  # no cliff, also not at the pond
    assert np.ptp(terrain_height(city(relief=0.0), x + X, y + Y)) < 1e-9


def test_classes_lie_where_they_belong() -> None:
    made = city(size=500.0)
    cloud = city_points(made, box(500), (0, 0))
    x, y, z = cloud.xyz.T
    classes = cloud.classification
    share = np.bincount(classes, minlength=19) / len(classes)
    assert set(np.flatnonzero(share)) == {1, 2, 5, 6, 7, 9, 18}
    assert 0.03 < share[5] < 0.05
    assert share[7] < 0.002
    assert len(x) == pytest.approx(1.5 * 500**2, rel=0.01)
    above = z - terrain_height(made, x, y)
    assert above[classes == 2].std() == pytest.approx(0.03, rel=0.05)
    assert above[classes == 9].std() == pytest.approx(0.03, rel=0.2)
    assert 0 < above[classes == 5].min() < above[classes == 5].max() < 4.5
    assert above[classes == 7].max() < -20
    assert above[classes == 18].min() > 100
    built = shapely.union_all(made.polygons)
    inside = shapely.contains_xy(built, x, y)
    assert inside[classes == 6].all()
    assert not inside[np.isin(classes, (1, 2, 5, 9))].any()


def test_where_buildings_overlap_the_higher_roof_is_seen() -> None:
    made = city(density=20.0)
    i, j = shapely.STRtree(made.polygons).query(made.polygons, predicate="overlaps")
    common = shapely.intersection(made.polygons[i[0]], made.polygons[j[0]])
    cloud = city_points(made, tuple(shapely.bounds(common)), (0, 0))
    x, y, z = cloud.xyz[cloud.classification == 6].T
    seen = z[shapely.contains_xy(common, x, y)]
    assert len(seen) > 20
    np.testing.assert_allclose(seen, max(made.roof[i[0]], made.roof[j[0]]), atol=0.3)


@pytest.mark.parametrize("buildings", [0, 1, 2, 4, 7])
def test_small_numbers(buildings: int) -> None:
    for seed in range(20):
        made = city(size=60.0, buildings=buildings, seed=seed)
        assert len(made.polygons) == len(made.roof) == buildings
        assert len(city_points(made, box(60), (0, 0)).xyz) > 3000


def test_a_dense_city_has_room() -> None:
    assert len(city(size=500.0, buildings=2000).polygons) == 2000  # as 50,000 on 6.25 km2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"buildings": 100_000}, r"100000 buildings do not fit on 400 m x 400 m; ask for at most 3317"),
        ({"buildings": -1}, "buildings -1"),
        ({"size": 0.0}, "size 0"),
        ({"size": float("nan")}, "size nan"),
        ({"density": -1.0}, "density -1"),
        ({"relief": float("nan")}, "relief nan"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_impossible_cities_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        city(**changes)
    with pytest.raises(ConfigError, match=message):
        write_city(tmp_path, **{"size": 400.0, "buildings": 80, **changes})
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_other_clouds_is_refused(tmp_path: Path) -> None:
    write_city(tmp_path, size=100, buildings=3, density=0.1)
    (tmp_path / "tiles" / "other.laz").touch()
    before = hashes(tmp_path)
    with pytest.raises(ConfigError, match=r"other\.laz: is not of this city"):
        write_city(tmp_path, size=100, buildings=4, density=0.1)
    assert hashes(tmp_path) == before


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        write_city(tmp_path / "file" / "city", size=100, buildings=3, density=0.1)
