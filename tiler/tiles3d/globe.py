"""The place of a run on the globe: longitude, latitude and height on WGS 84, and geocentric metres."""

import math
from collections.abc import Sequence

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj.crs import CompoundCRS

from pipeline.data.errors import ConfigError
from tiler.georeference.crs import horizontal_crs, parse_crs, short_crs
from tiler.georeference.operation import find_operation

Array = NDArray[np.float64]
MOST_GEOID = 120.0  # m; the geoid is between 107 m below the ellipsoid and 86 m above it
_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


class Globe:
    """The way from a CRS to the globe.

    Parameters
    ----------
    crs : str
        CRS of coordinates, as a run records it; its heights are those of the data.
    bounds : sequence of 4 floats
        West, south, east and north border of the region in it.
    geoid_height : float
        What is added to heights, so that they count from the ellipsoid (m).
    vertical_crs : str
        CRS of the heights instead, ``"EPSG:5709"``: PROJ then raises each by the geoid's height there.

    Raises
    ------
    ConfigError
        If the CRS has no place on Earth, the region crosses the date line, or the geoid is nowhere so high; if
        PROJ has not the grid of the heights, or both are given.
    """

    def __init__(
        self, crs: str, bounds: Sequence[float], *, geoid_height: float = 0.0, vertical_crs: str = ""
    ) -> None:
        if not abs(geoid_height) <= MOST_GEOID:
            raise ConfigError(
                f"--geoid-height {geoid_height:g} m: the geoid is within {MOST_GEOID:g} m of the ellipsoid"
            )
        name = short_crs(crs)
        own = horizontal_crs(parse_crs(crs))
        if own is None or own.geodetic_crs is None:
            raise ConfigError(f"CRS {name}: says nothing about the place on Earth; run again with --crs EPSG:NNNN")
        world = pyproj.CRS("EPSG:4326")
        try:
            self._forward = pyproj.Transformer.from_crs(own, world, always_xy=True)
            self._back = pyproj.Transformer.from_crs(world, own, always_xy=True)
        except pyproj.exceptions.ProjError as error:
            raise ConfigError(f"CRS {name}: PROJ has no way to WGS 84 ({error}); run again in another") from error
        self._geoid_height = geoid_height
        self._raise: pyproj.Transformer | None = None
        west, south, east, north = bounds
        x, y = np.meshgrid(np.linspace(west, east, 9), np.linspace(south, north, 9))
        lon, lat, _ = self.geographic(np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size)))).T
        if not np.isfinite(lon + lat).all():
            raise ConfigError(
                f"CRS {name}: the region {tuple(bounds)} has no place on Earth; check --crs of the run"
            )
        if lon.max() - lon.min() > 180:
            raise ConfigError(
                "the region crosses the date line, and a region of 3D Tiles may not; export its parts"
            )
        self.box = (float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max()))  # degrees
        self.operation = find_operation(own, world, self.box)
        if vertical_crs:
            if geoid_height:
                raise ConfigError("--geoid-height and --vertical-crs both raise the heights; leave one out")
            self._raise = _open_heights(own, vertical_crs, self.box, (west, south))
        self.heights = (
            f"heights from {vertical_crs} to the ellipsoid"
            if vertical_crs
            else f"heights raised by {geoid_height:g} m to the ellipsoid"
            if geoid_height
            else "heights are those of the run: --geoid-height or --vertical-crs puts them on the ellipsoid"
        )

    def geographic(self, xyz: Array) -> Array:
        """Give longitude and latitude (degrees) and height above the ellipsoid (m) of places (n, 3)."""
        lon, lat = self._forward.transform(xyz[:, 0], xyz[:, 1])
        if self._raise is None:
            return np.column_stack((lon, lat, xyz[:, 2] + self._geoid_height))
        _, _, height = self._raise.transform(xyz[:, 0], xyz[:, 1], xyz[:, 2])
        return np.column_stack((lon, lat, height))

    def plan(self, lon: Array, lat: Array) -> Array:
        """Give the coordinates (n, 2) in the CRS (m) of longitudes and latitudes (n,) (degrees)."""
        return np.column_stack(self._back.transform(lon, lat))


def _open_heights(
    plan: pyproj.CRS, name: str, box: tuple[float, float, float, float], place: tuple[float, float]
) -> pyproj.Transformer:
    """Open the way from heights to the ellipsoid; ConfigError if there is none but heights left as they are."""
    vertical = parse_crs(name)
    if not vertical.is_vertical:
        raise ConfigError(f"--vertical-crs {name}: is no CRS of heights; give for example EPSG:5709 (NAP)")
    whole, world = CompoundCRS(f"{plan.name} + {vertical.name}", [plan, vertical]), pyproj.CRS("EPSG:4979")
    try:
        found = pyproj.Transformer.from_crs(whole, world, always_xy=True, allow_ballpark=False)
        if math.isfinite(found.transform(place[0], place[1], 0.0)[2]):
            return found
    except pyproj.exceptions.ProjError:
        pass
    grids = ", ".join(find_operation(whole, world, box).missing_grids)
    what = (
        f"it needs the grid {grids} (package proj-data, or: pyproj sync --file {grids}), or give --geoid-height"
        if grids
        else "give --geoid-height"
    )
    raise ConfigError(f"--vertical-crs {name}: PROJ has no way from there to the ellipsoid; {what}")


def geocentric(places: Array) -> Array:
    """Give geocentric coordinates (EPSG:4978, m) of longitude, latitude (degrees) and height (m), (n, 3)."""
    return np.column_stack(_ECEF.transform(*places.T))


def geographic_of(places: Array) -> Array:
    """Give longitude, latitude (degrees) and height (m) of geocentric coordinates (n, 3)."""
    x, y, z = places.T
    return np.column_stack(_ECEF.transform(x, y, z, direction="INVERSE"))


def local_frame(lon: float, lat: float, height: float) -> Array:
    """Give the matrix (4, 4) from metres to the east, the north and up from a place to geocentric metres.

    Examples
    --------
    >>> local_frame(0.0, 0.0, 0.0).round(6).tolist()[:2]
    [[0.0, 0.0, 1.0, 6378137.0], [1.0, 0.0, 0.0, 0.0]]
    """
    a, b = math.radians(lon), math.radians(lat)
    east = (-math.sin(a), math.cos(a), 0.0)
    north = (-math.sin(b) * math.cos(a), -math.sin(b) * math.sin(a), math.cos(b))
    up = (math.cos(b) * math.cos(a), math.cos(b) * math.sin(a), math.sin(b))
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack((east, north, up))
    frame[:3, 3] = geocentric(np.array([[lon, lat, height]]))[0]
    return frame + 0.0


def into_frame(frame: Array, places: Array) -> Array:
    """Give geocentric places (n, 3) in a frame of `local_frame` (m).

    Products of BLAS have other last digits on other processors: sums are written out.
    """
    d = places - frame[:3, 3]
    turn = frame[:3, :3]
    return np.column_stack([d[:, 0] * turn[0, k] + d[:, 1] * turn[1, k] + d[:, 2] * turn[2, k] for k in range(3)])
