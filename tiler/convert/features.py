"""A building with its parts as all formats have it: vertices on a grid, and geometries by level of detail."""

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.facades.pictures import Picture
from tiler.cityinput.faces import DOOR, GROUND, NO_LOD, PICTURED, ROOF, WALL, WINDOW, Faces, ModelBuilding, Shape
from tiler.convert.inputs import ModelSource

SURFACES = {GROUND: "GroundSurface", ROOF: "RoofSurface", WALL: "WallSurface"}
OPENINGS = {WINDOW: "Window", DOOR: "Door"}
KINDS = {name: kind for kind, name in (SURFACES | OPENINGS).items()}
WITHOUT_LEVEL = 2.0  # what geometries are taken for whose level is not stated

Ring = list[int]
Face = tuple[int, list[Ring]]  # kind of a face, and its rings


@dataclass(frozen=True, eq=False)
class Geometry:
    """Faces of an object at one level of detail: those of a solid, oriented outwards, or a number of surfaces."""

    lod: float
    closed: bool
    faces: list[Face]
    pictures: dict[int, Picture] = field(default_factory=dict)  # by the number of the face that shows each


@dataclass(frozen=True, eq=False)
class CityObject:
    """A building, or another thing of some type of CityJSON, with its id, attributes and geometries.

    A `parent` is the building or part of a storey or an installation.
    """

    kind: str
    id: str
    attributes: dict[str, Any]
    geometries: list[Geometry]
    parent: str = ""


@dataclass(frozen=True, eq=False)
class Feature:
    """A building, then its parts and storeys, on vertices of their own; or a road, a plant cover or a tree.

    `vertices`, int64 (n, 3), are each there once, in steps of the source from its lowest corner, rounded down to a
    whole metre or degree.
    """

    objects: list[CityObject]
    vertices: NDArray[np.int64]


def origin_of(source: ModelSource) -> NDArray[np.float64]:
    """Give the place that vertices of features are counted from, float64 (3,)."""
    return np.floor(source.low)


def iter_features(source: ModelSource) -> Iterator[Feature]:
    """Give what a source holds as features; an id that was there before gets a number behind it."""
    seen: set[int] = set()
    origin, step = origin_of(source), source.step
    for building in source.buildings():
        names = {owner: unique_name(owner or "building", seen) for owner in owners_of(building)}
        again = sum(name != (owner or "building") for owner, name in names.items())
        source.told["ids that were there before, or missing, with a number behind them"] += again
        units = [np.round((shape.faces.xyz - origin) / step).astype(np.int64) for shape in building.shapes]
        rows, number = np.unique(np.concatenate([np.empty((0, 3), np.int64), *units]), axis=0, return_inverse=True)
        ends = np.cumsum([0, *map(len, units)])
        geometries: dict[str, list[Geometry]] = {}
        pictures = iter(building.pictures)
        for shape, (first, last) in zip(building.shapes, pairwise(ends), strict=True):
            found = _make_geometry(shape, number.ravel()[first:last].tolist(), source.told, pictures)
            if found is not None:
                geometries.setdefault(shape.owner, []).append(found)
        objects = [
            CityObject(
                building.kinds.get(owner, "Building" if owner == building.id else "BuildingPart"),
                name,
                {key: plain_value(value) for key, value in building.attributes.get(owner, {}).items()},
                geometries.get(owner, []),
                names.get(building.parents.get(owner, ""), ""),
            )
            for owner, name in names.items()
        ]
        yield Feature(objects, rows)


def owners_of(building: ModelBuilding) -> list[str]:
    """List the building and its parts."""
    return list(dict.fromkeys([building.id, *building.attributes, *(shape.owner for shape in building.shapes)]))


class Seen(Protocol):
    """Whole numbers that were there before: a set, or one on a disk."""

    def __contains__(self, number: object, /) -> bool:
        """Whether it was."""

    def add(self, number: int, /) -> None:
        """Add one."""


def unique_name(name: str, seen: Seen) -> str:
    """Give a name that was not given before, with a number behind it where it was; 8 bytes of each are kept."""
    found, number = name, 1
    while hash(found) in seen:
        number += 1
        found = f"{name}_{number}"
    seen.add(hash(found))
    return found


def _make_geometry(
    shape: Shape, number: list[int], told: Counter[str], pictures: Iterator[Picture]
) -> Geometry | None:
    faces: list[Face] = []
    shown = {}
    for kind, rings in rings_of(shape.faces, number):
        picture = next(pictures) if kind == PICTURED else None
        if rings and picture is not None:
            shown[len(faces)] = picture
        if rings:
            faces.append((kind if picture is None else KINDS[picture.kind], rings))
    told["faces without area"] += len(shape.faces) - len(faces)
    if not faces:
        return None
    told["geometries without a level, taken for level 2"] += shape.lod == NO_LOD
    told["geometries of several solids, written as surfaces"] += shape.several
    lod = WITHOUT_LEVEL if shape.lod == NO_LOD else shape.lod
    return Geometry(lod, shape.closed and not shape.several and lod > 0, faces, shown)


def rings_of(faces: Faces, number: list[int]) -> Iterator[Face]:
    """Give kind and rings of each face by the numbers of its vertices; no rings where its border has collapsed."""
    rings = [_without_repeats(number[a:b]) for a, b in pairwise(faces.ring_start.tolist())]
    for kind, (first, last) in zip(faces.kind.tolist(), pairwise(faces.face_start.tolist()), strict=True):
        border = rings[first]
        yield kind, [border, *filter(None, rings[first + 1 : last])] if border else []


def _without_repeats(ring: Ring) -> Ring:
    kept = [vertex for k, vertex in enumerate(ring) if vertex != ring[k - 1]]
    return kept if len(kept) >= 3 else []


def plain_value(value: Any) -> Any:
    """Give a value as JSON has it: NaN and infinity are None."""
    if isinstance(value, Mapping):
        return {str(key): plain_value(one) for key, one in value.items()}
    if isinstance(value, list):
        return [plain_value(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def attribute_text(value: Any) -> str:
    """Write a value as one text, lists and mappings as JSON."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def level_text(lod: float) -> str:
    """Write a level of detail: 2, 1.3."""
    return f"{lod:g}"
