"""CityGML 2.0 and 3.0 of features, a building at a time."""

import re
from collections.abc import Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from tiler.cityinput.cityjson import STOREY
from tiler.cityinput.faces import ROOF
from tiler.cityinput.sources import is_north_first
from tiler.convert.features import (
    SURFACES,
    CityObject,
    Feature,
    Geometry,
    attribute_text,
    iter_features,
    origin_of,
    unique_name,
)
from tiler.convert.inputs import ModelSource
from tiler.georeference.crs import horizontal_crs

NAMESPACES = {
    "2.0": {
        "": "http://www.opengis.net/citygml/2.0",
        ":bldg": "http://www.opengis.net/citygml/building/2.0",
        ":gen": "http://www.opengis.net/citygml/generics/2.0",
        ":gml": "http://www.opengis.net/gml",
        ":xlink": "http://www.w3.org/1999/xlink",
    },
    "3.0": {
        "": "http://www.opengis.net/citygml/3.0",
        ":bldg": "http://www.opengis.net/citygml/building/3.0",
        ":con": "http://www.opengis.net/citygml/construction/3.0",
        ":gen": "http://www.opengis.net/citygml/generics/3.0",
        ":gml": "http://www.opengis.net/gml/3.2",
        ":xlink": "http://www.w3.org/1999/xlink",
    },
}
# What lies around buildings: prefixes of elements, and modules.
MODULES = {
    "Road": ("tran", "transportation"),
    "PlantCover": ("veg", "vegetation"),
    "SolitaryVegetationObject": ("veg", "vegetation"),
}
HEIGHT = "measuredHeight"  # the one attribute that is not generic
OWN = "_g"  # begins the ids of polygons; those of buildings that begin so get another letter before
_NAME = re.compile(r"[A-Za-z_][\w.\-]*", re.ASCII)
_UNFIT = re.compile(r"[^\w.\-]", re.ASCII)
_CONTROL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class CityGmlWriter:
    """Writes objects of one version, and numbers their polygons."""

    def __init__(self, source: ModelSource, version: str) -> None:
        flat = horizontal_crs(source.crs)
        self.told, self.new = source.told, version == "3.0"
        self.version, self.origin, self.step = version, origin_of(source), source.step
        # A URN means the order of axes of the register.
        self.order = [1, 0, 2] if flat is not None and is_north_first(flat) else [0, 1, 2]
        plan = "%.9f" if source.in_degrees else "%.3f"
        self.form = f"{plan} {plan} %.3f"
        self.n_polygons = 0
        self.ids: set[int] = set()

    def head(self, source: ModelSource) -> str:
        """Write the start of the file, with the box of all."""
        spaces = "".join(f" xmlns{key}={quoteattr(value)}" for key, value in NAMESPACES[self.version].items())
        name = crs_urn(source)
        corners = [self.form % tuple(corner[self.order].tolist()) for corner in (source.low, source.high)]
        return (
            f'<?xml version="1.0" encoding="UTF-8"?>\n<CityModel{spaces}>\n<gml:boundedBy><gml:Envelope'
            f'{f" srsName={quoteattr(name)}" if name else ""} srsDimension="3"><gml:lowerCorner>{corners[0]}'
            f"</gml:lowerCorner><gml:upperCorner>{corners[1]}</gml:upperCorner></gml:Envelope></gml:boundedBy>\n"
        )

    def feature(self, feature: Feature) -> str:
        """Write a building with its parts and storeys, or what lies around buildings."""
        places = (feature.vertices * self.step + self.origin)[:, self.order]
        house, *others = feature.objects
        parts = [one for one in others if one.kind != STOREY]
        storeys = {one.id: self._storeys(one, others, places) for one in feature.objects}
        role = "buildingPart" if self.new else "consistsOfBuildingPart"
        inner = "".join(
            f"<bldg:{role}>{self._thing('bldg:BuildingPart', one, places, storeys[one.id])}</bldg:{role}>"
            for one in parts
        )
        kind = f"{MODULES[house.kind][0]}:{house.kind}" if house.kind in MODULES else "bldg:Building"
        text = self._thing(kind, house, places, storeys[house.id] + inner)
        return f"<cityObjectMember>{text}</cityObjectMember>\n"

    def _storeys(self, part: CityObject, others: list[CityObject], places: NDArray[np.float64]) -> str:
        """Write what is in a building or a part; 2.0 has rooms alone."""
        role, kind = ("buildingSubdivision", "Storey") if self.new else ("interiorRoom", "Room")
        own = (one for one in others if one.kind == STOREY and one.parent == part.id)
        return "".join(f"<bldg:{role}>{self._thing(f'bldg:{kind}', one, places)}</bldg:{role}>" for one in own)

    def _thing(self, kind: str, one: CityObject, places: NDArray[np.float64], parts: str = "") -> str:
        name = self._id(one.id)
        text = "" if name == one.id else f"<gml:name>{_text(one.id)}</gml:name>"
        attributes = {key: value for key, value in one.attributes.items() if value is not None}
        self.told["attributes that are null, which CityGML has not"] += len(one.attributes) - len(attributes)
        if one.kind in MODULES:
            prefix, module = MODULES[one.kind]
            uri = f"http://www.opengis.net/citygml/{module}/{self.version}"
            start = f'<{kind} xmlns:{prefix}="{uri}" gml:id={quoteattr(name)}>'
        else:
            start = f"<{kind} gml:id={quoteattr(name)}>"
        height = attributes.get(HEIGHT) if one.kind.startswith("Building") else None
        above = f"{float(height):g}" if isinstance(height, (int, float)) and height is not True else ""
        if above:
            del attributes[HEIGHT]
        generic = "".join(self._attribute(key, value) for key, value in attributes.items())
        if one.kind in (STOREY, *MODULES) and not self.new:
            return f"{start}{text}{generic}{self._plain(kind, one, places)}</{kind}>"
        spaces, surfaces = self._geometries(one, places)
        if self.new:
            tall = (
                "<con:height><con:Height><con:highReference>highestRoofEdge</con:highReference><con:lowReference>"
                "lowestGroundPoint</con:lowReference><con:status>measured</con:status>"
                f'<con:value uom="m">{above}</con:value></con:Height></con:height>'
            ) * bool(above)
            body = f"{text}{generic}{surfaces}{''.join(spaces.values())}{tall}{parts}"
        else:
            tall = f'<bldg:measuredHeight uom="m">{above}</bldg:measuredHeight>' if above else ""
            # Levels up to 2 stand before the boundary surfaces, those from 3 on behind.
            low = "".join(value for key, value in spaces.items() if key < 3)
            high = "".join(value for key, value in spaces.items() if key >= 3)
            body = f"{text}{generic}{tall}{low}{surfaces}{high}{parts}"
        return f"{start}{body}</{kind}>"

    def _id(self, text: str) -> str:
        """Give an id that XML takes and that no object before had."""
        fit = _UNFIT.sub("_", text)
        good = _NAME.fullmatch(fit) and not fit.startswith(OWN)
        name = unique_name(fit if good else f"id{fit}", self.ids)
        self.told["ids that XML does not take, kept as gml:name"] += name != text
        return name

    def _attribute(self, key: str, value: Any) -> str:
        kind = {bool: "string", int: "int", float: "double"}.get(type(value), "string")
        told = _text(attribute_text(value))
        if self.new:
            name = f"{kind.capitalize()}Attribute"
            inner = f"<gen:name>{_text(key)}</gen:name><gen:value>{told}</gen:value>"
            return f"<genericAttribute><gen:{name}>{inner}</gen:{name}></genericAttribute>"
        name = f"gen:{kind}Attribute"
        return f"<{name} name={quoteattr(_clean(key))}><gen:value>{told}</gen:value></{name}>"

    def _plain(self, kind: str, one: CityObject, places: NDArray[np.float64]) -> str:
        """Write rooms at level 4 of 2.0, and what lies around buildings at its whole levels, from 1 on."""
        room = one.kind == STOREY
        text = ""
        levels = groupby(sorted(one.geometries, key=lambda g: g.lod), lambda g: 4 if room else int(g.lod) or 1)
        for level, items in levels:
            chosen = self._choose(list(items))
            polygons = [self._polygon(rings, places)[1] for _, rings in chosen.faces]
            form = "Geometry" if one.kind.startswith("Solitary") else "MultiSurface"
            inner = _multi(polygons)
            if room and chosen.closed:
                form = "Solid"
                members = "".join(f"<gml:surfaceMember>{polygon}</gml:surfaceMember>" for polygon in polygons)
                shell = f"<gml:CompositeSurface>{members}</gml:CompositeSurface>"
                inner = f"<gml:Solid><gml:exterior>{shell}</gml:exterior></gml:Solid>"
            name = f"{kind.partition(':')[0]}:lod{level}{form}"
            text += f"<{name}>{inner}</{name}>"
        return text

    def _geometries(self, one: CityObject, places: NDArray[np.float64]) -> tuple[Mapping[int, str], str]:
        """Write geometries by whole level, and the boundary surfaces of all levels."""
        spaces: dict[int, str] = {}
        surfaces = ""
        for level, items in groupby(sorted(one.geometries, key=lambda item: item.lod), lambda item: int(item.lod)):
            chosen = self._choose(list(items))
            polygons = [(kind, *self._polygon(rings, places)) for kind, rings in chosen.faces]
            prefix = "" if self.new else "bldg:"
            if level == 0:
                edge = all(kind == ROOF for kind, _, _ in polygons)
                form = "lod0MultiSurface" if self.new else "bldg:lod0RoofEdge" if edge else "bldg:lod0FootPrint"
                spaces[0] = f"<{form}>{_multi(text for _, _, text in polygons)}</{form}>"
                continue
            # 2.0 has boundary surfaces from level 2 on; 3.0 has no other surfaces at level 1.
            bare = self.new and level == 1 and not chosen.closed
            known = SURFACES.keys() if self.new or level > 1 else set()
            aside = [bare or kind in known for kind, _, _ in polygons]
            members = [
                f'<gml:surfaceMember xlink:href="#{name}"/>'
                if own
                else f"<gml:surfaceMember>{text}</gml:surfaceMember>"
                for own, (_, name, text) in zip(aside, polygons, strict=True)
            ]
            surfaces += "".join(
                self._surface(kind, level, text)
                for own, (kind, _, text) in zip(aside, polygons, strict=True)
                if own
            )
            if chosen.closed:
                shell = "Shell" if self.new else "CompositeSurface"
                spaces[level] = (
                    f"<{prefix}lod{level}Solid><gml:Solid><gml:exterior><gml:{shell}>{''.join(members)}</gml:{shell}>"
                    f"</gml:exterior></gml:Solid></{prefix}lod{level}Solid>"
                )
            elif not all(aside):
                inner = _multi(text for own, (_, _, text) in zip(aside, polygons, strict=True) if not own)
                spaces[level] = f"<{prefix}lod{level}MultiSurface>{inner}</{prefix}lod{level}MultiSurface>"
        return spaces, surfaces

    def _choose(self, items: list[Geometry]) -> Geometry:
        """Choose the geometry of a whole level: the most detailed, a solid, one whose faces have kinds."""
        best = max(
            items, key=lambda item: (item.lod, item.closed, any(kind in SURFACES for kind, _ in item.faces))
        )
        for item in items:
            if item is not best:
                self.told[
                    f"geometries of level {item.lod:g} beside {best.lod:g}: CityGML has one a whole level"
                ] += 1
        return best

    def _surface(self, kind: int, level: int, polygon: str) -> str:
        inner = _multi([polygon])
        if self.new:
            name = f"con:{SURFACES[kind]}" if kind in SURFACES else "gen:GenericThematicSurface"
            return (
                f"<boundary><{name}><lod{level}MultiSurface>{inner}</lod{level}MultiSurface></{name}></boundary>"
            )
        name = f"bldg:{SURFACES[kind]}"
        form = f"bldg:lod{level}MultiSurface"
        return f"<bldg:boundedBy><{name}><{form}>{inner}</{form}></{name}></bldg:boundedBy>"

    def _polygon(self, rings: list[list[int]], places: NDArray[np.float64]) -> tuple[str, str]:
        self.n_polygons += 1
        name = f"{OWN}{self.n_polygons}"
        text = ""
        for k, ring in enumerate(rings):
            closed = places[[*ring, ring[0]]]
            numbers = " ".join([self.form] * len(closed)) % tuple(closed.ravel().tolist())
            side = "interior" if k else "exterior"
            text += (
                f"<gml:{side}><gml:LinearRing><gml:posList>{numbers}</gml:posList></gml:LinearRing></gml:{side}>"
            )
        return name, f'<gml:Polygon gml:id="{name}">{text}</gml:Polygon>'


def write_citygml(path: Path, source: ModelSource, version: str) -> None:
    """Write CityGML; coordinates in the order of the register's axes, as its name of the CRS means.

    Attributes are generic but for `HEIGHT`. Polygons of a solid stand in its boundary surfaces, which it links to.
    """
    writer = CityGmlWriter(source, version)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(writer.head(source))
        for feature in iter_features(source):
            file.write(writer.feature(feature))
        file.write("</CityModel>\n")


def crs_urn(source: ModelSource) -> str:
    """Name the CRS as OGC does: a URN, of several parts for a compound one; ``""`` where the register has none."""
    if source.crs is None:
        return ""
    if code := source.crs.to_epsg():
        return f"urn:ogc:def:crs:EPSG::{code}"
    codes = [part.to_epsg() for part in source.crs.sub_crs_list or [source.crs]]
    if all(codes):
        return "urn:ogc:def:crs," + ",".join(f"crs:EPSG::{code}" for code in codes)
    flat = horizontal_crs(source.crs)
    code = flat.to_epsg() if flat is not None else None
    return f"urn:ogc:def:crs:EPSG::{code}" if code else ""


def _multi(polygons: Iterator[str] | list[str]) -> str:
    members = "".join(f"<gml:surfaceMember>{text}</gml:surfaceMember>" for text in polygons)
    return f"<gml:MultiSurface>{members}</gml:MultiSurface>"


def _clean(text: str) -> str:
    """Leave out what XML has no character for."""
    return _CONTROL.sub("", text)


def _text(text: str) -> str:
    return escape(_clean(text))
