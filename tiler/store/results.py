"""Results of a run, read from its store: columns of a tile, terrain of the region."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from pipeline.points_terrain.raster import Dtm, NodeWindow, grow_window, node_window, sample_dtm, window_of
from pipeline.points_terrain.terrain import cut_terrain, join_terrain
from tiler.store.store import Store

COLUMN_ARRAYS = ("xy", "triangles", "building", "z_start", "z", "bottom", "key", "moved")
APPROACH, LEVELLED = "approach", "levelled"


def unpack_columns(arrays: Mapping[str, NDArray[Any]], order: Any) -> tuple[ColumnMesh, NDArray[np.int64]]:
    """Make columns of the arrays of the stage ``columns``.

    Returns
    -------
    ColumnMesh
        The mesh; `PlaneMesh.building` has rows of the second result.
    int64, (b,)
        Numbers of the buildings that the tile meets, ascending.
    """
    numbers, row = np.unique(arrays["building"], return_inverse=True)
    outside = int(len(numbers) > 0 and numbers[0] < 0)
    rows: NDArray[np.int32] = (row.reshape(-1) - outside).astype(np.int32)
    plane = PlaneMesh(arrays["xy"], arrays["triangles"], rows)
    key, moved = (arrays[name] if len(arrays[name]) else None for name in ("key", "moved"))
    mesh = ColumnMesh(plane, arrays["z_start"], arrays["z"], arrays["bottom"], order, key, moved)
    return mesh, numbers[outside:]


class StoredTerrain:
    """The terrain of a run, read from its store where it is asked for; the last window is kept.

    Parameters
    ----------
    path : Path
        Folder of the store.

    Raises
    ------
    InputError
        If it holds no terrain.
    """

    def __init__(self, path: Path) -> None:
        self._store = Store(path)
        # With land cover that with level water, with a pad that of both.
        known = {stage: self._store.names(stage) for stage in (LEVELLED, APPROACH, "terrain")}
        self._stage = next((stage for stage, names in known.items() if names), "terrain")
        self._names = np.array(known[self._stage], np.str_)
        if not len(self._names):
            raise InputError(f"{path}: holds no terrain; run citystitch again")
        self._windows = np.empty((len(self._names), 4), np.int64)  # i0, j0, nx, ny
        for k, name in enumerate(self._names.tolist()):
            facts = self._store.attributes(self._stage, name)["facts"]
            self._windows[k] = [facts[part] for part in ("i0", "j0", "nx", "ny")]
        self._spacing = float(facts["spacing"])
        some = self._windows[(self._windows[:, 2:] > 0).all(axis=1)]
        low, high = some[:, :2].min(axis=0), (some[:, :2] + some[:, 2:]).max(axis=0)
        self._region = NodeWindow(*low.tolist(), *(high - low).tolist())
        self._last: Dtm | None = None

    def sample(self, xy: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Ground height (m) at each place, (n, 2) to (n,).

        Memory is that of the terrain around them; at no place, that around earlier ones is let go.
        """
        if len(xy) == 0:
            self._last = None
            return np.empty(0)
        low, high = xy.min(axis=0), xy.max(axis=0)
        box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        window = grow_window(node_window(box, self._spacing), 0, within=self._region)
        if self._last is None or grow_window(window, 0, within=window_of(self._last)) != window:
            self._last = None  # its memory is free before the next is read
            self._last = self._read(window)
        return sample_dtm(cut_terrain(self._last, window), xy)

    def _read(self, window: NodeWindow) -> Dtm:
        """Read the nodes of a window that tiles have."""
        low, size = self._windows[:, :2], self._windows[:, 2:]
        begin, end = (window.i0, window.j0), (window.i0 + window.nx, window.j0 + window.ny)
        met = ((low < end) & (low + size > begin) & (size > 0)).all(axis=1)
        parts = []
        for k in np.flatnonzero(met).tolist():
            own = NodeWindow(*self._windows[k].tolist())
            common = grow_window(own, 0, within=window)
            rows, columns = common.j0 - own.j0, common.i0 - own.i0
            spans = (rows, rows + common.ny), (columns, columns + common.nx)
            z = self._store.read_window(self._stage, str(self._names[k]), "z", *spans)
            parts.append(Dtm(z, common.i0, common.j0, self._spacing))
        return join_terrain(parts, window)
