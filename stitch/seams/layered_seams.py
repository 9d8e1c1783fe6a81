"""Columns of seams and corners from seam data alone (steps 3.2 to 3.5, layered)."""

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.layered import LayeredOptions, fill_layers
from pipeline.columns.nodes import Levels, SeamColumns, join_levels, take_columns
from pipeline.data.mesh import PlaneMesh
from pipeline.points_terrain.terrain import Dtm
from stitch.seams.seams import Seam, find_vertices
from stitch.tiling.corners import Corner
from stitch.tiling.grid import Bounds


def fill_corner_layers(
    corner: Corner,
    patch: PlaneMesh,
    dtm: Dtm,
    roof: NDArray[np.float64],
    ids: NDArray[np.str_],
    removed: NDArray[np.int32],
    bounds: Bounds,
    options: LayeredOptions,
) -> Levels:
    """Fill the column of a corner: it belongs to the corner, and all its seams take it over.

    Parameters
    ----------
    corner : Corner
        A corner of two tiles or more.
    patch : PlaneMesh
        Triangles around it (`mesh_patch`).
    dtm : Dtm
        Terrain as far beyond these as `terrain_reach` says.
    roof, ids, bounds, options
        As in `mesh_layers`, with `bounds` the region.
    removed : int32, (b,)
        Layers removed in each building (`choose_layers`).

    Returns
    -------
    Levels
        One column, from the ground or the roof around it up to the domain's top.
    """
    levels = fill_layers(patch, dtm, roof, ids, removed, bounds, options)
    return take_columns(levels, find_vertices(patch.xy, corner.xy[None]))


def fill_seam_layers(
    seam: Seam,
    ends: tuple[Levels, Levels],
    dtm: Dtm,
    roof: NDArray[np.float64],
    ids: NDArray[np.str_],
    removed: NDArray[np.int32],
    bounds: Bounds,
    options: LayeredOptions,
) -> Levels:
    """Fill the columns of a seam within the region: step 3.5 on the triangles around it, free where these end.

    Parameters
    ----------
    seam : Seam
        The seam.
    ends : (Levels, Levels)
        Columns of its first and last corner.
    dtm : Dtm
        Terrain as far beyond its surroundings as `terrain_reach` says.
    roof, ids, removed, bounds, options
        As in `fill_corner_layers`.

    Returns
    -------
    Levels
        A column for each vertex, from the lowest level that either side uses up to the domain's top.
    """
    plane = seam.surroundings
    vertex = find_vertices(plane.xy, seam.xy)
    given = SeamColumns(vertex[[0, -1]], join_levels(ends))
    levels = fill_layers(plane, dtm, roof, ids, removed, bounds, options, seam=given)
    return take_columns(levels, vertex)
