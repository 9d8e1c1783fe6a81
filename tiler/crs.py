"""Which coordinate reference system the region has, and why it may be refused (steps 1.1 and 1.2)."""

import math
from collections.abc import Sequence
from functools import lru_cache

import pyproj

from pipeline.errors import ConfigError, InputError
from tiler.clouds import CloudHeader

_ALIKE = 20  # confidence (%) above which PROJ names a candidate, which is then compared in full
_PLACE_SLACK = 1.0  # degrees that a cloud may lie outside the area that a CRS is meant for


def parse_crs(text: str) -> pyproj.CRS:
    """Parse the CRS that a user asked for.

    Parameters
    ----------
    text : str
        What pyproj understands: ``"EPSG:28992"``, WKT, PROJJSON, a PROJ string.

    Returns
    -------
    pyproj.CRS
        As asked, compound CRSs included.

    Raises
    ------
    ConfigError
        If it cannot be parsed.
    """
    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as error:
        raise ConfigError(f"--crs {text!r} is no CRS that PROJ knows; give for example EPSG:28992") from error


def horizontal_crs(crs: pyproj.CRS | None) -> pyproj.CRS | None:
    """Give the two-dimensional horizontal part of a CRS.

    Parameters
    ----------
    crs : pyproj.CRS or None
        Any CRS: compound (horizontal and height), bound (with a datum shift), three-dimensional.

    Returns
    -------
    pyproj.CRS or None
        The entry of the EPSG register where it is one. None for None, and for an engineering CRS such as
        the "undefined" one of GeoPackage, which says nothing about the place on Earth.

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


def resolve_crs(
    asked: str | None, clouds: Sequence[CloudHeader], footprints: pyproj.CRS | None
) -> tuple[pyproj.CRS, list[str]]:
    """Decide the region's CRS: what was asked for, else the clouds', else the footprints'.

    Parameters
    ----------
    asked : str or None
        Value of ``--crs``.
    clouds : sequence of CloudHeader
        Headers of all point clouds; those without points have no say.
    footprints : pyproj.CRS or None
        CRS that the footprint file states.

    Returns
    -------
    pyproj.CRS
        Projected, horizontal, in metres.
    list of str
        Sentences that the user must be told: what was assumed.

    Raises
    ------
    ConfigError
        If `asked` cannot be parsed.
    InputError
        If clouds contradict each other or `asked`, if nobody states a CRS, or if the CRS or its heights do
        not count in metres: with the command that mends it.

    Notes
    -----
    Footprints in another CRS than the clouds' are fine: they are reprojected as they are read.
    """
    filled = [cloud for cloud in clouds if cloud.n_points > 0]
    # Headers share the CRS of a text: PROJ takes milliseconds to compare two, a country has 100,000 files.
    some = {id(cloud.crs): cloud.crs for cloud in filled}
    flat = {key: horizontal_crs(crs) for key, crs in some.items()}
    stated = [(cloud, crs) for cloud in filled if (crs := flat[id(cloud.crs)]) is not None]
    one_each = list({id(crs): (cloud, crs) for cloud, crs in reversed(stated)}.values())[::-1]
    full = None if asked is None else parse_crs(asked)
    wish = horizontal_crs(full)
    for cloud, crs in one_each:
        _check_metric_cloud(cloud, crs, wish)
    _check_agreement(one_each, wish)
    if full is not None:
        if wish is None:
            raise ConfigError(f"--crs {asked!r} has no place on Earth; give a projected CRS in metres")
        _check_metric(full, filled, "--crs")
        crs, source = wish, "--crs"
    elif stated:
        crs, source = stated[0][1], stated[0][0].path.name
    elif (crs_of_footprints := horizontal_crs(footprints)) is not None:
        crs, source = crs_of_footprints, "the footprints"
        _check_metric(crs, filled, source)
    else:
        raise InputError("neither point clouds nor footprints state a CRS; give --crs, as in --crs EPSG:28992")
    return crs, _sentences(crs, source, filled, len(stated), footprints)


def utm_crs(bounds: Sequence[float], crs: pyproj.CRS) -> str | None:
    """Name the UTM zone (WGS 84) in which the middle of a box lies.

    Parameters
    ----------
    bounds : sequence of at least 4 floats
        xmin, ymin, xmax, ymax in `crs`, x before y.
    crs : pyproj.CRS
        CRS of the bounds.

    Returns
    -------
    str or None
        None if the box is not on Earth.

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


def _east_first(crs: pyproj.CRS) -> pyproj.CRS:
    """Write a projected CRS with its easting first: PROJ compares regardless of axis order only degrees."""
    if not crs.is_projected or [axis.direction for axis in crs.axis_info] != ["north", "east"]:
        return crs
    fields = crs.to_json_dict()
    fields["coordinate_system"]["axis"].reverse()
    fields.pop("id", None)
    return pyproj.CRS.from_json_dict(fields)


def _fault(crs: pyproj.CRS) -> str:
    """Say in words why a CRS is no metric one; "" if it is. Heights count too."""
    for part in crs.sub_crs_list or [crs]:
        core = part.source_crs if part.is_bound and part.source_crs is not None else part
        if core.is_geographic:
            return "is geographic (degrees)"
        if not (core.is_projected or core.is_vertical):
            return f"is no projected CRS ({core.type_name})"
        for axis in core.axis_info:
            if axis.unit_conversion_factor != 1.0:
                return f"counts {axis.name.lower()} in {axis.unit_name}, not in metres"
    return ""


def _check_metric_cloud(cloud: CloudHeader, crs: pyproj.CRS, wish: pyproj.CRS | None) -> None:
    """Refuse a cloud whose own CRS is not metric, with the command that reprojects it."""
    if cloud.crs is None or not (fault := _fault(cloud.crs)):
        return
    target = crs_name(wish) if wish is not None and not _fault(wish) else utm_crs(cloud.bounds, crs)
    raise InputError(
        f"{cloud.path}: its CRS, {crs_name(cloud.crs)}, {fault}; reproject this and every cloud like it: "
        f"{_pdal(cloud, cloud.crs, target)}"
    )


def _check_metric(crs: pyproj.CRS, clouds: Sequence[CloudHeader], source: str) -> None:
    """Refuse a CRS that is not metric, from ``--crs`` or the footprints, where the clouds state none."""
    flat = horizontal_crs(crs)
    if flat is None or not (fault := _fault(crs)):
        return
    name = crs_name(crs)
    words = [f"{source}: the CRS {name} {fault}"]
    if source == "--crs":
        words.append("give the projected CRS of the clouds")
    else:
        words.append(
            "the point clouds state none: if theirs is another, give it with --crs, or reproject the "
            "footprints to it: ogr2ogr -t_srs EPSG:<code of the clouds> metric.gpkg <footprints>"
        )
    target = utm_crs(clouds[0].bounds, flat) if clouds else None
    if target is not None:
        words.append(f"clouds in {name} must be reprojected: {_pdal(clouds[0], crs, target)}")
    raise InputError("; ".join(words))


def _pdal(cloud: CloudHeader, crs: pyproj.CRS, target: str | None) -> str:
    """Give the command that makes a cloud metric.

    Both CRSs are named without heights, so that PDAL leaves z alone; heights are scaled on their own.
    """
    flat, factor = horizontal_crs(crs), _height_factor(crs)
    filters, options = [], []
    if flat is not None and not _fault(flat):
        target = crs_name(flat)
    else:
        target = target or "EPSG:<a projected CRS in metres>"
        filters.append("reprojection")
        if flat is not None and flat.to_authority():
            options.append(f"--filters.reprojection.in_srs={crs_name(flat)}")
        options.append(f"--filters.reprojection.out_srs={target}")
    if factor != 1.0:
        filters.append("assign")
        options.append(f'--filters.assign.value="Z = Z * {factor!r}"')
    options.append(f"--writers.las.a_srs={target}")
    return f"pdal translate {_paths(cloud, 'metric')} {' '.join(filters + options)}"


def _height_factor(crs: pyproj.CRS) -> float:
    """Give the metres of one unit of height."""
    for part in crs.sub_crs_list:
        if part.is_vertical:
            return float(part.axis_info[0].unit_conversion_factor)
    return float(crs.axis_info[2].unit_conversion_factor) if len(crs.axis_info) > 2 else 1.0


def _check_agreement(stated: Sequence[tuple[CloudHeader, pyproj.CRS]], wish: pyproj.CRS | None) -> None:
    for cloud, crs in stated:
        if wish is not None and not same_crs(crs, wish):
            raise InputError(
                f"{cloud.path}: states {crs_name(crs)}, but --crs asks for {crs_name(wish)}; leave out "
                f"--crs, or reproject the cloud: {_reproject(cloud, crs_name(wish))}"
            )
        first, common = stated[0]
        if not same_crs(crs, common):
            raise InputError(
                f"{cloud.path}: states {crs_name(crs)}, but {first.path} states {crs_name(common)}; leave "
                f"one out, or reproject it: {_reproject(cloud, crs_name(common))}"
            )


def _reproject(cloud: CloudHeader, target: str) -> str:
    return f"pdal translate {_paths(cloud, 'reprojected')} reprojection --filters.reprojection.out_srs={target}"


def _paths(cloud: CloudHeader, suffix: str) -> str:
    name = cloud.path.name.split(".")[0]
    return f'"{cloud.path}" "{cloud.path.with_name(f"{name}_{suffix}.laz")}"'


def _sentences(
    crs: pyproj.CRS, source: str, filled: Sequence[CloudHeader], n_stated: int, footprints: pyproj.CRS | None
) -> list[str]:
    words = []
    if filled and n_stated == 0:
        words.append(f"the point cloud states no CRS; using {crs_name(crs)} of {source}")
    elif n_stated < len(filled):
        silent = f"{len(filled) - n_stated} of {len(filled)}"
        words.append(f"{silent} point clouds state no CRS; taken as {crs_name(crs)} of {source}")
    ours = horizontal_crs(footprints)
    if ours is not None and not same_crs(ours, crs):
        words.append(f"the footprints are reprojected from {crs_name(ours)} to {crs_name(crs)}")
    stray = [cloud for cloud in filled if not _on_its_place(cloud.bounds, crs)]
    if stray:
        more = f" and {len(stray) - 1} more point clouds lie" if len(stray) > 1 else " lies"
        words.append(
            f"{stray[0].path.name}{more} outside the area of use of "
            f"{crs_name(crs)} ({crs.area_of_use.name if crs.area_of_use else ''}); is it the right CRS?"
        )
    return words


def _on_its_place(bounds: Sequence[float], crs: pyproj.CRS) -> bool:
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
    lon, lat = _to_degrees(crs).transform((xmin + xmax) / 2, (ymin + ymax) / 2)
    on_earth = math.isfinite(lon) and math.isfinite(lat) and abs(lon) <= 180 and abs(lat) <= 90
    return (lon, lat) if on_earth else None


@lru_cache(maxsize=8)
def _to_degrees(crs: pyproj.CRS) -> pyproj.Transformer:
    """Make the transformer to longitude and latitude, once for all clouds: that takes PROJ a tenth of a second."""
    return pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
