"""`python -m tests.benchmarks.roofs [--data FOLDER]`: how close roofs come to points, and what fitting them costs.

FOLDER has `tiles` and `footprints.gpkg`; without it, a town of sloped roofs made in code is measured alone. One
height a house, levels, and planes are measured, as parts and after simplification with a refit, then the full city
model, whose time is that of all: RMSE (m), median distance (m), and share of points within 0.2 and 0.25 m, of the
points at least 0.5 m inside outlines and of all; then the median over houses of RMSE and share within 0.2 m.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyogrio
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import has_building_class
from pipeline.city_model.city import CityOptions
from pipeline.city_model.city_steps import prepare_footprints
from pipeline.city_model.houses import FULL_CLEARANCE, FULL_PRICE
from pipeline.data.citymodel import Footprints
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roofs import Roofs, flat_roofs, roof_heights, take_roofs
from pipeline.geometry.inside import find_inside
from pipeline.roofs.house_levels import HouseParts, LevelOptions, split_levels
from pipeline.roofs.house_roofs import RoofOptions, fit_roofs
from pipeline.roofs.refit import refit_roofs
from pipeline.roofs.roof_points import RoofPoints, divide_roof_points, locate_roof_points, make_roof_points
from tests.helpers.cities import CITY_OPTIONS
from tests.helpers.sloped_roofs import town_of_slopes
from tests.helpers.whole_city import simplify_houses
from tests.helpers.whole_clouds import read_points
from tiler.pointclouds.clouds import find_clouds

INNER = 0.5  # m from an outline, within which points of façades count as roof points
EVERYWHERE = (-1e9, -1e9, 1e9, 1e9)
Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Town:
    """Houses and their roof points; the house of each, and its distance from the outline (m)."""

    polygons: NDArray[np.object_]
    points: RoofPoints
    house: Index
    inside: Array


def make_town(polygons: NDArray[np.object_], points: RoofPoints) -> Town:
    """Measure how far inside outlines the points are."""
    house = np.repeat(np.arange(len(polygons)), np.diff(points.start))
    walls = shapely.boundary(polygons)
    shapely.prepare(walls)
    return Town(polygons, points, house, shapely.distance(shapely.points(points.xyz[:, :2]), walls[house]))


def read_town(folder: Path, options: CityOptions) -> Town:
    """Read the houses that lie within the box of the points."""
    clouds = [read_points(path, EVERYWHERE)[0] for path in find_clouds([folder / "tiles"])]
    cloud = PointCloud(
        np.concatenate([part.xyz for part in clouds]), np.concatenate([part.classification for part in clouds])
    )
    _, _, blobs, _ = pyogrio.raw.read(folder / "footprints.gpkg", columns=[])
    raw = shapely.get_parts(shapely.force_2d(shapely.from_wkb(blobs)))
    ids = np.array([f"{i:06d}" for i in range(len(raw))])
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    region = shapely.box(low[0], low[1], high[0], high[1])
    clean, _ = prepare_footprints(Footprints(raw, ids, np.full(len(raw), np.nan)), region, options)
    marked = has_building_class(cloud)
    return make_town(clean.polygons, locate_roof_points(cloud, clean.polygons, building_class=marked))


def median_roofs(polygons: NDArray[np.object_], points: RoofPoints) -> Roofs:
    """Flat roofs at the median of the points of each polygon."""
    middle = [np.median(z) if len(z) else np.nan for z in np.split(points.z, points.start[1:-1])]
    return flat_roofs(np.array(middle)[: len(polygons)])


def points_of(town: Town, polygons: NDArray[np.object_]) -> tuple[Index, Index, RoofPoints]:
    """Polygon and row of each point inside polygons, and these points."""
    owner, point = find_inside(town.points.xyz, polygons)
    start = np.concatenate(([0], np.cumsum(np.bincount(owner, minlength=len(polygons)))))
    return owner, point, make_roof_points(start, town.points.xyz[point])


def describe(town: Town, point: Index, error: Array) -> str:
    """Columns of the table: of inner points, then of all."""
    cells = []
    for kept in (town.inside[point] >= INNER, np.ones(len(point), np.bool_)):
        off, house = np.abs(error[kept]), town.house[point[kept]]
        count = np.bincount(house)
        there = count > 0
        rmse = np.sqrt(np.bincount(house, off**2)[there] / count[there])
        near = np.bincount(house, off < 0.2)[there] / count[there]
        cells += [f"{np.sqrt(np.mean(off**2)):.2f}", f"{np.median(off):.3f}"]
        cells += [f"{np.mean(off < within):.3f}" for within in (0.2, 0.25)]
        cells += [f"{np.median(rmse):.2f}", f"{np.median(near):.3f}"]
    return " | ".join(cells)


def measure(town: Town, options: CityOptions, cut_price: float) -> None:
    """Print a line for each way to roof a town, and each stage."""
    whole = HouseParts(town.polygons, np.arange(len(town.polygons)))
    fitting = RoofOptions(clearance=options.clearance, cut_price=cut_price)

    def one_height() -> tuple[HouseParts, Roofs | None]:
        return whole, None

    def levels() -> tuple[HouseParts, Roofs | None]:
        return split_levels(town.polygons, town.points, LevelOptions(clearance=options.clearance)), None

    def planes() -> tuple[HouseParts, Roofs | None]:
        found, _ = fit_roofs(town.polygons, town.points, fitting)
        return found.parts, found.roofs

    def full_model() -> tuple[HouseParts, Roofs | None]:
        closer = min(FULL_CLEARANCE, options.clearance), FULL_PRICE * cut_price
        _, found = fit_roofs(town.polygons, town.points, fitting, closer)
        assert found is not None
        parts = found.parts
        points = divide_roof_points(town.points, parts.polygons, parts.house)
        return parts, refit_roofs(found.roofs, parts.polygons, points, max_slope=fitting.max_slope)

    ways: dict[str, Callable[[], tuple[HouseParts, Roofs | None]]] = {
        "one height": one_height,
        "levels": levels,
        "planes": planes,
        "full city model": full_model,
    }
    for name, way in ways.items():
        way()  # compiles
        begin = time.process_time()
        parts, roofs = way()
        cost = 1e3 * (time.process_time() - begin) / len(town.polygons)
        report(town, f"{name} ({cost:.1f} ms a house)", parts.polygons, roofs)
        if way is full_model:
            continue
        shapes = simplify_houses(parts, town.polygons, options)
        refitted = None
        if roofs is not None:
            points = points_of(town, shapes.polygons)[2]
            refitted = refit_roofs(
                take_roofs(roofs, shapes.member), shapes.polygons, points, max_slope=fitting.max_slope
            )
        report(town, f"{name}, simplified", shapes.polygons, refitted)


def report(town: Town, name: str, polygons: NDArray[np.object_], roofs: Roofs | None) -> None:
    """Print a line; roofs are medians by default."""
    owner, point, points = points_of(town, polygons)
    roofs = median_roofs(polygons, points) if roofs is None else roofs
    error = roof_heights(roofs, owner, town.points.xyz[point, :2]) - town.points.xyz[point, 2]
    print(f"| {name} | {len(polygons) / len(town.polygons):.2f} | {describe(town, point, error)} |", flush=True)


def thin(town: Town, density: float) -> Town:
    """Keep so many points a m², at random."""
    share = density * shapely.area(town.polygons).sum() / len(town.house)
    kept = np.random.default_rng(1).random(len(town.house)) < share
    start = np.searchsorted(town.house[kept], np.arange(len(town.polygons) + 1))
    return Town(town.polygons, make_roof_points(start, town.points.xyz[kept]), town.house[kept], town.inside[kept])


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description="How close roofs come to their points")
    parser.add_argument("--data", type=Path, action="append", default=[])
    parser.add_argument("--clearance", type=float, default=1.0)
    parser.add_argument("--cut-price", type=float, default=RoofOptions(clearance=1.0).cut_price)
    parser.add_argument("--thin", type=float, help="points a m² that are kept")
    given = parser.parse_args()
    options = replace(
        CITY_OPTIONS,
        roof_percentile=50.0,
        simplify="clearance",
        clearance=given.clearance,
        min_courtyard_area=5.0,
        split_levels=True,
        roof_group=2.5,
    )
    towns = {str(folder): read_town(folder, options) for folder in given.data}
    for name, town in {"sloped roofs": make_town(*town_of_slopes(160)), **towns}.items():
        used = thin(town, given.thin) if given.thin else town
        print(f"\n{name}: {len(town.polygons)} houses, {len(used.house)} points")
        columns = "RMSE | median | < 0.2 | < 0.25 | house RMSE | house < 0.2"
        print(f"| way | parts a house | inner {columns} | all {columns} |")
        measure(used, options, given.cut_price)


if __name__ == "__main__":
    main()
