"""Solids under sloped roofs on an integer grid: roofs cut where their plane reaches a limit (LoD2.2)."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs, is_flat, plane_heights

GROUND, ROOF, WALL = range(3)
Face = tuple[int, tuple[NDArray[np.int64], ...]]  # a kind, and rings
Place = tuple[int, int]

LEVEL_TOLERANCE = 0.005  # m; a plane this close to a limit is at it
LINE_TOLERANCE = 0.01  # m, in the plane, to the line where it reaches the limit: for slopes below 0.5
STRAIGHT = 0.002  # m; a corner of the outline this close to the line of its neighbours is left out
ROOM = 0.002  # m, of a roof above the ground
MAX_TILT = np.radians(10)  # of a triangle of a face against its plane; val3dity takes 20 degrees


@dataclass(frozen=True, eq=False)
class GridRoofs:
    """Roofs of buildings on a grid."""

    roofs: Roofs  #: the roofs, none lower than `ROOM` above the ground
    tolerance: NDArray[np.float64]  #: (n,): height (m) within which a plane is at a limit
    origin: NDArray[np.float64]  #: (3,): point of the grid coordinates (0, 0, 0) (m)
    grid: float  #: spacing (m)

    def heights(self, row: NDArray[np.int64], xy: NDArray[np.int64]) -> NDArray[np.int64]:
        """Heights of roofs at places, grid coordinates (k,) at (k, 2); where the plane is near a limit, that."""
        low, high = self.roofs.limits[row].T
        height = self.planes(row, xy)
        height = np.minimum(np.maximum(height, low), high)
        height = np.where(height - low <= self.tolerance[row], low, height)
        height = np.where(high - height <= self.tolerance[row], high, height)
        rounded: NDArray[np.int64] = np.rint((height - self.origin[2]) / self.grid).astype(np.int64)
        return rounded

    def planes(self, row: NDArray[np.int64], xy: NDArray[np.int64]) -> NDArray[np.float64]:
        """Heights of the planes (m) without their limits."""
        return plane_heights(self.roofs, row, xy * self.grid + self.origin[:2])


def put_on_grid(
    roofs: Roofs, ground: NDArray[np.float64], origin: NDArray[np.float64], *, grid: float
) -> GridRoofs:
    """Prepare roofs over the ground (n,) (m) for solids."""
    limits = np.maximum(roofs.limits, ground[:, None] + ROOM)
    steepness = np.hypot(roofs.plane[:, 0], roofs.plane[:, 1])
    tolerance = np.minimum(LEVEL_TOLERANCE, LINE_TOLERANCE * steepness)
    return GridRoofs(Roofs(roofs.plane, roofs.origin, limits), tolerance, origin, grid)


def straighten(polygons: NDArray[np.object_], roofs: Roofs) -> NDArray[np.object_]:
    """Leave out the corners of outlines under sloped roofs that lie on a straight wall.

    Three of them nearly on a line are a triangle that rounding turns any way: no plane face may have such.
    """
    result = polygons.copy()
    rows = np.flatnonzero(~is_flat(roofs) & ~shapely.is_empty(polygons))
    result[rows] = shapely.orient_polygons(shapely.simplify(polygons[rows], STRAIGHT))
    return result


def build_cut_solids(
    polygons: NDArray[np.object_], floor: NDArray[np.int64], roofs: GridRoofs
) -> dict[int, tuple[list[Face], NDArray[np.int64]]]:
    """Build the solids of the buildings whose roof is more than one plane face.

    Parameters
    ----------
    polygons : object, (n,)
        Outlines on the grid, from `straighten`.
    floor : int64, (n,)
        Ground, grid coordinates.
    roofs : GridRoofs
        Their roofs.

    Returns
    -------
    dict of int to (list of Face, int64 (v, 3))
        By row: faces (ground, roof, walls) with rings of rows of the vertices, counter-clockwise seen from
        outside; holes follow the outer ring.

    Notes
    -----
    An edge of the outline along which the plane passes a limit gets a node there; nodes of one limit are joined
    in their order along the level line where the joint lies inside. A face of the plane is cut in triangles if
    one of its triangles leans from it by more than `MAX_TILT`, as rounding does to narrow ones.
    """
    rows = np.flatnonzero(~is_flat(roofs.roofs) & ~shapely.is_empty(polygons))
    xy, owner = _grid_coordinates(polygons[rows], roofs)
    of = rows[owner]
    plane, tolerance = roofs.planes(of, xy), roofs.tolerance[of]
    n = len(polygons)
    cut = np.zeros(n, np.bool_)
    for limit in roofs.roofs.limits.T:
        above = np.bincount(of[plane > limit[of] + tolerance], minlength=n)
        below = np.bincount(of[plane < limit[of] - tolerance], minlength=n)
        cut |= (above > 0) & (below > 0)
    whole = np.setdiff1d(rows, np.flatnonzero(cut))
    leaning = whole[_lean(polygons[whole], roofs, whole)]
    several = np.union1d(np.flatnonzero(cut), leaning).tolist()
    return {row: _build(polygons[row], int(floor[row]), roofs, row) for row in several}


def _grid_coordinates(
    polygons: NDArray[np.object_], roofs: GridRoofs
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    xy, owner = shapely.get_coordinates(polygons, return_index=True)
    return np.rint((xy - roofs.origin[:2]) / roofs.grid).astype(np.int64), owner


def _build(
    polygon: shapely.Polygon, floor: int, roofs: GridRoofs, row: int
) -> tuple[list[Face], NDArray[np.int64]]:
    pieces = _cut(polygon, roofs, row)
    shown: list[shapely.Polygon] = []
    leaning = _lean(pieces, roofs, np.full(len(pieces), row))
    for piece, leans in zip(pieces, leaning.tolist(), strict=True):
        shown += shapely.get_parts(shapely.constrained_delaunay_triangles(piece)).tolist() if leans else [piece]
    faces = [_rings_of(piece, roofs) for piece in shapely.orient_polygons(shown)]
    edges = set(chain.from_iterable(pairwise([*ring, ring[0]]) for face in faces for ring in face))
    border = sorted(edge for edge in edges if edge[::-1] not in edges)
    corners = sorted(set(chain.from_iterable(edges)))
    number = {corner: k for k, corner in enumerate(corners)}
    xy = np.array(corners, np.int64)
    on_roof = roofs.heights(np.full(len(xy), row), xy)
    vertices = np.concatenate((np.column_stack((xy, np.full(len(xy), floor))), np.column_stack((xy, on_roof))))
    n = len(xy)

    def rows_of(ring: list[Place]) -> NDArray[np.int64]:
        return np.array([number[corner] for corner in ring], np.int64)

    bottom = _chain(border)
    floors = [bottom] if bottom else faces
    solid: list[Face] = [(GROUND, tuple(rows_of(ring)[::-1] for ring in face)) for face in floors]
    solid += [(ROOF, tuple(rows_of(ring) + n for ring in face)) for face in faces]
    for a, b in border:
        i, j = number[a], number[b]
        solid.append((WALL, (np.array([i, j, j + n, i + n], np.int64),)))
    used = np.unique(np.concatenate([ring for _, face in solid for ring in face]))
    return [(kind, tuple(np.searchsorted(used, ring) for ring in face)) for kind, face in solid], vertices[used]


def _cut(polygon: shapely.Polygon, roofs: GridRoofs, row: int) -> NDArray[np.object_]:
    """Cut an outline, in metres, along the lines where the plane is at a limit."""
    rings = _rings_of(polygon, roofs)
    joints: list[list[Place]] = []
    for limit in roofs.roofs.limits[row].tolist():
        found: list[Place] = []
        rings = [list(_with_nodes(ring, roofs, row, limit, found)) for ring in rings]
        joints += _join_inside(rings, sorted(set(found)), roofs, row)
    lines = [shapely.LineString([*ring, ring[0]]) for ring in rings] + [
        shapely.LineString(line) for line in joints
    ]
    pieces = shapely.get_parts(shapely.polygonize([shapely.union_all(lines, grid_size=1.0)]))
    outline = shapely.Polygon(rings[0], rings[1:])
    pieces = pieces[shapely.contains_xy(outline, *shapely.get_coordinates(shapely.point_on_surface(pieces)).T)]
    scaled: NDArray[np.object_] = shapely.transform(pieces, lambda xy: xy * roofs.grid + roofs.origin[:2])
    return scaled


def _rings_of(polygon: shapely.Polygon, roofs: GridRoofs) -> list[list[Place]]:
    """Rings of a polygon in grid coordinates, the first corner not repeated."""
    rings = []
    for ring in (polygon.exterior, *polygon.interiors):
        xy, _ = _grid_coordinates(np.array([ring]), roofs)
        rings.append([(x, y) for x, y in xy[:-1].tolist()])
    return rings


def _with_nodes(
    ring: list[Place], roofs: GridRoofs, row: int, limit: float, found: list[Place]
) -> Iterator[Place]:
    """Give a ring with nodes where the plane passes a limit; these, and corners at the limit, are `found`."""
    xy = np.array(ring, np.int64)
    over = roofs.planes(np.full(len(ring), row), xy) - limit
    side = np.where(np.abs(over) <= roofs.tolerance[row], 0, np.sign(over)).astype(int).tolist()
    height = over.tolist()
    for k, a in enumerate(ring):
        yield a
        if side[k] == 0:
            found.append(a)
        after = (k + 1) % len(ring)
        if side[k] * side[after] < 0:
            b, share = ring[after], height[k] / (height[k] - height[after])
            node = (round(a[0] + share * (b[0] - a[0])), round(a[1] + share * (b[1] - a[1])))
            found.append(node)
            if node not in (a, b):
                yield node


def _join_inside(
    rings: list[list[Place]], nodes: list[Place], roofs: GridRoofs, row: int
) -> Iterator[list[Place]]:
    """Give the joints of nodes of one limit, in their order along the level line, that lie inside."""
    a, b, _ = roofs.roofs.plane[row].tolist()
    nodes = sorted(nodes, key=lambda place: (a * place[1] - b * place[0], place))
    outline = shapely.Polygon(rings[0], rings[1:])
    for one, other in pairwise(nodes):
        if shapely.contains_xy(outline, (one[0] + other[0]) / 2, (one[1] + other[1]) / 2):
            yield [one, other]


def _chain(edges: list[tuple[Place, Place]]) -> list[list[Place]]:
    """Make one outline of directed edges, its outer ring first; empty if they pass a corner twice."""
    after = dict(edges)
    if len(after) < len(edges):
        return []
    rings = []
    while after:
        start = next(iter(after))
        ring = [start]
        while (onward := after.pop(ring[-1])) != start:
            ring.append(onward)
        rings.append(ring)
    outer = [k for k, ring in enumerate(rings) if _twice_area(ring) > 0]
    return [rings[outer[0]], *(ring for k, ring in enumerate(rings) if k != outer[0])] if len(outer) == 1 else []


def _twice_area(ring: list[Place]) -> int:
    return sum(a[0] * b[1] - a[1] * b[0] for a, b in pairwise([*ring, ring[0]]))


def _lean(polygons: NDArray[np.object_], roofs: GridRoofs, row: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which faces have a triangle that leans from their plane; those of three corners have none."""
    result = np.zeros(len(polygons), np.bool_)
    some = np.flatnonzero(shapely.get_num_coordinates(polygons) > 4)
    if not len(some):
        return result
    triangles, owner = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons[some]), return_index=True)
    xy, _ = _grid_coordinates(shapely.orient_polygons(triangles), roofs)
    xy = xy.reshape(-1, 4, 2)[:, :3]
    of = row[some[owner]]
    z = np.stack([roofs.heights(of, xy[:, k]) for k in range(3)], axis=1)
    corners = np.dstack((xy, z)).astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    low, high = np.full(len(some), np.inf), np.full(len(some), -np.inf)
    np.minimum.at(low, owner, z.min(axis=1))
    np.maximum.at(high, owner, z.max(axis=1))
    level = (low == high)[owner]
    a, b, _ = roofs.roofs.plane[of].T
    plane = np.column_stack((-a, -b, np.ones(len(of))))
    plane[level] = 0.0, 0.0, 1.0
    across = np.linalg.norm(np.cross(normal, plane), axis=1)
    leans = np.arctan2(across, (normal * plane).sum(axis=1)) > MAX_TILT
    result[some] = np.bincount(owner, leans, minlength=len(some)) > 0
    return result
