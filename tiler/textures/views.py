"""Which image shows each surface of a tile best: by the area of it that is seen, in pixels."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from math import ceil
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.textures.cameras import Array, Camera, farthest_radius, rotate
from tiler.textures.surfaces import Bins, Surface
from tiler.textures.visibility import (
    HIDDEN,
    NEAR,
    NOT_SEEN,
    OUTSIDE,
    PLANT,
    SEEN,
    cover_texels,
    draw_triangles,
    view_points,
)

SAMPLES = 16  # along the longer side of a surface, of the points that choose its images
LEAST_COSINE = 0.17  # of the angle between a normal and the direction to a camera: 80 degrees
BINS_HELD = 16  # bins of triangles in memory
NO_PLANTS = np.empty((0, 0), np.uint8)
REASONS = {
    NOT_SEEN: "no image faces it",
    OUTSIDE: "outside all images",
    HIDDEN: "hidden",
    PLANT: "behind plants",
    SEEN: "fewer pixels than --least-resolution",
}


@dataclass(frozen=True, eq=False)
class Plants:
    """Where an image shows plants: cells of `cell` pixels, uint8 (a, b)."""

    cells: NDArray[np.uint8] = field(default_factory=lambda: NO_PLANTS)
    cell: float = 1.0


@dataclass(frozen=True, eq=False)
class View:
    """What a camera sees of a tile: distances (h, w, m) from a corner of its image on, without distortion."""

    camera: Camera
    depth: NDArray[np.float32]
    corner: Array
    lens: Array  # as of `view_points`
    plants: Plants

    def see(self, points: Array, surface: Surface) -> tuple[NDArray[np.uint8], Array, Array]:
        """Give state and place in the image of points (n, 3) of a surface, and pixels per metre there (n,)."""
        camera = self.camera
        local = camera.to_camera(points)
        normal = rotate(camera.inverse.T, surface.axes[2:])[0]
        state, place = view_points(
            local, normal, self.lens, self.depth, self.corner, self.plants.cells, self.plants.cell
        )
        towards = camera.place - points
        cosine = (towards * surface.axes[2]).sum(axis=1) / np.linalg.norm(towards, axis=1)
        scale = float(camera.focal.mean()) / np.maximum(local[:, 2], NEAR) * np.sqrt(np.maximum(cosine, 0.0))
        return state, place, scale


@dataclass(frozen=True, eq=False)
class Ranking:
    """Images of each surface of a tile."""

    best: list[list[int]]  #: numbers of the cameras that see it, the best first
    reached: list[int]  #: the best state of its points in any image, see `tiler.textures.visibility`


def texel_grid(surface: Surface, texel: float) -> NDArray[np.bool_]:
    """Lay square texels over a surface; tells which have their middle in it (h, w), the first row at the top."""
    w, h = (max(1, ceil(side / texel - 1e-6)) for side in surface.size.tolist())
    local = rotate(surface.axes, surface.corners.reshape(-1, 3) - surface.origin)[:, :2] / texel
    local[:, 1] = h - local[:, 1]
    inside = np.zeros((h, w), np.uint8)
    cover_texels(inside, local.reshape(-1, 3, 2))
    return inside.astype(np.bool_)


def texel_middles(surface: Surface, texel: float, chosen: NDArray[np.bool_]) -> Array:
    """Give the middles (n, 3) of the texels that are chosen (h, w), row by row (m)."""
    row, column = np.nonzero(chosen)
    x, y = (column + 0.5) * texel, (len(chosen) - row - 0.5) * texel
    found: Array = surface.origin + x[:, np.newaxis] * surface.axes[0] + y[:, np.newaxis] * surface.axes[1]
    return found


def rank_images(
    surfaces: Sequence[Surface],
    cameras: Sequence[Camera],
    bins: Bins,
    plants_of: Callable[[Camera], Plants],
    least: float,
) -> Ranking:
    """Rank the images of each surface by how many of their pixels show it; ties by the order of the cameras.

    Parameters
    ----------
    surfaces, cameras
        Those of a tile, and all.
    bins : Bins
        What hides.
    plants_of : callable
        Plants of a camera's image.
    least : float
        Pixels per metre that an image must have of a surface.
    """
    samples = []
    for surface in surfaces:
        texel = max(float(surface.size.max()) / SAMPLES, 1e-3)
        found = texel_middles(surface, texel, texel_grid(surface, texel))
        samples.append(found if len(found) else surface.corners.mean(axis=1))
    scores: list[list[tuple[float, int]]] = [[] for _ in surfaces]
    reached = [NOT_SEEN] * len(surfaces)
    for number, camera, rows in facing(surfaces, cameras):
        view = open_view(camera, [surfaces[row] for row in rows], bins, plants_of(camera))
        if view is None:
            continue
        for row in rows:
            state, _, scale = view.see(samples[row], surfaces[row])
            reached[row] = max(reached[row], int(state.max()))
            seen = (state == SEEN) & (scale >= least)
            if seen.any():
                scores[row].append(
                    (-round(float((scale[seen] ** 2).sum()) / len(seen) * surfaces[row].area, 3), number)
                )
    return Ranking([[number for _, number in sorted(own)] for own in scores], reached)


def facing(surfaces: Sequence[Surface], cameras: Sequence[Camera]) -> Iterator[tuple[int, Camera, list[int]]]:
    """Give each camera, with its number, and the surfaces that are turned to it and not all behind it."""
    if not surfaces:
        return
    middle = np.array([surface.corners.reshape(-1, 3).mean(axis=0) for surface in surfaces])
    normal = np.array([surface.axes[2] for surface in surfaces])
    reach = np.array([float(np.linalg.norm(surface.size)) for surface in surfaces])
    for number, camera in enumerate(cameras):
        towards = camera.place - middle
        far = np.linalg.norm(towards, axis=1)
        cosine = (towards * normal).sum(axis=1) / far
        local = camera.to_camera(middle)
        spread = np.maximum(local[:, 2] + reach, NEAR)
        off = np.abs(local[:, :2]) - reach[:, np.newaxis]
        # A cone around all of what the image shows.
        wide = _half_width(camera)
        rows = (
            (cosine >= LEAST_COSINE) & (local[:, 2] > -reach) & (off <= wide * spread[:, np.newaxis]).all(axis=1)
        )
        if rows.any():
            yield number, camera, np.flatnonzero(rows).tolist()


def _half_width(camera: Camera) -> Array:
    view = camera.view().reshape(2, 2)
    found: Array = np.abs((view - camera.centre) / camera.focal).max(axis=0)
    return found


def open_view(camera: Camera, surfaces: Sequence[Surface], bins: Bins, plants: Plants) -> View | None:
    """Draw all that may hide surfaces from a camera; None where it sees none of them."""
    points = np.concatenate([surface.corners.reshape(-1, 3) for surface in surfaces])
    local = camera.to_camera(points)
    low, high = camera.view().reshape(2, 2)
    if (local[:, 2] >= NEAR).all():
        plain = local[:, :2] / local[:, 2:] * camera.focal + camera.centre
        low, high = np.maximum(low, plain.min(axis=0) - 1), np.minimum(high, plain.max(axis=0) + 1)
    elif (local[:, 2] < NEAR).all():
        return None
    low, high = np.floor(low), np.ceil(high)
    if not (low < high).all():
        return None
    width, height = (high - low).astype(int).tolist()
    depth = np.full((height, width), np.inf, np.float32)
    for code in _near_bins(camera, points, bins):
        corners = camera.to_camera(_read_triangles(bins, code).reshape(-1, 3)).reshape(-1, 3, 3)
        draw_triangles(depth, corners, camera.focal, camera.centre - low)
    size, limit = [camera.width, camera.height], [farthest_radius(camera.distortion)]
    lens = np.concatenate((size, camera.focal, camera.centre, camera.distortion, limit))
    return View(camera, depth, low, lens, plants)


@lru_cache(maxsize=BINS_HELD)
def _read_triangles(bins: Bins, code: int) -> Array:
    return bins.triangles(code)


def _near_bins(camera: Camera, points: Array, bins: Bins) -> list[int]:
    """List the bins above which rays from points to a camera are below the highest place of the city."""
    west, south, bottom = points.min(axis=0).tolist()
    east, north, _ = points.max(axis=0).tolist()
    box = np.array([(west, south), (east, south), (east, north), (west, north)])
    rise = float(camera.place[2]) - bottom
    share = min(1.0, (bins.top - bottom) / rise) if rise > 0 else 1.0
    ends = box + share * (camera.place[:2] - box)
    shade = shapely.MultiPoint(np.concatenate((box, ends))).convex_hull.buffer(1e-6)
    codes = sorted(bins.boxes)
    boxes = np.array([bins.boxes[code] for code in codes]).reshape(-1, 4)
    met = shapely.intersects(shapely.box(*boxes.T), shade)
    return [code for code, meets in zip(codes, np.atleast_1d(met).tolist(), strict=True) if meets]


def plants_file(folder: Path, name: str) -> Path:
    """Give the file of the plants of an image, by its name."""
    return folder / "plants" / f"{name.replace('/', '%')}.npy"
