"""A footprint file opened: which attributes, which CRS, and features made footprints (step 1.2)."""

from collections import Counter
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints, make_ids
from pipeline.data.errors import InputError
from pipeline.data.notes import Note
from pipeline.data.roof_forms import ROOF_SHAPES, SHAPE, TO_EAVES
from tiler.footprints.building_parts import BuildingParts, Shares, share_places
from tiler.footprints.footprint_attributes import (
    explain_repeated,
    find_attribute,
    find_id_attribute,
    height_columns,
    id_columns,
    read_heights,
    read_ids,
)
from tiler.footprints.plan_outlines import Finding, outline_all
from tiler.footprints.roof_attributes import RoofAttributes, find_roof_attributes, read_roofs, roof_columns
from tiler.georeference.crs import crs_name, horizontal_crs
from tiler.georeference.footprints import footprint_frame
from tiler.georeference.frame import Frame, box_to_file, shapes_to_region, to_region
from tiler.pointclouds.las_header import COORDINATE_LIMIT
from tiler.vectors.features import Box, Features
from tiler.vectors.layers import Layer, describe_layer
from tiler.vectors.osm_tags import STOREY, OsmTags, is_building, is_part, is_raised

# Kinds of the notes of forms, before the shape: that of each is counted.
GIVEN_FORMS, UNKNOWN_FORMS = "footprint-roof-forms:", "footprint-roof-forms-unknown:"
FORM_SHARE = 0.8  # of a footprint's area that parts must leave to it for its attributes of roofs to hold
MOST_SHAPES = 12  # that a note lists
_NOWHERE = (float("nan"),) * 4


@dataclass(frozen=True, eq=False)
class FootprintSource:
    """How footprints are read from one layer."""

    layer: Layer
    # Attributes with the id, the height above ground and the shape of the roof, ``""`` for none that is asked for.
    id_name: str
    height_name: str
    roof_name: str
    frame: Frame  # how coordinates of the file become those of the region
    bounds: Box  # the region (m), in its own CRS
    box: Box  # the region in the file's CRS
    notes: tuple[Note, ...]  # what was assumed about the CRS

    @property
    def columns(self) -> list[str]:
        """Attributes that `make_footprints` needs."""
        ids = id_columns(self.layer, self.id_name)
        heights = height_columns(self.layer, self.height_name)
        return list(dict.fromkeys([*ids, *heights, *roof_columns(self.layer, self.roof_name)]))


def open_source(
    path: Path,
    *,
    crs: pyproj.CRS,
    bounds: Box,
    layer: str = "",
    id_attribute: str = "",
    height_attribute: str = "",
    roof_attribute: str = "",
    frame: Frame | None = None,
) -> FootprintSource:
    """Decide how footprints are read from a file.

    Parameters
    ----------
    path : Path
        SHP, GPKG, GeoJSON, FlatGeobuf, OSM or GeoParquet.
    crs : pyproj.CRS
        The region's CRS, to which footprints in another are reprojected.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax in the region's CRS (m); the borders belong to the box.
    layer : str
        Name of the layer, ``""`` for the only one.
    id_attribute : str
        Attribute with the building's id; ``""`` for the first of `ID_ATTRIBUTES` that the layer has.
    height_attribute : str
        Attribute with the height above ground (m); ``""`` for none.
    roof_attribute : str
        Attribute with the shape of the roof; ``""`` for ``roof:shape`` and the like, where there is one.
    frame : Frame, optional
        How coordinates of the file become those of the region; by default as the CRSs have it.

    Raises
    ------
    InputError
        If the file cannot be read, or its coordinates do not fit its CRS.
    ConfigError
        If the layer or an attribute does not exist.
    """
    info = describe_layer(path, layer)
    id_name, height_name = find_id_attribute(info, id_attribute), find_attribute(info, height_attribute)
    find_roof_attributes(info, roof_attribute)
    own = horizontal_crs(info.crs)
    check_extent(info.path, info.extent, own or crs)
    if frame is None:
        frame = Frame() if own is None else footprint_frame(own, crs, bounds)[0]
    box = box_to_file(frame, bounds)
    return FootprintSource(
        info, id_name, height_name, roof_attribute, frame, bounds, box, tuple(_crs_notes(info, own, crs, frame))
    )


def make_footprints(
    source: FootprintSource,
    features: Features,
    repeated: Set[str],
    counts: Counter[str],
    parts: BuildingParts | None = None,
) -> tuple[Footprints, list[Note]]:
    """Make footprints of features.

    Parameters
    ----------
    features : Features
        Any of its features, with the attributes that `FootprintSource.columns` names.
    repeated : set of str
        Ids that several different geometries of the file carry: they are completed by the geometry.
    counts : Counter of str
        Numbers of features, by the kind of the note that a file gets for all of them: see `count_notes_of`.
    parts : BuildingParts, optional
        Parts of buildings in and around the region, so that no place has two footprints; by default all overlap.

    Returns
    -------
    Footprints
        Those that meet the region, in the order of the features.
    list of Note
        As a `FootprintBlock` has them.
    """
    tags = source.layer.tags
    wanted = np.ones(len(features.wkb), np.bool_) if tags is None else is_building(tags, features.columns)
    outlines = outline_all(features.wkb, metre=source.layer.metre, curved=features.curved)
    counts["footprints-without-geometry"] += sum(blob is None for blob in features.wkb) - len(features.broken)
    names = read_ids(source.layer, source.id_name, features) if source.id_name else [""] * len(features.wkb)
    notes = [
        Note("footprint-unreadable", names[row], detail=f"feature {features.fids[row]}: {reason}")
        for row, reason in sorted(features.broken.items())
    ]
    geometry, rows = outlines.geometry, outlines.rows
    geometry = shapes_to_region(source.frame, geometry)
    keep = is_finite(geometry)
    wrong = np.flatnonzero(~keep)
    keep[keep] = shapely.intersects(geometry[keep], shapely.box(*source.bounds))
    counts["footprints-not-buildings"] += int((keep & ~wanted[rows]).sum())
    keep &= wanted[rows]
    detail = f"a coordinate is NaN, infinite, or beyond ±{COORDINATE_LIMIT:g} m"
    lost = [Finding("footprint-not-finite", row, detail, _NOWHERE) for row in rows[wrong].tolist()]
    found = [one for one in outlines.findings if _is_near(one, source.box)] + lost
    notes += _tell([one for one in found if wanted[one.row]], source, features, names)
    geometry, rows = geometry[keep], rows[keep]
    height, by_levels, bad = read_heights(source.layer, source.height_name, features)
    if tags is not None and parts is not None:
        shares = share_places(parts, geometry, is_part(tags, features.columns)[rows], height[rows])
        _count_parts(shares, rows, tags, features, counts)
        left = ~shapely.is_empty(shares.geometry)
        geometry, rows, share = shares.geometry[left], rows[left], shares.share[left]
    else:
        share = np.ones(len(rows))
    ids, told = _ids(source, geometry, np.array([names[row] for row in rows], np.str_), repeated)
    notes += told
    counts["footprint-heights-by-levels"] += int(by_levels[rows].sum())
    none = np.array(list(map(bool, bad)), np.bool_)[rows]
    notes += _notes("footprint-height-missing", geometry[none], [bad[row] for row in rows[none]], ids[none])
    roofs = read_roofs(source.layer, source.roof_name, features)
    roofs.forms[by_levels & np.isfinite(roofs.forms[:, SHAPE]), TO_EAVES] = 1.0
    notes += _tell_roofs(roofs, rows, geometry, ids, counts)
    forms = np.where((share < FORM_SHARE)[:, None], np.nan, roofs.forms[rows])
    return Footprints(geometry, ids, height[rows], forms), notes


def count_notes_of(source: FootprintSource, counts: Counter[str]) -> list[Note]:
    """Make one note a file of each kind that `make_footprints` counts."""
    details = {
        "footprints-without-geometry": "{} features have no geometry",
        "footprints-not-buildings": "{} polygons without building=* or building:part=* are left out",
        "footprint-parts": "{} parts of buildings (building:part) are taken one by one",
        "footprint-outlines-of-parts": "{} outlines keep what no part of theirs covers",
        "footprint-outlines-replaced": "{} of these keep nothing: their parts stand for them",
        "footprint-parts-covered": "{} parts lie below higher ones and are left out",
        "footprint-parts-raised": "{} parts begin above the ground (min_height): they are taken down to it",
        "footprint-heights-by-levels": f"{{}} heights are building:levels x {STOREY:g} m",
        "footprint-roofs-by-levels": f"{{}} heights of roofs are roof:levels x {STOREY:g} m",
    }
    name = source.layer.path.name
    notes = [
        Note(kind, name, detail=detail.format(counts[kind]))
        for kind, detail in details.items()
        if counts[kind] > 0
    ]
    for kind in (GIVEN_FORMS, UNKNOWN_FORMS):
        shapes = {key[len(kind) :]: n for key, n in counts.items() if key.startswith(kind) and n > 0}
        named = sorted(shapes, key=lambda shape: (-shapes[shape], shape))
        told = ", ".join(f"{shapes[shape]} {shape}" for shape in named[:MOST_SHAPES])
        rest = sum(shapes[shape] for shape in named[MOST_SHAPES:])
        if named:
            notes.append(Note(kind[:-1], name, detail=told + (f", {rest} others" if rest else "")))
    return notes


def _count_parts(
    shares: Shares, rows: NDArray[np.int64], tags: OsmTags, features: Features, counts: Counter[str]
) -> None:
    """Count parts of buildings, and the outlines and parts that lost something to them."""
    part, raised = is_part(tags, features.columns)[rows], is_raised(tags, features.columns)[rows]
    gone = shapely.is_empty(shares.geometry)
    counts["footprint-parts"] += int((part & ~gone).sum())
    counts["footprint-parts-covered"] += int((part & gone).sum())
    counts["footprint-parts-raised"] += int((part & raised & ~gone).sum())
    counts["footprint-outlines-of-parts"] += int((~part & (shares.share < 1)).sum())
    counts["footprint-outlines-replaced"] += int((~part & gone).sum())


def _tell_roofs(
    roofs: RoofAttributes,
    rows: NDArray[np.int64],
    geometry: NDArray[np.object_],
    ids: NDArray[np.str_],
    counts: Counter[str],
) -> list[Note]:
    """Count the forms of roofs by shape, and tell of each that is said in part only."""
    counts["footprint-roofs-by-levels"] += int(roofs.by_levels[rows].sum())
    shape = roofs.forms[rows, SHAPE]
    counts.update(GIVEN_FORMS + ROOF_SHAPES[int(each)] for each in shape[np.isfinite(shape)].tolist())
    counts.update(UNKNOWN_FORMS + roofs.unknown[row] for row in rows.tolist() if roofs.unknown[row])
    bad = np.array(list(map(bool, roofs.wrong)), np.bool_)[rows]
    return _notes("footprint-roof-unread", geometry[bad], [roofs.wrong[row] for row in rows[bad]], ids[bad])


def _crs_notes(info: Layer, own: pyproj.CRS | None, crs: pyproj.CRS, frame: Frame) -> list[Note]:
    name = info.path.name
    if own is None and not frame.changes_plan:
        return [Note("footprints-without-crs", name, detail=f"taken as {crs_name(crs)}, the region's CRS")]
    if own is None:
        return [Note("footprints-without-crs", name, detail="taken in the CRS and units of the point clouds")]
    if frame.changes_plan:
        return [Note("footprints-reprojected", name, detail=f"from {crs_name(own)} to {crs_name(crs)}")]
    return []


def check_extent(path: Path, extent: Box | None, crs: pyproj.CRS) -> None:
    """Refuse degrees beyond the pole: GeoJSON without a CRS means degrees, whatever its author meant."""
    if crs.is_geographic and extent is not None and max(abs(v) for v in extent) > 360:
        raise InputError(
            f"{path}: states {crs_name(crs)} (degrees), but its coordinates reach "
            f"{max(extent, key=abs):g}; GeoJSON without a CRS means degrees: state the true one, "
            f'ogr2ogr -a_srs EPSG:<code> mended.gpkg "{path}"'
        )


def is_finite(geometry: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Tell the geometries, (n,), whose coordinates are all within `COORDINATE_LIMIT`, and none of them NaN."""
    coordinates, owner = shapely.get_coordinates(geometry, return_index=True)
    finite = np.ones(len(geometry), np.bool_)
    finite[owner[~(np.abs(coordinates) <= COORDINATE_LIMIT).all(axis=1)]] = False
    return finite


def _is_near(finding: Finding, box: Box) -> bool:
    """Whether something was found at a box, or where there is no place."""
    xmin, ymin, xmax, ymax = finding.box
    return not (xmin > box[2] or xmax < box[0] or ymin > box[3] or ymax < box[1])


def _tell(findings: list[Finding], source: FootprintSource, features: Features, names: list[str]) -> list[Note]:
    """Make notes of findings, at the middle of the bounding box in the region's CRS."""
    notes = []
    for finding in findings:
        place = np.add(finding.box[:2], finding.box[2:]) / 2
        if source.frame.changes_plan and np.isfinite(place).all():
            place = to_region(source.frame, place[None])[0]
        detail = f"feature {features.fids[finding.row]}: {finding.detail}"
        notes.append(Note(finding.kind, names[finding.row], float(place[0]), float(place[1]), detail))
    return notes


def _ids(
    source: FootprintSource, geometry: NDArray[np.object_], given: NDArray[np.str_], repeated: Set[str]
) -> tuple[NDArray[np.str_], list[Note]]:
    """Give each footprint its id: its own, completed by its geometry where that is repeated, or the geometry's."""
    missing = given == ""
    again = np.isin(given, sorted(repeated)) & ~missing
    made = np.full(len(given), "", dtype="<U14")
    made[missing | again] = make_ids(geometry[missing | again])
    ids = np.where(missing, made, given)
    ids = np.where(again, np.char.add(np.char.add(given, "-"), made), ids)
    if not source.id_name:
        return ids, []
    notes = _notes(
        "footprint-id-missing", geometry[missing], ["named by its geometry"] * int(missing.sum()), made[missing]
    )
    reasons = [explain_repeated(source.layer, source.id_name, name) for name in given[again].tolist()]
    return ids, notes + _notes("footprint-id-repeated", geometry[again], reasons, ids[again])


def _notes(kind: str, geometry: NDArray[np.object_], details: list[str], subjects: NDArray[np.str_]) -> list[Note]:
    """Make one note a geometry, at the middle of its bounding box."""
    boxes = shapely.bounds(geometry).reshape(-1, 4)
    places = ((boxes[:, :2] + boxes[:, 2:]) / 2).tolist()
    told = zip(subjects.tolist(), places, details, strict=True)
    return [Note(kind, name, x, y, detail) for name, (x, y), detail in told]
