"""Lines that part cells, as straight segments on a grid of millimetres, cut where they cross borders of tiles."""

import numpy as np
import shapely
from numpy.typing import NDArray

GRID = 0.001  # m; coordinates of barriers and cells are whole multiples of it

Array = NDArray[np.float64]


def explode_lines(lines: NDArray[np.object_]) -> Array:
    """Give the straight segments of lines, or of the borders of polygons.

    Parameters
    ----------
    lines : object, (n,)
        shapely geometries (m); points have no segments.

    Returns
    -------
    float64, (k, 4)
        x, y of the lesser end, then x, y of the other one (m), on `GRID`; none of length 0.
    """
    parts = shapely.get_parts(lines)
    areas = np.isin(shapely.get_type_id(parts), (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON))
    rings = shapely.get_rings(shapely.get_parts(parts[areas]))
    parts = np.concatenate([parts[~areas], rings])
    parts = parts[shapely.get_dimensions(parts) == 1]
    xy, owner = shapely.get_coordinates(parts, return_index=True)
    if not len(xy):
        return np.empty((0, 4))
    xy = np.round(xy, 3)
    inner = np.flatnonzero(owner[1:] == owner[:-1])
    return order_ends(np.hstack((xy[inner], xy[inner + 1])))


def order_ends(segments: Array) -> Array:
    """Turn segments, float64 (k, 4), the lesser end (x, then y) first; those of length 0 are gone."""
    x1, y1, x2, y2 = segments.T
    turned = np.where(((x1 > x2) | ((x1 == x2) & (y1 > y2)))[:, None], segments[:, [2, 3, 0, 1]], segments)
    kept: Array = turned[(turned[:, :2] != turned[:, 2:]).any(axis=1)]
    return kept


def split_at_grid(segments: Array, step: float) -> Array:
    """Cut segments where they cross lines of a grid, at places that depend on the segment alone.

    Parameters
    ----------
    segments : float64, (k, 4)
        As from `explode_lines`.
    step : float
        Spacing of the grid, whose lines pass through multiples of it (m).

    Returns
    -------
    float64, (m, 4)
        Each within one square of the grid, or on its border.

    Examples
    --------
    >>> split_at_grid(np.array([[0.0, 0, 15, 3]]), 10.0).tolist()
    [[0.0, 0.0, 10.0, 2.0], [10.0, 2.0, 15.0, 3.0]]
    """
    done = segments
    for axis in (0, 1):
        ends = done[:, [axis, axis + 2]]
        line = (np.floor(ends.min(axis=1) / step) + 1) * step
        while (cut := line < ends.max(axis=1)).any():
            whole, at = done[cut], line[cut]
            share = (at - whole[:, axis]) / (whole[:, axis + 2] - whole[:, axis])
            place = np.round(whole[:, :2] + share[:, None] * (whole[:, 2:] - whole[:, :2]), 3)
            place[:, axis] = at
            done = np.concatenate((done[~cut], np.hstack((whole[:, :2], place)), np.hstack((place, whole[:, 2:]))))
            ends = done[:, [axis, axis + 2]]
            line = (np.floor(ends.min(axis=1) / step) + 1) * step
    return order_ends(done)


def deal_segments(segments: Array, step: float) -> dict[tuple[int, int], Array]:
    """Deal segments of `split_at_grid` out to the squares that they lie in; on a border to both.

    Returns
    -------
    dict
        Segments of each square, by its column and row.
    """
    middle = (segments[:, :2] + segments[:, 2:]) / 2
    square = np.floor(middle / step).astype(np.int64)
    on_line = (segments[:, :2] == segments[:, 2:]) & (segments[:, :2] % step == 0)
    rows = [(square, np.arange(len(square)))]
    for axis in (0, 1):
        also = np.flatnonzero(on_line[:, axis])
        before = square[also].copy()
        before[:, axis] -= 1
        rows.append((before, also))
    squares, number = (np.concatenate(part) for part in zip(*rows, strict=True))
    order = np.lexsort((number, squares[:, 1], squares[:, 0]))
    squares, number = squares[order], number[order]
    starts = np.flatnonzero(np.diff(squares, axis=0, prepend=squares[:1] - 1).any(axis=1))
    groups = np.split(number, starts[1:]) if len(starts) else []
    return {(int(i), int(j)): segments[rows] for (i, j), rows in zip(squares[starts], groups, strict=True)}
