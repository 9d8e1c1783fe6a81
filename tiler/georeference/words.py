"""Words of messages about CRSs: units, directions, commands."""

from collections.abc import Sequence
from pathlib import Path

import pyproj

from tiler.georeference.crs import crs_name
from tiler.georeference.metric import MetricCrs

Box = tuple[float, float, float, float]


def like_degrees(box: Box) -> bool:
    """Whether coordinates can be longitude and latitude, in either order: no projected region is so small."""
    return max(abs(value) for value in box) <= 360 and max(box[2] - box[0], box[3] - box[1]) < 5


def fault_of(crs: pyproj.CRS) -> str:
    """Say why lengths in a CRS are not lengths on the ground; ``""`` for a projected one."""
    if crs.is_geographic:
        return "is geographic (degrees)"
    return "" if crs.is_projected else f"is no projected CRS ({crs.type_name})"


def directions_of(crs: pyproj.CRS) -> str:
    """Say where the axes of a CRS point."""
    return " and ".join(axis.direction.lower() for axis in crs.axis_info[:2])


def box_words(box: Sequence[float]) -> str:
    """Write a box for a message."""
    return " ".join(f"{value:.6g}" for value in box)


def pdal_command(cloud: Path, crs: pyproj.CRS, target: str | None) -> str:
    """Give the command of PDAL that reprojects a cloud."""
    name = cloud.name.split(".")[0]
    source = f" --filters.reprojection.in_srs={crs_name(crs)}" if crs.to_authority() else ""
    return (
        f'pdal translate "{cloud}" "{cloud.with_name(f"{name}_metric.laz")}" reprojection{source} '
        f"--filters.reprojection.out_srs={target or 'EPSG:<a projected CRS in metres>'}"
    )


def boxes_meet(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether two boxes have a place in common."""
    return one[0] <= other[2] and one[2] >= other[0] and one[1] <= other[3] and one[3] >= other[1]


def axes_words(metric: MetricCrs) -> str:
    """Say that axes were turned or exchanged, ``""`` where they were not."""
    if metric.east[0] == 1 and min(metric.east[1], metric.north[1]) > 0:
        return ", northing before easting,"
    return ", axes to the west and south," if metric.east[1] < 0 or metric.north[1] < 0 else ""
