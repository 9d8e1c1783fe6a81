"""What the records of a LAS header say of its CRS and units: WKT, and the GeoTIFF keys beside it (step 1.1)."""

import struct
from dataclasses import dataclass
from functools import lru_cache

import laspy
import pyproj
from laspy.vlrs.known import GeoDoubleParamsVlr, GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from tiler.georeference.units import METRES, exact_unit

# GeoTIFF keys, OGC 19-008r4, annex "Summary of GeoKey IDs"; their units are codes of the EPSG register.
MODEL_TYPE, GEODETIC_CRS, PROJECTED_CRS = 1024, 2048, 3072
PLAN_UNIT, PLAN_UNIT_SIZE = 3076, 3077
VERTICAL_CRS, HEIGHT_UNIT = 4096, 4099
GEOGRAPHIC_MODEL = 2
USER_DEFINED = 32767

# What pyproj and laspy raise on records that make no sense.
_DAMAGE = (pyproj.exceptions.CRSError, ValueError, TypeError, LookupError, OverflowError, struct.error)


@dataclass(frozen=True)
class LasCrs:
    """What a LAS header states of its coordinates."""

    # The CRS of the WKT record, else of the GeoTIFF keys; None if neither states one that is understood.
    crs: pyproj.CRS | None = None
    # Metres of a unit in plan, where a key states it beside the CRS; None where none does.
    plan_unit: float | None = None
    # Metres of a unit of height, by a key or by the vertical part of the CRS; None where nothing states it.
    height_unit: float | None = None
    unread: str = ""  # what a record holds that is not understood, ``""`` if nothing


def read_las_crs(header: laspy.LasHeader) -> LasCrs:
    """Read the CRS and the units that a header states, with its records, also those behind the points.

    Notes
    -----
    `laspy.LasHeader.parse_crs` drops the vertical keys, answers the geodetic CRS for a user-defined projection,
    and does not look at keys of units; so keys are read here. Where a header has WKT and keys, WKT counts, and
    keys only where the WKT cannot be parsed or says nothing of heights.
    """
    records = [*header.vlrs, *(header.evlrs or [])]
    wkt = next((str(one.string) for one in records if isinstance(one, WktCoordinateSystemVlr)), "")
    keys = _keys(records)
    crs, unread = _parse_wkt(wkt.strip("\0 \n"))
    keyed = crs is None
    if crs is None:
        crs, fault = _crs_of_keys(keys)
        unread = unread or fault
    plan_unit = _unit(keys, PLAN_UNIT, PLAN_UNIT_SIZE) if keyed else None
    return LasCrs(crs, plan_unit, _height_unit(crs, keys), unread)


def height_unit_of(crs: pyproj.CRS) -> float | None:
    """Metres of a unit of height by the vertical part of a CRS; None if it has none.

    Examples
    --------
    >>> height_unit_of(pyproj.CRS("EPSG:28992+5709")), height_unit_of(pyproj.CRS("EPSG:28992"))
    (1.0, None)
    """
    for part in crs.sub_crs_list:
        if part.is_vertical:
            return exact_unit(part.axis_info[0].unit_conversion_factor)
    whole = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    if len(whole.axis_info) > 2 and not whole.is_geocentric:
        return exact_unit(whole.axis_info[2].unit_conversion_factor)
    return None


def _height_unit(crs: pyproj.CRS | None, keys: dict[int, float]) -> float | None:
    stated = None if crs is None else height_unit_of(crs)
    if stated is not None:
        return stated
    unit = _unit(keys, HEIGHT_UNIT)
    if unit is not None:
        return unit
    vertical = _from_epsg(int(keys.get(VERTICAL_CRS, 0)))
    if vertical is None or not vertical.is_vertical:
        return None
    return exact_unit(vertical.axis_info[0].unit_conversion_factor)


def _keys(records: list[object]) -> dict[int, float]:
    """Values of the numeric GeoTIFF keys by their ids."""
    doubles = next(
        ([value.value for value in one.doubles] for one in records if isinstance(one, GeoDoubleParamsVlr)), []
    )
    values: dict[int, float] = {}
    for record in records:
        if isinstance(record, GeoKeyDirectoryVlr):
            for key in record.geo_keys or []:
                if key.tiff_tag_location == 0:
                    values[int(key.id)] = int(key.value_offset)
                elif key.tiff_tag_location == GeoDoubleParamsVlr.official_record_ids()[0]:
                    place = int(key.value_offset)
                    if place < len(doubles):
                        values[int(key.id)] = float(doubles[place])
    return values


def _unit(keys: dict[int, float], key: int, size: int | None = None) -> float | None:
    code = int(keys.get(key, 0))
    if code == USER_DEFINED and size is not None and keys.get(size, 0.0) > 0:
        return exact_unit(float(keys[size]))
    return METRES.get(code)


def _crs_of_keys(keys: dict[int, float]) -> tuple[pyproj.CRS | None, str]:
    key, code = PROJECTED_CRS, int(keys.get(PROJECTED_CRS, 0))
    if code == USER_DEFINED:
        return None, f"GeoTIFF key {PROJECTED_CRS} = {USER_DEFINED}, a user-defined projection"
    if not code and int(keys.get(MODEL_TYPE, 0)) in (0, GEOGRAPHIC_MODEL):
        key, code = GEODETIC_CRS, int(keys.get(GEODETIC_CRS, 0))
    if code in (0, USER_DEFINED):
        return None, ""
    crs = _from_epsg(code)
    return crs, "" if crs is not None else f"GeoTIFF key {key} = {code}, no CRS of the EPSG register"


def _parse_wkt(text: str) -> tuple[pyproj.CRS | None, str]:
    if not text:
        return None, ""
    try:
        return _one_crs(text), ""
    except _DAMAGE:
        return None, f"a WKT record that PROJ cannot parse: {text[:60]!r}"


def _from_epsg(code: int) -> pyproj.CRS | None:
    if not code:
        return None
    try:
        return _one_crs(f"EPSG:{code}")
    except _DAMAGE:
        return None


@lru_cache(maxsize=64)
def _one_crs(text: str) -> pyproj.CRS:
    """Give the one CRS of a text: a country's files state the same, and each takes some 30 kB."""
    return pyproj.CRS.from_user_input(text)
