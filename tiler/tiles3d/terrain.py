"""The ground of tiles: as it was meshed in the smallest cells, and on ever coarser lattices above them.

A lattice has `NODES` nodes along each side of a cell: those of a cell are every second one of its children's.
How far it is from the ground below is measured at every node and vertex of that, from level to level.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.data.mesh import Marker
from tiler.tiles3d.content import Ints, Surface
from tiler.tiles3d.globe import Array, Globe

NODES = 33
RIM = 0.06  # of a cell's side: border edges of the ground within it get a skirt
LEAST_AREA = 1e-6  # twice the area of a triangle that is drawn (m2)
SIDE = 1e-6  # m; how far from a side of the region a vertex on it may be
SLACK = 1e-6  # of barycentric coordinates
ROW = 10  # numbers of a triangle of ground as it waits: corners, marker
Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Site:
    """What all cells have in common: the way to the globe, the region, and the boxes of its tiles (k, 4)."""

    globe: Globe
    bounds: Sequence[float]
    tiles: Array

    def nodes(self, box: Box, n: int) -> Array:
        """Give the places (n * n, 2) in the CRS (m) of a lattice over a box (degrees), moved into the region."""
        west, south, east, north = box
        lon, lat = np.meshgrid(np.linspace(west, east, n), np.linspace(south, north, n))
        xy = self.globe.plan(lon.ravel(), lat.ravel())
        return xy.clip(self.bounds[:2], self.bounds[2:])

    def holds(self, xy: Array) -> NDArray[np.bool_]:
        """Tell which places (n, 2) lie in a tile of the run."""
        low, high = xy.min(axis=0), xy.max(axis=0)
        near = self.tiles[(self.tiles[:, :2] <= high).all(axis=1) & (self.tiles[:, 2:] >= low).all(axis=1)]
        found = np.zeros(len(xy), np.bool_)
        for west, south, east, north in near:
            found |= (xy[:, 0] >= west) & (xy[:, 0] <= east) & (xy[:, 1] >= south) & (xy[:, 1] <= north)
        return found


@dataclass(frozen=True, eq=False)
class Lattice:
    """Heights (NODES, NODES) over a cell from south and west on (m), NaN where unknown, and their error (m)."""

    height: Array
    error: float


def meshed_ground(rows: Array) -> tuple[Surface, list[int]]:
    """Make a surface of triangles of ground (m, `ROW`); its features are patches, whose markers it gives."""
    marker = rows[:, -1].astype(np.int64)
    corners = np.column_stack((rows[:, :9].reshape(-1, 3), np.repeat(marker, 3)))
    vertices: Array
    vertices, corner = np.unique(corners, axis=0, return_inverse=True)
    patches, feature = np.unique(vertices[:, 3].astype(np.int64), return_inverse=True)
    # Facets look out of the air.
    triangles = corner.reshape(-1, 3)[:, ::-1]
    return Surface(vertices[:, :3], triangles, marker, feature), patches.tolist()


def lay_lattice(site: Site, box: Box, ground: Surface) -> Lattice:
    """Take the heights of a lattice from the ground in a cell; beyond it, that of the nearest vertex."""
    nodes = site.nodes(box, NODES)
    xyz = ground.xyz
    if not len(xyz):
        return Lattice(np.full((NODES, NODES), np.nan), 0.0)
    height = xyz[cKDTree(xyz[:, :2]).query(nodes)[1], 2]
    corners = xyz[ground.triangles]
    facets = shapely.STRtree(shapely.polygons(corners[:, :, :2]))
    node, facet = facets.query(shapely.points(nodes), predicate="intersects")
    order = np.lexsort((facet, node))
    node, first = np.unique(node[order], return_index=True)
    height[node] = _on_planes(corners[facet[order][first]], nodes[node])[0]
    lattice = Lattice(height.reshape(NODES, NODES), 0.0)
    return replace(lattice, error=_distance(site, box, lattice, xyz))


def coarsen(site: Site, box: Box, children: Mapping[tuple[int, int], Lattice]) -> Lattice:
    """Take every second node of the lattices of a cell's children, by column and row."""
    n = 2 * NODES - 1
    fine = np.full((n, n), np.nan)
    for (column, row), child in sorted(children.items()):
        part = fine[row * (NODES - 1) :, column * (NODES - 1) :][:NODES, :NODES]
        part[:] = np.where(np.isfinite(child.height), child.height, part)
    below = np.column_stack((site.nodes(box, n), fine.ravel()))[np.isfinite(fine.ravel())]
    lattice = Lattice(_extend(fine[::2, ::2]), max((child.error for child in children.values()), default=0.0))
    return replace(lattice, error=lattice.error + _distance(site, box, lattice, below))


def draw_lattice(site: Site, box: Box, lattice: Lattice) -> Surface | None:
    """Make the surface of a lattice; None where it has no area."""
    xyz = np.column_stack((site.nodes(box, NODES), lattice.height.ravel()))
    row, column = (part.ravel() for part in np.mgrid[: NODES - 1, : NODES - 1])
    triangles = _corners(np.concatenate((row, row)), np.concatenate((column, column)), np.repeat([0, 1], len(row)))
    a, b, c = (xyz[triangles[:, k]] for k in range(3))
    (x, y), (u, v) = (b - a)[:, :2].T, (c - a)[:, :2].T
    drawn = np.isfinite((a + b + c)[:, 2]) & (x * v - y * u > LEAST_AREA) & site.holds(((a + b + c) / 3)[:, :2])
    used, corner = np.unique(triangles[drawn], return_inverse=True)
    n = int(drawn.sum())
    ground = np.full(n, int(Marker.GROUND))
    return Surface(xyz[used], corner.reshape(-1, 3), ground, np.zeros(len(used), np.int64)) if n else None


def add_skirt(surface: Surface, site: Site, box: Box, depth: float) -> Surface:
    """Hang walls of a depth (m) from border edges near the sides of a cell, which hide gaps between levels."""
    west, south, east, north = box
    u, v = ((site.globe.geographic(surface.xyz)[:, :2] - (west, south)) / (east - west, north - south)).T
    near = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) < RIM
    ends = surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, number, count = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    low, high = np.reshape(site.bounds, (2, 2))
    on_side = np.column_stack((surface.xyz[:, :2] <= low + SIDE, surface.xyz[:, :2] >= high - SIDE))
    outer = np.any(on_side[ends[:, 0]] & on_side[ends[:, 1]], axis=1)
    border = (count[number.ravel()] == 1) & near[ends].all(axis=1) & ~outer
    ends, material = ends[border], np.repeat(surface.material, 3)[border]
    n, k = len(surface.xyz), 4 * np.arange(len(ends))[:, np.newaxis]
    top = surface.xyz[ends]
    wall = np.concatenate((top, top - [0, 0, depth]), axis=1).reshape(-1, 3)
    triangles = np.concatenate((n + k + [0, 2, 1], n + k + [1, 2, 3]))
    return Surface(
        np.concatenate((surface.xyz, wall)),
        np.concatenate((surface.triangles, triangles)),
        np.concatenate((surface.material, material, material)),
        np.concatenate((surface.feature, np.repeat(surface.feature[ends[:, 0]], 4))),
        len(wall),
    )


def _extend(height: Array) -> Array:
    """Give unknown nodes beside known ones their height: a side of the region may lie just beyond a cell."""
    for turn in range(4):
        found = np.rot90(height, turn).copy()
        found[1:] = np.where(np.isnan(found[1:]), found[:-1], found[1:])
        height = np.rot90(found, -turn)
    return height


def _corners(row: Ints, column: Ints, upper: Ints) -> Ints:
    """Give the nodes (n, 3) of the lower or upper triangle of squares of a lattice, by the south-western node."""
    first = row * NODES + column
    far = first + NODES + 1
    return np.column_stack((first, np.where(upper, far, first + 1), np.where(upper, first + NODES, far)))


def _distance(site: Site, box: Box, lattice: Lattice, xyz: Array) -> float:
    """Give the largest vertical distance of places (n, 3) in a cell from the surface of its lattice."""
    nodes = np.column_stack((site.nodes(box, NODES), lattice.height.ravel()))
    west, south, east, north = box
    u, v = ((site.globe.geographic(xyz)[:, :2] - (west, south)) / (east - west, north - south)).T * (NODES - 1)
    within = (np.minimum(u, v) >= 0) & (np.maximum(u, v) <= NODES - 1)
    column, row = (np.floor(some[within]).astype(np.int64).clip(0, NODES - 2) for some in (u, v))
    upper = (v[within] - row > u[within] - column).astype(np.int64)
    height, inside = _on_planes(nodes[_corners(row, column, upper)], xyz[within, :2])
    away = np.abs(height - xyz[within, 2])
    return float(np.nanmax(away[inside], initial=0.0))


def _on_planes(corners: Array, xy: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Give heights of places (n, 2) on planes of triangles (n, 3, 3), and whether they are on the triangles."""
    a, b, c = (corners[:, k] for k in range(3))
    (x, y), (u, v), (p, q) = (b - a)[:, :2].T, (c - a)[:, :2].T, (xy - a[:, :2]).T
    area = x * v - y * u
    flat = area <= LEAST_AREA
    area = np.where(flat, 1.0, area)
    s, t = (p * v - q * u) / area, (x * q - y * p) / area
    on = (s >= -SLACK) & (t >= -SLACK) & (s + t <= 1 + SLACK) & ~flat
    height: Array = np.where(flat, a[:, 2], a[:, 2] + s * (b - a)[:, 2] + t * (c - a)[:, 2])
    return height, on
