"""Cameras of each kind of file: one that looks north shows a point where a calculation by hand says."""

import json
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyproj
import pytest

from pipeline.data.errors import CityError
from tiler.textures.camera_files import read_cameras
from tiler.textures.cameras import Array, Camera, distort, farthest_radius, undistort

# A camera at (100, 50, 20) from an origin; x is to the east, y down, z to the north. A point 10 m before it, 1 m
# to the east and 2 m above is seen at (0.1, -0.2), where 1 + k1 r² = 1 - 0.1 * 0.05.
ORIGIN = np.array([700_000.0, 5_900_000.0, 30.0])
PLACE = np.array([100.0, 50.0, 20.0])
OFF = np.array([1.0, 10.0, 2.0])
POINT = ORIGIN + PLACE + OFF
FOCAL, K1 = 800.0, -0.1
SEEN = np.array([500 + 800 * 0.1 * 0.995, 400 - 800 * 0.2 * 0.995])
TURN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
SHIFT = -TURN @ PLACE
HALF = 0.5**0.5
MODEL = [FOCAL, FOCAL, 500.0, 400.0, K1, 0.0, 0.0, 0.0]


def colmap_text(folder: Path) -> Path:
    values = " ".join(map(str, MODEL))
    (folder / "cameras.txt").write_text(f"# comment\n7 OPENCV 1000 800 {values}\n")
    shift = " ".join(map(str, SHIFT))
    lines = [f"1 {HALF} {HALF} 0 0 {shift} 7 a b.jpg", "1.5 2.5 -1", f"2 1 0 0 0 {shift} 7 c.jpg", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def colmap_binary(folder: Path) -> Path:
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ8d", 1, 7, 4, 1000, 800, *MODEL))
    head, points = struct.pack("<i7di", 1, HALF, HALF, 0, 0, *SHIFT, 7), struct.pack("<Qddq", 1, 1.5, 2.5, -1)
    other = struct.pack("<i7di", 2, 1, 0, 0, 0, *SHIFT, 7) + b"c.jpg\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + head + b"a b.jpg\0" + points + other)
    return folder


def bundler(folder: Path) -> Path:
    turn = np.diag([1, -1, -1]) @ TURN
    rows = [[FOCAL, K1, 0.0], *turn.tolist(), (-turn @ PLACE).tolist()]
    lost = [[0.0, 0.0, 0.0]] * 5
    text = "\n".join(" ".join(map(str, row)) for row in [*rows, *lost])
    (folder / "bundle.out").write_text(f"# Bundle file v0.3\n2 0\n{text}\n")
    (folder / "list.txt").write_text("a.jpg\nlost.jpg 0 800\n")
    return folder / "bundle.out"


def opensfm(folder: Path, **more: object) -> Path:
    camera = {
        "projection_type": "perspective",
        "width": 1000,
        "height": 800,
        "focal": FOCAL / 1000,
        "k1": K1,
        "k2": 0,
    }
    shot = {"camera": "one", "rotation": [np.pi / 2, 0, 0], "translation": SHIFT.tolist()}
    part = {"cameras": {"one": camera}, "shots": {"a.jpg": shot}, "points": {}} | more
    (folder / "opensfm").mkdir()
    (folder / "opensfm/reconstruction.json").write_text(json.dumps([part]))
    return folder


def see(camera: Camera, point: Array) -> Array:
    sized = camera.sized(1000, 800)
    local = sized.to_camera(point[np.newaxis])
    found: Array = distort(local[:, :2] / local[:, 2:], sized.distortion)[0] * sized.focal + sized.centre
    return found


@pytest.mark.parametrize("write", [colmap_text, colmap_binary, bundler, opensfm])
def test_a_point_is_seen_where_it_is_by_hand(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    told: Counter[str] = Counter()
    path = write(tmp_path)
    found = list(read_cameras(path, ORIGIN, None, 0.0, told))
    assert see(found[0], POINT) == pytest.approx(SEEN, abs=1e-6)
    assert len(found) + told.total() == (1 if write is opensfm else 2)
    assert found[0].name == ("a b.jpg" if "colmap" in write.__name__ else "a.jpg")
    with pytest.raises(CityError, match="--origin"):
        list(read_cameras(path, None, None, 0.0, told))


def test_a_reference_places_cameras_by_the_crs_with_its_convergence_and_scale(tmp_path: Path) -> None:
    lat, lon, height, geoid = 53.0, 11.5, 80.0, 40.0
    reference = {"latitude": lat, "longitude": lon, "altitude": height}
    crs = pyproj.CRS.from_epsg(25832)
    (camera,) = read_cameras(opensfm(tmp_path, reference_lla=reference), None, crs, geoid, Counter())
    to_globe = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={lat} +lon_0={lon} +h_0={height} "
        "+step +inv +proj=cart +ellps=WGS84"
    )
    east, north, up = (PLACE + OFF).tolist()
    place = to_globe.transform(east, north, up)
    xy = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(*place[:2])
    assert see(camera, np.array([*xy, place[2] - geoid])) == pytest.approx(SEEN, abs=0.01)
    assert abs(camera.turn[0, 1]) > 0.03  # convergence of 2 degrees


def test_distortion_is_taken_away_and_folds_back_beyond_a_radius() -> None:
    distortion = np.array([-0.2, 0.03, 0.001, 1e-3, -2e-3])
    plain = np.random.default_rng(1).uniform(-0.6, 0.6, (50, 2))
    assert undistort(distort(plain, distortion), distortion) == pytest.approx(plain, abs=1e-6)
    assert farthest_radius(np.array([-1 / 3, 0, 0, 0, 0])) == pytest.approx(1)
    assert farthest_radius(np.zeros(5)) == np.inf


@pytest.mark.parametrize(
    ("write", "file", "change", "told"),
    [
        (colmap_binary, "images.bin", lambda data: data[:-9], "images.bin: ends at byte"),
        (colmap_text, "cameras.txt", lambda data: data.replace(b"OPENCV", b"OPENCV_FISHEYE"), "txt:2: camera"),
        (colmap_text, "images.txt", lambda data: data.replace(b" 7 a", b" 8 a"), "txt:1: a b.jpg: names no"),
        (bundler, "list.txt", lambda data: data[:6], "1 images, and"),
        (bundler, "bundle.out", lambda data: data[:90], "has not the cameras"),
        (opensfm, "opensfm/reconstruction.json", lambda data: data.replace(b"perspective", b"fisheye"), "fisheye"),
        (opensfm, "opensfm/reconstruction.json", lambda data: data[1:-1], "cameras without poses"),
        (opensfm, "opensfm/reconstruction.json", lambda data: data[:-9], "missing or wrong"),
    ],
)  # fmt: skip
def test_bad_files_are_one_error(
    tmp_path: Path, write: Callable[[Path], Path], file: str, change: Callable[[bytes], bytes], told: str
) -> None:
    path = write(tmp_path)
    (tmp_path / file).write_bytes(change((tmp_path / file).read_bytes()))
    with pytest.raises(CityError, match=told):
        list(read_cameras(path, ORIGIN, None, 0.0, Counter()))
