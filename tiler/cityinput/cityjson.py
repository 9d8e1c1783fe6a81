"""CityJSON 1.0 to 2.0 and CityJSONSeq: buildings with their parts, one at a time."""

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.cityinput.faces import KINDS, NO_LOD, OUTLINE, UNKNOWN, Faces, ModelBuilding, Shape, check_places

WHOLE = 64 * 2**20  # bytes of a line; a longer one is no feature of a sequence
# How many lists of faces lie around a polygon of each type of geometry.
DEPTH = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
RELIEF = "TINRelief"
STOREY = "BuildingStorey"
AROUND = ("Road", "PlantCover", "SolitaryVegetationObject")  # around buildings

_MEMBERS = {"attributes": dict, "parents": list, "geometry": list}  # of a city object, if it has them

Object = Mapping[str, Any]
Vertices = NDArray[np.float64]


@dataclass(frozen=True)
class CityJsonHead:
    """The name of a file's CRS, ``""`` for none, and how its integers become coordinates."""

    crs: str
    scale: tuple[float, float, float]
    translate: tuple[float, float, float]


def read_objects(path: Path) -> tuple[CityJsonHead, Iterator[tuple[Object, Vertices]]]:
    """Read the head of a file, and give the city objects of each of its documents with their vertices.

    A sequence has one document a feature, any other file a single one: of a sequence one feature is in memory.

    Raises
    ------
    InputError
        If the file is no CityJSON, or one of its lines is none.
    """
    with path.open("rb") as file:
        first = file.readline(WHOLE)
        document = _parse(first) if first.rstrip().endswith(b"}") else None
        rest = file.read(1) if document is not None else b""
    if document is not None and _is_head(document, rest):
        head = _read_head(path, document, sequence=True)
        return head, _read_lines(path, head)
    if document is None or rest.strip():
        with path.open("rb") as file:
            document = _parse(file.read())
    if not isinstance(document, dict):
        raise InputError(f"{path}: is no JSON object; give a CityJSON file, or CityJSONSeq with one object a line")
    head = _read_head(path, document, sequence=False)
    return head, iter([(_objects_of(path, document), _vertices_of(path, document, head))])


def _is_head(document: Any, rest: bytes) -> bool:
    """Whether a first line is the head of a sequence: it is CityJSON, and others follow or it has no objects."""
    return (
        isinstance(document, dict)
        and document.get("type") == "CityJSON"
        and (bool(rest.strip()) or document.get("CityObjects") == {})
    )


def _parse(data: bytes) -> Any:
    try:
        return json.loads(data)
    except ValueError:
        return None


def _read_head(path: Path, document: dict[str, Any], *, sequence: bool) -> CityJsonHead:
    if document.get("type") != "CityJSON":
        raise InputError(
            f"{path}: its type is {document.get('type')!r}, not 'CityJSON'; a sequence begins with a CityJSON "
            "object that has the transform"
        )
    version = str(document.get("version", ""))
    transform = document.get("transform")
    if transform is None and (sequence or not version.startswith("1.0")):
        raise InputError(
            f"{path}: CityJSON {version} without a transform, so vertices have no place; write it anew"
        )
    try:
        scale = tuple(float(v) for v in (transform or {}).get("scale", (1, 1, 1)))
        translate = tuple(float(v) for v in (transform or {}).get("translate", (0, 0, 0)))
    except (TypeError, ValueError):
        scale, translate = (), ()
    if len(scale) != 3 or len(translate) != 3 or not all(math.isfinite(v) for v in (*scale, *translate)):
        raise InputError(f"{path}: its transform has not three finite scales and translations; write it anew")
    metadata = document.get("metadata") or {}
    crs = metadata.get("referenceSystem") or (metadata.get("crs") or {}).get("epsg") or ""
    return CityJsonHead(str(crs), scale, translate)


def _read_lines(path: Path, head: CityJsonHead) -> Iterator[tuple[Object, Vertices]]:
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            if not line.strip():
                continue
            document = _parse(line)
            if not isinstance(document, dict):
                raise InputError(
                    f"{path}, line {number}: is no JSON object; the file may be cut off: copy it again"
                )
            if number == 1 and not document.get("CityObjects"):
                continue
            yield _objects_of(path, document), _vertices_of(path, document, head)


def _objects_of(path: Path, document: dict[str, Any]) -> Object:
    objects = document.get("CityObjects")
    if not isinstance(objects, dict):
        raise InputError(f"{path}: has no CityObjects; give a CityJSON file with buildings")
    for name, thing in objects.items():
        if not isinstance(thing, dict):
            raise InputError(f"{path}: the city object {name} is no JSON object; write it anew")
        for key, kind in _MEMBERS.items():
            if not isinstance(thing.get(key) or kind(), kind):
                has = "has" if key == "geometry" else "have"
                raise InputError(f"{path}: the {key} of {name} {has} the wrong type; write it anew")
    return objects


def _vertices_of(path: Path, document: dict[str, Any], head: CityJsonHead) -> Vertices:
    try:
        xyz = np.array(document.get("vertices") or np.empty((0, 3)), np.float64)
    except (TypeError, ValueError):
        xyz = np.empty(0)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        feature = f", feature {document['id']}" if "id" in document else ""
        raise InputError(
            f"{path}{feature}: not all vertices have three numbers; write it anew, or give outlines in plan as "
            "--footprints"
        )
    placed: Vertices = xyz * np.array(head.scale) + np.array(head.translate)
    return placed


def read_buildings(
    objects: Object, vertices: Vertices, height: str = "", *, around: bool = False
) -> Iterator[ModelBuilding]:
    """Give the buildings among the objects of a document, by id, each with its parts.

    `vertices`, float64 (n, 3), are those of the document; `height` is the attribute with the height above ground
    (m), ``""`` for ``measuredHeight``. A part belongs to its first parent; one whose parent is absent is a
    building by itself. A `Building` without geometry is that of its parts. With `around` there are also storeys,
    and what lies around buildings: roads, plant cover and trees.
    """
    parts: dict[str, list[str]] = {}
    for name, thing in objects.items():
        if thing.get("type") == "BuildingPart" or (around and thing.get("type") == STOREY):
            parts.setdefault(_find_owner(name, objects), []).append(name)
    for name, thing in objects.items():
        if thing.get("type") == "Building" or (
            thing.get("type") == "BuildingPart" and name in parts.get(name, ())
        ):
            own = parts.get(name, [])
            inside = own + [storey for part in own for storey in parts.get(part, []) if around]
            yield _read_building(name, objects, vertices, inside, height)
        elif around and thing.get("type") in AROUND:
            yield _read_building(name, objects, vertices, [], height)


def _find_owner(name: str, objects: Object) -> str:
    """Find what a part or storey belongs to: its first parent, of a part of a part the first that is none."""
    owner, passed = name, {name}
    while known := [one for one in objects[owner].get("parents") or () if one in objects]:
        if known[0] in passed:  # parts of each other: by itself
            return name
        owner = known[0]
        passed.add(owner)
        if objects[owner].get("type") != "BuildingPart" or objects[name].get("type") == STOREY:
            break
    return owner


def _read_building(name: str, objects: Object, vertices: Vertices, parts: list[str], height: str) -> ModelBuilding:
    shapes: list[Shape] = []
    faults: list[str] = []
    for owner in dict.fromkeys([name, *parts]):
        for geometry in objects[owner].get("geometry") or ():
            try:
                shapes.append(_read_shape(owner, geometry, vertices))
            except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
                kind = geometry.get("type") if isinstance(geometry, Mapping) else "geometry"
                faults.append(f"{owner}: a {kind} cannot be read ({type(error).__name__}: {error})")
    attributes = {owner: objects[owner].get("attributes") or {} for owner in dict.fromkeys([name, *parts])}
    above = _number(attributes[name].get(height or "measuredHeight"))
    kinds = {owner: kind for owner in attributes if (kind := objects[owner]["type"]) in (STOREY, *AROUND)}
    parents = {
        owner: next(filter(objects.__contains__, objects[owner]["parents"])) for owner in kinds if owner != name
    }
    return ModelBuilding(name, tuple(shapes), above, tuple(faults), attributes, kinds, parents)


def _read_shape(owner: str, geometry: Mapping[str, Any], vertices: Vertices) -> Shape:
    kind = str(geometry["type"])
    if kind not in DEPTH:
        raise ValueError(f"a {kind} has no surfaces")
    given = geometry.get("semantics")
    semantics = given if isinstance(given, Mapping) else {}  # before CityJSON 1.0 it was a list
    lod = _number(geometry.get("lod"))
    lod = NO_LOD if math.isnan(lod) else lod
    default = OUTLINE if 0 <= lod < 1 else UNKNOWN
    kinds = [KINDS.get(str(one.get("type")), UNKNOWN) for one in semantics.get("surfaces") or ()]
    faces: list[Any] = geometry["boundaries"]
    several = DEPTH[kind] == 2 and len(faces) > 1
    values: Any = semantics.get("values")
    for _ in range(DEPTH[kind]):
        # Shells behind the first are cavities.
        solid = kind == "Solid"
        shells = faces[:1] if solid else [shell for one in faces for shell in one[:1]]
        if values is not None:
            values = values[:1] if solid else [value for one in values for value in (one or [None])[:1]]
        lists = values if values is not None else [None] * len(shells)
        if not solid:
            faces = [face for shell in shells for face in shell]
            values = [v for shell, own in zip(shells, lists, strict=True) for v in (own or [None] * len(shell))]
            break
        faces = list(shells[0]) if shells else []
        values = lists[0] if lists else None
    return Shape(owner, lod, DEPTH[kind] > 0, _make_faces(faces, values, kinds, vertices, default), several)


def _make_faces(faces: list[Any], values: Any, kinds: list[int], vertices: Vertices, default: int) -> Faces:
    numbers = values if values is not None else [None] * len(faces)
    corners: list[int] = []  # of all rings: millions of them in a file, so a ring is added at a time
    lengths: list[int] = []
    sizes: list[int] = []
    sorts: list[int] = []
    for face, number in zip(faces, numbers, strict=True):
        n = 0
        for ring in face:
            whole = ring[:-1] if len(ring) > 1 and ring[0] == ring[-1] else ring
            if len(whole) >= 3:
                corners += whole
                lengths.append(len(whole))
                n += 1
            elif not n:
                break  # without a border there is no face
        if n:
            sizes.append(n)
            sorts.append(default if number is None else kinds[number])
    index = np.array(corners, np.int64)
    if len(index) and index.min() < 0:
        raise IndexError(f"vertex {index.min()}")
    ring_start, face_start = (np.array([0, *accumulate(counts)], np.int64) for counts in (lengths, sizes))
    return Faces(check_places(vertices[index]), ring_start, face_start, np.array(sorts, np.int8))


def count_others(objects: Object, *, around: bool = False) -> Counter[str]:
    """Count the objects with geometry that `read_buildings` and `read_relief` leave out, by type."""
    read = {"Building", "BuildingPart", RELIEF, *((STOREY, *AROUND) if around else ())}
    return Counter(
        str(thing.get("type"))
        for thing in objects.values()
        if thing.get("type") not in read and thing.get("geometry")
    )


def read_relief(objects: Object, vertices: Vertices) -> list[Faces]:
    """Give the triangles of the terrain among the objects of a document."""
    return [
        _read_shape(name, geometry, vertices).faces
        for name, thing in objects.items()
        if thing.get("type") == RELIEF
        for geometry in thing.get("geometry") or ()
    ]


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan
