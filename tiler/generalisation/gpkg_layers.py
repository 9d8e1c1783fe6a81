"""GeoPackage of all levels: a layer of cells, and one for each level."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.formats.gpkg import Column, write_rows
from tiler.generalisation.rows import LEVELS, CellRows, Rows, level_word

CELLS = "cells"
BATCH = 5000  # rows that are written at once
Part = tuple[NDArray[np.object_], dict[str, Column]]


class LayerWriter:
    """Appends rows to layers, some thousand at a time; all layers are there in the end."""

    def __init__(self, path: Path, crs: str) -> None:
        self.path, self.crs = path, crs
        self.waiting: dict[str, list[Part]] = {}
        self.begun: set[str] = set()

    def add(self, cells: CellRows, rows: Mapping[str, Rows]) -> None:
        """Add what a tile has."""
        self._add(CELLS, (shapely.to_wkb(_several(cells.outlines)), _cell_columns(cells)))
        for level in LEVELS:
            self._add(level, (shapely.to_wkb(_several(rows[level].outlines)), level_columns(level, rows[level])))

    def finish(self) -> None:
        """Write what waits."""
        for layer, parts in self.waiting.items():
            if parts:
                self._write(layer)

    def _add(self, layer: str, part: Part) -> None:
        parts = self.waiting.setdefault(layer, [])
        parts.append(part)
        if sum(len(wkb) for wkb, _ in parts) >= BATCH:
            self._write(layer)

    def _write(self, layer: str) -> None:
        parts = self.waiting[layer]
        columns = {
            name: (
                np.concatenate([each[name][0] for _, each in parts]),
                None if parts[0][1][name][1] is None else np.concatenate([each[name][1] for _, each in parts]),
            )
            for name in parts[0][1]
        }
        wkb = np.concatenate([each for each, _ in parts])
        append = layer in self.begun
        if len(wkb) or not append:
            write_rows(self.path, wkb, columns, layer=layer, crs=self.crs, kind="MultiPolygon", append=append)
        self.begun.add(layer)
        self.waiting[layer] = []


def level_columns(level: str, rows: Rows) -> dict[str, Column]:
    """Give the columns of a layer of a level, by name."""
    area = rows.area
    return {
        "id": (rows.id, None),
        "level": (np.full(len(rows), level_word(level), object), None),
        "height": (rows.height, None),
        "parent": (rows.parent, None),
        "cell": (rows.cell, None),
        "members": (rows.members, None),
        "landmark": (rows.landmark, None),
        "area": (area, None),
        "volume": (area * rows.height, None),
        "ground_height": (rows.ground_height, np.isnan(rows.ground_height)),
    }


def _cell_columns(cells: CellRows) -> dict[str, Column]:
    area = shapely.area(cells.outlines)
    share = np.divide(cells.built, cells.free, out=np.zeros(len(area)), where=cells.free > 0)
    return {
        "id": (cells.id, None),
        "landuse": (np.where(cells.use, "Building", "Other").astype(object), None),
        "share": (share, cells.free <= 0),
        "area": (area, None),
        "building_area": (cells.built, None),
        "other_area": (area - cells.free, None),
        "members": (cells.members, None),
        "parent": (cells.parent, None),
    }


def _several(outlines: NDArray[np.object_]) -> NDArray[np.object_]:
    """Make multipolygons of all outlines."""
    parts, owner = shapely.get_parts(outlines, return_index=True)
    found: NDArray[np.object_] = shapely.multipolygons(parts, indices=owner, out=np.empty(len(outlines), object))
    return found
