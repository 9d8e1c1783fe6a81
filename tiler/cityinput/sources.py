"""Files of city models: what kind they are, what they say of themselves, and their buildings one at a time."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyproj

from pipeline.data.errors import ConfigError, InputError
from tiler.cityinput.citygml import Relief, scan_citygml
from tiler.cityinput.cityjson import count_others, read_buildings, read_objects, read_relief
from tiler.cityinput.crs_names import NamedCrs, read_crs_name
from tiler.cityinput.face_planes import signed_volume, upward_area
from tiler.cityinput.faces import ModelBuilding
from tiler.cityinput.geopackage import SIGNATURE, scan_geopackage
from tiler.georeference.crs import crs_text, horizontal_crs, is_on_its_place, parse_crs
from tiler.georeference.frame import Frame
from tiler.pointclouds.clouds import CloudHeader

CLOUD, MODEL, TERRAIN = "cloud", "model", "terrain"
_RASTERS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
ENOUGH = 2000  # solids and roofs that tell the order of axes
CLEAR = 0.9  # share of solids and roofs that agree on an order of axes


def kind_of(path: Path) -> str:
    """Whether a file is a point cloud, a city model or a raster of terrain, by its first bytes.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(4096)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start.startswith(_RASTERS) or text.startswith(b"<VRTDataset"):
        return TERRAIN
    return MODEL if text[:1] in (b"{", b"<") or start.startswith(SIGNATURE) else CLOUD


def scan_model(
    path: Path, height: str = "", *, attributes: bool = False, around: bool = False
) -> Iterator[str | ModelBuilding | Relief | Counter[str]]:
    """Give the names of CRSs, the buildings and the terrain of a city model, in the order of the file.

    Also numbers of other objects of CityJSON, by type.

    Parameters
    ----------
    path : Path
        CityJSON, CityJSONSeq or CityGML file, or a GeoPackage as of 3DBAG.
    height : str
        Attribute with the height above ground (m); ``""`` for the format's own.
    attributes : bool
        Whether attributes of a GeoPackage are read too: those of other formats always are.
    around : bool
        Whether storeys, roads, plant cover and trees of CityJSON are given too.

    Raises
    ------
    InputError
        If the file is none of these, or damaged.
    """
    with path.open("rb") as file:
        start = file.read(64).removeprefix(b"\xef\xbb\xbf").lstrip()
    if start[:1] == b"<":
        yield from scan_citygml(path, height)
        return
    if start.startswith(SIGNATURE):
        yield from scan_geopackage(path, attributes=attributes)
        return
    if start[:1] != b"{":
        raise InputError(
            f"{path}: is neither CityJSON nor CityGML nor a GeoPackage: it begins with {start[:20]!r}"
        )
    head, documents = read_objects(path)
    if head.crs:
        yield head.crs
    for objects, vertices in documents:
        yield from read_buildings(objects, vertices, height, around=around)
        yield from map(Relief, read_relief(objects, vertices))
        if others := count_others(objects, around=around):
            yield others


class _Survey:
    """Extent of a model, numbers of its buildings and vertices, and of solids and roofs by where they look."""

    def __init__(self) -> None:
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.n_buildings = self.n_vertices = self.right = self.wrong = 0

    def add(self, building: ModelBuilding) -> None:
        self.n_buildings += 1
        shapes = [shape for shape in building.shapes if len(shape.faces)]
        if shapes:
            xyz = np.concatenate([shape.faces.xyz for shape in shapes])
            self.n_vertices += len(xyz)
            self.low = np.minimum(self.low, xyz.min(axis=0))
            self.high = np.maximum(self.high, xyz.max(axis=0))
        for shape in shapes if self.right + self.wrong < ENOUGH else ():
            sign = signed_volume(shape.faces) if shape.closed else upward_area(shape.faces)
            self.right += sign > 0
            self.wrong += sign < 0


def read_model_header(path: Path, axis_order: str = "", *, around: bool = False) -> CloudHeader:
    """Read a city model once for its extent, its CRS and the order of its axes.

    `axis_order` is ``"xy"`` for the easting first, ``"yx"`` for the northing first; ``""`` for what the file
    shows. The bounds of the header have the easting first, and ``swapped`` says whether the file has not. They are
    those of buildings; with `around` also of what `scan_model` gives then.
    InputError if the file cannot be read.

    Notes
    -----
    A place in the area of use of the CRS decides the order of the axes; where both orders have one, or there is no
    CRS, the solids and roofs do: with the wrong order volumes are negative and roofs look down. Where neither says
    anything it is that of the name: a URN or a URL of OGC means the order of the register.
    """
    found, name = _Survey(), NamedCrs(None, False, "")
    for each in scan_model(path, around=around):
        if isinstance(each, str):
            name = name if name.text else read_crs_name(each)
        elif isinstance(each, ModelBuilding):
            found.add(each)
    low, high, n = found.low.tolist(), found.high.tolist(), found.n_vertices
    box = (low[0], low[1], high[0], high[1]) if n else (math.nan,) * 4
    if n and not np.isfinite(box).all():
        raise InputError(f"{path}: a coordinate is not finite; mend the file")
    swapped, why = choose_axes(name, box, (found.right, found.wrong), axis_order) if n else (False, "")
    if swapped:
        box = (box[1], box[0], box[3], box[2])
    heights = (low[2], high[2]) if n else (math.nan, math.nan)
    unread = f"the name {name.text!r} of its CRS is not understood" if name.text and name.crs is None else ""
    return CloudHeader(
        path, n, (*box, *heights), name.crs, unread=unread, kind=MODEL, swapped=swapped, axes=why,
        n_buildings=found.n_buildings,
    )  # fmt: skip


def frame_of(header: CloudHeader, target: str) -> Frame:
    """Give the way from a city model to a CRS, ``""`` for its own; ConfigError where one of them is unknown."""
    axes = ((1, 1.0), (0, 1.0)) if header.swapped else ((0, 1.0), (1, 1.0))
    if not target:
        return Frame(*axes)
    wanted, own = horizontal_crs(parse_crs(target)), horizontal_crs(header.crs)
    if own is None or wanted is None:
        raise ConfigError(f"{header.path}: has no CRS that --crs {target} could be reached from; leave --crs out")
    return Frame(*axes, source=crs_text(own), target=crs_text(wanted))


def choose_axes(
    name: NamedCrs, box: tuple[float, float, float, float], sense: tuple[int, int], asked: str
) -> tuple[bool, str]:
    """Decide whether the northing comes first in a file, and say what decided.

    Parameters
    ----------
    name : NamedCrs
        What the file says of its CRS.
    box : tuple of 4 floats
        Least and greatest first and second coordinates: first, second, first, second.
    sense : (int, int)
        Solids and roofs that look outwards and inwards with the first coordinate as the easting.
    asked : str
        ``"xy"``, ``"yx"`` or ``""``.
    """
    if asked:
        return asked == "yx", "by --axis-order"
    other = (box[1], box[0], box[3], box[2])
    flat = horizontal_crs(name.crs)
    north_first = name.registered_axes and flat is not None and is_north_first(flat)
    as_is, turned = (flat is None or is_on_its_place(one, flat) for one in (box, other))
    right, wrong = sense
    if as_is != turned:
        words = "it lies in the area of use of its CRS this way alone"
        return turned, words if turned or north_first else ""
    if wrong > CLEAR * (right + wrong):
        return True, f"{wrong} of {right + wrong} solids and roofs would be inside out otherwise"
    if right > CLEAR * (right + wrong):
        return False, f"{right} of {right + wrong} solids and roofs are right this way" if north_first else ""
    return north_first, "by the name of its CRS" if north_first else ""


def is_north_first(crs: pyproj.CRS) -> bool:
    """Whether the first axis of a CRS is its northing or its latitude."""
    first, second = (axis.direction.lower() for axis in crs.axis_info[:2])
    return first == "north" and second == "east"
