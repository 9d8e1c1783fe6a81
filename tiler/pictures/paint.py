"""Painting without OpenGL: polygons on a raster, and facets with depth, shadow and light from the sky.

Pictures are the same bytes every time, on every machine that has the same numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.inside import list_edges
from pipeline.kernel import kernel

Floats = NDArray[np.float64]
Colours = NDArray[np.uint8]

SAMPLES = 2  # pixels painted along each pixel shown
SUN = np.array([0.24, -0.72, 0.65]) / np.linalg.norm([0.24, -0.72, 0.65])  # where it stands: south by south-east
SUN_LIGHT, SKY_LIGHT, FLOOR_LIGHT = 0.46, 0.40, 0.22  # of level open ground; they add up to a little over 1
SUN_SIDE, SKY_SIDE = 1536, 640  # pixels of the maps of what the sun and each light of the sky see
SKY_DIRECTIONS = 8  # lights that stand for the sky
LINE = np.array([60.0, 53.0, 48.0])
NOTHING = -1
NEAREST = 0.02  # distances to the middle of the picture; what is closer to the camera is not drawn


@dataclass(frozen=True, eq=False)
class Scene:
    """Facets to paint.

    Attributes
    ----------
    corners : float64, (k, 3, 3)
        Corners (m) from a middle near them.
    rgb : uint8, (k, 3)
        Colour of each facet.
    lined : bool, (k,)
        Whether its edges are drawn, where they are long enough on the picture.
    """

    corners: Floats
    rgb: Colours
    lined: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class View:
    """A camera.

    Attributes
    ----------
    position, focal : float64, (3,)
        The camera and the place in the middle of the picture (m); up is up.
    view_angle : float
        Vertical opening angle (degrees).
    size : (int, int)
        Width and height (pixels).
    """

    position: Floats
    focal: Floats
    view_angle: float
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Lighting:
    """What the sun and some lights of the sky see.

    Attributes
    ----------
    lights : float64, (l, 3)
        Directions in which they stand, the sun first.
    frames : float64, (l, 4, 3)
        Axes that lead from a place (m) to column, row and height in the light's map, and last its origin.
    sides : int64, (l,)
        Pixels along the side of each map.
    maps : float32, (l, n, n)
        Height along the light of what it sees first, 0 where there is nothing.
    """

    lights: Floats
    frames: Floats
    sides: NDArray[np.int64]
    maps: NDArray[np.float32]


def join_scenes(scenes: Sequence[Scene]) -> Scene:
    """Put scenes together, at least one."""
    return Scene(
        np.concatenate([scene.corners for scene in scenes]),
        np.concatenate([scene.rgb for scene in scenes]),
        np.concatenate([scene.lined for scene in scenes]),
    )


def fill_polygons(image: NDArray[np.uint8], polygons: NDArray[np.object_], low: Floats, step: float) -> None:
    """Mark the pixels of a raster whose centres lie inside polygons.

    Parameters
    ----------
    image : uint8, (rows, columns)
        The raster, row 0 in the south; 1 is written.
    polygons : object, (n,)
        shapely Polygons or MultiPolygons (m).
    low : float64, (2,)
        Corner of the raster in the south-west (m).
    step : float
        Side of a pixel (m).

    Examples
    --------
    >>> import shapely
    >>> image = np.zeros((3, 4), np.uint8)
    >>> fill_polygons(image, np.array([shapely.box(1, 0, 3, 2)]), np.zeros(2), 1.0)
    >>> image.tolist()
    [[0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
    """
    if not len(polygons):
        return
    edges = list_edges(polygons)
    _fill(image, edges.start, (edges.a - low) / step - 0.5, (edges.b - low) / step - 0.5)


def cast_lights(scene: Scene) -> Lighting:
    """Find what the lights see of a scene, which is what throws shadows."""
    lights = _list_lights()
    maps = np.zeros((len(lights), SUN_SIDE, SUN_SIDE), np.float32)
    sides = np.array([SUN_SIDE, *[SKY_SIDE] * SKY_DIRECTIONS])
    frames = [_cast(scene.corners, *each) for each in zip(lights, sides.tolist(), maps, strict=True)]
    return Lighting(lights, np.array(frames), sides, maps)


def paint(
    scene: Scene, view: View, *, sky: tuple[str, str], lighting: Lighting | None = None, edge_pixels: float = 5.0
) -> Colours:
    """Paint facets with sun, shadow and sky.

    Parameters
    ----------
    scene : Scene
        What to paint; facets are seen from both sides.
    view : View
        The camera; facets that reach behind it are left out.
    sky : (str, str)
        Colours at the bottom and at the top, ``"#rrggbb"``.
    lighting : Lighting, optional
        From `cast_lights`; of the scene itself by default.
    edge_pixels : float
        Edges of facets are drawn, the fainter the shorter, where a facet's mean edge has more pixels than this.

    Returns
    -------
    uint8, (height, width, 3)
        The picture.

    Notes
    -----
    Some 0.5 s for 200,000 facets on 1.4 million pixels. Beside the facets memory has 40 bytes a pixel painted.
    """
    width, height = (side * SAMPLES for side in view.size)
    frame = _frame(view)
    seen = (scene.corners - view.position) @ frame.T
    before = seen[..., 2].min(axis=1) > NEAREST * float(np.linalg.norm(view.focal - view.position))
    if not before.all():
        lighting = lighting or cast_lights(scene)
        scene, seen = Scene(scene.corners[before], scene.rgb[before], scene.lined[before]), seen[before]
    scale = height / 2 / np.tan(np.radians(view.view_angle) / 2)
    nearness = 1 / seen[..., 2]
    plane = seen[..., :2] * nearness[..., None] * (scale, -scale) + (width / 2, height / 2)
    near = np.zeros((height, width))
    facet = np.full((height, width), NOTHING, np.int32)
    rim = np.zeros((height, width), np.float32)
    _raster(plane, nearness, near, facet, rim)
    light = lighting or cast_lights(scene)
    normal = np.cross(scene.corners[:, 1] - scene.corners[:, 0], scene.corners[:, 2] - scene.corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
    edges = np.linalg.norm(plane - np.roll(plane, 1, axis=1), axis=2).mean(axis=1) / SAMPLES
    strength = np.where(scene.lined, np.clip((edges - edge_pixels) / (3 * edge_pixels), 0, 1) * 0.45, 0.0)
    image = _gradient(sky, (height, width))
    rgb, frame = scene.rgb.astype(np.float64), np.ascontiguousarray(frame)
    lit_by = light.lights, light.frames, light.sides, light.maps
    _shade(image, near, facet, rim, rgb, normal, strength, frame, view.position, scale, *lit_by)
    small = sum(image[i::SAMPLES, j::SAMPLES] for i, j in np.ndindex(SAMPLES, SAMPLES)) / SAMPLES**2
    found: Colours = np.rint(small).astype(np.uint8)
    return found


def _frame(view: View) -> Floats:
    """Right, up and ahead of a camera, as rows."""
    ahead = (view.focal - view.position) / np.linalg.norm(view.focal - view.position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(right, ahead), ahead])


def _list_lights() -> Floats:
    """Directions of the sun, and of a sky that is seen from everywhere: a spiral over the upper half."""
    k = np.arange(SKY_DIRECTIONS)
    rise = 0.25 + 0.75 * (k + 0.5) / SKY_DIRECTIONS
    turn = k * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - rise**2)
    return np.vstack([SUN, np.column_stack([level * np.cos(turn), level * np.sin(turn), rise])])


def _cast(corners: Floats, light: Floats, pixels: int, near: NDArray[np.float32]) -> Floats:
    """Draw what a light sees, its height along the light; returns the frame (4, 3) that leads there."""
    side = np.cross([0.0, 1.0, 0.0], light)
    side /= np.linalg.norm(side)
    frame = np.array([side, np.cross(light, side), light])
    seen = _turn(corners.reshape(-1, 3), frame)
    low, high = seen.min(axis=1), seen.max(axis=1)
    scale = (pixels - 4) / max(float((high - low)[:2].max()), 1e-9)
    seen *= np.array([[scale], [scale], [1.0]])
    seen += np.array([[2 - low[0] * scale], [2 - low[1] * scale], [1 - low[2]]])
    _depth(seen[0], seen[1], seen[2], near[:pixels, :pixels])
    return np.vstack([frame * [[scale], [scale], [1.0]], [*(2 - low[:2] * scale), 1.0 - low[2]]])


def _gradient(sky: tuple[str, str], size: tuple[int, int]) -> NDArray[np.float32]:
    low, high = (np.array(list(bytes.fromhex(colour[1:])), np.float64) for colour in sky)
    image = np.empty((*size, 3), np.float32)
    image[:] = low + (high - low) * np.linspace(1, 0, size[0])[:, None, None]
    return image


@kernel
def _fill(image: NDArray[np.uint8], start: NDArray[np.int64], a: Floats, b: Floats) -> None:
    """Fill polygons line by line, between crossings with their edges; pixel centres are whole numbers."""
    rows, columns = image.shape
    for k in range(len(start) - 1):
        first, last = start[k], start[k + 1]
        if first == last:
            continue
        low, high = np.inf, -np.inf
        for e in range(first, last):
            low, high = min(low, a[e, 1], b[e, 1]), max(high, a[e, 1], b[e, 1])
        crossing = np.empty(last - first)
        for row in range(max(0, int(np.ceil(low))), min(rows - 1, int(np.floor(high))) + 1):
            n = 0
            for e in range(first, last):
                if (a[e, 1] <= row) != (b[e, 1] <= row):
                    crossing[n] = a[e, 0] + (row - a[e, 1]) / (b[e, 1] - a[e, 1]) * (b[e, 0] - a[e, 0])
                    n += 1
            crossing[:n].sort()
            for i in range(0, n - 1, 2):
                begin, end = max(0.0, np.ceil(crossing[i])), min(columns - 1.0, np.ceil(crossing[i + 1]) - 1.0)
                for column in range(int(begin), int(end) + 1):
                    image[row, column] = 1


@kernel
def _raster(
    plane: Floats, nearness: Floats, near: Floats, facet: NDArray[np.int32], rim: NDArray[np.float32]
) -> None:
    """Draw triangles (k, 3, 2) in pixels: the nearest one of each pixel, and how far its closest edge is."""
    rows, columns = near.shape
    for k in range(len(plane)):
        p, q, r = plane[k, 0], plane[k, 1], plane[k, 2]
        area = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        if area == 0:
            continue
        x0, x1 = (
            max(0, int(np.ceil(min(p[0], q[0], r[0]) - 0.5))),
            min(columns - 1, int(np.floor(max(p[0], q[0], r[0]) - 0.5))),
        )
        y0, y1 = (
            max(0, int(np.ceil(min(p[1], q[1], r[1]) - 0.5))),
            min(rows - 1, int(np.floor(max(p[1], q[1], r[1]) - 0.5))),
        )
        high = abs(area) / np.sqrt((r[0] - q[0]) ** 2 + (r[1] - q[1]) ** 2)
        high_q = abs(area) / np.sqrt((p[0] - r[0]) ** 2 + (p[1] - r[1]) ** 2)
        high_r = abs(area) / np.sqrt((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                at_x, at_y = x + 0.5, y + 0.5
                u = ((q[0] - at_x) * (r[1] - at_y) - (q[1] - at_y) * (r[0] - at_x)) / area
                v = ((r[0] - at_x) * (p[1] - at_y) - (r[1] - at_y) * (p[0] - at_x)) / area
                w = 1 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                depth = u * nearness[k, 0] + v * nearness[k, 1] + w * nearness[k, 2]
                if depth > near[y, x]:
                    near[y, x] = depth
                    facet[y, x] = k
                    rim[y, x] = min(u * high, v * high_q, w * high_r)


@kernel
def _turn(points: Floats, frame: Floats) -> Floats:
    """Give points (n, 3) in the axes that are a frame's rows, (3, n)."""
    found = np.empty((3, len(points)))
    for k in range(len(points)):
        for c in range(3):
            found[c, k] = points[k, 0] * frame[c, 0] + points[k, 1] * frame[c, 1] + points[k, 2] * frame[c, 2]
    return found


@kernel
def _depth(x: Floats, y: Floats, z: Floats, near: NDArray[np.float32]) -> None:
    """Draw the heights of triangles, three rows each, on pixels whose centres are whole numbers."""
    rows, columns = near.shape
    for k in range(0, len(x), 3):
        px, py, qx, qy, rx, ry = x[k], y[k], x[k + 1], y[k + 1], x[k + 2], y[k + 2]
        area = (qx - px) * (ry - py) - (qy - py) * (rx - px)
        if area == 0:
            continue
        first, last = max(0, int(np.ceil(min(px, qx, rx)))), min(columns - 1, int(max(px, qx, rx)))
        u_x, v_x = (qy - ry) / area, (ry - py) / area  # what a step to the right adds
        for row in range(max(0, int(np.ceil(min(py, qy, ry)))), min(rows - 1, int(max(py, qy, ry))) + 1):
            u = ((qx - first) * (ry - row) - (qy - row) * (rx - first)) / area
            v = ((rx - first) * (py - row) - (ry - row) * (px - first)) / area
            for column in range(first, last + 1):
                if u >= 0 and v >= 0 and u + v <= 1:
                    height = np.float32(u * z[k] + v * z[k + 1] + (1 - u - v) * z[k + 2])
                    near[row, column] = max(near[row, column], height)
                u += u_x
                v += v_x


@kernel
def _shade(
    image: NDArray[np.float32],
    near: Floats,
    facet: NDArray[np.int32],
    rim: NDArray[np.float32],
    rgb: Floats,
    normal: Floats,
    strength: Floats,
    frame: Floats,
    position: Floats,
    scale: float,
    lights: Floats,
    lit: Floats,
    sides: NDArray[np.int64],
    maps: NDArray[np.float32],
) -> None:
    """Colour each pixel by its facet and by the lights that reach it."""
    rows, columns = near.shape
    place = np.empty(3)
    for y in range(rows):
        for x in range(columns):
            k = facet[y, x]
            if k == NOTHING:
                continue
            depth = 1 / near[y, x]
            across, up = (x + 0.5 - columns / 2) / scale * depth, (rows / 2 - y - 0.5) / scale * depth
            facing = 0.0
            for c in range(3):
                place[c] = position[c] + across * frame[0, c] + up * frame[1, c] + depth * frame[2, c]
                facing += normal[k, c] * (position[c] - place[c])
            turn = 1.0 if facing > 0 else -1.0
            sun, sky, most = 0.0, 0.0, 0.0
            for j in range(len(lights)):
                cosine = turn * (
                    normal[k, 0] * lights[j, 0] + normal[k, 1] * lights[j, 1] + normal[k, 2] * lights[j, 2]
                )
                if j:
                    most += lights[j, 2]
                if cosine <= 0:
                    continue
                at_x = lit[j, 0, 0] * place[0] + lit[j, 0, 1] * place[1] + lit[j, 0, 2] * place[2] + lit[j, 3, 0]
                at_y = lit[j, 1, 0] * place[0] + lit[j, 1, 1] * place[1] + lit[j, 1, 2] * place[2] + lit[j, 3, 1]
                own = lit[j, 2, 0] * place[0] + lit[j, 2, 1] * place[1] + lit[j, 2, 2] * place[2] + lit[j, 3, 2]
                # A pixel of the light's map is this long along the facet, which would darken itself.
                bias = 1.5 / np.sqrt(lit[j, 0, 0] ** 2 + lit[j, 0, 1] ** 2 + lit[j, 0, 2] ** 2)
                bias *= np.sqrt(max(0.0, 1 - cosine**2)) / max(cosine, 0.1) + 0.3
                column, row = int(at_x), int(at_y)
                if 0 <= column < sides[j] and 0 <= row < sides[j] and maps[j, row, column] > own + bias:
                    continue
                if j == 0:
                    sun = cosine
                else:
                    sky += cosine
            light = FLOOR_LIGHT + SUN_LIGHT * sun / lights[0, 2] + SKY_LIGHT * sky / most
            line = strength[k] * min(1.0, max(0.0, 1.6 - rim[y, x] / 1.0))
            for c in range(3):
                shaded = min(255.0, rgb[k, c] * min(light, 1.08))
                image[y, x, c] = shaded * (1 - line) + LINE[c] * line
