"""Coordinate reference systems: read, named, compared, and where on Earth they have a place (steps 1.1, 1.2)."""

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyproj

from pipeline.data.errors import ConfigError
from tiler.words.plain_text import printable

_ALIKE = 20  # confidence (%) above which PROJ names a candidate, which is then compared in full
SAME_PLACE = 0.1  # m; CRSs between which a region moves by less are one
_PLACE_SLACK = 1.0  # degrees that a cloud may lie outside the area that a CRS is meant for
Box = tuple[float, float, float, float]


def parse_crs(text: str) -> pyproj.CRS:
    """Parse the CRS that a user asked for: anything that pyproj understands, compound ones included.

    Raises
    ------
    ConfigError
        If it cannot be parsed.
    """
    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as error:
        raise ConfigError(f"--crs {text!r} is no CRS that PROJ knows; give for example EPSG:28992") from error


def crs_or_none(text: str) -> pyproj.CRS | None:
    """Parse the CRS that a file names; None where PROJ does not understand it."""
    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError:
        return None


@lru_cache(maxsize=64)
def horizontal_crs(crs: pyproj.CRS | None) -> pyproj.CRS | None:
    """Give the two-dimensional horizontal part of a CRS, the entry of the EPSG register where it is one.

    None for None, and for an engineering CRS such as the "undefined" one of GeoPackage, which says nothing about
    the place on Earth.

    Examples
    --------
    >>> horizontal_crs(pyproj.CRS("EPSG:7415")).to_epsg()  # Amersfoort / RD New + NAP height
    28992
    """
    while crs is not None and (crs.is_compound or crs.is_bound):
        crs = crs.sub_crs_list[0] if crs.is_compound else crs.source_crs
    if crs is None or crs.is_engineering:
        return None
    flat = crs.to_2d() if len(crs.axis_info) > 2 and not crs.is_geocentric else crs
    code = flat.to_epsg(min_confidence=_ALIKE)
    if code is not None:
        listed = pyproj.CRS.from_epsg(code)
        if _east_first(flat).equals(_east_first(listed), ignore_axis_order=True):
            return listed
    return flat


def crs_name(crs: pyproj.CRS) -> str:
    """Name a CRS for a message or a command: its register's code, else its own name.

    Examples
    --------
    >>> crs_name(pyproj.CRS("EPSG:3006"))
    'EPSG:3006'
    """
    authority = crs.to_authority()
    return ":".join(authority) if authority else crs.name


def short_crs(text: str) -> str:
    """Write a CRS as a message can hold it: WKT is too long."""
    return printable(text) if len(text) < 40 else "a CRS of its own"


@lru_cache(maxsize=64)
def same_crs(one: pyproj.CRS, other: pyproj.CRS) -> bool:
    """Whether two CRSs mean the same horizontally, however they are written.

    Axis order does not matter: files store x before y.

    Examples
    --------
    >>> rd = pyproj.CRS("EPSG:28992")
    >>> same_crs(rd, pyproj.CRS(rd.to_wkt("WKT1_ESRI")))
    True
    >>> same_crs(rd, pyproj.CRS("EPSG:28991"))
    False
    """
    a, b = horizontal_crs(one), horizontal_crs(other)
    if a is None or b is None:
        return False
    return bool(_east_first(a).equals(_east_first(b), ignore_axis_order=True))


def utm_crs(bounds: Sequence[float], crs: pyproj.CRS) -> str | None:
    """Name the UTM zone (WGS 84) of the middle of a box, x before y in `crs`; None if it is not on Earth.

    Examples
    --------
    >>> utm_crs((4.8, 52.3, 5.0, 52.5), pyproj.CRS("EPSG:4326"))
    'EPSG:32631'
    >>> utm_crs((151.1, -33.9, 151.3, -33.8), pyproj.CRS("EPSG:4326"))
    'EPSG:32756'
    """
    place = _lon_lat(bounds, crs)
    if place is None:
        return None
    lon, lat = place
    zone = min(int((lon + 180) // 6) + 1, 60)
    return f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"


def crs_text(crs: pyproj.CRS) -> str:
    """Write a CRS so that it can be parsed anywhere: EPSG:NNNN where it is of that register, else WKT.

    Examples
    --------
    >>> crs_text(pyproj.CRS("EPSG:28992"))
    'EPSG:28992'
    """
    code = crs.to_epsg()
    return f"EPSG:{code}" if code else str(crs.to_wkt())


def geographic_box(bounds: Sequence[float], crs: pyproj.CRS) -> tuple[float, float, float, float] | None:
    """Give west, south, east and north (degrees) of the middle of a box, a tenth of a degree around it."""
    place = _lon_lat(bounds, crs)
    if place is None:
        return None
    lon, lat = place
    return max(lon - 0.05, -180.0), max(lat - 0.05, -90.0), min(lon + 0.05, 180.0), min(lat + 0.05, 90.0)


def scale_of(bounds: Sequence[float], crs: pyproj.CRS) -> float:
    """Give how long a metre on the ground is in a projected, metric CRS, at the middle of a box (m).

    Of the directions along both axes that which is farther from 1; NaN if the box is not on Earth, or PROJ has no
    transformation of the CRS.

    Examples
    --------
    >>> round(scale_of((120000, 487000, 121000, 488000), pyproj.CRS("EPSG:28992")), 4)
    0.9999
    >>> round(scale_of((545000, 6867000, 545100, 6867100), pyproj.CRS("EPSG:3857")), 2)
    1.64
    """
    base, reach = crs.geodetic_crs, 500.0
    if base is None:
        return math.nan
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    ends = np.array([(x - reach, y), (x + reach, y), (x, y - reach), (x, y + reach)])
    try:
        lon, lat = pyproj.Transformer.from_crs(crs, base, always_xy=True).transform(*ends.T)
    except pyproj.exceptions.ProjError:  # some entries of the Esri register lack a parameter
        return math.nan
    if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
        return math.nan
    geod = base.get_geod()
    if geod is None:
        return math.nan
    _, _, length = geod.inv(lon[::2], lat[::2], lon[1::2], lat[1::2])
    scales = 2 * reach / np.asarray(length)
    return float(scales[np.argmax(np.abs(scales - 1))])


def move_between(one: pyproj.CRS, other: pyproj.CRS, bounds: Sequence[float]) -> float:
    """Give how far coordinates move where those of one CRS become those of another (units of the CRSs).

    Corners and middle of a box, easting first, are tried, of CRSs that are both projected or both geographic;
    infinite where a place is lost, or the CRSs are of different kinds.

    Examples
    --------
    >>> zones = pyproj.CRS("EPSG:25832"), pyproj.CRS("EPSG:32632")
    >>> move_between(*zones, (565000, 5934000, 566000, 5935000)) < 0.001
    True
    """
    if one.is_geographic != other.is_geographic:
        return math.inf
    xmin, ymin, xmax, ymax = bounds[:4]
    x = np.array([xmin, xmax, xmin, xmax, (xmin + xmax) / 2])
    y = np.array([ymin, ymin, ymax, ymax, (ymin + ymax) / 2])
    try:
        to_x, to_y = pyproj.Transformer.from_crs(one, other, always_xy=True).transform(x, y)
    except pyproj.exceptions.ProjError:
        return math.inf
    moved = np.hypot(np.asarray(to_x) - x, np.asarray(to_y) - y)
    return float(moved.max()) if np.isfinite(moved).all() else math.inf


def is_one(one: pyproj.CRS, other: pyproj.CRS, bounds: Sequence[float]) -> bool:
    """Whether two CRSs are one: written alike, or a box moves by less than `SAME_PLACE` between them."""
    return same_crs(one, other) or move_between(one, other, bounds) < SAME_PLACE


def _east_first(crs: pyproj.CRS) -> pyproj.CRS:
    """Write a projected CRS with its easting first: PROJ compares regardless of axis order only degrees."""
    if not crs.is_projected or [axis.direction for axis in crs.axis_info] != ["north", "east"]:
        return crs
    fields = crs.to_json_dict()
    fields["coordinate_system"]["axis"].reverse()
    fields.pop("id", None)
    return pyproj.CRS.from_json_dict(fields)


def is_on_its_place(bounds: Sequence[float], crs: pyproj.CRS) -> bool:
    """Whether the middle of a box lies where a CRS is meant for, or within a degree of it.

    Examples
    --------
    >>> rd = pyproj.CRS("EPSG:28992")
    >>> is_on_its_place((120000, 487000, 121000, 488000), rd), is_on_its_place((4.8, 52.3, 4.9, 52.4), rd)
    (True, False)
    """
    area = crs.area_of_use
    if area is None:
        return True
    place = _lon_lat(bounds, crs)
    if place is None:
        return False
    lon, lat = place
    width = (area.east - area.west) % 360 or 360.0  # an area may cross the date line
    return (
        area.south - _PLACE_SLACK <= lat <= area.north + _PLACE_SLACK
        and (lon - area.west + _PLACE_SLACK) % 360 <= width + 2 * _PLACE_SLACK
    )


def _lon_lat(bounds: Sequence[float], crs: pyproj.CRS) -> tuple[float, float] | None:
    """Give the longitude and latitude (WGS 84, degrees) of the middle of a box, None if it has none."""
    xmin, ymin, xmax, ymax = bounds[:4]
    try:
        lon, lat = _to_degrees(crs).transform((xmin + xmax) / 2, (ymin + ymax) / 2)
    except pyproj.exceptions.ProjError:
        return None
    on_earth = math.isfinite(lon) and math.isfinite(lat) and abs(lon) <= 180 and abs(lat) <= 90
    return (lon, lat) if on_earth else None


@lru_cache(maxsize=8)
def _to_degrees(crs: pyproj.CRS) -> pyproj.Transformer:
    """Make the transformer to longitude and latitude, once for all clouds: that takes PROJ a tenth of a second."""
    return pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)


def like_degrees(box: Box) -> bool:
    """Whether coordinates can be longitude and latitude, in either order: no projected region is so small."""
    return max(abs(value) for value in box) <= 360 and max(box[2] - box[0], box[3] - box[1]) < 5


def fault_of(crs: pyproj.CRS) -> str:
    """Explain why lengths in a CRS are not lengths on the ground; ``""`` for a projected one."""
    if crs.is_geographic:
        return "is geographic (degrees)"
    return "" if crs.is_projected else f"is no projected CRS ({crs.type_name})"


def directions_of(crs: pyproj.CRS) -> str:
    """Describe where the axes of a CRS point."""
    return " and ".join(axis.direction.lower() for axis in crs.axis_info[:2])


def box_words(box: Sequence[float]) -> str:
    """Write a box for a message."""
    return " ".join(f"{value:.10g}" for value in box)


def pdal_command(cloud: Path, crs: pyproj.CRS, target: str | None) -> str:
    """Give the command of PDAL that reprojects a cloud."""
    name = cloud.name.split(".")[0]
    source = f" --filters.reprojection.in_srs={crs_name(crs)}" if crs.to_authority() else ""
    return (
        f'pdal translate "{cloud}" "{cloud.with_name(f"{name}_metric.laz")}" reprojection{source} '
        f"--filters.reprojection.out_srs={target or 'EPSG:<a projected CRS in metres>'}"
    )


def boxes_meet(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether two boxes have a place in common."""
    return one[0] <= other[2] and one[2] >= other[0] and one[1] <= other[3] and one[3] >= other[1]


def box_around(boxes: Iterable[Sequence[float]]) -> Box:
    """Give the box around boxes, of which the first four numbers count."""
    xmin, ymin, xmax, ymax, *_ = zip(*boxes, strict=True)
    return min(xmin), min(ymin), max(xmax), max(ymax)
