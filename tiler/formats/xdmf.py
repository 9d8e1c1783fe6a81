"""XDMF with HDF5: cells and marked facets in two grids on the same points, for FEniCS and ParaView.

The first grid, ``mesh``, has the tetrahedra, the second, ``facets``, the boundary's triangles with ``marker`` and
``building``: what `XDMFFile.read_mesh` and `read_meshtags` of DOLFINx take. With soil or cells in buildings,
``mesh`` has ``region``. With prisms a third one, ``sides``, has the boundary's quadrilaterals. Cells
of several kinds are one ``Mixed`` topology.
"""

from pathlib import Path
from xml.sax.saxutils import escape

import h5py
import numpy as np
from numpy.typing import NDArray

from tiler.export.export import CELLS, LARGEST_PART, ORIGIN, Format
from tiler.export.pieces import Pieces, blocks_of
from tiler.mesh_files.mesh_pieces import MeshPieces, open_pieces
from tiler.mesh_files.prisms import PrismMesh, read_prisms
from tiler.mesh_files.run_files import RunSource
from tiler.mesh_files.transitions import NO_CORNER
from tiler.store.atomic import disk_errors, replacing
from tiler.store.run_folder import LEAVES

DATA = ".h5"  # suffix of the second file
ARRAYS = {
    "points": (np.float64, 3),
    "cells": (np.int64, 4),
    "facets": (np.int64, 3),
    "marker": (np.int32, 1),
    "building": (np.int64, 1),
    "region": (np.int32, 1),
    LEAVES: (np.float32, 1),
}
HEAD = '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n  <Domain>\n'
TOPOLOGIES = {4: "Tetrahedron", 6: "Wedge"}  # of cells, by their corners
MIXED = np.array([0, 0, 0, 0, 6, 7, 8])  # XDMF's numbers of tetrahedra, pyramids and wedges, by corners
SIDES = "sides"  # quadrilaterals of the boundary
Ints = NDArray[np.int64]
Rows = dict[str, tuple[int, int]]  # rows and columns of each data set
TAIL = "  </Domain>\n</Xdmf>\n"


def export_xdmf(
    output: Path, source: RunSource, *, cells: str | None = None, prism_layers: int | None = None
) -> None:
    """Write the mesh of a finished run as XDMF.

    Parameters
    ----------
    output : Path
        The XML file; the numbers go to the file of the same name with the suffix ``.h5``.
    source : Path or RunFiles
        Folder of the run.
    cells, prism_layers
        See `tiler.mesh_files.prisms.read_prisms`, also for memory; tetrahedra by default.

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
    data = output.with_suffix(DATA)
    with replacing(output) as text_part, replacing(data) as data_part:
        with disk_errors(data):
            if cells is not None:
                mesh = read_prisms(pieces, cells, prism_layers)
                n_cells = len(mesh.cells)
                rows = _write_prisms(data_part, mesh)
            else:
                n_cells, n_facets = count_rows(pieces)
                rows = _write_data(data_part, pieces, n_cells, n_facets)
        text_part.write_text(_render(data.name, rows, n_cells, pieces.files.origin_words))
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


def _write_data(path: Path, pieces: MeshPieces, n_cells: int, n_facets: int) -> Rows:
    """Write the numbers of tetrahedra; returns how many rows and columns each data set has."""
    rows = {
        "points": pieces.n_points,
        "cells": n_cells,
        "facets": n_facets,
        "marker": n_facets,
        "building": n_facets,
    }
    if len(pieces.files.regions) > 1:
        rows["region"] = n_cells
    if pieces.files.leaves:
        rows[LEAVES] = n_cells
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
            if piece.leaves is not None:
                _put(sets[LEAVES], cell, piece.leaves)
            cell += len(piece.cells)
            _put(sets["facets"], facet, piece.ids[piece.facets])
            _put(sets["marker"], facet, piece.marker)
            _put(sets["building"], facet, piece.building)
            facet += len(piece.facets)
    return {name: (n, ARRAYS[name][1]) for name, n in rows.items()}


def _put(data: h5py.Dataset, start: int, rows: NDArray[np.generic]) -> None:
    if len(rows):
        data[start : start + len(rows)] = rows


def _write_prisms(path: Path, mesh: PrismMesh) -> Rows:
    """Write the numbers of prisms and others; returns how many rows and columns each data set has."""
    cells = mesh.cells
    if len(mesh.by_width()) > 1:
        cells = np.column_stack((MIXED[mesh.widths], cells))
        cells = cells[cells != NO_CORNER]
    sets: dict[str, NDArray[np.generic]] = {"points": mesh.points, "cells": cells}
    if mesh.region is not None:
        sets["region"] = mesh.region.astype(np.int32)
    if mesh.leaves is not None:
        sets[LEAVES] = mesh.leaves
    for name, width in (("", 3), ("side_", 4)):
        sets[SIDES if name else "facets"], sets[f"{name}marker"], sets[f"{name}building"] = mesh.facets(width)
    with h5py.File(path, "w", libver=("earliest", "v108")) as file:
        for name, values in sets.items():
            file.create_dataset(name, data=values)
    return {name: (len(values), values[:1].size or 1) for name, values in sets.items()}


def _render(data: str, rows: Rows, n_cells: int, origin: str) -> str:
    def item(name: str) -> str:
        n, width = rows[name]
        dtype = ARRAYS[name.removeprefix("side_")][0] if name != SIDES else np.int64
        kind = "Float" if dtype in (np.float64, np.float32) else "Int"
        shape = f"{n} {width}" if width > 1 else f"{n}"
        return (
            f'<DataItem Dimensions="{shape}" NumberType="{kind}" Precision="{np.dtype(dtype).itemsize}" '
            f'Format="HDF">{escape(data)}:/{name}</DataItem>'
        )

    def grid(name: str, topology: str, cells: str, attributes: dict[str, str]) -> str:
        n, nodes = rows[cells]
        size = (
            f'NumberOfElements="{n}" NodesPerElement="{nodes}"' if nodes > 1 else f'NumberOfElements="{n_cells}"'
        )
        lines = [
            f'    <Grid Name="{name}" GridType="Uniform">',
            '      <Time Value="0"/>',  # PyVista reads no file without
            f'      <Topology TopologyType="{topology}" {size}>',
            f"        {item(cells)}",
            "      </Topology>",
            '      <Geometry GeometryType="XYZ">',
            f"        {item('points')}",
            "      </Geometry>",
        ]
        for attribute, values in attributes.items():
            lines += [
                f'      <Attribute Name="{attribute}" AttributeType="Scalar" Center="Cell">',
                f"        {item(values)}",
                "      </Attribute>",
            ]
        return "\n".join([*lines, "    </Grid>", ""])

    tags = {name: name for name in ("region", LEAVES) if name in rows}
    grids = [grid("mesh", TOPOLOGIES.get(rows["cells"][1], "Mixed"), "cells", tags)]
    grids.append(grid("facets", "Triangle", "facets", {"marker": "marker", "building": "building"}))
    if SIDES in rows:
        names = {"marker": "side_marker", "building": "side_building"}
        grids.append(grid(SIDES, "Quadrilateral", SIDES, names))
    place = [f'    <Information Name="origin" Value="{origin}"/>\n'] if origin else []
    return HEAD + "".join([*place, *grids]) + TAIL


def read_xdmf(path: Path) -> tuple[NDArray[np.float64], list[tuple[int, Ints]]]:
    """Read the points of an exported mesh, and its cells by number of corners; errors of h5py."""
    with h5py.File(path.with_suffix(DATA)) as file:
        points, cells = file["points"][:], file["cells"][:]
    if cells.ndim == 2:
        return points, [(cells.shape[1], cells)]
    width = {kind: int(n) for n, kind in enumerate(MIXED) if kind}
    start, end = {n: list[int]() for n in width.values()}, 0
    kinds = cells.tolist()
    while end < len(kinds):
        n = width[kinds[end]]
        start[n].append(end + 1)
        end += n + 1
    return points, [(n, cells[np.array(first, np.int64)[:, None] + np.arange(n)]) for n, first in start.items()]


FORMAT = Format(
    "mesh and marked facets for FEniCS and ParaView, with a file .h5 beside it",
    export_xdmf,
    options=(*CELLS, LARGEST_PART, ORIGIN),
    suffix=".xdmf",
    companion=".h5",
)
