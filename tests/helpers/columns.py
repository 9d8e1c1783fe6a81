"""Columns of a tile, from the store of a run."""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import ColumnMesh
from tiler.store.results import COLUMN_ARRAYS, unpack_columns
from tiler.store.store import Store


def read_columns(store: Store, tile: str) -> tuple[ColumnMesh, NDArray[np.int64]]:
    """Read the columns of a tile, as `unpack_columns` gives them."""
    arrays, attributes = store.read("columns", tile, names=COLUMN_ARRAYS)
    return unpack_columns(arrays, attributes["facts"]["order"])
