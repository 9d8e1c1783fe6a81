"""Roofs of houses by the surfaces of a city model, where one knows them (step 2.0, ours)."""

import numpy as np

from pipeline.city_model.city import City, find_places
from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roofs import ROOF_METHODS, take_roofs
from pipeline.roofs.house_roofs import NewRoof
from pipeline.roofs.roof_surfaces import RoofSurfaces, make_surfaced_roof

MODEL = ROOF_METHODS.index("model")
TOLD_SHARE = 0.05  # of a house: larger overhangs and gaps are told ...
TOLD_AREA = 1.0  # m2, ... if they are larger than this, too


def lay_surfaces(
    city: City, surfaces: RoofSurfaces, *, clearance: float, finer: float
) -> tuple[dict[int, NewRoof], list[Note]]:
    """Make the roofs that a city model has for houses.

    Parameters
    ----------
    city : City
        The houses.
    surfaces : RoofSurfaces
        Roof surfaces of each, none where nothing is known.
    clearance, finer : float
        Least distance of walls (m), as for `make_surfaced_roof`.

    Returns
    -------
    dict of int to NewRoof
        By row of the house; none where it has no surfaces, or these do not cover it.
    list of Note
        ``model-roof-unused`` where surfaces give no roof, ``model-roof-overhang`` where they reach beyond the
        house, ``model-roof-gap`` where they leave some of it bare.
    """
    model = city.model
    new: dict[int, NewRoof] = {}
    overhang, gap = np.zeros(len(model)), np.zeros(len(model))
    known = np.diff(surfaces.start) > 0
    for row in np.flatnonzero(known).tolist():
        own = np.arange(surfaces.start[row], surfaces.start[row + 1])
        found = make_surfaced_roof(
            model.polygons[row],
            surfaces.polygons[own],
            take_roofs(surfaces.roofs, own),
            clearance=clearance,
            finer=finer,
        )
        if found is None:
            continue
        new[row] = found.parts, found.roofs, MODEL
        overhang[row], gap[row] = found.overhang, found.gap
    footprints = Footprints(model.polygons, model.ids, city.given_height)
    area = np.array([polygon.area for polygon in model.polygons])
    known[list(new)] = False  # those that are left have surfaces, and no roof of them
    notes = [
        Note("model-roof-unused", *place, "its surfaces do not cover the house; as without them")
        for _, place in find_places(footprints, known)
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
    return new, notes
