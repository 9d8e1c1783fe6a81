"""Groups of adjacent houses with nearly equal heights, which get one roof (after step 2.3, ours)."""

import heapq

import numpy as np
import shapely
from numpy.typing import NDArray

GROUP_THRESHOLD = 2.0  # m; roofs closer than this at a shared wall make flat cells


def adjacent_houses(polygons: NDArray[np.object_]) -> NDArray[np.int64]:
    """Find the pairs of houses that share a wall or only a corner.

    Parameters
    ----------
    polygons : object, (b,)
        Faces of one planar graph: where two of them touch, both have the same vertex, to the bit. A corner
        that rests on another house's wall without a vertex of it is no contact here.

    Returns
    -------
    int64, (p, 2)
        Rows of `polygons`, the smaller one first, ascending and unique.

    Notes
    -----
    O(n log n) in the vertices, and the square of the houses around one vertex, which are few.
    """
    xy, house = shapely.get_coordinates(polygons, return_index=True)
    _, vertex = np.unique(xy + 0.0, axis=0, return_inverse=True)  # + 0.0 turns -0.0 into 0.0
    visits = np.unique(np.column_stack((vertex.reshape(-1), house)), axis=0)
    found = [np.empty((0, 2), np.int64)]
    step = 1
    while (same := visits[step:, 0] == visits[:-step, 0]).any():
        found.append(np.column_stack((visits[:-step, 1][same], visits[step:, 1][same])))
        step += 1
    return np.unique(np.concatenate(found), axis=0)


def group_roofs(
    roof: NDArray[np.float64],
    area: NDArray[np.float64],
    pairs: NDArray[np.int64],
    *,
    key: NDArray[np.str_] | NDArray[np.int64],
    threshold: float = GROUP_THRESHOLD,
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Give adjacent houses of nearly equal height one roof: smallest difference first, mean by area.

    Parameters
    ----------
    roof : float64, (b,)
        Roof heights (m); a house without one (NaN) stays alone.
    area : float64, (b,)
        Footprint areas (m²), the weights.
    pairs : int64, (p, 2)
        Adjacent houses, as from `adjacent_houses`.
    key : str or int64, (b,)
        Unique ids; between equal differences the pair with the smallest ids goes first.
    threshold : float
        Neighbours closer in height than this (m) are joined.

    Returns
    -------
    roof : float64, (b,)
        Heights (m), the same bits within a group; a house that stays alone keeps its own.
    group : int32, (b,)
        Groups numbered by their smallest key.

    Raises
    ------
    ValueError
        If keys repeat, an area is not positive, or the shapes do not match.

    Notes
    -----
    Afterwards any two adjacent groups differ by `threshold` or more. The order of houses and pairs does not
    matter, and chains of neighbours that do not touch do not see each other.

    No roof moves by ``threshold * ln(area of its group / its own area)`` or more: a merge of a group of area
    ``W`` with one of area ``V`` moves it by less than ``threshold * V / (W + V)``, which is at most
    ``threshold * ln((W + V) / W)``, and these add up. In Amsterdam 8 to 13 of 1,092 houses moved by more than
    2 m, none by more than 3.3 m.

    Each merge looks at the neighbours of the new group again: O(p log p) while groups have few of them (4 ms for
    1,092 houses), more where one block is a whole town (0.3 s for 10,000 houses, 11 s for 40,000).
    """
    _check(roof, area, pairs, key, threshold)
    order = np.argsort(key, kind="stable")  # houses are named by the rank of their key from here on
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    heights, leader = _agglomerate(roof[order].tolist(), area[order].tolist(), rank[pairs], threshold)
    root = np.array(leader, np.int64)
    _, number = np.unique(root, return_inverse=True)
    return np.array(heights, np.float64)[root][rank], number.reshape(-1).astype(np.int32)[rank]


def _agglomerate(
    height: list[float], weight: list[float], pairs: NDArray[np.int64], threshold: float
) -> tuple[list[float], list[int]]:
    """Join neighbours until none differ by less than `threshold`; returns heights and each one's leader."""
    neighbours: list[set[int]] = [set() for _ in height]
    for a, b in pairs.tolist():
        if a != b:
            neighbours[a].add(b)
            neighbours[b].add(a)
    leader = list(range(len(height)))
    version = [0] * len(height)
    queue: list[tuple[float, int, int, int, int]] = []

    def offer(a: int, b: int) -> None:
        a, b = min(a, b), max(a, b)
        difference = abs(height[a] - height[b])
        if difference < threshold:
            heapq.heappush(queue, (difference, a, b, version[a], version[b]))

    for a, others in enumerate(neighbours):
        for b in others:
            if a < b:
                offer(a, b)
    while queue:
        _, a, b, version_a, version_b = heapq.heappop(queue)
        if (version[a], version[b]) != (version_a, version_b):
            continue
        total = weight[a] + weight[b]
        if height[a] != height[b]:
            height[a] = (weight[a] * height[a] + weight[b] * height[b]) / total
        weight[a] = total
        leader[b] = a
        version[a] += 1
        version[b] = -1  # gone: no entry carries this version
        if len(neighbours[b]) > len(neighbours[a]):
            neighbours[a], neighbours[b] = neighbours[b], neighbours[a]
        neighbours[a] |= neighbours[b]
        neighbours[a] -= {a, b}
        for c in neighbours[a]:
            neighbours[c].discard(b)
            neighbours[c].add(a)
            offer(a, c)
    for a, first in enumerate(leader):  # a leader has a smaller name, so it is resolved already
        leader[a] = leader[first]
    return height, leader


def _check(
    roof: NDArray[np.float64],
    area: NDArray[np.float64],
    pairs: NDArray[np.int64],
    key: NDArray[np.str_] | NDArray[np.int64],
    threshold: float,
) -> None:
    if not (roof.shape == area.shape == key.shape == (len(roof),)) or pairs.shape != (len(pairs), 2):
        raise ValueError(
            f"roof {roof.shape}, area {area.shape}, key {key.shape}, pairs {pairs.shape} do not match"
        )
    if len(np.unique(key)) < len(key):
        raise ValueError(f"{len(key) - len(np.unique(key))} of {len(key)} keys are repeated; give unique ids")
    if not (area > 0).all():
        raise ValueError(f"the least area is {np.min(area)} m²; drop houses without area first")
    if not threshold >= 0:
        raise ValueError(f"threshold {threshold} m must not be negative")
