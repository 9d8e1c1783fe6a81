"""Which levels of layered columns are given: ground, roofs, and the columns of seams (step 3.4)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import GROUND_SURFACE, TOP_SURFACE, Levels, SeamColumns
from pipeline.columns.trim_layers import first_kept
from pipeline.data.mesh import PlaneMesh


@dataclass(frozen=True, eq=False)
class GivenLevels:
    """What step 3.5 keeps of ``n`` columns of ``l`` levels.

    Attributes
    ----------
    kept : int32, (n,)
        First level of each column that a cell uses; in a seam's column, one on either side.
    surface : float64, (n, l)
        What a level stands for, as in `Levels`, without the top; NaN for most.
    stays : bool, (n, l)
        Levels whose height is given: those that stand for something, and all of a seam's.
    z : float64, (n, l)
        Their heights (m); elsewhere NaN.
    """

    kept: NDArray[np.int32]
    surface: NDArray[np.float64]
    stays: NDArray[np.bool_]
    z: NDArray[np.float64]


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
    plane : PlaneMesh
        Plane mesh.
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
    surface = np.full((n, n_layers + 1), np.nan)
    surface[kept == 0, 0] = GROUND_SURFACE
    inside = plane.building >= 0
    vertex, level = plane.triangles[inside].ravel(), np.repeat(first[inside], 3)
    height = np.repeat(roof[plane.building[inside]], 3)
    surface[vertex, level] = height
    if (surface[vertex, level] != height).any():
        raise ValueError("two roofs of different heights that meet share a layer; choose layers by all that touch")
    z = np.where(surface == GROUND_SURFACE, ground[:, None], surface)
    if top is not None:
        z[:, -1] = top
    column, place = _seam_places(seam, n_layers)
    given = np.full((n, n_layers + 1), np.nan)
    given[column, place] = np.where(seam.levels.surface == TOP_SURFACE, np.nan, seam.levels.surface)
    own = surface[seam.vertex]
    if (~np.isnan(own) & (own != given[seam.vertex])).any():
        raise ValueError("a triangle at a seam stands on a level that the seam's columns lack")
    surface[seam.vertex] = given[seam.vertex]
    kept[seam.vertex] = (n_layers + 1 - np.diff(seam.levels.start)).astype(np.int32)
    z[column, place] = seam.levels.z
    return GivenLevels(kept, surface, ~np.isnan(z), z)


def take_used_levels(given: GivenLevels, z: NDArray[np.float64]) -> Levels:
    """Drop the levels that no cell uses.

    Parameters
    ----------
    given : GivenLevels
        What was given.
    z : float64, (n, l)
        Heights of all levels (m).
    """
    levels = z.shape[1]
    used = np.arange(levels) >= given.kept[:, None]
    surface = given.surface.copy()
    surface[:, -1] = TOP_SURFACE
    start = np.concatenate(([0], np.cumsum(levels - given.kept))).astype(np.int64)
    return Levels(start, z[used], surface[used])


def _seam_places(seam: SeamColumns, n_layers: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Vertex and level of every level of the seam's columns."""
    count = np.diff(seam.levels.start)
    if (count > n_layers + 1).any():
        raise ValueError(f"a seam's column has {count.max()} levels, those of {n_layers} layers have one more")
    column = np.repeat(seam.vertex, count).astype(np.int64)
    level = np.arange(len(seam.levels.z)) - np.repeat(seam.levels.start[1:] - n_layers - 1, count)
    return column, level
