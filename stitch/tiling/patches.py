"""The patch around a corner: the triangles that the layers of its column are found in (before step 3.5, ours)."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.mesh import PlaneMesh
from pipeline.plane_mesh.plane import collect_graph, order_plane, ring_edges, triangulate_plane
from pipeline.plane_mesh.sizes import SizeField, local_sizes
from stitch.tiling.corners import Corner
from stitch.tiling.grid import Bounds
from stitch.tiling.strips import MARGIN, label_triangles
from stitch.tiling.walls import LONGEST_PIECE, walls_within

PATCH = 2.0  # mesh sizes; how far around a corner its column sees houses


def mesh_patch(
    corner: Corner,
    polygons: NDArray[np.object_],
    walls: NDArray[np.float64],
    bounds: Bounds,
    *,
    mesh_size: float,
    min_angle: float,
    sizes: SizeField | None = None,
) -> PlaneMesh:
    """Triangulate the surroundings of a corner.

    Parameters
    ----------
    corner : Corner
        A corner of two tiles or more.
    polygons : object, (b,)
        Footprints, at least those closer than `PATCH` mesh sizes in x and in y.
    walls : float64, (w, 2, 2)
        Their walls in pieces (`cut_walls`).
    bounds : (xmin, ymin, xmax, ymax)
        The region (m).
    mesh_size : float
        Target edge length h (m).
    min_angle : float
        Bound on the angles (degrees).
    sizes : SizeField, optional
        Target edge lengths that are not the same everywhere; the corner's own then is its mesh size here.

    Returns
    -------
    PlaneMesh
        Triangles whose centres are in a square around the corner, with the corner as a vertex and the first edges
        of its seams within the region as edges.

    Raises
    ------
    GeometryError
        As from `triangulate_plane`.

    Notes
    -----
    As in a strip, pieces of wall that meet the square are taken whole, and what lies beyond makes no difference.
    """
    size = float(local_sizes(sizes, corner.xy[None], mesh_size=mesh_size)[0])
    core = _square(corner.xy, PATCH * size, bounds)
    outer = _square(corner.xy, PATCH * size + (LONGEST_PIECE + MARGIN) * mesh_size, bounds)
    outline = ring_edges(shapely.get_rings(shapely.box(*outer)))
    edges = np.concatenate((outline, walls_within(walls, shapely.box(*core)), _first_edges(corner, bounds)))
    xy, triangles, _, _ = triangulate_plane(
        collect_graph(edges, np.empty((0, 2))), max_area=mesh_size**2 / 2, min_angle=min_angle, sizes=sizes
    )
    centre = xy[triangles].mean(axis=1)
    triangles = triangles[((centre >= core[:2]) & (centre <= core[2:])).all(axis=1)]
    return order_plane(xy, triangles, label_triangles(xy, triangles, polygons))


def _square(xy: NDArray[np.float64], half: float, bounds: Bounds) -> Bounds:
    low, high = np.maximum(xy - half, bounds[:2]), np.minimum(xy + half, bounds[2:])
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _first_edges(corner: Corner, bounds: Bounds) -> NDArray[np.float64]:
    """First edges of the corner's seams, without those on the region's border."""
    tips = corner.tips[~np.isnan(corner.tips[:, 0])]
    on_side = (((tips == bounds[:2]) | (tips == bounds[2:])) & (tips == corner.xy)).any(axis=1)
    tips = tips[~on_side]
    return np.stack((np.broadcast_to(corner.xy, tips.shape), tips), axis=1)
