"""How far levels stand apart: the vertical spacing that follows the plane mesh, and the domain's top (step 3.2).

Both are functions of a place and its neighbourhood alone, so that a tile gets them as the whole region does.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.kernel import kernel
from pipeline.data.mesh import PlaneMesh
from pipeline.plane_mesh.edges import plane_edges
from pipeline.plane_mesh.sizes import SizeField, local_sizes
from pipeline.points_terrain.terrain import HEIGHT_UNIT, Dtm, sample_dtm

TALLEST = 3.0  # times as high as wide; cells at walls that are finer in the plane alone, against others
TOP_PASSES = 2  # moving averages of the terrain that shape the domain's top
TOP_REACH = 0.5  # of the domain's height: how far those averages look together


@dataclass(frozen=True)
class SpacingLimits:
    """Limits of the vertical spacing, in target sizes of the place."""

    least: float  #: lower limit; also the least distance of two given heights of one column
    most: float  #: upper limit. Flat layers of equilateral triangles are best at 0.8 of their edge


def mean_edges(plane: PlaneMesh) -> NDArray[np.float64]:
    """Mean length of the edges at each vertex (m).

    Parameters
    ----------
    plane : PlaneMesh
        Plane mesh; every vertex has a triangle.

    Returns
    -------
    float64, (n,)
        Lengths (m).

    Examples
    --------
    >>> xy = np.array([[0.0, 0.0], [0.0, 3.0], [4.0, 0.0]])
    >>> mean_edges(PlaneMesh(xy, np.array([[0, 1, 2]], np.int32), np.array([-1], np.int32)))
    array([3.5, 4. , 4.5])
    """
    edges, _ = plane_edges(plane.triangles)
    across = plane.xy[edges[:, 1]] - plane.xy[edges[:, 0]]
    length = np.sqrt(across[:, 0] ** 2 + across[:, 1] ** 2)
    n = len(plane.xy)
    total = np.bincount(edges.ravel(), np.repeat(length, 2), n)
    mean: NDArray[np.float64] = total / np.bincount(edges.ravel(), minlength=n)
    return mean


def vertical_spacing(
    edge: NDArray[np.float64], size: float | NDArray[np.float64], limits: SpacingLimits
) -> NDArray[np.float64]:
    """Choose the distance of levels in each column: the mean edge at its vertex, within limits.

    Parameters
    ----------
    edge : float64, (n,)
        Mean length of the edges at each vertex (m).
    size : float or float64 (n,)
        Target size (m): one for all, or one a vertex.
    limits : SpacingLimits
        Limits in target sizes.
    """
    return np.clip(edge, limits.least * np.asarray(size), limits.most * np.asarray(size))


def column_spacing(
    plane: PlaneMesh, sizes: SizeField | None, limits: SpacingLimits, *, mesh_size: float
) -> NDArray[np.float64]:
    """Choose the distance of levels in each column of a plane mesh (m), float64 (n,).

    Parameters
    ----------
    sizes : SizeField or None
        Its target edge lengths, where they are not the same everywhere.
    limits : SpacingLimits
        Limits in target sizes.
    mesh_size : float
        Target edge length (m).

    Notes
    -----
    Where walls are finer in the plane alone, edges count as long as they would be without that, up to `TALLEST`
    times their length.
    """
    upright = local_sizes(sizes, plane.xy, mesh_size=mesh_size, upright=True)
    share = upright / local_sizes(sizes, plane.xy, mesh_size=mesh_size)
    return vertical_spacing(mean_edges(plane) * np.minimum(share, TALLEST), upright, limits)


def is_stretched(xy: NDArray[np.float64], sizes: SizeField | None, *, mesh_size: float) -> NDArray[np.bool_]:
    """Tell where cells are higher than wide, as walls are finer in the plane alone: bool (n,)."""
    upright, plan = (local_sizes(sizes, xy, mesh_size=mesh_size, upright=which) for which in (True, False))
    stretched: NDArray[np.bool_] = plan < upright
    return stretched


def top_reach(domain_height: float) -> float:
    """How far from a place the terrain counts for the height of the domain's top there (m)."""
    return TOP_REACH * domain_height


def domain_top(dtm: Dtm, xy: NDArray[np.float64], *, domain_height: float) -> NDArray[np.float64]:
    """Height of the domain's top: the terrain, smoothed, and the domain's height on it.

    Parameters
    ----------
    dtm : Dtm
        Terrain without empty nodes. The result is that of the whole region's raster where this one reaches
        `top_reach` beyond a place.
    xy : float64, (n, 2)
        Places (m).
    domain_height : float
        Height of the domain (m).

    Returns
    -------
    float64, (n,)
        Absolute heights (m).

    Notes
    -----
    Quays and single trees in the terrain would slant the cells at the top for nothing, hence the moving
    average over a square, twice. Its sums are of whole numbers (`HEIGHT_UNIT`) and therefore exact: a tile
    and a region that hold the same nodes get the same bits. Cost is linear in the nodes.
    """
    half = max(round(top_reach(domain_height) / TOP_PASSES / dtm.spacing), 1)
    units = np.rint(dtm.z / HEIGHT_UNIT)
    for _ in range(TOP_PASSES):
        units = _average(units, half)
    smooth = Dtm(units * HEIGHT_UNIT, dtm.i0, dtm.j0, dtm.spacing)
    return domain_height + sample_dtm(smooth, xy)


@kernel
def _average(units: NDArray[np.float64], half: int) -> NDArray[np.float64]:
    """Moving average of whole numbers over a square of side ``2 half + 1``, less at the border.

    It is rounded down after the columns and after the rows. Sums are exact, and so is what is rounded down: a
    quotient of numbers below 2^52 is no whole number unless it is one exactly.
    """
    rows, columns = units.shape
    average = np.empty((rows, columns))
    total, down = np.zeros(columns), np.empty(columns)
    for row in range(min(half, rows)):
        for column in range(columns):
            total[column] += units[row, column]
    for row in range(rows):
        enters, leaves = row + half, row - half - 1
        if enters < rows:
            for column in range(columns):
                total[column] += units[enters, column]
        if leaves >= 0:
            for column in range(columns):
                total[column] -= units[leaves, column]
        n = float(min(enters + 1, rows) - max(leaves + 1, 0))
        for column in range(columns):
            down[column] = np.floor(total[column] / n)
        across = 0.0
        for column in range(min(half, columns)):
            across += down[column]
        for column in range(columns):
            enters, leaves = column + half, column - half - 1
            if enters < columns:
                across += down[enters]
            if leaves >= 0:
                across -= down[leaves]
            average[row, column] = np.floor(across / (min(enters + 1, columns) - max(leaves + 1, 0)))
    return average
