"""An independent check of solids against ISO 19107, with the error codes and tolerances of val3dity.

Faces are judged by shapely in the plane of least squares, shells by VTK, self-intersections by exact determinants
of whole millimetres. Nothing of the program is used.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pyvista
import shapely
from numpy.typing import NDArray

SNAP = 0.001  # m; vertices closer than this are one
PLANARITY = 0.01  # m, of the corners of a face from its plane
MOST_BEND = 20.0  # degrees between two triangles of a face
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


def check_solids(
    document: dict[str, Any], lods: Collection[str] = ("1.2", "1.3", "2.2")
) -> dict[tuple[str, str], set[str]]:
    """Check every solid of a CityJSON document.

    Parameters
    ----------
    document : dict
        CityJSON whose coordinates are whole millimetres, or tenths of them.
    lods : collection of str
        Levels of detail to check.

    Returns
    -------
    dict of (id, lod) to set of str
        What is wrong with each solid, by the codes of val3dity; an empty set for a valid one.
    """
    scale = document["transform"]["scale"]
    if scale not in ([SNAP] * 3, [SNAP / 10] * 3):
        raise ValueError(
            f"scale {scale}; expected {SNAP}, or a tenth: the determinants are those of whole numbers"
        )
    vertices = np.array(document["vertices"], np.int64).reshape(-1, 3)
    return {
        (name, item["lod"]): set(check_shell(item["boundaries"][0], vertices, scale[0]))
        for name, thing in document["CityObjects"].items()
        for item in thing.get("geometry", [])
        if item["type"] == "Solid" and item["lod"] in lods
    }


def check_shell(faces: list[list[list[int]]], vertices: Ints, unit: float = SNAP) -> Iterator[str]:
    """Check the shell of a solid without cavities; vertices in units (m)."""
    if len(faces) < 4:
        yield "301 too few faces"
        return
    used = np.unique([vertex for face in faces for ring in face for vertex in ring])
    number = {vertex: k for k, vertex in enumerate(used.tolist())}
    places = vertices[used] - vertices[used[0]]
    if _has_close(places, SNAP / unit):
        yield "000 vertices within the snapping tolerance"
    triangles = []
    for face in faces:
        rings = [[number[vertex] for vertex in ring] for ring in face]
        faults = set(_check_rings(rings))
        if not faults:
            found, faults = _check_face(rings, places, unit)
            triangles += found
        yield from faults
    if triangles:
        yield from _check_surface(np.array(triangles, np.int64), places, unit)


def _has_close(places: Ints, distance: float) -> bool:
    found = shapely.STRtree(shapely.points(places[:, :2].astype(np.float64))).query(
        shapely.points(places[:, :2].astype(np.float64)), predicate="dwithin", distance=distance
    )
    one, other = found[:, found[0] < found[1]]
    return bool((((places[one] - places[other]) ** 2).sum(axis=1) <= distance**2).any())


def _check_rings(rings: list[list[int]]) -> Iterator[str]:
    for ring in rings:
        if len(ring) < 3:
            yield "101 too few points"
        elif any(a == b for a, b in pairwise([*ring, ring[0]])):
            yield "102 consecutive points are one"
        elif len(set(ring)) < len(ring):
            yield "104 ring meets itself"


def _check_face(rings: list[list[int]], places: Ints, unit: float) -> tuple[list[tuple[int, ...]], set[str]]:
    """Triangulate a face in its plane; its triangles, and what is wrong with it."""
    corners = [vertex for ring in rings for vertex in ring]
    xyz = places[corners] * unit
    middle = xyz.mean(axis=0)
    normal = np.linalg.svd(xyz - middle)[2][2]
    normal *= 1 if _newell(places[rings[0]] * unit) @ normal > 0 else -1
    faults = {"203 not planar"} if np.abs((xyz - middle) @ normal).max() > PLANARITY else set()
    east = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    east /= np.linalg.norm(east)
    plan = (places * unit - middle) @ np.column_stack((east, np.cross(normal, east)))
    outline = shapely.Polygon(plan[rings[0]], [plan[ring] for ring in rings[1:]])
    if not outline.is_valid:
        return [], faults | {f"20x {shapely.is_valid_reason(outline).partition('[')[0]}"}
    if not outline.exterior.is_ccw or any(ring.is_ccw for ring in outline.interiors):
        return [], faults | {"208 rings turn the wrong way"}
    index = {tuple(plan[vertex].tolist()): vertex for vertex in corners}
    parts = shapely.get_parts(shapely.orient_polygons(shapely.constrained_delaunay_triangles(outline)))
    triangles = [tuple(index[place] for place in part.exterior.coords[:3]) for part in parts]
    turned = np.array([_newell(places[list(triangle)] * unit) for triangle in triangles])
    turned /= np.maximum(np.linalg.norm(turned, axis=1), 1e-12)[:, None]
    if (turned @ turned.T).min() < np.cos(np.radians(MOST_BEND)):
        faults.add("204 bent")
    return triangles, faults


def _newell(corners: NDArray[np.floating]) -> Floats:
    moved = corners - corners[0]
    area: Floats = np.cross(moved, np.roll(moved, -1, axis=0)).sum(axis=0) / 2
    return area


def _check_surface(triangles: Ints, places: Ints, unit: float) -> Iterator[str]:
    surface = pyvista.PolyData.from_regular_faces(places * unit, triangles)
    if surface.n_open_edges:
        yield "302 not closed"
    if surface.extract_feature_edges(
        feature_edges=False, manifold_edges=False, boundary_edges=False, non_manifold_edges=True
    ).n_cells:
        yield "304 more than two faces at an edge"
    if surface.connectivity()["RegionId"].max() > 0:
        yield "305 several shells"
    around = defaultdict(list)
    edges = set()
    for a, b, c in triangles.tolist():
        for first, second, third in ((a, b, c), (b, c, a), (c, a, b)):
            around[first].append((second, third))
            if (first, second) in edges:
                yield "307 faces turn both ways"
            edges.add((first, second))
    if any(_n_umbrellas(fan) > 1 for fan in around.values()):
        yield "303 shells meet in a vertex"
    corners = places[triangles] * unit
    if np.einsum("ij,ij", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) <= 0:
        yield "405 looks inwards"
    if _meets_itself(triangles, places):
        yield "306 self-intersection"


def _n_umbrellas(fan: list[tuple[int, int]]) -> int:
    """How many closed or open fans the triangles around a vertex make."""
    group = {vertex: vertex for pair in fan for vertex in pair}

    def root(vertex: int) -> int:
        while group[vertex] != vertex:
            vertex = group[vertex]
        return vertex

    for one, other in fan:
        group[root(one)] = root(other)
    return len({root(vertex) for vertex in group})


def _meets_itself(triangles: Ints, places: Ints) -> bool:
    """Whether two triangles have more in common than their common corners."""
    corners = places[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    pairs = np.array(list(combinations(range(len(triangles)), 2)), np.int64).reshape(-1, 2)
    one, other = pairs.T
    pairs = pairs[((low[one] <= high[other]) & (low[other] <= high[one])).all(axis=1)]
    crossing = any(_edges_cross(triangles, places, order) for order in (pairs, pairs[:, ::-1]))
    return crossing or _overlap(triangles, places, pairs)


def _edges_cross(triangles: Ints, places: Ints, pairs: Ints) -> bool:
    """Whether an edge of the first triangle of a pair meets the second one, of which it has no corner."""
    for k in range(3):
        a, b = triangles[pairs[:, 0], k], triangles[pairs[:, 0], (k + 1) % 3]
        face = triangles[pairs[:, 1]]
        apart = ~((a[:, None] == face) | (b[:, None] == face)).any(axis=1)
        p, q = places[a[apart]], places[b[apart]]
        t, u, v = places[face[apart]].swapaxes(0, 1)
        side_p, side_q = _side(t, u, v, p), _side(t, u, v, q)
        around = np.stack([_side(p, q, one, other) for one, other in ((t, u), (u, v), (v, t))])
        inside = (around >= 0).all(axis=0) | (around <= 0).all(axis=0)
        level = (side_p == 0) & (side_q == 0)
        if (inside & ~level & (side_p * side_q <= 0)).any():
            return True
    return False


def _side(a: Ints, b: Ints, c: Ints, d: Ints) -> Ints:
    """Sign of the volume of tetrahedra."""
    found: Ints = np.sign(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a))
    return found


def _overlap(triangles: Ints, places: Ints, pairs: Ints) -> bool:
    """Whether two triangles of one plane have an area in common."""
    one, other = places[triangles[pairs[:, 0]]], places[triangles[pairs[:, 1]]]
    a, b, c = one.swapaxes(0, 1)
    level = np.all([_side(a, b, c, other[:, k]) == 0 for k in range(3)], axis=0)
    for first, second in zip(one[level], other[level], strict=True):
        normal = np.cross(first[1] - first[0], first[2] - first[0])
        kept = [axis for axis in range(3) if axis != np.argmax(np.abs(normal))]
        shapes = shapely.polygons(np.stack((first, second))[..., kept].astype(np.float64))
        if shapely.relate_pattern(*shapes, "T********"):
            return True
    return False
