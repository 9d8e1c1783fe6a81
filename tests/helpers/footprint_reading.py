"""Footprints of a file within a box, read as a run reads them."""

from pathlib import Path
from typing import Any

import pyproj

from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from tiler.engine.stage import Box
from tiler.footprints.footprint_index import join_footprints, scan_footprints
from tiler.footprints.footprint_source import open_source
from tiler.georeference.crs import horizontal_crs
from tiler.objects.places import as_place
from tiler.vectors.layers import BATCH, describe_layer


def read_footprint_crs(path: str | Path, layer: str = "") -> pyproj.CRS | None:
    """The CRS that a footprint file states; None if it states none, or one without a place on Earth."""
    crs = describe_layer(as_place(path), layer).crs
    return None if horizontal_crs(crs) is None else crs


def read_footprints(
    path: str | Path, *, crs: pyproj.CRS, bounds: Box, **options: Any
) -> tuple[Footprints, tuple[Note, ...]]:
    """The footprints that meet a box, by ascending id, and all notes."""
    batch = options.pop("batch", BATCH)
    source = open_source(as_place(path), crs=crs, bounds=bounds, **options)
    blocks = list(scan_footprints(source, batch=batch))
    notes = tuple(note for block in blocks for note in block.notes)
    return join_footprints([block.rows for block in blocks], bounds), notes
