"""What the steps take of a chunk of LAS points, as arrays (step 1.1)."""

import laspy
import numpy as np
from numpy.typing import NDArray

from pipeline.las_points import Triple, find_coordinates, find_range

_FIELDS = laspy.DecompressionSelection
# Fields to decompress where points are stored by fields (formats 6 to 10): coordinates, class and withheld.
FIELDS = _FIELDS.XY_RETURNS_CHANNEL | _FIELDS.Z | _FIELDS.CLASSIFICATION | _FIELDS.FLAGS


def units_of(chunk: laspy.ScaleAwarePointRecord) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Give x, y and z in units of the file, int32 (n,) each, where the chunk has them."""
    return chunk.array["X"], chunk.array["Y"], chunk.array["Z"]


def ends_of(chunk: laspy.ScaleAwarePointRecord) -> NDArray[np.float64]:
    """Give the coordinates (m) of the least and the greatest units along each axis, (2, 3); (0, 3) of none."""
    if len(chunk) == 0:
        return np.empty((0, 3))
    x, y, z = (np.array(find_range(units), np.int32) for units in units_of(chunk))
    return np.asarray(find_coordinates(x, y, z, *scaling_of(chunk)))


def scaling_of(chunk: laspy.ScaleAwarePointRecord) -> tuple[Triple, Triple]:
    """Give the size of a unit along each axis, and the place of unit 0 (m)."""
    (a, b, c), (x, y, z) = (np.asarray(values, np.float64).tolist() for values in (chunk.scales, chunk.offsets))
    return (a, b, c), (x, y, z)


def coordinates_of(chunk: laspy.ScaleAwarePointRecord) -> NDArray[np.float64]:
    """Give the coordinates (m), float64 (n, 3)."""
    return np.asarray(find_coordinates(*units_of(chunk), *scaling_of(chunk)))


def classes_of(chunk: laspy.ScaleAwarePointRecord) -> NDArray[np.uint8]:
    """Give the ASPRS class of each point, uint8 (n,)."""
    return np.ascontiguousarray(chunk.classification, np.uint8)
