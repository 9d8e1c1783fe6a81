"""Footprints read once, in rows sorted by place, and those of a box found again (step 1.2)."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roof_forms import no_forms
from tiler.footprints.building_parts import find_building_parts
from tiler.footprints.footprint_source import FootprintSource, count_notes_of, make_footprints, open_source
from tiler.footprints.repeated_ids import find_repeated_ids
from tiler.georeference.frame import Frame
from tiler.objects.places import as_place
from tiler.pointclouds.cells import order_by_cell, row_ranges
from tiler.vectors.features import Box, Features
from tiler.vectors.layers import BATCH, scan_layer

# Side of the cells that footprints are sorted by (m).
FOOTPRINT_CELL = 1000.0


@dataclass(frozen=True, eq=False)
class FootprintRows:
    """Footprints as plain arrays, for a store.

    Attributes
    ----------
    wkb : uint8, (k,)
        Well-known binary of all polygons, one behind the other.
    wkb_start : int64, (n + 1,)
        Polygon r is ``wkb[wkb_start[r] - wkb_start[0]:wkb_start[r + 1] - wkb_start[0]]``: a range of rows may
        keep the numbers that it has in the whole.
    ids : str, (n,)
        Building ids.
    given_height : float64, (n,)
        Height above ground (m), NaN where there is none.
    forms : float64, (n, 6)
        What attributes say of their roofs, by the columns of `roof_forms`.
    box : float64, (n, 4)
        xmin, ymin, xmax, ymax of each polygon in the region's CRS (m).
    """

    wkb: NDArray[np.uint8]
    wkb_start: NDArray[np.int64]
    ids: NDArray[np.str_]
    given_height: NDArray[np.float64]
    forms: NDArray[np.float64]
    box: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class FootprintBlock:
    """Footprints of a part of a file.

    Attributes
    ----------
    rows : FootprintRows
        Sorted by the cell of the box's centre (j, then i), then by id.
    cell : int64, (c, 2)
        Cells (i, j) of the grid of `FOOTPRINT_CELL` that have rows, in that order.
    start : int64, (c + 1,)
        The footprints of cell k are the rows ``start[k]`` to ``start[k + 1]``.
    cell_box : float64, (c, 4)
        The box around the boxes of each cell's footprints (m).
    notes : tuple of Note
        What was converted, left out, assumed or renamed; they add up over the blocks of a file. One a footprint
        for what `outline_all` tells, ``footprint-not-finite``, ``footprint-id-missing``,
        ``footprint-id-repeated``, ``footprint-height-missing`` and ``footprint-roof-unread``; one a file for what
        `count_notes_of` counts, ``footprints-without-crs``, ``footprints-reprojected``, ``footprints-outside`` and
        ``footprints-reader-warning``.
    """

    rows: FootprintRows
    cell: NDArray[np.int64]
    start: NDArray[np.int64]
    cell_box: NDArray[np.float64]
    notes: tuple[Note, ...]


def scan_footprints(
    path: str | Path,
    *,
    crs: pyproj.CRS,
    bounds: Box,
    layer: str = "",
    id_attribute: str = "",
    height_attribute: str = "",
    roof_attribute: str = "",
    frame: Frame | None = None,
    batch: int = BATCH,
) -> Iterator[FootprintBlock]:
    """Read the footprints that meet a box, once and by batches (step 1.2).

    Parameters
    ----------
    path, crs, bounds, layer, id_attribute, height_attribute, roof_attribute, frame
        As `open_source` has them.
    batch : int
        Features in memory at once.

    Yields
    ------
    FootprintBlock
        One a batch; at least one a file.

    Raises
    ------
    InputError
        If the file cannot be read, or its coordinates do not fit its CRS.
    ConfigError
        If the layer or an attribute does not exist.

    Notes
    -----
    A file with a spatial index is read by query, another from end to end. The ids are read once more before
    that, see `find_repeated_ids`: an id is the same whatever box is asked for. So are parts of buildings of OSM
    data, see `find_building_parts`.
    """
    source = open_source(
        as_place(path),
        crs=crs,
        bounds=bounds,
        layer=layer,
        id_attribute=id_attribute,
        height_attribute=height_attribute,
        roof_attribute=roof_attribute,
        frame=frame,
    )
    repeated = find_repeated_ids(source.layer, source.id_name, batch=batch)
    parts = find_building_parts(source.layer, source.frame, bounds, height_name=source.height_name, batch=batch)
    n_found, notes, warned = 0, [*source.layer.notes, *source.notes], set[str]()
    counts: Counter[str] = Counter()
    for features in scan_layer(source.layer, source.columns, source.box, batch=batch):
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
        yield block_footprints(Footprints(np.empty(0, np.object_), np.empty(0, np.str_), np.empty(0)), notes)


def select_footprints(cell_box: NDArray[np.float64], start: NDArray[np.int64], box: Box) -> list[tuple[int, int]]:
    """Give the ranges of rows of the cells whose footprints may meet a box.

    Parameters
    ----------
    cell_box : float64, (c, 4)
        Boxes around the footprints of each cell.
    start : int64, (c + 1,)
        First row of each cell, and the number of rows.
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax (m); the borders belong to the box.

    Returns
    -------
    list of (row_start, row_stop)
        Ascending, apart from each other: all that meet the box are in them, and others are too.

    Examples
    --------
    >>> cell_box = np.array([[0.0, 0, 1010, 900], [1005, 0, 2000, 900], [3000, 0, 3100, 50]])
    >>> select_footprints(cell_box, np.array([0, 4, 5, 9]), (1006.0, 10.0, 1007.0, 20.0))
    [(0, 5)]
    """
    return row_ranges(_meets(cell_box, box), start)


def join_footprints(parts: Sequence[FootprintRows], box: Box) -> Footprints:
    """Join rows of any blocks, and keep the footprints that meet a box.

    Parameters
    ----------
    parts : sequence of FootprintRows
        No row twice.
    box : tuple of 4 floats
        xmin, ymin, xmax, ymax (m); the borders belong to the box.

    Returns
    -------
    Footprints
        By ascending id, those of one id by their geometry as stored, then by height and form: the same whatever
        the order of the parts and of their rows.
    """
    blobs, ids, heights, roofs = [], [np.empty(0, np.str_)], [np.empty(0)], [no_forms(0)]
    for part in parts:
        near = np.flatnonzero(_meets(part.box, box))
        stored, start = part.wkb.tobytes(), part.wkb_start - part.wkb_start[0]
        blobs += [stored[start[row] : start[row + 1]] for row in near]
        ids.append(part.ids[near])
        heights.append(part.given_height[near])
        roofs.append(part.forms[near])
    names, given, forms = np.concatenate(ids), np.concatenate(heights), np.concatenate(roofs)
    keys = list(zip(names.tolist(), blobs, map(str, given.tolist()), map(str, forms.tolist()), strict=True))
    order = np.array(sorted(range(len(keys)), key=keys.__getitem__), np.int64)
    geometry = shapely.from_wkb([blobs[row] for row in order], on_invalid="fix").astype(np.object_)
    kept = shapely.intersects(geometry, shapely.box(*box))
    return Footprints(geometry[kept], names[order[kept]], given[order[kept]], forms[order[kept]])


def _meets(boxes: NDArray[np.float64], box: Box) -> NDArray[np.bool_]:
    xmin, ymin, xmax, ymax = boxes.T
    meets: NDArray[np.bool_] = (xmin <= box[2]) & (xmax >= box[0]) & (ymin <= box[3]) & (ymax >= box[1])
    return meets


def block_footprints(footprints: Footprints, notes: Sequence[Note]) -> FootprintBlock:
    """Put footprints into blocks of rows sorted by place, with some notes."""
    box = shapely.bounds(footprints.polygons).reshape(-1, 4)
    by_id = np.argsort(footprints.ids, kind="stable")
    cells = order_by_cell((box[by_id, :2] + box[by_id, 2:]) / 2, FOOTPRINT_CELL)
    order = by_id[cells.order]
    blobs = shapely.to_wkb(footprints.polygons[order], output_dimension=2, byte_order=1)
    length = np.fromiter(map(len, blobs), np.int64, len(blobs))
    rows = FootprintRows(
        np.frombuffer(b"".join(blobs), np.uint8),
        np.concatenate([np.zeros(1, np.int64), np.cumsum(length)]),
        footprints.ids[order],
        footprints.given_height[order],
        footprints.forms[order],
        box[order],
    )
    first = cells.start[:-1]
    low, high = (ufunc.reduceat(rows.box, first) if len(first) else rows.box for ufunc in (np.minimum, np.maximum))
    return FootprintBlock(rows, cells.cell, cells.start, np.hstack((low[:, :2], high[:, 2:])), tuple(notes))


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
