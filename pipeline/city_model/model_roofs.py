"""Roofs of houses by the surfaces of a city model, where one knows them (step 2.0, ours)."""

import numpy as np
from numpy.typing import NDArray

from pipeline.city_model.city import City, find_places
from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roofs import ROOF_METHODS, take_roofs
from pipeline.roofs.house_roofs import HouseRoofs, RoofOptions, replace_roofs
from pipeline.roofs.roof_surfaces import RoofSurfaces, make_surfaced_roof

MODEL = ROOF_METHODS.index("model")
TOLD_SHARE = 0.05  # of a house: larger overhangs and gaps are told ...
TOLD_AREA = 1.0  # m2, ... if they are larger than this, too


def lay_surfaces(
    fitted: HouseRoofs, city: City, surfaces: RoofSurfaces
) -> tuple[HouseRoofs, NDArray[np.bool_], list[Note]]:
    """Give houses the roofs that a city model has for them.

    Parameters
    ----------
    fitted : HouseRoofs
        Roofs of all houses.
    city : City
        The houses.
    surfaces : RoofSurfaces
        Roof surfaces of each, none where nothing is known.

    Returns
    -------
    HouseRoofs
        The roofs; a house keeps its own where it has no surfaces, or these do not cover it.
    bool, (h,)
        Houses whose roof is that of the model.
    list of Note
        ``model-roof-unused`` where surfaces give no roof, ``model-roof-overhang`` where they reach beyond the
        house, ``model-roof-gap`` where they leave some of it bare.
    """
    model = city.model
    new = {}
    overhang, gap = np.zeros(len(model)), np.zeros(len(model))
    known = np.diff(surfaces.start) > 0
    laid = np.zeros(len(model), np.bool_)
    for row in np.flatnonzero(known).tolist():
        own = np.arange(surfaces.start[row], surfaces.start[row + 1])
        found = make_surfaced_roof(
            model.polygons[row],
            surfaces.polygons[own],
            take_roofs(surfaces.roofs, own),
            min_area=RoofOptions.min_area,
        )
        if found is None:
            continue
        laid[row] = True
        new[row] = found.parts, found.roofs, MODEL
        overhang[row], gap[row] = found.overhang, found.gap
    footprints = Footprints(model.polygons, model.ids, city.given_height)
    area = np.array([polygon.area for polygon in model.polygons])
    notes = [
        Note("model-roof-unused", *place, "its surfaces do not cover the house; as without them")
        for _, place in find_places(footprints, known & ~laid)
    ]
    for kind, values, words in (
        ("model-roof-overhang", overhang, "of roof beyond the walls cut off"),
        ("model-roof-gap", gap, "without a roof surface took the nearest one"),
    ):
        told = (values > TOLD_AREA) & (values > TOLD_SHARE * area)
        notes += [
            Note(kind, *place, f"{values[row]:.1f} m2 {words}, of a house of {area[row]:.1f} m2")
            for row, place in find_places(footprints, told)
        ]
    return replace_roofs(fitted, new), laid, notes
