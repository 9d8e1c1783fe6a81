"""A city model file read once: rows of buildings and points on their faces, in blocks sorted by place."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.classes import BUILDING, GROUND
from pipeline.data.notes import Note
from pipeline.data.roofs import plane_heights
from tiler.cityinput.citygml import Relief
from tiler.cityinput.face_planes import find_planes
from tiler.cityinput.faces import Faces, ModelBuilding
from tiler.cityinput.rows import ModelRows, make_rows, no_rows, take_rows
from tiler.cityinput.samples import along_outlines, grid_faces, grid_polygons, highest_nodes
from tiler.cityinput.sources import scan_model
from tiler.georeference.frame import Frame, to_region
from tiler.pointclouds.cells import Box, order_by_cell
from tiler.pointclouds.ingest import CELL

BATCH = 1000  # buildings in memory at a time
ROW_CELL = 256.0  # m, side of the cells that buildings are sorted by
STEP = 0.5  # m between points on roofs
GROUND_STEP = 1.0  # m between points of terrain, and along outlines
FOOT_ROOM = 0.25  # m from an outline to the points of the ground around it
AROUND = 100.0  # m; buildings that close count as neighbours ...
FEWEST = 3  # ... and so many of them tell where the ground is, ...
OFF = 15.0  # m, ... from which a foot is told that lies higher or lower than theirs in the median
LONGEST = 5000.0  # m; a building or roof that is longer has wrong coordinates: points on it would fill the memory
UNIT = 0.001  # m of a coordinate

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Wanted:
    """What is read of a city model."""

    lod: str  # level of detail, one of `levels.CHOICES`
    height: str  # attribute with heights above ground, ``""`` for the format's own
    roof_points: bool  # whether to make points on roofs
    # Whether to make points of the ground: of the terrain, and along outlines at the foot of buildings.
    ground_points: bool
    shift: float = 0.0  # added to all heights (m)


@dataclass(frozen=True, eq=False)
class ModelBlock:
    """Some buildings of a file."""

    rows: ModelRows  # sorted by the cell of their box's centre, then by id
    xyz: Array  # (n, 3): points on their roofs and around them (m)
    classification: NDArray[np.uint8]  # (n,): ASPRS class of each point: 6 on roofs, 2 on the ground
    notes: tuple[Note, ...]  # what was not as it should be
    counts: Counter[str]  # numbers by name; they add up over the blocks


def read_model_blocks(path: Path, frame: Frame, bounds: Box, wanted: Wanted) -> Iterator[ModelBlock]:
    """Read the buildings of a file that meet a box in the region's CRS (m), and points on their faces.

    Gives a block for each thousand buildings; at least one. InputError if the file cannot be read.

    Notes
    -----
    Points on roofs are the nodes of a grid of 0.5 m that lies fixed in the CRS; where several surfaces lie over
    each other, those of overlapping buildings included, on the highest, and within the outline alone. Memory is
    that of a thousand buildings.
    """
    batch: list[ModelBuilding] = []
    given, others = False, Counter[str]()
    for each in scan_model(path, wanted.height):
        if isinstance(each, ModelBuilding):
            batch.append(each)
            if len(batch) == BATCH:
                yield _make_block(batch, frame, bounds, wanted)
                batch, given = [], True
        elif isinstance(each, Relief) and wanted.ground_points:
            yield from _make_relief(each.faces, frame, bounds, wanted.shift)
            given = True
        elif isinstance(each, Counter):
            others.update({f"model objects not read, {kind}": n for kind, n in each.items()})
    if batch or others or not given:
        block = _make_block(batch, frame, bounds, wanted)
        block.counts.update(others)
        yield block


def _make_block(batch: Sequence[ModelBuilding], frame: Frame, bounds: Box, wanted: Wanted) -> ModelBlock:
    counts: Counter[str] = Counter()
    rows, notes = make_rows(batch, frame, wanted.lod, counts, wanted.shift)
    length, of_surface = _lengths(rows.outlines), _lengths(rows.surfaces)
    np.maximum.at(length, np.repeat(np.arange(len(rows)), np.diff(rows.start)), of_surface)
    notes += [
        Note("model-fault", str(rows.ids[k]), detail=f"it is {length[k] / 1000:,.0f} km long; left out")
        for k in np.flatnonzero(length > LONGEST).tolist()
    ]
    near = shapely.intersects(rows.outlines, shapely.box(*bounds)) if len(rows) else np.zeros(0, np.bool_)
    counts["model buildings outside the region"] += int((~near).sum())
    kept = np.flatnonzero(near & (length <= LONGEST))
    kept = kept[np.argsort(rows.ids[kept], kind="stable")]
    box = shapely.bounds(rows.outlines[kept]).reshape(-1, 4)
    rows = take_rows(rows, kept[order_by_cell((box[:, :2] + box[:, 2:]) / 2, ROW_CELL).order])
    parts = [np.empty((0, 3))]
    classes = [np.empty(0, np.uint8)]
    if wanted.roof_points:
        parts.append(_sample_roofs(rows))
        classes.append(np.full(len(parts[-1]), BUILDING, np.uint8))
    if wanted.ground_points:
        parts.append(_sample_feet(rows))
        classes.append(np.full(len(parts[-1]), GROUND, np.uint8))
        notes += _note_feet(rows)
    xyz, found = np.concatenate(parts), np.concatenate(classes)
    inside = _within(xyz, bounds)
    near_notes = [note for note in notes if np.isnan(note.x) or _within(np.array([[note.x, note.y]]), bounds)[0]]
    return ModelBlock(rows, xyz[inside], found[inside], tuple(near_notes), counts)


def _lengths(polygons: NDArray[np.object_]) -> Array:
    box = shapely.bounds(polygons).reshape(-1, 4)
    longest: Array = (box[:, 2:] - box[:, :2]).max(axis=1)
    return longest


def _within(xy: Array, bounds: Box) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (xy[:, 0] >= bounds[0]) & (xy[:, 0] <= bounds[2])
    inside &= (xy[:, 1] >= bounds[1]) & (xy[:, 1] <= bounds[3])
    return inside


def _sample_roofs(rows: ModelRows) -> Array:
    """Points on roofs: of surfaces and houses over each other on the highest, within outlines alone."""
    surface, node = grid_polygons(rows.surfaces, STEP)
    owner = np.repeat(np.arange(len(rows)), np.diff(rows.start))[surface]
    xy = np.asarray((node + 0.5) * STEP, np.float64)
    z = plane_heights(rows.roofs, surface, xy)
    top = highest_nodes(owner, node, z, grid_polygons(rows.outlines, STEP))
    return np.column_stack((xy[top], z[top]))


def _sample_feet(rows: ModelRows) -> Array:
    """Points close around outlines at the lowest height of each building."""
    known = np.flatnonzero(np.isfinite(rows.base))
    around = shapely.buffer(rows.outlines[known], FOOT_ROOM, join_style="mitre")
    xy, row = along_outlines(around, GROUND_STEP)
    return np.column_stack((xy, rows.base[known][row]))


def _note_feet(rows: ModelRows) -> list[Note]:
    """Tell of the buildings that float above those around, or are sunk, where feet alone tell the ground."""
    known = np.flatnonzero(np.isfinite(rows.base))
    base, place = rows.base[known], shapely.point_on_surface(rows.outlines[known])
    one, other = shapely.STRtree(place).query(place, predicate="dwithin", distance=AROUND)
    one, other = one[one != other], other[one != other]
    order = np.lexsort((base[other], one))
    count = np.bincount(one, minlength=len(known))
    told = np.flatnonzero(count >= FEWEST)
    foot = base[other[order]][(np.cumsum(count) - count)[told] + (count[told] - 1) // 2]
    far = base[told] - foot
    x, y = shapely.get_x(place[told]), shapely.get_y(place[told])
    return [
        Note(
            "model-off-neighbours",
            str(rows.ids[known[told[k]]]),
            float(x[k]),
            float(y[k]),
            f"its foot is {abs(far[k]):.1f} m {'above' if far[k] > 0 else 'below'} those of the buildings around",
        )
        for k in np.flatnonzero(np.abs(far) > OFF).tolist()
    ]


def _make_relief(faces: Faces, frame: Frame, bounds: Box, shift: float) -> Iterator[ModelBlock]:
    """Points on triangles of the terrain, some of them at a time."""
    xyz = np.column_stack((to_region(frame, faces.xyz[:, :2]), faces.xyz[:, 2] * frame.height + shift))
    placed = Faces(xyz, faces.ring_start, faces.face_start, faces.kind)
    planes = find_planes(placed)
    count = np.diff(faces.face_start)
    for first in range(0, len(faces), 20_000):
        chosen = np.arange(first, min(first + 20_000, len(faces)))
        low, high = faces.face_start[first], faces.face_start[chosen[-1] + 1]
        begin, end = faces.ring_start[low], faces.ring_start[high]
        face, node = grid_faces(
            xyz[begin:end, :2],
            faces.ring_start[low : high + 1] - begin,
            np.concatenate(([0], np.cumsum(count[chosen]))),
            GROUND_STEP,
        )
        xy, own = (node + 0.5) * GROUND_STEP, chosen[face]
        normal = planes.normal[own]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = planes.centre[own, 2] - (normal[:, :2] * (xy - planes.centre[own, :2])).sum(axis=1) / normal[:, 2]
        points = np.column_stack((xy, z))
        points = points[_within(points, bounds) & np.isfinite(z)]
        counts = Counter({"model points of terrain": len(points)})
        yield ModelBlock(no_rows(), points, np.full(len(points), GROUND, np.uint8), (), counts)


def pack_points(block: ModelBlock, origin: tuple[float, float]) -> tuple[Arrays, NDArray[np.int64]]:
    """Write points as the store has those of clouds, in units of a millimetre from an origin.

    Gives ``units``, ``classification``, ``cell``; and where the points of each cell start, int64 (c + 1,).
    """
    cells = order_by_cell(block.xyz, CELL)
    xyz = block.xyz[cells.order] - np.array([*origin, 0.0])
    units = np.round(xyz / UNIT).astype(np.int32)
    return {"units": units, "classification": block.classification[cells.order], "cell": cells.cell}, cells.start
