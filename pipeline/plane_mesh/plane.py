"""Step 3.1: the 2D mesh of the region with the walls as edges. The one place that knows Triangle."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import triangle
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.data.mesh import PlaneMesh
from pipeline.plane_mesh.edges import sort_triangles
from pipeline.plane_mesh.improve_plane import improve_plane
from pipeline.plane_mesh.sizes import SizeField, local_sizes

MIN_ANGLE = 25.0  # degrees; Triangle's quality bound (paper, step 3.1; higher may not terminate)
STEINER_FACTOR = 40  # Steiner points allowed for each expected vertex before Triangle is stopped
CLEAR_OF_GRAPH = 0.6  # local sizes; vertices on open ground are that far from walls and given vertices
AREA_TOLERANCE = 1e-6  # relative; triangles of a building against its footprint


@dataclass(frozen=True, eq=False)
class PlaneGraph:
    """Planar straight-line graph: what the 2D mesher has to respect."""

    xy: NDArray[np.float64]  #: (n, 2): vertices (m), no two alike
    segments: NDArray[np.int32]  #: (s, 2): edges of the region's border and of all walls, each once
    seeds: NDArray[np.float64]  #: (b, 2): a place in each building, which labels the triangles around it


def plane_graph(bounds: tuple[float, float, float, float], polygons: NDArray[np.object_]) -> PlaneGraph:
    """Collect the border of the region and all walls as a planar straight-line graph.

    Parameters
    ----------
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    polygons : object, (b,)
        Footprints strictly inside the region that do not cross each other; they may share vertices and
        walls.
    """
    border = ring_edges(shapely.get_rings(np.array([shapely.box(*bounds)])))
    walls = ring_edges(shapely.get_rings(polygons))
    seeds = shapely.get_coordinates(shapely.point_on_surface(polygons))
    return collect_graph(np.concatenate((border, walls)), seeds)


def ring_edges(rings: NDArray[np.object_]) -> NDArray[np.float64]:
    """Give the edges of closed rings, float64 (s, 2, 2): their start and end (m)."""
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    start = np.flatnonzero(np.diff(ring, append=-1) == 0)
    return np.stack((xy[start], xy[start + 1]), axis=1)


def collect_graph(edges: NDArray[np.float64], seeds: NDArray[np.float64]) -> PlaneGraph:
    """Number the ends of edges, which meet in their ends only.

    Parameters
    ----------
    edges : float64, (s, 2, 2)
        Start and end of each (m); those that repeat, in either direction, count once.
    seeds : float64, (b, 2)
        As in `PlaneGraph`.

    Returns
    -------
    PlaneGraph
        Vertices sorted by (x, y) and segments by their vertices: the same for edges in any order.
    """
    # Complex numbers compare as (x, y) do.
    unique, index = np.unique(np.ascontiguousarray(edges).view(np.complex128), return_inverse=True)
    segments = np.sort(index.reshape(-1, 2), axis=1)
    key = np.unique(segments[:, 0] * len(unique) + segments[:, 1])
    ends = np.column_stack((key // len(unique), key % len(unique)))
    return PlaneGraph(unique.view(np.float64).reshape(-1, 2), ends.astype(np.int32), seeds)


def triangulate_plane(
    graph: PlaneGraph,
    *,
    max_area: float,
    min_angle: float = MIN_ANGLE,
    refinements: int = 0,
    frozen: bool = False,
    sizes: SizeField | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32], bool]:
    """Triangulate a planar straight-line graph with bounds on area and angle.

    This function is all that the rest knows of the 2D mesher: another one takes Triangle's place here.

    Parameters
    ----------
    graph : PlaneGraph
        Edges to respect.
    max_area : float
        Largest triangle (m2).
    min_angle : float
        Smallest angle (degrees), but at corners of the input that are sharper.
    refinements : int
        Further runs of Triangle on its own result. The first run leaves an angle in some ten thousand below
        the bound, one more none; a third makes tiny edges at sharp corners of walls.
    frozen : bool
        Keep the outer border as it is: no vertex is added to it.
    sizes : SizeField, optional
        Target edge lengths h that are not the same everywhere, instead of `max_area`: triangles are about
        h**2 / 2 at most, with h that in their middle.

    Returns
    -------
    xy : float64, (n, 2)
        Vertices (m); those of the graph come first, bit for bit.
    triangles : int32, (m, 3)
        Vertex indices, counter-clockwise.
    label : int32, (m,)
        The seed that the triangle's area holds, -1 where none.
    complete : bool
        False if the limit on added vertices stopped the refinement.

    Raises
    ------
    GeometryError
        If Triangle cannot make sense of the graph.

    Notes
    -----
    Graded sizes come from vertices on open ground that Triangle is given beside the graph: those of a mesh of
    the graph's box, in which it finds the sizes round by round, as a triangle inherits the bound on its area from
    the one that it comes of. Refining the mesh of the graph itself in as many rounds makes edges of 0.05 m at
    sharp corners.
    """
    # Near the origin the predicates keep all their digits.
    origin = np.floor(graph.xy.min(axis=0))
    local = graph.xy - origin
    largest, smallest = max_area, max_area
    if sizes is not None:
        largest, smallest = sizes.rule.open_size**2 / 2, sizes.smallest**2 / 2
        local = np.concatenate((local, _open_vertices(local, graph.segments, origin, sizes)))
    width, height = local.max(axis=0)
    limit = STEINER_FACTOR * int(len(local) + width * height / smallest + 100)
    data = {"vertices": local, "segments": graph.segments}
    if len(graph.seeds):
        # Labels count from 1: Triangle gives 0 to what no seed reaches.
        number = np.arange(1.0, len(graph.seeds) + 1)
        data["regions"] = np.column_stack((graph.seeds - origin, number, np.zeros(len(number))))
    try:
        quality, end = f"q{min_angle:g}", "Y" * frozen + f"S{limit}"
        out = triangle.triangulate(data, f"p{quality}a{largest:.12g}A{end}")
        for _ in range(refinements):
            if sizes is None:
                out = triangle.triangulate(_kept(out), f"rp{quality}a{largest:.12g}{end}")
            else:
                out = triangle.triangulate(_kept(out) | _area_bounds(out, origin, sizes), f"rp{quality}a{end}")
        triangles = out["triangles"].astype(np.int32)
    except (RuntimeError, KeyError, ValueError) as error:
        place = ", ".join(f"{value:.1f}" for value in graph.xy.mean(axis=0))
        raise GeometryError(
            f"plane mesh around ({place}), step 3.1: the 2D mesher failed on {len(local)} vertices and "
            f"{len(graph.segments)} segments ({error}); raise --clearance or mend the footprints there"
        ) from error
    xy = out["vertices"] + origin
    xy[: len(graph.xy)] = graph.xy
    label = np.full(len(triangles), -1, np.int32)
    if len(graph.seeds):
        label = np.rint(out["triangle_attributes"][:, 0]).astype(np.int32) - 1
    return xy, triangles, label, len(xy) - len(local) < limit


def _kept(out: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """What Triangle needs of its own result to refine it."""
    kept = ("vertices", "triangles", "segments", "triangle_attributes")
    return {name: out[name] for name in kept if name in out}


def _area_bounds(
    out: dict[str, NDArray[Any]], origin: NDArray[np.float64], sizes: SizeField
) -> dict[str, NDArray[np.float64]]:
    """Bound on the area of each triangle of Triangle's result (m2), which what comes of it inherits."""
    middle = out["vertices"][out["triangles"]].mean(axis=1) + origin
    size = local_sizes(sizes, middle, mesh_size=sizes.rule.mesh_size)
    return {"triangle_max_area": size[:, None] ** 2 / 2}


def _open_vertices(
    local: NDArray[np.float64], segments: NDArray[np.int32], origin: NDArray[np.float64], sizes: SizeField
) -> NDArray[np.float64]:
    """Vertices of a mesh of the graph's box in these sizes, but for those close to the graph."""
    low, high = local.min(axis=0), local.max(axis=0)
    box = ring_edges(shapely.get_rings(np.array([shapely.box(*low, *high)])))[:, 0]
    sides = {"vertices": box, "segments": np.array([[0, 1], [1, 2], [2, 3], [3, 0]])}
    out = triangle.triangulate(sides, f"pq{MIN_ANGLE:g}a{sizes.rule.open_size**2 / 2:.12g}")
    for _ in range(math.ceil(math.log2(sizes.rule.open_size / sizes.smallest)) + 1):
        a, b, c = (out["vertices"][out["triangles"][:, k]] for k in range(3))
        u, v = b - a, c - a
        quarter = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])[:, None] / 8
        bounds = _area_bounds(out, origin, sizes)["triangle_max_area"]
        out = triangle.triangulate(
            _kept(out) | {"triangle_max_area": np.maximum(bounds, quarter)}, f"rpq{MIN_ANGLE:g}a"
        )
    xy: NDArray[np.float64] = out["vertices"]
    size = local_sizes(sizes, xy + origin, mesh_size=sizes.rule.mesh_size)
    alone = np.setdiff1d(np.arange(len(local)), segments)
    graph = np.concatenate((shapely.linestrings(local[segments]), shapely.points(local[alone])))
    near, _ = shapely.STRtree(graph).query(shapely.points(xy), predicate="dwithin", distance=CLEAR_OF_GRAPH * size)
    return np.delete(xy, near, axis=0)


def mesh_plane(
    bounds: tuple[float, float, float, float],
    polygons: NDArray[np.object_],
    *,
    mesh_size: float,
    min_angle: float = MIN_ANGLE,
    refinements: int = 0,
    passes: int = 0,
    sizes: SizeField | None = None,
) -> tuple[PlaneMesh, bool]:
    """Mesh the region with all walls as edges (paper, step 3.1).

    Parameters
    ----------
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    polygons : object, (b,)
        Footprints as in `plane_graph`.
    mesh_size : float
        Target edge length h (m); no triangle is larger than h**2 / 2.
    min_angle : float
        Bound on the angles (degrees).
    refinements : int
        Further runs of Triangle, as in `triangulate_plane`.
    passes : int
        Rounds of `improve_plane`. With any, a triangle may be larger than the bound.
    sizes : SizeField, optional
        As in `triangulate_plane`.

    Returns
    -------
    PlaneMesh
        Vertices sorted by (x, y), triangles by their vertices.
    bool
        False if refinement was stopped by the limit on added vertices.

    Raises
    ------
    GeometryError
        If the triangles of a building do not cover its footprint.
    """
    graph = plane_graph(bounds, polygons)
    xy, triangles, label, complete = triangulate_plane(
        graph, max_area=mesh_size**2 / 2, min_angle=min_angle, refinements=refinements, sizes=sizes
    )
    size = local_sizes(sizes, xy, mesh_size=mesh_size)
    xy, triangles = improve_plane(xy, triangles, label, mesh_size=size, passes=passes)
    plane = order_plane(xy, triangles, label)
    check_areas(plane, float(shapely.box(*bounds).area), shapely.area(polygons), polygons)
    return plane, complete


def order_plane(xy: NDArray[np.float64], triangles: NDArray[np.int32], label: NDArray[np.int32]) -> PlaneMesh:
    """Sort vertices by (x, y) and triangles by their vertices; vertices that no triangle has are gone."""
    used = np.flatnonzero(np.bincount(triangles.ravel(), minlength=len(xy)))
    order = used[np.lexsort((xy[used, 1], xy[used, 0]))]
    rank = np.empty(len(xy), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    sorted_triangles = np.sort(rank[triangles], axis=1)
    rows = sort_triangles(sorted_triangles)
    return PlaneMesh(xy[order], sorted_triangles[rows], label[rows])


def signed_areas(plane: PlaneMesh) -> NDArray[np.float64]:
    """Area of each triangle (m2), negative where its ascending vertices run clockwise."""
    a, b, c = (plane.xy[plane.triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    area: NDArray[np.float64] = 0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    return area


def check_areas(plane: PlaneMesh, whole: float, built: NDArray[np.float64], polygons: NDArray[np.object_]) -> None:
    """Refuse a mesh that does not cover its region, or a building.

    Parameters
    ----------
    plane : PlaneMesh
        The mesh.
    whole : float
        Area of the region (m2).
    built : float64, (b,)
        Area of each building within it (m2).
    polygons : object, (b,)
        The buildings, whose size is what the tolerance is relative to.

    Raises
    ------
    GeometryError
        With the building that is worst, and its areas.
    """
    area = np.abs(signed_areas(plane))
    if area.min() <= 0 or abs(area.sum() - whole) > AREA_TOLERANCE * whole:
        raise GeometryError(
            f"plane mesh, step 3.1: triangles cover {area.sum():.6f} m2 of {whole:.6f} m2, the smallest has "
            f"{area.min():.3g} m2; raise --clearance"
        )
    if len(polygons) == 0:
        return
    inside = plane.building >= 0
    covered = np.bincount(plane.building[inside], area[inside], len(polygons))
    error = np.abs(covered - built) / shapely.area(polygons)
    worst = int(np.argmax(error))
    if error[worst] > AREA_TOLERANCE:
        x, y = graph_place(polygons[worst])
        raise GeometryError(
            f"plane mesh, step 3.1: building at ({x:.1f}, {y:.1f}) has {built[worst]:.3f} m2, its triangles "
            f"cover {covered[worst]:.3f} m2; its walls cross a neighbour's: raise --clearance"
        )


def graph_place(polygon: shapely.Polygon) -> tuple[float, float]:
    """Return a place in the polygon for a message."""
    point = polygon.representative_point()
    return float(point.x), float(point.y)
