"""Footprints read once, in rows sorted by place, and those of a box found again (step 1.2)."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roof_forms import no_forms
from tiler.footprints.building_parts import find_building_parts
from tiler.footprints.footprint_source import FootprintSource, count_notes_of, make_footprints
from tiler.footprints.repeated_ids import find_repeated_ids
from tiler.pointclouds.cells import boxes_of_cells, meets_box, order_by_cell
from tiler.vectors.features import Box, Features
from tiler.vectors.layers import BATCH, scan_layer
from tiler.vectors.wkb import cut_blobs, join_blobs

# Side of the cells that footprints are sorted by (m).
FOOTPRINT_CELL = 1000.0


@dataclass(frozen=True, eq=False)
class FootprintRows:
    """Footprints as plain arrays, for a store."""

    wkb: NDArray[np.uint8]  # (k,): well-known binary of all polygons, one behind the other
    # (n + 1,): Polygon r is ``wkb[wkb_start[r] - wkb_start[0]:wkb_start[r + 1] - wkb_start[0]]``: a range of rows
    # may keep the numbers that it has in the whole
    wkb_start: NDArray[np.int64]
    ids: NDArray[np.str_]
    given_height: NDArray[np.float64]  # (n,): height above ground (m), NaN where there is none
    forms: NDArray[np.float64]  # (n, 6): what attributes say of their roofs, by the columns of `roof_forms`
    box: NDArray[np.float64]  # (n, 4): xmin, ymin, xmax, ymax of each polygon in the region's CRS (m)

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class FootprintBlock:
    """Footprints of a part of a file."""

    rows: FootprintRows  # sorted by the cell of the box's centre (j, then i), then by id
    cell: NDArray[np.int64]  # (c, 2): cells (i, j) of the grid of `FOOTPRINT_CELL` that have rows, in that order
    start: NDArray[np.int64]  # (c + 1,): the footprints of cell k are the rows ``start[k]`` to ``start[k + 1]``
    cell_box: NDArray[np.float64]  # (c, 4): the box around the boxes of each cell's footprints (m)
    # What was converted, left out, assumed or renamed; they add up over the blocks of a file. One a footprint for
    # what `outline_all` tells, ``footprint-not-finite``, ``footprint-id-missing``, ``footprint-id-repeated``,
    # ``footprint-height-missing`` and ``footprint-roof-unread``; one a file for what `count_notes_of` counts,
    # ``footprints-without-crs``, ``footprints-reprojected``, ``footprints-outside`` and
    # ``footprints-reader-warning``.
    notes: tuple[Note, ...]


def scan_footprints(source: FootprintSource, *, batch: int = BATCH) -> Iterator[FootprintBlock]:
    """Read the footprints of a source that meet its region, once and by batches (step 1.2).

    Gives a block for each `batch` of features in memory, at least one a file. InputError if the file is damaged.

    Notes
    -----
    A file with a spatial index is read by query, another from end to end. The ids are read once more before
    that, see `find_repeated_ids`: an id is the same whatever box is asked for. So are parts of buildings of OSM
    data, see `find_building_parts`.
    """
    layer, height = source.layer, source.height_name
    repeated = find_repeated_ids(layer, source.id_name, batch=batch)
    parts = find_building_parts(layer, source.frame, source.bounds, height_name=height, batch=batch)
    n_found, notes, warned = 0, [*layer.notes, *source.notes], set[str]()
    counts: Counter[str] = Counter()
    for features in scan_layer(layer, source.columns, source.box, batch=batch):
        footprints, found = make_footprints(source, features, repeated, counts, parts)
        notes += [*_warnings(source, features, warned), *found]
        n_found += len(footprints.ids)
        if len(footprints.ids) or notes:
            yield block_footprints(footprints, notes)
        notes = []
    notes += count_notes_of(source, counts)
    if n_found == 0:
        notes += _outside(source)
    if n_found == 0 or notes:
        yield no_footprints(notes)


def join_footprints(parts: Sequence[FootprintRows], box: Box) -> Footprints:
    """Join rows of any blocks, and keep the footprints that meet a box (m); its borders belong to it.

    By ascending id, those of one id by their geometry as stored, then by height and form: the same whatever
    the order of the parts and of their rows.
    """
    blobs, ids, heights, roofs = [], [np.empty(0, np.str_)], [np.empty(0)], [no_forms(0)]
    for part in parts:
        near = np.flatnonzero(meets_box(part.box, box))
        blobs += cut_blobs(part.wkb, part.wkb_start)[near].tolist()
        ids.append(part.ids[near])
        heights.append(part.given_height[near])
        roofs.append(part.forms[near])
    names, given, forms = np.concatenate(ids), np.concatenate(heights), np.concatenate(roofs)
    keys = list(zip(names.tolist(), blobs, map(str, given.tolist()), map(str, forms.tolist()), strict=True))
    order = np.array(sorted(range(len(keys)), key=keys.__getitem__), np.int64)
    geometry = shapely.from_wkb([blobs[row] for row in order], on_invalid="fix").astype(np.object_)
    kept = shapely.intersects(geometry, shapely.box(*box))
    return Footprints(geometry[kept], names[order[kept]], given[order[kept]], forms[order[kept]])


def block_footprints(footprints: Footprints, notes: Sequence[Note]) -> FootprintBlock:
    """Put footprints into blocks of rows sorted by place, with some notes."""
    box = shapely.bounds(footprints.polygons).reshape(-1, 4)
    by_id = np.argsort(footprints.ids, kind="stable")
    cells = order_by_cell((box[by_id, :2] + box[by_id, 2:]) / 2, FOOTPRINT_CELL)
    order = by_id[cells.order]
    rows = FootprintRows(
        *join_blobs(shapely.to_wkb(footprints.polygons[order], output_dimension=2, byte_order=1)),
        footprints.ids[order],
        footprints.given_height[order],
        footprints.forms[order],
        box[order],
    )
    return FootprintBlock(rows, cells.cell, cells.start, boxes_of_cells(rows.box, cells.start), tuple(notes))


def no_footprints(notes: Sequence[Note] = ()) -> FootprintBlock:
    """Give a block of notes alone."""
    return block_footprints(Footprints(np.empty(0, np.object_), np.empty(0, np.str_), np.empty(0)), notes)


def _warnings(source: FootprintSource, features: Features, warned: set[str]) -> list[Note]:
    new = [text for text in features.warned if text not in warned]
    warned.update(new)
    return [Note("footprints-reader-warning", source.layer.path.name, detail=text) for text in new]


def _outside(source: FootprintSource) -> list[Note]:
    layer = source.layer
    if layer.n_features == 0:
        return []
    extent = "unknown" if layer.extent is None else ", ".join(f"{value:.10g}" for value in layer.extent)
    detail = f"none meets the region; extent of the file: {extent}"
    return [Note("footprints-outside", layer.path.name, detail=detail)]
