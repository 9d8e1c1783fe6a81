"""GeoTIFF: a raster with its place and CRS, written by Pillow."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tiler.wind.raster import Grid

# Tags and keys of OGC 19-008r4, GeoTIFF 1.1.
PIXEL_SCALE, TIE_POINT, GEO_KEYS, NO_DATA = 33550, 33922, 34735, 42113
MODEL_TYPE, RASTER_TYPE, PROJECTED_CRS = 1024, 1025, 3072
PROJECTED, PIXEL_IS_AREA, USER_DEFINED = 1, 1, 32767
DOUBLE, SHORT, ASCII = 12, 3, 2


def write_geotiff(path: Path, values: NDArray[Any], grid: Grid, *, crs: str, no_data: str) -> None:
    """Write a raster of one band.

    Parameters
    ----------
    path : Path
        The file.
    values : float32 or uint8, (rows, columns)
        From north to south.
    grid : Grid
        Where it lies.
    crs : str
        A CRS that has an EPSG number; of a compound one the horizontal part is written. Any other one is called
        user-defined, so a reader must be told it.
    no_data : str
        What stands where nothing is known, as `nan`.

    Raises
    ------
    ConfigError
        If Pillow is not installed.
    """
    from PIL import Image, TiffImagePlugin

    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, value in (
        (PIXEL_SCALE, DOUBLE, (grid.size, grid.size, 0.0)),
        (TIE_POINT, DOUBLE, (0.0, 0.0, 0.0, grid.west, grid.north, 0.0)),
        (GEO_KEYS, SHORT, _geo_keys(epsg_of(crs))),
        (NO_DATA, ASCII, no_data),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = value
    Image.fromarray(np.ascontiguousarray(values)).save(
        path, format="tiff", tiffinfo=tags, compression="tiff_adobe_deflate"
    )


def _geo_keys(epsg: int | None) -> tuple[int, ...]:
    keys = ((MODEL_TYPE, PROJECTED), (RASTER_TYPE, PIXEL_IS_AREA), (PROJECTED_CRS, epsg or USER_DEFINED))
    flat = [number for key, value in keys for number in (key, 0, 1, value)]
    return (1, 1, 1, len(keys), *flat)


def epsg_of(crs: str) -> int | None:
    """Return the EPSG number of the horizontal part of a CRS, None if it has none.

    Examples
    --------
    >>> epsg_of("EPSG:28992"), epsg_of("EPSG:7415"), epsg_of("LOCAL_CS[1]")
    (28992, 28992, None)
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        found = CRS.from_user_input(crs)
    except CRSError:
        return None
    if found.is_compound:
        found = found.sub_crs_list[0]
    number = found.to_epsg()
    return None if number is None else int(number)


def need_pillow() -> None:
    """Raise ConfigError if Pillow is not installed."""
    try:
        import PIL  # noqa: F401
    except ImportError as error:
        raise ConfigError("maps need Pillow: pip install citystitch[pictures]") from error
