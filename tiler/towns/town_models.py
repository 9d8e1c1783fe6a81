"""City models of towns: CityJSONSeq, all levels of detail of a house in one object."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from pipeline.architecture.levels import Footprint, Volume, make_level
from pipeline.architecture.parameters import House
from pipeline.data.errors import ConfigError

_ROOF_TYPES = {
    "flat": "1000",
    "shed": "1010",
    "gabled": "1030",
    "hipped": "1040",
    "pyramidal": "1070",
}  # CityGML codes


def write_models(
    houses: Iterable[House],
    path: Path,
    *,
    crs: pyproj.CRS,
    levels: Sequence[str],
    footprint: Footprint = "walls",
    top: str = "half",
    solid: bool = True,
) -> int:
    """Write CityJSONSeq 2.0, a house a line, and give their number.

    Parameters
    ----------
    houses : iterable of House
        One at a time is in memory.
    path : Path
        The file.
    crs : CRS
        Of the town.
    levels, footprint, top, solid
        As of `make_level`; all levels stand side by side.
    """
    code = crs.to_epsg()
    if code is None:
        raise ConfigError(f"{crs.name}: has no EPSG code, which CityJSON names it by")
    head = {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001] * 3, "translate": [0.0] * 3},
        "metadata": {"referenceSystem": f"https://www.opengis.net/def/crs/EPSG/0/{code}"},
        "CityObjects": {},
        "vertices": [],
    }
    number = 0
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(_text(head))
        for house in houses:
            made = {level: make_level(house, level, footprint=footprint, top=top, solid=solid) for level in levels}
            file.write(_text(_feature(house, made)))
            number += 1
    return number


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


def _feature(house: House, made: dict[str, list[Volume]]) -> dict[str, Any]:
    names = [f"{house.id}-{part.kind}-{k + 1}" for k, part in enumerate(house.parts)]
    vertices = _Vertices()
    geometry: dict[str, list[dict[str, Any]]] = {name: [] for name in (house.id, *names)}
    for level, volumes in made.items():
        for volume in volumes:
            owner = house.id if volume.part < 0 else names[volume.part]
            geometry[owner].append(_geometry(level, volume, vertices))
    objects: dict[str, Any] = {
        house.id: {"type": "Building", "attributes": describe_house(house), "geometry": geometry[house.id]}
    }
    if names:
        objects[house.id]["children"] = names
    for name, part in zip(names, house.parts, strict=True):
        objects[name] = {
            "type": "BuildingPart",
            "parents": [house.id],
            "attributes": {"function": part.kind, "measuredHeight": part.height},
            "geometry": geometry[name],
        }
    return {"type": "CityJSONFeature", "id": house.id, "CityObjects": objects, "vertices": vertices.rows()}


def _geometry(level: str, volume: Volume, vertices: _Vertices) -> dict[str, Any]:
    faces = [[vertices.ring(ring) for ring in (surface.border, *surface.holes)] for surface in volume.surfaces]
    told: dict[str, Any] = {"type": "Solid" if volume.closed else "MultiSurface", "lod": level}
    told["boundaries"] = [faces] if volume.closed else faces
    values = [surface.kind for surface in volume.surfaces]
    kinds = list(dict.fromkeys(values))
    rows = [kinds.index(kind) for kind in values]
    told["semantics"] = {
        "surfaces": [{"type": kind} for kind in kinds],
        "values": [rows] if volume.closed else rows,
    }
    return told


def _text(document: Any) -> str:
    return json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n"
