"""Step 1.3: heights for empty nodes, the same whatever the tiles are.

Small empty areas are flooded from their border. Middles of large ones (lakes) take a coarse level that all tiles
of a region share.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.kernel import kernel
from pipeline.points_terrain.raster import (
    HEIGHT_UNIT,
    Dtm,
    NodeWindow,
    cut_nodes,
    hull_windows,
    round_height,
    window_of,
)

FILL_RINGS = 64  # rings that are flooded; also how many nodes beyond its own a tile must read
RIM = FILL_RINGS // 2  # deeper than this ring, the coarse level has a weight
DEEPER = FILL_RINGS + 1  # ring of all nodes that the flood does not reach
COARSE = 64  # nodes between two coarse nodes


@dataclass(frozen=True, eq=False)
class FloodedDtm:
    """Terrain with its small empty areas filled."""

    dtm: Dtm  #: heights (m), NaN where `ring` is `DEEPER`
    #: (ny, nx): nodes to the closest one with ground points, along the larger of the two axes: 0 for those
    #: themselves, `DEEPER` for all that are farther than `FILL_RINGS`
    ring: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class CoarseSums:
    """What tiles tell of their large empty areas. Small: has entries only where there are any."""

    #: (k, 2): region-wide column and row of coarse nodes, sorted. Coarse node ``(i, j)`` is node ``(i, j) *
    #: COARSE``
    node: NDArray[np.int64]
    total: NDArray[np.int64]  #: (k,): sum of the heights of the rim nodes closest to each, in `HEIGHT_UNIT`
    count: NDArray[np.int64]  #: (k,): how many these are, at least 1
    window: NodeWindow  #: nodes from which the sums were made
    n_known: int  #: nodes with ground points among them
    spacing: float  #: distance between nodes (m)


@dataclass(frozen=True)
class FillCounts:
    """How many nodes have no ground point of their own."""

    filled: int  #: all of them
    coarse: int  #: those whose height is wholly or partly from the coarse level


def flood_terrain(raw: Dtm, window: NodeWindow) -> FloodedDtm:
    """Fill empty nodes from the border of each empty area, one ring after the other, up to `FILL_RINGS`.

    Parameters
    ----------
    raw : Dtm
        Bin means, NaN where a bin is empty. It must reach `FILL_RINGS` nodes beyond `window`, or to the
        region's border, and not beyond that: what is not there takes no part.
    window : NodeWindow
        Nodes to return, inside `raw`.

    Raises
    ------
    ValueError
        If the window is not inside the raster.

    Notes
    -----
    A node gets the mean of those of its eight neighbours that were known before its ring began, rounded to
    `HEIGHT_UNIT`. A node in ring r so depends on the nodes within r of it alone: the result is that of the whole
    region, bit for bit. Cost is linear in the nodes.
    """
    outer = window_of(raw)
    if not _covers(outer, window):
        raise ValueError(f"{window} is not inside the raster's {outer}")
    z, ring = np.empty(raw.z.shape), np.empty(raw.z.shape, np.uint8)
    _flood(raw.z, z, ring, FILL_RINGS, DEEPER)
    part = Dtm(cut_nodes(z, outer, window).copy(), window.i0, window.j0, raw.spacing)
    return FloodedDtm(part, cut_nodes(ring, outer, window).copy())


def coarsen(flooded: FloodedDtm) -> CoarseSums:
    """Sum up the rim nodes, in the rings deeper than `RIM`, by closest coarse node.

    Notes
    -----
    Rim nodes have the height of the shore. Known nodes beyond it would lift a lake towards its banks, and
    make all tiles depend on each other's ground where no area is large and empty.
    """
    window = window_of(flooded.dtm)
    rim = (flooded.ring > RIM) & (flooded.ring < DEEPER)
    row, column = np.unravel_index(np.flatnonzero(rim), rim.shape)
    units = np.rint(flooded.dtm.z[row, column] / HEIGHT_UNIT).astype(np.int64)
    fine = np.column_stack((column + window.i0, row + window.j0))
    node, total, count = _sum_up((fine + COARSE // 2) // COARSE, units, np.ones(len(units), np.int64))
    return CoarseSums(node, total, count, window, int(np.count_nonzero(flooded.ring == 0)), flooded.dtm.spacing)


def merge_coarse(parts: Sequence[CoarseSums]) -> CoarseSums:
    """Add up the sums of tiles that share no node, in any order.

    Raises
    ------
    ValueError
        If there are no parts, or their spacings differ.
    """
    if not parts or any(part.spacing != parts[0].spacing for part in parts):
        raise ValueError(f"cannot merge {len(parts)} parts of spacings {sorted({p.spacing for p in parts})}")
    node, total, count = _sum_up(
        np.concatenate([part.node for part in parts]),
        np.concatenate([part.total for part in parts]),
        np.concatenate([part.count for part in parts]),
    )
    window = hull_windows([part.window for part in parts])
    return CoarseSums(node, total, count, window, sum(part.n_known for part in parts), parts[0].spacing)


def coarse_terrain(sums: CoarseSums) -> Dtm:
    """Make the coarse level of a region from the merged sums of all its tiles.

    Returns
    -------
    Dtm
        Means at the coarse nodes around the region, empty ones flooded from these without bound; the spacing
        is `COARSE` times as large. NaN throughout if no empty area is deep enough to need it.

    Raises
    ------
    InputError
        If no node of the region has a ground point.
    """
    window = sums.window
    if not sums.n_known:
        raise InputError(
            f"terrain, step 1.3: none of the {window.nx * window.ny} nodes has a ground point (class 2 or 9); "
            "check the bounds and the classes of the point cloud, or give --ground-filter or --terrain"
        )
    i0, j0 = window.i0 // COARSE, window.j0 // COARSE
    nx = -(-(window.i0 + window.nx - 1) // COARSE) - i0 + 1
    ny = -(-(window.j0 + window.ny - 1) // COARSE) - j0 + 1
    means, z = np.full((ny, nx), np.nan), np.empty((ny, nx))
    means[sums.node[:, 1] - j0, sums.node[:, 0] - i0] = sums.total * HEIGHT_UNIT / sums.count
    _flood(means, z, np.empty(z.shape, np.int32), nx + ny, nx + ny + 1)
    return Dtm(z, i0, j0, sums.spacing * COARSE)


def fill_terrain(flooded: FloodedDtm, coarse: Dtm) -> tuple[Dtm, FillCounts]:
    """Give the middles of large empty areas the heights of the coarse level.

    Parameters
    ----------
    flooded : FloodedDtm
        The tile's own nodes.
    coarse : Dtm
        Coarse level of the region, or a part of it that reaches around the tile.

    Returns
    -------
    Dtm
        Terrain without empty nodes.
    FillCounts
        How many were filled, and how.

    Raises
    ------
    ValueError
        If the coarse level has another spacing, or does not reach around the tile where it is needed.

    Notes
    -----
    Its weight grows from 0 in ring `RIM` to 1 in ring `FILL_RINGS`, so that there is no step; deeper it is
    alone. Between coarse nodes it is bilinear. A tile without rings deeper than `RIM` does not read it.
    """
    dtm = flooded.dtm
    n_coarse = count_coarse(flooded)
    counts = FillCounts(int(np.count_nonzero(flooded.ring)), n_coarse)
    if coarse.spacing != dtm.spacing * COARSE:
        raise ValueError(f"coarse spacing {coarse.spacing} m is not {COARSE} times {dtm.spacing} m")
    if not n_coarse:
        return dtm, counts
    around = _coarse_window(window_of(dtm))
    if not _covers(window_of(coarse), around):
        raise ValueError(f"coarse nodes {window_of(coarse)} do not reach around {window_of(dtm)}")
    z = dtm.z.copy()
    _blend(z, flooded.ring, dtm.i0, dtm.j0, coarse.z, coarse.i0, coarse.j0)
    return Dtm(z, dtm.i0, dtm.j0, dtm.spacing), counts


def count_coarse(flooded: FloodedDtm) -> int:
    """Count the nodes of a tile for which the coarse level has a weight."""
    return int(np.count_nonzero(flooded.ring > RIM))


def coarse_around(coarse: Dtm, window: NodeWindow) -> Dtm:
    """Take the coarse nodes that a tile needs whose fine nodes are a window.

    Raises
    ------
    ValueError
        If the coarse level does not reach around the tile.
    """
    own = _coarse_window(window)
    if not _covers(window_of(coarse), own):
        raise ValueError(f"coarse nodes {window_of(coarse)} do not reach around {window}")
    i, j = own.i0 - coarse.i0, own.j0 - coarse.j0
    return Dtm(coarse.z[j : j + own.ny, i : i + own.nx].copy(), own.i0, own.j0, coarse.spacing)


def _coarse_window(window: NodeWindow) -> NodeWindow:
    """Coarse nodes around a window of fine ones."""
    i0, j0 = window.i0 // COARSE, window.j0 // COARSE
    i1, j1 = -(-(window.i0 + window.nx - 1) // COARSE), -(-(window.j0 + window.ny - 1) // COARSE)
    return NodeWindow(i0, j0, i1 - i0 + 1, j1 - j0 + 1)


def _covers(window: NodeWindow, other: NodeWindow) -> bool:
    low = window.i0 <= other.i0 and window.j0 <= other.j0
    return low and other.i0 + other.nx <= window.i0 + window.nx and other.j0 + other.ny <= window.j0 + window.ny


def _sum_up(
    node: NDArray[np.int64], total: NDArray[np.int64], count: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Add up totals and counts of equal nodes (k, 2); sort the nodes."""
    unique, group = np.unique(node, axis=0, return_inverse=True)
    sums = np.zeros((2, len(unique)), np.int64)
    np.add.at(sums[0], group.reshape(-1), total)
    np.add.at(sums[1], group.reshape(-1), count)
    return unique, sums[0], sums[1]


@kernel
def _flood(
    raw: NDArray[np.float64], z: NDArray[np.float64], ring: NDArray[np.integer], limit: int, deeper: int
) -> None:
    """Put `raw`, filled up to ring `limit` of at least 2, into `z`, and tell the rings."""
    ny, nx = raw.shape
    _fill_first(raw, z, ring, deeper)
    queue = np.empty((np.sum(ring == deeper), 2), np.int32)
    head, tail, r = 0, 0, 2
    for j in range(ny):
        for i in range(nx):
            if ring[j, i] == deeper and _touches_first(ring, j, i):
                ring[j, i] = 2
                queue[tail, 0], queue[tail, 1] = j, i
                tail += 1
    while head < tail:
        end = tail
        for k in range(head, end):
            j, i = queue[k, 0], queue[k, 1]
            total, count = 0.0, 0
            for q in range(max(j - 1, 0), min(j + 2, ny)):
                for p in range(max(i - 1, 0), min(i + 2, nx)):
                    if ring[q, p] < r:
                        total += z[q, p]
                        count += 1
                    elif ring[q, p] == deeper and r < limit:
                        ring[q, p] = r + 1
                        queue[tail, 0], queue[tail, 1] = q, p
                        tail += 1
            z[j, i] = round_height(total / count)
        head = end
        r += 1


@kernel
def _fill_first(raw: NDArray[np.float64], z: NDArray[np.float64], ring: NDArray[np.integer], deeper: int) -> None:
    """Fill the first ring, which most empty nodes are in: its means take nothing but `raw`.

    Away from the border the loop has no branch and no bound that moves: many nodes are done at once, ten times as
    fast as by looking at the empty ones alone.
    """
    ny, nx = raw.shape
    for j in range(1, ny - 1):
        for i in range(1, nx - 1):
            total, count = 0.0, 0
            for q in range(3):
                for p in range(3):
                    near = raw[j - 1 + q, i - 1 + p]
                    total += 0.0 if np.isnan(near) else near
                    count += not np.isnan(near)
            known = not np.isnan(raw[j, i])
            z[j, i] = raw[j, i] if known or count == 0 else round_height(total / max(count, 1))
            ring[j, i] = 0 if known else (1 if count else deeper)
    for j in range(ny):
        for i in range(0, nx, 1 if j in (0, ny - 1) else max(nx - 1, 1)):
            _fill_first_at_border(raw, z, ring, deeper, j, i)


@kernel
def _fill_first_at_border(
    raw: NDArray[np.float64], z: NDArray[np.float64], ring: NDArray[np.integer], deeper: int, j: int, i: int
) -> None:
    z[j, i], ring[j, i] = raw[j, i], 0
    if not np.isnan(raw[j, i]):
        return
    total, count = 0.0, 0
    for near in raw[max(j - 1, 0) : j + 2, max(i - 1, 0) : i + 2].flat:
        if not np.isnan(near):
            total += near
            count += 1
    ring[j, i] = 1 if count else deeper
    if count:
        z[j, i] = round_height(total / count)


@kernel
def _touches_first(ring: NDArray[np.integer], j: int, i: int) -> bool:
    for q in range(max(j - 1, 0), min(j + 2, ring.shape[0])):
        for p in range(max(i - 1, 0), min(i + 2, ring.shape[1])):
            if ring[q, p] == 1:
                return True
    return False


@kernel
def _blend(
    z: NDArray[np.float64],
    ring: NDArray[np.uint8],
    i0: int,
    j0: int,
    coarse: NDArray[np.float64],
    coarse_i0: int,
    coarse_j0: int,
) -> None:
    ny, nx = z.shape
    for j in range(ny):
        low = (j0 + j) // COARSE
        v = (j0 + j - low * COARSE) / COARSE
        low -= coarse_j0
        high = min(low + 1, coarse.shape[0] - 1)
        for i in range(nx):
            if ring[j, i] <= RIM:
                continue
            left = (i0 + i) // COARSE
            u = (i0 + i - left * COARSE) / COARSE
            left -= coarse_i0
            right = min(left + 1, coarse.shape[1] - 1)
            below = (1 - u) * coarse[low, left] + u * coarse[low, right]
            above = (1 - u) * coarse[high, left] + u * coarse[high, right]
            deep = (1 - v) * below + v * above
            if ring[j, i] < DEEPER:
                weight = (ring[j, i] - RIM) / (FILL_RINGS - RIM)
                deep = (1 - weight) * z[j, i] + weight * deep
            z[j, i] = round_height(deep)
