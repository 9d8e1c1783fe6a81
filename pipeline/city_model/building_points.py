"""Step 1.5: roof and ground points of each building."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.classes import BUILDING, GROUND, NEVER_ROOF, WATER
from pipeline.data.kernel import kernel
from pipeline.data.pointcloud import PointCloud
from pipeline.geometry.group_order import sort_values
from pipeline.geometry.inside import are_inside, find_inside

OUTLIER_DEVIATIONS = 2.0  # paper, step 1.5
FINE_OUTLINE = 2000  # vertices; only the largest of real houses have so many


@dataclass(frozen=True, eq=False)
class BuildingPoints:
    """Heights of the roof and ground points of ``n`` buildings.

    Attributes
    ----------
    roof_start, ground_start : int64, (n + 1,)
        Building ``i`` has ``roof_z[roof_start[i]:roof_start[i + 1]]``, and its ground points likewise.
    roof_z, ground_z : float64
        Absolute heights (m), ascending within each building.
    """

    roof_start: NDArray[np.int64]
    roof_z: NDArray[np.float64]
    ground_start: NDArray[np.int64]
    ground_z: NDArray[np.float64]


def has_building_class(cloud: PointCloud) -> bool:
    """Tell whether any point is classified as building (class 6)."""
    return bool((cloud.classification == BUILDING).any())


def extract_building_points(
    cloud: PointCloud,
    polygons: NDArray[np.object_],
    *,
    margin: float,
    building_class: bool,
    roof: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None,
) -> BuildingPoints:
    """Extract each building's roof and ground points, outliers removed (paper, step 1.5).

    Parameters
    ----------
    cloud : PointCloud
        Points of the tile and its halo.
    polygons : object, (n,)
        Valid shapely Polygons.
    margin : float
        Ground points (classes 2 and 9) lie outside the footprint within this distance (m).
    building_class : bool
        True: roof points are those of class 6 inside. False, for a cloud without that class: those inside
        that are neither ground, water, vegetation nor noise, and no rail, road, wire or bridge deck.
    roof : (start, z), optional
        The roof points of each polygon, where they are known: int64 (n + 1,), and heights (m), ascending in each.

    Returns
    -------
    BuildingPoints
        Points within two standard deviations of the mean of their building.

    Notes
    -----
    The result does not depend on the order of the points.
    """
    if roof is None:
        on_roof = (
            cloud.classification == BUILDING if building_class else ~np.isin(cloud.classification, NEVER_ROOF)
        )
        roof = _points_inside(cloud.xyz, on_roof, polygons, None)
    ground = (cloud.classification == GROUND) | (cloud.classification == WATER)
    rings = shapely.buffer(_coarsened(polygons, margin), margin)
    ground_start, ground_z = _points_inside(cloud.xyz, ground, rings, polygons)
    return BuildingPoints(*remove_outliers(*roof), *remove_outliers(ground_start, ground_z))


def reach_of_points(polygons: NDArray[np.object_], margin: float) -> NDArray[np.object_]:
    """Lay an area around each polygon that has all points which `extract_building_points` may take of it.

    Parameters
    ----------
    polygons : object, (n,)
        Valid shapely Polygons.
    margin : float
        As there (m).

    Returns
    -------
    object, (n,)
        Wide enough for parts of the polygons too, whose walls may be some millimetres off theirs: twice a quarter
        of the margin by coarsening, and what rounded corners lack.
    """
    areas: NDArray[np.object_] = shapely.buffer(_coarsened(polygons, margin), 1.6 * margin + 0.1)
    return areas


def _coarsened(polygons: NDArray[np.object_], margin: float) -> NDArray[np.object_]:
    """Simplify what has very many vertices within a quarter of the margin that is laid around it.

    Arcs around vertices that are closer to each other than the margin all cross: the time grows with the square of
    their number. Ragged outlines of 40,000 vertices took 36 s and 2 GB.
    """
    fine = shapely.get_num_coordinates(polygons) > FINE_OUTLINE
    coarse: NDArray[np.object_] = polygons.copy()
    coarse[fine] = shapely.simplify(polygons[fine], margin / 4)
    return coarse


def remove_outliers(
    start: NDArray[np.int64], z: NDArray[np.float64], *, deviations: float = OUTLIER_DEVIATIONS
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Remove the values farther than `deviations` standard deviations from the mean of their group.

    Parameters
    ----------
    start : int64, (n + 1,)
        Group ``i`` is ``z[start[i]:start[i + 1]]``; groups may be empty.
    z : float64
        Values, ascending within each group.

    Returns
    -------
    start, z
        The same for the values that stay.

    Examples
    --------
    >>> remove_outliers(np.array([0, 0, 7]), np.array([1.0, 1, 1, 1, 1, 1, 9]))
    (array([0, 0, 6]), array([1., 1., 1., 1., 1., 1.]))
    """
    keep, kept = _select_close(start, z, deviations)
    return np.concatenate(([0], np.cumsum(kept))), z[keep]


@kernel
def _select_close(
    start: NDArray[np.int64], z: NDArray[np.float64], deviations: float
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Select the values close to the mean of their group, bool (k,), and count them in each, int64 (n,)."""
    keep, kept = np.zeros(len(z), np.bool_), np.zeros(len(start) - 1, np.int64)
    for g in range(len(kept)):
        group = z[start[g] : start[g + 1]]
        total = squares = 0.0
        for value in group:
            total += value
        mean = total / max(len(group), 1)
        for value in group:
            squares += (value - mean) * (value - mean)
        # A group of equal values has a deviation of rounding errors only: keep it whole.
        most = deviations * np.sqrt(squares / max(len(group), 1)) + 1e-9
        for k in range(start[g], start[g + 1]):
            keep[k] = abs(z[k] - mean) <= most
            kept[g] += keep[k]
    return keep, kept


def merge_building_points(points: BuildingPoints, members: tuple[NDArray[np.int64], ...]) -> BuildingPoints:
    """Pool the points of the buildings that were merged (paper, step 2.3).

    Parameters
    ----------
    points : BuildingPoints
        Points of the original buildings.
    members : tuple of int64 arrays
        The originals that each merged building is made of.
    """
    owner = np.full(len(points.roof_start) - 1, -1)
    for building, originals in enumerate(members):
        owner[originals] = building
    roof = _regroup(points.roof_start, points.roof_z, owner, len(members))
    ground = _regroup(points.ground_start, points.ground_z, owner, len(members))
    return BuildingPoints(*roof, *ground)


def take_building_points(points: BuildingPoints, rows: NDArray[np.int64]) -> BuildingPoints:
    """Take the points of some buildings, in the order of `rows`, int64 (k,), which may repeat."""
    roof = _take(points.roof_start, points.roof_z, rows)
    return BuildingPoints(*roof, *_take(points.ground_start, points.ground_z, rows))


def join_building_points(several: Sequence[BuildingPoints]) -> BuildingPoints:
    """Put the points of the buildings of several lists one after the other."""

    def joined(start: list[NDArray[np.int64]], z: list[NDArray[np.float64]]) -> tuple[Any, Any]:
        count = np.concatenate([np.empty(0, np.int64), *(np.diff(one) for one in start)])
        return np.concatenate(([0], np.cumsum(count))), np.concatenate([np.empty(0), *z])

    roof = joined([points.roof_start for points in several], [points.roof_z for points in several])
    ground = joined([points.ground_start for points in several], [points.ground_z for points in several])
    return BuildingPoints(*roof, *ground)


def _take(
    start: NDArray[np.int64], z: NDArray[np.float64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    count = np.diff(start)[rows]
    new_start = np.concatenate(([0], np.cumsum(count)))
    return new_start, z[np.arange(new_start[-1]) + np.repeat(start[rows] - new_start[:-1], count)]


def _points_inside(
    xyz: NDArray[np.float64],
    among: NDArray[np.bool_],
    polygons: NDArray[np.object_],
    outside: NDArray[np.object_] | None,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Heights of the points in each polygon, and not in its counterpart in `outside` where given."""
    polygon, point = find_inside(xyz, polygons, among=among)
    if outside is not None:
        apart = ~are_inside(outside, polygon, np.take(xyz, point, axis=0), closed=True)
        polygon, point = polygon[apart], point[apart]
    start = np.concatenate(([0], np.cumsum(np.bincount(polygon, minlength=len(polygons)))))
    return start, sort_values(start, xyz[point, 2])


def _regroup(
    start: NDArray[np.int64], z: NDArray[np.float64], owner: NDArray[np.int64], n: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    taken = owner >= 0
    count = np.bincount(owner[taken], np.diff(start)[taken], minlength=n).astype(np.int64)
    new_start = np.concatenate(([0], np.cumsum(count)))
    return new_start, sort_values(new_start, _merge_by_owner(start, z, owner, new_start))


@kernel
def _merge_by_owner(
    start: NDArray[np.int64], z: NDArray[np.float64], owner: NDArray[np.int64], new_start: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Put the values of each group behind those of the others of its owner; those of -1 are left out."""
    dealt, free = np.empty(new_start[-1]), new_start.copy()
    for g in range(len(owner)):
        if owner[g] >= 0:
            first = free[owner[g]]
            free[owner[g]] += start[g + 1] - start[g]
            dealt[first : free[owner[g]]] = z[start[g] : start[g + 1]]
    return dealt
