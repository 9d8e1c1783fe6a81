"""Houses on their way through step 2: divided in parts, each with its points (after steps 1.6 and 2.0)."""

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.city_model.building_points import (
    BuildingPoints,
    extract_building_points,
    has_building_class,
    join_building_points,
    take_building_points,
)
from pipeline.city_model.city import City, CityOptions
from pipeline.city_model.heights import ROOF_SOURCES
from pipeline.city_model.model_roofs import MODEL, lay_surfaces
from pipeline.city_model.shaped_roofs import form_roofs, shape_roofs
from pipeline.data.notes import Note
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roof_forms import NO_FORM, POINTS_TELL, SHAPE
from pipeline.data.roofs import ROOF_FALLBACKS, Roofs, choose_roofs, flat_roofs, join_roofs, take_roofs
from pipeline.roofs.house_levels import HouseParts, LevelOptions, split_levels
from pipeline.roofs.house_roofs import FLAT, HouseRoofs, RoofOptions, fit_roofs, replace_roofs, take_roof
from pipeline.roofs.roof_points import (
    RoofPoints,
    add_roof_points,
    divide_roof_points,
    keep_roof_points,
    locate_roof_points,
    no_roof_points,
)
from pipeline.roofs.roof_surfaces import RoofSurfaces

NO_POINTS, FEW_POINTS = (ROOF_FALLBACKS.index(why) for why in ("no roof points", "few roof points"))
FULL_CLEARANCE = 0.2  # m; of walls between planes of the full city model, 1.5 times of which they keep
FULL_PRICE = 0.5  # share of the price of a cut that it has there


@dataclass(frozen=True, eq=False)
class Houses:
    """Houses before simplification, and the parts that they were divided in."""

    ids: NDArray[np.str_]  #: (h,): ids of the houses
    polygons: NDArray[np.object_]  #: (h,): their outlines (m)
    given_height: NDArray[np.float64]  #: (h,): height above ground (m) from an attribute, NaN where none
    parts: HouseParts  #: parts of all houses; a house that is not divided is its only part
    roofs: Roofs  #: roof of each part, as its points tell; NaN where it has none, or one height is looked for
    method: NDArray[np.int8]  #: (h,): where the roof of each house comes from: index into `ROOF_METHODS`
    too_few: NDArray[np.bool_]  #: (h,): houses with too few points for planes; none where one height is looked for
    #: (h,): the form of the roof by an attribute: index into `ROOF_SHAPES`; negative where there is none, or why
    #: it is not used, by the codes of `roof_forms`
    form: NDArray[np.int8]
    points: BuildingPoints  #: roof and ground points of each part
    notes: tuple[Note, ...] = ()  #: what became of given forms, where the houses were divided just now
    #: their division for the full city model, where it was asked for: closer to the points
    full: HouseRoofs | None = None

    def __len__(self) -> int:
        return len(self.ids)


def divide_houses(
    city: City,
    cloud: PointCloud,
    options: CityOptions,
    *,
    building_class: bool | None = None,
    roofs: RoofPoints | None = None,
    unmarked: NDArray[np.bool_] | None = None,
    surfaces: RoofSurfaces | None = None,
    prefer_points: bool = False,
    full: bool = False,
) -> Houses:
    """Divide houses by the planes of their roofs, or where these step (step 2.0, ours).

    With other options, each house is one part.

    Parameters
    ----------
    city : City
        Result of `build_city`.
    cloud : PointCloud
        Points of all houses and `ground_margin` around them.
    options : CityOptions
        Parameters.
    building_class : bool, optional
        Whether the cloud marks buildings; by default, whether it has a point of that class.
    roofs : RoofPoints, optional
        Roof points of the houses, where they are known.
    unmarked : bool, (h,), optional
        Houses whose roof points are those of `roofs` alone, whatever class they have in the cloud.
    surfaces : RoofSurfaces, optional
        Roof surfaces of the houses by a city model; not used where roofs are flat.
    prefer_points : bool
        Whether such a roof counts only where points are too few for planes.
    full : bool
        Whether to divide sloped roofs for the full city model besides.
    """
    model = city.model
    marks = has_building_class(cloud) if building_class is None else building_class
    parts, points = HouseParts(model.polygons, np.arange(len(model))), city.points
    sloped = options.roofs != "flat"
    part_roofs, method, too_few = None, np.full(len(model), FLAT, np.int8), np.zeros(len(model), np.bool_)
    form, notes, finer = np.full(len(model), NO_FORM, np.int8), list[Note](), None
    if (options.split_levels or sloped) and options.simplify == "clearance" and len(model):
        if roofs is None:
            roofs = locate_roof_points(cloud, model.polygons, building_class=marks)
        if sloped:
            fitted, finer, form, notes = _fit_sloped(city, roofs, options, surfaces, prefer_points, full)
            parts, part_roofs, method, too_few = fitted.parts, fitted.roofs, fitted.method, fitted.too_few
        else:
            parts = split_levels(model.polygons, roofs, LevelOptions(clearance=options.clearance))
        divided = np.flatnonzero(np.bincount(parts.house)[parts.house] > 1)
        roof = None
        if unmarked is not None and unmarked.any():
            roof = _collect_roof_points(
                cloud, HouseParts(parts.polygons[divided], parts.house[divided]), roofs, unmarked
            )
        found = extract_building_points(
            cloud, parts.polygons[divided], margin=options.ground_margin, building_class=marks, roof=roof
        )
        rows = parts.house.copy()  # a house that is not divided keeps its points
        rows[divided] = len(model) + np.arange(len(divided))
        points = take_building_points(join_building_points([points, found]), rows)
    if part_roofs is None:
        part_roofs = flat_roofs(np.full(len(parts.polygons), np.nan))
    return Houses(
        model.ids,
        model.polygons,
        city.given_height,
        parts,
        part_roofs,
        method,
        too_few,
        form,
        points,
        tuple(notes),
        finer,
    )


def _fit_sloped(
    city: City,
    points: RoofPoints,
    options: CityOptions,
    surfaces: RoofSurfaces | None,
    prefer_points: bool,
    full: bool,
) -> tuple[HouseRoofs, HouseRoofs | None, NDArray[np.int8], list[Note]]:
    """Roofs of a city model, of planes, of given forms, and hipped ones, in this order where all are looked for.

    Where planes are, points tell the roof if they are enough; else a given form does, and at last the outline.
    In the full city model walls between planes keep less distance, and need to save less; all else is the same.
    """
    model = city.model
    distances = {"clearance": options.clearance, "finer": options.finer_clearance}
    new, told_of = ({}, []) if surfaces is None else lay_surfaces(city, surfaces, **distances)
    laid = np.zeros(len(model), np.bool_)
    laid[list(new)] = True
    used = points if prefer_points else leave_out_points(points, laid)
    rules = RoofOptions(clearance=options.clearance, cut_price=options.roof_price)
    again = full and options.roofs == "planes" and (prefer_points or not laid.all())
    closer = (min(FULL_CLEARANCE, options.clearance), FULL_PRICE * options.roof_price) if again else None
    fitted, finer = fit_roofs(model.polygons, used, rules, closer)
    if prefer_points:
        laid &= fitted.too_few
        new = {row: roof for row, roof in new.items() if laid[row]}
    fitted = replace_roofs(fitted, new)
    left = ~laid & (fitted.too_few if options.roofs == "planes" else True)
    given = np.isfinite(city.forms[:, SHAPE])
    fitted, form, notes = form_roofs(fitted, city, points, given & left)
    form[given & ~left & ~laid] = POINTS_TELL
    told = city.roof_source != ROOF_SOURCES.index("default")
    hipped = left & (form < 0) & (told if options.roofs == "planes" else True)
    fitted = shape_roofs(fitted, model.polygons, hipped, model.ground, model.roof)
    whole = fitted if full else None
    if finer is not None:
        rows = np.flatnonzero(laid | left)
        whole = replace_roofs(finer, {row: take_roof(fitted, row) for row in rows.tolist()})
    return fitted, whole, form, [*told_of, *notes]


def leave_out_points(points: RoofPoints, without: NDArray[np.bool_]) -> RoofPoints:
    """Take the points of some houses, bool (h,), away."""
    if not without.any():
        return points
    kept = keep_roof_points(points, ~without)
    return add_roof_points(no_roof_points(len(without)), np.flatnonzero(~without), kept)


def _collect_roof_points(
    cloud: PointCloud, parts: HouseParts, roofs: RoofPoints, unmarked: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Roof points of parts: of class 6 inside, and for unmarked houses those of the house inside."""
    mine = unmarked[parts.house]
    marked = locate_roof_points(cloud, parts.polygons[~mine], building_class=True)
    own = divide_roof_points(roofs, parts.polygons[mine], parts.house[mine])
    found = add_roof_points(no_roof_points(len(mine)), np.flatnonzero(~mine), marked)
    found = add_roof_points(found, np.flatnonzero(mine), own)
    return found.start, found.z


def name_parts(ids: NDArray[np.str_], row: NDArray[np.int64], reserved: Set[str]) -> NDArray[np.str_]:
    """Ids of faces; those of a house of several are numbered, reserved names left out."""
    count = np.bincount(row, minlength=len(ids))
    seen = np.zeros(len(ids), np.int64)
    names = []
    for k in row.tolist():
        seen[k] += 1
        name = str(ids[k])
        part = name if count[k] == 1 else f"{name}-part{seen[k]}"
        while count[k] > 1 and part in reserved:
            part += "-"
        names.append(part)
    return np.array(names, dtype=np.str_)


def find_fallbacks(houses: Houses) -> NDArray[np.int8]:
    """Index into `ROOF_FALLBACKS` of each house."""
    count = np.bincount(houses.parts.house, np.diff(houses.points.roof_start), len(houses))
    reason = np.where(houses.too_few, np.where(count > 0, FEW_POINTS, NO_POINTS), 0)
    return np.where((houses.method == FLAT) & (houses.form < 0), reason, 0).astype(np.int8)


def find_model_roofs(houses: Houses) -> Roofs | None:
    """Give the roofs of the parts that a city model tells, NaN for others; None if there is no such part."""
    told = houses.method[houses.parts.house] == MODEL
    if not told.any():
        return None
    return choose_roofs(told, houses.roofs, flat_roofs(np.full(len(told), np.nan)))


def take_houses(houses: Houses, rows: NDArray[np.int64]) -> Houses:
    """Take some houses, in the order of `rows`, int64 (k,), none of them twice."""
    parts = houses.parts
    number = np.full(len(houses), -1)
    number[rows] = np.arange(len(rows))
    mine = np.flatnonzero(number[parts.house] >= 0)
    mine = mine[np.argsort(number[parts.house[mine]], kind="stable")]
    return Houses(
        houses.ids[rows],
        houses.polygons[rows],
        houses.given_height[rows],
        HouseParts(parts.polygons[mine], number[parts.house[mine]]),
        take_roofs(houses.roofs, mine),
        houses.method[rows],
        houses.too_few[rows],
        houses.form[rows],
        take_building_points(houses.points, mine),
    )


def join_houses(several: Sequence[Houses]) -> Houses:
    """Put the houses of several tiles one after the other; none gives none."""
    first = np.cumsum([0, *(len(houses) for houses in several)])
    shift = [houses.parts.house + begin for houses, begin in zip(several, first, strict=False)]
    nothing = np.empty(0)
    return Houses(
        np.concatenate([nothing.astype(np.str_), *(houses.ids for houses in several)]),
        np.concatenate([nothing.astype(object), *(houses.polygons for houses in several)]),
        np.concatenate([nothing, *(houses.given_height for houses in several)]),
        HouseParts(
            np.concatenate([nothing.astype(object), *(houses.parts.polygons for houses in several)]),
            np.concatenate([nothing.astype(np.int64), *shift]),
        ),
        join_roofs([houses.roofs for houses in several]),
        np.concatenate([np.empty(0, np.int8), *(houses.method for houses in several)]),
        np.concatenate([np.empty(0, np.bool_), *(houses.too_few for houses in several)]),
        np.concatenate([np.empty(0, np.int8), *(houses.form for houses in several)]),
        join_building_points([houses.points for houses in several]),
    )
