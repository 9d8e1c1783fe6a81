"""Water by points of class 9: polygons of squares of the CRS, the same whatever the tiles (beyond the paper)."""

import numpy as np
import scipy  # what is asked of it is imported then
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import make_ids
from pipeline.data.classes import BUILDING, GROUND, WATER
from tiler.citymodels.tables import pack_polygons
from tiler.config.config import Config
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.stages.inputs import halo_of_points, own_window
from tiler.stages.readers import read_bands
from tiler.vectors.features import to_objects

WET = "wet"
CELLS = 16  # a side of a square, in which water is a polygon of its own
CELL = 0.5  # mesh sizes; side of a cell, which has water or not
AROUND = 4  # cells around a square that count for closing and opening
# What of a cell between four centres is water, by which of these are: lower left, lower right, upper right, upper
# left are 1, 2, 4, 8. Corners at 0 and 1, and the middles of sides; two opposite corners stay apart.
SHAPES: dict[int, tuple[tuple[tuple[float, float], ...], ...]] = {
    1: (((0, 0), (0.5, 0), (0, 0.5)),),
    2: (((1, 0), (1, 0.5), (0.5, 0)),),
    3: (((0, 0), (1, 0), (1, 0.5), (0, 0.5)),),
    4: (((1, 1), (0.5, 1), (1, 0.5)),),
    6: (((1, 0), (1, 1), (0.5, 1), (0.5, 0)),),
    7: (((0, 0), (1, 0), (1, 1), (0.5, 1), (0, 0.5)),),
    8: (((0, 1), (0, 0.5), (0.5, 1)),),
    9: (((0, 0), (0.5, 0), (0.5, 1), (0, 1)),),
    11: (((0, 0), (1, 0), (1, 0.5), (0.5, 1), (0, 1)),),
    12: (((1, 1), (0, 1), (0, 0.5), (1, 0.5)),),
    13: (((0, 0), (0.5, 0), (1, 0.5), (1, 1), (0, 1)),),
    14: (((1, 0), (1, 1), (0, 1), (0, 0.5), (0.5, 0)),),
    15: (((0, 0), (1, 0), (1, 1), (0, 1)),),
}
SHAPES |= {5: (*SHAPES[1], *SHAPES[4]), 10: (*SHAPES[2], *SHAPES[8])}


def water_point_stages(config: Config) -> list[Stage]:
    """Stage of the water that points show; none where it is not asked for."""
    if not config.water_points:
        return []
    reach = halo_of_points(config, (AROUND + 2) * CELL * config.mesh_size + CELLS * CELL * config.mesh_size)
    return [Stage(WET, Scope.TILE, find_wet, (Read("points", reach),), ("mesh_size", "ground_filter"))]


def find_wet(task: Task) -> Facts:
    """Find the water of the squares that a tile owns."""
    given = task.parameters
    size = CELL * given.mesh_size
    window = own_window(task, spacing=CELLS * size)
    first = CELLS * np.array([window.i0, window.j0]) - 1 - AROUND
    shape = CELLS * np.array([window.ny, window.nx]) + 1 + 2 * AROUND
    low = first * size
    box = (*low.tolist(), *(low + shape[::-1] * size).tolist())
    more = np.zeros(shape[0] * shape[1], np.int64)
    for cloud in read_bands(task, box, classes=(GROUND, BUILDING, WATER), ground_filter=given.ground_filter):
        i, j = (np.floor(cloud.xyz[:, k] / size).astype(np.int64) - first[k] for k in (0, 1))
        inside = (i >= 0) & (i < shape[1]) & (j >= 0) & (j < shape[0])
        sign = np.where(cloud.classification[inside] == WATER, 1, -1)
        more += np.bincount(j[inside] * shape[1] + i[inside], sign, len(more)).astype(np.int64)
    wet = (more > 0).reshape(shape)
    near = np.ones((3, 3), np.bool_)
    wet = scipy.ndimage.binary_opening(scipy.ndimage.binary_closing(wet, near), near)
    wet = wet[AROUND:-AROUND, AROUND:-AROUND]
    polygons = [
        polygon
        for bj in range(window.ny)
        for bi in range(window.nx)
        for polygon in outline_wet(
            wet[CELLS * bj : CELLS * (bj + 1) + 1, CELLS * bi : CELLS * (bi + 1) + 1],
            (CELLS * (window.i0 + bi) - 1, CELLS * (window.j0 + bj) - 1),
            size,
        )
    ]
    array = to_objects(polygons)
    task.put(**pack_polygons(array, "outline"), names=make_ids(array))
    return {"n": len(polygons)}


def outline_wet(wet: NDArray[np.bool_], first: tuple[int, int], size: float) -> list[shapely.Polygon]:
    """Outline the water between the centres of cells, bool (ny, nx), of a side (m).

    `first` is the index (i, j) of the first cell, counted in `size` from the CRS's origin. Shores go through the
    middles between centres, so squares beside each other fit.

    Examples
    --------
    >>> outline_wet(np.array([[True, True], [False, False]]), (0, 0), 2.0)[0].wkt
    'POLYGON ((1 1, 1 2, 3 2, 3 1, 1 1))'
    """
    code = wet[:-1, :-1] + 2 * wet[:-1, 1:] + 4 * wet[1:, 1:] + 8 * wet[1:, :-1]
    found = []
    for number, shapes in SHAPES.items():
        j, i = np.nonzero(code == number)
        corner = np.column_stack((i + first[0] + 0.5, j + first[1] + 0.5))
        found += [shapely.polygons((corner[:, None] + np.array(shape)) * size) for shape in shapes]
    union = shapely.simplify(shapely.union_all(np.concatenate(found)), 0.0)
    parts = shapely.get_parts(shapely.normalize(union))
    return [part for part in parts if not part.is_empty]
