"""Merge footprints that are closer than the clearance: the paper's Algorithm 1 (step 2.1)."""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.geometry.bins import Bins
from pipeline.geometry.clearance import is_sound, make_sound
from pipeline.geometry.holes import fill_small_holes
from pipeline.geometry.rings import drop_needless_vertices, make_canonical, sort_canonically
from pipeline.simplification.patches import merge_polygons

# Size of a bin as a multiple of the mean footprint diameter: the paper's choice.
BIN_FACTOR = 4.0
MAX_ITERATIONS = 3  # patches that are tried for a pair
METHODS = ("union", "patch", "hulls", "hull")
RUNGS = ("repaired-simplify", "repaired-buffer", "repaired-hull")


@dataclass(frozen=True, eq=False)
class MergedFootprints:
    """Footprints after step 2.1."""

    #: (k,): valid shapely Polygons in canonical form and order, each at least the clearance from all others
    polygons: NDArray[np.object_]
    #: k of them: indices of the input polygons that each was made of, ascending
    members: tuple[NDArray[np.int64], ...]
    #: k of them: how each got its last shape: ``"single"`` (as it came), ``"union"``, ``"patch"``, ``"hulls"``,
    #: ``"hull"``, or the rung of `make_sound` that repaired it
    method: tuple[str, ...]
    #: how many merges ended as each of `METHODS`, how many repairs on each of `RUNGS`, and ``"hole-filled"``, the
    #: holes of the input that were too small. All keys are there, in this order
    counts: dict[str, int]


def merge_footprints(
    polygons: NDArray[np.object_],
    *,
    clearance: float,
    min_hole_area: float,
    floor: float,
    tolerance: float,
) -> MergedFootprints:
    """Merge all polygons that are closer than the clearance to each other (Algorithms 1-3).

    Parameters
    ----------
    polygons : object, (n,)
        Valid shapely Polygons, as step 1.4 leaves them.
    clearance : float
        Polygons closer than this are merged; merged shapes are accepted if their own minimum clearance is not
        less (m).
    min_hole_area : float
        Smaller holes, and holes that no disc of diameter `clearance` fits into, are filled (m²).
    floor : float
        Least minimum clearance of any polygon, merged or not (m); see `make_sound`.
    tolerance : float
        That of step 1.4 (m): the result has no needless vertices either, so step 2.2 finds nothing to do.

    Returns
    -------
    MergedFootprints
        Pairwise distances are at least `clearance`; every polygon is valid, has minimum clearance >= `floor`
        and no corner sharper than `pipeline.geometry.clearance.SHARPEST_CORNER`.

    Raises
    ------
    GeometryError
        If an input polygon is invalid or empty, or a result breaks one of these promises.
    ValueError
        Unless ``0 <= tolerance <= floor <= clearance`` and ``0 < floor``.

    Notes
    -----
    Input is put in canonical order first and each polygon is compared with all others in that order, as the
    paper's text has it. The bins only find them, so the result depends neither on the input's order nor on
    the bins' size nor on buildings farther away: clusters may be merged one by one. The paper's continuing
    with the grown polygon where the comparison stands, and queueing it again, is kept.
    Each merge removes a polygon, so the queue runs empty. Where nothing touches the cost is O(n) and some
    0.1 ms a polygon; a merge costs about 1 ms.

    Examples
    --------
    >>> pair = np.array([shapely.box(0, 0, 4, 4), shapely.box(4.5, 0, 9, 4)])
    >>> merged = merge_footprints(pair, clearance=1.0, min_hole_area=5.0, floor=0.1, tolerance=0.01)
    >>> print(merged.polygons[0], merged.members[0], merged.method[0])
    POLYGON ((0 0, 9 0, 9 4, 0 4, 0 0)) [0 1] patch
    """
    if not (0 <= tolerance <= floor <= clearance and floor > 0):
        raise ValueError(f"want 0 <= tolerance {tolerance} <= floor {floor} <= clearance {clearance}, floor > 0")
    check_footprints(polygons)
    canonical = make_canonical(polygons)
    order = sort_canonically(canonical)
    shapes, n_filled = fill_small_holes(canonical[order], min_hole_area=min_hole_area, clearance=clearance)
    shapes = _drop_needless(shapes, tolerance)
    method = ["single"] * len(shapes)
    members = [[int(i)] for i in order]
    counts = Counter({"hole-filled": n_filled})
    for k in np.flatnonzero(~is_sound(shapes, floor)):
        shapes[k], method[k] = _repair(shapes[k], floor, min_hole_area, clearance)
        counts[method[k]] += 1

    bins = Bins(shapes, _choose_bin_size(shapes, clearance))
    queue = deque(range(len(shapes)))
    queued = set(queue)
    while queue:
        i = queue.popleft()
        queued.discard(i)
        if shapes[i] is None:
            continue
        j = -1
        while (j := _find_next(shapes, bins, i, j, clearance)) >= 0:
            bins.remove(i)
            bins.remove(j)
            shape, method[i] = merge_polygons(
                shapes[i],
                shapes[j],
                clearance=clearance,
                max_iterations=MAX_ITERATIONS,
                min_hole_area=min_hole_area,
                tolerance=tolerance,
            )
            counts[method[i]] += 1
            shapes[i], rung = _repair(shape, floor, min_hole_area, clearance)
            if rung:
                method[i] = rung
                counts[rung] += 1
            shapes[j] = None
            members[i] += members[j]
            bins.insert(i, shapes[i])
            if i not in queued:
                queue.append(i)
                queued.add(i)
    return _collect(shapes, members, method, counts, clearance=clearance, floor=floor)


def _repair(
    shape: shapely.Polygon, floor: float, min_hole_area: float, clearance: float
) -> tuple[shapely.Polygon, str]:
    """Make a polygon sound, and fill the holes that this leaves too small, as a closed gap does."""
    sound, rung = make_sound(shape, floor)
    if not rung:
        return sound, rung
    filled, _ = fill_small_holes(np.array([sound]), min_hole_area=min_hole_area, clearance=clearance)
    return filled[0], rung


def _choose_bin_size(shapes: NDArray[np.object_], clearance: float) -> float:
    if not len(shapes):
        return clearance
    low, high = np.split(shapely.bounds(shapes), 2, axis=1)
    return float(max(BIN_FACTOR * np.hypot(*(high - low).T).mean(), 2 * clearance))


def _find_next(shapes: NDArray[np.object_], bins: Bins, i: int, after: int, clearance: float) -> int:
    """Find the first polygon behind ``after`` closer to polygon ``i`` than the clearance; -1 if none is."""
    # A little more than the clearance: the box must not rule out what the distance would not.
    near = bins.find(i, clearance * 1.001)
    near = near[near > after]
    close = near[_measure(shapes, np.full_like(near, i), near) < clearance]
    return int(close[0]) if len(close) else -1


def _measure(shapes: NDArray[np.object_], i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
    """Measure distances, always from the lower index, so that asking twice gives the same bits."""
    distance: NDArray[np.float64] = shapely.distance(shapes[np.minimum(i, j)], shapes[np.maximum(i, j)])
    return distance


def _drop_needless(shapes: NDArray[np.object_], tolerance: float) -> NDArray[np.object_]:
    """Drop needless vertices where that leaves a valid polygon."""
    lean, _ = drop_needless_vertices(shapes, tolerance)
    return np.where(shapely.is_valid(lean), make_canonical(lean), shapes)


def check_footprints(polygons: NDArray[np.object_]) -> None:
    """Raise GeometryError with the first polygon that is invalid or empty."""
    usable = (shapely.get_type_id(polygons) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(polygons)
    usable &= shapely.is_valid(polygons)
    if not usable.all():
        i = int(np.flatnonzero(~usable)[0])
        raise GeometryError(
            f"step 2.1: footprint {i} ({shapely.is_valid_reason(polygons[i])}) and "
            f"{int((~usable).sum()) - 1} others of {len(polygons)} are no valid polygons; "
            "clean them first (step 1.4)"
        )


def _collect(
    shapes: NDArray[np.object_],
    members: list[list[int]],
    method: list[str],
    counts: Counter[str],
    *,
    clearance: float,
    floor: float,
) -> MergedFootprints:
    left = np.flatnonzero(~shapely.is_missing(shapes))
    _check_distances(shapes, left, clearance)
    _check_soundness(shapes[left], floor)
    left = left[sort_canonically(shapes[left])]
    return MergedFootprints(
        polygons=shapes[left],
        members=tuple(np.sort(np.array(members[i], dtype=np.int64)) for i in left),
        method=tuple(method[i] for i in left),
        counts={key: counts[key] for key in (*METHODS, *RUNGS, "hole-filled")},
    )


def _check_distances(shapes: NDArray[np.object_], left: NDArray[np.int64], clearance: float) -> None:
    tree = shapely.STRtree(shapes[left])
    i, j = left[tree.query(shapes[left], predicate="dwithin", distance=clearance)]
    i, j = i[i < j], j[i < j]
    distance = _measure(shapes, i, j)
    if (distance < clearance).any():
        worst = int(distance.argmin())
        x, y = shapes[i[worst]].representative_point().coords[0]
        raise GeometryError(
            f"step 2.1 at ({x:.2f}, {y:.2f}): two merged footprints are {distance[worst]:.4f} m apart, "
            f"less than the clearance {clearance:g} m; look at the footprints there or change the clearance"
        )


def _check_soundness(polygons: NDArray[np.object_], floor: float) -> None:
    bad = np.flatnonzero(~is_sound(polygons, floor))
    if len(bad):
        worst = polygons[bad[0]]
        x, y = worst.representative_point().coords[0]
        raise GeometryError(
            f"step 2.1 at ({x:.2f}, {y:.2f}): a footprint with minimum clearance "
            f"{shapely.minimum_clearance(worst):.4f} m (least {floor:g} m) could not be repaired; "
            "look at the footprint there or leave it out"
        )
