"""Small city models, made in code: a house with a gabled roof, in every format."""

import json
from pathlib import Path
from typing import Any

# A house of 10 by 8 m, eaves at 6 m, a ridge at 9 m that runs along x over y = 4; by its corners.
CORNERS = [
    [0, 0, 2], [10, 0, 2], [10, 8, 2], [0, 8, 2],
    [0, 0, 6], [10, 0, 6], [10, 8, 6], [0, 8, 6],
    [0, 4, 9], [10, 4, 9],
]  # fmt: skip
FACES = {
    "GroundSurface": [[0, 3, 2, 1]],
    "RoofSurface": [[4, 5, 9, 8], [6, 7, 8, 9]],
    "WallSurface": [[0, 1, 5, 4], [2, 3, 7, 6], [1, 2, 6, 9, 5], [3, 0, 4, 8, 7]],
}
PLACE = (100_000.0, 450_000.0, 0.0)  # in the Netherlands, EPSG:28992


def face_list() -> tuple[list[list[list[int]]], list[int], list[str]]:
    """Faces of the house with one ring each, the number of the kind of each, and the kinds."""
    faces, values = [], []
    for number, rings in enumerate(FACES.values()):
        faces += [[ring] for ring in rings]
        values += [number] * len(rings)
    return faces, values, list(FACES)


def solid(lod: Any = "2.2", *, semantics: bool = True, first: int = 0) -> dict[str, Any]:
    """Geometry of the house as a solid."""
    faces, values, kinds = face_list()
    moved = [[[v + first for v in ring] for ring in face] for face in faces]
    found: dict[str, Any] = {"type": "Solid", "lod": lod, "boundaries": [moved]}
    if semantics:
        found["semantics"] = {"surfaces": [{"type": kind} for kind in kinds], "values": [values]}
    return found


def box_solid(height: float, lod: Any, first: int = 0) -> tuple[dict[str, Any], list[list[float]]]:
    """Geometry of a box over the house, and its vertices."""
    corners = [[x, y, z] for z in (2.0, height) for x, y in ((0.0, 0.0), (10.0, 0.0), (10.0, 8.0), (0.0, 8.0))]
    faces = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    return {"type": "Solid", "lod": lod, "boundaries": [[[[v + first for v in face]] for face in faces]]}, corners


def city_json(
    objects: dict[str, Any], vertices: list[Any], crs: str = "EPSG:28992", **more: Any
) -> dict[str, Any]:
    """A CityJSON document with vertices in millimetres from `PLACE`."""
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001] * 3, "translate": list(PLACE)},
        "metadata": {"referenceSystem": crs} if crs else {},
        "CityObjects": objects,
        "vertices": [[round(1000 * v) for v in vertex] for vertex in vertices],
        **more,
    }


def house_json(**more: Any) -> dict[str, Any]:
    """The house with its attribute."""
    house = {"type": "Building", "attributes": {"measuredHeight": 7.0}, "geometry": [solid()]}
    return city_json({"house": house}, CORNERS, **more)


def write_json(path: Path, document: dict[str, Any]) -> Path:
    """Write a document."""
    path.write_text(json.dumps(document))
    return path


def write_sequence(path: Path, documents: list[dict[str, Any]]) -> Path:
    """Write documents as CityJSONSeq: the first one's transform and metadata count for all."""
    head = {key: documents[0][key] for key in ("type", "version", "transform", "metadata")}
    lines = [head | {"CityObjects": {}, "vertices": []}]
    for one in documents:
        name = next(iter(one["CityObjects"]))
        lines.append({"type": "CityJSONFeature", "id": name} | {k: one[k] for k in ("CityObjects", "vertices")})
    path.write_text("\n".join(map(json.dumps, lines)) + "\n")
    return path


def ring_gml(ring: list[int], *, swap: bool = False) -> str:
    """A ring of the house as a ``gml:LinearRing`` with a repeated end."""
    numbers = []
    for v in [*ring, ring[0]]:
        x, y, z = (a + b for a, b in zip(CORNERS[v], PLACE, strict=True))
        numbers += [y, x, z] if swap else [x, y, z]
    text = " ".join(map(str, numbers))
    return f"<gml:LinearRing><gml:posList srsDimension='3'>{text}</gml:posList></gml:LinearRing>"


def polygon_gml(ring: list[int], name: str = "", **more: Any) -> str:
    """A face of the house as a ``gml:Polygon``."""
    given = f" gml:id='{name}'" if name else ""
    return f"<gml:Polygon{given}><gml:exterior>{ring_gml(ring, **more)}</gml:exterior></gml:Polygon>"


def write_gml(
    path: Path, content: str, *, version: str = "2.0", crs: str = "EPSG:28992", before: str = ""
) -> Path:
    """Write the members of a city model as CityGML."""
    gml = "http://www.opengis.net/gml/3.2" if version == "3.0" else "http://www.opengis.net/gml"
    spaces = {
        "": f"http://www.opengis.net/citygml/{version}",
        ":bldg": f"http://www.opengis.net/citygml/building/{version}",
        ":con": "http://www.opengis.net/citygml/construction/3.0",
        ":gml": gml,
        ":xlink": "http://www.w3.org/1999/xlink",
    }
    names = " ".join(f'xmlns{key}="{value}"' for key, value in spaces.items())
    envelope = f"<gml:boundedBy><gml:Envelope srsName='{crs}'/></gml:boundedBy>" if crs else ""
    path.write_text(f"<?xml version='1.0'?>{before}<CityModel {names}>{envelope}{content}</CityModel>")
    return path


def house_gml(name: str = "house", *, inner: str = "", swap: bool = False) -> str:
    """The house by its boundary surfaces."""
    surfaces = ""
    for kind, rings in FACES.items():
        for ring in rings:
            surfaces += (
                f"<bldg:boundedBy><bldg:{kind}><bldg:lod2MultiSurface><gml:MultiSurface><gml:surfaceMember>"
                f"{polygon_gml(ring, swap=swap)}</gml:surfaceMember></gml:MultiSurface></bldg:lod2MultiSurface>"
                f"</bldg:{kind}></bldg:boundedBy>"
            )
    return (
        f"<cityObjectMember><bldg:Building gml:id='{name}'>{inner}<bldg:measuredHeight uom='m'>7"
        f"</bldg:measuredHeight>{surfaces}</bldg:Building></cityObjectMember>"
    )
