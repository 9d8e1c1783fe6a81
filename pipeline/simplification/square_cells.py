"""The last resort for walls that do not settle: houses made of square cells (step 2.1, our way)."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.simplification.graph import Faces, WallGraph, make_graph, trace_faces
from pipeline.simplification.labels import BUILT_SHARE, OPEN, Territories
from pipeline.simplification.snap import straighten


def draw_cells(territories: Territories, cluster: int, size: float) -> tuple[WallGraph, Faces, NDArray[np.int64]]:
    """Draw one cluster's houses with the cells of a square grid.

    Parameters
    ----------
    territories : Territories
        Who has what.
    cluster : int
        The cluster to draw.
    size : float
        Side of a cell (mm, whole); cell corners are at multiples of it.

    Returns
    -------
    graph : WallGraph
        The sides of cells between different houses, and between houses and open ground, made straight.
    faces : Faces
        Its faces.
    label : int64, (f,)
        House of each face, or `OPEN`.

    Notes
    -----
    A cell is the house's that covers most of it, and open where less than `BUILT_SHARE` is covered. Where
    cells of houses meet in a corner only, one of the two open cells there is built too, until none is left, so
    no corner touches. Vertices are `size` apart at least, and so are vertices and foreign walls, whatever the
    houses are: this cannot fail. Cost: one overlay for each cell that a house's box holds.
    """
    mine = territories.cluster == cluster
    polygons, house = territories.polygons[mine], territories.house[mine]
    if not len(polygons):
        nothing = np.zeros(0, np.int64)
        graph = make_graph(np.zeros((0, 2)), nothing, nothing.reshape(0, 2), np.zeros(0))
        return graph, trace_faces(graph), nothing
    bounds = shapely.bounds(polygons)
    # One ring of open cells around all.
    low = np.floor(bounds[:, :2].min(axis=0) / size).astype(np.int64) - 1
    high = np.ceil(bounds[:, 2:].max(axis=0) / size).astype(np.int64) + 1
    label = _fill_corners(_label_cells(polygons, house, low, high - low, size))
    graph, _ = straighten(_trace_cells(label, low, size, cluster), 0.0)
    faces = trace_faces(graph)
    inside = shapely.get_coordinates(shapely.point_on_surface(faces.polygons))
    i, j = (np.floor(inside / size).astype(np.int64) - low).T
    return graph, faces, label[i, j]


def _label_cells(
    polygons: NDArray[np.object_],
    house: NDArray[np.int64],
    low: NDArray[np.int64],
    shape: NDArray[np.int64],
    size: float,
) -> NDArray[np.int64]:
    label = np.full(shape, OPEN)
    best, total = np.zeros(shape), np.zeros(shape)
    for name in np.unique(house):
        pieces = polygons[house == name]
        box = shapely.total_bounds(pieces)
        start = np.floor(box[:2] / size).astype(np.int64)
        stop = np.ceil(box[2:] / size).astype(np.int64)
        i, j = (axis.reshape(-1) for axis in np.mgrid[start[0] : stop[0], start[1] : stop[1]])
        squares = shapely.box(i * size, j * size, (i + 1) * size, (j + 1) * size)
        piece, square = shapely.STRtree(squares).query(pieces, predicate="intersects")
        order = np.lexsort((piece, square))
        piece, square = piece[order], square[order]
        covered = shapely.area(shapely.intersection(squares[square], pieces[piece]))
        area = np.bincount(square, covered, len(squares))
        at = (i - low[0], j - low[1])
        total[at] += area
        label[at] = np.where(area > best[at], name, label[at])
        best[at] = np.maximum(area, best[at])
    label[total < BUILT_SHARE * size**2] = OPEN
    return label


def _fill_corners(label: NDArray[np.int64]) -> NDArray[np.int64]:
    """Build open cells until no two built ones meet in a corner only: the one at smaller x, the house beside."""
    while True:
        built = label != OPEN
        a, b, c, d = built[:-1, :-1], built[:-1, 1:], built[1:, :-1], built[1:, 1:]
        rising, falling = a & d & ~b & ~c, b & c & ~a & ~d
        if not (rising | falling).any():
            return label
        label = label.copy()
        i, j = np.nonzero(rising)
        label[i, j + 1] = label[i, j]
        i, j = np.nonzero(falling)
        label[i, j] = label[i, j + 1]


def _trace_cells(label: NDArray[np.int64], low: NDArray[np.int64], size: float, cluster: int) -> WallGraph:
    """Take the sides between cells of different labels; the outer ring is open, so none is at the border."""
    i, j = np.nonzero(label[1:] != label[:-1])
    upright = np.column_stack((i + 1, j, i + 1, j + 1))
    i, j = np.nonzero(label[:, 1:] != label[:, :-1])
    level = np.column_stack((i, j + 1, i + 1, j + 1))
    xy = ((np.concatenate((upright, level)).reshape(-1, 2) + low) * size).astype(np.float64)
    edges = np.arange(len(xy)).reshape(-1, 2)
    return make_graph(xy, np.full(len(xy), cluster), edges, np.zeros(len(edges)))
