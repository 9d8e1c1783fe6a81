"""Point clouds read whole, in the order of the file: what tests compare with."""

from pathlib import Path

import numpy as np

from pipeline.data.pointcloud import PointCloud
from tiler.georeference.frame import AS_IT_IS, Frame
from tiler.objects.places import as_place
from tiler.pointclouds.cells import Box
from tiler.pointclouds.ingest import COUNTED, select_usable
from tiler.pointclouds.las_chunks import coordinates_of, read_chunks
from tiler.pointclouds.las_header import read_las_header


def read_points(path: str | Path, bounds: Box, *, frame: Frame = AS_IT_IS) -> tuple[PointCloud, dict[str, int]]:
    """Read the usable points of a file within a box, and the counts of all."""
    path = as_place(path)
    counts = dict.fromkeys(COUNTED, 0)
    xyz, classes = [np.empty((0, 3))], [np.empty(0, np.uint8)]
    for chunk in read_chunks(path, read_las_header(path), frame=frame):
        kept = select_usable(chunk, bounds, counts)
        xyz.append(coordinates_of(chunk)[kept])
        classes.append(chunk.classification[kept])
    return PointCloud(np.concatenate(xyz), np.concatenate(classes)), counts
