"""Houses and city models as plain arrays for the store, and back."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from itertools import chain, pairwise
from typing import Any, TypeVar

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import BuildingPoints
from pipeline.city_model.city import City
from pipeline.city_model.houses import Houses
from pipeline.data.citymodel import CityModel, Prisms
from pipeline.data.roofs import Roofs, join_roofs, take_roofs
from pipeline.quality.point_fidelity import HouseFidelity
from pipeline.roofs.house_levels import HouseParts
from tiler.pointclouds.cells import meets_box
from tiler.vectors.wkb import cut_blobs, join_blobs

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Buildings:
    """Buildings of a city model as the stages pass them on, ``n`` of them."""

    model: CityModel
    roof_source: NDArray[np.int8]  # (n,): where the roof's height comes from: index into `heights.ROOF_SOURCES`
    measured_roof: NDArray[np.float64]  # (n,): roof heights (m) before roofs were grouped and raised
    wall_ground: NDArray[np.float64]  # (n,): highest terrain at the walls (m)
    group: NDArray[np.int64]  # (n,): buildings of one group have one roof
    layers: NDArray[np.int32]  # (n,): layers that the layered mesher removes; 0 with the other one
    fidelity: HouseFidelity  # how the roof fits its points
    # (n,): as of `City`
    roof_method: NDArray[np.int8]
    roof_fallback: NDArray[np.int8]
    roof_form: NDArray[np.int8]
    # (n,): level of detail that the zone of its house asks for: index into `zones.LEVELS`; -1 without zones
    level: NDArray[np.int8] = field(default_factory=lambda: np.empty(0, np.int8))
    # (n, 2): representative point of the house, which decides on its zone (m); NaN without zones
    place: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))

    def __post_init__(self) -> None:
        """Put no building into a zone where none is stated."""
        if len(self.level) != len(self.model):
            object.__setattr__(self, "level", np.full(len(self.model), -1, np.int8))
            object.__setattr__(self, "place", np.full((len(self.model), 2), np.nan))

    def __len__(self) -> int:
        return len(self.model)


@dataclass(frozen=True, eq=False)
class NearBuildings:
    """Buildings of a city model around a box, as meshing and measuring need them, by ascending id."""

    model: Prisms
    # As of `Buildings`.
    wall_ground: NDArray[np.float64]
    group: NDArray[np.int64]
    layers: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.model)


Rows = TypeVar("Rows", Buildings, NearBuildings)


def pack_polygons(polygons: NDArray[np.object_], name: str) -> Arrays:
    """Write polygons as well-known binary: bytes one after the other, and where each starts."""
    data, start = join_blobs(shapely.to_wkb(polygons, byte_order=1))
    return {name: data, f"{name}_start": start}


def unpack_polygons(
    arrays: Arrays, name: str, rows: NDArray[np.integer[Any]] | None = None
) -> NDArray[np.object_]:
    """Read what `pack_polygons` wrote, or some rows of it."""
    blobs = cut_blobs(arrays[name], arrays[f"{name}_start"])
    polygons: NDArray[np.object_] = shapely.from_wkb(blobs if rows is None else blobs[rows])
    return polygons


ROOF_ARRAYS = ("roof_plane", "roof_origin", "roof_limits")


def pack_roofs(roofs: Roofs) -> Arrays:
    """Write roofs as arrays."""
    return dict(zip(ROOF_ARRAYS, (roofs.plane, roofs.origin, roofs.limits), strict=True))


def unpack_roofs(arrays: Arrays) -> Roofs:
    """Read what `pack_roofs` wrote."""
    return Roofs(*(arrays[name] for name in ROOF_ARRAYS))


def pack_houses(houses: Houses) -> Arrays:
    """Write houses, their parts and the points of these as arrays."""
    return {
        **pack_polygons(houses.polygons, "outline"),
        "ids": houses.ids,
        "given_height": houses.given_height,
        **pack_polygons(houses.parts.polygons, "part"),
        "part_house": houses.parts.house,
        **{f"part_{name}": values for name, values in pack_roofs(houses.roofs).items()},
        "method": houses.method,
        "too_few": houses.too_few,
        "form": houses.form,
        "roof_start": houses.points.roof_start,
        "roof_z": houses.points.roof_z,
        "ground_start": houses.points.ground_start,
        "ground_z": houses.points.ground_z,
    }


POINTS = ("roof", "ground")
HOUSE_ROWS = (
    "ids",
    "given_height",
    "part_house",
    "method",
    "too_few",
    "form",
    *(f"part_{name}" for name in ROOF_ARRAYS),
)
# What simplifying houses takes, and giving them heights after that.
ARRAYS_TO_SHAPE = (*HOUSE_ROWS, "part", "part_start")
ARRAYS_TO_RAISE = (*HOUSE_ROWS, "outline", "outline_start", "roof_start", "roof_z", "ground_start", "ground_z")


def unpack_houses(arrays: Arrays) -> Houses:
    """Read what `pack_houses` wrote: of arrays that are not there, polygons are None and points none."""
    n, n_parts = len(arrays["ids"]), len(arrays["part_house"])
    none = np.zeros(n_parts + 1, np.int64), np.empty(0)
    roof, ground = ((arrays.get(f"{name}_start", none[0]), arrays.get(f"{name}_z", none[1])) for name in POINTS)
    return Houses(
        arrays["ids"],
        unpack_polygons(arrays, "outline") if "outline" in arrays else np.full(n, None),
        arrays["given_height"],
        HouseParts(
            unpack_polygons(arrays, "part") if "part" in arrays else np.full(n_parts, None), arrays["part_house"]
        ),
        Roofs(*(arrays[f"part_{name}"] for name in ROOF_ARRAYS)),
        arrays["method"],
        arrays["too_few"],
        arrays["form"],
        BuildingPoints(*roof, *ground),
    )


FIDELITY_ARRAYS = {
    "n_points": "fidelity_points",
    **{name: f"fidelity_{name}" for name in ("rmse", "bias", "coverage", "median", "within")},
}
# Columns of `Buildings` that are arrays of the same name, in this order; and further ones of a run with zones.
OWN_ARRAYS = (
    *("roof_source", "measured_roof", "wall_ground", "group", "layers"),
    *("roof_method", "roof_fallback", "roof_form"),
)
ZONE_ARRAYS = ("level", "place")
BUILDING_ARRAYS = (
    *("polygon", "polygon_start", "id", "number", "house", "ground", "member", "member_start"),
    *ROOF_ARRAYS,
    *OWN_ARRAYS,
    *FIDELITY_ARRAYS.values(),
)


def make_buildings(city: City, fidelity: HouseFidelity, layers: NDArray[np.int32]) -> Buildings:
    """Take from a city what later stages need."""
    own: dict[str, Any] = {name: getattr(city, name) for name in OWN_ARRAYS if name != "layers"}
    own["group"] = city.group.astype(np.int64)
    return Buildings(model=city.model, fidelity=fidelity, layers=layers, **own)


def pack_buildings(buildings: Buildings, prefix: str = "", *, zoned: bool = False) -> Arrays:
    """Write buildings as arrays, `zoned` with the level that zones ask for."""
    model, fidelity = buildings.model, buildings.fidelity
    members = [name for names in model.members for name in names]
    arrays: Arrays = {
        **pack_polygons(model.polygons, "polygon"),
        "id": model.ids,
        "number": model.numbers,
        "house": model.house,
        "ground": model.ground,
        "roof": model.roof,
        **pack_roofs(model.roofs),
        "member": np.array(members, dtype=np.str_),
        "member_start": np.cumsum([0, *(len(names) for names in model.members)], dtype=np.int64),
        **{name: getattr(buildings, name) for name in OWN_ARRAYS},
        **{name: getattr(fidelity, key) for key, name in FIDELITY_ARRAYS.items()},
    }
    if zoned:
        arrays |= {name: getattr(buildings, name) for name in ZONE_ARRAYS}
    return {prefix + name: values for name, values in arrays.items()}


def unpack_buildings(arrays: Arrays, prefix: str = "") -> Buildings:
    """Read what `pack_buildings` wrote."""
    arrays = {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
    names, start = arrays["member"].tolist(), arrays["member_start"].tolist()
    model = CityModel(
        unpack_polygons(arrays, "polygon"),
        arrays["id"],
        arrays["number"],
        arrays["ground"],
        unpack_roofs(arrays),
        tuple(tuple(names[a:b]) for a, b in pairwise(start)),
        arrays["house"],
    )
    fidelity = HouseFidelity(**{key: arrays[name] for key, name in FIDELITY_ARRAYS.items()})
    own: dict[str, Any] = {name: arrays[name] for name in OWN_ARRAYS}
    own |= {name: arrays[name] for name in ZONE_ARRAYS if name in arrays}
    return Buildings(model=model, fidelity=fidelity, **own)


NEAR_ARRAYS = (
    *("polygon", "polygon_start", "extents", "id", "number", "ground"),
    *ROOF_ARRAYS,
    *("wall_ground", "group", "layers"),
)


def pack_model(buildings: Buildings, *, zoned: bool = False) -> Arrays:
    """Write the buildings of the stage ``model`` as arrays, with the boxes by which `take_near` finds some."""
    return pack_buildings(buildings, zoned=zoned) | {"extents": shapely.bounds(buildings.model.polygons)}


def find_changed(old: Arrays, new: Arrays) -> list[tuple[float, float, float, float]]:
    """Find where two states of `NEAR_ARRAYS` differ: boxes (m) of the buildings that changed, before and after."""
    before, after = rows_by_id(old), rows_by_id(new)
    changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    return [state[name][0] for name in changed for state in (before, after) if name in state]


def rows_by_id(arrays: Arrays, names: Sequence[str] = NEAR_ARRAYS) -> dict[str, tuple[Any, ...]]:
    """Box, and of all else the bytes, of each building of the stage ``model`` by its id."""
    cut = {name for name in ("polygon", "member") if name in names}
    whole = [arrays[name] for name in names if name.removesuffix("_start") not in {*cut, "id"}]
    parts = [(arrays[name], arrays[f"{name}_start"].tolist()) for name in sorted(cut)]
    return {
        name: (
            tuple(box),
            *(values[start[k] : start[k + 1]].tobytes() for values, start in parts),
            *(values[k].tobytes() for values in whole),
        )
        for k, (name, box) in enumerate(zip(arrays["id"].tolist(), arrays["extents"].tolist(), strict=True))
    }


def take_near(arrays: Arrays, box: shapely.Polygon, layers: NDArray[np.int32] | None = None) -> NearBuildings:
    """Read the buildings that meet a box, prepared, from `NEAR_ARRAYS` of the stage ``model``.

    `layers`, int32 (n,), are those of all of them where they were chosen later; by default those of the arrays.
    """
    rows = np.flatnonzero(meets_box(arrays["extents"], box.bounds))
    polygons = unpack_polygons(arrays, "polygon", rows)
    meet = shapely.intersects(box, polygons)
    rows, polygons = rows[meet], polygons[meet]
    ids, numbers, ground = (arrays[name][rows] for name in ("id", "number", "ground"))
    roofs = take_roofs(unpack_roofs(arrays), rows)
    layers = arrays["layers"] if layers is None else layers
    return NearBuildings(
        Prisms(polygons, ids, numbers, ground, roofs),
        arrays["wall_ground"][rows],
        arrays["group"][rows],
        layers[rows],
    )


def join_near(several: Sequence[NearBuildings]) -> NearBuildings:
    """Put what `take_near` gives of several tiles together, as `join_buildings` does."""
    none = no_buildings()
    model = Prisms(*(getattr(none.model, name) for name in _columns(Prisms)))
    return _join_by_id([NearBuildings(model, none.wall_ground, none.group, none.layers), *several])


def take_buildings(buildings: Rows, rows: NDArray[np.integer[Any]]) -> Rows:
    """Take some buildings, in the order of `rows`."""
    taken: Rows = _take(buildings, rows)
    return taken


def no_buildings() -> Buildings:
    """Make an empty city model."""
    text, number, rows = np.empty(0, np.str_), np.empty(0), np.empty(0, np.int64)
    model = CityModel(np.empty(0, object), text, rows, number, join_roofs([]), (), text)
    layers = np.empty(0, np.int32)
    fidelity = HouseFidelity(rows, *(number,) * 5)
    code = np.empty(0, np.int8)
    return Buildings(model, code, number, number, rows, layers, fidelity, code, code, code)


def join_buildings(several: Sequence[Buildings]) -> Buildings:
    """Put the buildings of different tiles together, by ascending id; groups stay apart. None gives none."""
    return _join_by_id([no_buildings(), *several])


def _join_by_id(several: Sequence[Rows]) -> Rows:
    first = np.cumsum([0, *(int(each.group.max(initial=-1)) + 1 for each in several)])
    apart = [replace(each, group=each.group + begin) for each, begin in zip(several, first, strict=False)]
    joined: Rows = _join(apart)
    return take_buildings(joined, np.argsort(joined.model.ids, kind="stable"))


def _join(several: Sequence[Any]) -> Any:
    """Put rows one after the other: of arrays, of tuples, or of dataclasses made of them."""
    one = several[0]
    if columns := _columns(one):
        return type(one)(*(_join([getattr(each, name) for each in several]) for name in columns))
    return tuple(chain.from_iterable(several)) if isinstance(one, tuple) else np.concatenate(several)


def _take(table: Any, rows: NDArray[np.integer[Any]]) -> Any:
    """Take rows of an array, of a tuple, or of a dataclass made of them."""
    if columns := _columns(table):
        return type(table)(*(_take(getattr(table, name), rows) for name in columns))
    return tuple(table[row] for row in rows.tolist()) if isinstance(table, tuple) else table[rows]


def _columns(table: Any) -> list[str]:
    """Names of what a dataclass is made of; none for anything else."""
    return [column.name for column in fields(table)] if is_dataclass(table) else []
