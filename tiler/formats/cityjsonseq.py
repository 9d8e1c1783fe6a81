"""CityJSONSeq: the city model line by line, the first with its metadata, then one feature a building."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np

from pipeline.data.errors import InputError
from tiler.citymodels.building_index import Vertices, copy_vertices, has_parts, read_objects
from tiler.export.export import Format
from tiler.store.atomic import replacing
from tiler.store.out_folder import CITY_MODEL
from tiler.store.run_folder import WRONG_FIELD, broken_field


def export_cityjsonseq(output: Path, directory: Path) -> None:
    """Write the simplified city model of a finished run as CityJSONSeq.

    Parameters
    ----------
    output : Path
        The file; it appears whole or not at all.
    directory : Path
        Folder of the run.

    Raises
    ------
    InputError
        If the city model is missing or damaged.
    OutputError
        If the file cannot be written.
    """
    with replacing(output) as part:
        write_cityjsonseq(part, directory / CITY_MODEL)


def write_cityjsonseq(path: Path, model: Path) -> None:
    """Write a CityJSON file as CityJSONSeq.

    Parameters
    ----------
    path : Path
        The file.
    model : Path
        CityJSON 2.0 of buildings, and buildings with parts.

    Raises
    ------
    InputError
        If the city model is missing or damaged.

    Notes
    -----
    Buildings without parts come first, in the order of the city model, then those with parts. A feature has its
    own vertices, each once, and the transform of the first line. The city model is read twice, an object at a
    time; vertices and parts wait in temporary files. Memory holds the ids of the parts and their houses.

    References
    ----------
    CityJSON 2.0.1, section 8, https://www.cityjson.org/specs/2.0.1/#text-sequences-and-streaming-with-cityjsonfeature
    """
    with (
        TemporaryFile() as vertex_file,
        TemporaryFile(dir=path.parent) as parts,
        path.open("wb") as file,
    ):
        vertices = copy_vertices(model, vertex_file)
        head = {"type": "CityJSON", "version": "2.0", **_pick(vertices.head, ("transform", "metadata"))}
        file.write(_line(head | {"CityObjects": {}, "vertices": []}))
        for name, objects in _features(model, parts):
            try:
                feature = _make_feature(name, objects, vertices)
            except WRONG_FIELD as error:
                raise InputError(
                    f"{model}: building {name!r}: a field is missing or wrong ({error!r}); run again"
                ) from None
            file.write(_line(feature))


def _pick(members: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: members[name] for name in names if name in members}


def _features(model: Path, parts: IO[bytes]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Give each building with its parts, as objects by id."""
    place: dict[str, tuple[int, int]] = {}
    houses: dict[str, Any] = {}
    for name, thing in read_objects(model):
        if has_parts(model, thing):
            houses[name] = thing
        elif "parents" in thing:
            data = _line(thing)
            place[name] = parts.tell(), len(data)
            parts.write(data)
        else:
            yield name, {name: thing}
    for name, house in houses.items():
        objects = {name: house}
        try:
            for child in house["children"]:
                start, size = place.pop(child)
                parts.seek(start)
                objects[child] = json.loads(parts.read(size))
        except WRONG_FIELD as error:
            raise broken_field(model, error) from None
        yield name, objects
    if place:
        raise InputError(f"{model}: part {next(iter(place))!r} belongs to no building; run again")


def _make_feature(name: str, objects: Mapping[str, Any], vertices: Vertices) -> dict[str, Any]:
    geometries = [item for thing in objects.values() for item in thing.get("geometry", ())]
    used = np.unique(np.array([i for item in geometries for i in _corners(item["boundaries"])], np.int64))
    if len(used) and not 0 <= used[0] <= used[-1] < len(vertices):
        raise IndexError(f"vertex {used[0]}..{used[-1]} of {len(vertices)}")
    rows, own = np.unique(vertices.take_raw(used).astype(np.int64), axis=0, return_inverse=True)
    places = dict(zip(used.tolist(), own.ravel().tolist(), strict=True))
    moved = {
        key: thing
        if "geometry" not in thing
        else thing
        | {"geometry": [item | {"boundaries": _move(item["boundaries"], places)} for item in thing["geometry"]]}
        for key, thing in objects.items()
    }
    return {"type": "CityJSONFeature", "id": name, "CityObjects": moved, "vertices": rows.tolist()}


def _corners(boundaries: Any) -> Iterator[int]:
    for item in boundaries:
        if isinstance(item, list):
            yield from _corners(item)
        else:
            yield item


def _move(boundaries: Any, places: Mapping[int, int]) -> list[Any]:
    return [_move(item, places) if isinstance(item, list) else places[item] for item in boundaries]


def _line(document: Any) -> bytes:
    return (json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n").encode("ascii")


FORMAT = Format(
    "the simplified city model as CityJSONSeq, one feature a building",
    lambda path, files: export_cityjsonseq(path, files.directory),
    suffix=".jsonl",
)
