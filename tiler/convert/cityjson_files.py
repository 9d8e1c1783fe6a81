"""CityJSON 2.0 and CityJSONSeq of features."""

from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from tiler.cityinput.faces import WALL
from tiler.citymodels.cityjson_text import ObjectLines, compact, reference_system
from tiler.convert.features import OPENINGS, SURFACES, Feature, Geometry, iter_features, level_text, origin_of
from tiler.convert.inputs import ModelSource
from tiler.georeference.crs import horizontal_crs

HIGHEST = 4  # CityJSON has no level from this on


def write_sequence(path: Path, source: ModelSource) -> None:
    """Write CityJSONSeq: the head, then a feature a line."""
    with path.open("wb") as file:
        file.write(head_line(source))
        file.writelines(feature_line(feature, source) for feature in iter_features(source))


def head_line(source: ModelSource) -> bytes:
    """Give the first line of a sequence."""
    return _line(_head(source) | {"CityObjects": {}, "vertices": []})


def feature_line(feature: Feature, source: ModelSource) -> bytes:
    """Give the line of a building in a sequence."""
    told = {"type": "CityJSONFeature", "id": feature.objects[0].id, "CityObjects": _objects(feature, source)}
    return _line(told | {"vertices": feature.vertices.tolist()})


def write_document(path: Path, source: ModelSource) -> None:
    """Write CityJSON, an object a line; vertices wait in a temporary file."""
    with path.open("wb") as file, TemporaryFile() as vertex_file:
        file.write(_line(_head(source))[:-2] + b",")
        lines = ObjectLines(file.write, vertex_file)
        for feature in iter_features(source):
            objects = _objects(feature, source, lines.n_vertices)
            lines.add_objects(f"{compact(name)}:{compact(thing)}" for name, thing in objects.items())
            lines.add_vertices(feature.vertices)
        lines.finish()
        file.write(b"}\n")


def _head(source: ModelSource) -> dict[str, Any]:
    extent = [round(float(value), 9) for value in (*source.low, *source.high)]
    metadata: dict[str, Any] = {"geographicalExtent": extent}
    if name := reference_system(source.crs) or reference_system(horizontal_crs(source.crs)):
        metadata["referenceSystem"] = name
    transform = {"scale": source.step.tolist(), "translate": origin_of(source).tolist()}
    return {"type": "CityJSON", "version": "2.0", "transform": transform, "metadata": metadata}


def _objects(feature: Feature, source: ModelSource, first: int = 0) -> dict[str, Any]:
    """Give the objects of a feature by id; vertices are counted from `first`."""
    house = feature.objects[0]
    children: dict[str, list[str]] = {}
    for one in feature.objects[1:]:
        children.setdefault(one.parent or house.id, []).append(one.id)
    found: dict[str, Any] = {}
    for one in feature.objects:
        kept = [item for item in one.geometries if item.lod < HIGHEST]
        source.told["geometries of level 4, which CityJSON has not"] += len(one.geometries) - len(kept)
        thing: dict[str, Any] = {"type": one.kind}
        if one is not house:
            thing["parents"] = [one.parent or house.id]
        if one.id in children:
            thing["children"] = children[one.id]
        geometry = [_geometry(item, first) for item in kept]
        found[one.id] = thing | {"attributes": one.attributes, "geometry": geometry}
    return found


def _geometry(item: Geometry, first: int) -> dict[str, Any]:
    faces: Any = [[[vertex + first for vertex in ring] for ring in rings] for _, rings in item.faces]
    known = SURFACES | OPENINGS
    kinds = [kind for kind in known if any(kind == other for other, _ in item.faces)]
    values: Any = [kinds.index(kind) if kind in kinds else None for kind, _ in item.faces]
    told: dict[str, Any] = {"type": "Solid" if item.closed else "MultiSurface", "lod": level_text(item.lod)}
    told["boundaries"] = [faces] if item.closed else faces
    if kinds:
        surfaces: list[dict[str, Any]] = [{"type": known[kind]} for kind in kinds]
        if openings := [k for k, kind in enumerate(kinds) if kind in OPENINGS]:
            wall = kinds.index(WALL)
            surfaces[wall]["children"] = openings
            for k in openings:
                surfaces[k]["parent"] = wall
        told["semantics"] = {"surfaces": surfaces, "values": [values] if item.closed else values}
    return told


def _line(document: Any) -> bytes:
    return (compact(document) + "\n").encode("ascii")
