"""Streets where no file has them: the medial axis of the open space between blocks of buildings."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.generalisation.barriers import order_ends

SPACING = 3.0  # m, of points along outlines
FAR = 20.0  # sides of the box: where four points stand that close the diagram
SMOOTH = 1.0  # m; steps of the axis below the size of the points' spacing are smoothed by this

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def find_close_pairs(own: NDArray[np.object_], near: NDArray[np.object_], distance: float) -> Index:
    """List pairs of buildings that are no farther from each other than a street is wide.

    Parameters
    ----------
    own, near : object, (n,), (m,)
        Outlines (m).
    distance : float
        Greatest distance of a pair (m).

    Returns
    -------
    int64, (p, 2)
        Rows of `own` and of `near`.
    """
    if not len(own) or not len(near):
        return np.empty((0, 2), np.int64)
    pairs: Index = shapely.STRtree(near).query(own, "dwithin", distance).T
    return pairs


def find_street_axis(outlines: NDArray[np.object_], block: Index, box: tuple[float, float, float, float]) -> Array:
    """Give the edges of the Voronoi diagram of points along outlines that part two blocks.

    Parameters
    ----------
    outlines : object, (n,)
        Buildings in and around a box (m).
    block : int64, (n,)
        Name of the block of each: buildings closer than a street.
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax (m).

    Returns
    -------
    float64, (k, 4)
        Segments as of `order_ends`, cut at the box. No edge lies between two points of one block, so the branches
        of the medial axis that end in courtyards and passages are not there.

    References
    ----------
    J. W. Brandt, V. R. Algazi: Continuous skeleton computation by Voronoi diagram, CVGIP: Image Understanding 55,
    1992.
    """
    from scipy.spatial import Voronoi

    if len(np.unique(block)) < 2:
        return np.empty((0, 4))
    names, row = np.unique(block, return_inverse=True)
    order = np.argsort(row.ravel(), kind="stable")
    groups = np.split(outlines[order], np.cumsum(np.bincount(row.ravel()))[:-1])
    blocks = np.array([shapely.union_all(each) for each in groups])  # points of party walls would part nothing
    places, owner = shapely.get_coordinates(shapely.segmentize(blocks, SPACING), return_index=True)
    places, first = np.unique(np.round(places, 3), axis=0, return_index=True)
    name = np.concatenate([names[owner[first]], np.full(4, -1)])
    low, high = np.array(box[:2]), np.array(box[2:])
    middle, size = (low + high) / 2, FAR * (high - low).max()
    corners = middle + size * np.array([[-1.0, 0], [1, 0], [0, -1], [0, 1]])
    found = Voronoi(np.concatenate((places, corners)) - middle)
    side = name[found.ridge_points]
    ends = np.array(found.ridge_vertices, np.int64)
    kept = (side[:, 0] != side[:, 1]) & (side >= 0).all(axis=1) & (ends >= 0).all(axis=1)
    corner = found.vertices[ends[kept]] + middle
    near = (corner.min(axis=1) <= high).all(axis=1) & (corner.max(axis=1) >= low).all(axis=1)
    lines = shapely.clip_by_rect(shapely.linestrings(corner[near]), *box)
    lines = shapely.get_parts(lines)
    lines = lines[(shapely.get_type_id(lines) == shapely.GeometryType.LINESTRING) & ~shapely.is_empty(lines)]
    return order_ends(np.round(shapely.get_coordinates(lines).reshape(-1, 4), 3))


def smooth_pieces(pieces: NDArray[np.object_]) -> NDArray[np.object_]:
    """Smooth the borders that pieces of a tile share; the border of the tile stays."""
    if not len(pieces):
        return pieces
    smoothed: NDArray[np.object_] = shapely.coverage_simplify(pieces, SMOOTH, simplify_boundary=False)
    return smoothed
