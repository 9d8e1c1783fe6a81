"""Rows of city models as plain arrays of a store, and those of a box found again."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs
from tiler.cityinput.model_blocks import ROW_CELL
from tiler.cityinput.rows import ModelRows, join_rows
from tiler.pointclouds.cells import boxes_of_cells, order_by_cell
from tiler.vectors.wkb import cut_blobs, join_blobs

Arrays = dict[str, NDArray[Any]]
Ranges = list[tuple[int, int]]
# Reads ranges of rows of some arrays, put one after the other.
ReadRanges = Callable[[Sequence[str], Ranges], Arrays]

OF_ROW = ("model_wkb_end", "model_id_end", "model_end", "model_height", "model_lod", "model_base")
OF_SURFACE = ("surface_wkb_end", "surface_plane", "surface_origin", "surface_limits")
OF_CELL = ("model_cell_box", "model_cell_start")


class RowPacker:
    """Writes blocks of rows one after the other, with ends that count through all of them."""

    def __init__(self) -> None:
        self.n_rows = self.n_surfaces = 0
        self._bytes = {"model_wkb": 0, "model_id": 0, "surface_wkb": 0}

    def pack(self, rows: ModelRows) -> Arrays:
        """Give the arrays that a block of sorted rows appends."""
        arrays: Arrays = {
            "model_end": self.n_surfaces + rows.start[1:],
            "model_height": rows.given_height,
            "model_lod": rows.lod,
            "model_base": rows.base,
            "surface_plane": rows.roofs.plane,
            "surface_origin": rows.roofs.origin,
            "surface_limits": rows.roofs.limits,
        }
        blobs = {
            "model_wkb": shapely.to_wkb(rows.outlines, byte_order=1, output_dimension=2),
            "model_id": [name.encode() for name in rows.ids.tolist()],
            "surface_wkb": shapely.to_wkb(rows.surfaces, byte_order=1, output_dimension=2),
        }
        for name, some in blobs.items():
            arrays[name], start = join_blobs(some)
            arrays[f"{name}_end"] = self._bytes[name] + start[1:]
            self._bytes[name] += int(start[-1])
        box = shapely.bounds(rows.outlines).reshape(-1, 4)
        start = order_by_cell((box[:, :2] + box[:, 2:]) / 2, ROW_CELL).start
        arrays["model_cell_box"] = boxes_of_cells(box, start)
        arrays["model_cell_start"] = start[:-1] + self.n_rows
        self.n_rows += len(rows)
        self.n_surfaces += len(rows.surfaces)
        return arrays


def unpack_rows(read: ReadRanges, ranges: Ranges) -> ModelRows:
    """Read ranges of rows, range by range."""
    return join_rows([_unpack(read, first, last) for first, last in ranges])


def _unpack(read: ReadRanges, first: int, last: int) -> ModelRows:
    before = max(first - 1, 0)
    rows = read(OF_ROW, [(before, last)])
    ends = {name: _from(values, first) for name, values in rows.items() if name.endswith("_end")}
    own = first - before
    low, high = int(ends["model_end"][0]), int(ends["model_end"][-1])
    surfaces: Arrays = {}
    if high > low:
        surfaces = read(OF_SURFACE, [(max(low - 1, 0), high)])
    skip = low - max(low - 1, 0)
    wkb_end = _from(surfaces["surface_wkb_end"], low) if surfaces else np.zeros(1, np.int64)
    roofs = Roofs(
        *(
            surfaces[f"surface_{name}"][skip:] if surfaces else np.empty((0, width))
            for name, width in (("plane", 3), ("origin", 2), ("limits", 2))
        )
    )
    return ModelRows(
        shapely.from_wkb(_blobs(read, "model_wkb", ends["model_wkb_end"])).astype(object),
        np.array([name.decode() for name in _blobs(read, "model_id", ends["model_id_end"])], np.str_),
        rows["model_height"][own:],
        rows["model_lod"][own:],
        rows["model_base"][own:],
        ends["model_end"] - low,
        shapely.from_wkb(_blobs(read, "surface_wkb", wkb_end)).astype(object),
        roofs,
    )


def _from(ends: NDArray[np.int64], first: int) -> NDArray[np.int64]:
    """Where rows begin and end, of ends that begin one row before, or with the first of all."""
    return ends if first else np.append(0, ends)


def _blobs(read: ReadRanges, name: str, ends: NDArray[np.int64]) -> NDArray[np.object_]:
    first, last = int(ends[0]), int(ends[-1])
    data = read((name,), [(first, last)])[name] if last > first else np.empty(0, np.uint8)
    return cut_blobs(data, ends)
