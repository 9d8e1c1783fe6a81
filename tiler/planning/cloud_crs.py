"""Which CRS and units the coordinates of each cloud have: what files state, held against what the user says."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pyproj

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.notes import Note
from tiler.config.config import Config
from tiler.georeference.crs import (
    Box,
    box_around,
    box_words,
    crs_name,
    directions_of,
    fault_of,
    horizontal_crs,
    is_on_its_place,
    is_one,
    like_degrees,
    parse_crs,
    pdal_command,
    utm_crs,
)
from tiler.georeference.frame import Frame, box_to_region
from tiler.georeference.las_crs import height_unit_of
from tiler.georeference.metric import MetricCrs, find_metric
from tiler.georeference.units import UNITS, same_unit, unit_name
from tiler.pointclouds.clouds import CloudHeader


@dataclass(frozen=True)
class CloudGroup:
    """Clouds that state the same of their coordinates."""

    clouds: list[CloudHeader]
    stated: pyproj.CRS | None  # horizontal

    @property
    def first(self) -> CloudHeader:
        return self.clouds[0]

    @property
    def box(self) -> Box:
        return box_around([cloud.bounds for cloud in self.clouds])

    @property
    def label(self) -> str:
        n = len(self.clouds)
        kind = "point clouds" if self.first.kind == "cloud" else "files"
        return self.first.path.name if n == 1 else f"{n} {kind} ({self.first.path.name} and others)"

    @property
    def state(self) -> str:
        return "states" if len(self.clouds) == 1 else "state"


@dataclass(frozen=True)
class PlanCrs:
    """Which metric CRS a group's coordinates in plan have, and from where."""

    source: pyproj.CRS
    metric: MetricCrs
    degrees: bool = False


@dataclass(frozen=True)
class Findings:
    """What the user must know, as messages and as notes."""

    messages: list[str]
    notes: list[Note]

    def say(self, kind: str, subject: str, text: str) -> None:
        self.messages.append(text)
        self.notes.append(Note(kind, subject, detail=text))

    def say_of(self, group: CloudGroup, kind: str, text: str) -> None:
        """Say what is so of a group; the record names its first file."""
        self.say(kind, group.first.path.name, text)


def group_clouds(clouds: Sequence[CloudHeader]) -> list[CloudGroup]:
    """Group clouds with points by what they state, in the order of their first."""
    groups: dict[Any, list[CloudHeader]] = {}
    for cloud in clouds:
        if cloud.n_points > 0:
            groups.setdefault((id(cloud.crs), cloud.plan_unit, cloud.height_unit), []).append(cloud)
    return [CloudGroup(members, horizontal_crs(members[0].crs)) for members in groups.values()]


def read_wish(asked: Config, groups: Sequence[CloudGroup]) -> tuple[pyproj.CRS, MetricCrs] | None:
    """Parse ``--crs``, and find its metric form."""
    if not asked.crs:
        return None
    full = parse_crs(asked.crs)
    flat = horizontal_crs(full)
    if flat is None:
        raise ConfigError(f"--crs {asked.crs!r} has no place on Earth; give a projected CRS in metres")
    if not flat.is_projected:
        zone = next((zone for group in groups if (zone := utm_crs(group.box, flat))), None)
        move = f"--crs {zone} --reproject" if zone else "the projected CRS of the clouds"
        raise InputError(
            f"--crs {crs_name(flat)} {fault_of(flat)}, and cells need metres; give {move} (the region's CRS)"
        )
    metric = find_metric(flat)
    if metric is None:
        raise InputError(
            f"--crs {crs_name(flat)} has axes to the {directions_of(flat)}, and no register has it with axes east "
            "and north; give such a CRS, a UTM zone for example, with --reproject"
        )
    return flat, metric


def choose_plan(
    group: CloudGroup, wish: tuple[pyproj.CRS, MetricCrs] | None, asked: Config, findings: Findings
) -> PlanCrs | None:
    """Decide which CRS a group's coordinates have; None where neither file nor user says."""
    stated = group.stated
    if like_degrees(group.box) and (stated is None or stated.is_projected):
        return _assume_degrees(group, wish, asked, findings)
    if stated is None:
        unread = f": {group.first.unread}" if group.first.unread else ""
        if wish is None:
            return None
        text = f"no CRS that is understood{unread}; taken as {crs_name(wish[0])} of --crs"
        findings.say_of(group, "cloud-without-crs", f"{group.label} {group.state} {text}")
        return PlanCrs(wish[0], _with_unit(group, wish[0], wish[1], findings))
    if stated.is_geographic:
        return _choose_for_degrees(group, stated, wish, asked, findings)
    if not stated.is_projected:
        raise InputError(
            f"{group.first.path}: its CRS, {crs_name(stated)}, {fault_of(stated)}; reproject the cloud to a "
            f"projected CRS: {pdal_command(group.first.path, stated, None)}"
        )
    metric = find_metric(stated)
    if metric is None:
        zone = utm_crs(group.box, stated) or "EPSG:<a projected CRS in metres>"
        raise InputError(
            f"{group.first.path}: its CRS, {crs_name(stated)}, has axes to the {directions_of(stated)}, and no "
            "register has it with axes east and north; reproject the cloud: "
            f"{pdal_command(group.first.path, stated, zone)}"
        )
    if wish is None or asked.reproject or is_one(metric.crs, wish[1].crs, metric_box(group, metric)):
        return PlanCrs(stated, _with_unit(group, stated, metric, findings))
    return _overrule(group, stated, wish, findings)


def _overrule(
    group: CloudGroup, stated: pyproj.CRS, wish: tuple[pyproj.CRS, MetricCrs], findings: Findings
) -> PlanCrs:
    """Take ``--crs`` for what a file states, where its coordinates are plausible for that."""
    flat, metric = wish
    if not is_on_its_place(metric_box(group, metric), metric.crs):
        raise InputError(
            f"{group.first.path}: states {crs_name(stated)}, but --crs asks for {crs_name(flat)}, where "
            f"coordinates such as ({group.box[0]:.10g}, {group.box[1]:.10g}) have no place; add --reproject to "
            "reproject the cloud, or leave out --crs"
        )
    findings.say_of(
        group,
        "cloud-crs-overruled",
        f"{group.label} {group.state} {crs_name(stated)}; taken as {crs_name(flat)} of --crs (--reproject would "
        "reproject instead)",
    )
    return PlanCrs(flat, metric)


def _choose_for_degrees(
    group: CloudGroup,
    stated: pyproj.CRS,
    wish: tuple[pyproj.CRS, MetricCrs] | None,
    asked: Config,
    findings: Findings,
) -> PlanCrs:
    if asked.reproject and is_on_its_place(group.box, stated):
        return PlanCrs(stated, MetricCrs(stated, (0, 1.0), (1, 1.0)), degrees=True)
    if wish is not None and not like_degrees(group.box):
        return _overrule(group, stated, wish, findings)
    if not like_degrees(group.box) and not is_on_its_place(group.box, stated):
        raise InputError(
            f"{group.first.path}: its CRS, {crs_name(stated)}, {fault_of(stated)}, but its coordinates, "
            f"{box_words(group.box)}, are none; give the CRS that they are in with --crs"
        )
    target = crs_name(wish[0]) if wish is not None else utm_crs(group.box, stated)
    raise InputError(
        f"{group.first.path}: its CRS, {crs_name(stated)}, {fault_of(stated)}, and cells need metres; give "
        f"--reproject{f' --crs {target}' if target else ''}, or reproject this and every cloud like it: "
        f"{pdal_command(group.first.path, stated, target)}"
    )


def _with_unit(group: CloudGroup, crs: pyproj.CRS, metric: MetricCrs, findings: Findings) -> MetricCrs:
    """Take the unit that a key states beside a CRS, and the axes that the coordinates show."""
    unit = group.first.plan_unit
    sizes = abs(metric.east[1]), abs(metric.north[1])
    if unit is not None and any(not same_unit(unit, size) for size in sizes):
        keyed = MetricCrs(
            metric.crs,
            (metric.east[0], math.copysign(unit, metric.east[1])),
            (metric.north[0], math.copysign(unit, metric.north[1])),
        )
        by_key, by_crs = (is_on_its_place(metric_box(group, one), one.crs) for one in (keyed, metric))
        taken = keyed if by_key or not by_crs else metric
        findings.say_of(
            group,
            "cloud-unit-of-key",
            f"{group.label}: {crs_name(crs)} is in {unit_name(sizes[0])}, but GeoTIFF key 3076 says "
            f"{unit_name(unit)}; coordinates are taken in {unit_name(unit if taken is keyed else sizes[0])}",
        )
        return taken
    return _with_axes(group, crs, metric, findings)


def _with_axes(group: CloudGroup, crs: pyproj.CRS, metric: MetricCrs, findings: Findings) -> MetricCrs:
    """Take the axes that the coordinates show, where those of the CRS put them off its area of use."""
    if is_on_its_place(metric_box(group, metric), metric.crs):
        return metric
    sizes = abs(metric.east[1]), abs(metric.north[1])
    others = {
        f"{crs_name(crs)} has axes to the {directions_of(crs)}, but the coordinates grow to the east and north": (
            MetricCrs(metric.crs, (0, sizes[0]), (1, sizes[1]))
        ),
        f"the northing comes first, before the easting of {crs_name(crs)}": (
            MetricCrs(metric.crs, (1, sizes[0]), (0, sizes[1]))
        ),
    }
    for words, other in others.items():
        if other != metric and is_on_its_place(metric_box(group, other), other.crs):
            findings.say_of(group, "cloud-axes", f"{group.label}: {words}; taken as {crs_name(metric.crs)}")
            return other
    return metric


def choose_fallback(
    groups: Sequence[CloudGroup],
    plans: Sequence[PlanCrs | None],
    footprints: pyproj.CRS | None,
    findings: Findings,
) -> PlanCrs:
    """What is taken for clouds that state nothing: what the others state, else the footprints' CRS."""
    silent = [group for group, plan in zip(groups, plans, strict=True) if plan is None]
    known = [(group, plan) for group, plan in zip(groups, plans, strict=True) if plan is not None]
    if not silent:
        return known[0][1]
    n_silent, n_all = sum(len(group.clouds) for group in silent), sum(len(group.clouds) for group in groups)
    unread = next((f" ({group.first.unread})" for group in silent if group.first.unread), "")
    if known:
        group, plan = known[0]
        findings.say_of(
            silent[0],
            "cloud-without-crs",
            f"{n_silent} of {n_all} point clouds state no CRS{unread}; taken as {crs_name(plan.source)} of "
            f"{group.first.path.name}",
        )
        return plan
    flat = horizontal_crs(footprints)
    if flat is None:
        raise InputError(
            f"neither point clouds nor footprints state a CRS{unread}; give --crs, as in --crs EPSG:28992"
        )
    metric = find_metric(flat) if flat.is_projected else None
    if metric is None:
        raise InputError(
            f"the point clouds state no CRS{unread}, and that of the footprints, {crs_name(flat)}, "
            f"{fault_of(flat) or f'has axes to the {directions_of(flat)}'}; give the CRS of the clouds with --crs"
        )
    findings.say_of(
        silent[0],
        "cloud-without-crs",
        f"the point cloud states no CRS{unread}; using {crs_name(flat)} of the footprints",
    )
    return PlanCrs(flat, _with_unit(silent[0], flat, metric, findings))


def _assume_degrees(
    group: CloudGroup, wish: tuple[pyproj.CRS, MetricCrs] | None, asked: Config, findings: Findings
) -> PlanCrs:
    """Take coordinates that look like degrees for those of WGS 84, where they may be reprojected."""
    wgs84 = pyproj.CRS("EPSG:4326")
    states = f"{group.state} {'no CRS' if group.stated is None else crs_name(group.stated)}"
    if asked.reproject:
        findings.say_of(
            group,
            "cloud-without-crs",
            f"{group.label} {states}, and the coordinates look like degrees; taken as EPSG:4326 (WGS 84)",
        )
        return PlanCrs(wgs84, MetricCrs(wgs84, (0, 1.0), (1, 1.0)), degrees=True)
    target = utm_crs(group.box, wgs84) if wish is None else crs_name(wish[1].crs)
    raise InputError(
        f"{group.first.path}: {states}, and its coordinates, {box_words(group.box)}, look like degrees, where "
        f"cells need metres; give --reproject{f' --crs {target}' if target else ''} if they are WGS 84, or "
        f"reproject it: {pdal_command(group.first.path, wgs84, target)}"
    )


def choose_height_unit(group: CloudGroup, plan: PlanCrs, asked: Config, findings: Findings) -> float:
    """Metres of a unit of height: asked for, stated, or that of plan."""
    stated, text = group.first.height_unit, ""
    if asked.height_unit:
        unit = UNITS[asked.height_unit]
        if stated is not None and not same_unit(stated, unit):
            text = f"states heights in {unit_name(stated)}; taken in {unit_name(unit)} by --height-unit"
    elif stated is not None:
        unit = stated
    elif asked.crs and (by_crs := height_unit_of(parse_crs(asked.crs))) is not None:
        unit = by_crs
    else:
        unit = 1.0 if plan.degrees else abs(plan.metric.east[1])
        if unit != 1.0:
            text = f"no record states the unit of heights; taken in {unit_name(unit)} as plan is, "
            text += "--height-unit m says otherwise"
    if text:
        findings.say_of(group, "cloud-height-unit", f"{group.label}: {text}")
    if unit != 1.0:
        text = f"{group.label}: heights in {unit_name(unit)} converted to metres"
        findings.say_of(group, "cloud-height-converted", text)
    return unit


def metric_box(group: CloudGroup, metric: MetricCrs) -> Box:
    return box_to_region(Frame(metric.east, metric.north), group.box)


def group_box(group: CloudGroup, plan: PlanCrs) -> Box:
    """Give the box of a group in its metric CRS, or in degrees."""
    return group.box if plan.degrees else metric_box(group, plan.metric)
