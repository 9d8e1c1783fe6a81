"""What a camera sees: triangles drawn into a buffer of distances, and points of surfaces held against it.

Both are as of a camera without distortion; where a point is in the image is distorted afterwards.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel

Array = NDArray[np.float64]
Depth = NDArray[np.float32]
NEAR = 0.5  # m before the camera: nothing nearer is drawn
NOT_SEEN, OUTSIDE, HIDDEN, PLANT, SEEN = range(
    5
)  # of a point: not turned to the camera, not in the image, and so on


@kernel
def draw_triangles(depth: Depth, corners: Array, focal: Array, centre: Array) -> None:
    """Draw triangles into a buffer of distances along the axis of a camera, the nearest of each pixel.

    Parameters
    ----------
    depth : float32 (h, w), changed
        Distances (m) at the middles of pixels; infinite where nothing is.
    corners : float64 (t, 3, 3)
        Corners in the axes of the camera (m).
    focal, centre : float64 (2,)
        Of the camera, the second from the corner of the buffer (pixels).
    """
    height, width = depth.shape
    polygon = np.empty((4, 3))
    flat = np.empty((4, 3))
    for t in range(len(corners)):
        n = 0
        for k in range(3):
            here, after = corners[t, k], corners[t, (k + 1) % 3]
            if here[2] >= NEAR:
                polygon[n] = here
                n += 1
            if (here[2] >= NEAR) != (after[2] >= NEAR):
                share = (NEAR - here[2]) / (after[2] - here[2])
                for axis in range(3):
                    polygon[n, axis] = here[axis] + share * (after[axis] - here[axis])
                polygon[n, 2] = NEAR
                n += 1
        for k in range(n):
            flat[k, 0] = polygon[k, 0] / polygon[k, 2] * focal[0] + centre[0]
            flat[k, 1] = polygon[k, 1] / polygon[k, 2] * focal[1] + centre[1]
            flat[k, 2] = 1.0 / polygon[k, 2]
        for k in range(1, n - 1):
            x0, y0, x1, y1, x2, y2 = flat[0, 0], flat[0, 1], flat[k, 0], flat[k, 1], flat[k + 1, 0], flat[k + 1, 1]
            area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
            if area == 0.0:
                continue
            left, right = max(min(x0, x1, x2), 0.0), min(max(x0, x1, x2), float(width))
            top, bottom = max(min(y0, y1, y2), 0.0), min(max(y0, y1, y2), float(height))
            if left > right or top > bottom:
                continue
            for j in range(int(np.ceil(top - 0.5)), min(int(np.floor(bottom - 0.5)), height - 1) + 1):
                y = j + 0.5
                for i in range(int(np.ceil(left - 0.5)), min(int(np.floor(right - 0.5)), width - 1) + 1):
                    x = i + 0.5
                    b = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / area
                    c = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / area
                    if b >= 0.0 and c >= 0.0 and b + c <= 1.0:
                        z = 1.0 / (flat[0, 2] + b * (flat[k, 2] - flat[0, 2]) + c * (flat[k + 1, 2] - flat[0, 2]))
                        depth[j, i] = min(z, depth[j, i])


@kernel
def view_points(
    points: Array,
    normal: Array,
    lens: Array,
    depth: Depth,
    corner: Array,
    plants: NDArray[np.uint8],
    cell: float,
) -> tuple[NDArray[np.uint8], Array]:
    """Tell of points of a plane whether a camera sees them, and where in its image.

    Parameters
    ----------
    points : float64 (n, 3)
        In the axes of the camera (m).
    normal : float64 (3,)
        Of the plane, in the same axes.
    lens : float64 (12,)
        Of the camera: width and height (pixels), focal lengths, principal point, distortion, and the radius of
        directions from which on that folds the image back.
    depth : float32 (h, w)
        As of `draw_triangles`.
    corner : float64 (2,)
        Where the buffer begins in the image without distortion (pixels).
    plants : uint8 (a, b)
        Cells of the image that show plants; empty where that is not known.
    cell : float
        Side of a cell (pixels).

    Returns
    -------
    uint8 (n,)
        `OUTSIDE`, `HIDDEN`, `PLANT` or `SEEN`.
    float64 (n, 2)
        Place in the image (pixels).
    """
    size, focal, centre, distortion, limit = lens[:2], lens[2:4], lens[4:6], lens[6:11], lens[11]
    state = np.empty(len(points), np.uint8)
    place = np.empty((len(points), 2))
    height, width = depth.shape
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        state[k] = OUTSIDE
        if z < NEAR:
            continue
        u, v = x / z, y / z
        r2 = u * u + v * v
        if r2 >= limit * limit:
            continue
        radial = 1 + r2 * (distortion[0] + r2 * (distortion[1] + r2 * distortion[2]))
        p1, p2 = distortion[3], distortion[4]
        i = (u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)) * focal[0] + centre[0]
        j = (v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v) * focal[1] + centre[1]
        place[k, 0], place[k, 1] = i, j
        if not (0.0 <= i < size[0] and 0.0 <= j < size[1]):
            continue
        state[k] = SEEN
        a = int(np.floor(u * focal[0] + centre[0] - corner[0]))
        b = int(np.floor(v * focal[1] + centre[1] - corner[1]))
        if 0 <= a < width and 0 <= b < height:
            # Where the ray through the middle of the pixel meets the plane.
            s = (a + 0.5 + corner[0] - centre[0]) / focal[0]
            t = (b + 0.5 + corner[1] - centre[1]) / focal[1]
            towards = normal[0] * s + normal[1] * t + normal[2]
            meets = z
            if towards != 0.0:
                meets = (normal[0] * x + normal[1] * y + normal[2] * z) / towards
            if not 0.5 * z < meets < 2.0 * z:
                meets = z
            slack = 0.02 + 0.5 * z / focal[0]
            if depth[b, a] < min(meets, z + 4 * slack) - slack:
                state[k] = HIDDEN
                continue
        if plants.shape[0] > 0 and plants[int(j / cell), int(i / cell)]:
            state[k] = PLANT
    return state, place


@kernel
def cover_texels(inside: NDArray[np.uint8], corners: Array) -> None:
    """Mark the texels (h, w) whose middles are in triangles (t, 3, 2), in texels from the upper left corner."""
    height, width = inside.shape
    for t in range(len(corners)):
        x0, y0 = corners[t, 0]
        x1, y1 = corners[t, 1]
        x2, y2 = corners[t, 2]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0:
            continue
        for j in range(max(int(min(y0, y1, y2)), 0), min(int(max(y0, y1, y2)) + 1, height)):
            for i in range(max(int(min(x0, x1, x2)), 0), min(int(max(x0, x1, x2)) + 1, width)):
                x, y = i + 0.5, j + 0.5
                b = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / area
                c = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / area
                if b >= -1e-9 and c >= -1e-9 and b + c <= 1.0 + 1e-9:
                    inside[j, i] = 1


@kernel
def sample_pixels(pixels: NDArray[np.uint8], place: Array, found: Array) -> None:
    """Interpolate pixels (h, w, 3) at places (n, 2), in pixels from the corner, into float64 (n, 3)."""
    height, width = pixels.shape[:2]
    for k in range(len(place)):
        x = min(max(place[k, 0] - 0.5, 0.0), width - 1.0)
        y = min(max(place[k, 1] - 0.5, 0.0), height - 1.0)
        i, j = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        a, b = min(i + 1, width - 1), min(j + 1, height - 1)
        s, t = x - i, y - j
        for c in range(3):
            found[k, c] = (1 - t) * ((1 - s) * pixels[j, i, c] + s * pixels[j, a, c]) + t * (
                (1 - s) * pixels[b, i, c] + s * pixels[b, a, c]
            )
