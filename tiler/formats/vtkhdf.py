"""VTKHDF: mesh and marked boundary for VTK and ParaView in one HDF5 file, numbers as they are.

Each of the two is one partition: pyvista has no data of several ones.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tiler.export.export import LARGEST_PART, ORIGIN, Format
from tiler.export.pieces import ROWS, Pieces, blocks_of, slices
from tiler.export.surface import place_vertices, survey_surface
from tiler.mesh_files.merged import NO_PLACE, Place
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.run_files import RunSource, crs_of
from tiler.store.atomic import disk_errors, replacing
from tiler.store.run_folder import LEAVES

VERSION = (2, 2)  # of the format that VTK 9.4 reads
ROOT = "VTKHDF"
TETRAHEDRON, TRIANGLE = 10, 5  # numbers of VTK
WIDTHS = {TETRAHEDRON: 4, TRIANGLE: 3}
Runs = list[tuple[int, NDArray[np.float64]]]


def export_vtkhdf(output: Path, source: RunSource) -> None:
    """Write the mesh of a finished run as VTKHDF.

    Parameters
    ----------
    output : Path
        The file; it appears whole or not at all.
    source : Path or RunFiles
        Folder of the run.

    Raises
    ------
    InputError
        If the run is not finished, or a file of it is missing or damaged.
    OutputError
        If the file cannot be written.
    """
    pieces = open_pieces(source)
    crs = crs_of(source)
    with replacing(output) as part, disk_errors(output):
        write_vtkhdf(part, pieces, crs=crs, origin=pieces.files.origin)


def write_vtkhdf(path: Path, pieces: Pieces, *, crs: str, origin: Place = NO_PLACE) -> None:
    """Write a mesh as two data sets, ``mesh`` and ``boundary``.

    Parameters
    ----------
    path : Path
        The file.
    pieces : Pieces
        The mesh.
    crs : str
        CRS of the coordinates, an attribute of the root.
    origin : tuple of float
        Place in it (m) that coordinates count from, likewise if it is not that of the CRS.

    Notes
    -----
    Memory: one piece, and a quarter of a byte a point. Points are in the order of their numbers, cells and facets
    piece by piece. Each piece is read twice.
    """
    survey = survey_surface(pieces)
    with h5py.File(path, "w", libver=("earliest", "v108")) as file:
        root = _open_group(file, ROOT, "MultiBlockDataSet")
        root.attrs["crs"] = crs
        if any(origin):
            root.attrs["origin"] = np.array(origin)
        mesh = _Grid(root, "mesh", n_points=pieces.n_points, kind=TETRAHEDRON)
        boundary = _Grid(root, "boundary", n_points=survey.n_vertices, kind=TRIANGLE)
        for k in range(len(pieces.names)):
            piece = pieces.read(k)
            of_cells: dict[str, NDArray[Any]] = {"tile": np.full(len(piece.cells), k, np.int32)}
            if piece.region is not None:
                of_cells["region"] = piece.region
            if piece.leaves is not None:
                of_cells[LEAVES] = piece.leaves
            runs = [(start, piece.points[rows]) for start, rows in blocks_of(piece.ids)]
            mesh.add(runs, piece.ids[piece.cells], of_cells)
            runs, facets = place_vertices(piece, survey.vertices)
            boundary.add(runs, facets, {"marker": piece.marker, "building": piece.building})
        mesh.close()
        boundary.close()
        assembly = root.create_group("Assembly", track_order=True)
        for name in ("mesh", "boundary"):
            assembly[name] = h5py.SoftLink(f"/{ROOT}/{name}")


def _open_group(parent: h5py.Group, name: str, kind: str) -> h5py.Group:
    group = parent.create_group(name, track_order=True)
    group.attrs["Version"] = np.array(VERSION, np.int64)
    group.attrs.create("Type", kind.encode("ascii"), dtype=h5py.string_dtype("ascii", len(kind)))
    return group


class _Grid:
    """An unstructured grid of one partition, filled piece by piece."""

    def __init__(self, root: h5py.Group, name: str, *, n_points: int, kind: int) -> None:
        self._group = _open_group(root, name, "UnstructuredGrid")
        self._group.attrs["Index"] = np.int64(len(root) - 1)
        self._points = self._group.create_dataset("Points", (n_points, 3), np.float64)
        self._kind, self._width, self._n = kind, WIDTHS[kind], 0

    def add(self, points: Runs, cells: NDArray[np.int64], of_cells: dict[str, NDArray[Any]]) -> None:
        """Add runs of points, each from the place of its first on, and cells (m, k) with their arrays."""
        for start, rows in points:
            self._points[start : start + len(rows)] = rows
        self._append("Connectivity", cells.reshape(-1))
        self._append("Types", np.full(len(cells), self._kind, np.uint8))
        for name, values in of_cells.items():
            self._append(f"CellData/{name}", values)
        self._n += len(cells)

    def close(self) -> None:
        """Write what follows from the number of cells."""
        counts = {"Points": len(self._points), "Cells": self._n, "ConnectivityIds": self._n * self._width}
        for name, count in counts.items():
            self._group[f"NumberOf{name}"] = np.array([count], np.int64)
        offsets = self._group.create_dataset("Offsets", (self._n + 1,), np.int64)
        for rows in slices(self._n + 1):
            offsets[rows] = self._width * np.arange(rows.start, rows.stop)

    def _append(self, name: str, rows: NDArray[Any]) -> None:
        if name not in self._group:
            self._group.create_dataset(name, (0,), rows.dtype, maxshape=(None,), chunks=(ROWS,))
        data = self._group[name]
        start = len(data)
        data.resize(start + len(rows), axis=0)
        if len(rows):
            data[start:] = rows


FORMAT = Format(
    "mesh and marked boundary in one file for VTK 9.4 and later",
    export_vtkhdf,
    options=(LARGEST_PART, ORIGIN),
    suffix=".vtkhdf",
)
