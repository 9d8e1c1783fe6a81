"""The full city model: houses in parts on their own outlines, as close to points as these allow (step 1.7)."""

from collections.abc import Set

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import take_building_points
from pipeline.city_model.city import City
from pipeline.city_model.houses import Houses, find_fallbacks, name_parts
from pipeline.city_model.model_roofs import MODEL
from pipeline.data.citymodel import CityModel, number_ids
from pipeline.data.roofs import choose_roofs, flat_roofs, highest_roofs
from pipeline.roofs.house_levels import HouseParts
from pipeline.roofs.house_roofs import FAMILY, PLANES, HouseRoofs, RoofOptions
from pipeline.roofs.refit import refit_roofs
from pipeline.roofs.roof_points import RoofPoints, divide_roof_points

CLOSE = 0.003  # m; corners that near would be one corner of a solid, whose coordinates are rounded to 1 mm


def divide_city(city: City, houses: Houses, points: RoofPoints, *, reserved: Set[str]) -> tuple[City, RoofPoints]:
    """Divide the houses of a city by `Houses.full`, each part with its roof fitted to its points once more.

    Parameters
    ----------
    city : City
        Result of `build_city`.
    houses : Houses
        Result of `divide_houses`; without the division for the full city model the city stays as it is.
    points : RoofPoints
        Roof points of the houses.
    reserved : set of str
        Ids that no part may get.

    Returns
    -------
    City
        The parts, each on the ground of its house. Roofs of a given form, and those of a city model, stay as they
        are; a part without a roof has the height of its house.
    RoofPoints
        Roof points of each.
    """
    if houses.full is None:
        return city, points
    parts, roofs, model = join_close(houses.full, city.model.polygons), houses.full.roofs, city.model
    row = parts.house
    points = divide_roof_points(points, parts.polygons, row)
    fixed = ((houses.form >= 0) | (houses.full.method == MODEL))[row]
    fitted = refit_roofs(roofs, parts.polygons, points, max_slope=RoofOptions.max_slope)
    roofs = choose_roofs(fixed, roofs, fitted)
    roofs = choose_roofs(np.isnan(roofs.plane[:, 2]), flat_roofs(model.roof[row]), roofs)
    ids = name_parts(model.ids, row, reserved)
    full = CityModel(
        parts.polygons,
        ids,
        number_ids(ids),
        model.ground[row],
        roofs,
        tuple(model.members[k] for k in row.tolist()),
        model.ids[row],
    )
    divided = City(
        full,
        take_building_points(city.points, row),
        city.given_height[row],
        city.forms[row],
        city.roof_source[row],
        city.wall_ground[row],
        highest_roofs(roofs, parts.polygons),
        np.arange(len(row), dtype=np.int32),
        city.row[row],
        houses.full.method[row],
        find_fallbacks(houses)[row],
        houses.form[row],
        (),
        {},
        {},
    )
    return divided, points


def join_close(fitted: HouseRoofs, outlines: NDArray[np.object_]) -> HouseParts:
    """Join corners of parts that skeletons or a city model have closer than `CLOSE`; those of outlines stay.

    Parameters
    ----------
    fitted : HouseRoofs
        Roofs of h houses.
    outlines : object, (h,)
        Their outlines.

    Returns
    -------
    HouseParts
        The parts; one that would be no valid polygon stays as it is.
    """
    parts = fitted.parts
    divided = np.bincount(parts.house, minlength=len(fitted.method)) > 1
    rows = np.flatnonzero((divided & ~np.isin(fitted.method, (PLANES, FAMILY)))[parts.house])
    if not len(rows):
        return parts
    xy, of = shapely.get_coordinates(parts.polygons[rows], return_index=True)
    house = parts.house[rows][of]
    places = shapely.points(xy)
    near = shapely.STRtree(places).query(places, predicate="dwithin", distance=CLOSE).T
    near = near[(near[:, 0] < near[:, 1]) & (house[near[:, 0]] == house[near[:, 1]])]
    near = near[(xy[near[:, 0]] != xy[near[:, 1]]).any(axis=1)]
    if not len(near):
        return parts
    corners = {
        k: set(map(tuple, shapely.get_coordinates(outlines[k]).tolist())) for k in house[near[:, 0]].tolist()
    }
    rank = {k: (tuple(xy[k].tolist()) not in corners[house[k]], *xy[k].tolist()) for k in np.unique(near).tolist()}
    target = dict(rank)
    for pair in near.tolist():
        first, last = sorted(pair, key=rank.__getitem__)
        if rank[last][0]:
            target[last] = min(target[last], rank[first])
    for k, (_, *place) in target.items():
        xy[k] = place
    joined = shapely.remove_repeated_points(shapely.set_coordinates(parts.polygons[rows], xy))
    sound = shapely.is_valid(joined) & ~shapely.is_empty(joined)
    polygons = parts.polygons.copy()
    polygons[rows] = np.where(sound, joined, polygons[rows])
    return HouseParts(polygons, parts.house)
