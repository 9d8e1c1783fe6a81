"""Holes of polygons, the courtyards of buildings: list them, fill some (steps 1.4 and 2.1)."""

import numpy as np
import shapely
from numpy.typing import NDArray


def list_holes(polygons: NDArray[np.object_]) -> tuple[NDArray[np.object_], NDArray[np.int64]]:
    """List the holes of all polygons as polygons.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons.

    Returns
    -------
    holes : object, (k,)
        shapely Polygons.
    owner : int64, (k,)
        Index of the polygon that each hole is in, ascending.
    """
    holed = np.flatnonzero(shapely.get_num_interior_rings(polygons) > 0)
    if not len(holed):
        return np.zeros(0, dtype=object), holed
    rings, index = shapely.get_rings(polygons[holed], return_index=True)
    inner = ~_is_shell(index)
    return shapely.polygons(rings[inner]), holed[index[inner]]


def fill_holes(polygons: NDArray[np.object_], fill: NDArray[np.bool_]) -> NDArray[np.object_]:
    """Remove holes.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons.
    fill : bool, (k,)
        True for each hole of `list_holes` that goes.

    Returns
    -------
    object, (n,)
        The polygons with the other holes, in their old order.
    """
    result = polygons.copy()
    _, owner = list_holes(polygons)
    for_change = np.unique(owner[fill])
    if len(for_change):
        rings, index = shapely.get_rings(polygons[for_change], return_index=True)
        stays = np.ones(len(rings), np.bool_)
        stays[~_is_shell(index)] = ~fill[np.isin(owner, for_change)]
        result[for_change] = shapely.polygons(rings[stays], indices=index[stays])
    return result


def fill_small_holes(
    polygons: NDArray[np.object_], *, min_hole_area: float, clearance: float
) -> tuple[NDArray[np.object_], int]:
    """Fill the holes that are too small for the mesh.

    Parameters
    ----------
    polygons : object, (n,)
        shapely Polygons.
    min_hole_area : float
        Holes of less area go (m²).
    clearance : float
        Holes go that no disc of this diameter fits into (m).

    Returns
    -------
    polygons : object, (n,)
        The polygons.
    n_filled : int
        Number of holes that went.
    """
    holes, _ = list_holes(polygons)
    if not len(holes):
        return polygons, 0
    small = shapely.area(holes) < min_hole_area
    small |= shapely.is_empty(shapely.buffer(holes, -clearance / 2, join_style="mitre"))
    return fill_holes(polygons, small), int(small.sum())


def _is_shell(owner: NDArray[np.int64]) -> NDArray[np.bool_]:
    first = np.ones(len(owner), np.bool_)
    np.not_equal(owner[1:], owner[:-1], out=first[1:])
    return first
