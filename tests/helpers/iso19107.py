"""An independent check of solids against ISO 19107, with the error codes and tolerances of val3dity.

Faces are judged by shapely in the plane of least squares, shells by VTK, self-intersections by exact determinants
of whole millimetres; what shells and solids have in common by winding numbers on a lattice of places. Nothing of
the program is used.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pyvista
import shapely
from numpy.typing import NDArray
from scipy import ndimage

SNAP = 0.001  # m; vertices closer than this are one
PLANARITY = 0.01  # m, of the corners of a face from its plane
ROUNDED = 1.0  # units of coordinates; rounded walls cross by less
MOST_BEND = 20.0  # degrees between two triangles of a face
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Shell = list[list[list[int]]]  # rings of each face, by numbers of vertices
Shells = list[Shell]


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
    found: dict[tuple[str, str], set[str]] = {}
    parts: dict[tuple[str, str], list[Shells]] = defaultdict(list)
    for name, thing in document["CityObjects"].items():
        for item in thing.get("geometry", []):
            if item["lod"] not in lods or item["type"] not in ("Solid", "CompositeSolid"):
                continue
            solids = [item["boundaries"]] if item["type"] == "Solid" else item["boundaries"]
            found[name, item["lod"]] = {
                *(fault for solid in solids for fault in _check_solid(solid, vertices, scale[0])),
                *_check_composite(solids, vertices),
            }
            for parent in thing.get("parents", []):
                parts[parent, item["lod"]] += solids
    for key, solids in parts.items():
        if any((one & other).any() for one, other in _pairs_on_lattices(solids, vertices)):
            found.setdefault(key, set()).add("601 parts overlap")
    return found


def _check_solid(shells: Shells, vertices: Ints, unit: float) -> Iterator[str]:
    """Check the outer shell of a solid, its cavities, which look inwards, and how they lie to each other."""
    yield from check_shell(shells[0], vertices, unit)
    for cavity in shells[1:]:
        yield from check_shell(_turn(cavity), vertices, unit)
    if len(shells) == 1:
        return
    lattice = _lattice(shells, vertices)
    whole, *holes = (_is_within([shell], vertices, lattice) for shell in (shells[0], *map(_turn, shells[1:])))
    for hole in holes:
        if (hole & ~whole).any():
            yield "401 shells cross" if (hole & whole).any() else "403 a cavity lies outside"
    for one, other in combinations((whole, *holes), 2):
        if (one == other).all():
            yield "402 shells are one"
    if any((one & other).any() and (one != other).any() for one, other in combinations(holes, 2)):
        yield "401 shells cross"
    if ndimage.label(whole & ~np.any(holes, axis=0))[1] > 1:
        yield "404 the inside is in pieces"


def _check_composite(solids: list[Shells], vertices: Ints) -> Iterator[str]:
    """Check how the solids of a composite lie to each other: they may share faces alone, and hang together."""
    for one, other in _pairs_on_lattices(solids, vertices):
        if (one & other).any():
            yield "502 solids are one" if (one == other).all() else "501 solids overlap"
    if len(solids) > 1:
        lattice = _lattice([shell for solid in solids for shell in solid], vertices)
        if ndimage.label(np.any([_is_within(solid, vertices, lattice) for solid in solids], axis=0))[1] > 1:
            yield "503 solids do not hang together"


def _pairs_on_lattices(
    solids: list[Shells], vertices: Ints
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """What of a lattice lies within each of two solids, for all pairs that overlap in plan."""
    boxes = [_box(solid, vertices) for solid in solids]
    plans = [_project(solid, vertices) for solid in solids]
    for one, other in combinations(range(len(solids)), 2):
        (low, high), (low_2, high_2) = boxes[one], boxes[other]
        if (np.minimum(high, high_2) - np.maximum(low, low_2) > 2).all():
            common = shapely.buffer(shapely.intersection(plans[one], plans[other]), -ROUNDED)
            if not shapely.is_empty(common):
                lattice = _lattice(solids[one] + solids[other], vertices)
                yield _is_within(solids[one], vertices, lattice), _is_within(solids[other], vertices, lattice)


def _project(shells: Shells, vertices: Ints) -> shapely.Geometry:
    """The plan of a solid, the union of its faces seen from above."""
    faces = [
        shapely.Polygon(vertices[face[0], :2], [vertices[hole, :2] for hole in face[1:]])
        for face in shells[0]
        if len(face[0]) > 2
    ]
    return shapely.union_all(shapely.buffer(shapely.make_valid(faces), 0))


def _turn(shell: Shell) -> Shell:
    return [[ring[::-1] for ring in face] for face in shell]


def _box(shells: Shells, vertices: Ints) -> tuple[Ints, Ints]:
    used = vertices[np.unique([vertex for shell in shells for face in shell for ring in face for vertex in ring])]
    return used.min(axis=0), used.max(axis=0)


def _lattice(shells: Shells, vertices: Ints) -> Floats:
    """Places in the box of shells, of one distance in all directions, float64 (i, j, k, 3)."""
    low, high = _box(shells, vertices)
    step = max(float((high - low).min()) / 15, float((high - low).max()) / 90)
    axes = [np.arange(a + 0.37 * step, b, step) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _is_within(shells: Shells, vertices: Ints, lattice: Floats) -> NDArray[np.bool_]:
    """Whether places lie within shells, by solid angles of triangles (van Oosterom and Strackee 1983)."""
    angle = np.zeros(lattice.shape[:-1])
    for ring in (ring for shell in shells for face in shell for ring in face):
        for second, third in pairwise(ring[1:]):  # fans: what they have too much cancels in a plane
            a, b, c = (vertices[vertex] - lattice for vertex in (ring[0], second, third))
            x, y, z = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
            across = np.einsum("...i,...i", a, np.cross(b, c))
            ab, bc, ca = (np.einsum("...i,...i", p, q) for p, q in ((a, b), (b, c), (c, a)))
            angle += 2 * np.arctan2(across, x * y * z + ab * z + bc * x + ca * y)
    within: NDArray[np.bool_] = angle > 2 * np.pi
    return within


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
