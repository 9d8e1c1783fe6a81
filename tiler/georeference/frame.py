"""How coordinates of a file become those of the region: axes, units, then a reprojection where there is one."""

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError

if TYPE_CHECKING:
    import pyproj

Axis = tuple[int, float]  # which coordinate of a file, and the metres of its unit, with a direction
Box = tuple[float, float, float, float]

STEP = 0.001  # m; coordinates of points that were reprojected are whole multiples of it
FAR = 100_000.0  # m; their units are counted from a multiple of it
EDGE_POINTS = 21  # points on each side of a box that is reprojected, as its sides become curves
MARGIN = 0.01  # share of its size by which such a box is then grown


@dataclass(frozen=True)
class Frame:
    """How coordinates of a file become those of the region."""

    # Which coordinate of the file it is, and the metres of its unit, negative where it grows westwards or
    # southwards.
    east: Axis = (0, 1.0)
    north: Axis = (1, 1.0)
    height: float = 1.0  # metres of a unit of height
    # CRSs from and to which these coordinates are then reprojected, as EPSG:NNNN or WKT; ``""`` for none.
    source: str = ""
    target: str = ""

    @property
    def changes_plan(self) -> bool:
        """Whether coordinates in plan are not taken as they are."""
        return self.east != (0, 1.0) or self.north != (1, 1.0) or bool(self.source)


AS_IT_IS = Frame()


def to_region(frame: Frame, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give places of the file in the region's CRS, float64 (n, 2): metres; infinite where a place has none there.

    Examples
    --------
    >>> to_region(Frame(east=(1, -1.0), north=(0, -1.0)), np.array([[1043000.0, 743000.0]])).tolist()
    [[-743000.0, -1043000.0]]
    """
    plan = np.column_stack([xy[:, axis] * unit for axis, unit in (frame.east, frame.north)])
    if not frame.source:
        return plan
    return np.column_stack(_transformer(frame.source, frame.target).transform(plan[:, 0], plan[:, 1]))


def shapes_to_region(frame: Frame, shapes: Any) -> Any:
    """Give geometries of the file, one or an array of them, in the region's CRS."""
    return shapely.transform(shapes, partial(to_region, frame)) if frame.changes_plan else shapes


def box_to_region(frame: Frame, box: Box) -> Box:
    """Give a box around what a box of the file becomes (m); its corners where units and axes alone change.

    Raises
    ------
    InputError
        If it has no place in the region's CRS.
    """
    corners = to_region(Frame(frame.east, frame.north), np.array(box, np.float64).reshape(2, 2))
    low, high = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    plain = (low[0], low[1], high[0], high[1])
    return _reproject(plain, frame.source, frame.target) if frame.source else plain


def box_to_file(frame: Frame, box: Box) -> Box:
    """Give a box around what a box of the region is in the file; errors as for `box_to_region`."""
    if frame.source:
        xmin, ymin, xmax, ymax = _reproject(box, frame.target, frame.source)
        margin = MARGIN * max(xmax - xmin, ymax - ymin)
        box = (xmin - margin, ymin - margin, xmax + margin, ymax + margin)
    ends = {
        axis: sorted((box[place] / unit, box[place + 2] / unit))
        for place, (axis, unit) in enumerate((frame.east, frame.north))
    }
    return ends[0][0], ends[1][0], ends[0][1], ends[1][1]


def origin_of(middle: tuple[float, float]) -> tuple[float, float]:
    """Give the place that units of reprojected points near another one are counted from (m).

    Examples
    --------
    >>> origin_of((631234.0, 5803890.0))
    (600000.0, 5800000.0)
    """
    return FAR * math.floor(middle[0] / FAR), FAR * math.floor(middle[1] / FAR)


@lru_cache(maxsize=16)
def _transformer(source: str, target: str) -> "pyproj.Transformer":
    """Make a transformer once a process: that takes PROJ a tenth of a second."""
    import pyproj

    return pyproj.Transformer.from_crs(source, target, always_xy=True)


def _reproject(box: Box, source: str, target: str) -> Box:
    from pyproj.exceptions import ProjError

    try:
        found = _transformer(source, target).transform_bounds(*box, densify_pts=EDGE_POINTS)
    except ProjError:
        found = (math.inf,) * 4
    xmin, ymin, xmax, ymax = found
    if not np.isfinite(found).all() or xmin > xmax or ymin > ymax:
        raise InputError(f"the box {box} of {source} has no place in {target}; check the CRS, --crs and --bounds")
    return xmin, ymin, xmax, ymax
