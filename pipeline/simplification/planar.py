"""The city model as one planar graph of walls with a guaranteed clearance (step 2.1, our way)."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs, take_roofs
from pipeline.geometry.rings import make_canonical, sort_canonically
from pipeline.roofs.roof_surfaces import LEAST_ANGLE
from pipeline.simplification.fidelity import find_sharpest, measure_moved_roofs
from pipeline.simplification.graph import MILLIMETRES
from pipeline.simplification.labels import Territories
from pipeline.simplification.merge import check_footprints
from pipeline.simplification.shaping import (
    LAST_RUNG,
    RUNGS,
    Rules,
    Shaped,
    add_counts,
    join_shaped,
    shape_clusters,
)

CHAIN_TOLERANCE = 0.1  # m; 0.2 m saves 1 % of the walls more and costs a tenth of the area error more
FINER_TOLERANCE = 0.05  # m; of finer clusters: a step of 7 cm between a court and a high roof counts
# A cluster is shaped again with a finer clearance where moved walls put the known roofs of more than `OFF_SHARE`
# of its buildings off by more than `ROOF_OFF` (m, RMSE), or those of the median one by more than `MEDIAN_OFF`.
ROOF_OFF, OFF_SHARE, MEDIAN_OFF = 0.5, 0.05, 0.15
COUNTS = (
    # Clusters: all, those joined here (none: `house_clusters` joins them), and how many ended on which rung.
    *("clusters", "clusters-joined", *RUNGS, LAST_RUNG),
    # What the rounds did, tries that failed included: the most rounds of a cluster, vertices, edges.
    *("rounds", "straightened", "collapsed", "contracted", "bent", "crossings"),
    # Faces given to a neighbour; sharp corners cut; touching corners opened or closed.
    *("small-faces", "blunted", "opened", "closed"),
    # The result: vertices in which houses only touch, houses of several faces, of none, the area of these.
    *("corner-touches", "houses-divided", "houses-lost", "lost-area-m2"),
)


@dataclass(frozen=True, eq=False)
class PlanarCity:
    """Houses as faces of one planar graph of walls."""

    #: (k,): valid shapely Polygons (m) in canonical form and order, courtyards as holes. A wall between two of
    #: them has the same vertices, bit for bit, in both
    polygons: NDArray[np.object_]
    house: NDArray[np.int64]  #: (k,): index of the input polygon that each belongs to
    #: k of them: how the walls of its cluster got their clearance: ``"snapped"``, ``"snapped-wider"`` (with 1.5
    #: times the clearance) or ``"cells"`` (redrawn with square cells)
    method: tuple[str, ...]
    counts: dict[str, int]  #: what was done, all keys of `COUNTS` in their order
    lost: tuple[int, ...]  #: indices of the input polygons that have no face, ascending
    clearance: NDArray[np.float64]  #: (k,): what the walls of its cluster keep (m)


def shape_planar(
    polygons: NDArray[np.object_],
    cluster: NDArray[np.int64],
    *,
    clearance: float,
    min_area: float,
    min_courtyard_area: float,
    manifold: bool = False,
    roofs: Roofs | None = None,
    building: NDArray[np.int64] | None = None,
    finer: float = 0.0,
) -> PlanarCity:
    """Give all walls of each cluster a least distance, whatever the distance of clusters; keep every house.

    Parameters
    ----------
    polygons : object, (n,)
        Valid shapely Polygons (m), as step 1.4 leaves them; they may overlap.
    cluster : int64, (n,)
        Their clusters, numbered from 0 to at most ``n - 1``.
    clearance : float
        Least distance of any two vertices of walls, and of a vertex and a wall that does not end in it (m).
    min_area : float
        Smaller pieces of a house, but for its largest, go to a neighbour or to the open ground (m²).
    min_courtyard_area : float
        Smaller courtyards, within a house or between houses, are given to the house along the longest wall (m²).
    manifold : bool
        Open the corners in which houses only touch, or close them, so that no edge of the mesh's boundary has
        four faces. Such corners are counted either way; those without room for it stay.
    roofs : Roofs, optional
        Known roofs of the polygons, NaN where there is none: ground covered by several polygons whose roofs are
        known goes to the highest one there.
    building : int64, (n,), optional
        The building of each polygon, for ``finer``; by default one each.
    finer : float
        Clearance of a cluster whose roofs are off otherwise (m), kept if that helps (`OFF_SHARE`); 0 for none.

    Returns
    -------
    PlanarCity
        All walls of the houses of a cluster have the clearance, up to the rounding of coordinates (1e-7 m); no
        two of its faces overlap.

    Raises
    ------
    GeometryError
        If an input polygon is invalid or empty.
    ValueError
        Unless the clearance is `CHAIN_TOLERANCE` or more and the areas are not negative.

    Notes
    -----
    Ground covered by several houses goes to the smallest one. A face of the settled walls is the house's that
    covers most of it, and open where less than half was built, so a gap narrower than the clearance vanishes and
    a street stays. A cluster's result has the same bytes for any order of the input and any other houses around.
    Vertices lie on a grid of 1 mm. O(n log n), some 0.5 ms a house in a dense block.

    Angles below 20 degrees are cut where the walls are long enough; none is promised. What the clearance gives
    by itself: the sine of an angle is at least the clearance over the length of its shorter wall.

    References
    ----------
    Iterated snap rounding (Halperin and Packer 2002), with discs around vertices in place of pixels, is the
    nearest relative; the rounds, their order and the labels are ours.

    Examples
    --------
    >>> pair = np.array([shapely.box(0, 0, 4, 4), shapely.box(4.3, 0, 9, 4)])
    >>> city = shape_planar(pair, np.zeros(2, int), clearance=0.5, min_area=5.0, min_courtyard_area=5.0)
    >>> for house, polygon in zip(city.house, city.polygons):
    ...     print(house, polygon)
    0 POLYGON ((0 0, 4.3 0, 4.3 4, 0 4, 0 0))
    1 POLYGON ((4.3 0, 9 0, 9 4, 4.3 4, 4.3 0))
    """
    if not (clearance >= CHAIN_TOLERANCE and min_area >= 0 and min_courtyard_area >= 0):
        raise ValueError(
            f"want {CHAIN_TOLERANCE:g} <= clearance {clearance}, min_area {min_area} >= 0 and "
            f"min_courtyard_area {min_courtyard_area} >= 0"
        )
    check_footprints(polygons)
    canonical = make_canonical(polygons)
    order = sort_canonically(canonical)
    houses = shapely.transform(canonical[order], lambda xy: xy * MILLIMETRES)
    lengths = (clearance * MILLIMETRES, CHAIN_TOLERANCE * MILLIMETRES)
    areas = (min_area * MILLIMETRES**2, min_courtyard_area * MILLIMETRES**2)
    rules = Rules(*lengths, *areas, manifold)
    known = None if roofs is None else take_roofs(roofs, order)
    shaped, territories, counts = shape_clusters(houses, cluster[order], rules, known)
    refined = np.empty(0, np.int64)
    if finer and known is not None:
        owner = order if building is None else building[order]
        lengths = (finer * MILLIMETRES, FINER_TOLERANCE * MILLIMETRES)
        rules = Rules(*lengths, *areas, manifold, least_moved=True)
        shaped, refined = _refine(shaped, territories, counts, houses, cluster[order], owner, known, rules)
    kept = np.where(np.isin(shaped.cluster, refined), finer, clearance)
    return _finish(shaped, counts, order, polygons, kept)


def _refine(
    shaped: Shaped,
    territories: Territories,
    counts: Counter[str],
    houses: NDArray[np.object_],
    cluster: NDArray[np.int64],
    building: NDArray[np.int64],
    roofs: Roofs,
    finer: Rules,
) -> tuple[Shaped, NDArray[np.int64]]:
    """Shape the clusters whose roofs are off once more; give those that this helped, in their new shape."""
    share, median = _measure_roofs_off(territories, shaped, roofs, building, cluster)
    off = np.flatnonzero((share > OFF_SHARE) | (median > MEDIAN_OFF))
    if not len(off):
        return shaped, off
    todo = np.where(np.isin(cluster, off), cluster, -1)
    again, territories, more = shape_clusters(houses, todo, finer, roofs)
    add_counts(counts, more)
    left, now = _measure_roofs_off(territories, again, roofs, building, todo)
    better = off[(left < share)[off] | ((median > MEDIAN_OFF) & (now <= MEDIAN_OFF))[off]]
    better = better[[_keeps_angles(shaped, again, k) for k in better.tolist()]]
    return join_shaped([shaped.leave_out(better), again.leave_out(np.setdiff1d(off, better))]), better


def _measure_roofs_off(
    territories: Territories,
    shaped: Shaped,
    roofs: Roofs,
    building: NDArray[np.int64],
    cluster: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Share of buildings above `ROOF_OFF` and median of their RMSE (m) in each cluster; 0 where none has one."""
    rmse = measure_moved_roofs(territories, shaped, roofs, building)
    of = np.full(len(rmse), -1)
    of[building] = cluster
    rows = np.flatnonzero((of >= 0) & ~np.isnan(rmse))
    rows = rows[np.lexsort((rmse[rows], of[rows]))]
    n = len(cluster)
    count = np.bincount(of[rows], minlength=n)
    median, some = np.zeros(n), np.flatnonzero(count)
    start = (np.cumsum(count) - count)[some]
    median[some] = rmse[rows][np.stack((start + (count[some] - 1) // 2, start + count[some] // 2))].mean(axis=0)
    return np.bincount(of[rows], rmse[rows] > ROOF_OFF, n) / np.maximum(count, 1), median


def _keeps_angles(one: Shaped, other: Shaped, cluster: int) -> bool:
    """Whether a cluster has no sharper angles in the other shape, or none below `LEAST_ANGLE`."""
    before, after = (find_sharpest(shaped.polygons[shaped.cluster == cluster]) for shaped in (one, other))
    return after >= min(before, LEAST_ANGLE)


def _finish(
    shaped: Shaped,
    counts: Counter[str],
    order: NDArray[np.int64],
    given: NDArray[np.object_],
    clearance: NDArray[np.float64],
) -> PlanarCity:
    """Go back to metres, to the canonical order and to the input's indices."""
    polygons = make_canonical(shapely.transform(shaped.polygons, lambda xy: xy / MILLIMETRES))
    rows = sort_canonically(polygons)
    house = order[shaped.house[rows]]
    lost = np.setdiff1d(np.arange(len(given)), house)
    counts.update(shaped.method.values())
    counts["clusters"] = len(shaped.method)
    counts["corner-touches"] = len(shaped.touches)
    counts["houses-divided"] = int((np.bincount(house, minlength=1) > 1).sum())
    counts["houses-lost"] = len(lost)
    counts["lost-area-m2"] = int(np.ceil(shapely.area(given[lost]).sum()))
    return PlanarCity(
        polygons=polygons[rows],
        house=house,
        method=tuple(shaped.method[int(name)] for name in shaped.cluster[rows]),
        counts={key: counts[key] for key in COUNTS},
        lost=tuple(lost.tolist()),
        clearance=clearance[rows],
    )
