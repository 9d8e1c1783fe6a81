"""An airborne laser scanner: pulses of a strip, and the surfaces, crowns and ground that they meet."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.architecture.plants import Tree
from pipeline.architecture.surfaces import Surface

FLIGHT = 600.0  # m above the lowest ground
HALF_SWATH, SPACING = 280.0, 400.0  # m: 25 degrees to both sides, and 30 % of a strip lie in its neighbour
FORWARD = math.tan(math.radians(8.0))  # strips look ahead, and their neighbours back: they see walls of all sides
BEAM = 0.15  # m, radius of a pulse at the ground
_ACCURACY = 1e-4  # m, of where pulses meet the ground

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Pulses:
    """Pulses as straight lines: the place ``x + east h, y + north h`` at height ``h`` above the lowest ground."""

    #: (n,): where they would meet the lowest ground (m)
    x: Array
    y: Array
    east: Array  #: (n,): shift towards the sensor for each metre up
    north: float  #: the same along the strip
    cell: "Cell"  #: what they are drawn in

    def at(self, h: Array) -> tuple[Array, Array]:
        """Give the places at heights above the lowest ground."""
        return self.x + self.east * h, self.y + self.north * h

    def shift(self, x: Array, y: Array) -> "Pulses":
        """Give parallel pulses beside these, by at most `BEAM`."""
        return Pulses(self.x + x, self.y + y, self.east, self.north, self.cell)


@dataclass(frozen=True)
class Cell:
    """A square of ``side`` times ``side`` smaller ones, row by row, with a pulse each."""

    #: lower left corner and side (m)
    west: float
    south: float
    size: float
    side: int  #: number of pulses along a side

    def places(self, jitter: Array) -> tuple[Array, Array]:
        """Give x and y of the pulses by their places within the smaller squares, of 0 to 1: float64, (n, 2)."""
        number = np.arange(self.side)
        step = self.size / self.side
        x = self.west + step * (np.tile(number, self.side) + jitter[:, 0])
        return x, self.south + step * (np.repeat(number, self.side) + jitter[:, 1])

    def near(self, boxes: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pair pulses with the boxes that they may be aimed at: float64, (n, 4), of west, south, east, north."""
        moved = (boxes + BEAM * np.array([-1, -1, 1, 1]) - [self.west, self.south] * 2) * (self.side / self.size)
        low = np.clip(np.floor(moved[:, :2]), 0, self.side).astype(np.int64)
        n_columns, n_rows = (np.clip(np.ceil(moved[:, 2:]), 0, self.side).astype(np.int64) - low).T
        count = np.maximum(n_columns, 0) * np.maximum(n_rows, 0)
        box = np.repeat(np.arange(len(boxes)), count)
        number = np.arange(len(box)) - np.repeat(np.cumsum(count) - count, count)
        row, column = number // n_columns[box] + low[box, 1], number % n_columns[box] + low[box, 0]
        return row * self.side + column, box


@dataclass(frozen=True, eq=False)
class Faces:
    """Flat faces in space."""

    corners: Array  #: (m, 3): of their borders, one face after the other (m)
    start: NDArray[np.int64]  #: (n,): first corner of each
    normal: Array  #: (n, 3): normals of length 1
    offset: Array  #: (n,): of the planes: ``normal . place``
    #: (n, 2): the two axes that the outline is told in: those that the normal is least along
    axes: NDArray[np.int64]
    outlines: NDArray[np.object_]  #: (n,): polygons in these axes, with holes


def strips_over(west: float, east: float) -> range:
    """List the strips that see something between two places: strip k flies northwards or southwards along x."""
    first = math.ceil((west - HALF_SWATH) / SPACING - 0.5)
    return range(first, math.floor((east + HALF_SWATH) / SPACING - 0.5) + 1)


def aim(strip: int, cell: Cell, jitter: Array) -> Pulses:
    """Give the pulses of a strip that are aimed at a cell of the lowest ground: see `Cell.places`."""
    x, y = cell.places(jitter)
    return Pulses(x, y, ((strip + 0.5) * SPACING - x) / FLIGHT, _tilt(strip), cell)


def _tilt(strip: int) -> float:
    return FORWARD if strip % 2 else -FORWARD


def list_faces(surfaces: Sequence[Surface], lowest: float) -> Faces:
    """Make faces of surfaces; heights are above the lowest ground (m)."""
    borders = [np.array(one.border) - (0.0, 0.0, lowest) for one in surfaces]
    n = len(borders)
    normal = np.zeros((n, 3))
    outlines = np.empty(n, np.object_)
    for k, border in enumerate(borders):
        moved = border - border[0]
        normal[k] = np.cross(moved, np.roll(moved, -1, axis=0)).sum(axis=0)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    axes = np.sort(np.argsort(np.abs(normal), axis=1, kind="stable")[:, :2], axis=1)
    for k, one in enumerate(surfaces):
        holes = [(np.array(hole) - (0.0, 0.0, lowest))[:, axes[k]] for hole in one.holes]
        outlines[k] = shapely.Polygon(borders[k][:, axes[k]], holes)
    shapely.prepare(outlines)
    corners = np.concatenate(borders) if n else np.empty((0, 3))
    start = np.cumsum([0, *map(len, borders)])[:-1].astype(np.int64)
    offset = np.einsum("ij,ij->i", normal, corners[start]) if n else np.empty(0)
    return Faces(corners, start, normal, offset, axes, outlines)


def meet_faces(faces: Faces, seen: Array, pulses: Pulses) -> Array:
    """Give the highest place (m, above the lowest ground) at which each pulse meets a face; -inf: none.

    Parameters
    ----------
    seen : float64, (n, 4)
        Their boxes as of `aimed_boxes`.
    pulses : Pulses
        Of the same strip.
    """
    found = np.full(len(pulses.x), -np.inf)
    ray, face = pulses.cell.near(seen)
    normal = faces.normal[face]
    fall = normal[:, 0] * pulses.east[ray] + normal[:, 1] * pulses.north + normal[:, 2]
    level = np.abs(fall) > 1e-9
    ray, face, normal, fall = ray[level], face[level], normal[level], fall[level]
    h = (faces.offset[face] - normal[:, 0] * pulses.x[ray] - normal[:, 1] * pulses.y[ray]) / fall
    place = np.column_stack((pulses.x[ray] + pulses.east[ray] * h, pulses.y[ray] + pulses.north * h, h))
    u, v = np.take_along_axis(place, faces.axes[face], axis=1).T
    inside = shapely.intersects_xy(faces.outlines[face], u, v)
    np.maximum.at(found, ray[inside], h[inside])
    return found


def list_crowns(trees: Sequence[Tree], lowest: float) -> tuple[Array, Array]:
    """List crowns: middle, radius and half height (m), (n, 5), and the corners of their boxes, (8 n, 3)."""
    rows = [(one.x, one.y, one.middle - lowest, one.radius, one.half_height) for one in trees]
    crown = np.array(rows).reshape(-1, 5)
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    return crown, (crown[:, None, :3] + signs * crown[:, None, [3, 3, 4]]).reshape(-1, 3)


def meet_crowns(crown: Array, seen: Array, pulses: Pulses) -> tuple[Array, Array]:
    """Give where each pulse enters and leaves the highest crown on its way (m); -inf: none. See `meet_faces`."""
    enters, leaves = np.full((2, len(pulses.x)), -np.inf)
    ray, tree = pulses.cell.near(seen)
    x, y, z, wide, high = crown[tree].T
    # A place on a pulse, with the crown as a unit sphere: a + b h.
    a = np.stack(((pulses.x[ray] - x) / wide, (pulses.y[ray] - y) / wide, -z / high))
    b = np.stack((pulses.east[ray] / wide, pulses.north / wide, 1 / high))
    bb, ab = (b * b).sum(axis=0), (a * b).sum(axis=0)
    root = ab * ab - bb * ((a * a).sum(axis=0) - 1)
    ray, bb, ab, root = (one[root > 0] for one in (ray, bb, ab, root))
    top, bottom = (-ab + np.sqrt(root)) / bb, (-ab - np.sqrt(root)) / bb
    order = np.argsort(top, kind="stable")  # of several crowns, the highest is the last to be written
    enters[ray[order]], leaves[ray[order]] = top[order], bottom[order]
    return enters, leaves


def meet_ground(ground: Callable[[Array, Array], Array], lowest: float, pulses: Pulses) -> Array:
    """Give the height (m, above the lowest) at which each pulse meets ground that is less steep than it."""
    h = np.zeros(len(pulses.x))
    for _ in range(200):
        before, h = h, ground(*pulses.at(h)) - lowest
        if np.abs(h - before).max(initial=0.0) < _ACCURACY:
            return h
    raise ValueError("the ground is too steep for the pulses")


def aimed_boxes(corners: Array, start: NDArray[np.int64], strip: int) -> Array:
    """Give the boxes of the places that pulses through each group of corners are aimed at: float64, (n, 4).

    The aim is linear over linear in each place, so that corners have its extremes.
    """
    if not len(start):
        return np.empty((0, 4))
    x, y, h = corners.T
    sensor = (strip + 0.5) * SPACING
    aims = np.column_stack((sensor + (x - sensor) / (1 - h / FLIGHT), y - _tilt(strip) * h))
    return np.hstack((np.minimum.reduceat(aims, start), np.maximum.reduceat(aims, start)))
