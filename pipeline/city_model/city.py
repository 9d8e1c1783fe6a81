"""A city between its steps: model, points, groups, notes; and what both ways to simplify share."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import BuildingPoints, take_building_points
from pipeline.city_model.heights import ROOF_SOURCES, Heights, compute_building_heights
from pipeline.data.citymodel import CityModel, Footprints, number_ids
from pipeline.data.notes import Note
from pipeline.data.roof_forms import NO_FORM
from pipeline.data.roofs import NOT_FITTED, Roofs, flat_roofs, take_roofs
from pipeline.points_terrain.terrain import Dtm

Bounds = tuple[float, float, float, float]
# Called with the name of a step around it: the caller's clock.
Trace = Callable[[str], AbstractContextManager[object]]


def no_trace(_: str) -> AbstractContextManager[object]:
    """Do nothing around a step."""
    return nullcontext()


@dataclass(frozen=True)
class CityOptions:
    """Parameters of steps 1.4 to 2.3; their meaning, units and defaults stand in the configuration."""

    min_building_area: float
    vertex_tolerance: float
    ground_margin: float
    ground_percentile: float
    roof_percentile: float
    default_height: float
    roof_clearance: float
    border: Literal["drop", "clip"]
    simplify: Literal["clearance", "paper"]
    clearance: float
    finer_clearance: float
    clearance_floor: float
    min_courtyard_area: float
    roofs: Literal["planes", "skeleton", "flat"]
    roof_price: float
    split_levels: bool
    roof_group: float
    manifold: bool


@dataclass(frozen=True, eq=False)
class City:
    """A city model with what is needed to go on from it."""

    model: CityModel  #: the buildings
    points: BuildingPoints  #: their roof and ground points
    given_height: NDArray[np.float64]  #: (n,): height above ground (m) from an attribute, NaN where none
    forms: NDArray[np.float64]  #: (n, 6): what attributes say of their roofs, by the columns of `roof_forms`
    roof_source: NDArray[np.int8]  #: (n,): where the roof's height comes from: index into `heights.ROOF_SOURCES`
    wall_ground: NDArray[np.float64]  #: (n,): highest terrain at the walls (m)
    measured_roof: NDArray[np.float64]  #: (n,): roof heights (m) before roofs were grouped and raised
    #: (n,): buildings of one group have one roof: the same height, and no wall between them
    group: NDArray[np.int32]
    #: (n,): row of the footprint, or of the simplified building, that each was made of: those without a roof are
    #: gone
    row: NDArray[np.int64]
    #: (n,): where the roof of the house of each comes from: index into `ROOF_METHODS`; `NOT_FITTED` with flat
    #: roofs
    roof_method: NDArray[np.int8]
    #: (n,): why the roof of that house has one height: index into `ROOF_FALLBACKS`
    roof_fallback: NDArray[np.int8]
    #: (n,): the form of that house by an attribute: index into `ROOF_SHAPES`; negative where it has none
    roof_form: NDArray[np.int8]
    notes: tuple[Note, ...]  #: what was dropped, repaired or defaulted on the way
    counts: dict[str, int]  #: numbers by name, for the report
    #: how the simplified outlines compare with the footprints: ``area_error`` (share of all area that houses lost
    #: or gained), ``min_clearance`` (m), ``sharpest`` (degrees); empty before simplification
    outline: dict[str, float]


def measure_heights(
    points: BuildingPoints,
    polygons: NDArray[np.object_],
    dtm: Dtm,
    given_height: NDArray[np.float64],
    options: CityOptions,
) -> Heights:
    """Heights of buildings by the rules that the options state (steps 1.6 and 2.3)."""
    return compute_building_heights(
        points,
        polygons,
        dtm,
        ground_percentile=options.ground_percentile,
        roof_percentile=options.roof_percentile,
        given_height=given_height,
        default_height=options.default_height,
    )


def assemble_city(
    footprints: Footprints,
    points: BuildingPoints,
    heights: Heights,
    members: tuple[tuple[str, ...], ...],
    wall_ground: NDArray[np.float64],
    *,
    roofs: Roofs | None = None,
    house: NDArray[np.str_] | None = None,
    group: NDArray[np.int32] | None = None,
) -> City:
    """Make the city of all buildings that have a roof.

    Roofs are those measured, and each building a house and a group of its own, where nothing else is given.
    """
    kept = np.flatnonzero(~np.isnan(heights.roof))
    ids = footprints.ids[kept]
    model = CityModel(
        footprints.polygons[kept],
        ids,
        number_ids(ids),
        heights.ground[kept],
        take_roofs(flat_roofs(heights.roof) if roofs is None else roofs, kept),
        tuple(members[row] for row in kept),
        ids if house is None else house[kept],
    )
    return City(
        model,
        take_building_points(points, kept),
        footprints.given_height[kept],
        footprints.forms[kept],
        heights.roof_source[kept],
        wall_ground[kept],
        heights.roof[kept],
        np.arange(len(kept), dtype=np.int32) if group is None else group[kept],
        kept,
        np.full(len(kept), NOT_FITTED, np.int8),
        np.zeros(len(kept), np.int8),
        np.full(len(kept), NO_FORM, np.int8),
        (),
        {},
        {},
    )


def note_heights(what: str, footprints: Footprints, heights: Heights) -> list[Note]:
    """Tell of the heights that do not come from points; `what` is "footprint" or "building"."""
    notes = []
    for source, name in enumerate(ROOF_SOURCES[1:], start=1):
        kind = f"{what}-without-height-dropped" if name == "none" else f"{what}-roof-from-{name}"
        places = find_places(footprints, heights.roof_source == source)
        notes += [Note(kind, *place, "no roof points") for _, place in places]
    places = find_places(footprints, heights.ground_from_dtm)
    return notes + [Note(f"{what}-ground-from-dtm", *place, "no ground points") for _, place in places]


def find_places(footprints: Footprints, chosen: NDArray[np.bool_]) -> list[tuple[int, tuple[str, float, float]]]:
    """Row, and id and place, of each chosen footprint."""
    rows = np.flatnonzero(chosen)
    xy = shapely.get_coordinates(shapely.point_on_surface(footprints.polygons[rows]))
    return [
        (int(row), (str(footprints.ids[row]), float(x), float(y))) for row, (x, y) in zip(rows, xy, strict=True)
    ]
