"""The metric CRS with axes east and north that a projected CRS stands for, by units and axes alone."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType

from tiler.georeference.frame import Axis
from tiler.georeference.units import exact_unit

_SAME = 0.005  # m within which coordinates of two CRSs are one; false origins are rounded to millimetres
LIKELY = 20  # confidence (%) above which PROJ names a candidate, which is then compared by coordinates
_EAST = {"east": 1.0, "west": -1.0}
_NORTH = {"north": 1.0, "south": -1.0}
_SOUTH_ORIENTED, _TRANSVERSE_MERCATOR = 9808, 9807  # codes of the methods in the EPSG register
_FALSE_EASTING, _FALSE_NORTHING = 8806, 8807  # codes of their parameters


@dataclass(frozen=True)
class MetricCrs:
    """A metric CRS with axes east and north, and where a file has its coordinates."""

    crs: pyproj.CRS  # projected, in metres; that of the EPSG or Esri register where one has it
    # Which coordinate of the file it is, and the metres of its unit; negative where it grows westwards or
    # southwards.
    east: Axis
    north: Axis


@lru_cache(maxsize=64)
def find_metric(crs: pyproj.CRS) -> MetricCrs | None:
    """Find the metric CRS with axes east and north that a projected one stands for, by units and axes alone.

    None if the axes point elsewhere than east and north, and no register has the CRS with those.

    Notes
    -----
    Files store the easting first where a CRS has the axes east and north in either order. Where it has axes to the
    west or south, files store the coordinates as the CRS defines them. Candidates of the registers are compared by
    coordinates, at three places within the area of use.

    Examples
    --------
    >>> find_metric(pyproj.CRS("EPSG:2227")).crs.to_epsg()  # California zone 3, US survey feet
    26943
    >>> found = find_metric(pyproj.CRS("EPSG:5513"))  # Krovak: southing, westing
    >>> found.crs.to_epsg(), found.east, found.north
    (5514, (1, -1.0), (0, -1.0))
    """
    east, north = _axes(crs)
    if east == (0, 1.0) and north == (1, 1.0):
        return MetricCrs(crs, east, north)
    for candidate in _candidates(crs):
        if _is_metric(candidate) and _agree(crs, candidate, east, north):
            return MetricCrs(candidate, east, north)
    return None


def _axes(crs: pyproj.CRS) -> tuple[Axis, Axis]:
    """Name which coordinate is the easting and which the northing, with metres of a unit and direction."""
    first, second = crs.axis_info[:2]
    x, y = first.direction.lower(), second.direction.lower()
    scale, other = (exact_unit(axis.unit_conversion_factor) for axis in (first, second))
    if {x, y} == {"east", "north"} or not ({x, y} <= _EAST.keys() | _NORTH.keys()) or x == y:
        return (0, scale), (1, other)  # around a pole both axes point the same way: x and y of the map
    if x in _EAST:
        return (0, _EAST[x] * scale), (1, _NORTH[y] * other)
    return (1, _EAST[y] * other), (0, _NORTH[x] * scale)


def _is_metric(crs: pyproj.CRS) -> bool:
    east, north = _axes(crs)
    return crs.is_projected and east == (0, 1.0) and north == (1, 1.0)


def _candidates(crs: pyproj.CRS) -> Iterator[pyproj.CRS]:
    """CRSs that may be the metric one: of the registers first, then made of the CRS itself."""
    made = [one for one in (_in_metres(crs), _turned(crs)) if one is not None]
    for one in made:
        code = one.to_epsg(min_confidence=LIKELY)
        if code is not None:
            yield pyproj.CRS.from_epsg(code)
    yield from _of_like_name(crs)
    yield from made


def _of_like_name(crs: pyproj.CRS) -> Iterator[pyproj.CRS]:
    area, name = crs.area_of_use, _plain(crs.name)
    if area is None:
        return
    where = AreaOfInterest(area.west, area.south, area.east, area.north)
    for register in ("EPSG", "ESRI"):
        found = query_crs_info(auth_name=register, pj_types=PJType.PROJECTED_CRS, area_of_interest=where)
        for info in sorted(found, key=lambda one: (len(one.name), one.code)):
            if _plain(info.name).startswith(name):
                yield pyproj.CRS.from_authority(register, info.code)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", re.sub(r"\((ftus|ft|us survey feet)\)|_?feet$", "", name.lower()))


def _in_metres(crs: pyproj.CRS) -> pyproj.CRS | None:
    """The same projection in metres; None for one whose axes point west or south."""
    east, north = _axes(crs)
    if east[1] < 0 or north[1] < 0:
        return None
    fields = _without_code(crs)
    for axis in fields["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
    fields["name"] = f"{re.sub(r' *[(](ftUS|ft)[)]', '', crs.name)} in metres"
    return _parse(fields)


def _turned(crs: pyproj.CRS) -> pyproj.CRS | None:
    """The south-oriented Transverse Mercator as the usual one, whose false origin has the opposite sign."""
    fields = _without_code(crs)
    conversion = fields.get("conversion", {})
    if conversion.get("method", {}).get("id", {}).get("code") != _SOUTH_ORIENTED:
        return None
    conversion["method"] = {
        "name": "Transverse Mercator",
        "id": {"authority": "EPSG", "code": _TRANSVERSE_MERCATOR},
    }
    conversion.pop("id", None)
    for parameter in conversion["parameters"]:
        if parameter.get("id", {}).get("code") in (_FALSE_EASTING, _FALSE_NORTHING):
            parameter["value"] = -parameter["value"] or 0.0
    fields["coordinate_system"]["axis"] = [
        {"name": "Easting", "abbreviation": "E", "direction": "east", "unit": "metre"},
        {"name": "Northing", "abbreviation": "N", "direction": "north", "unit": "metre"},
    ]
    fields["name"] = f"{crs.name}, east and north"
    return _parse(fields)


def _without_code(crs: pyproj.CRS) -> dict[str, Any]:
    fields = crs.to_json_dict()
    fields.pop("id", None)
    return fields


def _parse(fields: dict[str, Any]) -> pyproj.CRS | None:
    try:
        return pyproj.CRS.from_json_dict(fields)
    except pyproj.exceptions.CRSError:
        return None


def _agree(crs: pyproj.CRS, candidate: pyproj.CRS, east: Axis, north: Axis) -> bool:
    """Whether coordinates of a CRS, by its axes and units, are those of the candidate."""
    base, other = crs.geodetic_crs, candidate.geodetic_crs
    if base is None or other is None or not base.equals(other, ignore_axis_order=True):
        return False
    degrees = _places(crs)
    raw = np.column_stack(pyproj.Transformer.from_crs(base, crs).transform(*_in_order(base, degrees)))
    x_first = [axis.direction.lower() for axis in crs.axis_info[:2]] == ["north", "east"]
    raw = raw[:, ::-1] if x_first else raw
    ours = np.column_stack([raw[:, east[0]] * east[1], raw[:, north[0]] * north[1]])
    try:
        forward = pyproj.Transformer.from_crs(other, candidate, always_xy=True)
    except pyproj.exceptions.ProjError:  # some entries of the Esri register lack a parameter
        return False
    theirs = np.column_stack(forward.transform(*degrees.T))
    return bool(np.isfinite(ours).all() and np.abs(ours - theirs).max() <= _SAME)


def _places(crs: pyproj.CRS) -> NDArray[np.float64]:
    """Longitude and latitude of three places within the area of use (degrees)."""
    area = crs.area_of_use
    if area is None:
        middle = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(0.0, 0.0)
        lon, lat = middle if np.isfinite(middle).all() else (0.0, 0.0)
        return np.array([(lon, lat), (lon + 0.1, lat), (lon, lat + 0.1)])
    width, height = (area.east - area.west) % 360 or 360.0, area.north - area.south
    shares = ((0.5, 0.5), (0.4, 0.45), (0.55, 0.6))
    return np.array([(area.west + a * width, area.south + b * height) for a, b in shares])


def _in_order(base: pyproj.CRS, degrees: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lon, lat = degrees.T
    return (lat, lon) if base.axis_info[0].direction.lower() == "north" else (lon, lat)


def axes_words(metric: MetricCrs) -> str:
    """State that axes were turned or exchanged, ``""`` where they were not."""
    if metric.east[0] == 1 and min(metric.east[1], metric.north[1]) > 0:
        return ", northing before easting,"
    return ", axes to the west and south," if metric.east[1] < 0 or metric.north[1] < 0 else ""
