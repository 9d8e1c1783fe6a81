"""VTK's XML: the volume mesh as one file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.export.export import CELLS, LARGEST_PART, ORIGIN, WORKERS, Format
from tiler.mesh_files.merged import TILE, write_merged_volume
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.prisms import PrismMesh, read_prisms
from tiler.mesh_files.run_files import RunFiles
from tiler.mesh_files.transitions import NO_CORNER
from tiler.mesh_files.vtk_files import stream_offsets
from tiler.mesh_files.vtk_xml import Stream, stream_items, write_data_file
from tiler.store.run_folder import LEAVES, REGION

# VTK's numbers of tetrahedra, pyramids and wedges, by corners: its measures of volume are positive in our order.
TYPES = np.array([0, 0, 0, 0, 10, 14, 13], np.uint8)


def export_vtu(
    path: Path,
    files: RunFiles,
    *,
    cells: str | None = None,
    prism_layers: int | None = None,
    scalars: bool = False,
    workers: int = 0,
) -> None:
    """Write the volume of a finished run, as `tiler.mesh_files.merged.write_merged_volume` does, or as prisms."""
    if cells is not None:
        write_prisms(path, read_prisms(open_pieces(files), cells, prism_layers), scalars=scalars, threads=workers)
    else:
        write_merged_volume(path, files.volumes, scalars=scalars, origin=files.origin, threads=workers)


def write_prisms(path: Path, mesh: PrismMesh, *, scalars: bool = False, threads: int = 0) -> None:
    """Write prisms as VTK's wedges, with other cells; `scalars` adds the cell array of tiles."""
    n, width = len(mesh.cells), mesh.widths
    corners = mesh.cells[mesh.cells != NO_CORNER]
    offsets = stream_offsets(n, 6)
    if len(corners) < 6 * n:
        offsets = _stream("offsets", np.cumsum(width), np.dtype(np.int32 if len(corners) < 2**31 else np.int64))
    number = np.dtype(np.int32 if len(mesh.points) < 2**31 else np.int64)
    tiles = [_stream(TILE, mesh.tile, mesh.tile.dtype)] if scalars else []
    tiles += [_stream(LEAVES, mesh.leaves, mesh.leaves.dtype)] if mesh.leaves is not None else []
    tiles += [_stream(REGION, mesh.region, mesh.region.dtype)] if mesh.region is not None else []
    sections = {
        "Points": [_stream("Points", mesh.points, mesh.points.dtype, components=3)],
        "Cells": [
            _stream("connectivity", corners, number),
            offsets,
            _stream("types", TYPES[width], TYPES.dtype),
        ],
        "PointData": [],
        "CellData": tiles,
    }
    counts = {"NumberOfPoints": len(mesh.points), "NumberOfCells": n}
    write_data_file(path, "UnstructuredGrid", counts, sections, threads=threads)


def _stream(name: str, values: NDArray[Any], dtype: np.dtype[Any], *, components: int = 1) -> Stream:
    flat = values.reshape(-1)
    return stream_items(name, dtype, components, len(flat), lambda i, j: flat[i:j])


FORMAT = Format(
    "the volume mesh as one VTK file",
    export_vtu,
    options=("scalars", *CELLS, LARGEST_PART, ORIGIN, WORKERS),
)
