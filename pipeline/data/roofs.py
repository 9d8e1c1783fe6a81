"""Roofs as planes between two heights: one kind of roof for all building parts, flat ones included."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

# Where the roof of a building comes from: planes found in its points, a family of roofs fitted to them (gable,
# hip, ...), the straight skeleton of its outline, one height, or the surfaces of a city model.
ROOF_METHODS = ("planes", "family", "skeleton", "flat", "model")
NOT_FITTED = -1  # instead of a method, where every building has one height
# Why a building has one height, where that is not what its points tell.
ROOF_FALLBACKS = ("", "no roof points", "few roof points")


@dataclass(frozen=True, eq=False)
class Roofs:
    """Roofs of ``n`` building parts: at (x, y) each is ``a (x - x0) + b (y - y0) + c``, between two heights."""

    #: (n, 3): slopes ``a`` and ``b`` eastwards and northwards (m per m), and the height ``c`` at the origin (m)
    plane: NDArray[np.float64]
    #: (n, 2): the origin ``x0, y0`` of each plane in the region's CRS: whole metres near the part
    origin: NDArray[np.float64]
    #: (n, 2): lowest and highest height of each roof (m); both are ``c`` where a roof is flat
    limits: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.plane)


@dataclass(frozen=True)
class Weld:
    """When heights of roofs at a vertex are joined or parted."""

    factor: float = 0.7  #: least step of two roofs at a vertex, in vertical spacings of its column
    #: limits of that step (m)
    least: float = 1.0
    most: float = 2.5
    clearance: float = 2.0  #: least height of a roof above the terrain at a wall (m)
    slack: float = 1.0  #: how far roofs may be moved at a vertex where cells would be bad (m)


def flat_roofs(height: NDArray[np.float64]) -> Roofs:
    """Flat roofs of given heights (m), float64 (n,); NaN stays NaN.

    Examples
    --------
    >>> roof_heights(flat_roofs(np.array([12.5])), np.array([0, 0]), np.array([[3.0, 4.0], [5.0, 9.0]])).tolist()
    [12.5, 12.5]
    """
    nothing = np.zeros(len(height))
    return Roofs(
        np.column_stack((nothing, nothing, height)),
        np.zeros((len(height), 2)),
        np.column_stack((height, height)),
    )


def roof_heights(roofs: Roofs, row: NDArray[np.int64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of roofs at places.

    Parameters
    ----------
    roofs : Roofs
        Roofs.
    row : int64, (k,)
        The roof that is wanted at each place.
    xy : float64, (k, 2)
        The places in the region's CRS (m).

    Returns
    -------
    float64, (k,)
        Heights (m).

    Examples
    --------
    >>> shed = Roofs(np.array([[0.5, 0.0, 10.0]]), np.array([[100.0, 0.0]]), np.array([[9.0, 12.0]]))
    >>> roof_heights(shed, np.array([0, 0, 0]), np.array([[100.0, 7.0], [102.0, 0.0], [110.0, 0.0]])).tolist()
    [10.0, 11.0, 12.0]
    """
    low, high = roofs.limits[row].T
    height: NDArray[np.float64] = np.minimum(np.maximum(plane_heights(roofs, row, xy), low), high)
    return height


def plane_heights(roofs: Roofs, row: NDArray[np.int64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of the planes of roofs at places (m), as `roof_heights` without the limits."""
    a, b, c = roofs.plane[row].T
    x, y = (xy - roofs.origin[row]).T
    height: NDArray[np.float64] = a * x + b * y + c
    return height


def highest_roofs(roofs: Roofs, polygons: NDArray[np.object_]) -> NDArray[np.float64]:
    """Highest place of each roof over its polygon (m), float64 (n,)."""
    highest = roofs.limits[:, 1].copy()
    sloped = np.flatnonzero(~is_flat(roofs))
    if len(sloped):
        xy, index = shapely.get_coordinates(polygons[sloped], return_index=True)
        first = np.flatnonzero(np.diff(index, prepend=-1))
        highest[sloped] = np.maximum.reduceat(roof_heights(roofs, sloped[index], xy), first)
    return highest


def is_flat(roofs: Roofs) -> NDArray[np.bool_]:
    """Tell which roofs have one height, bool (n,)."""
    level: NDArray[np.bool_] = (roofs.plane[:, :2] == 0).all(axis=1)
    level |= roofs.limits[:, 0] == roofs.limits[:, 1]
    return level


def choose_roofs(first: NDArray[np.bool_], one: Roofs, other: Roofs) -> Roofs:
    """Roofs of `one` where `first`, bool (n,), and of `other` elsewhere."""
    return Roofs(
        np.where(first[:, None], one.plane, other.plane),
        np.where(first[:, None], one.origin, other.origin),
        np.where(first[:, None], one.limits, other.limits),
    )


def take_roofs(roofs: Roofs, rows: NDArray[np.int64]) -> Roofs:
    """Take some roofs in the order of `rows`, int64 (k,)."""
    return Roofs(roofs.plane[rows], roofs.origin[rows], roofs.limits[rows])


def join_roofs(several: Sequence[Roofs]) -> Roofs:
    """Put roofs one after the other; none gives none."""
    return Roofs(
        np.concatenate([np.empty((0, 3)), *(roofs.plane for roofs in several)]),
        np.concatenate([np.empty((0, 2)), *(roofs.origin for roofs in several)]),
        np.concatenate([np.empty((0, 2)), *(roofs.limits for roofs in several)]),
    )
