"""Point cloud files: find them, read their headers, read their points within a box (step 1.1)."""

import logging
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import laspy
import numpy as np
import pyproj
from numpy.typing import NDArray

from pipeline.errors import InputError, OutputError
from pipeline.las_points import KEPT, REASONS, count_values, judge_points
from pipeline.pointcloud import PointCloud
from tiler.copc import NODE_SLACK, CopcIndex, read_index, read_nodes
from tiler.las_chunks import FIELDS, classes_of, coordinates_of, ends_of, scaling_of, units_of
from tiler.lasheader import AGAIN, RECORD_BYTES, LasPromise, read_promise
from tiler.places import as_place, is_url, place, source_of

CHUNK_POINTS = 1_000_000
CHUNK_BYTES = 64_000_000  # wins over CHUNK_POINTS where a point has many extra bytes
HEADER_SLACK = 1.0  # m that a point may lie outside the header's bounds
QUERY_SHARE = 0.5  # a COPC file is read by its octree where less than this share of its box is wanted

Box = tuple[float, float, float, float]

# What laspy and pyproj raise on records of a CRS that make no sense.
_NO_CRS = (pyproj.exceptions.CRSError, ValueError, TypeError, LookupError, OverflowError, struct.error)
_SUFFIXES = {".las", ".laz"}
_GLOB_SIGNS = set("*?[")

# laspy logs what it also raises; without a handler Python would print it over the user's progress.
logging.getLogger("laspy").addHandler(logging.NullHandler())


@dataclass(frozen=True)
class CloudHeader:
    """What one point cloud file says about itself.

    Attributes
    ----------
    path : Path
        The file.
    n_points : int
        Number of points.
    bounds : tuple of 6 floats
        xmin, ymin, xmax, ymax, zmin, zmax in the file's CRS; all NaN if there are no points.
    crs : pyproj.CRS or None
        As stated, compound CRSs included; None if the file states none or one that nobody can parse.
    """

    path: Path
    n_points: int
    bounds: tuple[float, float, float, float, float, float]
    crs: pyproj.CRS | None


def find_clouds(sources: Sequence[str | Path]) -> list[Path]:
    """Find the point cloud files that files, globs and folders stand for.

    Parameters
    ----------
    sources : sequence of str or Path
        Files of any name, glob patterns (``**`` included), and folders, whose ``.las`` and ``.laz`` files
        are taken in any case, without their subfolders. URLs of files, and ``s3://`` ones of what lies below.

    Returns
    -------
    list of Path
        Sorted, each file once.

    Raises
    ------
    InputError
        If there are no sources, or one of them is missing or stands for no file.
    """
    if not sources:
        raise InputError("no point cloud was given; name a file, a folder or a glob such as 'tiles/*.laz'")
    local = [source for source in sources if not is_url(str(source))]
    files = [path for source in local for path in _expand(Path(source))]
    remote = {path for source in sources if is_url(str(source)) for path in _expand_url(str(source))}
    return sorted({path.resolve(): path for path in sorted(files, reverse=True)}.values()) + sorted(remote)


def read_header(path: str | Path) -> CloudHeader:
    """Read the header of a LAS, LAZ or COPC file.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    CloudHeader

    Raises
    ------
    InputError
        If the file is missing, is not LAS, is shorter than its header claims, or its header has values that
        are not finite or absurd (see `tiler.lasheader`).

    Notes
    -----
    A CRS that cannot be parsed counts as none: the user must then state it, and is told so.
    """
    path = as_place(path)
    promise = read_promise(path)
    evlrs = promise.extended <= RECORD_BYTES
    with _laspy_as_input_error(path, promise, [0]), laspy.open(source_of(path), read_evlrs=evlrs) as reader:
        header = reader.header
    return CloudHeader(path, promise.n_points, promise.bounds, _parse_crs(header))


def read_points(path: str | Path, bounds: Box) -> tuple[PointCloud, dict[str, int]]:
    """Read the usable points of a file within a box (step 1.1).

    Dropped are, in this order: points outside the box, withheld points, the noise classes 7 and 18, and
    points with a height that is not within ±10 km.

    Parameters
    ----------
    path : str or Path
        LAS, LAZ or COPC file.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax in the file's CRS; the borders belong to the box.

    Returns
    -------
    PointCloud
        The kept points in the order of the file; possibly none.
    dict of str to int
        ``read`` = ``outside`` + ``withheld`` + ``noise`` + ``absurd`` + ``kept``; each point counts once.

    Raises
    ------
    InputError
        If the file cannot be read, ends early, is damaged, or has points more than 1 m outside the bounds
        that its header states: such a file is damaged, or would be missing from the tiles it belongs to.

    Notes
    -----
    Memory is that of the kept points (25 bytes each) and one chunk of the file.
    """
    path = as_place(path)
    promise = read_promise(path)
    counts = dict.fromkeys(("read", "outside", "withheld", "noise", "absurd", "kept"), 0)
    places, classes = [np.empty((0, 3))], [np.empty(0, np.uint8)]
    for chunk in _chunks(path, promise):
        kept = select_usable(chunk, bounds, counts)
        places.append(coordinates_of(chunk)[kept])
        classes.append(classes_of(chunk)[kept])
    return PointCloud(np.concatenate(places), np.concatenate(classes)), counts


def read_chunks(path: Path, bounds: Box) -> Iterator[tuple[laspy.ScaleAwarePointRecord, int]]:
    """Read a file by chunks, without those parts of a COPC file that are away from a box.

    Parameters
    ----------
    path : Path
        LAS, LAZ or COPC file.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax in the file's CRS (m).

    Yields
    ------
    laspy.ScaleAwarePointRecord
        Some million points, in the order of the file; the first chunk may be empty, others are not.
    int
        Points that are not read, all of them outside the box; not 0 in the first chunk only.

    Raises
    ------
    InputError
        As `read_points`.

    Notes
    -----
    A COPC file is read by its octree where the box covers less than half of the box in its header.
    """
    promise = read_promise(path)
    index = read_index(path, promise) if _share(promise, bounds) < QUERY_SHARE else None
    n_skipped, chunks = 0, _chunks(path, promise)
    if index is not None:
        near = _near(index.box, bounds)
        n_skipped, chunks = int(index.count[~near].sum()), _query(path, promise, index, near)
    first = next(chunks, None)
    if first is None:
        with _laspy_as_input_error(path, promise, [0]), laspy.open(source_of(path), read_evlrs=False) as reader:
            empty = laspy.ScaleAwarePointRecord.zeros(0, header=reader.header)
        yield empty, n_skipped
        return
    yield first, n_skipped
    for chunk in chunks:
        yield chunk, 0


def select_usable(chunk: laspy.ScaleAwarePointRecord, bounds: Box, counts: dict[str, int]) -> NDArray[np.bool_]:
    """Select the usable points of a chunk, and count what became of each.

    Parameters
    ----------
    chunk : laspy.ScaleAwarePointRecord
        Points of a file, n of them.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax; the borders belong to the box.
    counts : dict of str to int
        The counts of `read_points`; this chunk's are added.

    Returns
    -------
    bool, (n,)
        Which points to keep.
    """
    verdict = judge_points(
        *units_of(chunk), *scaling_of(chunk), classes_of(chunk), np.asarray(chunk.withheld) != 0, bounds
    )
    for reason, number in zip(REASONS, count_values(verdict)[: len(REASONS)].tolist(), strict=True):
        counts[reason] += number
    counts["read"] += len(chunk)
    return np.asarray(verdict == KEPT)


def _expand(source: Path) -> list[Path]:
    try:
        return _find(source)
    except OSError as error:
        raise InputError(
            f"{source}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from error


def _expand_url(source: str) -> list[Path]:
    path = place(source)
    try:
        if path.suffix.lower() in _SUFFIXES:
            path.stat()
            return [path]
        found = [one for one in path.iterdir() if _is_cloud(one) and one.is_file()]
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror}); check the URL") from error
    if not found:
        raise InputError(f"{source}: no .las or .laz file lies below; name files, or what is before their names")
    return found


def _is_cloud(path: Path) -> bool:
    """Whether a file of a folder is meant: hidden ones are not, such as the ``._x.laz`` of macOS archives."""
    return path.suffix.lower() in _SUFFIXES and not path.name.startswith(".")


def _find(source: Path) -> list[Path]:
    if source.is_dir():
        found = [path for path in source.iterdir() if _is_cloud(path) and path.is_file()]
        if not found:
            raise InputError(f"{source}: the folder holds no .las or .laz file; name the folder of the tiles")
        return found
    if source.is_file():
        return [source]
    if _GLOB_SIGNS & set(str(source)):
        found = _glob(source)
        if not found:
            raise InputError(f"{source}: the pattern matches no file; check the folder's name")
        return found
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


def _chunks(path: Path, promise: LasPromise) -> Iterator[laspy.ScaleAwarePointRecord]:
    """Yield the points by chunks; fail if there are fewer than the header claims."""
    step = _step(promise)
    n_read = [0]
    with (
        _laspy_as_input_error(path, promise, n_read),
        laspy.open(
            source_of(path), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False, decompression_selection=FIELDS
        ) as reader,
    ):
        while n_read[0] < promise.n_points:
            chunk = reader.read_points(step)
            if len(chunk) == 0:
                break
            n_read[0] += len(chunk)
            _check_within_header(path, promise, chunk)
            yield chunk
    if n_read[0] != promise.n_points:
        raise InputError(f"{path}: {n_read[0]} of {promise.n_points} points could be read; {AGAIN}")


def _share(promise: LasPromise, bounds: Box) -> float:
    """Give the share of the header's box that a box covers; 1 for a file without area or points."""
    xmin, ymin, xmax, ymax, _, _ = promise.bounds
    width = min(xmax, bounds[2]) - max(xmin, bounds[0])
    height = min(ymax, bounds[3]) - max(ymin, bounds[1])
    area = (xmax - xmin) * (ymax - ymin)
    return max(width, 0.0) * max(height, 0.0) / area if area > 0 else 1.0


def _near(box: NDArray[np.float64], bounds: Box) -> NDArray[np.bool_]:
    xmin, ymin, xmax, ymax = box.T
    near: NDArray[np.bool_] = (xmin <= bounds[2] + NODE_SLACK) & (xmax >= bounds[0] - NODE_SLACK)
    near &= (ymin <= bounds[3] + NODE_SLACK) & (ymax >= bounds[1] - NODE_SLACK)
    return near


def _query(
    path: Path, promise: LasPromise, index: CopcIndex, near: NDArray[np.bool_]
) -> Iterator[laspy.ScaleAwarePointRecord]:
    n_read = [0]
    with _laspy_as_input_error(path, promise, n_read):
        for chunk in read_nodes(path, index, near, step=_step(promise)):
            n_read[0] += len(chunk)
            _check_within_header(path, promise, chunk)
            yield chunk


def _step(promise: LasPromise) -> int:
    return max(1, min(CHUNK_POINTS, CHUNK_BYTES // promise.point_size))


def _check_within_header(path: Path, promise: LasPromise, chunk: laspy.ScaleAwarePointRecord) -> None:
    low = np.array(promise.bounds[:2]) - HEADER_SLACK
    high = np.array(promise.bounds[2:4]) + HEADER_SLACK
    ends = ends_of(chunk)[:, :2]
    if ((ends >= low) & (ends <= high)).all():
        return
    xy = coordinates_of(chunk)[:, :2]
    stray = ((xy < low) | (xy > high)).any(axis=1)
    x, y = xy[stray][0]
    raise InputError(
        f"{path}: {np.count_nonzero(stray)} of {len(xy)} points lie more than {HEADER_SLACK:g} m outside "
        f"the bounds in its header, the first at ({x:.2f}, {y:.2f}): the points or the header are "
        f"damaged; {AGAIN}, or rewrite it: pdal translate {path.name} mended.laz"
    )


def _parse_crs(header: laspy.LasHeader) -> pyproj.CRS | None:
    try:
        crs: pyproj.CRS | None = header.parse_crs()
    except _NO_CRS:
        return None
    return None if crs is None else _one_crs(crs.srs)


@lru_cache(maxsize=64)
def _one_crs(text: str) -> pyproj.CRS:
    """Give the one CRS of a text: a country's files state the same, and each takes some 30 kB."""
    return pyproj.CRS.from_user_input(text)


@contextmanager
def _laspy_as_input_error(path: Path, promise: LasPromise, n_read: list[int]) -> Iterator[None]:
    """Turn whatever laspy and lazrs raise on a bad file into an InputError.

    On damaged bytes they raise LaspyException, LazrsError, struct.error, ValueError, IndexError, KeyError,
    MemoryError and more, and a panic of the Rust side, which is no Exception and cannot be imported.
    """
    try:
        yield
    except (InputError, OutputError):
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise InputError(
            f"{path}: {n_read[0]} of {promise.n_points} points could be read "
            f"({type(error).__name__}: {error}); {AGAIN}"
        ) from error
