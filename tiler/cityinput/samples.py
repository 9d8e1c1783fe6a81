"""Points on the faces of city models: a grid over roofs and terrain, and the ground along outlines."""

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.kernel import kernel

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel
def _cross_row(xy: Array, ring_start: Index, rings: tuple[int, int], y: float, out: Array) -> int:
    """Where the edges of some rings cross a line of one northing; gives how many, in `out` ascending."""
    n = 0
    for r in range(rings[0], rings[1]):
        last = ring_start[r + 1] - 1
        for v in range(ring_start[r], ring_start[r + 1]):
            x0, y0, x1, y1 = xy[last, 0], xy[last, 1], xy[v, 0], xy[v, 1]
            if (y0 <= y) != (y1 <= y):
                x = x0 + (y - y0) / (y1 - y0) * (x1 - x0)
                k = n
                while k > 0 and out[k - 1] > x:
                    out[k] = out[k - 1]
                    k -= 1
                out[k] = x
                n += 1
            last = v
    return n


@kernel
def _find_nodes(xy: Array, ring_start: Index, face_start: Index, step: float) -> tuple[Index, Index]:
    """Nodes of the grid of a step within faces: the face of each, and its column and row."""
    face, node = np.empty(64, np.int64), np.empty((64, 2), np.int64)
    n = 0
    longest = 0
    for f in range(len(face_start) - 1):
        longest = max(longest, ring_start[face_start[f + 1]] - ring_start[face_start[f]])
    out = np.empty(longest + 1)
    for f in range(len(face_start) - 1):
        first, last = ring_start[face_start[f]], ring_start[face_start[f + 1]]
        low, high = math.inf, -math.inf
        for v in range(first, last):
            low, high = min(low, xy[v, 1]), max(high, xy[v, 1])
        if not low <= high:
            continue
        for j in range(math.ceil(low / step - 0.5), math.floor(high / step - 0.5) + 1):
            y = (j + 0.5) * step
            m = _cross_row(xy, ring_start, (face_start[f], face_start[f + 1]), y, out)
            for k in range(0, m - 1, 2):
                for i in range(math.ceil(out[k] / step - 0.5), math.floor(out[k + 1] / step - 0.5) + 1):
                    if n == len(face):
                        more, further = np.empty(2 * n, np.int64), np.empty((2 * n, 2), np.int64)
                        more[:n], further[:n] = face, node
                        face, node = more, further
                    face[n], node[n, 0], node[n, 1] = f, i, j
                    n += 1
    return face[:n].copy(), node[:n].copy()


def grid_faces(xy: Array, ring_start: Index, face_start: Index, step: float) -> tuple[Index, Index]:
    """Find the nodes of a grid within faces in plan: the face of each, int64 (k,), its column i and row j, (k, 2).

    Parameters
    ----------
    xy : float64, (n, 2)
        Vertices of all rings (m).
    ring_start, face_start : int64
        As of `Faces`; what lies within an odd number of rings of a face is inside.
    step : float
        Side of the grid (m): nodes are at ``(i + 0.5) * step``, ``(j + 0.5) * step``.

    Examples
    --------
    >>> square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
    >>> face, node = grid_faces(square, np.array([0, 4]), np.array([0, 1]), 1.0)
    >>> node.tolist()
    [[0, 0], [1, 0]]
    """
    return _find_nodes(np.ascontiguousarray(xy), ring_start, face_start, step)


def grid_polygons(polygons: NDArray[np.object_], step: float) -> tuple[Index, Index]:
    """Find the nodes of a grid within polygons or multipolygons: row of the polygon, and column and row."""
    parts, owner = shapely.get_parts(polygons, return_index=True)
    rings, part = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    ring_start = np.searchsorted(ring, np.arange(len(rings) + 1))
    face_start = np.searchsorted(owner[part], np.arange(len(polygons) + 1))
    return grid_faces(xy, ring_start, face_start, step)


def highest_nodes(owner: Index, node: Index, z: Array, mask: tuple[Index, Index]) -> Index:
    """Find the highest of all nodes at one place that a mask has, too, for their owner.

    `owner` (n,), `node` (n, 2) and `z` (n,) are owners, ascending, columns and rows, and heights (m) of nodes;
    `mask` has owners and nodes of places that count. Gives the rows of the nodes, by row and column.
    """
    if not len(owner) or not len(mask[0]):
        return np.empty(0, np.int64)
    # Column by column: numpy reduces rows of two slowly.
    (i, j), (mask_i, mask_j) = node.T, mask[1].T
    left, below = min(i.min(), mask_i.min()), min(j.min(), mask_j.min())
    width = max(i.max(), mask_i.max()) - left + 1
    places = width * (max(j.max(), mask_j.max()) - below + 1)
    key = (j - below) * width + i - left
    allowed = np.sort(mask[0] * places + (mask_j - below) * width + mask_i - left, kind="stable")
    wanted = owner * places + key
    inside = np.flatnonzero(allowed[np.minimum(np.searchsorted(allowed, wanted), len(allowed) - 1)] == wanted)
    order = inside[np.argsort(key[inside], kind="stable")]  # of long runs, which a stable sort merges
    if not len(order):
        return order
    key, height = key[order], z[order]
    start = np.flatnonzero(np.diff(key, prepend=key[0] - 1))
    top = np.repeat(np.maximum.reduceat(height, start), np.diff(start, append=len(key)))
    found: Index = order[np.maximum.reduceat(np.where(height == top, np.arange(len(key)), 0), start)]
    return found


def along_outlines(polygons: NDArray[np.object_], step: float) -> tuple[Array, Index]:
    """Places along outlines at most a step apart (m), float64 (k, 2), and the row of each."""
    xy, row = shapely.get_coordinates(shapely.segmentize(polygons, step), return_index=True)
    return xy, row
