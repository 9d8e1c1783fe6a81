"""Heights of the roofs that meet at a vertex: joined where close, parted where they stay apart (ours, step 3.4).

A wall between two roofs must not be lower than cells there are high. So at each vertex the heights of all roofs
that meet are compared with a least step: those closer than half of it become one, and those that stay closer than
the step are moved apart, both by the same way. Walls then taper to nothing at a vertex, and no lower gap is left.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.roofs import Weld

PART_SWEEPS = 6  # of moving heights apart from below to above


def least_steps(weld: Weld | None, spacing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least step of two roofs at each vertex (m), (n,); without a weld none, so that equal heights alone join.

    Parameters
    ----------
    weld : Weld or None
        The rule.
    spacing : float64, (n,)
        Vertical spacing at each vertex (m).
    """
    if weld is None:
        return np.zeros(len(spacing))
    return np.clip(weld.factor * spacing, weld.least, weld.most)


@kernel
def weld_heights(
    start: NDArray[np.int64],
    ground: NDArray[np.bool_],
    wanted: NDArray[np.float64],
    given: NDArray[np.bool_],
    step: NDArray[np.float64],
    least_gap: NDArray[np.float64],
    clearance: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """Find the nodes of every column from the heights of its surfaces.

    Parameters
    ----------
    start : int64, (n + 1,)
        Column ``i`` has the surfaces ``start[i]`` to ``start[i + 1]``.
    ground : bool, (start[-1],)
        Which of them are the ground; the first of a column, if any.
    wanted : float64, (start[-1],)
        Their heights (m).
    given : bool, (n,)
        Columns that are given: heights stay, and equal ones alone share a node.
    step, least_gap : float64, (n,)
        Least step of two roofs, and least distance of any two nodes (m).
    clearance : float
        Least height of the lowest roof above the ground of its column (m).

    Returns
    -------
    int64, (n + 1,)
        Column ``i`` has the nodes from here.
    float64
        Their heights (m), ascending in every column.
    int64, (start[-1],)
        Node of each surface.
    """
    n = len(start) - 1
    node_start = np.zeros(n + 1, np.int64)
    node_z, node_of = np.empty(len(wanted)), np.empty(len(wanted), np.int64)
    most = 0
    for i in range(n):
        most = max(most, start[i + 1] - start[i])
    order, first = np.empty(most, np.int64), np.empty(most + 1, np.int64)
    height, weight = np.empty(most), np.empty(most)
    k = 0
    for i in range(n):
        begin, below = start[i], -np.inf
        if start[i + 1] > begin and ground[begin]:
            below = wanted[begin]
            node_z[k], node_of[begin] = below, k
            k += 1
            begin += 1
        c = _sort_heights(wanted[begin : start[i + 1]], order, first, height, weight)
        if not given[i]:
            c = _join_close(first, height, weight, c, 0.5 * step[i])
            _part_close(height, c, step[i])
            _raise_low(height, c, below, max(clearance, least_gap[i]), max(step[i], least_gap[i]))
        first[c] = start[i + 1] - begin
        for q in range(c):
            node_z[k] = height[q]
            for p in range(first[q], first[q + 1]):
                node_of[begin + order[p]] = k
            k += 1
        node_start[i + 1] = k
    return node_start, node_z[:k].copy(), node_of


@kernel
def _sort_heights(
    wanted: NDArray[np.float64],
    order: NDArray[np.int64],
    first: NDArray[np.int64],
    height: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> int:
    """Sort heights, equal ones in the order given: how many differ, and where each begins in `order`."""
    for q in range(len(wanted)):
        p = q
        while p > 0 and wanted[order[p - 1]] > wanted[q]:
            order[p] = order[p - 1]
            p -= 1
        order[p] = q
    c = 0
    for q in range(len(wanted)):
        if q > 0 and wanted[order[q]] == wanted[order[q - 1]]:
            weight[c - 1] += 1.0
            continue
        first[c], height[c], weight[c] = q, wanted[order[q]], 1.0
        c += 1
    return c


@kernel
def _join_close(
    first: NDArray[np.int64], height: NDArray[np.float64], weight: NDArray[np.float64], c: int, least: float
) -> int:
    """Join the two closest heights to their mean as long as they are closer than that; how many are left."""
    while c > 1:
        at = 0
        for q in range(1, c - 1):
            if height[q + 1] - height[q] < height[at + 1] - height[at]:
                at = q
        if not height[at + 1] - height[at] < least:
            break
        total = weight[at] + weight[at + 1]
        height[at] = (weight[at] * height[at] + weight[at + 1] * height[at + 1]) / total
        weight[at] = total
        c -= 1
        for q in range(at + 1, c):
            first[q], height[q], weight[q] = first[q + 1], height[q + 1], weight[q + 1]
    return c


@kernel
def _part_close(height: NDArray[np.float64], c: int, step: float) -> None:
    """Move heights that are closer than a step apart, both by the same way."""
    for _ in range(PART_SWEEPS):
        for q in range(1, c):
            if height[q] - height[q - 1] < step:
                middle = 0.5 * (height[q] + height[q - 1])
                height[q - 1], height[q] = middle - 0.5 * step, middle + 0.5 * step


@kernel
def _raise_low(height: NDArray[np.float64], c: int, below: float, over_ground: float, gap: float) -> None:
    """Raise heights from below: the first over the ground, each next one over the one before it."""
    for q in range(c):
        least = gap if q > 0 else over_ground
        if height[q] - below < least:
            height[q] = below + least
        below = height[q]
