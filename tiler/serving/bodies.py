"""What a client asks for: JSON bodies as edits, checked before anything waits for them."""

import base64
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

import jsonschema
import numpy as np
import pyogrio
import pyproj
import shapely
from pyproj.exceptions import CRSError

from pipeline.data.errors import InputError
from tiler.editing.edit import City
from tiler.editing.requests import ACTIONS, Asked, read_date
from tiler.editing.uploads import HEIGHT, Upload, read_upload

MOST_BYTES = 2**20  # of a body
TEXT = {"type": "string", "minLength": 1, "maxLength": 200}
SCHEMA = {
    "type": "object",
    "required": ["action"],
    "additionalProperties": False,
    "properties": {
        "id": TEXT | {"pattern": "^[A-Za-z0-9._-]+$"},
        "action": {"enum": list(ACTIONS)},
        "building": TEXT,
        "footprint": {"type": "object"},
        "height": {"type": "number", "exclusiveMinimum": 0, "maximum": 10_000},
        "crs": TEXT,
        "cityjson": {"type": "object"},
        "glb": {"type": "string", "contentEncoding": "base64"},
        "position": {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3},
        "date": {"type": "string"},
        "base": {"type": "integer", "minimum": 0},
    },
}
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)


def read_body(data: bytes) -> dict[str, Any]:
    """Parse a body; InputError unless it is an edit as `SCHEMA` has it."""
    try:
        found = json.loads(data, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"body: is no JSON ({error}); send an object as docs/serve.md has it") from None
    if wrong := jsonschema.exceptions.best_match(VALIDATOR.iter_errors(found)):
        place = ".".join(map(str, wrong.absolute_path)) or "body"
        raise InputError(f"{place}: {wrong.message}; see docs/serve.md")
    body: dict[str, Any] = found
    given = [name for name in WRITERS if name in body]
    if len(given) != (body["action"] != "remove"):
        raise InputError(f"{body['action']}: has {' and '.join(given) or 'none'}; replace and add take one of "
                         f"{', '.join(WRITERS)}, remove none")  # fmt: skip
    if body["action"] != "add" and "building" not in body:
        raise InputError(f"{body['action']}: has no building; name the one that is meant")
    if stray := sorted({"height", "crs"} & body.keys()) if "footprint" not in body else []:
        raise InputError(f"{stray[0]}: is for a footprint; leave it out")
    if "position" in body and "glb" not in body:
        raise InputError("position: is for a glb; leave it out")
    if body["action"] == "add" and "cityjson" not in body and "building" not in body:
        raise InputError("add: has no building; give the new one an id")
    return body


def make_asked(body: Mapping[str, Any], city: City) -> Asked:
    """Make an edit of a body from `read_body`; errors as of `read_upload`, and for what is no polygon or CRS."""
    what = {name: value for name, value in body.items() if name != "id"}
    digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()
    read_date(body.get("date", ""))
    upload, source = None, ""
    if body["action"] != "remove":
        with TemporaryDirectory(prefix="citystitch-") as folder:
            (write,) = (write for name, write in WRITERS.items() if name in body)
            path = write(body, city, Path(folder))
            source, given = path.name, Upload(path, body.get("position"))
            try:
                upload = read_upload(given, city.config, crs=city.crs, bounds=city.bounds)
            except InputError as error:
                raise InputError(str(error).replace(f"{path}: ", "")) from None
    if upload is not None and "cityjson" not in body:
        upload = upload.with_ids(body["building"])
    return Asked(
        *(body["action"], body.get("building", ""), upload, source),
        date=body.get("date", ""),
        base=body.get("base"),
        request=body.get("id", ""),
        digest=digest,
    )


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


def _write_footprint(body: Mapping[str, Any], city: City, folder: Path) -> Path:
    try:
        shape = shapely.from_geojson(json.dumps(body["footprint"]))
        crs = pyproj.CRS.from_user_input(body.get("crs", city.crs)).to_wkt()
    except shapely.errors.GEOSException as error:
        raise InputError(f"footprint: is no GeoJSON ({error}); send a Polygon") from None
    except CRSError as error:
        raise InputError(f"crs {body['crs']!r}: is unknown ({error}); send one such as EPSG:4326") from None
    if shape is None or shape.geom_type not in ("Polygon", "MultiPolygon"):
        raise InputError("footprint: is no polygon; send a GeoJSON Polygon")
    blob = np.array([shapely.to_wkb(shape)], np.object_)
    path = folder / "footprint.gpkg"
    height = {city.config.height_attribute or HEIGHT: np.array([body["height"]])} if "height" in body else {}
    pyogrio.raw.write(path, blob, [*height.values()], [*height], geometry_type=shape.geom_type, crs=crs)
    return path


def _write_model(body: Mapping[str, Any], city: City, folder: Path) -> Path:
    path = folder / "building.city.json"
    path.write_text(json.dumps(body["cityjson"]))
    return path


def _write_glb(body: Mapping[str, Any], city: City, folder: Path) -> Path:
    path = folder / "building.glb"
    try:
        path.write_bytes(base64.b64decode(body["glb"], validate=True))
    except ValueError as error:
        raise InputError(f"glb: is not in base64 ({error}); encode the file so") from None
    return path


WRITERS = {"footprint": _write_footprint, "cityjson": _write_model, "glb": _write_glb}
