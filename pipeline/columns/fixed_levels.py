"""Which levels of layered columns are given: ground, roofs, and the columns of seams (step 3.4)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import (
    FREE,
    GROUND_LEVEL,
    ROOF_LEVEL,
    TOP_LEVEL,
    Levels,
    SeamColumns,
    collect_surfaces,
    find_surface_levels,
)
from pipeline.columns.trim_layers import first_kept
from pipeline.data.mesh import PlaneMesh


@dataclass(frozen=True, eq=False)
class GivenLevels:
    """What step 3.5 keeps of ``n`` columns of ``l`` levels."""

    #: (n,): first level of each column that a cell uses; in a seam's column, one on either side
    kept: NDArray[np.int32]
    kind: NDArray[np.int8]  #: (n, l): what a level is, as in `Levels`, without the top; `FREE` for most
    #: (n, l): levels whose height is given: those that stand for something, and all of a seam's
    stays: NDArray[np.bool_]
    z: NDArray[np.float64]  #: (n, l): their heights (m); elsewhere NaN


def find_given_levels(
    plane: PlaneMesh,
    first: NDArray[np.int32],
    ground: NDArray[np.float64],
    roof: NDArray[np.float64],
    seam: SeamColumns,
    *,
    n_layers: int,
    top: float | None = None,
) -> GivenLevels:
    """Collect the levels that step 3.5 keeps: the ground under air, every roof, and the columns of seams.

    Parameters
    ----------
    first : int32, (m,)
        First level of the cells over each triangle.
    ground : float64, (n,)
        Terrain at each vertex (m).
    roof : float64, (b,)
        Absolute roof heights (m).
    seam : SeamColumns
        Columns that are given, all up to the domain's top.
    n_layers : int
        Layers of the slab.
    top : float, optional
        Absolute height of a flat top (m), which is given too.

    Raises
    ------
    ValueError
        If two roofs would share a level of a column, a triangle stands on one that a seam's column lacks, or
        that has more than there are.
    """
    n = len(plane.xy)
    kept = first_kept(plane, first)
    kind = np.zeros((n, n_layers + 1), np.int8)
    kind[kept == 0, 0] = GROUND_LEVEL
    inside = plane.building >= 0
    vertex, level = plane.triangles[inside].ravel(), np.repeat(first[inside], 3)
    height = np.repeat(roof[plane.building[inside]], 3)
    kind[vertex, level] = ROOF_LEVEL
    z = np.full((n, n_layers + 1), np.nan)
    z[kept == 0, 0] = ground[kept == 0]
    z[vertex, level] = height
    if (z[vertex, level] != height).any():
        raise ValueError("two roofs of different heights that meet share a layer; choose layers by all that touch")
    if top is not None:
        z[:, -1] = top
    column, place = _seam_places(seam, n_layers)
    _check_seam(plane, first, seam, n_layers)
    kind[seam.vertex] = FREE
    kind[column, place] = np.where(seam.levels.kind == TOP_LEVEL, FREE, seam.levels.kind)
    kept[seam.vertex] = (n_layers + 1 - np.diff(seam.levels.start)).astype(np.int32)
    z[column, place] = seam.levels.z
    return GivenLevels(kept, kind, ~np.isnan(z), z)


def take_used_levels(
    plane: PlaneMesh, first: NDArray[np.int32], given: GivenLevels, z: NDArray[np.float64]
) -> Levels:
    """Drop the levels that no cell uses.

    Parameters
    ----------
    first : int32, (m,)
        First level of the cells over each triangle.
    z : float64, (n, l)
        Heights of all levels (m).
    """
    levels = z.shape[1]
    used = np.arange(levels) >= given.kept[:, None]
    kind = given.kind.copy()
    kind[:, -1] = TOP_LEVEL
    start = np.concatenate(([0], np.cumsum(levels - given.kept))).astype(np.int64)
    bottom = first[:, None] - given.kept[plane.triangles]
    return Levels(start, z[used], kind[used], z[used], collect_surfaces(plane, bottom.astype(np.int32)))


def stand_on_floors(
    given: GivenLevels, z: NDArray[np.float64], heights: NDArray[np.float64], *, min_gap: float
) -> tuple[GivenLevels, NDArray[np.float64]]:
    """Let columns that begin at a roof go on below it, for cells of buildings: down to the terrain.

    Parameters
    ----------
    z : float64, (n, l)
        Heights of all levels (m): the lowest at the terrain, those from `GivenLevels.kept` on as they stay.
    heights : float64, (l,)
        Heights of the levels over flat ground (m): levels below a roof keep the ratios of their distances.
    min_gap : float
        Least distance of two levels (m): where terrain inside a building comes too close to its roof, the floor
        is as far below that as its levels need.

    Returns
    -------
    GivenLevels
        The same, with all levels kept.
    float64, (n, l)
        Heights of all levels (m).
    """
    bare = np.flatnonzero(given.kept)
    kept = given.kept[bare]
    roof = z[bare, kept]
    floor = np.minimum(z[bare, 0], roof - min_gap * heights[kept] / heights[1])
    kind, z = given.kind.copy(), z.copy()
    kind[bare, 0] = GROUND_LEVEL
    z[bare] = np.where(
        np.arange(z.shape[1]) < kept[:, None],
        floor[:, None] + (roof - floor)[:, None] * (heights / heights[kept, None]),
        z[bare],
    )
    return GivenLevels(np.zeros_like(given.kept), kind, given.stays, given.z), z


def _check_seam(plane: PlaneMesh, first: NDArray[np.int32], seam: SeamColumns, n_layers: int) -> None:
    """Refuse a triangle at a seam whose cells begin at a level that does not stand for its surface there."""
    row = np.full(len(plane.xy), -1, np.int64)
    row[seam.vertex] = np.arange(len(seam.vertex))
    triangle, corner = np.nonzero(row[plane.triangles] >= 0)
    column = row[plane.triangles[triangle, corner]]
    found = find_surface_levels(seam.levels, column, plane.building[triangle].astype(np.int64))
    dropped = n_layers + 1 - np.diff(seam.levels.start)
    if ((found < 0) | (found + dropped[column] != first[triangle])).any():
        raise ValueError("a triangle at a seam stands on a level that the seam's columns lack")


def _seam_places(seam: SeamColumns, n_layers: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Vertex and level of every level of the seam's columns."""
    count = np.diff(seam.levels.start)
    if (count > n_layers + 1).any():
        raise ValueError(f"a seam's column has {count.max()} levels, those of {n_layers} layers have one more")
    column = np.repeat(seam.vertex, count).astype(np.int64)
    level = np.arange(len(seam.levels.z)) - np.repeat(seam.levels.start[1:] - n_layers - 1, count)
    return column, level
