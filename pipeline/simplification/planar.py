"""The city model as one planar graph of walls with a guaranteed clearance (step 2.1, our way)."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.data.roofs import Roofs, take_roofs
from pipeline.geometry.components import join_pairs
from pipeline.geometry.rings import make_canonical, sort_canonically
from pipeline.roofs.roof_surfaces import LEAST_ANGLE
from pipeline.simplification.fidelity import find_sharpest, measure_moved_roofs
from pipeline.simplification.graph import MILLIMETRES
from pipeline.simplification.labels import Territories
from pipeline.simplification.shaping import LAST_RUNG, RUNGS, Rules, Shaped, join_shaped, shape_clusters

# Metres. On 1,475 houses of Amsterdam 0.5 m changes 0.28 % of the area and 1 m 0.71 %; both keep every house and
# every angle above 20 degrees, and 0.5 m costs 20 % more triangles at a mesh size of 10 m.
CLEARANCE = 0.5
# Metres. 0.2 m saves 1 % of the walls more and costs a tenth of the area error more.
CHAIN_TOLERANCE = 0.1
SMALLEST_CLEARANCE = 0.01  # m; ten steps of the grid
# A cluster is shaped again with a finer clearance where moved walls put the known roofs of more than `OFF_SHARE`
# of its buildings off by more than `ROOF_OFF` (m, RMSE), or those of the median one by more than `MEDIAN_OFF`.
ROOF_OFF, OFF_SHARE, MEDIAN_OFF = 0.5, 0.05, 0.15
COUNTS = (
    # Clusters: all, those fewer by joining, and how many ended on which rung.
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
    """Houses as faces of one planar graph of walls.

    Attributes
    ----------
    polygons : object, (k,)
        Valid shapely Polygons (m) in canonical form and order, courtyards as holes. A wall between two of
        them has the same vertices, bit for bit, in both.
    house : int64, (k,)
        Index of the input polygon that each belongs to.
    method : tuple of k str
        How the walls of its cluster got their clearance: ``"snapped"``, ``"snapped-wider"`` (with 1.5 times the
        clearance) or ``"cells"`` (redrawn with square cells).
    cluster : int64, (n,)
        The cluster of each input polygon, named by the smallest index in it.
    counts : dict of str to int
        What was done, all keys of `COUNTS` in their order.
    lost : tuple of int
        Indices of the input polygons that have no face, ascending.
    clearance : float64, (k,)
        What the walls of its cluster keep (m).
    """

    polygons: NDArray[np.object_]
    house: NDArray[np.int64]
    method: tuple[str, ...]
    cluster: NDArray[np.int64]
    counts: dict[str, int]
    lost: tuple[int, ...]
    clearance: NDArray[np.float64]


def simplify_planar(
    polygons: NDArray[np.object_],
    *,
    clearance: float = CLEARANCE,
    chain_tolerance: float = CHAIN_TOLERANCE,
    min_area: float,
    min_courtyard_area: float,
    manifold: bool = False,
) -> PlanarCity:
    """Give all walls a least distance; keep every house, and the walls between houses.

    Parameters
    ----------
    polygons : object, (n,)
        Valid shapely Polygons (m), as step 1.4 leaves them; they may overlap.
    clearance : float
        Least distance of any two vertices of walls, and of a vertex and a wall that does not end in it (m).
    chain_tolerance : float
        A vertex of two walls goes if no wall moves farther than this by it (m).
    min_area : float
        Smaller pieces of a house, but for its largest, go to a neighbour or to the open ground (m²).
    min_courtyard_area : float
        Smaller courtyards, within a house or between houses, are given to the house along the longest wall (m²).
    manifold : bool
        Open the corners in which houses only touch, or close them, so that no edge of the mesh's boundary has
        four faces. Such corners are counted either way; those without room for it stay.

    Returns
    -------
    PlanarCity
        All walls of all houses, clusters taken together, have the clearance, up to the rounding of coordinates
        (1e-7 m); no two faces overlap.

    Raises
    ------
    GeometryError
        If an input polygon is invalid or empty.
    ValueError
        Unless ``0.01 <= clearance``, ``0 <= chain_tolerance <= clearance`` and the areas are not negative.

    Notes
    -----
    Ground covered by several houses goes to the smallest one. A face of the settled walls is the house's that
    covers most of it, and open where less than half was built, so a gap narrower than the clearance vanishes and
    a street stays. Clusters are chains of polygons closer than the clearance, and of polygons whose results
    came closer than that: these are taken together and shaped again, until none are. A cluster's
    result has the same bytes for any order of the input and any other houses around. Vertices lie on a grid of
    1 mm. O(n log n), some 0.5 ms a house in a dense block.

    Angles below 20 degrees are cut where the walls are long enough; none is promised. What the clearance gives
    by itself: the sine of an angle is at least the clearance over the length of its shorter wall.

    References
    ----------
    Iterated snap rounding (Halperin and Packer 2002), with discs around vertices in place of pixels, is the
    nearest relative; the rounds, their order and the labels are ours.

    Examples
    --------
    >>> pair = np.array([shapely.box(0, 0, 4, 4), shapely.box(4.3, 0, 9, 4)])
    >>> city = simplify_planar(pair, clearance=0.5, min_area=5.0, min_courtyard_area=5.0)
    >>> for house, polygon in zip(city.house, city.polygons):
    ...     print(house, polygon)
    0 POLYGON ((0 0, 4.3 0, 4.3 4, 0 4, 0 0))
    1 POLYGON ((4.3 0, 9 0, 9 4, 4.3 4, 4.3 0))
    """
    houses, order, rules = _prepare(polygons, clearance, chain_tolerance, min_area, min_courtyard_area, manifold)
    shaped, cluster, counts = _shape_all(houses, rules)
    return _finish(shaped, cluster, counts, order, polygons, np.full(len(shaped.house), clearance))


def shape_planar(
    polygons: NDArray[np.object_],
    cluster: NDArray[np.int64],
    *,
    clearance: float = CLEARANCE,
    chain_tolerance: float = CHAIN_TOLERANCE,
    min_area: float,
    min_courtyard_area: float,
    manifold: bool = False,
    roofs: Roofs | None = None,
    building: NDArray[np.int64] | None = None,
    finer: float = 0.0,
) -> PlanarCity:
    """Give all walls of each cluster a least distance, whatever the distance of clusters.

    Parameters
    ----------
    polygons : object, (n,)
        As in `simplify_planar`.
    cluster : int64, (n,)
        Their clusters, numbered from 0 to at most ``n - 1``.
    clearance, chain_tolerance, min_area, min_courtyard_area, manifold
        As in `simplify_planar`, and so are errors and the result of each cluster.
    roofs : Roofs, optional
        Known roofs of the polygons, NaN where there is none: ground covered by several polygons whose roofs are
        known goes to the highest one there.
    building : int64, (n,), optional
        The building of each polygon, for ``finer``; by default one each.
    finer : float
        Clearance of a cluster whose roofs are off otherwise (m), kept if that helps (`OFF_SHARE`); 0 for none.
    """
    houses, order, rules = _prepare(polygons, clearance, chain_tolerance, min_area, min_courtyard_area, manifold)
    known = None if roofs is None else take_roofs(roofs, order)
    cluster = cluster[order]
    shaped, territories, counts = shape_clusters(houses, cluster, rules, known)
    kept = np.full(len(shaped.house), clearance)
    if finer and known is not None:
        owner = order if building is None else building[order]
        share, median = _measure_roofs_off(territories, shaped, known, owner, cluster)
        off = np.flatnonzero((share > OFF_SHARE) | (median > MEDIAN_OFF))
        if len(off):
            todo = np.where(np.isin(cluster, off), cluster, -1)
            again, territories, more = shape_clusters(
                houses, todo, replace(rules, clearance=finer * MILLIMETRES), known
            )
            more["rounds"] = max(more["rounds"] - counts["rounds"], 0)  # of rounds, the most count
            counts.update(more)
            left, now = _measure_roofs_off(territories, again, known, owner, todo)
            better = off[(left < share)[off] | ((median > MEDIAN_OFF) & (now <= MEDIAN_OFF))[off]]
            better = better[[_keeps_angles(shaped, again, k) for k in better.tolist()]]
            again = again.leave_out(np.setdiff1d(off, better))
            kept = np.concatenate((kept[~np.isin(shaped.cluster, better)], np.full(len(again.house), finer)))
            shaped = join_shaped([shaped.leave_out(better), again])
    return _finish(shaped, cluster, counts, order, polygons, kept)


def find_clusters(polygons: NDArray[np.object_], clearance: float) -> NDArray[np.int64]:
    """Find the chains of polygons closer than the clearance.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons.
    clearance : float
        Bound on the distance (in the unit of the coordinates).

    Returns
    -------
    int64, (n,)
        Cluster of each polygon, named by the smallest index in it.
    """
    i, j = _find_close_pairs(polygons, clearance)
    return join_pairs(len(polygons), np.column_stack((i, j)))


def _prepare(
    polygons: NDArray[np.object_],
    clearance: float,
    chain_tolerance: float,
    min_area: float,
    min_courtyard_area: float,
    manifold: bool,
) -> tuple[NDArray[np.object_], NDArray[np.int64], Rules]:
    """Check the input; put it in canonical order and into millimetres."""
    _check(polygons, clearance, chain_tolerance, min_area, min_courtyard_area)
    canonical = make_canonical(polygons)
    order = sort_canonically(canonical)
    rules = Rules(
        clearance * MILLIMETRES,
        chain_tolerance * MILLIMETRES,
        min_area * MILLIMETRES**2,
        min_courtyard_area * MILLIMETRES**2,
        manifold,
    )
    return shapely.transform(canonical[order], lambda xy: xy * MILLIMETRES), order, rules


def _shape_all(houses: NDArray[np.object_], rules: Rules) -> tuple[Shaped, NDArray[np.int64], Counter[str]]:
    """Shape all clusters, joining those whose results come too close."""
    cluster = find_clusters(houses, rules.clearance)
    todo = cluster
    shaped = join_shaped([])
    counts = Counter[str]()
    while True:
        piece, _, done = shape_clusters(houses, todo, rules)
        counts.update(done)
        shaped = join_shaped([shaped, piece])
        i, j = _find_close_pairs(shaped.polygons, rules.clearance)
        i, j = shaped.cluster[i], shaped.cluster[j]
        if (i == j).all():
            return shaped, cluster, counts
        joined = join_pairs(len(houses), np.column_stack((i, j)))[cluster]
        touched = np.isin(joined, joined[joined != cluster])
        counts["clusters-joined"] += len(np.unique(cluster)) - len(np.unique(joined))
        shaped = shaped.leave_out(cluster[touched])
        cluster, todo = joined, np.where(touched, joined, -1)


def _find_close_pairs(
    polygons: NDArray[np.object_], clearance: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    i, j = shapely.STRtree(polygons).query(polygons, predicate="dwithin", distance=clearance)
    later = i < j
    i, j = i[later], j[later]
    close = shapely.distance(polygons[i], polygons[j]) < clearance
    return i[close], j[close]


def _finish(
    shaped: Shaped,
    cluster: NDArray[np.int64],
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
    smallest = np.full(len(given), len(given))
    np.minimum.at(smallest, cluster, order)
    named = np.empty(len(given), np.int64)
    named[order] = smallest[cluster]
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
        cluster=named,
        counts={key: counts[key] for key in COUNTS},
        lost=tuple(lost.tolist()),
        clearance=clearance[rows],
    )


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


def _check(
    polygons: NDArray[np.object_],
    clearance: float,
    chain_tolerance: float,
    min_area: float,
    min_courtyard_area: float,
) -> None:
    if not (
        clearance >= SMALLEST_CLEARANCE
        and 0 <= chain_tolerance <= clearance
        and min_area >= 0
        and min_courtyard_area >= 0
    ):
        raise ValueError(
            f"want {SMALLEST_CLEARANCE} <= clearance {clearance}, 0 <= chain_tolerance {chain_tolerance} <= "
            f"clearance, min_area {min_area} >= 0 and min_courtyard_area {min_courtyard_area} >= 0"
        )
    usable = (shapely.get_type_id(polygons) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(polygons)
    usable &= shapely.is_valid(polygons)
    if not usable.all():
        i = int(np.flatnonzero(~usable)[0])
        raise GeometryError(
            f"step 2.1: footprint {i} ({shapely.is_valid_reason(polygons[i])}) and "
            f"{int((~usable).sum()) - 1} others of {len(polygons)} are no valid polygons; "
            "clean them first (step 1.4)"
        )
