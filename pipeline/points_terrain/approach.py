"""Ground of a margin around a region: it goes on from the region's border and flattens outwards (step 1.3, ours).

Profiles of the wind at an inlet hold over level ground (Richards and Hoxey, *Appropriate boundary conditions for
computational wind engineering models using the k-epsilon turbulence model*, J. Wind Eng. Ind. Aerodyn. 46-47
(1993), 145-153), so all outer sides have one height: the mean of the terrain along the region's border, the rim.

At distance d from the region the ground is ``rim + (1 - s(u)) (1 - s(v)) (mean - rim)``: u and v are the shares
of the margin's width that lie between the place and the region along x and y, ``s(t) = t^2 (3 - 2 t)``, and
``mean`` is that of the border within d to both sides of the closest place on it, along the border. So kerbs and
ditches end within a few metres, and hills go on about as far as they are wide.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.points_terrain.raster import Dtm, NodeWindow

BLOCK = 256  # rows of nodes at a time


@dataclass(frozen=True, eq=False)
class Border:
    """Terrain along the border of a region."""

    #: (n,): height (m) of the outermost nodes of its raster, counter-clockwise from the lower left one
    z: NDArray[np.float64]
    rim: float  #: height at the outer sides of the margin (m)
    window: NodeWindow  #: nodes of the region


def border_nodes(window: NodeWindow) -> NDArray[np.int64]:
    """List the outermost nodes of a window of at least 2 x 2, counter-clockwise from the lower left: (n, 2).

    Examples
    --------
    >>> border_nodes(NodeWindow(7, 0, 3, 2)).tolist()
    [[7, 0], [8, 0], [9, 0], [9, 1], [8, 1], [7, 1]]
    """
    nx, ny = window.nx - 1, window.ny - 1
    i = np.concatenate((np.arange(nx), np.full(ny, nx), np.arange(nx, 0, -1), np.zeros(ny, np.int64)))
    j = np.concatenate((np.zeros(nx, np.int64), np.arange(ny), np.full(nx, ny), np.arange(ny, 0, -1)))
    return np.column_stack((i + window.i0, j + window.j0))


def make_border(z: NDArray[np.float64], window: NodeWindow) -> Border:
    """Find the height of the rim, and fill in the heights of the border that are not known.

    Parameters
    ----------
    z : float64, (n,)
        Heights (m) of `border_nodes`, NaN where there is no terrain.
    window : NodeWindow
        Nodes of the region.

    Raises
    ------
    InputError
        If none is known.

    Notes
    -----
    The rim is the mean of those that are known, by a sum without rounding; between known ones heights run straight
    along the border, around its end too.

    Examples
    --------
    >>> border = make_border(np.array([4.0, np.nan, 6.0, np.nan]), NodeWindow(0, 0, 2, 2))
    >>> border.z, border.rim
    (array([4., 5., 6., 5.]), 5.0)
    """
    known = np.flatnonzero(~np.isnan(z))
    if len(known) == 0:
        raise InputError(
            "no terrain along the border of the region, so its pad has nothing to go on from; give --bounds "
            "within the point clouds, or no --pad"
        )
    filled = np.interp(np.arange(len(z)), known, z[known], period=len(z))
    filled[known] = z[known]
    return Border(filled, math.fsum(z[known].tolist()) / len(known), window)


def approach_terrain(border: Border, nodes: NodeWindow, outer: NodeWindow, *, spacing: float) -> Dtm:
    """Compute the ground of a margin at some nodes.

    Parameters
    ----------
    border : Border
        Terrain along the region's border.
    nodes : NodeWindow
        Nodes to return.
    outer : NodeWindow
        Nodes of region and margin, up to the first ones on or beyond its sides. The outermost two on every side
        that has a margin are at the height of the rim, so that what lies between them is.
    spacing : float
        Distance between nodes (m).

    Returns
    -------
    Dtm
        NaN within the region, but for the nodes of its border.

    Notes
    -----
    A height depends on the node, the border and the widths alone: tiles that compute a node find the same bits.
    The cost is that of two look-ups in the running sum along the border for each node.

    Examples
    --------
    >>> border = make_border(np.array([9.0, 9.0, 1.0, 1.0]), NodeWindow(10, 0, 2, 2))
    >>> approach_terrain(border, NodeWindow(6, 0, 5, 1), NodeWindow(6, 0, 6, 2), spacing=1.0).z.round(2)
    array([[5.  , 5.  , 5.  , 6.48, 7.  ]])
    """
    height = np.concatenate(([0.0], np.cumsum((_next(border.z) + border.z) / 2 - border.rim)))
    i = np.arange(nodes.i0, nodes.i0 + nodes.nx)
    z = np.empty((nodes.ny, nodes.nx))
    for first in range(0, nodes.ny, BLOCK):
        j = np.arange(nodes.j0 + first, nodes.j0 + min(first + BLOCK, nodes.ny))
        z[first : first + len(j)] = _block(border, height, i, j[:, None], outer)
    return Dtm(z, nodes.i0, nodes.j0, spacing)


def _block(
    border: Border,
    running: NDArray[np.float64],
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    outer: NodeWindow,
) -> NDArray[np.float64]:
    """Heights at the nodes of some columns and rows."""
    inner = border.window
    x, u = _across(i, inner.i0, inner.nx, outer.i0, outer.nx)
    y, v = _across(j, inner.j0, inner.ny, outer.j0, outer.ny)
    far = np.hypot(i - inner.i0 - x, j - inner.j0 - y)
    n = len(border.z)
    reach = np.clip(far, 0.5, n / 2)
    place = _along(x, y, inner.nx - 1, inner.ny - 1)
    mean = (_running(running, place + reach) - _running(running, place - reach)) / (2 * reach)
    z = border.rim + (1 - _smooth(u)) * (1 - _smooth(v)) * mean
    inside = (x > 0) & (x < inner.nx - 1) & (y > 0) & (y < inner.ny - 1)
    return np.where(inside, np.nan, z)


def _across(
    at: NDArray[np.int64], first: int, n: int, outer_first: int, outer_n: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Closest column within the region, counted from its first; and the share of the margin on the way to it."""
    inside = np.clip(at - first, 0, n - 1)
    below = max(first - (outer_first + 1), 1)
    above = max(outer_first + outer_n - 2 - (first + n - 1), 1)
    off = at - first - inside
    return inside, np.minimum(np.maximum(-off / below, off / above), 1.0)


def _along(x: NDArray[np.int64], y: NDArray[np.int64], nx: int, ny: int) -> NDArray[np.int64]:
    """Number of a node of the border in the order of `border_nodes`; anything for others."""
    low_right = np.where(y == 0, x, nx + y)
    high_left = np.where(y == ny, 2 * nx + ny - x, 2 * (nx + ny) - y)
    return np.where((y == 0) | ((x == nx) & (y < ny)), low_right, high_left)


def _running(running: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum along the border from its start to a place, any number of times around."""
    n = len(running) - 1
    turns = np.floor(place / n)
    found: NDArray[np.float64] = np.interp(place - turns * n, np.arange(n + 1), running) + turns * running[-1]
    return found


def _smooth(t: NDArray[np.float64]) -> NDArray[np.float64]:
    return t * t * (3 - 2 * t)


def _next(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.roll(z, -1)
