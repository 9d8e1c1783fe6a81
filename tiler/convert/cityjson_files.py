"""CityJSON 2.0 and CityJSONSeq of features."""

from dataclasses import dataclass, field
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.cityinput.faces import WALL
from tiler.citymodels.cityjson_text import ObjectLines, compact, reference_system
from tiler.convert.features import OPENINGS, SURFACES, Feature, Geometry, iter_features, level_text, origin_of
from tiler.convert.inputs import ModelSource
from tiler.convert.picture_pages import PAGE, Pages
from tiler.georeference.crs import horizontal_crs

HIGHEST = 4  # CityJSON has no level from this on
THEME = "facades"  # of textures


@dataclass
class Textures:
    """Textures of a document or of a feature: pages in a folder beside the file, and places on them."""

    pages: Pages  #: where pictures are put
    folder: str  #: name of the folder of pages, see `page_name`
    used: dict[int, int] = field(default_factory=dict)  #: number of each page among the textures
    #: places on pages that are not written yet; u to the right, v upwards, from 0 to 1
    places: list[list[float]] = field(default_factory=list)
    n_written: int = 0  #: number of those that are

    def show(self, item: Geometry, xyz: NDArray[np.float64]) -> dict[str, Any]:
        """Give what shows on the faces of a geometry, whose vertices are at `xyz`, float64 (n, 3)."""
        values: list[Any] = [[[None]] for _ in item.faces]
        for k, picture in item.pictures.items():
            place = self.pages.place(picture)
            texture = self.used.setdefault(place.page, len(self.used))
            values[k] = []
            for ring in item.faces[k][1]:
                flat = picture.frame.to_local(xyz[ring])[:, [0, 2]] / place.pixel
                on_page = np.array([place.left, PAGE - place.low]) + flat
                first = self.n_written + len(self.places)
                self.places += (on_page / PAGE).round(6).tolist()
                values[k].append([texture, *range(first, first + len(ring))])
        return {THEME: {"values": [values] if item.closed else values}}

    def head(self) -> dict[str, Any]:
        """Give the appearance without its places."""
        images = [f"{self.folder}/{page_name(page)}" for page in self.used]
        told = [{"type": "PNG", "image": name, "wrapMode": "clamp", "textureType": "typical"} for name in images]
        return {"default-theme-texture": THEME, "textures": told}


def page_name(page: int) -> str:
    """Name the file of a page, which are numbered from 0 on."""
    return f"{page + 1}.png"


def write_sequence(path: Path, source: ModelSource, pages: Pages | None = None, folder: str = "") -> None:
    """Write CityJSONSeq: the head, then a feature a line; with `pages` they have textures, in a folder."""
    with path.open("wb") as file:
        file.write(head_line(source))
        for feature in iter_features(source):
            file.write(feature_line(feature, source, Textures(pages, folder) if pages else None))


def head_line(source: ModelSource) -> bytes:
    """Give the first line of a sequence."""
    return _line(_head(source) | {"CityObjects": {}, "vertices": []})


def feature_line(feature: Feature, source: ModelSource, textures: Textures | None = None) -> bytes:
    """Give the line of a building in a sequence."""
    objects = _objects(feature, source, textures=textures)
    told = {"type": "CityJSONFeature", "id": feature.objects[0].id, "CityObjects": objects}
    if textures is not None and textures.used:
        told["appearance"] = textures.head() | {"vertices-texture": textures.places}
    return _line(told | {"vertices": feature.vertices.tolist()})


def write_document(path: Path, source: ModelSource, pages: Pages | None = None, folder: str = "") -> None:
    """Write CityJSON, an object a line; vertices and places on `pages` wait in temporary files."""
    textures = None if pages is None else Textures(pages, folder)
    with path.open("wb") as file, TemporaryFile() as vertex_file, TemporaryFile() as place_file:
        file.write(_line(_head(source))[:-2] + b",")
        lines = ObjectLines(file.write, vertex_file)
        for feature in iter_features(source):
            objects = _objects(feature, source, lines.n_vertices, textures)
            lines.add_objects(f"{compact(name)}:{compact(thing)}" for name, thing in objects.items())
            lines.add_vertices(feature.vertices)
            if textures is not None and textures.places:
                text = compact(textures.places)[1:-1].encode("ascii")
                place_file.write(b",\n" + text if textures.n_written else text)
                textures.n_written += len(textures.places)
                textures.places.clear()
        lines.finish()
        if textures is not None and textures.used:
            file.write(b',\n"appearance":' + _line(textures.head())[:-2] + b',"vertices-texture":[')
            place_file.seek(0)
            copyfileobj(place_file, file)
            file.write(b"]}")
        file.write(b"}\n")


def _head(source: ModelSource) -> dict[str, Any]:
    extent = [round(float(value), 9) for value in (*source.low, *source.high)]
    metadata: dict[str, Any] = {"geographicalExtent": extent}
    if name := reference_system(source.crs) or reference_system(horizontal_crs(source.crs)):
        metadata["referenceSystem"] = name
    transform = {"scale": source.step.tolist(), "translate": origin_of(source).tolist()}
    return {"type": "CityJSON", "version": "2.0", "transform": transform, "metadata": metadata}


def _objects(
    feature: Feature, source: ModelSource, first: int = 0, textures: Textures | None = None
) -> dict[str, Any]:
    """Give the objects of a feature by id; vertices are counted from `first`."""
    xyz = feature.vertices * source.step + origin_of(source)
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
        for item, told in zip(kept, geometry, strict=True):
            if textures is not None and item.pictures:
                told["texture"] = textures.show(item, xyz)
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
