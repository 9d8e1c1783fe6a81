"""Step 3.4: which layers of each column lie in a building and are removed."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.data.mesh import PlaneMesh
from pipeline.points_terrain.terrain import HEIGHT_UNIT

MIN_SQUEEZE = 0.4  # a layer below a roof is never squeezed under this part of its height


def count_removed_layers(
    levels: NDArray[np.float64],
    building: NDArray[np.int64],
    roof: NDArray[np.float64],
    wall_ground: NDArray[np.float64],
    group: NDArray[np.int32],
    *,
    layer_height: float,
    flat_levels: NDArray[np.float64] | None = None,
) -> NDArray[np.int32]:
    """Choose the layer that becomes the roof of each building: the closest, within limits (step 3.4).

    Parameters
    ----------
    levels : float64, (p, n_layers + 1)
        Levels after step 3.3 (m) at places of the buildings, in any order.
    building : int64, (p,)
        The building of each place; every one has a place.
    roof : float64, (b,)
        Absolute roof heights (m).
    wall_ground : float64, (b,)
        Highest terrain at the walls of each building (m).
    group : int32, (b,)
        Buildings of one group have one roof, and so one layer.
    layer_height : float
        Height of a layer of the slab (m).
    flat_levels : float64, (n_layers + 1,), optional
        Heights of the levels on flat ground (m), where layers differ in height.

    Returns
    -------
    int32, (b,)
        Number of layers removed in each building, at least 1 and at most ``n_layers - 1``.

    Notes
    -----
    The closest level is that of the mean over the group's places, summed in whole numbers of `HEIGHT_UNIT`. No
    more layers are removed than leave each at least 0.4 of its height between the highest terrain at a wall
    and the roof.
    """
    _, first, member = np.unique(group, return_index=True, return_inverse=True)
    n_groups, n_layers = len(first), levels.shape[1] - 1
    label = member[building]
    count = np.bincount(label, minlength=n_groups)
    units = np.rint(levels / HEIGHT_UNIT)
    total = np.column_stack([np.bincount(label, units[:, k], n_groups) for k in range(n_layers + 1)])
    mean = total * HEIGHT_UNIT / count[:, None]
    closest = np.abs(mean - roof[first, None]).argmin(axis=1)
    highest_ground = np.full(n_groups, -np.inf)
    np.maximum.at(highest_ground, member, wall_ground)
    room = np.floor((roof[first] - highest_ground) / (MIN_SQUEEZE * layer_height)).astype(np.int64)
    if flat_levels is not None:
        room = np.searchsorted(MIN_SQUEEZE * flat_levels, roof[first] - highest_ground, side="right") - 1
    removed = np.clip(np.minimum(closest, room), 1, n_layers - 1).astype(np.int32)
    of_building: NDArray[np.int32] = removed[member]
    return of_building


def first_levels(plane: PlaneMesh, removed: NDArray[np.int32]) -> NDArray[np.int32]:
    """First level of the cells over each triangle: 0 on open ground, the roof in a building."""
    return np.where(plane.building >= 0, np.append(removed, 0)[plane.building], 0).astype(np.int32)


def first_kept(plane: PlaneMesh, first: NDArray[np.int32]) -> NDArray[np.int32]:
    """First level of each column that a cell uses."""
    kept = np.full(len(plane.xy), np.iinfo(np.int32).max, np.int32)
    np.minimum.at(kept, plane.triangles.ravel(), np.repeat(first, 3))
    return kept


def check_headroom(
    top: NDArray[np.float64],
    plane: PlaneMesh,
    roof: NDArray[np.float64],
    ids: NDArray[np.str_],
    *,
    domain_height: float,
    air: float,
) -> None:
    """Refuse a roof that comes too close to the top of the domain.

    Parameters
    ----------
    top : float64, (n,)
        Height of each column's top (m).
    plane : PlaneMesh
        Plane mesh; every building has a triangle.
    roof : float64, (b,)
        Absolute roof heights (m).
    ids : str, (b,)
        Building ids.
    domain_height : float
        Height of the domain (m), for the message.
    air : float
        Least air above a roof (m).

    Raises
    ------
    GeometryError
        With the building, its place, and the domain height that would do.
    """
    inside = plane.building >= 0
    label = np.repeat(plane.building[inside], 3)
    corner = plane.triangles[inside].ravel()
    lowest = np.full(len(roof), np.inf)
    np.minimum.at(lowest, label, top[corner])
    missing = roof + air - lowest
    if len(roof) == 0 or missing.max() <= 0:
        return
    worst = int(missing.argmax())
    x, y = plane.xy[corner[label == worst]].mean(axis=0)
    enough = np.ceil(domain_height + missing[worst] + 2 * air)
    raise GeometryError(
        f"building {ids[worst]} at ({x:.1f}, {y:.1f}), step 3.4: its roof at {roof[worst]:.1f} m leaves "
        f"{lowest[worst] - roof[worst]:.1f} m of air below the domain's top at {lowest[worst]:.1f} m, less than "
        f"{air:.1f} m; raise --domain-height to {enough:.0f}, or correct the building's height"
    )
