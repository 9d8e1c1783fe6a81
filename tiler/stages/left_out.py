"""Stage of the footprints of each tile that no building of the mesh stands for: area, building points, height."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import reach_of_points
from pipeline.city_model.city import City, CityOptions, measure_heights
from pipeline.city_model.city_steps import measure_city
from pipeline.city_model.footprints import clean_footprints
from pipeline.city_model.houses import divide_houses
from pipeline.data.citymodel import Footprints
from pipeline.data.classes import BUILDING, GROUND, WATER
from pipeline.data.pointcloud import PointCloud
from pipeline.geometry.inside import cover_polygons
from pipeline.points_terrain.raster import Dtm, window_of
from pipeline.points_terrain.terrain import cut_terrain
from pipeline.roofs.roof_points import locate_roof_points
from tiler.citymodels.tables import pack_polygons, unpack_polygons
from tiler.config.config import Config
from tiler.config.step_options import CITY_PARAMETERS, city_options
from tiler.engine.run_context import find_owned, region_around
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.stages.inputs import halo_of_points
from tiler.stages.readers import extent_of, grow, hull, read_cloud, read_known_terrain

LEFT_OUT = "left-out"
COVERED = 0.5  # share of a footprint's area from which on the mesh has a building for it


def left_out_stage(config: Config) -> Stage:
    """Stage of what the city model leaves out of the footprints; it reads points only where there is something."""
    reads = (
        Read("outlines", own=True),
        Read("model", around="outlines", by_extent=True),
        Read("points", halo_of_points(config, config.ground_margin), around="outlines"),
        Read("terrain", 2 * config.dtm_spacing, around="outlines"),
    )
    parameters = (*CITY_PARAMETERS, "dtm_spacing", "ground_filter")
    return Stage(LEFT_OUT, Scope.TILE, find_left_out, reads, parameters, small=True)


def find_left_out(task: Task) -> Facts:
    """Find the footprints of a tile of which less than half is under a building, whatever the reason.

    Of each part of a footprint within the region it gives area and place, how many building points lie in it, and
    the height of its highest part above the ground, measured as that of every other building; NaN for those that
    are smaller than buildings are.
    """
    (found,) = (result.arrays for result in task.read("outlines"))
    polygons, row = _parts_in_region(task, unpack_polygons(found, "outline"), found["ids"])
    area = shapely.area(polygons)
    bare = area - _covered_area(task, polygons)
    lost = np.flatnonzero(bare > (1 - COVERED) * area)
    place = shapely.get_coordinates(shapely.point_on_surface(polygons[lost])).reshape(-1, 2)
    mine = find_owned(task.box, task.context.bounds, place)
    lost, place = lost[mine], place[mine]
    polygons, row, bare = polygons[lost], row[lost], bare[lost]
    ids, given = found["ids"][row], found["given_height"][row]
    n_points, height = _measure(task, polygons, given)
    task.put(**pack_polygons(polygons, "polygon"), id=ids, area=bare, points=n_points, height=height, place=place)
    sums = {"footprints": len(np.unique(row)), "area": float(bare.sum()), "points": int(n_points.sum())}
    return {"extent": extent_of(polygons), "left_out": sums}


def _parts_in_region(
    task: Task, outlines: NDArray[np.object_], ids: NDArray[np.str_]
) -> tuple[NDArray[np.object_], NDArray[np.int64]]:
    """Polygons of the footprints within the region, and the row of each; those of known buildings are left out."""
    known = np.concatenate(
        [np.empty(0, np.str_)]
        + [
            np.concatenate((r.arrays["house"], r.arrays["member"]))
            for r in task.read("model", ("house", "member"))
        ]
    )
    row = np.flatnonzero(~np.isin(ids, known))
    polygons, row = read_polygons(outlines, row)
    if not len(row):
        return polygons, row
    region = region_around(task.context.grid, hull(task.box, extent_of(polygons)))
    return take_polygons(shapely.intersection(polygons, region), row)


def read_polygons(
    outlines: NDArray[np.object_], row: NDArray[np.int64]
) -> tuple[NDArray[np.object_], NDArray[np.int64]]:
    """Give the polygons of some rows of footprints as read, valid ones, and the row of each."""
    row = row[~(shapely.is_missing(outlines[row]) | shapely.is_empty(outlines[row]))]
    return take_polygons(shapely.force_2d(outlines[row]), row)


def take_polygons(
    geometries: NDArray[np.object_], row: NDArray[np.int64]
) -> tuple[NDArray[np.object_], NDArray[np.int64]]:
    """Take geometries apart and keep what has an area: valid polygons, with the row of each.

    Parameters
    ----------
    geometries : object, (n,)
        Geometries of any kind without Z, valid or not, none of them None.
    row : int64, (n,)
        The row of each.
    """
    geometries = geometries.copy()
    bad = ~shapely.is_valid(geometries)
    geometries[bad] = shapely.make_valid(geometries[bad], method="structure", keep_collapsed=False)
    while (shapely.get_type_id(geometries) > shapely.GeometryType.POLYGON).any():
        geometries, index = shapely.get_parts(geometries, return_index=True)
        row = row[index]
    kept = (shapely.get_type_id(geometries) == shapely.GeometryType.POLYGON) & (shapely.area(geometries) > 0)
    return geometries[kept], row[kept]


def _covered_area(task: Task, polygons: NDArray[np.object_]) -> NDArray[np.float64]:
    """Area of each polygon that buildings of the city model have (m²); these do not overlap."""
    covered = np.zeros(len(polygons))
    if not len(polygons):
        return covered
    for result in task.read("model", ("polygon", "polygon_start")):
        buildings = unpack_polygons(result.arrays, "polygon")
        one, other = shapely.STRtree(buildings).query(polygons, predicate="intersects")
        np.add.at(covered, one, shapely.area(shapely.intersection(polygons[one], buildings[other])))
    return covered


def _measure(
    task: Task, polygons: NDArray[np.object_], given: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Building points in each polygon, and the height of its highest part (m)."""
    n_points, height = np.zeros(len(polygons), np.int64), np.full(len(polygons), np.nan)
    box = extent_of(polygons)
    if box is None:
        return n_points, height
    options, spacing = city_options(task.parameters), task.parameters.dtm_spacing
    cloud = read_cloud(
        task,
        grow(box, options.ground_margin),
        classes=(BUILDING, GROUND, WATER),
        ground_filter=task.parameters.ground_filter,
        cover=cover_polygons(reach_of_points(polygons, options.ground_margin)),
    )
    n_points = np.diff(locate_roof_points(cloud, polygons, building_class=True).start)
    names = np.array([f"{k}" for k in range(len(polygons))])
    buildings, _ = clean_footprints(
        Footprints(polygons, names, given), min_area=options.min_building_area, tolerance=options.vertex_tolerance
    )
    if len(buildings.ids):
        dtm = read_known_terrain(task, grow(box, 2 * spacing), spacing=spacing, bounds=task.context.bounds)
        terrain = cut_terrain(dtm, window_of(dtm))
        city = measure_city(cloud, buildings, terrain, options, building_class=True)
        number = np.array([int(name.partition("-")[0]) for name in city.model.ids.tolist()], np.int64)
        np.fmax.at(height, number, _highest_parts(city, cloud, terrain, options))
    return n_points, height


def _highest_parts(city: City, cloud: PointCloud, terrain: Dtm, options: CityOptions) -> NDArray[np.float64]:
    """Height of the highest part of each house above its ground (m)."""
    houses = divide_houses(city, cloud, options, building_class=True)
    part = houses.parts.house
    heights = measure_heights(houses.points, houses.parts.polygons, terrain, houses.given_height[part], options)
    highest = city.model.roof - city.model.ground
    np.fmax.at(highest, part, heights.roof - city.model.ground[part])
    return highest
