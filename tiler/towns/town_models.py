"""City models of towns: CityJSONSeq, all levels of detail of a house in one object."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pyproj

from pipeline.architecture.faults import Fault
from pipeline.architecture.interiors import make_interior
from pipeline.architecture.levels import Footprint, Volume, make_level
from pipeline.architecture.lots import Lot
from pipeline.architecture.parameters import House
from pipeline.architecture.plants import Tree, crown_rings
from pipeline.architecture.representations import Representation, make_representation
from pipeline.architecture.roof_sides import Point
from pipeline.data.errors import ConfigError
from tiler.citymodels.cityjson_text import compact, reference_system

# CityGML codes.
_ROOF_TYPES = {"flat": "1000", "shed": "1010", "gabled": "1030", "hipped": "1040", "pyramidal": "1070"}


def model_head(crs: pyproj.CRS) -> str:
    """Give the first line of CityJSONSeq: coordinates are whole millimetres."""
    name = reference_system(crs)
    if name is None:
        raise ConfigError(f"{crs.name}: has no EPSG code, which CityJSON names it by")
    head = compact(
        {
            "type": "CityJSON",
            "version": "2.0",
            "transform": {"scale": [0.001] * 3, "translate": [0.0] * 3},
            "metadata": {"referenceSystem": name},
            "CityObjects": {},
            "vertices": [],
        }
    )
    return head + "\n"


def house_feature(
    house: House, *, levels: Sequence[str], footprint: Footprint = "walls", top: str = "half", solid: bool = True
) -> str:
    """Give the line of a house in CityJSONSeq: all levels side by side, parameters as of `make_level`."""
    made = {level: make_level(house, level, footprint=footprint, top=top, solid=solid) for level in levels}
    return _house_line(house, made)


def variant_feature(house: House, asked: Representation) -> str:
    """Give the line of a house in one of its representations; what is inside are storeys of the building."""
    semantics = asked.kind != "surfaces"
    if not asked.interior:
        made = {asked.level: make_representation(house, asked)}
        return _house_line(house, made, semantics=semantics)
    vertices = _Vertices()
    objects, names = _describe_parts(house)
    for room in make_interior(house, asked.level):
        owner = names[room.volume.part]
        geometry = [_geometry(asked.level, room.volume, vertices, semantics=False)]
        if room.storey < 0:
            objects[owner]["geometry"] = geometry
            continue
        name = f"{owner}-storey-{room.storey}"
        objects[owner].setdefault("children", []).append(name)
        objects[name] = {
            "type": "BuildingStorey",
            "parents": [owner],
            "attributes": {"storey": room.storey},
            "geometry": geometry,
        }
    return _feature_line(house.id, objects, vertices)


def fault_feature(fault: Fault, corner: Point) -> str:
    """Give the line of a building whose solids are as they are, moved to a corner (m)."""
    vertices = _Vertices()

    def place(ring: Sequence[Point]) -> list[int]:
        return vertices.ring(
            [(round(x + corner[0], 3), round(y + corner[1], 3), z + corner[2]) for x, y, z in ring]
        )

    name, kind, _ = fault
    solids = [[[[place(ring) for ring in face] for face in shell] for shell in solid] for solid in fault.solids]
    objects: dict[str, Any] = {name: {"type": "Building", "attributes": {"fault": name}}}
    if kind == "BuildingPart":
        objects[name]["children"] = [f"{name}-part-{k + 1}" for k in range(len(solids))]
        for part, solid in zip(objects[name]["children"], solids, strict=True):
            geometry = [{"type": "Solid", "lod": "1.2", "boundaries": solid}]
            objects[part] = {"type": kind, "parents": [name], "geometry": geometry}
    else:
        boundaries: Any = solids[0] if kind == "Solid" else solids
        objects[name]["geometry"] = [{"type": kind, "lod": "1.2", "boundaries": boundaries}]
    return _feature_line(name, objects, vertices)


def lot_feature(lot: Lot, ground: Callable[[float, float], float]) -> str:
    """Give the line of a piece of a street or of the green of a courtyard: two triangles on the ground."""
    half = lot.size / 2
    corners = [(lot.x - half, lot.y - half), (lot.x + half, lot.y - half), (lot.x + half, lot.y + half)]
    corners.append((lot.x - half, lot.y + half))
    places = [(round(x, 3), round(y, 3), round(float(ground(x, y)), 3)) for x, y in corners]
    vertices = _Vertices()
    faces = [[vertices.ring([places[0], places[k], places[k + 1]])] for k in (1, 2)]
    street = lot.use == "street"
    name = f"{'road' if street else 'green'}-{lot.i}-{lot.j}"
    geometry: dict[str, Any] = {"type": "MultiSurface", "lod": "1.0", "boundaries": faces}
    if street:
        geometry["semantics"] = {"surfaces": [{"type": "TrafficArea"}], "values": [0, 0]}
    thing = {"type": "Road" if street else "PlantCover", "geometry": [geometry]}
    return _feature_line(name, {name: thing}, vertices)


def tree_feature(tree: Tree) -> str:
    """Give the line of a tree: its crown as a surface of triangles and quadrilaterals."""
    vertices = _Vertices()
    rings = [[(round(x, 3), round(y, 3), round(z, 3)) for x, y, z in ring] for ring in crown_rings(tree)]
    faces = []
    for low, high in pairwise(rings):
        n = max(len(low), len(high))
        for k in range(n):
            a, b = low[k % len(low)], low[(k + 1) % n % len(low)]
            c, d = high[(k + 1) % n % len(high)], high[k % len(high)]
            faces.append([vertices.ring(list(dict.fromkeys((a, b, c, d))))])
    name = f"tree-{tree.i}-{tree.j}"
    thing = {
        "type": "SolitaryVegetationObject",
        "attributes": {"height": tree.height, "crownDiameter": round(2 * tree.radius, 3)},
        "geometry": [{"type": "MultiSurface", "lod": "2.0", "boundaries": faces}],
    }
    return _feature_line(name, {name: thing}, vertices)


def describe_house(house: House) -> dict[str, Any]:
    """Give the attributes of a house."""
    return {
        "yearOfConstruction": house.year,
        "storeysAboveGround": house.storeys,
        "usage": house.use,
        "roofType": _ROOF_TYPES[house.roof.shape],
        "roofShape": house.roof.shape,
        "measuredHeight": round(house.height + house.roof.rise, 3),
    }


class _Vertices:
    """Vertices of a feature, on whole millimetres, each once."""

    def __init__(self) -> None:
        self._number: dict[tuple[float, float, float], int] = {}

    def ring(self, places: Sequence[tuple[float, float, float]]) -> list[int]:
        """Give the numbers of the vertices of a ring."""
        number = self._number
        return [number.setdefault(place, len(number)) for place in places]

    def rows(self) -> list[list[int]]:
        """Give all by their numbers, in millimetres."""
        rows: list[list[int]] = np.rint(1000 * np.array(list(self._number))).astype(np.int64).tolist()
        return rows


def _house_line(house: House, made: dict[str, list[Volume]], *, semantics: bool = True) -> str:
    vertices = _Vertices()
    objects, names = _describe_parts(house)
    for level, volumes in made.items():
        for volume in volumes:
            geometry = _geometry(level, volume, vertices, semantics=semantics)
            objects[names[volume.part]]["geometry"].append(geometry)
    return _feature_line(house.id, objects, vertices)


def _describe_parts(house: House) -> tuple[dict[str, Any], dict[int, str]]:
    """Give the objects of a house and its parts without geometry, and their names by `Volume.part`."""
    names = {k: f"{house.id}-{part.kind}-{k + 1}" for k, part in enumerate(house.parts)}
    objects: dict[str, Any] = {house.id: {"type": "Building", "attributes": describe_house(house), "geometry": []}}
    if names:
        objects[house.id]["children"] = list(names.values())
    for name, part in zip(names.values(), house.parts, strict=True):
        objects[name] = {
            "type": "BuildingPart",
            "parents": [house.id],
            "attributes": {"function": part.kind, "measuredHeight": part.height},
            "geometry": [],
        }
    return objects, names | {-1: house.id}


def _feature_line(name: str, objects: dict[str, Any], vertices: _Vertices) -> str:
    told = {"type": "CityJSONFeature", "id": name, "CityObjects": objects, "vertices": vertices.rows()}
    return compact(told) + "\n"


def _geometry(level: str, volume: Volume, vertices: _Vertices, *, semantics: bool) -> dict[str, Any]:
    faces = [[vertices.ring(ring) for ring in (surface.border, *surface.holes)] for surface in volume.surfaces]
    told: dict[str, Any] = {"type": "Solid" if volume.closed else "MultiSurface", "lod": level}
    told["boundaries"] = [faces] if volume.closed else faces
    if not semantics:
        return told
    kinds = list(dict.fromkeys(surface.kind for surface in volume.surfaces))
    rows = [kinds.index(surface.kind) for surface in volume.surfaces]
    told["semantics"] = {
        "surfaces": [{"type": kind} for kind in kinds],
        "values": [rows] if volume.closed else rows,
    }
    return told
