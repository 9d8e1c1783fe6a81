"""The side of tiles where none is given."""

import math

from stitch.tiling.smallest_tile import LEAST_TILE

LEAST_SIDE = 10.0  # m
LARGE_SIDE = 1250.0  # m; for meshes of the size below, and coarser ones
LARGE_SIDE_SIZE = 10.0  # m
POWER = 0.9  # of the mesh size: cells in a tile grow somewhat as it falls
STEP = 10.0  # m; sides that are chosen are multiples of it


def choose_tile_size(mesh_size: float, largest_size: float) -> float:
    """Choose the side of tiles (m) so that seams are few, and a worker takes some 300 to 450 MB.

    Parameters
    ----------
    mesh_size, largest_size : float
        Target edge length at walls, and the largest one in the region (m).

    Notes
    -----
    Nothing else counts, so that a larger region has the same tiles. Larger tiles have fewer seams and tasks,
    smaller ones take less memory and leave no worker idle: `docs/scaling.md` has the measurements.

    Examples
    --------
    >>> [choose_tile_size(size, size) for size in (20.0, 10.0, 5.0, 2.5)]
    [1250.0, 1250.0, 660.0, 350.0]
    """
    fine = min(mesh_size / LARGE_SIDE_SIZE, 1.0)
    side = math.floor(LARGE_SIDE * math.pow(fine, POWER) / STEP) * STEP
    return max(side, LEAST_SIDE, LEAST_TILE * largest_size)
