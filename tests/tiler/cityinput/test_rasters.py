"""Rasters of terrain: where their cells lie, which have a height, and heights between them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine

from pipeline.data.errors import InputError
from tiler.cityinput.lattices import Cells, interpolate_cells
from tiler.cityinput.rasters import (
    HEIGHT_UNIT,
    Lattice,
    find_lattice,
    list_raster_files,
    read_raster,
    read_raster_header,
)
from tiler.georeference.frame import AS_IT_IS, Frame

BOUNDS = (0.0, 0.0, 1e6, 1e7)


def write(
    path: Path, z: Any, *, west: float = 500_000.0, north: float = 5_000_010.0, size: float = 1.0, **more: Any
) -> Path:
    values = np.asarray(z, np.float32)
    options: dict[str, Any] = {"crs": "EPSG:25832", "transform": Affine(size, 0, west, 0, -size, north)} | more
    scales, offsets = options.pop("scales", None), options.pop("offsets", None)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=values.shape[0],
        width=values.shape[1],
        count=1,
        dtype="float32",
        **options,
    ) as file:
        file.write(values, 1)
        if scales:
            file.scales, file.offsets = scales, offsets
    return path


def cells_of(path: Path, frame: Frame = AS_IT_IS, bounds: Any = BOUNDS) -> tuple[Lattice, NDArray[np.float64]]:
    """The lattice of a file, and its cells with a height: x, y, z."""
    lattice = find_lattice(path, frame, bounds)
    units = np.concatenate([block.units for block in read_raster(path, frame, lattice, bounds)])
    scale = np.array([lattice.dx, lattice.dy, HEIGHT_UNIT])
    return lattice, units * scale + np.array([lattice.x, lattice.y, 0.0])


def test_cells_lie_in_their_middles_and_the_first_row_is_north(tmp_path: Path) -> None:
    lattice, xyz = cells_of(write(tmp_path / "a.tif", [[1, 2, 3], [4, 5, 6]]))
    assert lattice == Lattice(500_000.5, 5_000_008.5, 1.0, 1.0, 3, 2)
    by_place = {(x, y): z for x, y, z in xyz.tolist()}
    assert by_place[500_000.5, 5_000_009.5] == 1.0
    assert by_place[500_002.5, 5_000_008.5] == 6.0


def test_a_raster_of_points_lies_where_its_transform_says(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", np.arange(16).reshape(4, 4))
    before = cells_of(path)[1]
    with rasterio.open(path, "r+") as file:
        file.update_tags(AREA_OR_POINT="Point")
    raw = path.read_bytes()
    lattice, after = cells_of(path)
    # The tie point in the file is now a middle: GDAL gives the corner half a cell before it.
    assert after.tolist() == before.tolist()
    assert (lattice.x % 1.0, lattice.y % 1.0) == (0.5, 0.5)
    assert np.float64(500_000.5).tobytes() in raw


def test_no_height_where_a_cell_says_so_or_is_nan_or_absurd(tmp_path: Path) -> None:
    _, xyz = cells_of(write(tmp_path / "a.tif", [[1, -9999, np.nan], [1e30, 5, -1e5]], nodata=-9999))
    assert sorted(xyz[:, 2].tolist()) == [1.0, 5.0]


def test_scale_and_offset_of_the_band_are_applied(tmp_path: Path) -> None:
    _, xyz = cells_of(write(tmp_path / "a.tif", [[10, 20]], scales=(0.5,), offsets=(100.0,)))
    assert sorted(xyz[:, 2].tolist()) == [105.0, 110.0]


def test_a_header_states_box_and_crs(tmp_path: Path) -> None:
    header = read_raster_header(write(tmp_path / "a.tif", np.zeros((2, 3))))
    assert header.bounds[:4] == (500_000.0, 5_000_008.0, 500_003.0, 5_000_010.0)
    assert header.crs is not None
    assert (header.kind, header.n_points, header.crs.to_epsg()) == ("terrain", 6, 25832)


def test_cells_far_from_the_region_are_not_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", np.zeros((1000, 1000)), north=5_001_000.0)
    bounds = (500_400.0, 5_000_400.0, 500_410.0, 5_000_410.0)
    _, xyz = cells_of(path, bounds=bounds)
    assert 0 < len(xyz) <= 215**2


def test_a_vrt_names_its_files(tmp_path: Path) -> None:
    tile = write(tmp_path / "a.tif", [[1, 2], [3, 4]])
    vrt = tmp_path / "all.vrt"
    vrt.write_text(
        "<VRTDataset rasterXSize='2' rasterYSize='2'><SRS>EPSG:25832</SRS>"
        "<GeoTransform>500000, 1, 0, 5000010, 0, -1</GeoTransform><VRTRasterBand dataType='Float32' band='1'>"
        "<SimpleSource><SourceFilename relativeToVRT='1'>a.tif</SourceFilename><SourceBand>1</SourceBand>"
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    assert list_raster_files(vrt) == [vrt, tile]
    assert sorted(cells_of(vrt)[1][:, 2].tolist()) == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"transform": Affine(1, 0.1, 5e5, 0.1, -1, 5e6)}, "do not run west to east"),
        ({"size": 90.0}, "cells of 90 m, at most 50 m"),
    ],
)
def test_what_cannot_be_taken_is_refused(tmp_path: Path, more: dict[str, Any], words: str) -> None:
    path = write(tmp_path / "a.tif", np.zeros((2, 2)), **more)
    read = find_lattice if "size" in more else lambda path, *_: read_raster_header(path)
    with pytest.raises(InputError, match=words):
        read(path, AS_IT_IS, BOUNDS)


def test_a_file_that_is_no_raster_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(b"II*\0 and no more")
    with pytest.raises(InputError, match="no raster"):
        read_raster_header(tmp_path / "a.tif")


def test_a_raster_in_another_crs_is_interpolated(tmp_path: Path) -> None:
    x = 500_000.5 + np.arange(200)
    path = write(tmp_path / "a.tif", np.tile((x - 500_000) / 10, (200, 1)), north=5_000_200.0)
    frame = Frame(source="EPSG:25832", target="EPSG:32632")  # the same within a millimetre
    lattice, xyz = cells_of(path, frame, (500_000.0, 5_000_000.0, 500_200.0, 5_000_200.0))
    assert (lattice.dx, lattice.dy) == (1.0, 1.0)
    assert len(xyz) > 190**2
    assert xyz[:, 2] == pytest.approx((xyz[:, 0] - 500_000) / 10, abs=1e-3)


def test_the_tiles_of_munich_meet(shared_data: Path) -> None:
    folder = shared_data / "dtm_munich"
    south, north = (find_lattice(folder / name, AS_IT_IS, BOUNDS) for name in ("690_5335.tif", "690_5336.tif"))
    assert (south.dx, south.dy, south.nx, south.ny) == (1.0, 1.0, 1000, 1000)
    assert north.y - (south.y + 999) == 1.0
    header = read_raster_header(folder / "690_5335.tif")
    assert header.crs is not None
    assert header.crs.to_epsg() == 25832


def lattice_of(z: Any, x: float = 0.5, y: float = 0.5, d: float = 1.0) -> tuple[Cells, Lattice, NDArray[np.int32]]:
    """Cells for heights (rows from the south), NaN for none."""
    values = np.asarray(z, np.float64)
    lattice = Lattice(x, y, d, d, values.shape[1], values.shape[0])
    row, column = np.nonzero(np.isfinite(values))
    units = np.column_stack((column, row, np.round(values[row, column] / HEIGHT_UNIT))).astype(np.int32)
    cells = Cells.around((x, y, x + d * values.shape[1], y + d * values.shape[0]), lattice)
    cells.put(units, lattice, HEIGHT_UNIT)
    return cells, lattice, units


def test_a_plane_is_reproduced_between_middles() -> None:
    y, x = np.mgrid[0.5:6.5, 0.5:8.5]
    cells, _, _ = lattice_of(2 * x + 3 * y + 1)
    found = interpolate_cells(cells, np.arange(1.0, 8.0), np.arange(1.0, 6.0), 1.0)
    assert found == pytest.approx(np.add.outer(3 * np.arange(1.0, 6.0), 2 * np.arange(1.0, 8.0)) + 1)


def test_half_a_cell_beyond_the_outer_middles_there_is_a_height_and_no_farther() -> None:
    cells, _, _ = lattice_of(np.full((3, 3), 7.0))
    found = interpolate_cells(cells, np.array([-1.0, 0.0, 1.0, 2.0, 3.0, 4.0]), np.array([1.0]), 1.0)
    assert np.isnan(found).tolist() == [[True, False, False, False, False, True]]
    assert found[0, 1:5].tolist() == [7.0] * 4


def test_a_cell_without_a_height_takes_no_part() -> None:
    z = np.full((4, 4), 5.0)
    z[1, 1] = np.nan
    cells, _, _ = lattice_of(z)
    found = interpolate_cells(cells, np.array([1.0, 1.3, 1.5, 2.2]), np.array([1.4]), 1.0)
    assert np.isnan(found).tolist() == [[False, True, True, False]] or found[0, 3] == 5.0


def test_between_two_files_both_count() -> None:
    z = np.tile(np.arange(6.0), (3, 1))
    whole, _, _ = lattice_of(z)
    _, west, units_west = lattice_of(z[:, :3])
    _, east, units_east = lattice_of(z[:, 3:], x=3.5)
    cells = Cells.around((0.5, 0.5, 6.5, 3.5), west)
    cells.put(units_west, west, HEIGHT_UNIT)
    cells.put(units_east, east, HEIGHT_UNIT)
    x, y = np.arange(1.0, 6.0), np.array([1.0, 2.0])
    assert interpolate_cells(cells, x, y, 1.0).tolist() == interpolate_cells(whole, x, y, 1.0).tolist()
    assert interpolate_cells(cells, np.array([3.0]), y, 1.0).tolist() == [[2.5], [2.5]]


def test_fine_cells_are_averaged_around_nodes() -> None:
    y, x = np.mgrid[0.125:4.125:0.25, 0.125:4.125:0.25]
    cells, _, _ = lattice_of(x + 10 * y, x=0.125, y=0.125, d=0.25)
    found = interpolate_cells(cells, np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0]), 1.0)
    assert found == pytest.approx(np.array([[11.0, 12.0, 13.0], [21.0, 22.0, 23.0]]))


def test_coarse_cells_are_interpolated() -> None:
    y, x = np.mgrid[5.0:45.0:10, 5.0:45.0:10]
    cells, _, _ = lattice_of(x - y, x=5.0, y=5.0, d=10.0)
    found = interpolate_cells(cells, np.arange(6.0, 30.0), np.arange(7.0, 20.0), 1.0)
    assert found == pytest.approx(np.subtract.outer(np.arange(6.0, 30.0), np.arange(7.0, 20.0)).T)
