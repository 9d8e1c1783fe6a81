"""GeoTIFF: a raster with its place and CRS, by rasterio."""

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from pyproj.exceptions import CRSError
from rasterio.transform import Affine

from pipeline.data.errors import ConfigError
from tiler.georeference.crs import horizontal_crs
from tiler.wind.raster import Grid


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
        A CRS that has an EPSG number; of a compound one the horizontal part is written. Of any other one nothing
        is, so a reader must be told it.
    no_data : str
        What stands where nothing is known, as `nan`.
    """
    (rows, columns), number = values.shape, epsg_of(crs)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=columns,
        height=rows,
        count=1,
        dtype=values.dtype,
        crs=None if number is None else rasterio.CRS.from_epsg(number),
        transform=Affine(grid.size, 0.0, grid.west, 0.0, -grid.size, grid.north),
        nodata=float(no_data),
        compress="deflate",
    ) as raster:
        raster.write(np.ascontiguousarray(values), 1)


def epsg_of(crs: str) -> int | None:
    """Return the EPSG number of the horizontal part of a CRS, None if it has none.

    Examples
    --------
    >>> epsg_of("EPSG:28992"), epsg_of("EPSG:7415"), epsg_of("LOCAL_CS[1]")
    (28992, 28992, None)
    """
    try:
        found = horizontal_crs(pyproj.CRS.from_user_input(crs))
    except CRSError:
        return None
    number = None if found is None else found.to_epsg()
    return None if number is None else int(number)


def need_pillow() -> None:
    """Raise ConfigError if Pillow is not installed."""
    try:
        import PIL  # noqa: F401
    except ImportError as error:
        raise ConfigError("maps need Pillow: pip install citystitch[pictures]") from error
