"""Cameras of OpenSfM and OpenDroneMap: ``reconstruction.json``.

Image coordinates of OpenSfM count from the middle of the image in units of its longer side. Its world is that of
the plane that touches the ellipsoid at the reference (x east, y north, z up), or any other less an origin.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from pipeline.data.errors import ConfigError, InputError
from tiler.store.run_folder import WRONG_FIELD
from tiler.textures.cameras import Array, Camera, turn_of_axis
from tiler.tiles3d.globe import local_frame

KNOWN = ("perspective", "simple_radial", "radial", "brown")
REFERENCE = ("latitude", "longitude", "altitude")
STEP = 10.0  # m, of the differences that give the axes of the CRS at a place


def read_opensfm(path: Path, origin: Array | None, crs: pyproj.CRS | None, lift: float) -> Iterator[Camera]:
    """Read cameras.

    Parameters
    ----------
    origin : float64 (3,), optional
        What its coordinates count from in the CRS (m); without it the reference of the file places them.
    crs : pyproj.CRS, optional
        That of the city.
    lift : float
        Height of the geoid above the ellipsoid (m): heights of the city are those of the reference less it.

    Raises
    ------
    InputError
        If the file is damaged, has no poses, or a camera is not supported.
    ConfigError
        If there is neither an origin nor a reference.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(document, dict):
            raise InputError(f"{path}: has cameras without poses; give opensfm/reconstruction.json of the project")
        for part in document:
            site = None if origin is not None else _Tangent(path, part.get("reference_lla"), crs, lift)
            for name, shot in part["shots"].items():
                lens = _lens(path, shot["camera"], part["cameras"][shot["camera"]])
                turn = turn_of_axis(np.array(shot["rotation"], np.float64))
                place = -turn.T @ np.array(shot["translation"], np.float64)
                if site is not None:
                    yield Camera(name, *lens, *site.pose(turn, place))
                elif origin is not None:
                    yield Camera(name, *lens, turn, origin + place)
    except (OSError, UnicodeDecodeError, *WRONG_FIELD) as error:
        raise InputError(f"{path}: a field is missing or wrong ({error!r}); export it again") from None


def _lens(path: Path, name: str, camera: Mapping[str, Any]) -> tuple[int, int, Array, Array, Array]:
    kind = camera["projection_type"]
    if kind not in KNOWN:
        raise InputError(f"{path}: camera {name!r}: projection {kind} is not supported; known: {', '.join(KNOWN)}")
    width, height = int(camera["width"]), int(camera["height"])
    side = max(width, height)
    one = camera.get("focal", 0.0)
    focal = np.array([camera.get("focal_x", one), camera.get("focal_y", one)], np.float64) * side
    if not (focal > 0).all():
        raise InputError(f"{path}: camera {name!r}: focal length {focal.tolist()} pixels; bound: above 0")
    centre = np.array([camera.get("c_x", 0.0), camera.get("c_y", 0.0)]) * side + [width / 2, height / 2]
    return width, height, focal, centre, np.array([camera.get(k, 0.0) for k in ("k1", "k2", "k3", "p1", "p2")])


class _Tangent:
    """The plane that touches the ellipsoid at a reference, and its way into the CRS."""

    def __init__(self, path: Path, reference: Any, crs: pyproj.CRS | None, lift: float) -> None:
        if not reference or crs is None:
            what = "the city has no CRS" if reference else "it has no reference_lla"
            raise ConfigError(f"{path}: {what}, so its place is unknown; give --origin X,Y,Z")
        lat, lon, height = (float(reference[key]) for key in REFERENCE)
        self._lift = lift
        geocentric = pyproj.CRS.from_epsg(4978)
        self._to_crs = pyproj.Transformer.from_crs(geocentric, crs.to_2d(), always_xy=True)
        self._to_height = pyproj.Transformer.from_crs(geocentric, pyproj.CRS.from_epsg(4979), always_xy=True)
        self._frame = local_frame(lon, lat, height)

    def place(self, local: Array) -> Array:
        """Give places (n, 3) of the plane's axes in the CRS (m)."""
        xyz = local @ self._frame[:3, :3].T + self._frame[:3, 3]
        x, y, z = xyz.T
        easting, northing, _ = self._to_crs.transform(x, y, z)
        _, _, height = self._to_height.transform(x, y, z)
        return np.column_stack((easting, northing, np.asarray(height) - self._lift))

    def pose(self, turn: Array, place: Array) -> tuple[Array, Array]:
        """Give rotation and place in the CRS: meridian convergence and scale of the map are in the first."""
        around = np.concatenate((np.zeros((1, 3)), STEP * np.eye(3), -STEP * np.eye(3))) + place
        found = self.place(around)
        axes = (found[1:4] - found[4:7]).T / (2 * STEP)
        return turn @ np.linalg.inv(axes), found[0]
