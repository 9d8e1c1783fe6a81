"""`citystitch wind`: maps from sampled speeds that are known, read back by other programs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tiler.cli.main import main
from tiler.wind.raster import find_triangles, make_grid

ROSE = "direction,speed,share\n0,4,0.5\n90,8,0.4\n"
WEST, SOUTH = 121_000.0, 487_000.0


@pytest.fixture
def case(tmp_path: Path) -> Path:
    """An export of 8 x 4 m in four triangles, of which one has no sample; wind from 0 and 90 degrees has run."""
    folder = tmp_path / "case"
    (folder / "constant" / "triSurface").mkdir(parents=True)
    points = np.array([[x, y] for y in (SOUTH, SOUTH + 4) for x in (WEST, WEST + 4, WEST + 8)])
    corners = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    lines = [f"v {x:.17g} {y:.17g} 1.75" for x, y in points]
    lines += [f"f {a} {b} {c}" for a, b, c in corners + 1]
    (folder / "constant" / "triSurface" / "pedestrian.obj").write_text("\n".join(["g ground", *lines]) + "\n")
    wind = {"directions": [0.0, 90.0], "speed": 5.0, "height": 10.0, "roughness": 0.1, "patches": {}}
    (folder / "export.json").write_text(json.dumps({"crs": "EPSG:28992", "wind": wind}))
    centres = points[corners].mean(axis=1)
    for direction, speeds in ((0, [5.0, 10.0, 2.5]), (90, [2.5, 5.0, 5.0])):
        write_samples(folder, direction, 100, centres[:3], [1.0, 1.0, 1.0])
        write_samples(folder, direction, 500, centres[:3][::-1], speeds[::-1])
    (tmp_path / "rose.csv").write_text(ROSE)
    return folder


def write_samples(
    folder: Path, direction: int, time: int, centres: NDArray[np.float64], speeds: list[float]
) -> None:
    place = folder / f"wind_{direction}" / "postProcessing" / "pedestrian" / str(time)
    place.mkdir(parents=True)
    rows = [f"{x:.12g} {y:.12g} 1.75 {0.6 * s} {0.8 * s} 0" for (x, y), s in zip(centres, speeds, strict=True)]
    (place / "U_pedestrian.raw").write_text(
        "\n".join(["# U  FACE_DATA", "# x  y  z  U_x  U_y  U_z", *rows]) + "\n"
    )


def command(case: Path, *words: str) -> list[str]:
    rose, maps = case.parent / "rose.csv", case.parent / "maps"
    return ["wind", str(case), "--rose", str(rose), "-o", str(maps), *words]


def read_tiff(path: Path) -> tuple[NDArray[Any], Any]:
    with rasterio.open(path) as raster:
        return raster.read(1), (tuple(raster.transform)[:6], raster.crs and raster.crs.to_epsg(), raster.nodata)


def test_maps_by_hand(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command(case)) == 0
    said = capsys.readouterr().out
    assert "0 degrees: 4 triangles after iteration 500, 1 triangles without a sample" in said
    assert "10.0% of the time is calm" in said
    maps = case.parent / "maps"
    assert sorted(path.name for path in maps.iterdir()) == [
        "factor_0.tif", "factor_90.tif", "lawson.png", "lawson.tif", "lawson_distress.png", "lawson_distress.tif",
        "mean_speed.png", "mean_speed.tif", "nen8100.png", "nen8100.tif", "nen8100_danger.png",
        "nen8100_danger.tif", "wind.json",
    ]  # fmt: skip
    mean, place = read_tiff(maps / "mean_speed.tif")
    assert mean.dtype == np.float32
    assert mean.shape == (4, 8)
    # South-east half of the left square: 0.5 * 4 * 1 + 0.4 * 8 * 0.5; other: factors 2 and 1; right: 0.5 and 1.
    assert mean[3, 3] == pytest.approx(3.6)
    assert mean[0, 0] == pytest.approx(0.5 * 4 * 2 + 0.4 * 8)
    assert mean[3, 7] == pytest.approx(0.5 * 4 * 0.5 + 0.4 * 8)
    assert np.isnan(mean[0, 4])
    assert place[:2] == ((1.0, 0.0, WEST, 0.0, -1.0, SOUTH + 4), 28992)
    assert np.isnan(place[2])
    classes, place = read_tiff(maps / "nen8100.tif")
    # Over 5 m/s: never, both directions 0.9, from 90 degrees 0.4 of the time.
    assert [classes[3, 3], classes[0, 0], classes[3, 7], classes[0, 4]] == [1, 5, 5, 0]
    assert place[2] == 0
    record = json.loads((maps / "wind.json").read_text())
    assert record["iterations"] == {"0": 500, "90": 500}
    share = (classes == 1).sum() / (classes > 0).sum()
    assert record["ground_shares"]["nen8100"]["A: sitting"] == pytest.approx(share, abs=1e-6)


def test_vtk_reads_the_same_raster(case: Path) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOImage import vtkTIFFReader

    assert main(command(case, "--resolution", "0.5")) == 0
    path = case.parent / "maps" / "lawson.tif"
    reader = vtkTIFFReader()
    reader.SetFileName(str(path))
    reader.Update()
    image = reader.GetOutput()
    columns, rows, _ = image.GetDimensions()
    assert (columns, rows) == (16, 8)
    found = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(rows, columns)
    assert np.array_equal(found, read_tiff(path)[0])


def test_speeds_of_a_rose_at_another_height(case: Path) -> None:
    """At 60 m the undisturbed wind is ln(601) / ln(101) times that at 10 m, so factors are smaller by that."""
    assert main(command(case, "--rose-height", "60")) == 0
    factor = read_tiff(case.parent / "maps" / "factor_0.tif")[0]
    assert factor[3, 3] == pytest.approx(np.log(101) / np.log(601), rel=1e-6)


def test_directions_far_from_the_simulated_ones_are_said(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (case.parent / "rose.csv").write_text("direction,speed,share\n0,4,50\n200,8,50\n")
    assert main(command(case)) == 0
    assert "warning: 50% of the time the wind comes from more than 15 degrees beside" in capsys.readouterr().out


def test_the_profile_at_the_outlet_by_hand(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two rows of faces, one with two faces; heights count from the ground there, which is at 7.1 m."""
    record, place = case / "export.json", case / "postProcessing" / "pedestrian" / "9"
    lowest = {"west": 7.0, "east": 7.1, "ground": 7.0, "top": 60.0}
    wind = {"directions": [270.0], "speed": 5.0, "height": 10.0, "roughness": 0.1}
    words = {"crs": "EPSG:28992", "wind": wind, "meshes": [{"lowest": lowest, "highest": {"ground": 7.02}}]}
    place.mkdir(parents=True)
    heights, speeds = (8.1, 8.12, 17.1), (1.9, 2.1, 5.5)
    for name, values in (
        ("U", [f"{u} 1 0" for u in speeds]),
        ("k", (0.3, 0.5, 0.2)),
        ("epsilon", (0.1, 0.1, 0.02)),
    ):
        rows = [f"8 1 {z} {value}" for z, value in zip(heights, values, strict=True)]
        (place / f"{name}_outlet.raw").write_text("\n".join(["# x y z", *rows]) + "\n")

    def run(*options: str, **changed: object) -> tuple[int, str]:
        record.write_text(json.dumps(words | changed))
        status = main(["wind", str(case), *options])
        said = capsys.readouterr()
        return status, said.out + said.err

    table = case.parent / "inlet.csv"
    status, said = run("--profile", str(table))
    assert (status, table.read_text()) == (
        0, "height,speed,k,epsilon\n1.01,2,0.4,0.1\n10,5.5,0.2,0.02\n"
    )  # fmt: skip
    # The inlet has 5 ln(11.1) / ln(101) = 2.607 m/s at 1.01 m.
    assert "speeds at the outlet are -23.3% to +10.0% off those of the inlet, most at 1.01 m" in said
    assert "inlet.csv: exists; give another --profile, or --overwrite" in run("--profile", str(table))[1]
    assert "give --rose and --output for maps, or --profile" in run()[1]
    again = ("--profile", str(table), "--overwrite")
    assert "has 2 directions; --profile takes a case of one" in run(*again, wind=wind | {"directions": [0, 9]})[1]
    meshes = [{"lowest": lowest | {"walls": 7.0}, "highest": {"ground": 7.02}}]
    assert "--profile takes a case of bare ground; this one has walls" in run(*again, meshes=meshes)[1]
    meshes = [{"lowest": lowest, "highest": {"ground": 8.2}}]
    assert "takes level ground, within 0.05 m; this spans 1.2 m" in run(*again, meshes=meshes)[1]
    assert "export.json: is damaged ('ground')" in run(*again, meshes=[{"lowest": lowest, "highest": {}}])[1]
    (place / "k_outlet.raw").unlink()
    assert "k_outlet.raw: is missing or damaged" in run(*again)[1]


def test_what_cannot_be_mapped(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*words: str) -> str:
        assert main(command(case, *words)) in (1, 2)
        return capsys.readouterr().err

    assert "--resolution 0: must be more than 0 m" in refused("--resolution", "0")
    assert "--rose-height -1: must be more than 0 m" in refused("--rose-height", "-1")
    maps = case.parent / "maps"
    maps.mkdir()
    assert "maps: exists; give another --output, or --overwrite" in refused()
    assert "maps: holds no wind.json" in refused("--overwrite")
    maps.rmdir()
    samples = case / "wind_90" / "postProcessing" / "pedestrian" / "500" / "U_pedestrian.raw"
    samples.write_text("# U\n1 2 3\n")
    assert "U_pedestrian.raw: is missing or damaged" in refused()
    samples.write_text("1 2 3 4 5 6\n")
    assert "none of its 1 samples is over a triangle of the case" in refused()
    samples.parent.parent.rename(case / "elsewhere")
    assert "nothing was sampled yet for 90 degrees; run" in refused()
    (case / "export.json").write_text("{}")
    assert "is no exported wind case (export.json: 'wind')" in refused()


def test_triangles_on_a_raster_cover_each_pixel_once() -> None:
    """Middles of pixels on shared edges belong to one triangle, whichever way round they are."""
    rng = np.random.default_rng(2)
    points = np.array([[0.0, 0], [6, 0], [6, 6], [0, 6], [3, 3]]) + 100.0
    corners = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    grid = make_grid(points, 1.0)
    found = find_triangles(points, corners, grid)
    assert found.min() == 0
    flipped = corners[:, [0, 2, 1]]
    assert np.array_equal(find_triangles(points, flipped, grid), found)
    order = rng.permutation(4)
    assert ((find_triangles(points, corners[order], grid) >= 0) == (found >= 0)).all()
    assert np.bincount(found.ravel()).sum() == 36


def test_a_raster_too_large_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"--resolution 0.001: 100,000,000 x 100,000,000 pixels"):
        make_grid(np.array([[0.0, 0.0], [1e5, 1e5]]), 0.001)
