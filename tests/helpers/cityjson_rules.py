"""What a CityJSON 2.0 file of buildings must obey: the specification, and ISO 19107 for its solids."""

import copy
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import jsonschema
import numpy as np
import shapely
from numpy.typing import NDArray

Json = dict[str, Any]
MOST_TURN = 20.0  # degrees; val3dity's planarity_n_tol


def record(properties: Json, *optional: str) -> Json:
    """Schema of an object with these properties, all required but the optional ones, and no others."""
    required = [name for name in properties if name not in optional]
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def array(items: Json, least: int = 0, most: int | None = None) -> Json:
    limits = {"minItems": least} | ({} if most is None else {"maxItems": most})
    return {"type": "array", "items": items} | limits


def geometry(kind: str, lod: str, boundaries: Json) -> Json:
    values = array(array({"enum": [0, 1, 2]}, 5), 1, 1)
    surface = record({"type": {"enum": ["GroundSurface", "WallSurface", "RoofSurface"]}})
    semantics = record({"surfaces": array(surface, 1), "values": values})
    fields = {"type": {"const": kind}, "lod": {"const": lod}, "boundaries": boundaries}
    return record(fields | ({"semantics": semantics} if kind == "Solid" else {}))


NUMBER = {"type": "number"}
FACE = array(array({"type": "integer", "minimum": 0}, 3), 1)
ATTRIBUTES = {
    "type": "object",
    "properties": {
        "number": {"type": "integer"},
        "ground_height": NUMBER,
        "roof_height": NUMBER,
        "height": NUMBER,
        "members": array({"type": "string"}),
    },
    "required": ["number", "ground_height", "roof_height", "height", "members"],
}
GEOMETRY = array(
    {
        "oneOf": [
            geometry("MultiSurface", "0", array(FACE, 1)),
            *(geometry("Solid", lod, array(array(FACE, 5), 1, 1)) for lod in ("1.2", "1.3", "2.2")),
        ]
    }
)
# Sections 2 to 5 of https://www.cityjson.org/specs/2.0.1/, as far as the model's buildings go.
SCHEMA = record(
    {
        "type": {"const": "CityJSON"},
        "version": {"const": "2.0"},
        "transform": record({"scale": array(NUMBER, 3, 3), "translate": array(NUMBER, 3, 3)}),
        "metadata": record(
            {
                "geographicalExtent": array(NUMBER, 6, 6),
                "identifier": {"type": "string", "pattern": "^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$"},
                "title": {"type": "string"},
                "referenceSystem": {
                    "type": "string",
                    "pattern": "^https://www.opengis.net/def/crs/EPSG/0/[0-9]+$",
                },
            },
            "title",
            "referenceSystem",
        ),
        "CityObjects": {
            "type": "object",
            "additionalProperties": {
                "oneOf": [
                    record({"type": {"const": "Building"}, "attributes": ATTRIBUTES, "geometry": GEOMETRY}),
                    record(
                        {
                            "type": {"const": "BuildingPart"},
                            "parents": array({"type": "string"}, 1, 1),
                            "attributes": ATTRIBUTES,
                            "geometry": GEOMETRY,
                        }
                    ),
                    record({"type": {"const": "Building"}, "children": array({"type": "string"}, 1)}),
                ]
            },
        },
        "vertices": array(array({"type": "integer"}, 3, 3)),
    }
)


def file_faults(document: Json) -> set[str]:
    """Name what breaks the specification in a file."""
    if any(True for _ in jsonschema.Draft202012Validator(SCHEMA).iter_errors(document)):
        return {"schema"}
    faults = set()
    rows = [tuple(row) for row in document["vertices"]]
    if len(set(rows)) < len(rows):
        faults.add("duplicate vertex")
    used = {corner for item in geometries(document) for face in faces_of(item) for ring in face for corner in ring}
    if used and max(used) >= len(rows):
        faults.add("vertex out of range")
    if used < set(range(len(rows))):
        faults.add("unused vertex")
    for item in geometries(document):
        values = item.get("semantics", {}).get("values", [[]])[0]
        if item["type"] == "Solid" and len(values) != len(faces_of(item)):
            faults.add("semantics do not match the faces")
    objects = document["CityObjects"]
    down = {(name, child) for name, item in objects.items() for child in item.get("children", [])}
    up = {(parent, name) for name, item in objects.items() for parent in item.get("parents", [])}
    if down != up or not {name for pair in down for name in pair} <= objects.keys():
        faults.add("parents and children differ")
    return faults


def solid_faults(document: Json) -> dict[str, set[str]]:
    """Name what breaks ISO 19107, or disagrees with the attributes, in the solids of each building."""
    points = np.array(document["vertices"]) * document["transform"]["scale"] + document["transform"]["translate"]
    found: dict[str, set[str]] = {}
    for name, item in document["CityObjects"].items():
        for solid in item.get("geometry", []):
            if solid["type"] == "Solid":
                found.setdefault(name, set()).update(_solid_faults(solid, points, item["attributes"]))
    return found


def geometries(document: Json) -> Iterator[Json]:
    for item in document["CityObjects"].values():
        yield from item.get("geometry", [])


def faces_of(item: Json) -> list[list[list[int]]]:
    faces: list[list[list[int]]] = item["boundaries"][0] if item["type"] == "Solid" else item["boundaries"]
    return faces


def area_vector(face: list[list[int]], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Area times normal of a face with its holes (Newell)."""
    total = np.zeros(3)
    for ring in face:
        corners = points[ring] - points[face[0][0]]
        total += 0.5 * np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    return total


def volume(solid: Json, points: NDArray[np.float64]) -> float:
    """Signed volume within the faces: positive if the normals point outwards (divergence theorem)."""
    centre = points[faces_of(solid)[0][0][0]]
    return sum(float(area_vector(face, points) @ (points[face[0][0]] - centre)) / 3 for face in faces_of(solid))


def broken(document: Json, path: list[Any], value: Any) -> Json:
    """Copy the document with another value at a path."""
    changed = copy.deepcopy(document)
    place = changed
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return changed


def _solid_faults(solid: Json, points: NDArray[np.float64], attributes: Json) -> Iterator[str]:
    faces = faces_of(solid)
    sloped = solid["lod"] == "2.2" and "roof_plane" in attributes
    names = {"1.2": "lod12_height", "1.3": "lod13_height", "2.2": "roof_height"}
    top = attributes.get(names[solid["lod"]], attributes["roof_height"])
    height = attributes["height"] if top == attributes["roof_height"] else top - attributes["ground_height"]
    edges = Counter(edge for face in faces for ring in face for edge in pairwise([*ring, ring[0]]))
    if any(a == b for a, b in edges):
        yield "corner repeated"
    if any(count != 1 or edges[b, a] != 1 for (a, b), count in edges.items()):
        yield "shell not a closed 2-manifold"
    kinds = [solid["semantics"]["surfaces"][i]["type"] for i in solid["semantics"]["values"][0]]
    ground_area = 0.0
    for kind, face in zip(kinds, faces, strict=True):
        vector = area_vector(face, points)
        size = np.linalg.norm(vector)
        corners = points[[corner for ring in face for corner in ring]]
        if size < 1e-9:
            yield "face without area"
        elif np.ptp((corners - corners[0]) @ vector / size) > (0.01 if sloped else 1e-3):
            yield "face not planar"
        elif kind == "RoofSurface" and _largest_turn(face, points, vector) > MOST_TURN:
            yield "face bent in a corner"
        rise = float(vector[2] / max(size, 1e-9))
        if kind != {-1: "GroundSurface", 0: "WallSurface", 1: "RoofSurface"}[(rise > 1e-6) - (rise < -1e-6)]:
            yield "semantics do not fit the normal"
        ground_area -= vector[2] if kind == "GroundSurface" else 0.0
        level = {"GroundSurface": attributes["ground_height"], "RoofSurface": top}.get(kind)
        if level is None:
            continue
        levels = _plane_heights(attributes, corners) if sloped and kind == "RoofSurface" else level
        if np.abs(corners[:, 2] - levels).max() > (0.0055 if sloped else 0.0005) + 1e-6:
            yield "face not at its height"
    if sloped:  # it has the volume of the solid of LoD1.3
        height = attributes["lod13_height"] - attributes["ground_height"]
    if abs(volume(solid, points) - ground_area * height) > (0.007 if sloped else 0.001) * ground_area + 1e-6:
        yield "volume is not area times height"


def _largest_turn(face: list[list[int]], points: NDArray[np.float64], normal: NDArray[np.float64]) -> float:
    """Largest angle of a triangle of a roof's face with its plane (degrees)."""
    shell, *holes = (points[ring, :2] for ring in face)
    rows = {(x, y): points[row] for ring in face for row in ring for x, y in [points[row, :2].tolist()]}
    triangles = shapely.orient_polygons(
        shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.Polygon(shell, holes)))
    )
    corners = np.array([[rows[x, y] for x, y in one.exterior.coords[:3]] for one in triangles])
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = np.linalg.norm(np.cross(turned, normal), axis=1)
    return float(np.degrees(np.arctan2(across, turned @ normal)).max())


def _plane_heights(attributes: Json, corners: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b, c, x0, y0, low, high = attributes["roof_plane"]
    heights: NDArray[np.float64] = np.clip(a * (corners[:, 0] - x0) + b * (corners[:, 1] - y0) + c, low, high)
    return heights
