"""Columns of seams and corners from seam data alone (steps 3.2 to 3.4, adaptive), and a tile's share of them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.adaptive import AdaptiveOptions, fill_columns
from pipeline.columns.nodes import Levels, SeamColumns, join_levels, take_columns
from pipeline.columns.order_keys import set_order_keys, wall_gates
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from pipeline.data.roofs import Roofs
from pipeline.plane_mesh.plane import order_plane
from pipeline.plane_mesh.sizes import SizeField
from pipeline.points_terrain.terrain import Dtm
from stitch.seams.seams import Seam, find_vertices
from stitch.tiling.corners import Corner


def fill_corner(
    corner: Corner,
    dtm: Dtm,
    roofs: Roofs,
    ids: NDArray[np.str_],
    options: AdaptiveOptions,
    *,
    sizes: SizeField | None = None,
) -> Levels:
    """Fill the column of a corner: it belongs to the corner, and all its seams take it over.

    Parameters
    ----------
    corner : Corner
        A corner of two tiles or more. No wall is as close to it as the tips of its first edges.
    dtm : Dtm
        Terrain as far beyond these as `top_reach` says.
    roofs, ids, options, sizes
        As in `mesh_adaptive`.

    Returns
    -------
    Levels
        One column, with a spacing that follows the length of the first edges.
    """
    fan = mesh_fan(corner)
    levels, _ = fill_columns(fan, dtm, roofs, ids, options, sizes=sizes)
    return take_columns(levels, find_vertices(fan.xy, corner.xy[None]))


def fill_seam(
    seam: Seam,
    ends: tuple[Levels, Levels],
    dtm: Dtm,
    roofs: Roofs,
    ids: NDArray[np.str_],
    options: AdaptiveOptions,
    *,
    sizes: SizeField | None = None,
) -> Levels:
    """Fill the columns of a seam within the region from the triangles on both of its sides.

    Parameters
    ----------
    seam : Seam
        The seam.
    ends : (Levels, Levels)
        Columns of its first and last corner.
    dtm : Dtm
        Terrain as far beyond its triangles as `top_reach` says.
    roofs, ids, options, sizes
        As in `mesh_adaptive`.

    Returns
    -------
    Levels
        A column for each vertex, with a level for every roof on either side.

    Notes
    -----
    Order keys are set for the edges of the seam itself. Those of edges that lead away from it are for the tiles,
    which move their own columns alone.
    """
    levels, bottom = fill_columns(seam.ring, dtm, roofs, ids, options, sizes=sizes)
    if options.weld is not None or options.solids:
        levels = _key_along(seam, levels, bottom, floors=options.solids)
    return join_levels([ends[0], take_columns(levels, seam.vertex[1:-1]), ends[1]])


def _key_along(seam: Seam, levels: Levels, bottom: NDArray[np.int32], *, floors: bool) -> Levels:
    """Set the order keys of a seam's columns, but for those of its corners, for the edges along it."""
    mesh = ColumnMesh(seam.ring, levels.start, levels.z, bottom, "heights")
    given = np.ones(len(seam.ring.xy), np.bool_)
    given[seam.vertex[1:-1]] = False
    gates = wall_gates(mesh, floors=floors)
    column = np.searchsorted(levels.start, gates[:, :, 0], side="right") - 1
    along = np.full(len(seam.ring.xy), -1)
    along[seam.vertex] = np.arange(len(seam.vertex))
    at = along[column]
    mine = gates[(at >= 0).all(axis=1) & (np.abs(at[:, 0] - at[:, 1]) == 1)]
    mesh, _ = set_order_keys(mesh, levels.z, given, mine)
    return replace(levels, key=mesh.merge_keys)


def tile_columns(plane: PlaneMesh, seams: Sequence[tuple[Seam, Levels]]) -> SeamColumns:
    """Collect the columns that a tile takes over from its seams.

    Parameters
    ----------
    plane : PlaneMesh
        The tile's plane mesh.
    seams : sequence of (Seam, Levels)
        Its seams within the region, with their columns.

    Raises
    ------
    ValueError
        If the mesh lacks a vertex of a seam.
    """
    if not seams:
        return SeamColumns(np.empty(0, np.int32), join_levels([]))
    levels = join_levels([columns for _, columns in seams])
    vertex = np.concatenate([find_vertices(plane.xy, seam.xy) for seam, _ in seams])
    vertex, first = np.unique(vertex, return_index=True)
    return SeamColumns(vertex, take_columns(levels, first.astype(np.int32)))


def mesh_fan(corner: Corner) -> PlaneMesh:
    """Make the triangles between a corner and the neighbouring tips."""
    xy = np.concatenate((corner.xy[None], corner.tips))
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]], np.int32)
    triangles = triangles[~np.isnan(xy[triangles]).any(axis=(1, 2))]
    return order_plane(xy, triangles, np.full(len(triangles), corner.building, np.int32))
