"""Point cloud files: find them, and say what their headers say (step 1.1)."""

import logging
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj

from pipeline.data.errors import InputError
from tiler.georeference.frame import AS_IT_IS, Frame
from tiler.georeference.las_crs import read_las_crs
from tiler.objects.places import as_place, is_url, place
from tiler.pointclouds.las_chunks import SLACK, box_of_points
from tiler.pointclouds.las_header import box_of_header, has_void_box, read_las_header
from tiler.store.remembered import remember

# Points that a task reads of a larger file: some seconds, many of those of a task, and few enough for all workers.
SHARE_POINTS = 3_000_000
_SUFFIXES = {".las", ".laz"}
_GLOB_SIGNS = set("*?[")

# laspy logs what it also raises; without a handler Python would print it over the user's progress.
logging.getLogger("laspy").addHandler(logging.NullHandler())


@dataclass(frozen=True)
class CloudHeader:
    """What one point cloud file says about itself."""

    path: Path
    n_points: int
    # xmin, ymin, xmax, ymax, zmin, zmax in the file's CRS, or in the region's where that is established; all NaN
    # if there are no points.
    bounds: tuple[float, float, float, float, float, float]
    # As stated, compound CRSs included; None if the file states none or one that nobody can parse.
    crs: pyproj.CRS | None
    # Metres of a unit in plan and of height, where a record states them beside the CRS (see `LasCrs`).
    plan_unit: float | None = None
    height_unit: float | None = None
    unread: str = ""  # what a record of the CRS holds that is not understood
    box_of_points: bool = False  # whether the box in the header is void, and the points were read for `bounds`
    frame: Frame = AS_IT_IS  # how coordinates of the file become those of the region
    # ``"cloud"``; other files that give points or ground are ``"model"``, a city model, and ``"terrain"``, a
    # raster.
    kind: str = "cloud"
    # Whether the northing comes first in the file; `bounds` have the easting first all the same.
    swapped: bool = False
    axes: str = ""  # what decided on that order, where it is not the usual one
    n_buildings: int = 0


def find_clouds(sources: Sequence[str | Path]) -> list[Path]:
    """Find the point cloud files that files, globs and folders stand for: sorted, each file once.

    Parameters
    ----------
    sources : sequence of str or Path
        Files of any name, glob patterns (``**`` included), and folders, whose ``.las`` and ``.laz`` files
        are taken in any case, without their subfolders. URLs of files, and ``s3://`` ones of what lies below.

    Raises
    ------
    InputError
        If there are no sources, or one of them is missing or stands for no file.
    """
    if not sources:
        raise InputError("no point cloud was given; name a file, a folder or a glob such as 'tiles/*.laz'")
    files = [path for source in sources if not is_url(str(source)) for path in _find(Path(source))]
    remote = {path for source in sources if is_url(str(source)) for path in _expand_url(str(source))}
    return each_once(files) + sorted(remote)


def list_files(source: Path, suffixes: Collection[str]) -> list[Path]:
    """List the files that a file, a pattern or a folder stands for; none where nothing is there.

    Of a folder those with one of the suffixes, given in lower case, in any case; hidden ones are not meant, such
    as the ``._x.laz`` of macOS archives.

    Raises
    ------
    InputError
        If a folder cannot be read, or a pattern cannot be followed.
    """
    try:
        if source.is_dir():
            return [path for path in source.iterdir() if _is_meant(path, suffixes) and path.is_file()]
        if source.is_file():
            return [source]
        return _glob(source) if is_pattern(source) else []
    except OSError as error:
        raise InputError(
            f"{source}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from error


def is_pattern(source: Path) -> bool:
    """Whether a path has signs of a pattern."""
    return bool(_GLOB_SIGNS & set(str(source)))


def each_once(files: Iterable[Path]) -> list[Path]:
    """Sort files; of those that are one by symbolic links the first name counts."""
    return sorted({path.resolve(): path for path in sorted(files, reverse=True)}.values())


def count_shares(header: CloudHeader) -> int:
    """Count the tasks that read a file: workers share the points of a large one."""
    return max(1, round(header.n_points / SHARE_POINTS)) if header.kind == "cloud" else 1


def read_header(path: str | Path) -> CloudHeader:
    """Read the header of a LAS, LAZ or COPC file; errors as of `read_las_header`.

    A CRS that cannot be parsed counts as none, and a message asks the user to state it. Where the box in the
    header is void, all points are read once for their box.
    """
    path = as_place(path)
    return remember(path, ("header", path), lambda: _read_header(path))


def _read_header(path: Path) -> CloudHeader:
    header = read_las_header(path, evlrs=True)
    stated = read_las_crs(header)
    bounds = box_of_points(path, header)
    differs = has_void_box(header) and not np.allclose(bounds, box_of_header(header), rtol=0.0, atol=SLACK)
    units = stated.plan_unit, stated.height_unit
    return CloudHeader(path, header.point_count, bounds, stated.crs, *units, stated.unread, differs)


def _expand_url(source: str) -> list[Path]:
    path = place(source)
    try:
        if path.suffix.lower() in _SUFFIXES:
            path.stat()
            return [path]
        found = [one for one in path.iterdir() if _is_meant(one, _SUFFIXES) and one.is_file()]
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror}); check the URL") from error
    if not found:
        raise InputError(f"{source}: no .las or .laz file lies below; name files, or what is before their names")
    return found


def _is_meant(path: Path, suffixes: Collection[str]) -> bool:
    return path.suffix.lower() in suffixes and not path.name.startswith(".")


def _find(source: Path) -> list[Path]:
    if found := list_files(source, _SUFFIXES):
        return found
    if source.is_dir():
        raise InputError(f"{source}: the folder holds no .las or .laz file; name the folder of the tiles")
    if is_pattern(source):
        raise InputError(f"{source}: the pattern matches no file; check the folder's name")
    raise InputError(f"{source}: no such file or folder; check the path")


def _glob(pattern: Path) -> list[Path]:
    """Find the files of a pattern; ``**`` does not go through symbolic links, which may lead in circles."""
    first = next(k for k, part in enumerate(pattern.parts) if _GLOB_SIGNS & set(part))
    base, rest = Path(*pattern.parts[:first]), str(Path(*pattern.parts[first:]))
    try:
        found = [path for path in base.glob(rest) if path.is_file()]
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{pattern}: the pattern cannot be followed ({error}); name a folder or files") from error
    return [path for path in found if not any(part.startswith(".") for part in path.relative_to(base).parts)]
