"""Uploaded footprints: the features of a vector file, in the region's CRS, as an edit keeps them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints
from pipeline.data.errors import InputError
from pipeline.data.roofs import take_roofs
from tiler.cityinput.faces import ModelBuilding
from tiler.cityinput.rows import ModelRows, make_rows, take_rows
from tiler.cityinput.sources import frame_of, read_model_header, scan_model
from tiler.config.config import Config
from tiler.editing.glb_uploads import MAGIC, read_glb
from tiler.footprints.footprint_index import FootprintRows, join_footprints, scan_footprints
from tiler.footprints.footprint_source import open_source
from tiler.georeference.crs import parse_crs, same_crs
from tiler.georeference.frame import Frame
from tiler.objects.places import is_missing
from tiler.store.edit_journal import Box, Outline, Surface
from tiler.vectors.layers import describe_layer

# Notes that say that a feature is not what it should be: of a file of a city it is left out, an edit is refused.
REFUSED = {
    *("footprint-unreadable", "footprint-not-finite", "footprint-not-polygon", "footprint-too-many-vertices"),
    *("footprint-height-missing", "footprint-roof-unread", "model-fault", "model-without-place"),
}
SAMPLES = 64  # along each side of the box of a building, where the heights of its roof are averaged
EAST_NORTH = Frame((0, 1.0), (1, 1.0))
HEIGHT = "height"  # attribute of heights above ground (m), where the run was told of none
HEAD = 2**20  # bytes of a file within which it says that it is CityJSON


@dataclass(frozen=True)
class Upload:
    """A file that is uploaded; of GLB also where its origin lies, see `read_glb`."""

    path: Path
    position: Sequence[float] | None = None


@dataclass(frozen=True, eq=False)
class Uploaded:
    """What an uploaded file has, by id: footprints, and of a city model the roof surfaces of each, else None."""

    footprints: Footprints
    models: ModelRows | None = None

    def with_ids(self, name: str) -> "Uploaded":
        """Give all footprints the id of a building."""
        n = len(self.footprints.ids)
        return replace(self, footprints=replace(self.footprints, ids=np.full(n, name)))


def read_upload(upload: Upload, config: Config, *, crs: str, bounds: Box) -> Uploaded:
    """Read the footprints of an uploaded file.

    Parameters
    ----------
    upload : Upload
        Any vector file that `citystitch run` takes as footprints; ids, heights and roofs from the same attributes.
        Or CityJSON, or a sequence of it, or one building as GLB: outlines and roof surfaces.
    config : Config
        Parameters of the run that is edited.
    crs : str
        CRS of its region, to which footprints in another one are reprojected.
    bounds : tuple of 4 floats
        Its region (m).

    Returns
    -------
    Uploaded
        One or more footprints. Those of models have mean heights of roofs above the lowest place of each, which
        count where roofs are flat.

    Raises
    ------
    InputError
        If the file cannot be read, or a feature is no valid polygon or lies outside the region.
    """
    found = _read(upload, config, crs, bounds)
    without = found.footprints.ids[np.isnan(found.footprints.given_height)].tolist()
    if config.buildings and without:  # the points are those of the model's own roofs
        raise InputError(f"{upload.path}: {without[0]} has no height; give it one, in the attribute {HEIGHT}")
    return found


def _read(upload: Upload, config: Config, crs: str, bounds: Box) -> Uploaded:
    path, position = upload.path, upload.position
    if is_missing(path):
        raise InputError(f"{path}: no such file; check the path of the upload")
    start = _read_start(path)
    if start.startswith(MAGIC):
        return _take_models(path, [read_glb(path, position)], EAST_NORTH, bounds)
    if position is not None:
        raise InputError(f"{path}: is no GLB file, and other files say where they stand; leave the position out")
    if start.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] == b"{" and b'"CityJSON' in start:
        return _read_model(path, crs, bounds)
    layer = describe_layer(path)
    # An upload may say less than the file of the city: what has no height takes that of the points.
    heights = config.height_attribute or HEIGHT
    names = {name: name if name in layer.fields else "" for name in (heights, config.id_attribute)}
    source = open_source(
        path,
        crs=pyproj.CRS.from_user_input(crs),
        bounds=bounds,
        id_attribute=names[config.id_attribute],
        height_attribute=names[heights],
        roof_attribute=config.roof_attribute if config.roof_attribute in layer.fields else "",
    )
    found = list(scan_footprints(source))
    for note in (note for block in found for note in block.notes):
        if note.kind in REFUSED:
            raise InputError(f"{path}: {note.subject} {note.detail} ({note.kind}); mend the file")
    rows: Sequence[FootprintRows] = [block.rows for block in found]
    n = sum(map(len, rows))
    if n == 0 or (layer.n_features >= 0 and n < layer.n_features):
        raise InputError(
            f"{path}: {n} of {layer.n_features} features meet the region "
            f"({', '.join(f'{value:.10g}' for value in bounds)}, {crs}); check their place and CRS"
        )
    return Uploaded(_check(path, join_footprints(rows, bounds), bounds))


def _read_start(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(HEAD)
    except OSError:  # a folder, say: the reader of vector files tells
        return b""


def _read_model(path: Path, crs: str, bounds: Box) -> Uploaded:
    """Read the buildings of CityJSON; one without a CRS is in that of the region."""
    header = read_model_header(path)
    is_other = header.crs is not None and not same_crs(header.crs, parse_crs(crs))
    buildings = [one for one in scan_model(path) if isinstance(one, ModelBuilding)]
    return _take_models(path, buildings, frame_of(header, crs if is_other else ""), bounds)


def _take_models(path: Path, buildings: Sequence[ModelBuilding], frame: Frame, bounds: Box) -> Uploaded:
    rows, notes = make_rows(buildings, frame, "auto", Counter())
    for note in notes:
        if note.kind in REFUSED:
            raise InputError(f"{path}: {note.subject} {note.detail} ({note.kind}); mend the file")
    parts = [shapely.get_parts(outline) for outline in rows.outlines]
    for name, some in zip(rows.ids, parts, strict=True):
        if len(some) != 1:
            raise InputError(f"{path}: {name} stands in {len(some)} places; make a building of each")
    rows = take_rows(rows, np.argsort(rows.ids, kind="stable"))
    polygons = np.array([shapely.force_2d(shapely.get_geometry(one, 0)) for one in rows.outlines], np.object_)
    return Uploaded(_check(path, Footprints(polygons, rows.ids, _mean_tops(rows)), bounds), rows)


def _mean_tops(rows: ModelRows) -> NDArray[np.float64]:
    """Give the mean height of each building's highest surfaces above its lowest place (m).

    Floors below count as little as they are seen from above. Where there is no surface it is the height that an
    attribute gives, NaN without one.
    """
    found = rows.given_height.copy()
    for k in np.flatnonzero(np.diff(rows.start)).tolist():
        own = slice(rows.start[k], rows.start[k + 1])
        xmin, ymin, xmax, ymax = shapely.bounds(rows.outlines[k]).tolist()
        steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
        x, y = (axis.ravel() for axis in np.meshgrid(xmin + steps * (xmax - xmin), ymin + steps * (ymax - ymin)))
        point, surface = shapely.STRtree(rows.surfaces[own]).query(shapely.points(x, y), predicate="intersects")
        roofs = take_roofs(rows.roofs, np.arange(own.start, own.stop)[surface])
        away = np.column_stack((x, y))[point] - roofs.origin
        top = np.full(len(x), -np.inf)
        np.maximum.at(top, point, roofs.plane[:, 2] + (roofs.plane[:, :2] * away).sum(axis=1))
        if np.isfinite(top).any():
            found[k] = top[np.isfinite(top)].mean() - rows.base[k]
    return found


def _check(path: Path, footprints: Footprints, bounds: Box) -> Footprints:
    """Refuse invalid polygons, and none or one beyond the region."""
    inside = int(shapely.intersects(footprints.polygons, shapely.box(*bounds)).sum())
    if inside < max(len(footprints.ids), 1):
        n, box = len(footprints.ids), ", ".join(f"{value:.10g}" for value in bounds)
        raise InputError(f"{path}: {inside} of {n} buildings meet the region ({box}); check their place and CRS")
    for polygon, name in zip(footprints.polygons, footprints.ids, strict=True):
        if not shapely.is_valid(polygon):
            raise InputError(f"{path}: {name}: {shapely.is_valid_reason(polygon)}; mend the polygon")
    return footprints


def as_outlines(uploaded: Uploaded) -> tuple[tuple[Outline, ...], tuple[Box, ...]]:
    """Write footprints as an edit keeps them, and the box of each (m)."""
    footprints, models = uploaded.footprints, uploaded.models
    outlines = tuple(
        Outline(name, blob, _number(height), _form(form), *(_roof_of(models, k) if models is not None else ()))
        for k, (name, blob, height, form) in enumerate(
            zip(
                footprints.ids.tolist(),
                _as_text(footprints.polygons),
                footprints.given_height.tolist(),
                footprints.forms.tolist(),
                strict=True,
            )
        )
    )
    boxes = shapely.bounds(footprints.polygons).reshape(-1, 4).tolist()
    return outlines, tuple((xmin, ymin, xmax, ymax) for xmin, ymin, xmax, ymax in boxes)


def _roof_of(models: ModelRows, row: int) -> tuple[float | None, tuple[Surface, ...]]:
    """Lowest height and roof surfaces of a building."""
    own = slice(models.start[row], models.start[row + 1])
    planes = np.column_stack((models.roofs.plane, models.roofs.origin, models.roofs.limits))[own]
    surfaces = zip(_as_text(models.surfaces[own]), map(tuple, planes.tolist()), strict=True)
    return _number(models.base[row]), tuple(surfaces)


def _as_text(polygons: NDArray[np.object_]) -> list[str]:
    blobs: list[str] = shapely.to_wkb(polygons, hex=True, output_dimension=2, byte_order=1).tolist()
    return blobs


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _form(values: list[float]) -> tuple[float | None, ...]:
    form = tuple(map(_number, values))
    return () if form == (None,) * len(form) else form
