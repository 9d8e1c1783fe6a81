"""CityGML 1.0, 2.0 and 3.0: buildings with their parts, one at a time, by lxml's events.

Nothing is fetched and no entity is expanded. Elements are told by their local names, as versions differ in
namespaces.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.cityinput.faces import (
    KINDS,
    OUTLINE,
    UNKNOWN,
    FaceList,
    Faces,
    ModelBuilding,
    Shape,
    check_places,
    drop_end,
)  # fmt: skip

HREF = "{http://www.w3.org/1999/xlink}href"
BUILDING, PART, RELIEF = "Building", "BuildingPart", "TINRelief"
POLYGONS = {"Polygon", "Triangle", "Rectangle", "PolygonPatch"}
# Subtrees that hold no faces of a building.
SKIPPED = {
    *("address", "appearance", "appearanceMember", "externalReference"),
    *("interiorRoom", "interiorBuildingInstallation"),
}
GENERIC = {"intAttribute": int, "doubleAttribute": float, "measureAttribute": float}
# Children of a building that hold no attribute of it.
NO_ATTRIBUTES = {"boundedBy", "boundary", "consistsOfBuildingPart", "buildingPart"}
FEET = {"ft": 0.3048, "feet": 0.3048, "foot": 0.3048, "[ft_i]": 0.3048}
_LOD = re.compile(r"lod([0-4])(\w*)")


@dataclass(frozen=True, eq=False)
class Relief:
    """Triangles of the terrain."""

    faces: Faces


def scan_citygml(path: Path, height: str = "") -> Iterator[str | ModelBuilding | Relief]:
    """Give names of CRSs as they are met first, and buildings and terrain in the order of the file.

    `height` is the generic attribute with the height above ground (m); ``""`` for ``measuredHeight``, or
    ``height`` of 3.0.

    Raises
    ------
    InputError
        If the file is no XML, or is cut off.
    """
    from lxml import etree

    names: set[str] = set()
    depth = 0
    try:
        events = etree.iterparse(
            str(path), events=("start", "end"), resolve_entities=False, no_network=True, load_dtd=False,
            huge_tree=True, remove_comments=True, remove_pis=True,
        )  # fmt: skip
        for event, element in events:
            tag = _local(element)
            if event == "start":
                if (name := element.get("srsName")) and name not in names:
                    names.add(name)
                    yield name
                depth += tag in (BUILDING, PART, RELIEF)
                continue
            if tag not in (BUILDING, PART, RELIEF):
                if not depth and tag in ("cityObjectMember", "featureMember", "appearanceMember"):
                    _forget(element)
                continue
            depth -= 1
            if depth:
                continue
            if tag == RELIEF:
                found = FaceList()
                _collect_polygons(element, found, UNKNOWN)
                yield Relief(found.done())
            else:
                yield _read_building(element, height)
            _forget(element)
    except etree.XMLSyntaxError as error:
        raise InputError(f"{path}: is no sound XML ({error}); the file may be cut off: copy it again") from error


def _forget(element: Any) -> None:
    """Free an element that was read, and those before it."""
    element.clear()
    while element.getprevious() is not None:
        del element.getparent()[0]


def _local(element: Any) -> str:
    tag = element.tag
    return tag[tag.rfind("}") + 1 :] if isinstance(tag, str) else ""


def _name_of(element: Any) -> str:
    for key, value in element.attrib.items():
        if key.endswith("}id") or key == "id":
            return str(value)
    return ""


@dataclass(eq=False)
class _Reading:
    """What is found of a building and its parts, by owner, level of detail, and whether it is a solid."""

    faces: dict[tuple[str, float, bool], FaceList] = field(default_factory=dict)
    links: list[tuple[tuple[str, float, bool], int, str, bool]] = field(default_factory=list)
    polygons: dict[str, Any] = field(default_factory=dict)
    seen: dict[tuple[str, float], set[str]] = field(default_factory=dict)
    linked: dict[tuple[str, float], set[str]] = field(default_factory=dict)
    solids: Counter[tuple[str, float, bool]] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    attributes: dict[str, dict[str, Any]] = field(default_factory=dict)

    def add(self, key: tuple[str, float, bool], kind: int, element: Any, *, turned: bool = False) -> None:
        name = _name_of(element)
        owner, lod, _ = key
        if name:
            self.seen.setdefault((owner, lod), set()).add(name)
        try:
            rings = read_polygon(element)
        except (TypeError, ValueError) as error:
            self.faults.append(f"polygon {name or 'without id'} cannot be read ({error})")
            return
        self.faces.setdefault(key, FaceList()).add([ring[::-1] for ring in rings] if turned else rings, kind)

    def make_shape(self, key: tuple[str, float, bool], found: FaceList) -> Shape:
        """Give the faces of an owner at a level; boundary surfaces are a solid where one links to all of them."""
        owner, lod, closed = key
        solid = (owner, lod, True)
        whole = (
            not closed and solid not in self.faces and len(self.linked.get((owner, lod), ())) == len(found.kinds)
        )
        return Shape(owner, lod, closed or whole, found.done(), self.solids[solid] > 1)


def _read_building(element: Any, height: str) -> ModelBuilding:
    name = _name_of(element)
    reading = _Reading()
    _read_object(element, name, reading)
    # Links to polygons elsewhere in the building; those to its own boundary surfaces are there already.
    targets: dict[str, Any] | None = None
    for key, kind, link, turned in reading.links:
        owner, lod, closed = key
        if link in reading.seen.get((owner, lod), ()):
            if closed and not turned:
                reading.linked.setdefault((owner, lod), set()).add(link)
            continue
        if targets is None:
            targets = {_name_of(one): one for one in element.iter() if isinstance(one.tag, str) and _name_of(one)}
        target = targets.get(link)
        if target is None:
            reading.faults.append(f"{owner}: xlink to #{link}, which is not in the building")
            continue
        for one in target.iter():
            if _local(one) in POLYGONS:
                reading.add(key, kind, one, turned=turned)
    shapes = tuple(reading.make_shape(key, found) for key, found in reading.faces.items())
    return ModelBuilding(name, shapes, _height_of(element, height), tuple(reading.faults), reading.attributes)


def _read_object(element: Any, owner: str, reading: _Reading) -> None:
    """Read a building or a part of it, and the parts in it by themselves."""
    reading.attributes.setdefault(owner, {}).update(_read_attributes(element))
    for child in element:
        tag = _local(child)
        if not tag or tag in SKIPPED:
            continue
        if found := _LOD.fullmatch(tag):
            _read_geometry(child, owner, reading, found, UNKNOWN)
        elif tag in ("boundedBy", "boundary"):
            _read_boundary(child, owner, reading)
        elif tag in ("consistsOfBuildingPart", "buildingPart"):
            for part in child:
                if _local(part) == PART:
                    _read_object(part, _name_of(part) or owner, reading)


def _read_boundary(element: Any, owner: str, reading: _Reading) -> None:
    for surface in element:
        kind = KINDS.get(_local(surface))
        if kind is None:
            continue  # an envelope, or a surface of a kind that is none of a building
        for child in surface:
            if found := _LOD.fullmatch(_local(child)):
                _read_geometry(child, owner, reading, found, kind)


def _read_geometry(element: Any, owner: str, reading: _Reading, name: re.Match[str], kind: int) -> None:
    level, form = float(name[1]), name[2]
    if form.lower() in ("footprint", "roofedge") or (level == 0 and kind == UNKNOWN):
        kind = OUTLINE
    if form in ("TerrainIntersection", "MultiCurve", "ImplicitRepresentation", "Point"):
        return
    key = (owner, level, form == "Solid")
    for one, turned in _iter_outer(element, turned=element.get("orientation") == "-"):
        reading.solids[key] += _local(one) == "Solid"
        if _local(one) in POLYGONS:
            reading.add(key, kind, one, turned=turned)
        elif link := one.get(HREF):
            reading.links.append((key, kind, link.rpartition("#")[2], turned))


def _iter_outer(element: Any, *, turned: bool) -> Iterator[tuple[Any, bool]]:
    """Give the elements below one, but not those within cavities of solids, and whether each is turned over."""
    for child in element:
        if _local(child) == "interior" and _local(element) == "Solid":
            continue
        over = turned != (child.get("orientation") == "-")
        yield child, over
        if _local(child) not in POLYGONS:
            yield from _iter_outer(child, turned=over)


def _read_attributes(element: Any) -> dict[str, Any]:
    """Read what a building or part is said to be: generic attributes, and children with a text alone."""
    found: dict[str, Any] = {}
    for child in element:
        tag = _local(child)
        if not tag or tag in SKIPPED | NO_ATTRIBUTES or _LOD.fullmatch(tag):
            continue
        generic = child[0] if tag == "genericAttribute" and len(child) else child
        kind = _local(generic)
        parts = {_local(one): (one.text or "").strip() for one in generic}
        if "value" in parts and kind.endswith("Attribute"):
            name = child.get("name") or parts.get("name", "")
            value = _typed(parts["value"], GENERIC.get(kind[:1].lower() + kind[1:], str))
        elif tag == "height":
            name, value = "measuredHeight", _height_of([child], "")
        elif not len(child):
            name, value = tag, (child.text or "").strip()
            value = _metres(child, value) if tag == "measuredHeight" else value
        else:
            continue
        if name and value != "" and not (isinstance(value, float) and math.isnan(value)):
            found[name] = f"{found[name]}; {value}" if name in found else value
    return found


def _typed(text: str, kind: Callable[[str], Any]) -> Any:
    try:
        return kind(text)
    except ValueError:
        return text


def _collect_polygons(element: Any, found: FaceList, kind: int) -> None:
    for one in element.iter():
        if _local(one) in POLYGONS:
            found.add(read_polygon(one), kind)


def read_polygon(element: Any) -> list[NDArray[np.float64]]:
    """Read the rings of a polygon, the border first, float64 (k, 3) each without a repeated end.

    Heights are 0 where coordinates have two numbers. ValueError if coordinates are no numbers, or not so many as
    they should be.
    """
    rings = []
    for side in element:
        if _local(side) in ("exterior", "interior", "outerBoundaryIs", "innerBoundaryIs"):
            rings += [_read_ring(ring) for ring in side]
    return rings


def _read_ring(element: Any) -> NDArray[np.float64]:
    numbers: list[float] = []
    width = int(element.get("srsDimension", 3))
    for child in element:
        tag = _local(child)
        if tag == "posList":
            width = int(child.get("srsDimension", width))
            return _as_ring([float(word) for word in (child.text or "").split()], width)
        if tag in ("pos", "pointProperty"):
            words = [word for one in child.iter() if _local(one) == "pos" for word in (one.text or "").split()]
            width = len(words)
            numbers += map(float, words)
        elif tag == "coordinates":
            rows = [row.split(child.get("cs", ",")) for row in (child.text or "").split(child.get("ts"))]
            width = len(rows[0]) if rows else 3
            numbers += [float(word) for row in rows for word in row]
    return _as_ring(numbers, width)


def _as_ring(numbers: list[float], width: int) -> NDArray[np.float64]:
    if width not in (2, 3) or len(numbers) % width:
        raise ValueError(f"{len(numbers)} numbers in rows of {width}")
    xyz = np.array(numbers, np.float64).reshape(-1, width)
    if width == 2:
        xyz = np.column_stack((xyz, np.zeros(len(xyz))))
    return drop_end(check_places(xyz))


def _height_of(element: Any, name: str) -> float:
    """Height of a building by an attribute (m); NaN where there is none."""
    for child in element:
        tag = _local(child)
        if name and child.get("name") == name:
            return _metres(child, "".join(child.itertext()))
        if not name and tag == "measuredHeight":
            return _metres(child, child.text)
        if not name and tag == "height":
            for one in child.iter():
                if _local(one) == "value":
                    return _metres(one, one.text)
    return math.nan


def _metres(element: Any, text: str | None) -> float:
    unit = (element.get("uom") or "m").rpartition("#")[2].lower()
    try:
        return float((text or "").strip()) * FEET.get(unit, 1.0)
    except ValueError:
        return math.nan
