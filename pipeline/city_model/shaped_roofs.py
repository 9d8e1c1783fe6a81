"""Roofs by the straight skeletons of outlines: the form that attributes give, or a hipped one (step 2.0, ours)."""

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.city import City, find_places
from pipeline.city_model.heights import ROOF_SOURCES
from pipeline.data.citymodel import Footprints
from pipeline.data.errors import GeometryError
from pipeline.data.notes import Note
from pipeline.data.roof_forms import (
    ACROSS,
    DIRECTION,
    HEIGHT,
    NO_FORM,
    NO_HEIGHT,
    NO_SKELETON,
    ROOF_SHAPES,
    SHAPE,
    SLOPE,
    TO_EAVES,
    TOO_LOW,
)
from pipeline.data.roofs import (
    ROOF_METHODS,
    Roofs,
    flat_roofs,
    join_roofs,
    plane_heights,
    roof_heights,
)
from pipeline.geometry.inside import find_inside
from pipeline.roofs.house_roofs import FLAT, HouseRoofs, RoofOptions, replace_roofs
from pipeline.roofs.roof_points import RoofPoints
from pipeline.skeletons.skeleton_roofs import DEFAULT_SLOPE, RoofForm, skeleton_roofs

SKELETON = ROOF_METHODS.index("skeleton")
WIDEST_RISE = 4.0  # m; over outlines whose hipped roof would be higher, roofs are flat; given forms are lower
LEAST_EAVES = 2.0  # m above the ground
LEAST_RISE = 0.3  # m, from the eaves to the ridge of a given form
LEAST_SHARE = 0.125  # of a house; smaller parts of a given form are joined with others
MIN_SLOPE_POINTS = 8  # points of a house that its slope is fitted to
MIN_SPAN = 0.4  # share of the height of its roof over which these lie
SLOPES = (0.1, 1.7)  # m per m; limits of a fitted slope
SLOPE_STEPS = (0.05, 0.005)  # of the search and its refinement
FAR_OFF = 1.0  # m; median distance of points to a given form that is told

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Shaped:
    """Parts of a house with their planes; ``shape`` is one of `ROOF_SHAPES`."""

    parts: NDArray[np.object_]
    roofs: Roofs
    shape: str

    @property
    def rise(self) -> float:
        """Height from the eaves to the highest ridge (m)."""
        return float(self.roofs.limits[:, 1].max() - self.roofs.limits[:, 0].min())

    @property
    def mean(self) -> float:
        """Mean height (m)."""
        area = shapely.area(self.parts)
        centre = shapely.get_coordinates(shapely.centroid(self.parts))
        return float((area * plane_heights(self.roofs, np.arange(len(self.roofs)), centre)).sum() / area.sum())

    def moved(self, eaves: float, factor: float = 1.0) -> "_Shaped":
        """Make it higher by a factor, and put its eaves to a height (m); they were at 0."""
        over = self.roofs
        plane = over.plane * factor + np.array([0.0, 0.0, eaves])
        return replace(self, roofs=Roofs(plane, over.origin, over.limits * factor + eaves))


def shape_roofs(
    fitted: HouseRoofs,
    polygons: NDArray[np.object_],
    chosen: NDArray[np.bool_],
    ground: Array,
    roof: Array,
) -> HouseRoofs:
    """Give some houses hipped roofs, of the mean height that they had.

    Parameters
    ----------
    fitted : HouseRoofs
        Roofs of all houses.
    polygons : object, (h,)
        Their outlines (m).
    chosen : bool, (h,)
        Houses that are to have one.
    ground, roof : float64, (h,)
        Heights of each (m).

    Returns
    -------
    HouseRoofs
        The roofs. A house stays as it is where the roof would rise by more than `WIDEST_RISE`, its eaves would be
        lower than `LEAST_EAVES` above the ground, or its outline has no skeleton.
    """
    shaped: dict[int, _Shaped] = {}
    for row in np.flatnonzero(chosen & np.isfinite(roof) & np.isfinite(ground)).tolist():
        found = _hip(polygons[row], float(ground[row]), float(roof[row]))
        if found is not None:
            shaped[row] = found
    return _replace_roofs(fitted, shaped)


def form_roofs(
    fitted: HouseRoofs, city: City, points: RoofPoints, chosen: NDArray[np.bool_]
) -> tuple[HouseRoofs, NDArray[np.int8], list[Note]]:
    """Give some houses roofs of the forms that attributes of their footprints state.

    Parameters
    ----------
    fitted : HouseRoofs
        Roofs of all houses.
    city : City
        The houses, with their heights and the forms of their roofs.
    points : RoofPoints
        Their roof points, of which there may be none.
    chosen : bool, (h,)
        Houses with a form that are to have it.

    Returns
    -------
    HouseRoofs
        The roofs. A house stays as it is where there is no height, no straight skeleton of its outline for that
        shape, or no room for the roof above its least eaves.
    int8, (h,)
        Index into `ROOF_SHAPES` of the shape of each house that has a form now (hipped instead of a pyramidal one
        over some outlines), `NO_FORM` of those not chosen, else a code of `roof_forms` that tells why not.
    list of Note
        ``footprint-roof-form-unused``, ``footprint-roof-form-replaced``, ``footprint-roof-form-lowered`` and
        ``footprint-roof-form-off``.

    Notes
    -----
    - How steep: by the height that is given, else by the slope, else the slope that fits the points best (the
      least sum of their distances; `MIN_SLOPE_POINTS` of them, over `MIN_SPAN` of the roof's height), else
      `DEFAULT_SLOPE`, but no higher than `WIDEST_RISE`.
    - How high: such that the median of the points lies on the roof. Without a point the height of the footprint is
      that of the highest ridge, or of the eaves where levels were counted. A height by default is the mean one.
    - Eaves are at least `LEAST_EAVES` above the ground: the ridge stays, and the roof gets lower.

    The order of the points does not matter, and other houses do not.
    """
    model, forms = city.model, city.forms
    code = np.full(len(model), NO_FORM, np.int8)
    units: dict[int, _Shaped] = {}
    for row in np.flatnonzero(chosen).tolist():
        if not (np.isfinite(model.ground[row]) and np.isfinite(model.roof[row])):
            code[row] = NO_HEIGHT
            continue
        unit = _unit_roof(model.polygons[row], forms[row])
        if unit is None:
            code[row] = NO_SKELETON
        else:
            units[row] = unit
    shaped: dict[int, _Shaped] = {}
    lowered, off = np.full(len(model), np.nan), np.full(len(model), np.nan)
    above = _points_over(units, points)
    for row, unit in units.items():
        placed = _place(unit, forms[row], above[row], _Known.of(city, row))
        if placed is None:
            code[row] = TOO_LOW
            continue
        code[row] = ROOF_SHAPES.index(unit.shape)
        shaped[row], lowered[row], off[row] = unit.moved(placed.eaves, placed.factor), placed.lowered, placed.off
    return _replace_roofs(fitted, shaped), code, _note_forms(city, code, lowered, off)


@dataclass(frozen=True)
class _Known:
    """Heights of a house: `source` is one of `ROOF_SOURCES`."""

    ground: float
    roof: float
    source: str

    @classmethod
    def of(cls, city: City, row: int) -> "_Known":
        source = ROOF_SOURCES[int(city.roof_source[row])]
        return cls(float(city.model.ground[row]), float(city.model.roof[row]), source)


@dataclass(frozen=True)
class _Placed:
    """Where a roof is: its eaves (m) and how many times the unit roof its height is.

    ``lowered`` is how much lower (m) than stated it is, NaN if it is not; ``off`` the median distance of its
    points (m), NaN without.
    """

    eaves: float
    factor: float
    lowered: float
    off: float


def _unit_roof(polygon: shapely.Polygon, form: Array) -> _Shaped | None:
    """Make the roof of a form with its eaves at 0 and the slope 1; None where the outline has none."""
    shape = ROOF_SHAPES[int(form[SHAPE])]
    if shape == "flat":
        return _Shaped(np.array([polygon], dtype=object), flat_roofs(np.zeros(1)), shape)
    direction = None if math.isnan(form[DIRECTION]) else float(form[DIRECTION])
    wanted = RoofForm(shape, 1.0, direction=direction, across=form[ACROSS] == 1)
    least = min(RoofOptions.min_area, LEAST_SHARE * polygon.area)
    try:
        found = skeleton_roofs(polygon, 0.0, wanted, min_area=least)
    except GeometryError:
        return None
    return _Shaped(found.parts, found.roofs, found.shape)


def _points_over(units: dict[int, _Shaped], points: RoofPoints) -> dict[int, tuple[Array, Array]]:
    """Heights of the unit roof of each house at its points (m), and those of the points, by their heights."""
    if not units:
        return {}
    house = np.concatenate([np.full(len(unit.parts), row) for row, unit in units.items()])
    parts = np.concatenate([unit.parts for unit in units.values()])
    owner = np.repeat(np.arange(len(points.start) - 1), np.diff(points.start))
    part, point = find_inside(points.xyz, parts, among=np.isin(owner, house))
    own = house[part] == owner[point]
    part, point = part[own], point[own]
    height = roof_heights(join_roofs([unit.roofs for unit in units.values()]), part, points.xyz[point, :2])
    z = points.xyz[point, 2]
    order = np.lexsort((z, height, house[part]))
    start = np.searchsorted(house[part][order], [list(units), [row + 1 for row in units]])
    return {
        row: (height[order[first:last]], z[order[first:last]])
        for row, first, last in zip(units, *start.tolist(), strict=True)
    }


def _place(unit: _Shaped, form: Array, above: tuple[Array, Array], known: _Known) -> _Placed | None:
    """Find the slope and the eaves of a roof; None where there is no room for it."""
    rise = unit.rise
    unit_height, z = above
    stated = True
    if not rise:
        factor = 1.0
    elif form[HEIGHT] > 0:
        factor = float(form[HEIGHT]) / rise
    elif form[SLOPE] > 0:
        factor = float(form[SLOPE])
    else:
        stated = False
        factor = min(DEFAULT_SLOPE, WIDEST_RISE / rise)
        if len(z) >= MIN_SLOPE_POINTS and np.ptp(unit_height) >= MIN_SPAN * rise:
            factor = _fit_slope(unit_height, z)
    if len(z):
        eaves = float(np.median(z - factor * unit_height))
    elif known.source == "attribute":
        eaves = known.roof if form[TO_EAVES] == 1 else known.roof - factor * rise
    else:
        eaves = known.roof - factor * unit.mean
    lowered, least = np.nan, known.ground + LEAST_EAVES
    if rise and eaves < least:
        left = eaves + factor * rise - least
        if left < LEAST_RISE:
            return None
        lowered = least - eaves if stated else np.nan
        eaves, factor = least, left / rise
    off = float(np.median(np.abs(z - factor * unit_height - eaves))) if len(z) else np.nan
    return _Placed(eaves, factor, lowered, off)


def _fit_slope(unit_height: Array, z: Array) -> float:
    """Slope of the roof that has the least sum of distances to points, at the eaves that go with it."""
    least, most = SLOPES
    low, high, best = least, most, least
    for step in SLOPE_STEPS:
        slopes = low + step * np.arange(round((high - low) / step) + 1)
        over = np.sort(z - slopes[:, np.newaxis] * unit_height, axis=1)
        cost = np.abs(over - np.median(over, axis=1)[:, np.newaxis]).sum(axis=1)
        best = float(slopes[np.argmin(cost)])
        low, high = max(best - step, least), min(best + step, most)
    return best


def _hip(polygon: shapely.Polygon, ground: float, roof: float) -> _Shaped | None:
    """Parts and planes of a hipped roof of this mean height, None where there is none."""
    try:
        found = skeleton_roofs(polygon, 0.0, RoofForm("hipped", DEFAULT_SLOPE), min_area=RoofOptions.min_area)
    except GeometryError:
        return None
    shaped = _Shaped(found.parts, found.roofs, found.shape)
    eaves = roof - shaped.mean
    if found.height.max() > WIDEST_RISE or eaves < ground + LEAST_EAVES:
        return None
    return shaped.moved(eaves)


def _replace_roofs(fitted: HouseRoofs, shaped: dict[int, _Shaped]) -> HouseRoofs:
    """Put the roofs of some houses in the place of those that they had."""
    new = {row: (each.parts, each.roofs, SKELETON if each.rise else FLAT) for row, each in shaped.items()}
    return replace_roofs(fitted, new)


def _note_forms(city: City, code: NDArray[np.int8], lowered: Array, off: Array) -> list[Note]:
    """Tell of the forms that could not be given, not as they are stated, or that points do not fit."""
    model = city.model
    footprints = Footprints(model.polygons, model.ids, city.given_height)
    reasons = {
        NO_HEIGHT: "the house has no height",
        NO_SKELETON: "the outline has no roof of that shape",
        TOO_LOW: f"no room above eaves of {LEAST_EAVES:g} m",
    }
    notes = []
    for row, place in find_places(footprints, np.isin(code, list(reasons))):
        shape = ROOF_SHAPES[int(city.forms[row, SHAPE])]
        notes.append(Note("footprint-roof-form-unused", *place, f"{shape}: {reasons[int(code[row])]}"))
    for row, place in find_places(footprints, (code >= 0) & (code != city.forms[:, SHAPE])):
        wanted, made = ROOF_SHAPES[int(city.forms[row, SHAPE])], ROOF_SHAPES[code[row]]
        detail = f"{wanted}: an edge does not face the middle; {made}"
        notes.append(Note("footprint-roof-form-replaced", *place, detail))
    for row, place in find_places(footprints, np.isfinite(lowered)):
        detail = (
            f"{ROOF_SHAPES[code[row]]}: eaves raised by {lowered[row]:.2f} m to {LEAST_EAVES:g} m above ground"
        )
        notes.append(Note("footprint-roof-form-lowered", *place, detail))
    for row, place in find_places(footprints, off > FAR_OFF):
        detail = f"{ROOF_SHAPES[code[row]]}: points are {off[row]:.2f} m from it in the median"
        notes.append(Note("footprint-roof-form-off", *place, detail))
    return notes
