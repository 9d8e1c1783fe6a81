"""A chunk of the points of a LAS file, as arrays of whole units, and the same in the region's CRS (step 1.1)."""

from dataclasses import dataclass

import laspy
import numpy as np
from numpy.typing import NDArray

from pipeline.classes import GROUND, KEY_POINT
from pipeline.las_points import Triple, find_coordinates, find_range
from tiler.georeference.frame import STEP, Frame, origin_of, to_region

_FIELDS = laspy.DecompressionSelection
# Fields to decompress where points are stored by fields (formats 6 to 10): coordinates, class and withheld. laspy
# gives a field that is left out the first value of its chunk for all points.
FIELDS = _FIELDS.XY_RETURNS_CHANNEL | _FIELDS.Z | _FIELDS.CLASSIFICATION | _FIELDS.FLAGS

LAST_LEGACY_FORMAT = 5
MOST_UNITS = 2**31 - 1


@dataclass(frozen=True, eq=False)
class PointChunk:
    """Some points of a file.

    Attributes
    ----------
    x, y, z : int32, (n,)
        Coordinates in whole units.
    scale, offset : tuple of 3 floats
        Size of a unit along each axis, and place of unit 0, in the file's CRS or the region's.
    classification : uint8, (n,)
        ASPRS class of each point; model key points count as ground.
    withheld : bool, (n,)
        Whether the file says not to use a point.
    n_key_points : int
        How many points had the class of model key points.
    """

    x: NDArray[np.int32]
    y: NDArray[np.int32]
    z: NDArray[np.int32]
    scale: Triple
    offset: Triple
    classification: NDArray[np.uint8]
    withheld: NDArray[np.bool_]
    n_key_points: int = 0

    def __len__(self) -> int:
        return len(self.x)


def take_chunk(record: laspy.ScaleAwarePointRecord) -> PointChunk:
    """Take what the steps need of a chunk of points.

    Parameters
    ----------
    record : laspy.ScaleAwarePointRecord
        Points as laspy reads them.

    Returns
    -------
    PointChunk
        In the file's CRS.

    Notes
    -----
    Class 8 is that of model key points, thinned ground, in the point formats 0 to 5 (LAS 1.4 R15, table 9), and
    reserved in the formats 6 to 10 (table 17).
    """
    classes = np.ascontiguousarray(record.classification, np.uint8)
    n_key_points = 0
    if record.point_format.id <= LAST_LEGACY_FORMAT:
        key = classes == KEY_POINT
        n_key_points = int(np.count_nonzero(key))
        if n_key_points:
            classes = np.where(key, np.uint8(GROUND), classes)
    (a, b, c), (x, y, z) = (np.asarray(values, np.float64).tolist() for values in (record.scales, record.offsets))
    withheld = np.asarray(np.asarray(record.withheld) != 0)
    array = record.array
    return PointChunk(array["X"], array["Y"], array["Z"], (a, b, c), (x, y, z), classes, withheld, n_key_points)


def ends_of(chunk: PointChunk) -> NDArray[np.float64]:
    """Give the coordinates of the least and the greatest units along each axis, (2, 3); (0, 3) of none."""
    if len(chunk) == 0:
        return np.empty((0, 3))
    x, y, z = (np.array(find_range(units), np.int32) for units in (chunk.x, chunk.y, chunk.z))
    return np.asarray(find_coordinates(x, y, z, chunk.scale, chunk.offset))


def coordinates_of(chunk: PointChunk) -> NDArray[np.float64]:
    """Give the coordinates, float64 (n, 3)."""
    return np.asarray(find_coordinates(chunk.x, chunk.y, chunk.z, chunk.scale, chunk.offset))


def place_chunk(chunk: PointChunk, frame: Frame, middle: tuple[float, float]) -> PointChunk:
    """Give a chunk in the region's CRS.

    Parameters
    ----------
    chunk : PointChunk
        In the file's CRS.
    frame : Frame
        How coordinates of the file become those of the region.
    middle : tuple of 2 floats
        Middle of the file in the region's CRS (m): reprojected points are counted from near it.

    Returns
    -------
    PointChunk
        In metres. Where units and axes alone change, the units of the file stay, exactly; reprojected points are
        rounded to millimetres. A point without a place in the region's CRS is withheld.
    """
    scale, offset = _heights(chunk, frame)
    if not frame.source:
        return _turn(chunk, frame, scale, offset)
    plan = coordinates_of(chunk)[:, :2]
    start = origin_of(middle)
    units = (to_region(frame, plan) - start) / STEP
    there = np.abs(units).max(axis=1) <= MOST_UNITS  # infinite or NaN where there is none
    x, y = np.rint(np.where(there[:, None], units, 0.0)).astype(np.int32).T.copy()
    return PointChunk(
        x,
        y,
        chunk.z,
        (STEP, STEP, scale),
        (*start, offset),
        chunk.classification,
        chunk.withheld | ~there,
        chunk.n_key_points,
    )


def _heights(chunk: PointChunk, frame: Frame) -> tuple[float, float]:
    return chunk.scale[2] * frame.height, chunk.offset[2] * frame.height


def _turn(chunk: PointChunk, frame: Frame, z_scale: float, z_offset: float) -> PointChunk:
    """Change units and axes."""
    if frame.east == (0, 1.0) and frame.north == (1, 1.0):
        x, y = chunk.x, chunk.y
        scale, offset = chunk.scale[:2], chunk.offset[:2]
    else:
        both = (chunk.x, chunk.y)
        x, y = (both[axis] if unit > 0 else -both[axis] for axis, unit in (frame.east, frame.north))
        scale = tuple(chunk.scale[axis] * abs(unit) for axis, unit in (frame.east, frame.north))  # type: ignore[assignment]
        offset = tuple(chunk.offset[axis] * unit for axis, unit in (frame.east, frame.north))  # type: ignore[assignment]
    return PointChunk(
        x,
        y,
        chunk.z,
        (*scale, z_scale),
        (*offset, z_offset),
        chunk.classification,
        chunk.withheld,
        chunk.n_key_points,
    )
