"""Which vector files GDAL may open: those that hold their own features (step 1.2).

GDAL tells formats by their content, whatever the name. Some only point elsewhere: a VRT, WFS or GDALG file of a
few lines makes it read other files, ask servers and databases, or run an algorithm. Archives may hold any of them,
and expand without end. So a file is looked at before GDAL is asked.
"""

import re
import stat
from pathlib import Path

from pipeline.data.errors import InputError

_HEAD = 65_536  # bytes that are looked at; GDAL looks for these marks in fewer
# Marks by which GDAL's drivers recognise a file that points elsewhere, lower case.
_POINTERS = (
    b"<ogrvrtdatasource", b"<vrtdataset", b"<ogrwfsdatasource", b"<ogrcswdatasource", b"gdal_streamed_alg",
)  # fmt: skip
_BEGINNINGS = {
    b"\x00\x00\x27\x0a": "Shapefile",
    b"SQLite format 3\x00": "GeoPackage",
    b"fgb": "FlatGeobuf",
    b"{": "GeoJSON",
    b"\x1e": "GeoJSON sequence",
}
# A city model by its first element, or its first type: properties of GeoJSON may hold any.
_CITY_MODELS = {
    "CityJSON": re.compile(rb'(?:(?!"type").)*"type"\s*:\s*"CityJSON(?:Feature)?"', re.DOTALL),
    "CityGML": re.compile(rb"[^{]*?<(?:\w+:)?CityModel[\s>]"),
}
# The first block of an OSM extract in protocol buffers, behind its length; and the first element of one in XML,
# with nothing but the declaration and comments before: no entities, which may expand without end.
_OSM_BLOCK, _OSM_BLOCK_PLACE = b"\x0a\x09OSMHeader", 4
_OSM_XML = re.compile(rb"(<\?xml[^>]*\?>)?\s*(<!--(?:[^-]|-(?!->))*-->\s*)*<osm[\s>]")


def check_form(path: Path) -> None:
    """Refuse a vector file that GDAL should not open.

    Taken are Shapefile, GeoPackage, GeoJSON (also as a sequence, TopoJSON and Esri JSON), FlatGeobuf and extracts
    of OpenStreetMap, told by their content; and folders, such as an Esri geodatabase.

    Raises
    ------
    InputError
        If it is a city model or of another form, points elsewhere, is no regular file, or cannot be read.
    """
    if path.is_dir():
        return
    head = read_head(path)
    for name, mark in _CITY_MODELS.items():
        if mark.match(head):
            raise InputError(f"{path}: is a city model ({name}), no vector file; give it as --buildings")
    pointer = next((mark for mark in _POINTERS if mark in head.lower()), None)
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    known = any(start.startswith(mark) for mark in _BEGINNINGS) or is_osm(head)
    if pointer is not None or not known:
        what = (
            f"points to other data ({pointer.decode()})"
            if pointer
            else "is none of SHP, GPKG, GeoJSON, FlatGeobuf, OSM"
        )
        raise InputError(
            f'{path}: cannot be read: it {what}; convert it, if you trust it: ogr2ogr footprints.gpkg "{path}"'
        )


def is_osm(head: bytes) -> bool:
    """Whether a file that begins so is an extract of OpenStreetMap, in XML or protocol buffers.

    Examples
    --------
    >>> is_osm(b"<?xml version='1.0'?>\\n<osm version='0.6'>"), is_osm(b"<!DOCTYPE osm []><osm>")
    (True, False)
    """
    return (
        head.startswith(_OSM_BLOCK, _OSM_BLOCK_PLACE)
        or _OSM_XML.match(head.removeprefix(b"\xef\xbb\xbf")) is not None
    )


def read_head(path: Path) -> bytes:
    """Read the first 64 kB of a file that is to be opened by a library.

    Raises
    ------
    InputError
        If it is empty or cannot be read, or is no regular file: a pipe or a device may never end.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(f"{path}: is no regular file; give a file with footprint polygons")
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check the path and its permissions") from error
    if not head:
        raise InputError(f"{path}: is empty; copy it again")
    return head
