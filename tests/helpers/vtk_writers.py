"""VTK's files of arrays that are in memory."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Boundary, TetMesh
from tiler.mesh_files.vtk_files import Arrays, RowArrays, Rows, Values, write_vtp_blocks, write_vtu_blocks
from tiler.mesh_files.vtk_xml import VTK_TYPES, Stream, stream_items

NO_ARRAYS: Arrays = {}
VERTEX = Values(1, np.dtype(np.int64), np.asarray)  # index of each point


def values_of(array: NDArray[Any]) -> Values:
    """Values of an array (n,) or (n, width)."""
    return Values(array.shape[1] if array.ndim == 2 else 1, array.dtype, lambda index: array[index])


def write_vtu(path: Path, mesh: TetMesh, *, point_data: Arrays = NO_ARRAYS, cell_data: Arrays = NO_ARRAYS) -> None:
    """Write a volume mesh, with further arrays, as a VTU file."""
    write_vtu_blocks(
        path,
        Rows.of(mesh.points),
        Rows.of(mesh.cells),
        point_data=_rows_of(point_data, len(mesh.points)),
        cell_data=_rows_of(cell_data, len(mesh.cells)),
    )


def write_vtp(
    path: Path, points: NDArray[np.float64], boundary: Boundary, *, point_data: Arrays = NO_ARRAYS
) -> None:
    """Write the boundary of a volume mesh as a VTP file, with the points (n, 3) that it uses alone."""
    checked = _checked(point_data, len(points))
    data = {"vertex": VERTEX} | {name: values_of(array) for name, array in checked.items()}
    write_vtp_blocks(path, len(points), boundary, values_of(points), point_data=data)


def make_stream(name: str, array: NDArray[Any], dtype: Any) -> Stream:
    """Make a stream of an array (n,) or (n, components), to be written as `dtype`."""
    flat = np.ascontiguousarray(array).reshape(-1)
    components = array.shape[1] if array.ndim == 2 else 1
    return stream_items(name, np.dtype(dtype), components, flat.size, lambda i, j: flat[i:j])


def _rows_of(arrays: Arrays, n_rows: int) -> RowArrays:
    return {name: Rows.of(array) for name, array in _checked(arrays, n_rows).items()}


def _checked(arrays: Arrays, n_rows: int) -> Arrays:
    for name, array in arrays.items():
        if array.dtype.name not in VTK_TYPES or array.ndim not in (1, 2) or len(array) != n_rows:
            raise ValueError(
                f"array {name!r} is {array.dtype} {array.shape}; expected {n_rows} rows of {list(VTK_TYPES)}"
            )
    return arrays
