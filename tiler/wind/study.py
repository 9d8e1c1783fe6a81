"""`citystitch wind`: maps of mean speed and comfort from results of several directions and a wind rose."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tiler.store.atomic import replacing_folder
from tiler.wind.comfort import CRITERIA, NO_CLASS, LocalWind
from tiler.wind.geotiff import epsg_of, need_pillow, write_geotiff
from tiler.wind.map_picture import draw_classes, draw_speeds
from tiler.wind.raster import Grid, find_triangles, make_grid
from tiler.wind.results import Sampled, WindCase, open_case, read_samples, read_triangles
from tiler.wind.rose import Floats, WindRose, nearest_directions, read_rose

MOST_OFF = 15.0  # degrees between a sector of the rose and the direction that stands for it, before it is said
RECORD = "wind.json"


@dataclass(frozen=True)
class WindMaps:
    """What to draw."""

    rose: Path  #: CSV file of the wind rose; see `read_rose`
    #: height at which its speeds are (m); that of the case's reference speed if not given
    rose_height: float | None = None
    resolution: float = 1.0  #: size of pixels (m)


def assess_wind(directory: Path, output: Path, maps: WindMaps, *, overwrite: bool = False) -> list[str]:
    """Write maps of mean speed and comfort 1.75 m above the ground as GeoTIFF and PNG, and their numbers as JSON.

    Parameters
    ----------
    directory : Path
        An exported wind case whose directions have run.
    output : Path
        Folder to write; it appears whole or not at all.
    maps : WindMaps
        The rose, and what to draw.
    overwrite : bool
        Whether a folder that this wrote may be replaced.

    Returns
    -------
    list of str
        What was found, a line each.

    Raises
    ------
    ConfigError
        If the folder exists and may not be replaced, a parameter is out of range, or Pillow is missing.
    InputError
        If the case or the rose cannot be read, or a direction has no results.
    OutputError
        If the folder cannot be written.
    """
    need_pillow()
    _check_output(output, overwrite=overwrite)
    case, rose = open_case(directory), read_rose(maps.rose)
    height = case.wind.height if maps.rose_height is None else maps.rose_height
    if not 0 < height < np.inf:
        raise ConfigError(f"--rose-height {height:g}: must be more than 0 m")
    triangles = read_triangles(case)
    found = [read_samples(case, direction, triangles) for direction in case.wind.directions]
    grid = make_grid(triangles.points[:, :2], maps.resolution)
    row = find_triangles(triangles.points[:, :2], triangles.corners, grid)
    undisturbed = float(case.wind.speed_at(height))
    factors = np.array([sample.speed for sample in found]) / undisturbed
    of_row, off = nearest_directions(rose, case.wind.directions)
    local = LocalWind(rose, factors, of_row)
    lines = _describe(case, rose, found, off)
    with replacing_folder(output) as folder:
        record = {"schema": 1, "crs": case.crs, "rose_height": height, "calm": rose.calm}
        record |= _write_maps(folder, local, case, grid, row)
        record |= {"iterations": {f"{d:g}": s.iteration for d, s in zip(case.wind.directions, found, strict=True)}}
        record["notes"] = lines
        (folder / RECORD).write_text(json.dumps(record, indent=1) + "\n")
    return lines


def _check_output(output: Path, *, overwrite: bool) -> None:
    if output.exists() and not overwrite:
        raise ConfigError(f"{output}: exists; give another --output, or --overwrite")
    if output.exists() and not (output / RECORD).is_file():
        raise ConfigError(f"{output}: holds no {RECORD}, so it is none of these maps; give another --output")


def _describe(case: WindCase, rose: WindRose, found: list[Sampled], off: Floats) -> list[str]:
    lines = []
    for direction, sample in zip(case.wind.directions, found, strict=True):
        lost = f", {sample.n_lost:,} triangles without a sample" if sample.n_lost else ""
        what = f"{len(sample.speed):,} triangles after iteration {sample.iteration}{lost}"
        lines.append(f"{direction:g} degrees: {what}")
    far = off > MOST_OFF
    if far.any():
        lines.append(
            f"warning: {rose.share[far].sum():.0%} of the time the wind comes from more than {MOST_OFF:g} degrees "
            f"beside any simulated direction, at most {off.max():g}; the nearest stands for it; simulate more"
        )
    if rose.calm > 0:
        lines.append(f"{rose.calm:.1%} of the time is calm")
    if epsg_of(case.crs) is None:
        lines.append(f"warning: {case.crs} has no EPSG number; tell the CRS to what reads the GeoTIFF files")
    return lines


def _write_maps(
    folder: Path, local: LocalWind, case: WindCase, grid: Grid, row: NDArray[np.int32]
) -> dict[str, Any]:
    """Write all maps; returns the share of the ground in each class, and percentiles of the speed."""
    mean = _spread(local.mean_speed(), row, np.nan)
    write_geotiff(folder / "mean_speed.tif", mean.astype(np.float32), grid, crs=case.crs, no_data="nan")
    draw_speeds(folder / "mean_speed.png", mean, title="mean speed, 1.75 m above ground", unit="m/s")
    for direction, factor in zip(case.wind.directions, local.factors, strict=True):
        values = _spread(factor, row, np.nan).astype(np.float32)
        write_geotiff(folder / f"factor_{direction:g}.tif", values, grid, crs=case.crs, no_data="nan")
    known = mean[~np.isnan(mean)]
    shares: dict[str, dict[str, float]] = {}
    for name, criterion in CRITERIA.items():
        classes = _spread(criterion.classify(local.exceeded), row, NO_CLASS)
        write_geotiff(folder / f"{name}.tif", classes, grid, crs=case.crs, no_data=str(NO_CLASS))
        draw_classes(folder / f"{name}.png", classes, title=criterion.title, names=criterion.names)
        counts = np.bincount(classes.ravel(), minlength=len(criterion.names) + 1)[1:]
        total = max(int(counts.sum()), 1)
        words = zip(criterion.names, counts.tolist(), strict=True)
        shares[name] = {word: round(int(n) / total, 6) for word, n in words}
    percentiles = np.percentile(known, [5, 50, 95]).round(4).tolist() if len(known) else []
    return {"mean_speed": percentiles, "ground_shares": shares}


def _spread(values: NDArray[Any], row: NDArray[np.int32], nothing: float) -> NDArray[Any]:
    """Give each pixel the value of its triangle."""
    return np.where(row >= 0, values[row], np.asarray(nothing, values.dtype))
