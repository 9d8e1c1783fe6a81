"""The full city model: houses in parts on their own outlines, as close to points as these allow (step 1.7)."""

from collections.abc import Set

import numpy as np

from pipeline.city_model.building_points import take_building_points
from pipeline.city_model.city import City
from pipeline.city_model.houses import Houses, find_fallbacks, name_parts
from pipeline.city_model.model_roofs import MODEL
from pipeline.data.citymodel import CityModel, number_ids
from pipeline.data.roofs import choose_roofs, flat_roofs, highest_roofs
from pipeline.roofs.house_roofs import RoofOptions
from pipeline.roofs.refit import refit_roofs
from pipeline.roofs.roof_points import RoofPoints, divide_roof_points


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
    parts, roofs, model = houses.full.parts, houses.full.roofs, city.model
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
