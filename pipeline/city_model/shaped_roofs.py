"""Roofs by the straight skeletons of outlines, for houses whose points do not tell of planes (step 2.0, ours)."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.data.roofs import ROOF_METHODS, Roofs, join_roofs, plane_heights, take_roofs
from pipeline.roofs.house_levels import HouseParts
from pipeline.roofs.house_roofs import HouseRoofs, RoofOptions
from pipeline.skeletons.skeleton_roofs import RoofForm, skeleton_roofs

SKELETON = ROOF_METHODS.index("skeleton")
SLOPE = 0.7  # m per m, about 35 degrees
WIDEST_RISE = 4.0  # m; over outlines whose hipped roof would be higher, roofs are flat
LEAST_EAVES = 2.0  # m above the ground


def shape_roofs(
    fitted: HouseRoofs,
    polygons: NDArray[np.object_],
    chosen: NDArray[np.bool_],
    ground: NDArray[np.float64],
    roof: NDArray[np.float64],
) -> HouseRoofs:
    """Give some houses hipped roofs, of the mean height that they had.

    Parameters
    ----------
    fitted : HouseRoofs
        Roofs of all houses.
    polygons : object, (h,)
        Their outlines (m).
    chosen : bool, (h,)
        Houses that are to have one.
    ground, roof : float64, (h,)
        Heights of each (m).

    Returns
    -------
    HouseRoofs
        The roofs. A house stays as it is where the roof would rise by more than `WIDEST_RISE`, its eaves would be
        lower than `LEAST_EAVES` above the ground, or its outline has no skeleton.
    """
    shaped: dict[int, tuple[NDArray[np.object_], Roofs]] = {}
    for row in np.flatnonzero(chosen & np.isfinite(roof) & np.isfinite(ground)).tolist():
        found = _hip(polygons[row], float(ground[row]), float(roof[row]))
        if found is not None:
            shaped[row] = found
    if not shaped:
        return fitted
    new = np.zeros(len(polygons), np.bool_)
    new[list(shaped)] = True
    kept = np.flatnonzero(~new[fitted.parts.house])
    more = [np.full(len(parts), row) for row, (parts, _) in shaped.items()]
    house = np.concatenate([fitted.parts.house[kept], *more])
    order = np.argsort(house, kind="stable")
    pieces = np.concatenate([fitted.parts.polygons[kept], *(parts for parts, _ in shaped.values())])
    roofs = join_roofs([take_roofs(fitted.roofs, kept), *(each for _, each in shaped.values())])
    method, n_planes = fitted.method.copy(), fitted.n_planes.copy()
    method[new] = SKELETON
    n_planes[new] = [len(np.unique(each.plane, axis=0)) for _, each in shaped.values()]
    parts = HouseParts(pieces[order], house[order])
    return HouseRoofs(parts, take_roofs(roofs, order), method, n_planes, fitted.too_few)


def _hip(polygon: shapely.Polygon, ground: float, roof: float) -> tuple[NDArray[np.object_], Roofs] | None:
    """Parts and planes of a hipped roof of this mean height, None where there is none."""
    try:
        found = skeleton_roofs(polygon, 0.0, RoofForm("hipped", SLOPE), min_area=RoofOptions.min_area)
    except GeometryError:
        return None
    parts, over = found.parts, found.roofs
    centre = shapely.get_coordinates(shapely.centroid(parts))
    area = shapely.area(parts)
    eaves = roof - float((area * plane_heights(over, np.arange(len(over)), centre)).sum() / area.sum())
    if found.height.max() > WIDEST_RISE or eaves < ground + LEAST_EAVES:
        return None
    return parts, Roofs(over.plane + np.array([0.0, 0.0, eaves]), over.origin, over.limits + eaves)
