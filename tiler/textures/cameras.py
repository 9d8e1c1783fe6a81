"""Cameras: images with a pose in the CRS of the city, and how places become pixels.

A pixel (i, j) covers x from i to i + 1 and y, downwards, from j to j + 1. Distortion is that of Brown: radial
k1, k2, k3 and tangential p1, p2, as OpenCV has them.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ROUNDS = 30  # of the fixed-point iteration that takes distortion away
BORDER = 33  # points a side of an image whose directions bound its view


@dataclass(frozen=True, eq=False)
class Camera:
    """An image and its pose."""

    name: str  # of the image file, within the folder of images
    # Pixels; 0 where the file of cameras does not state them, which is until the image is opened.
    width: int
    height: int
    focal: Array  # (2,): focal lengths in x and y (pixels)
    centre: Array  # (2,): principal point (pixels); from the middle of the image where the size is not stated
    distortion: Array  # (5,): k1, k2, k3, p1, p2
    turn: Array  # (3, 3): from the axes of the CRS to those of the camera: x right, y down, z ahead
    place: Array  # (3,): its centre in the CRS (m)

    @property
    def inverse(self) -> Array:
        """The way back from its axes to those of the CRS (3, 3)."""
        found: Array = np.linalg.inv(self.turn).astype(np.float64)
        return found

    def to_camera(self, xyz: Array) -> Array:
        """Give places (n, 3) of the CRS in the axes of the camera (m)."""
        return rotate(self.turn, xyz - self.place)

    def sized(self, width: int, height: int) -> "Camera":
        """Give the camera with the size of its image, where the file of cameras has none."""
        if self.width:
            return self
        return replace(self, width=width, height=height, centre=self.centre + np.array([width, height]) / 2)

    def view(self) -> Array:
        """Give the box of the image without distortion (pixels): least x and y, then greatest x and y.

        All of what the image shows is within it, where the distortion can be taken away.
        """
        x, y = np.linspace(0, self.width, BORDER), np.linspace(0, self.height, BORDER)
        sides = [(x, 0 * x), (x, 0 * x + self.height), (0 * y, y), (0 * y + self.width, y)]
        pixels = np.concatenate([np.column_stack(side) for side in sides])
        plain = undistort((pixels - self.centre) / self.focal, self.distortion) * self.focal + self.centre
        return np.concatenate((plain.min(axis=0), plain.max(axis=0)))


def rotate(turn: Array, xyz: Array) -> Array:
    """Multiply vectors (n, 3) by a matrix; products of BLAS have other last digits on other processors."""
    x, y, z = xyz.T
    return np.column_stack([row[0] * x + row[1] * y + row[2] * z for row in turn])


def distort(xy: Array, distortion: Array) -> Array:
    """Give where directions (n, 2) of a camera without distortion are seen."""
    k1, k2, k3, p1, p2 = distortion
    x, y = xy.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.column_stack(
        (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    )


def undistort(seen: Array, distortion: Array) -> Array:
    """Give the directions (n, 2) that are seen at places of the image plane, by fixed-point iteration."""
    plain = seen
    if distortion.any():
        for _ in range(ROUNDS):
            plain = plain + (seen - distort(plain, distortion))
    return plain


def farthest_radius(distortion: Array) -> float:
    """Give the radius of directions from which on radial distortion would fold an image back."""
    k1, k2, k3 = distortion[:3].tolist()
    # Where r (1 + k1 r² + k2 r⁴ + k3 r⁶) grows no more, in r².
    slopes = np.asarray(np.roots([7 * k3, 5 * k2, 3 * k1, 1.0]), np.complex128)
    found = [float(root.real) for root in slopes if abs(root.imag) < 1e-12 and root.real > 0]
    return math.sqrt(min(found, default=math.inf))


def turn_of_quaternion(w: float, x: float, y: float, z: float) -> Array:
    """Give the rotation (3, 3) of a quaternion, which need not be of length 1; ValueError if it is 0."""
    length = (w * w + x * x + y * y + z * z) ** 0.5
    if not length > 0:
        raise ValueError("quaternion 0")
    w, x, y, z = w / length, x / length, y / length, z / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turn_of_axis(axis: Array) -> Array:
    """Give the rotation (3, 3) about an axis (3,) by its length (radians)."""
    angle = float(np.linalg.norm(axis))
    half = np.sin(angle / 2) / angle if angle else 0.5
    x, y, z = (axis * half).tolist()
    return turn_of_quaternion(float(np.cos(angle / 2)), x, y, z)
