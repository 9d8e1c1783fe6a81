"""The store: results by stage and tile in zarr (v3), written whole or not at all."""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.mesh import ColumnMesh, PlaneMesh
from pipeline.terrain import Dtm, sample_dtm

CHUNK_BYTES = 4 * 2**20  # about what one read or write moves at a time


class Store:
    """Arrays by stage and tile below one folder.

    Parameters
    ----------
    path : Path
        Folder of the store; made when first written to.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, stage: str, tile: str, arrays: Mapping[str, NDArray[Any]], **attributes: Any) -> None:
        """Write one result; it becomes visible at once and whole."""
        target = self.path / stage / tile
        partial = target.with_name(f".{tile}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        group = zarr.open_group(str(partial), mode="w", zarr_format=3, attributes=attributes)
        for name, values in arrays.items():
            array = np.ascontiguousarray(values)
            row_bytes = max(array.dtype.itemsize * int(np.prod(array.shape[1:])), 1)
            chunks = (min(max(CHUNK_BYTES // row_bytes, 1), max(len(array), 1)), *array.shape[1:])
            group.create_array(name, data=array, chunks=chunks)
        shutil.rmtree(target, ignore_errors=True)
        os.replace(partial, target)

    def read(self, stage: str, tile: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Read one result: its arrays and its attributes.

        Raises
        ------
        InputError
            If it is not there or damaged.
        """
        target = self.path / stage / tile
        try:
            group = zarr.open_group(str(target), mode="r")
            return {name: np.asarray(array[...]) for name, array in group.arrays()}, dict(group.attrs)
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            raise InputError(
                f"{target}: cannot be read ({error}); run citystitch again with --overwrite"
            ) from error

    def tiles(self, stage: str) -> list[str]:
        """List the tiles that have a result of the stage, sorted."""
        folder = self.path / stage
        return sorted(entry.name for entry in folder.iterdir() if entry.name[0] != ".") if folder.is_dir() else []


def write_dtm(store: Store, tile: str, dtm: Dtm) -> None:
    """Store the terrain of a tile."""
    store.write("terrain", tile, {"z": dtm.z}, i0=dtm.i0, j0=dtm.j0, spacing=dtm.spacing)


def read_dtm(store: Store, tile: str) -> Dtm:
    """Read the terrain of a tile."""
    arrays, attributes = store.read("terrain", tile)
    return Dtm(arrays["z"], int(attributes["i0"]), int(attributes["j0"]), float(attributes["spacing"]))


def write_columns(store: Store, tile: str, mesh: ColumnMesh) -> None:
    """Store the columns of a tile."""
    plane = mesh.plane
    arrays: dict[str, NDArray[Any]] = {
        "xy": plane.xy,
        "triangles": plane.triangles,
        "building": plane.building,
        "z_start": mesh.z_start,
        "z": mesh.z,
        "bottom": mesh.bottom,
    }
    store.write("columns", tile, arrays, order=mesh.order)


def read_columns(store: Store, tile: str) -> ColumnMesh:
    """Read the columns of a tile."""
    arrays, attributes = store.read("columns", tile)
    plane = PlaneMesh(arrays["xy"], arrays["triangles"], arrays["building"])
    return ColumnMesh(plane, arrays["z_start"], arrays["z"], arrays["bottom"], attributes["order"])


class StoredTerrain:
    """The terrain of a run, read from its store.

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
        store = Store(path)
        tiles = store.tiles("terrain")
        if len(tiles) != 1:
            raise InputError(f"{path}: terrain of {len(tiles)} tiles, expected one; run citystitch again")
        self._dtm = read_dtm(store, tiles[0])

    def sample(self, xy: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Ground height (m) at each place, (n, 2) to (n,)."""
        return sample_dtm(self._dtm, xy)
