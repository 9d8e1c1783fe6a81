"""How coordinates of the footprints become those of the region (step 1.2)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import pyproj

from pipeline.data.errors import InputError
from tiler.georeference.crs import boxes_meet, crs_name, crs_text, directions_of, is_one
from tiler.georeference.frame import Box, Frame, box_to_region
from tiler.georeference.metric import MetricCrs, find_metric
from tiler.georeference.operation import Operation, find_operation


def footprint_frame(
    stated: pyproj.CRS, crs: pyproj.CRS, box: Box, say: Callable[[str, str, str], None] | None = None
) -> tuple[Frame, Operation | None]:
    """Describe how coordinates of footprints become those of a region.

    Parameters
    ----------
    stated, crs : pyproj.CRS
        CRS of the footprints, horizontal, and that of the region.
    box : tuple of 4 floats
        The region (m).
    say : callable, optional
        Told the kind, the subject and the text of what the user must know.

    Returns
    -------
    Frame
    Operation or None
        None where nothing is reprojected.

    Raises
    ------
    InputError
        If the axes of the CRS point elsewhere, and no register has it with axes east and north.
    """
    metric = MetricCrs(stated, (0, 1.0), (1, 1.0)) if stated.is_geographic else find_metric(stated)
    if metric is None:
        raise InputError(
            f"the footprints: {crs_name(stated)} has axes to the {directions_of(stated)}, and no register has it "
            f"with axes east and north; reproject them: ogr2ogr -t_srs {crs_name(crs)} metric.gpkg <footprints>"
        )
    plain = Frame(metric.east, metric.north)
    if not stated.is_geographic and is_one(metric.crs, crs, box):
        if say is not None and plain.changes_plan:
            text = f"the footprints: {crs_name(stated)} converted to {crs_name(crs)}"
            say("footprints-converted", "footprints", text)
        return plain, None
    frame = replace(plain, source=crs_text(metric.crs), target=crs_text(crs))
    operation = find_operation(metric.crs, crs, box)
    if say is not None:
        say("footprints-operation", "footprints", f"the footprints are reprojected {operation.describe()}")
    return frame, operation


def find_shown_axes(
    stated: pyproj.CRS, crs: pyproj.CRS, extent: Box | None, box: Box, clouds: Sequence[Frame]
) -> tuple[Frame, str] | None:
    """Find the axes that coordinates of footprints show, where those of their CRS put them off the region.

    Parameters
    ----------
    stated, crs : pyproj.CRS
        CRS of the footprints, horizontal, and that of the region.
    extent : tuple of 4 floats, or None
        Of the footprints, in their own coordinates.
    box : tuple of 4 floats
        The region (m).
    clouds : sequence of Frame
        Of the clouds: footprints with their coordinates may have the same axes.

    Returns
    -------
    Frame and str, or None
        The axes, and the words that tell of them. None where those of the CRS count: it is another than the
        region's, or the footprints lie in the region by it, or by no other axes.
    """
    metric = find_metric(stated) if stated.is_projected else None
    if extent is None or metric is None or not is_one(metric.crs, crs, box):
        return None
    if boxes_meet(box_to_region(Frame(metric.east, metric.north), extent), box):
        return None
    sizes = abs(metric.east[1]), abs(metric.north[1])
    others = {}
    if min(metric.east[1], metric.north[1]) < 0:
        words = f"{crs_name(stated)} has axes to the {directions_of(stated)}, but the coordinates grow to the"
        others[f"{words} east and north"] = Frame((0, sizes[0]), (1, sizes[1]))
    for frame in clouds:
        if not frame.source:
            others.setdefault("their axes are those of the point clouds", replace(frame, height=1.0))
    for words, frame in others.items():
        if boxes_meet(box_to_region(frame, extent), box):
            return frame, words
    return None
