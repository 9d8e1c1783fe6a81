"""Clusters of close houses, each simplified by itself, and joined until none are close (step 2.1).

A round simplifies every cluster from its houses alone, then joins the clusters whose results came closer than
the clearance; joined ones are simplified again from the same houses. What comes out of a cluster depends on its
houses and nothing else, so tiles can share the work and all get the same model.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.city import CityOptions
from pipeline.data.roofs import Roofs, take_roofs
from pipeline.roofs.house_levels import HouseParts
from pipeline.simplification.graph import MILLIMETRES
from pipeline.simplification.merge import merge_footprints
from pipeline.simplification.planar import PlanarCity, shape_planar

KEPT = 0.5  # a house that keeps less of its area than this is simplified again by its closed outline
ROUNDING = 1e-4  # mm, of distances
HELPS = 1.2  # closing an outline must add a fifth of its area: a wall without width stays one


@dataclass(frozen=True, eq=False)
class Shapes:
    """Buildings of some simplified clusters."""

    polygons: NDArray[np.object_]  #: (k,): valid shapely Polygons (m)
    #: (k + 1,): building ``i`` was made of the parts ``member[member_start[i]:member_start[i + 1]]``
    member_start: NDArray[np.int64]
    member: NDArray[np.int64]  #: rows of parts, ascending in each building
    cluster: NDArray[np.int64]  #: (k,): cluster of each building
    closed: NDArray[np.int64]  #: (c, 2): row and cluster of each part that was simplified by its closed outline
    clearance: NDArray[np.float64]  #: (k,): least distance of walls in the cluster of each building (m)
    counts: dict[str, int]  #: what was done, by name

    def __len__(self) -> int:
        return len(self.polygons)


def shape_clusters(
    parts: HouseParts, cluster: NDArray[np.int64], options: CityOptions, roofs: Roofs | None = None
) -> Shapes:
    """Simplify some clusters, each from its own houses.

    Parameters
    ----------
    cluster : int64, (h,)
        Cluster of each house; -1 for houses to leave out.
    options : CityOptions
        Parameters; `simplify` chooses the way.
    roofs : Roofs, optional
        Known roofs of the parts, NaN where there is none, as for `shape_planar`; not used by the paper's way.
    """
    of_part = cluster[parts.house]
    rows = np.flatnonzero(of_part >= 0)
    if options.simplify == "paper":
        return _merge_clusters(parts.polygons, rows, of_part, options)
    return _shape_planar_clusters(parts, rows, of_part, options, roofs)


def find_close(polygons: NDArray[np.object_], clearance: float) -> NDArray[np.int64]:
    """Find the pairs of polygons closer to each other than the clearance.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons (m).
    clearance : float
        Bound on the distance (m).

    Returns
    -------
    int64, (p, 2)
        Rows, the smaller one first.

    Notes
    -----
    Distances are compared in millimetres and ones that differ from the clearance by rounding alone count as
    equal to it, since simplified walls stand exactly that far apart.
    """
    i, j = shapely.STRtree(polygons).query(polygons, predicate="dwithin", distance=clearance)
    later = i < j
    i, j = i[later], j[later]
    close = shapely.distance(polygons[i], polygons[j]) * MILLIMETRES < clearance * MILLIMETRES - ROUNDING
    return np.column_stack((i[close], j[close])).astype(np.int64)


def join_shapes(several: Sequence[Shapes]) -> Shapes:
    """Put the buildings of different clusters together; their parts are rows of one list."""
    nothing = np.empty(0, np.int64)
    counts = Counter[str]()
    for shapes in several:
        counts.update(shapes.counts)
    size = np.concatenate([nothing, *(np.diff(shapes.member_start) for shapes in several)])
    return Shapes(
        np.concatenate([nothing.astype(object), *(shapes.polygons for shapes in several)]),
        np.concatenate(([0], np.cumsum(size))).astype(np.int64),
        np.concatenate([nothing, *(shapes.member for shapes in several)]),
        np.concatenate([nothing, *(shapes.cluster for shapes in several)]),
        np.concatenate([np.empty((0, 2), np.int64), *(shapes.closed for shapes in several)]),
        np.concatenate([np.empty(0), *(shapes.clearance for shapes in several)]),
        dict(counts),
    )


def leave_out(shapes: Shapes, clusters: NDArray[np.int64]) -> Shapes:
    """Forget some clusters."""
    kept = keep_shapes(shapes, ~np.isin(shapes.cluster, clusters))
    return replace(kept, closed=shapes.closed[~np.isin(shapes.closed[:, 1], clusters)])


def keep_shapes(shapes: Shapes, stays: NDArray[np.bool_]) -> Shapes:
    """Keep some buildings, whatever their cluster; `closed` is left as it is."""
    size = np.diff(shapes.member_start)
    return replace(
        shapes,
        polygons=shapes.polygons[stays],
        member_start=np.concatenate(([0], np.cumsum(size[stays]))).astype(np.int64),
        member=shapes.member[np.repeat(stays, size)],
        cluster=shapes.cluster[stays],
        clearance=shapes.clearance[stays],
    )


def close_outlines(polygons: NDArray[np.object_], clearance: float) -> NDArray[np.object_]:
    """Fill the gaps of each polygon that are narrower than twice the clearance.

    Examples
    --------
    >>> slot = shapely.box(0, 0, 10, 10) - shapely.box(4, 2, 5, 10)
    >>> shapely.area(close_outlines(np.array([slot], dtype=object), 1.0))
    array([100.])
    """
    grown = shapely.buffer(polygons, clearance, join_style="mitre")
    shrunk = shapely.buffer(grown, -clearance, join_style="mitre")
    closed = polygons.copy()
    for row, shape in enumerate(shrunk):
        parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon" and part.area > 0]
        if parts:
            closed[row] = shapely.normalize(max(parts, key=lambda part: float(part.area)))
    return closed


def _merge_clusters(
    polygons: NDArray[np.object_], rows: NDArray[np.int64], cluster: NDArray[np.int64], options: CityOptions
) -> Shapes:
    """Merge the buildings of each cluster, the paper's way."""
    rows = rows[np.argsort(cluster[rows], kind="stable")]
    pieces = [join_shapes([])]
    for of_cluster in np.split(rows, np.flatnonzero(np.diff(cluster[rows])) + 1) if len(rows) else []:
        merged = merge_footprints(
            polygons[of_cluster],
            clearance=options.clearance,
            min_hole_area=options.min_courtyard_area,
            floor=options.clearance_floor,
            tolerance=options.vertex_tolerance,
        )
        members = [np.sort(of_cluster[group]) for group in merged.members]
        pieces.append(
            Shapes(
                merged.polygons,
                np.cumsum([0, *(len(group) for group in members)]),
                np.concatenate(members),
                np.full(len(members), cluster[of_cluster[0]]),
                np.empty((0, 2), np.int64),
                np.full(len(members), options.clearance),
                {f"merge {how}": n for how, n in sorted(merged.counts.items())},
            )
        )
    return join_shapes(pieces)


def _shape_planar_clusters(
    parts: HouseParts,
    rows: NDArray[np.int64],
    cluster: NDArray[np.int64],
    options: CityOptions,
    roofs: Roofs | None,
) -> Shapes:
    """Shape each cluster as one planar graph; where a house loses most of itself, by its closed outline.

    A comb of thin walls does that. Other clusters come out as before, to the bit.
    """
    planar = _shape_planar(parts, rows, cluster, options, roofs)
    closable, outlines = _find_closable(parts.polygons, rows, cluster, planar, options.clearance)
    if not len(closable):
        return planar
    shapes = parts.polygons.copy()
    shapes[closable] = outlines
    again = np.unique(cluster[closable])
    closed_parts = replace(parts, polygons=shapes)
    redone = _shape_planar(closed_parts, rows[np.isin(cluster[rows], again)], cluster, options, roofs)
    closed = np.column_stack((closable, cluster[closable]))
    return join_shapes([leave_out(planar, again), replace(redone, closed=closed)])


def _shape_planar(
    parts: HouseParts,
    rows: NDArray[np.int64],
    cluster: NDArray[np.int64],
    options: CityOptions,
    roofs: Roofs | None,
) -> Shapes:
    planar: PlanarCity = shape_planar(
        parts.polygons[rows],
        np.unique(cluster[rows], return_inverse=True)[1].reshape(-1),
        clearance=options.clearance,
        min_area=options.min_building_area,
        min_courtyard_area=options.min_courtyard_area,
        manifold=options.manifold,
        roofs=None if roofs is None else take_roofs(roofs, rows),
        building=np.unique(parts.house[rows], return_inverse=True)[1].reshape(-1),
        finer=options.finer_clearance,
    )
    member = rows[planar.house]
    return Shapes(
        planar.polygons,
        np.arange(len(member) + 1),
        member,
        cluster[member],
        np.empty((0, 2), np.int64),
        planar.clearance,
        {f"planar {how}": n for how, n in planar.counts.items()},
    )


def _find_closable(
    polygons: NDArray[np.object_],
    rows: NDArray[np.int64],
    cluster: NDArray[np.int64],
    planar: Shapes,
    clearance: float,
) -> tuple[NDArray[np.int64], NDArray[np.object_]]:
    """Find the parts that lost most of themselves, and not to houses of their cluster, and closed outlines."""
    kept = np.zeros(len(polygons))
    np.add.at(kept, planar.member, shapely.area(shapely.intersection(planar.polygons, polygons[planar.member])))
    poor = rows[kept[rows] < KEPT * shapely.area(polygons[rows])]
    part, building = shapely.STRtree(planar.polygons).query(polygons[poor], predicate="intersects")
    ours = cluster[poor[part]] == planar.cluster[building]
    part, building = part[ours], building[ours]
    over = shapely.area(shapely.intersection(polygons[poor[part]], planar.polygons[building]))
    area = shapely.area(polygons[poor])
    lost = np.bincount(part, over, len(poor)) < KEPT * area
    outlines = close_outlines(polygons[poor[lost]], clearance)
    # Closing helps only where there is something between the walls.
    helps = shapely.area(outlines) > HELPS * area[lost]
    return poor[lost][helps], outlines[helps]
