"""Rasters of terrain: what GeoTIFF, COG and VRT files say of themselves, and their cells as ground points."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.cityinput.sources import TERRAIN
from tiler.georeference.crs import crs_or_none
from tiler.georeference.frame import Frame, box_to_file, box_to_region, to_region
from tiler.pointclouds.cells import Box, order_by_cell
from tiler.pointclouds.clouds import CloudHeader
from tiler.pointclouds.ingest import CELL

MOST_CELL = 50.0  # m; side of the largest cells that are taken
HEIGHT_UNIT = 2.0**-13  # m
HIGHEST = 10_000.0  # m, either way: other values are none of the ground
ROWS = 512  # of cells read at a time
REACH = 2.0 * MOST_CELL  # m around a node within which its cells lie


@dataclass(frozen=True)
class Lattice:
    """Where the cells of a raster lie."""

    # Middle of the first cell of the southernmost row (m).
    x: float
    y: float
    # Size of a cell (m).
    dx: float
    dy: float
    # Columns and rows.
    nx: int
    ny: int


@dataclass(frozen=True, eq=False)
class RasterBlock:
    """Cells with a height of some rows of a raster, sorted by the cells of points."""

    # (n, 3): column and row (from the south) of each in the lattice, and height in `HEIGHT_UNIT`
    units: NDArray[np.int32]
    cell: NDArray[np.int64]  # (c, 2): cells of points
    start: NDArray[np.int64]  # (c + 1,): where the units of each begin
    n_read: int  # number of cells that were looked at, those without a height included


def read_raster_header(path: Path) -> CloudHeader:
    """Read where a raster lies; its heights are not looked at.

    Raises
    ------
    InputError
        If it cannot be read, is turned, or has no place.
    """
    with _open(path) as source:
        _check_turn(path, source)
        crs = None if source.crs is None else crs_or_none(source.crs.to_wkt())
        unread = "" if source.crs is None or crs is not None else "its CRS is not understood"
        bounds = (*_box_of(source), 0.0, 0.0)
        return CloudHeader(path, source.width * source.height, bounds, crs, unread=unread, kind=TERRAIN)


def list_raster_files(path: Path) -> list[Path]:
    """List the files that a raster is made of: itself, and those that a VRT names."""
    with _open(path) as source:
        return [path, *(Path(name) for name in source.files if Path(name) != path)]


def find_lattice(path: Path, frame: Frame, bounds: Box) -> Lattice:
    """Lay the lattice of the cells of a raster in the region, whose `bounds` are in metres.

    It is that of the raster, where its coordinates are those of the region but for units. A raster that is
    reprojected has one between multiples of the length of its cells, over its part of the region.

    Raises
    ------
    InputError
        If its cells are larger than `MOST_CELL`.
    """
    with _open(path) as source:
        step = source.transform
        if not frame.source and frame.east[0] == 0:
            dx, dy = step.a * frame.east[1], -step.e * frame.north[1]
            x = (step.c + step.a / 2) * frame.east[1]
            y = (step.f + (source.height - 0.5) * step.e) * frame.north[1]
            if dx > 0 and dy > 0:
                _check_cell(path, max(dx, dy))
                return Lattice(x, y, dx, dy, source.width, source.height)
        whole = box_to_region(frame, _box_of(source))
    low = [max(whole[k], bounds[k] - REACH) for k in (0, 1)]
    high = [min(whole[k + 2], bounds[k + 2] + REACH) for k in (0, 1)]
    file_box = box_to_file(frame, whole)
    size = math.sqrt(
        (whole[2] - whole[0]) * (whole[3] - whole[1]) / ((file_box[2] - file_box[0]) * (file_box[3] - file_box[1]))
    ) * math.sqrt(abs(step.a * step.e))
    size = float(f"{size:.1g}") if size < 1 else float(round(size))
    _check_cell(path, size)
    first = [math.ceil(v / size) for v in low]
    last = [math.floor(v / size) for v in high]
    nx, ny = (max(b - a + 1, 0) for a, b in zip(first, last, strict=True))
    return Lattice(first[0] * size, first[1] * size, size, size, nx, ny)


def read_raster(path: Path, frame: Frame, lattice: Lattice, bounds: Box) -> Iterator[RasterBlock]:
    """Read the cells of a raster in the region and `REACH` around it, some rows at a time; at least one block.

    `lattice` is that of `find_lattice`, `bounds` the region (m).

    Notes
    -----
    A cell has no height where it has the declared value for none, is masked, NaN, or beyond ±10 km. Scale and
    offset of the band are applied. A raster in another CRS is interpolated linearly between four of its cells, all
    of which must have a height.
    """
    x, y, dx, dy = lattice.x, lattice.y, lattice.dx, lattice.dy
    i0 = max(math.floor((bounds[0] - REACH - x) / dx), 0)
    j0 = max(math.floor((bounds[1] - REACH - y) / dy), 0)
    i1 = min(math.ceil((bounds[2] + REACH - x) / dx) + 1, lattice.nx)
    j1 = min(math.ceil((bounds[3] + REACH - y) / dy) + 1, lattice.ny)
    if i1 <= i0 or j1 <= j0:
        yield RasterBlock(np.empty((0, 3), np.int32), np.empty((0, 2), np.int64), np.zeros(1, np.int64), 0)
        return
    reprojected = bool(frame.source) or frame.east[0] != 0
    with _open(path) as source:
        straight = not reprojected and (source.width, source.height) == (lattice.nx, lattice.ny)
        for first in range(j0, j1, ROWS):
            rows = (first, min(first + ROWS, j1))
            if straight:
                top = lattice.ny - rows[1]
                z = _read(source, (i0, top, i1 - i0, rows[1] - rows[0]))[::-1]
            else:
                z = _resample(source, frame, lattice, (i0, i1), rows)
            yield _make_block(z * frame.height, lattice, (i0, first))


def sample_heights(path: Path, frame: Frame, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of the cells of a raster at places of the region, float64 (n,) (m); NaN where there is none."""
    z = np.full(len(xy), np.nan)
    with _open(path) as source:
        place, step = _to_file(frame, xy), source.transform
        column, row = np.floor((place[:, 0] - step.c) / step.a), np.floor((place[:, 1] - step.f) / step.e)
        inside = (column >= 0) & (column < source.width) & (row >= 0) & (row < source.height)
        block = source.block_shapes[0]
        # A block of the file at a time.
        number = np.where(inside, row // block[0] * source.width + column // block[1], -1)
        for one in np.unique(number[inside]).tolist():
            own = np.flatnonzero(number == one)
            c, r = column[own].astype(np.int64), row[own].astype(np.int64)
            cells = _read(source, (int(c.min()), int(r.min()), int(np.ptp(c)) + 1, int(np.ptp(r)) + 1))
            z[own] = cells[r - r.min(), c - c.min()] * frame.height
    z[np.abs(z) > HIGHEST] = np.nan
    return z


def _make_block(z: NDArray[np.float64], lattice: Lattice, corner: tuple[int, int]) -> RasterBlock:
    with np.errstate(invalid="ignore"):
        row, column = np.nonzero(np.abs(z) <= HIGHEST)
    height = np.round(z[row, column] / HEIGHT_UNIT).astype(np.int32)
    place = np.column_stack((column + corner[0], row + corner[1]))
    xy = place * np.array([lattice.dx, lattice.dy]) + np.array([lattice.x, lattice.y])
    cells = order_by_cell(xy, CELL)
    units = np.column_stack((place.astype(np.int32), height))[cells.order]
    return RasterBlock(units, cells.cell, cells.start, z.size)


def _read(source: Any, box: tuple[int, int, int, int]) -> NDArray[np.float64]:
    """Read heights of a window (column, row, width, height); NaN where there is none."""
    from rasterio.errors import RasterioError
    from rasterio.windows import Window

    try:
        found = source.read(1, window=Window(*box), masked=True)
    except RasterioError as error:
        raise InputError(
            f"{source.name}: cannot be read ({error}); the file may be cut off: copy it again"
        ) from error
    z: NDArray[np.float64] = np.asarray(found.filled(0), np.float64)
    z = z * float(source.scales[0]) + float(source.offsets[0])
    z[np.ma.getmaskarray(found)] = np.nan
    return z


def _resample(
    source: Any, frame: Frame, lattice: Lattice, columns: tuple[int, int], rows: tuple[int, int]
) -> NDArray[np.float64]:
    """Heights of nodes of a lattice, linearly between the four cells of the raster around each."""
    x = lattice.x + np.arange(*columns) * lattice.dx
    y = lattice.y + np.arange(*rows) * lattice.dy
    nodes = np.column_stack([side.ravel() for side in np.meshgrid(x, y)])
    place = _to_file(frame, nodes)
    step = source.transform
    u, v = (place[:, 0] - step.c) / step.a - 0.5, (place[:, 1] - step.f) / step.e - 0.5
    fine = (u >= 0) & (v >= 0) & (u <= source.width - 1) & (v <= source.height - 1)  # not so for NaN
    z = np.full(len(nodes), np.nan)
    if fine.any():
        c0, r0 = int(np.floor(u[fine].min())), int(np.floor(v[fine].min()))
        c1, r1 = (int(np.floor(w[fine].max())) + 2 for w in (u, v))
        c1, r1 = min(c1, source.width), min(r1, source.height)
        cells = _read(source, (c0, r0, c1 - c0, r1 - r0))
        c, r = np.floor(u[fine]).astype(np.int64) - c0, np.floor(v[fine]).astype(np.int64) - r0
        s, t = u[fine] - c0 - c, v[fine] - r0 - r
        right, below = np.minimum(c + 1, cells.shape[1] - 1), np.minimum(r + 1, cells.shape[0] - 1)
        z[fine] = (
            cells[r, c] * (1 - s) * (1 - t)
            + cells[r, right] * s * (1 - t)
            + cells[below, c] * (1 - s) * t
            + cells[below, right] * s * t
        )
    return z.reshape(len(y), len(x))


def _to_file(frame: Frame, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places of the region in the coordinates of a file: `to_region` the other way round."""
    plan = to_region(Frame(source=frame.target, target=frame.source), xy) if frame.source else xy
    place = np.empty_like(plan)
    place[:, frame.east[0]] = plan[:, 0] / frame.east[1]
    place[:, frame.north[0]] = plan[:, 1] / frame.north[1]
    return place


def _open(path: Path) -> Any:
    import rasterio
    from rasterio.errors import RasterioIOError

    try:
        return rasterio.open(path)
    except RasterioIOError as error:
        raise InputError(
            f"{path}: is no raster that GDAL reads ({error}); give a GeoTIFF, COG or VRT with heights"
        ) from error


def _check_turn(path: Path, source: Any) -> None:
    step = source.transform
    if step.b or step.d or not step.a or not step.e:
        raise InputError(f"{path}: its rows do not run west to east; gdalwarp '{path}' straight.tif turns them")
    if step.is_identity:
        raise InputError(f"{path}: states no place of its cells; give a raster with a geotransform")


def _check_cell(path: Path, size: float) -> None:
    if size > MOST_CELL:
        raise InputError(f"{path}: cells of {size:g} m, at most {MOST_CELL:g} m are taken; give a finer raster")


def _box_of(source: Any) -> Box:
    box = source.bounds
    return min(box.left, box.right), min(box.bottom, box.top), max(box.left, box.right), max(box.bottom, box.top)
