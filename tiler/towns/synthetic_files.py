"""Files of synthetic points: LAZ that has the same bytes whenever it is written."""

from collections.abc import Iterable, Mapping
from datetime import date
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
from numpy.typing import NDArray

from pipeline.data.pointcloud import PointCloud

SCALE = 0.01  # m
DAY = date(2022, 1, 1)  # in all files, so that the same seed gives the same bytes


def write_laz(path: Path, cloud: PointCloud, bounds: tuple[float, float, float, float], crs: str) -> None:
    """Write a point cloud, each point the only return of its pulse, with offsets of whole metres."""
    las = laspy.LasData(_make_header(bounds, crs))
    las.x, las.y, las.z = cloud.xyz.T
    las.classification = cloud.classification
    las.return_number = las.number_of_returns = np.ones(len(cloud.xyz), np.uint8)
    las.write(path, laz_backend=laspy.LazBackend.Lazrs)


def write_laz_parts(
    path: Path,
    parts: Iterable[tuple[PointCloud, Mapping[str, NDArray[Any]]]],
    bounds: tuple[float, float, float, float],
    crs: str,
) -> None:
    """Write a point cloud part by part, one of which is in memory, with what LAS says of each point besides."""
    header = _make_header(bounds, crs)
    with laspy.open(path, mode="w", header=header, laz_backend=laspy.LazBackend.Lazrs) as file:
        for cloud, fields in parts:
            points = laspy.ScaleAwarePointRecord.zeros(len(cloud.xyz), header=header)
            points.x, points.y, points.z = cloud.xyz.T
            points.classification = cloud.classification
            for name, values in fields.items():
                points[name] = values
            file.write_points(points)


def _make_header(bounds: tuple[float, float, float, float], crs: str) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, SCALE)
    header.offsets = np.array([np.floor(bounds[0]), np.floor(bounds[1]), 0.0])
    header.creation_date = DAY
    header.generating_software = "citystitch synth"
    header.add_crs(pyproj.CRS(crs))
    return header
