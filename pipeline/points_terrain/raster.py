"""The terrain's raster: nodes aligned with the CRS, the windows of tiles, joining and sampling (step 1.3)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel

# Heights are summed as whole numbers of this unit, 0.12 mm, so that a mean does not depend on the order of what
# is summed: sums of whole numbers below 2**53 are exact in float64. The terrain's own are rounded to it: the last
# three of their eight bytes are zeros, and less than half as much is written and read.
HEIGHT_UNIT = 2.0**-13  # m

Value = TypeVar("Value", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Dtm:
    """Ground heights at the nodes of a grid that is aligned with the CRS."""

    #: (ny, nx): height (m) at node ``(x, y) = ((i0 + i) * spacing, (j0 + j) * spacing)``, row ``j``, column ``i``
    z: NDArray[np.float64]
    #: region-wide index of the first column and row: the same node has the same index in every tile
    i0: int
    j0: int
    spacing: float  #: distance between nodes (m)


@dataclass(frozen=True)
class NodeWindow:
    """A rectangle of nodes."""

    #: region-wide index of the first column and row
    i0: int
    j0: int
    #: columns and rows, 0 or more
    nx: int
    ny: int


@kernel(inline="always")
def round_height(z: float) -> float:
    """Round a height of the terrain (m) for kernels, to the closest whole number of `HEIGHT_UNIT`; NaN stays."""
    return float(np.rint(z / HEIGHT_UNIT) * HEIGHT_UNIT)


def node_window(
    box: tuple[float, float, float, float],
    spacing: float,
    *,
    low_border: tuple[bool, bool] = (True, True),
    high_border: tuple[bool, bool] = (True, True),
) -> NodeWindow:
    """Find the nodes that a tile owns.

    Parameters
    ----------
    box : (xmin, ymin, xmax, ymax)
        The tile (m).
    spacing : float
        Distance between nodes (m).
    low_border, high_border : (bool, bool)
        Whether the low and the high side in x and in y are the region's border. By default all are: the box
        is the region.

    Returns
    -------
    NodeWindow
        Nodes in the half-open box; at the region's border up to the first node on or beyond it.

    Raises
    ------
    ValueError
        If the box is inside out or the spacing not positive.

    Notes
    -----
    Tiles that share a line as the same floats share no node and leave none out, wherever the line lies.

    Examples
    --------
    >>> west, east = (0.3, 0.0, 2.5, 4.0), (2.5, 0.0, 5.2, 4.0)
    >>> node_window(west, 1.0, high_border=(False, True))
    NodeWindow(i0=0, j0=0, nx=3, ny=5)
    >>> node_window(east, 1.0, low_border=(False, True))
    NodeWindow(i0=3, j0=0, nx=4, ny=5)
    """
    if not (spacing > 0 and box[0] <= box[2] and box[1] <= box[3]):
        raise ValueError(f"no nodes in box {box} at spacing {spacing}")
    low, high = [0, 0], [0, 0]
    for k in range(2):
        first, last = box[k] / spacing, box[k + 2] / spacing
        low[k] = math.floor(first) if low_border[k] else math.ceil(first)
        high[k] = math.ceil(last) + 1 if high_border[k] else math.ceil(last)
    return NodeWindow(low[0], low[1], high[0] - low[0], high[1] - low[1])


def window_of(dtm: Dtm) -> NodeWindow:
    """Nodes of a raster."""
    ny, nx = dtm.z.shape
    return NodeWindow(dtm.i0, dtm.j0, nx, ny)


def grow_window(window: NodeWindow, by: int, *, within: NodeWindow) -> NodeWindow:
    """Grow a window by a number of nodes on each side, but not beyond another one (the region's).

    Examples
    --------
    >>> grow_window(NodeWindow(0, 10, 5, 5), 3, within=NodeWindow(0, 0, 100, 100))
    NodeWindow(i0=0, j0=7, nx=8, ny=11)
    """
    i0, j0 = max(window.i0 - by, within.i0), max(window.j0 - by, within.j0)
    i1 = min(window.i0 + window.nx + by, within.i0 + within.nx)
    j1 = min(window.j0 + window.ny + by, within.j0 + within.ny)
    return NodeWindow(i0, j0, max(i1 - i0, 0), max(j1 - j0, 0))


def hull_windows(windows: Sequence[NodeWindow]) -> NodeWindow:
    """Smallest window around all that have nodes."""
    some = [window for window in windows if window.nx and window.ny] or [windows[0]]
    i0, j0 = min(window.i0 for window in some), min(window.j0 for window in some)
    i1, j1 = max(window.i0 + window.nx for window in some), max(window.j0 + window.ny for window in some)
    return NodeWindow(i0, j0, i1 - i0, j1 - j0)


def windows_meet(one: NodeWindow, other: NodeWindow) -> bool:
    """Tell whether two windows have a node in common."""
    common = grow_window(one, 0, within=other)
    return common.nx > 0 and common.ny > 0


def join_dtm(parts: Sequence[Dtm], window: NodeWindow) -> Dtm:
    """Put the rasters of neighbouring tiles together.

    Parameters
    ----------
    parts : sequence of Dtm, at least one
        Rasters of one spacing, in any order. Where they overlap, they agree or one of them has NaN.
    window : NodeWindow
        Nodes to return; parts may reach beyond it or miss it.

    Returns
    -------
    Dtm
        Heights of the window, NaN where no part has any.

    Raises
    ------
    ValueError
        If there are no parts, or they differ in spacing or in the height of a node.
    """
    if not parts or any(part.spacing != parts[0].spacing for part in parts):
        raise ValueError(f"cannot join {len(parts)} rasters of spacings {sorted({p.spacing for p in parts})}")
    z = np.full((window.ny, window.nx), np.nan)
    for part in parts:
        common = grow_window(window_of(part), 0, within=window)
        target = cut_nodes(z, window, common)
        source = cut_nodes(part.z, window_of(part), common)
        if np.isnan(target).all():  # as between tiles, which share no node
            target[...] = source
            continue
        if ((target != source) & ~np.isnan(target) & ~np.isnan(source)).any():
            raise ValueError(f"rasters to join have different heights at nodes of {common}")
        np.copyto(target, source, where=~np.isnan(source))
    return Dtm(z, window.i0, window.j0, parts[0].spacing)


def cut_nodes(values: NDArray[Value], window: NodeWindow, inner: NodeWindow) -> NDArray[Value]:
    """View of the values (ny, nx) of a window at the nodes of a window inside it."""
    i, j = max(inner.i0 - window.i0, 0), max(inner.j0 - window.j0, 0)
    return values[j : j + inner.ny, i : i + inner.nx]


def sample_dtm(dtm: Dtm, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample ground heights bilinearly.

    Parameters
    ----------
    dtm : Dtm
        Terrain without empty nodes.
    xy : float64, (n, 2)
        Places (m). Beyond the grid, the closest place on its border is sampled.

    Returns
    -------
    float64, (n,)
        Heights (m).

    Notes
    -----
    The position in a cell comes from region-wide indices, so two tiles that hold the same nodes get the
    same bits.
    """
    height = np.empty(len(xy))
    _sample(dtm.z, dtm.i0, dtm.j0, dtm.spacing, xy, height)
    return height


def sample_grid(dtm: Dtm, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample ground heights at all nodes of a grid, as `sample_dtm` does.

    Parameters
    ----------
    dtm : Dtm
        Terrain without empty nodes.
    x, y : float64, (nx,) and (ny,)
        Coordinates of its columns and of its rows (m).

    Returns
    -------
    float64, (ny, nx)
        Heights (m).
    """
    height = np.empty((len(y), len(x)))
    _sample_grid(dtm.z, dtm.i0, dtm.j0, dtm.spacing, x, y, height)
    return height


def measure_over(dtm: Dtm, xyz: NDArray[np.float64], among: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Measure how high terrain is over points: `sample_dtm` minus their own heights.

    Parameters
    ----------
    dtm : Dtm
        Terrain without empty nodes.
    xyz : float64, (n, 3)
        Points (m).
    among : bool, (n,)
        Which ``k`` of them.

    Returns
    -------
    float64, (k,)
        Differences (m), in their order.
    """
    return np.asarray(_measure_over(dtm.z, dtm.i0, dtm.j0, dtm.spacing, xyz, among))


@kernel
def _sample(
    z: NDArray[np.float64],
    i0: int,
    j0: int,
    spacing: float,
    xy: NDArray[np.float64],
    height: NDArray[np.float64],
) -> None:
    for k in range(len(xy)):
        height[k] = _height_at(z, i0, j0, spacing, xy[k, 0], xy[k, 1])


@kernel
def _sample_grid(
    z: NDArray[np.float64],
    i0: int,
    j0: int,
    spacing: float,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    height: NDArray[np.float64],
) -> None:
    for row in range(len(y)):
        for column in range(len(x)):
            height[row, column] = _height_at(z, i0, j0, spacing, x[column], y[row])


@kernel
def _measure_over(
    z: NDArray[np.float64],
    i0: int,
    j0: int,
    spacing: float,
    xyz: NDArray[np.float64],
    among: NDArray[np.bool_],
) -> NDArray[np.float64]:
    over = np.empty(np.count_nonzero(among))
    n = 0
    for k in range(len(xyz)):
        if among[k]:
            over[n] = _height_at(z, i0, j0, spacing, xyz[k, 0], xyz[k, 1]) - xyz[k, 2]
            n += 1
    return over


@kernel(inline="always")
def _height_at(z: NDArray[np.float64], i0: int, j0: int, spacing: float, x: float, y: float) -> float:
    ny, nx = z.shape
    u = min(max(x / spacing, float(i0)), float(i0 + nx - 1))
    v = min(max(y / spacing, float(j0)), float(j0 + ny - 1))
    i = min(int(np.floor(u)), i0 + max(nx - 2, 0))
    j = min(int(np.floor(v)), j0 + max(ny - 2, 0))
    s, t = u - i, v - j
    left, low = i - i0, j - j0
    right, high = min(left + 1, nx - 1), min(low + 1, ny - 1)
    below = (1 - s) * z[low, left] + s * z[low, right]
    above = (1 - s) * z[high, left] + s * z[high, right]
    height: float = (1 - t) * below + t * above
    return height
