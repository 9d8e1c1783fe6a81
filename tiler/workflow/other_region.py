"""Refuse to run into a folder that holds the finished run of another region."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import pyproj
import shapely

from pipeline.data.errors import CityError, ConfigError
from tiler.engine.stage import Box
from tiler.georeference.crs import same_crs, short_crs
from tiler.objects.places import absolute, in_bucket
from tiler.planning.region import Region
from tiler.store.json_stream import read_members
from tiler.store.out_folder import RUN_RECORD, STORE
from tiler.store.run_folder import WRONG_FIELD
from tiler.store.store import SUFFIX
from tiler.words.plain_text import format_box

COMMON = 0.5  # share of the larger region's area from which on other files are newer ones of the same region


def refuse_other_region(out: Path, region: Region, inputs: Sequence[str]) -> None:
    """Refuse a folder whose finished run is of another region.

    Parameters
    ----------
    out : Path
        The folder.
    region : Region
        What is to be meshed.
    inputs : sequence of str
        Point clouds and footprints as configured.

    Raises
    ------
    ConfigError
        If the CRS is another one; if the two regions share no area; or if they share less than half of the larger
        one, and no input. A run that did not end is never another region's: it may have been given wrong bounds.
    """
    found = _read_run(out / RUN_RECORD)
    if found is None:
        return
    bounds, crs, known = found
    move = "give another --out, or --overwrite to remove that run"
    holds = f"{out}: holds the run of another region"
    if not _same(crs, region.crs):
        raise ConfigError(f"{holds}, in {short_crs(crs)}; this one is in {short_crs(region.crs)}; {move}")
    one, other = shapely.box(*bounds), shapely.box(*region.bounds)
    share = one.intersection(other).area / max(one.area, other.area)
    here = {absolute(path) for path in inputs}
    if share <= 0 or (share < COMMON and here.isdisjoint(map(absolute, known))):
        how = (
            "have no area in common"
            if share <= 0
            else f"have {100 * share:.0f} % of their area and no file in common"
        )
        raise ConfigError(f"{holds}: {format_box(bounds)} there and {format_box(region.bounds)} now {how}; {move}")


def _read_run(path: Path) -> tuple[Box, str, list[str]] | None:
    """Bounds without a pad, CRS and inputs of a finished run; None where there is none."""
    try:
        if not path.is_file():
            return None
        found, _ = read_members(path, ("region", "parameters").__contains__)
        if found["status"] != "done":
            return None
        region, given = found["region"], found["parameters"]
        west, south, east, north = (float(value) for value in region.get("core", region["bounds"]))
        inputs = [
            str(name) for name in (*given["pointcloud"], given["footprints"], *given.get("buildings", ())) if name
        ]
        return (west, south, east, north), str(region["crs"]), inputs
    except (CityError, *WRONG_FIELD):
        return None  # a damaged record is mended by the run


def _same(one: str, other: str) -> bool:
    if one == other:
        return True
    try:
        return same_crs(pyproj.CRS.from_user_input(one), pyproj.CRS.from_user_input(other))
    except pyproj.exceptions.CRSError:
        return False


def find_missing_folders(out: Path) -> list[Path]:
    """List the folders of a path that are not there, the inner one first; none in a bucket.

    Examples
    --------
    >>> find_missing_folders(Path("/")), find_missing_folders(Path("/nowhere-a/b"))
    ([], [PosixPath('/nowhere-a/b'), PosixPath('/nowhere-a')])
    """
    if in_bucket(out):
        return []
    return [folder for folder in (out, *out.parents) if not folder.exists()]


def remove_folders(made: Sequence[Path]) -> None:
    """Remove folders that a refused run has made, as far as they are empty."""
    for folder in made:
        try:
            folder.rmdir()
        except FileNotFoundError:
            continue
        except OSError:
            return


def remove_if_useless(made: Sequence[Path]) -> None:
    """Remove what a failed run has written where no point cloud was read: a next run would save nothing by it."""
    if made and not any(made[0].glob(f"{STORE}/points/*{SUFFIX}")):
        shutil.rmtree(made[0], ignore_errors=True)
        remove_folders(made)
