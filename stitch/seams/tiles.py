"""Step 3.1 for one tile: its plane mesh between seams that stay as they are."""

from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.mesh import PlaneMesh
from pipeline.plane_mesh.improve_plane import improve_plane
from pipeline.plane_mesh.plane import check_areas, collect_graph, order_plane, triangulate_plane
from pipeline.plane_mesh.sizes import SizeField, SizeRule, local_sizes
from stitch.seams.seams import ON_WALL, Seam
from stitch.tiling.corners import corner_sight
from stitch.tiling.grid import band_width, corner_reach
from stitch.tiling.land_cover import find_kept
from stitch.tiling.patches import PATCH
from stitch.tiling.strips import MARGIN, NO_EDGES, RING, label_triangles
from stitch.tiling.walls import LONGEST_PIECE, split_walls, walls_within

CLEAR_OF_SEAMS = 1.2  # mesh sizes; vertices of a strip that the tile begins with are that far from its other seams
CLEAR_OF_OTHERS = 0.6  # mesh sizes; that far from those of another strip
CLEAR_OF_WALLS = 0.3  # mesh sizes; and that far from walls

Sides = tuple[Seam, Seam, Seam, Seam]


def mesh_tile(
    sides: Sides,
    polygons: NDArray[np.object_],
    walls: NDArray[np.float64],
    *,
    mesh_size: float,
    min_angle: float,
    refinements: int,
    passes: int,
    sizes: SizeField | None = None,
    divide_chords: bool = False,
    edges: NDArray[np.float64] = NO_EDGES,
) -> tuple[PlaneMesh, bool]:
    """Mesh a tile between its four seams.

    Parameters
    ----------
    sides : four of Seam
        South, east, north, west.
    polygons : object, (b,)
        Footprints, at least those that meet the tile.
    walls : float64, (w, 2, 2)
        Their walls in pieces (`cut_walls`).
    mesh_size, min_angle, refinements, passes, sizes
        As in `mesh_plane`.
    divide_chords : bool
        Set a vertex in the middle of each piece of a wall that crosses the tile from seam to seam: with sloped
        roofs the tile must be free to move a column of every wall.
    edges : float64, (e, 2, 2)
        Further edges of the mesh, on open ground (m): those that the seams were found with, too.

    Returns
    -------
    PlaneMesh
        Its border is the seams' vertices, bit for bit, and no other; walls end and cross it in these.
    bool
        False if refinement was stopped by the limit on added vertices.

    Raises
    ------
    GeometryError
        If the 2D mesher fails, or the triangles do not cover the tile or a building's part in it.

    Notes
    -----
    A frozen border cannot be refined, so triangles beside it may be poor. Those in which the seam was found
    are good: the tile begins with their vertices, where these are clear of walls and of other seams.
    """
    ring = tile_ring(sides)
    tile = shapely.Polygon(ring)
    nodes = np.concatenate([side.wall_nodes for side in sides])
    edges = walls_within(edges, shapely.box(*tile.bounds))
    walls = np.concatenate((walls_within(walls, shapely.box(*tile.bounds)), edges))
    pieces = split_walls(walls, nodes, reach=ON_WALL)
    middle = pieces.mean(axis=1)
    inner = pieces[shapely.contains_xy(tile, middle[:, 0], middle[:, 1])]
    if divide_chords:
        inner = _divide_chords(inner, ring)
    border = np.stack((ring, np.roll(ring, -1, axis=0)), axis=1)
    graph = collect_graph(np.concatenate((border, inner)), np.empty((0, 2)))
    loose = _strip_vertices(sides, tile, inner, mesh_size, sizes)
    xy, triangles, _, complete = triangulate_plane(
        replace(graph, xy=np.concatenate((graph.xy, loose))),
        max_area=mesh_size**2 / 2,
        min_angle=min_angle,
        refinements=refinements,
        frozen=True,
        sizes=sizes,
    )
    label = label_triangles(xy, triangles, polygons)
    size = local_sizes(sizes, xy, mesh_size=mesh_size)
    kept = find_kept(xy, edges, triangles)
    xy, triangles = improve_plane(xy, triangles, label, mesh_size=size, passes=passes, kept=kept)
    plane = order_plane(xy, triangles, label)
    check_areas(plane, tile.area, areas_within(polygons, tile), polygons)
    return plane, complete


def tile_halo(tile_size: float, mesh_size: float, rule: SizeRule | None = None) -> float:
    """How far beyond a tile's lines buildings count for it and its seams, and terrain is sampled (m).

    The adaptive mesher looks at terrain `top_reach` farther. Where sizes are graded, buildings count as far as
    `sizes_halo`.
    """
    if rule is not None:
        return _strip_reach(tile_size, rule)
    widest = max(band_width(tile_size), corner_reach(tile_size)) + RING * mesh_size
    return max(widest, corner_sight(tile_size)) + mesh_size


def sizes_halo(tile_size: float, rule: SizeRule, *, around_walls: bool = True) -> float:
    """How far beyond a tile's lines walls count for the sizes in it and in the strips of its seams (m).

    Where sizes grow around the region, not around walls, finer ones may still do so around these.
    """
    return _strip_reach(tile_size, rule) + max(rule.reach if around_walls else 0.0, rule.wall_reach)


def areas_within(polygons: NDArray[np.object_], tile: shapely.Polygon) -> NDArray[np.float64]:
    """Area of each building's part in a tile (m2), float64 (b,); only those that its border meets are cut."""
    shapely.prepare(tile)
    area: NDArray[np.float64] = shapely.area(polygons)
    cut = np.flatnonzero(~shapely.contains_properly(tile, polygons))
    area[cut] = shapely.area(shapely.intersection(polygons[cut], tile))
    return area


def _strip_reach(tile_size: float, rule: SizeRule) -> float:
    """How far from a line strips and patches end (m)."""
    band = max(band_width(tile_size, rule.open_size), corner_reach(tile_size))
    widest = band + max(RING, PATCH) * rule.open_size + (LONGEST_PIECE + MARGIN) * rule.mesh_size
    return max(widest, corner_sight(tile_size) + rule.mesh_size)


def tile_ring(sides: Sides) -> NDArray[np.float64]:
    """Give the vertices of a tile's border counter-clockwise, float64 (k, 2) (m), each once."""
    south, east, north, west = (side.xy for side in sides)
    return np.concatenate((south[:-1], east[:-1], north[:0:-1], west[:0:-1]))


def _divide_chords(pieces: NDArray[np.float64], ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """Halve the pieces (p, 2, 2) that have both ends among the vertices of the ring, and are no edge of it."""
    places = np.ascontiguousarray(pieces.reshape(-1, 2)).view(np.complex128).reshape(-1, 2)
    vertices = np.ascontiguousarray(ring).view(np.complex128).ravel()
    order = np.argsort(vertices)
    row = order[np.searchsorted(vertices, places, sorter=order).clip(max=len(order) - 1)]
    on_ring = (vertices[row] == places).all(axis=1)
    apart = np.abs(row[:, 0] - row[:, 1])
    chord = on_ring & (apart > 1) & (apart < len(ring) - 1)
    middle = pieces[chord].mean(axis=1)
    halves = [np.stack((pieces[chord][:, k], middle), axis=1) for k in (0, 1)]
    return np.concatenate((pieces[~chord], *halves))


def _strip_vertices(
    sides: Sides,
    tile: shapely.Polygon,
    walls: NDArray[np.float64],
    mesh_size: float,
    sizes: SizeField | None,
) -> NDArray[np.float64]:
    """Vertices of the strips beside the seams, within the tile."""
    lines = shapely.linestrings(walls)
    wall_tree = shapely.STRtree(lines)
    chosen = [np.empty((0, 2))]
    for side in sides:
        xy = np.delete(side.ring.xy, side.vertex, axis=0)
        xy = xy[shapely.contains_xy(tile, xy[:, 0], xy[:, 1])]
        points, size = shapely.points(xy), local_sizes(sizes, xy, mesh_size=mesh_size)
        others = shapely.multilinestrings([shapely.LineString(other.xy) for other in sides if other is not side])
        clear = shapely.distance(others, points) > CLEAR_OF_SEAMS * size
        clear[wall_tree.query(points, predicate="dwithin", distance=CLEAR_OF_WALLS * size)[0]] = False
        earlier = shapely.STRtree(shapely.points(np.concatenate(chosen)))
        clear[earlier.query(points, predicate="dwithin", distance=CLEAR_OF_OTHERS * size)[0]] = False
        chosen.append(xy[clear])
    return np.concatenate(chosen)
