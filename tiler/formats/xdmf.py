"""XDMF with HDF5: cells and marked facets in two grids on the same points, for FEniCS and ParaView.

The first grid, ``mesh``, has the tetrahedra, the second, ``facets``, the boundary's triangles with ``marker`` and
``building``: what `XDMFFile.read_mesh` and `read_meshtags` of DOLFINx take. With soil, ``mesh`` has ``region``.
"""

from pathlib import Path
from xml.sax.saxutils import escape

import h5py
import numpy as np
from numpy.typing import NDArray

from tiler.export.export import LARGEST_PART, Format
from tiler.export.pieces import Pieces, blocks_of
from tiler.mesh_files.mesh_pieces import MeshPieces, open_pieces
from tiler.mesh_files.run_files import RunSource
from tiler.store.atomic import disk_errors, replacing

DATA = ".h5"  # suffix of the second file
ARRAYS = {
    "points": (np.float64, 3),
    "cells": (np.int64, 4),
    "facets": (np.int64, 3),
    "marker": (np.int32, 1),
    "building": (np.int64, 1),
    "region": (np.int32, 1),
}
HEAD = '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n  <Domain>\n'
TAIL = "  </Domain>\n</Xdmf>\n"


def export_xdmf(output: Path, source: RunSource) -> None:
    """Write the mesh of a finished run as XDMF.

    Parameters
    ----------
    output : Path
        The XML file; the numbers go to the file of the same name with the suffix ``.h5``.
    source : Path or RunFiles
        Folder of the run.

    Raises
    ------
    InputError
        If the run is not finished, or a file of it is missing or damaged.
    OutputError
        If a file cannot be written.

    Notes
    -----
    Memory: one piece. Points are in the order of their numbers, cells and facets piece by piece. Each piece is
    read twice. The XML is written last: without it there is no mesh.
    """
    pieces = open_pieces(source)
    n_cells, n_facets = count_rows(pieces)
    data = output.with_suffix(DATA)
    with replacing(output) as text_part, replacing(data) as data_part:
        with disk_errors(data):
            _write_data(data_part, pieces, n_cells, n_facets)
        tags = ("region",) if pieces.files.depth else ()
        text_part.write_text(_render(data.name, pieces.n_points, n_cells, n_facets, tags))
        # Numbers that do not belong to an old text must not be read with it.
        output.unlink(missing_ok=True)


def count_rows(pieces: Pieces) -> tuple[int, int]:
    """Count cells and facets by reading all pieces once."""
    n_cells = n_facets = 0
    for k in range(len(pieces.names)):
        piece = pieces.read(k)
        n_cells += len(piece.cells)
        n_facets += len(piece.facets)
    return n_cells, n_facets


def _write_data(path: Path, pieces: MeshPieces, n_cells: int, n_facets: int) -> None:
    rows = {
        "points": pieces.n_points,
        "cells": n_cells,
        "facets": n_facets,
        "marker": n_facets,
        "building": n_facets,
    }
    if pieces.files.depth:
        rows["region"] = n_cells
    with h5py.File(path, "w", libver=("earliest", "v108")) as file:
        sets = {
            name: file.create_dataset(name, (rows[name], width) if width > 1 else (rows[name],), dtype)
            for name, (dtype, width) in ARRAYS.items()
            if name in rows
        }
        cell = facet = 0
        for k in range(len(pieces.names)):
            piece = pieces.read(k)
            for start, chosen in blocks_of(piece.ids):
                _put(sets["points"], start, piece.points[chosen])
            _put(sets["cells"], cell, piece.ids[piece.cells])
            if piece.region is not None:
                _put(sets["region"], cell, piece.region)
            cell += len(piece.cells)
            _put(sets["facets"], facet, piece.ids[piece.facets])
            _put(sets["marker"], facet, piece.marker)
            _put(sets["building"], facet, piece.building)
            facet += len(piece.facets)


def _put(data: h5py.Dataset, start: int, rows: NDArray[np.generic]) -> None:
    if len(rows):
        data[start : start + len(rows)] = rows


def _render(data: str, n_points: int, n_cells: int, n_facets: int, tags: tuple[str, ...]) -> str:
    def item(name: str, n: int) -> str:
        dtype, width = ARRAYS[name]
        kind = "Float" if dtype is np.float64 else "Int"
        shape = f"{n} {width}" if width > 1 else f"{n}"
        return (
            f'<DataItem Dimensions="{shape}" NumberType="{kind}" Precision="{np.dtype(dtype).itemsize}" '
            f'Format="HDF">{escape(data)}:/{name}</DataItem>'
        )

    def grid(name: str, topology: str, n: int, rows: str, attributes: tuple[str, ...] = ()) -> str:
        nodes = ARRAYS[rows][1]
        lines = [
            f'    <Grid Name="{name}" GridType="Uniform">',
            f'      <Topology TopologyType="{topology}" NumberOfElements="{n}" NodesPerElement="{nodes}">',
            f"        {item(rows, n)}",
            "      </Topology>",
            '      <Geometry GeometryType="XYZ">',
            f"        {item('points', n_points)}",
            "      </Geometry>",
        ]
        for attribute in attributes:
            lines += [
                f'      <Attribute Name="{attribute}" AttributeType="Scalar" Center="Cell">',
                f"        {item(attribute, n)}",
                "      </Attribute>",
            ]
        return "\n".join([*lines, "    </Grid>", ""])

    cells = grid("mesh", "Tetrahedron", n_cells, "cells", tags)
    return HEAD + cells + grid("facets", "Triangle", n_facets, "facets", ("marker", "building")) + TAIL


FORMAT = Format(
    "mesh and marked facets for FEniCS and ParaView, with a file .h5 beside it",
    export_xdmf,
    options=(LARGEST_PART,),
    suffix=".xdmf",
    companion=".h5",
)
