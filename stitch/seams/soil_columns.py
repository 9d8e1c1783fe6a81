"""Columns of soil of seams and corners, from seam data alone, as those of air are (beyond the paper)."""

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import Levels, join_levels, take_columns
from pipeline.columns.underground import SoilOptions, fill_soil, is_grounded, join_soil, soil_tops
from pipeline.plane_mesh.sizes import SizeField
from pipeline.points_terrain.terrain import Dtm, sample_dtm
from stitch.seams.seam_columns import mesh_fan
from stitch.seams.seams import Seam, find_vertices
from stitch.tiling.corners import Corner


def fill_corner_soil(
    corner: Corner, air: Levels, dtm: Dtm, options: SoilOptions, *, sizes: SizeField | None = None
) -> Levels:
    """Fill the column of soil under a corner: all seams take it over.

    Parameters
    ----------
    corner : Corner
        The corner.
    air : Levels
        Its column of air, of either mesher.
    dtm : Dtm
        Terrain around it.
    options : SoilOptions
        Parameters.
    sizes : SizeField, optional
        Sizes in the plane, where they are graded.

    Returns
    -------
    Levels
        One column.
    """
    fan = mesh_fan(corner)
    top = _find_tops(corner.xy[None], air, dtm, options)
    return fill_soil(fan, find_vertices(fan.xy, corner.xy[None]), top, options, sizes=sizes)


def fill_seam_soil(
    seam: Seam,
    ends: tuple[Levels, Levels],
    air: Levels,
    dtm: Dtm,
    options: SoilOptions,
    *,
    sizes: SizeField | None = None,
) -> Levels:
    """Fill the columns of soil under a seam within the region.

    Parameters
    ----------
    seam : Seam
        The seam.
    ends : (Levels, Levels)
        Columns of soil of its first and last corner.
    air : Levels
        Its columns of air, of either mesher.
    dtm : Dtm
        Terrain around it.
    options : SoilOptions
        Parameters.
    sizes : SizeField, optional
        Sizes in the plane, where they are graded.

    Returns
    -------
    Levels
        A column for each vertex.
    """
    soil = fill_soil(seam.ring, seam.vertex, _find_tops(seam.xy, air, dtm, options), options, sizes=sizes)
    inner = np.arange(1, len(seam.vertex) - 1, dtype=np.int32)
    return join_levels([ends[0], take_columns(soil, inner), ends[1]])


def join_seam(soil: Levels, air: Levels) -> Levels:
    """Put a seam's columns of air on those of soil: what its points are counted in."""
    return join_soil(soil, air, is_grounded(air))


def _find_tops(xy: NDArray[np.float64], air: Levels, dtm: Dtm, options: SoilOptions) -> NDArray[np.float64]:
    return soil_tops(air.z[air.start[:-1]], is_grounded(air), sample_dtm(dtm, xy), options)[0]
