"""Names of coordinate reference systems in city models, and what they say of the order of axes."""

import re
from dataclasses import dataclass

import pyproj

from tiler.georeference.crs import crs_or_none

# National names that no register resolves: plan, and heights where the name has them.
PLAIN = {
    "CH1903": "EPSG:21781",
    "CH1903_LV03": "EPSG:21781",
    "CH1903+": "EPSG:2056",
    "CH1903+_LV95": "EPSG:2056",
    **{f"ETRS89_UTM{zone}": f"EPSG:258{zone}" for zone in range(28, 39)},
    **{f"DE_DHDN_3GK{zone}": f"EPSG:3146{zone + 4}" for zone in range(2, 6)},
    "RGF93_LAMBERT93": "EPSG:2154",
    "RD": "EPSG:28992",
}
HEIGHTS = {
    "DE_DHHN92_NH": "EPSG:5783",
    "DE_DHHN2016_NH": "EPSG:7837",
    "DE_DHHN12_NOH": "EPSG:7699",
    "LN02": "EPSG:5728",
    "NAP": "EPSG:5709",
}
_REGISTERED = re.compile(
    r"(?:urn:(?:x-)?ogc:def:crs:EPSG:|https?://www\.opengis\.net/def/crs/EPSG/)[^:/]*[:/](\d+)", re.I
)
_COMPOUND = re.compile(r"crs:EPSG:[^:,]*:(\d+)", re.I)
_SHORT = re.compile(r"EPSG:(\d+)(?:\+(\d+))?", re.I)
_OLD = re.compile(r"https?://www\.opengis\.net/gml/srs/epsg\.xml#(\d+)", re.I)
ADV = "urn:adv:crs:"


@dataclass(frozen=True)
class NamedCrs:
    """What the name of a CRS says."""

    crs: pyproj.CRS | None  # the CRS; None where the name is not understood
    # Whether the form of the name means the order of axes of the register: a URN or a URL of OGC.
    registered_axes: bool
    text: str


def read_crs_name(text: str) -> NamedCrs:
    """Find the CRS that a name of a city model, as in ``srsName`` or ``referenceSystem``, stands for.

    Examples
    --------
    >>> found = read_crs_name("urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH")
    >>> found.crs.name, found.registered_axes
    ('ETRS89 / UTM zone 32N + DHHN2016 height', False)
    >>> read_crs_name("http://www.opengis.net/def/crs/EPSG/0/6697").registered_axes
    True
    """
    name = text.strip()
    if "," in name and (codes := _COMPOUND.findall(name)):
        return NamedCrs(crs_or_none("EPSG:" + "+".join(codes[:2])), True, text)
    for form, registered in ((_REGISTERED, True), (_OLD, False)):
        if found := form.fullmatch(name):
            return NamedCrs(crs_or_none(f"EPSG:{found[1]}"), registered, text)
    if _SHORT.fullmatch(name):
        return NamedCrs(crs_or_none(name.upper()), False, text)
    plan, _, height = name.removeprefix(ADV).partition("*")
    key = re.sub(r"[\s/]+", "_", plan.strip()).upper()
    known = PLAIN.get(key)
    if known:
        above = HEIGHTS.get(height.strip().upper())
        return NamedCrs(crs_or_none(f"{known}+{above.removeprefix('EPSG:')}" if above else known), False, text)
    return NamedCrs(crs_or_none(name) if name else None, False, text)
