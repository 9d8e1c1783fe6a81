"""Buildings of any input by batches: outlines in the region's CRS with heights above ground."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import islice
from pathlib import Path

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.notes import Note
from tiler.cityinput.faces import ModelBuilding
from tiler.cityinput.rows import make_rows, mean_roofs
from tiler.config.zones import BLOCKS, LOD
from tiler.convert.features import unique_name
from tiler.convert.inputs import open_source
from tiler.footprints.building_parts import mend_polygons
from tiler.footprints.footprint_attributes import find_attribute, find_id_attribute, id_columns, read_ids
from tiler.footprints.footprint_index import scan_footprints
from tiler.footprints.footprint_source import open_source as open_footprints
from tiler.footprints.plan_shapes import find_extent
from tiler.generalisation.options import Asked, Inputs, Landmarks
from tiler.generalisation.shards import DiskSet
from tiler.generalisation.summary import Told
from tiler.georeference.crs import crs_name, horizontal_crs, parse_crs, utm_crs
from tiler.georeference.footprints import footprint_frame
from tiler.georeference.frame import Frame, box_to_region
from tiler.vectors.features import to_objects
from tiler.vectors.layers import Layer, describe_layer, scan_layer
from tiler.vectors.wkb import cut_blobs

BATCH = 2000  # buildings of a model in memory at once
HEIGHTS = ("height", "measuredheight", "h", "hoogte")  # attributes that are taken where none is named

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Buildings:
    """Some buildings, a row each."""

    outlines: NDArray[np.object_]  # (n,): valid polygons and multipolygons (m)
    ids: NDArray[np.object_]  # (n,): text, each once in the region
    height: Array  # (n,): mean height of the roof above ground (m)
    ground: Array  # (n,): absolute height of the ground (m), NaN where unknown
    landmark: NDArray[np.bool_]  # (n,): whether it stays as it is at every level

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> "Buildings":
        """Take some, in the order of the rows."""
        return Buildings(*(getattr(self, one.name)[rows] for one in fields(self)))


def join_buildings(parts: list[Buildings]) -> Buildings:
    """Put buildings one after the other; none gives none."""
    none = Buildings(np.empty(0, object), np.empty(0, object), np.empty(0), np.empty(0), np.empty(0, np.bool_))
    columns = ([getattr(part, one.name) for part in (none, *parts)] for one in fields(none))
    return Buildings(*map(np.concatenate, columns))


@dataclass(frozen=True)
class Source:
    """Buildings that are about to be read: their CRS, metric, and batches of them."""

    crs: pyproj.CRS
    batches: Iterator[Buildings]


@contextmanager
def open_buildings(inputs: Inputs, asked: Asked, told: Told) -> Iterator[Source]:
    """Open the buildings; what is counted while they are read goes to `told`.

    Raises
    ------
    InputError
        If a file cannot be read.
    ConfigError
        If their CRS is unknown or in degrees and none is given, or an attribute does not exist.
    """
    if inputs.footprints is not None:
        crs, batches = _open_footprints(inputs, asked, told)
        yield Source(crs, _finish(batches, inputs, asked, told))
        return
    with open_source(inputs.models, crs=inputs.crs) as source:
        if source.crs is None or source.in_degrees:
            name = "has no CRS" if source.crs is None else f"{crs_name(source.crs)} is in degrees"
            raise ConfigError(f"{inputs.models[0]}: {name}; give --crs EPSG:NNNN, a metric one")
        for note in source.notes:
            told.say(note)
        flat = horizontal_crs(source.crs)
        assert flat is not None
        batches = _scan_models(inputs.models[0], source.buildings(), asked.landmarks, told)
        yield Source(flat, _finish(batches, inputs, asked, told))
        told.counts.update(source.told)


def _scan_models(
    name: Path, buildings: Iterator[ModelBuilding], landmarks: Landmarks, told: Told
) -> Iterator[Buildings]:
    while batch := list(islice(buildings, BATCH)):
        if level := next((own[LOD] for one in batch for own in one.attributes.values() if _is_block(own)), ""):
            raise InputError(
                f"{name}: has blocks of level {level} among its buildings; give what they stand for: the folder "
                "of a run without --generalised, or its input"
            )
        rows, notes = make_rows(batch, Frame(), "auto", Counter())
        _tell(notes, "", told)
        tagged = {one.id for one in batch if _has_tag(one, landmarks.tag)}
        landmark = np.array([name in tagged for name in rows.ids.tolist()], np.bool_)
        yield Buildings(rows.outlines, rows.ids.astype(object), mean_roofs(rows), rows.base, landmark)


def _is_block(attributes: Mapping[str, object]) -> bool:
    return attributes.get(LOD) in BLOCKS


def _tell(notes: Sequence[Note], file: str, told: Told) -> None:
    """Tell notes: of a file what they say, of buildings how many there are of each kind."""
    for note in notes:
        if note.subject == file:
            told.say(f"{file}: {note.detail}")
        else:
            told.notes[note.kind] += 1


def _has_tag(building: ModelBuilding, tag: str) -> bool:
    name, _, wanted = tag.partition("=")
    values = [own.get(name) for own in building.attributes.values()] if name else []
    return any(_is_set(value, wanted) for value in values)


def _open_footprints(inputs: Inputs, asked: Asked, told: Told) -> tuple[pyproj.CRS, Iterator[Buildings]]:
    path = inputs.footprints
    assert path is not None
    layer = describe_layer(path, inputs.layer)
    own = horizontal_crs(layer.crs)
    crs = horizontal_crs(parse_crs(inputs.crs)) if inputs.crs else own
    if crs is None:
        raise ConfigError(f"{path}: states no CRS; give --crs EPSG:NNNN, a metric one")
    extent = find_extent(layer)
    if extent is None:
        raise InputError(f"{path}: has no feature with a place; give another file")
    if crs.is_geographic:
        zone = utm_crs(extent, crs)
        if zone is None or inputs.crs:
            raise ConfigError(f"{path}: {crs_name(crs)} is in degrees; give --crs EPSG:NNNN, a metric one")
        crs = pyproj.CRS(zone)
        told.say(f"{path.name}: in degrees, reprojected to {zone}, its UTM zone")
    if crs.axis_info[0].unit_name != "metre":
        raise ConfigError(f"{path}: {crs_name(crs)} is not in metres; give --crs EPSG:NNNN, a metric one")
    if crs.coordinate_operation and "Pseudo" in crs.coordinate_operation.method_name:
        raise ConfigError(f"{path}: {crs_name(crs)} stretches lengths; give --crs EPSG:NNNN, one of the place")
    bounds = inputs.bounds
    if bounds is None:
        frame = Frame() if own is None or own == crs else footprint_frame(own, crs, extent)[0]
        bounds = box_to_region(frame, extent)
    lower = {field.lower(): field for field in layer.fields}
    height = inputs.height_attribute
    if not height and layer.tags is None:  # of OSM data, levels count where there is no height
        height = next((lower[name] for name in HEIGHTS if name in lower), "")
    tagged = _find_tagged(inputs, layer, asked.landmarks.tag)
    blocks = scan_footprints(
        open_footprints(
            path, crs=crs, bounds=bounds, layer=inputs.layer, id_attribute=inputs.id_attribute,
            height_attribute=height,
        )
    )  # fmt: skip
    if height:
        told.say(f"{path.name}: heights are of attribute {height}")

    def read() -> Iterator[Buildings]:
        for block in blocks:
            _tell(block.notes, path.name, told)
            rows = block.rows
            outlines = shapely.from_wkb(cut_blobs(rows.wkb, rows.wkb_start), on_invalid="fix")
            landmark = np.array([name.split("-g")[0] in tagged for name in rows.ids.tolist()], np.bool_)
            none = np.full(len(rows), np.nan)
            yield Buildings(outlines, rows.ids.astype(object), rows.given_height, none, landmark)

    return crs, read()


def _find_tagged(inputs: Inputs, layer: Layer, tag: str) -> set[str]:
    """List the ids whose attribute is set, or has the value that is asked for."""
    name, _, wanted = tag.partition("=")
    id_name = find_id_attribute(layer, inputs.id_attribute)
    if not name:
        return set()
    if not id_name:
        raise ConfigError(f"{layer.path}: --landmark-tag needs ids; name their attribute by --id-attribute")
    columns = [find_attribute(layer, name), *id_columns(layer, id_name)]
    found = set()
    for features in scan_layer(layer, list(dict.fromkeys(columns)), None, geometry=False):
        values = features.columns[name].tolist()
        names = read_ids(layer, id_name, features)
        found |= {each for each, value in zip(names, values, strict=True) if _is_set(value, wanted)}
    return found


def _is_set(value: object, wanted: str) -> bool:
    missing = value in (None, "", False) or (isinstance(value, float) and math.isnan(value))
    return not missing and wanted in ("", str(value))


def _finish(batches: Iterator[Buildings], inputs: Inputs, asked: Asked, told: Told) -> Iterator[Buildings]:
    """Mend outlines, give missing heights, make ids unique, and tell landmarks."""
    seen = DiskSet()
    for given in batches:
        flat = shapely.force_2d(given.outlines)
        outlines = mend_polygons(flat)
        told.counts["outlines made valid"] += int((~shapely.is_valid(flat)).sum())
        kept = shapely.area(outlines) > 0
        told.counts["buildings without area, left out"] += int((~kept).sum())
        if inputs.bounds is not None:
            inside = shapely.intersects(shapely.point_on_surface(outlines), shapely.box(*inputs.bounds))
            told.counts["buildings whose middle is outside --bounds, left out"] += int((kept & ~inside).sum())
            kept &= inside
        batch = replace(given, outlines=outlines).take(kept)
        unknown = ~(np.isfinite(batch.height) & (batch.height > 0))
        told.counts[f"buildings without a height, taken as {asked.default_height:g} m high"] += int(unknown.sum())
        height = np.where(unknown, asked.default_height, batch.height)
        ids = [unique_name(str(name), seen) for name in batch.ids.tolist()]
        again = int((batch.ids.astype(str) != np.array(ids, np.str_)).sum())
        told.counts["ids that were there before, with a number behind them"] += again
        marks = asked.landmarks
        landmark = batch.landmark | np.array([name in marks.ids for name in ids], np.bool_)
        if marks.height:
            landmark |= height >= marks.height
        if marks.volume:
            landmark |= height * shapely.area(batch.outlines) >= marks.volume
        yield Buildings(batch.outlines, to_objects(ids), height, batch.ground, landmark)
