"""Augmentation: footprints with heights, storeys and roofs by rules where their attributes say nothing."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.architecture.draw import LEAST_RISE, Ground, draw_house
from pipeline.architecture.lots import Lot, lot_random
from pipeline.architecture.parameters import House, Rings
from pipeline.architecture.roof_sides import list_sides
from pipeline.architecture.rules import Distribution
from pipeline.data.errors import GeometryError, InputError
from tiler.formats.gpkg import Column, fixed_time, write_rows
from tiler.towns.synthetic_files import DAY

# Attributes that win over rules, by what they give: the first that a file has.
NAMES = {
    "id": ("id", "identificatie", "osm_id"),
    "height": ("height", "measuredHeight"),
    "storeys": ("building:levels", "storeysAboveGround", "storeys"),
    "shape": ("roof:shape", "roofShape"),
    "rise": ("roof:height",),
    "year": ("yearOfConstruction", "year", "bouwjaar"),
    "use": ("usage", "use"),
    "ground": ("ground",),
}
_SHAPES = {"skillion": "shed", **{name: name for name in ("flat", "shed", "gabled", "hipped", "pyramidal")}}
_WORDS = {"shed": "skillion"}  # of OpenStreetMap, where they are other ones
RECTANGLE = 0.97  # of the least rectangle around: outlines that fill so much are houses with walls and openings
STRAIGHT = 0.01  # m, of corners from the wall that they are left out of
CLEARANCE = 0.03  # m, least one of the sides of a roof, which are rounded to millimetres
_BESIDE = 0.15  # m from a wall: what lies there shares it


@dataclass(frozen=True, eq=False)
class Augmented:
    """Footprints with what rules and attributes say of them."""

    outlines: NDArray[np.object_]  # (n,): polygons and multipolygons of the file
    # ``id``, ``height`` (m, to the ridge), ``building:levels``, ``roof:shape`` and ``roof:height`` of each.
    columns: Mapping[str, NDArray[Any]]
    houses: Sequence[House]  # those of rectangular outlines
    crs: str  # of the file
    # How many attributes were taken, how many outlines are no houses, and what could not be read.
    counts: Counter[str]


def augment(
    path: Path, rules: Mapping[str, Distribution], *, seed: int, ground: Ground = lambda x, y: 0.0
) -> Augmented:
    """Draw what the attributes of footprints, polygons of a file in a metric CRS, do not say; all are in memory.

    Rectangles are houses with walls and openings; outlines of any form are where the rules have footprints that
    are no rectangles.

    Houses without a height of their ground stand on `ground`.

    What is drawn depends on `seed`, not negative, the rules, the attributes and the place of a footprint alone.

    Raises
    ------
    InputError
        If the file cannot be read, or its CRS is not metric.
    """
    try:
        meta, _, wkb, values = pyogrio.raw.read(path)
    except (OSError, pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise InputError(f"{path}: cannot be read ({error}); give a vector file of polygons") from error
    crs = pyproj.CRS(meta["crs"]) if meta["crs"] else None
    if crs is None or not crs.is_projected or crs.axis_info[0].unit_name != "metre":
        raise InputError(
            f"{path}: its CRS is {crs.name if crs else 'unknown'}; expected a projected one in metres"
        )
    outlines = shapely.force_2d(shapely.from_wkb(wkb))
    if not len(outlines):
        raise InputError(f"{path}: has no features; give a file with footprints")
    table = dict(zip(meta["fields"].tolist(), values, strict=True))
    given = {what: next((table[name] for name in names if name in table), None) for what, names in NAMES.items()}
    tree = shapely.STRtree(outlines)
    counts: Counter[str] = Counter()
    any_form = rules["footprint"].values != ("rectangle",)
    rows, houses = [], []
    for number, outline in enumerate(outlines.tolist()):
        if outline is None or outline.is_empty or not outline.area > 0:
            raise InputError(f"{path}, feature {number}: has no area; remove it")
        told = dict(_read_attributes({k: v[number] for k, v in given.items() if v is not None}, counts))
        name = str(told.pop("id", f"F{number:07d}"))
        drawn = _draw(rules, outline, told, seed)
        rows.append((name, *drawn.describe()))
        rectangular = outline.area >= RECTANGLE * shapely.minimum_rotated_rectangle(outline).area
        if outline.geom_type != "Polygon" or not (rectangular or any_form) or drawn.shape is None:
            counts["footprints that are no rectangles, or have another roof: without walls and openings"] += 1
            continue
        try:
            house = _make_house(rules, outline, drawn, tree, number, seed, ground, rectangular=rectangular)
        except GeometryError:
            counts["footprints whose roof has slivers: without walls and openings"] += 1
            continue
        houses.append(replace(house, id=name))
    names = ("id", "height", "building:levels", "roof:shape", "roof:height")
    kinds = (object, np.float64, np.int32, object, np.float64)
    columns = {
        name: np.array(column, kind)
        for name, column, kind in zip(names, zip(*rows, strict=True), kinds, strict=True)
    }
    return Augmented(outlines, columns, houses, crs.to_string(), counts)


def write_augmented(path: Path, found: Augmented) -> None:
    """Write footprints with their attributes as a GeoPackage that `citystitch run` takes roofs from."""
    path.unlink(missing_ok=True)
    single = bool((shapely.get_type_id(found.outlines) == shapely.GeometryType.POLYGON).all())
    kind = "Polygon" if single else "Unknown"
    columns: dict[str, Column] = {name: (values, None) for name, values in found.columns.items()}
    with fixed_time(DAY):
        wkb = shapely.to_wkb(found.outlines)
        write_rows(path, wkb, columns, layer="footprints", crs=found.crs, kind=kind)


@dataclass(frozen=True)
class _Drawn:
    """What a footprint has: by its attributes, else by rules; ``shape`` is None for a roof that is not ours."""

    shape: str | None
    word: str
    storeys: int
    eaves: float
    rise: float
    run: float
    ground: float | None
    year: int
    use: str

    def describe(self) -> tuple[float, int, str, float]:
        return round(self.eaves + self.rise, 3), self.storeys, self.word, round(self.rise, 3)


def _read_attributes(row: Mapping[str, Any], counts: Counter[str]) -> Iterator[tuple[str, Any]]:
    """Read what a row says; numbers that are none are counted, and rules hold."""
    for what, value in row.items():
        if value is None or value == "" or (isinstance(value, float) and math.isnan(value)):
            continue
        if what in ("id", "shape", "use"):
            yield what, str(value)
        else:
            try:
                number = float(value)
            except (TypeError, ValueError):
                number = math.nan
            if not math.isfinite(number) or (number <= 0 and what in ("height", "storeys")) or (
                number < 0 and what == "rise"
            ):  # fmt: skip
                counts[f"attributes of {what} that are no such number: drawn by rules"] += 1
                continue
            yield what, number
        counts[f"attributes of {what} taken"] += 1


def _draw(rules: Mapping[str, Distribution], outline: Any, told: Mapping[str, Any], seed: int) -> _Drawn:
    centre = outline.centroid
    rng = lot_random(seed, round(1000 * centre.x), round(1000 * centre.y), 3)
    drawn = {name: rules[name].draw(rng) for name in ("roof_shape", "roof_pitch", "storeys", "storey_height")}
    drawn |= {name: rules[name].draw(rng) for name in ("year", "use")}
    word = str(told.get("shape", drawn["roof_shape"])).lower()
    shape = _SHAPES.get(word)
    run = shapely.maximum_inscribed_circle(outline).length * (2 if shape == "shed" else 1)
    rise = float(told.get("rise", run * math.tan(math.radians(float(drawn["roof_pitch"])))))
    height, storey = told.get("height"), float(drawn["storey_height"])
    if height is not None and "rise" not in told:
        rise = min(rise, height / 2)
    if shape == "flat" or rise < LEAST_RISE or (height is not None and height <= rise):
        shape, word, rise = ("flat" if shape else None), ("flat" if shape else word), 0.0
    if height is None:
        storeys = int(told.get("storeys", round(float(drawn["storeys"]))))
        eaves = storeys * storey
    else:
        eaves = height - rise
        storeys = int(told.get("storeys", max(round(eaves / storey), 1)))
    year, use = int(told.get("year", drawn["year"])), str(told.get("use", drawn["use"]))
    ground = told.get("ground")
    return _Drawn(shape, _WORDS.get(word, word), max(storeys, 1), eaves, rise, run, ground, year, use)


def _make_house(
    rules: Mapping[str, Distribution],
    outline: Any,
    drawn: _Drawn,
    tree: Any,
    number: int,
    seed: int,
    ground: Ground,
    *,
    rectangular: bool,
) -> House:
    """Draw parts of the roof and openings of an outline whose sizes are known."""
    corners = shapely.get_coordinates(shapely.orient_polygons(shapely.minimum_rotated_rectangle(outline)))[:4]
    sides = np.diff(corners, axis=0, append=corners[:1])
    lengths = np.hypot(*sides.T)
    first = int(np.argmax(lengths[:2]))
    length, width = float(lengths[first]), float(lengths[1 - first])
    shed = drawn.shape == "shed"
    fixed: dict[str, float | str] = {
        **{"length": length, "width": width, "storeys": drawn.storeys},
        **{"storey_height": drawn.eaves / drawn.storeys, "roof_shape": str(drawn.shape)},
        "roof_pitch": math.degrees(math.atan(drawn.rise / (width if shed else width / 2))),
        **{"garage": 0.0, "alcove": 0.0, "overhang": 0.0, "year": drawn.year, "use": drawn.use},
    }
    own = {**rules, **{name: Distribution("constant", (value,)) for name, value in fixed.items()}}
    rings = [np.roll(corners, -first, axis=0)] if rectangular else _walls_from_longest(outline)
    begin = np.concatenate(rings)
    walls = np.concatenate([np.roll(ring, -1, axis=0) - ring for ring in rings])
    outward = np.column_stack((walls[:, 1], -walls[:, 0])) / np.hypot(*walls.T)[:, None]
    # A rectangle shares the walls whose middle another outline touches; others those it touches anywhere.
    shares = (0.5, 0.5) if rectangular else (0.02, 0.98)
    ends = [begin + share * walls + _BESIDE * outward for share in shares]
    near, wall = tree.query(shapely.linestrings(np.stack(ends, axis=1)), "intersects")[::-1]
    shared = {k for other, k in zip(near.tolist(), wall.tolist(), strict=True) if other != number}
    centre = corners.mean(axis=0)
    place = (round(1000 * float(centre[0])), round(1000 * float(centre[1])))
    size = math.hypot(length, width) + 3.0  # that nothing is made smaller
    rotation = round(math.degrees(math.atan2(sides[first, 1], sides[first, 0])), 3)
    plan: Rings = ()
    if not rectangular:
        turn = math.radians(rotation)
        axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        middle = (round(length, 3) / 2, round(width, 3) / 2)
        local = [np.round((ring - centre) @ axes + middle, 6).tolist() for ring in rings]
        plan = tuple(tuple((x, y) for x, y in ring) for ring in local)
    lot = Lot(*place, float(centre[0]), float(centre[1]), size, rotation)
    rise = None if rectangular else round(drawn.rise, 3)
    foot = ground if drawn.ground is None else lambda x, y: drawn.ground
    house = draw_house(own, lot, foot, seed=seed, plan=plan, rise=rise)
    if plan and min(shapely.minimum_clearance(side.polygon) for side in list_sides(house)) < CLEARANCE:
        raise GeometryError(f"house {house.id}: a side of its roof is narrower than {CLEARANCE:g} m")
    return replace(house, openings=tuple(one for one in house.openings if one.wall not in shared))


def _walls_from_longest(outline: shapely.Polygon) -> list[NDArray[np.float64]]:
    """Corners (m): of the border counter-clockwise from its longest outer wall, of courtyards clockwise."""
    plain = shapely.orient_polygons(shapely.simplify(outline, STRAIGHT))
    border, *holes = (shapely.get_coordinates(ring)[:-1] for ring in (plain.exterior, *plain.interiors))
    walls = np.roll(border, -1, axis=0) - border
    long = np.hypot(*walls.T)
    across = border[None] - border[:, None]  # from the start of each wall to each corner
    inwards = (walls[:, None, 0] * across[..., 1] - walls[:, None, 1] * across[..., 0]) / long[:, None]
    outer = (inwards > -STRAIGHT).all(axis=1)
    return [np.roll(border, -int(np.argmax(np.round(long, 3) + 1e6 * outer)), axis=0), *holes]
