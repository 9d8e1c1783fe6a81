"""Normals, planes and volumes of faces in space, all faces at a time."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.cityinput.faces import ROOF, Faces

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FacePlanes:
    """The plane of each of ``f`` faces."""

    # (f, 3): area vectors (m²): as long as the area, by the right-hand rule around the border, holes taken away
    normal: Array
    centre: Array  # (f, 3): mean of the vertices of the border (m)
    # (f,): least and greatest height of the vertices (m)
    low: Array
    high: Array
    residual: Array  # (f,): largest vertical distance of a vertex to the plane (m); infinite for a vertical face


def area_vectors(xyz: Array, ring_start: NDArray[np.int64]) -> Array:
    """Area vectors of closed rings, float64 (r, 3), by Newell's formula."""
    if len(ring_start) < 2:
        return np.empty((0, 3))
    count = np.diff(ring_start)
    after = np.arange(len(xyz)) + 1
    after[ring_start[1:] - 1] = ring_start[:-1]
    near = xyz - np.repeat(xyz[ring_start[:-1]], count, axis=0)
    (x, y, z), (u, v, w) = near.T, near[after].T
    vectors = np.column_stack((y * w - z * v, z * u - x * w, x * v - y * u)) / 2
    found: Array = np.add.reduceat(vectors, ring_start[:-1], axis=0)
    return found


def find_planes(faces: Faces) -> FacePlanes:
    """Give the plane of each face: through the centre of its border, at right angles to its area vector."""
    if not len(faces):
        return FacePlanes(np.empty((0, 3)), np.empty((0, 3)), *(np.empty(0) for _ in range(3)))
    border = faces.face_start[:-1]
    rings = area_vectors(faces.xyz, faces.ring_start)
    lengths = np.linalg.norm(rings, axis=1)
    whole = np.maximum(lengths[border], 1e-12)
    # Holes are taken away by their size: they should run the other way round, but do not always.
    left = np.maximum(1 - (np.add.reduceat(lengths, border) - lengths[border]) / whole, 0.0)
    normal = rings[border] * left[:, np.newaxis]
    first, last = faces.ring_start[border], faces.ring_start[border + 1]
    # Sums of the border's vertices alone: those of holes lie behind them.
    ends = np.column_stack((first, last)).ravel()
    padded = np.vstack((faces.xyz, np.zeros((1, 3))))
    local = padded - padded[0]
    centre = np.add.reduceat(local, ends, axis=0)[::2] / (last - first)[:, np.newaxis] + padded[0]
    low = np.minimum.reduceat(padded[:, 2], ends)[::2]
    high = np.maximum.reduceat(padded[:, 2], ends)[::2]
    of_vertex = np.repeat(np.repeat(np.arange(len(faces)), np.diff(faces.face_start)), np.diff(faces.ring_start))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = -normal[:, :2] / normal[:, 2:]
        off = faces.xyz - centre[of_vertex]
        far = np.abs(off[:, 2] - (slope[of_vertex] * off[:, :2]).sum(axis=1))
    residual = np.maximum.reduceat(np.where(np.isfinite(far), far, np.inf), faces.ring_start[border])
    return FacePlanes(normal, centre, low, high, residual)


def signed_volume(faces: Faces) -> float:
    """Volume within faces that close (m³): positive where they are oriented outwards in right-handed axes."""
    if not len(faces):
        return 0.0
    near = faces.xyz - faces.xyz[0]
    vectors = area_vectors(near, faces.ring_start)
    return float((near[faces.ring_start[:-1]] * vectors).sum() / 3)


def upward_area(faces: Faces) -> float:
    """Area of roofs in plan (m²), negative where they look down."""
    vectors = area_vectors(faces.xyz, faces.ring_start)
    return float(vectors[faces.face_start[:-1]][faces.kind == ROOF, 2].sum())


def cut_face(rings: list[list[int]], xyz: Array) -> list[list[int]] | None:
    """Cut a face into triangles, seen along the axis that it is largest from; None where it is no polygon."""
    corners = xyz[rings[0]]
    normal = area_vectors(corners, np.array([0, len(corners)]))[0]
    axis = int(np.argmax(np.abs(normal)))
    kept = [(axis + 1) % 3, (axis + 2) % 3]
    plan = [xyz[ring][:, kept] for ring in rings]
    outline = shapely.Polygon(plan[0], plan[1:])
    if not outline.is_valid or not outline.area:
        return None
    place = {
        tuple(xy): v
        for ring, own in zip(rings, plan, strict=True)
        for v, xy in zip(ring, own.tolist(), strict=True)
    }
    pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(outline))
    ends = shapely.get_coordinates(shapely.orient_polygons(pieces)).reshape(-1, 4, 2)[:, :3].tolist()
    triangles = [[place[tuple(xy)] for xy in one] for one in ends]
    return triangles if normal[axis] > 0 else [one[::-1] for one in triangles]
