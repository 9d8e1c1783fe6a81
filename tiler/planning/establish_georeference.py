"""Where a region lies: its CRS, and how coordinates of each cloud and of the footprints become those of it."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import pyproj

from pipeline.data.errors import InputError
from pipeline.data.notes import Note
from tiler.config.config import Config
from tiler.georeference.crs import (
    SAME_PLACE,
    Box,
    box_around,
    boxes_meet,
    crs_name,
    crs_text,
    horizontal_crs,
    is_on_its_place,
    is_one,
    same_crs,
    scale_of,
    utm_crs,
)
from tiler.georeference.footprints import find_shown_axes, footprint_frame
from tiler.georeference.frame import Frame, box_to_region
from tiler.georeference.metric import LIKELY, MetricCrs, axes_words, find_metric
from tiler.georeference.operation import Operation, find_operation
from tiler.georeference.units import unit_name
from tiler.planning.cloud_crs import (
    CloudGroup,
    Findings,
    PlanCrs,
    choose_fallback,
    choose_height_unit,
    choose_plan,
    group_box,
    group_clouds,
    read_wish,
)
from tiler.pointclouds.clouds import CloudHeader

FOOTPRINTS = "the footprints"  # subject of their operation
LARGEST_SCALE = 0.004  # how far the scale of a projection may be from 1: 4 m in a kilometre


@dataclass(frozen=True)
class Georeference:
    """Where a region lies, and how its input gets there."""

    crs: pyproj.CRS  # projected, horizontal, in metres, axes east and north
    clouds: list[CloudHeader]  # all clouds, with their boxes in that CRS, and their frames
    footprints: Frame  # how coordinates of the footprints become those of the region
    operations: dict[str, Operation]  # those that reproject, by what they reproject
    messages: list[str]  # messages for the user
    notes: list[Note]  # the same for the record, by kind
    record: dict[str, Any]  # all of it in plain values


def establish_georeference(
    asked: Config, clouds: Sequence[CloudHeader], footprints: pyproj.CRS | None, extent: Box | None
) -> Georeference:
    """Establish where a region lies, from the headers of its input alone.

    Parameters
    ----------
    asked : Config
        Parameters: what the user says of CRS, unit of heights, and reprojection.
    clouds : sequence of CloudHeader
        All point clouds, at least one of them with points; those without have no say.
    footprints : pyproj.CRS or None
        CRS that the footprints state.
    extent : tuple of 4 floats, or None
        xmin, ymin, xmax, ymax of the footprints in their own coordinates, where it is known.

    Raises
    ------
    ConfigError
        If ``--crs`` cannot be parsed, or is no projected CRS.
    InputError
        If nobody states a CRS, if two contradict each other or the coordinates, or if plan is so stretched by the
        projection that lengths are wrong: with the option that mends it.

    Notes
    -----
    The region's CRS is that of ``--crs``, else the first cloud's, else the footprints', in metres and with axes
    east and north: coordinates in feet, or along axes to the west or south, are converted exactly. Clouds in
    another CRS are reprojected where that is asked for.
    """
    findings = Findings([], [])
    groups = group_clouds(clouds)
    wish = read_wish(asked, groups)
    stated = [choose_plan(group, wish, asked, findings) for group in groups]
    fallback = choose_fallback(groups, stated, footprints, findings)
    plans = [found or fallback for found in stated]
    crs = _registered(_choose_target(groups, plans, wish, asked), groups, plans, footprints)
    placed: dict[int, CloudHeader] = {}
    described: list[dict[str, Any]] = []
    operations: dict[str, Operation] = {}
    for group, plan in zip(groups, plans, strict=True):
        frame, operation = _frame(group, plan, crs, asked, findings)
        described.append(_describe_clouds(group, plan, frame, operation))
        operations |= {} if operation is None else {group.first.path.name: operation}
        for cloud in group.clouds:
            low, high = sorted((cloud.bounds[4] * frame.height, cloud.bounds[5] * frame.height))
            placed[id(cloud)] = replace(
                cloud, bounds=(*box_to_region(frame, cloud.bounds[:4]), low, high), frame=frame
            )
    scale = _check_scale(crs, [placed[id(cloud)] for group in groups for cloud in group.clouds], asked)
    region = box_around([cloud.bounds for cloud in placed.values()])
    frame, operation = _place_footprints(footprints, extent, crs, region, plans, groups, placed, findings)
    operations |= {} if operation is None else {FOOTPRINTS: operation}
    _describe_stray(list(placed.values()), crs, findings)
    record = {"crs": crs_name(crs), "scale of the projection": round(scale, 6), "clouds": described}
    if footprints is not None or extent is not None:
        name = None if footprints is None else crs_name(footprints)
        record["footprints"] = {"crs": name, **_describe_frame(frame, operation)}
    everything = [placed.get(id(cloud), cloud) for cloud in clouds]
    return Georeference(crs, everything, frame, operations, findings.messages, findings.notes, record)


def find_inexact(found: Georeference, bound: float) -> list[Note]:
    """Note the operations that are less exact than a bound (m), or of unknown accuracy: kind ``crs-accuracy``."""
    return [
        Note("crs-accuracy", subject, detail=f"{operation.describe()}; {bound:g} m is asked for")
        for subject, operation in found.operations.items()
        if operation.is_worse_than(bound)
    ]


def _choose_target(
    groups: Sequence[CloudGroup],
    plans: Sequence[PlanCrs],
    wish: tuple[pyproj.CRS, MetricCrs] | None,
    asked: Config,
) -> pyproj.CRS:
    """Choose the region's CRS; a UTM zone where clouds are to be reprojected from one without true lengths."""
    if wish is not None:
        return wish[1].crs
    group, plan = groups[0], plans[0]
    box = group_box(group, plan)
    stretched = plan.degrees or abs(scale_of(box, plan.metric.crs) - 1) > LARGEST_SCALE
    if asked.reproject and stretched and (zone := utm_crs(box, plan.metric.crs)):
        return pyproj.CRS(zone)
    return plan.metric.crs


def _registered(
    crs: pyproj.CRS, groups: Sequence[CloudGroup], plans: Sequence[PlanCrs], footprints: pyproj.CRS | None
) -> pyproj.CRS:
    """Take a CRS of the EPSG register that is one with the region's, where the input or PROJ has such a one."""
    if crs.to_epsg() is not None:
        return crs
    box = group_box(groups[0], plans[0])
    flat = horizontal_crs(footprints)
    others = [plan.metric.crs for plan in plans] + ([flat] if flat is not None else [])
    others += [
        pyproj.CRS.from_authority(match.auth_name, match.code)
        for match in crs.list_authority(auth_name="EPSG", min_confidence=LIKELY)
    ]
    for other in others:
        registered = other.is_projected and other.to_epsg() is not None
        if registered and is_on_its_place(box, other) and is_one(crs, other, box):
            metric = find_metric(other)
            if metric is not None and metric.crs == other:
                return other
    return crs


def _frame(
    group: CloudGroup, plan: PlanCrs, crs: pyproj.CRS, asked: Config, findings: Findings
) -> tuple[Frame, Operation | None]:
    """Describe how a group's coordinates become those of the region."""
    metric = plan.metric
    height = choose_height_unit(group, plan, asked, findings)
    plain = Frame(metric.east, metric.north, height)
    box = group_box(group, plan)
    if is_one(metric.crs, crs, box):
        if not same_crs(metric.crs, crs):
            findings.say_of(
                group,
                "cloud-crs-alike",
                f"{group.label}: {crs_name(metric.crs)} is taken as {crs_name(crs)}, as the region moves by less "
                f"than {SAME_PLACE:g} m between them",
            )
        if plain.changes_plan:
            findings.say_of(
                group,
                "cloud-converted",
                f"{group.label}: {crs_name(plan.source)} in {unit_name(abs(metric.east[1]))}"
                f"{axes_words(metric)} converted to {crs_name(crs)} in metres",
            )
        return plain, None
    if not asked.reproject:
        raise InputError(
            f"{group.first.path}: states {crs_name(plan.source)}, others {crs_name(crs)}; add --reproject to "
            "reproject it, or leave it out"
        )
    frame = replace(plain, source=crs_text(metric.crs), target=crs_text(crs))
    operation = find_operation(metric.crs, crs, box_to_region(frame, group.box))
    findings.say_of(group, "cloud-reprojected", f"{group.label}: reprojected {operation.describe()}")
    return frame, operation


def _check_scale(crs: pyproj.CRS, clouds: Sequence[CloudHeader], asked: Config) -> float:
    """Refuse a projection whose lengths are not those on the ground."""
    box = box_around([cloud.bounds for cloud in clouds])
    scale = scale_of(box, crs)
    if math.isnan(scale):
        raise InputError(
            f"{clouds[0].path}: coordinates such as ({box[0]:.10g}, {box[1]:.10g}) have no place on Earth in "
            f"{crs_name(crs)}, or PROJ has no transformation of it; give the right CRS with --crs"
        )
    if abs(scale - 1) <= LARGEST_SCALE:
        return scale
    if not is_on_its_place(box, crs):
        area = crs.area_of_use.name if crs.area_of_use else ""
        raise InputError(
            f"{clouds[0].path}: lies outside the area of use of {crs_name(crs)} ({area}), which stretches plan by "
            f"{scale:.4g} there; give the right CRS with --crs"
        )
    zone = utm_crs(box, crs)
    move = "give another --crs" if zone is None else f"give --crs {zone} --reproject"
    if asked.crs and not asked.reproject and zone is not None:
        move = f"give the CRS of the clouds with --crs, or --crs {zone} --reproject where it is {crs_name(crs)}"
    raise InputError(
        f"{crs_name(crs)}: a metre on the ground is {scale:.4g} m in plan here, and heights are not stretched "
        f"(at most {LARGEST_SCALE:.1%} is taken): houses would be that much too wide; {move}"
    )


def _place_footprints(
    stated: pyproj.CRS | None,
    extent: Box | None,
    crs: pyproj.CRS,
    box: Box,
    plans: Sequence[PlanCrs],
    groups: Sequence[CloudGroup],
    placed: dict[int, CloudHeader],
    findings: Findings,
) -> tuple[Frame, Operation | None]:
    """Describe how coordinates of the footprints become those of the region."""
    flat = horizontal_crs(stated)
    if flat is None:
        if extent is None:
            return Frame(), None
        like = placed[id(groups[0].first)].frame
        if like.changes_plan and boxes_meet(extent, groups[0].box) and not boxes_meet(extent, box):
            findings.say(
                "footprints-without-crs",
                "footprints",
                f"the footprints state no CRS; taken as {crs_name(plans[0].source)}, as their coordinates are "
                f"those of {groups[0].first.path.name}",
            )
            return replace(like, height=1.0), None
        return Frame(), None
    shown = find_shown_axes(flat, crs, extent, box, [cloud.frame for cloud in placed.values()])
    if shown is not None:
        findings.say("footprints-axes", "footprints", f"the footprints: {shown[1]}; taken as {crs_name(crs)}")
        return shown[0], None
    return footprint_frame(flat, crs, box, findings.say)


def _describe_stray(clouds: Sequence[CloudHeader], crs: pyproj.CRS, findings: Findings) -> None:
    stray = [cloud for cloud in clouds if not is_on_its_place(cloud.bounds, crs)]
    if stray:
        more = f" and {len(stray) - 1} more point clouds lie" if len(stray) > 1 else " lies"
        findings.say(
            "cloud-off-its-crs",
            stray[0].path.name,
            f"{stray[0].path.name}{more} outside the area of use of "
            f"{crs_name(crs)} ({crs.area_of_use.name if crs.area_of_use else ''}); is it the right CRS?",
        )


def _describe_clouds(
    group: CloudGroup, plan: PlanCrs, frame: Frame, operation: Operation | None
) -> dict[str, Any]:
    return {
        "files": len(group.clouds),
        "first": group.first.path.name,
        "stated": None if group.stated is None else crs_name(group.stated),
        "taken as": crs_name(plan.source),
        "unit of heights (m)": frame.height,
        "unit of heights stated": group.first.height_unit is not None,
        **_describe_frame(frame, operation),
    }


def _describe_frame(frame: Frame, operation: Operation | None) -> dict[str, Any]:
    axes = {
        "easting": {"coordinate": frame.east[0], "unit (m)": frame.east[1]},
        "northing": {"coordinate": frame.north[0], "unit (m)": frame.north[1]},
    }
    if operation is None:
        return axes
    return axes | {"operation": asdict(operation) | {"missing_grids": list(operation.missing_grids)}}
