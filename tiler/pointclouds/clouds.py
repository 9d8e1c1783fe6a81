"""Point cloud files: find them, read their headers, read their points within a box (step 1.1)."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import pyproj
from numpy.typing import NDArray

from pipeline.errors import InputError, OutputError
from pipeline.las_points import KEPT, REASONS, count_values, judge_points
from pipeline.pointcloud import PointCloud
from tiler.georeference.frame import AS_IT_IS, Frame, box_to_file, box_to_region
from tiler.georeference.las_crs import read_las_crs
from tiler.objects.places import as_place, is_url, place, source_of
from tiler.pointclouds.copc import NODE_SLACK, CopcIndex, read_index, read_nodes
from tiler.pointclouds.las_chunks import FIELDS, PointChunk, coordinates_of, ends_of, place_chunk, take_chunk
from tiler.pointclouds.las_header import AGAIN, RECORD_BYTES, LasPromise, read_promise

CHUNK_POINTS = 1_000_000
CHUNK_BYTES = 64_000_000  # wins over CHUNK_POINTS where a point has many extra bytes
HEADER_SLACK = 1.0  # m that a point may lie outside the header's bounds
COUNTED = ("read", "outside", "withheld", "noise", "absurd", "kept")
KEY_POINTS = "key points"
QUERY_SHARE = 0.5  # a COPC file is read by its octree where less than this share of its box is wanted

Box = tuple[float, float, float, float]

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
        xmin, ymin, xmax, ymax, zmin, zmax in the file's CRS, or in the region's where that is established; all NaN
        if there are no points.
    crs : pyproj.CRS or None
        As stated, compound CRSs included; None if the file states none or one that nobody can parse.
    plan_unit, height_unit : float or None
        Metres of a unit in plan and of height, where a record states them beside the CRS (see `LasCrs`).
    unread : str
        What a record of the CRS holds that is not understood.
    box_of_points : bool
        Whether the box in the header is void, and the points were read for `bounds`.
    frame : Frame
        How coordinates of the file become those of the region.
    """

    path: Path
    n_points: int
    bounds: tuple[float, float, float, float, float, float]
    crs: pyproj.CRS | None
    plan_unit: float | None = None
    height_unit: float | None = None
    unread: str = ""
    box_of_points: bool = False
    frame: Frame = AS_IT_IS


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
        are not finite or absurd (see `tiler.pointclouds.las_header`).

    Notes
    -----
    A CRS that cannot be parsed counts as none: the user must then state it, and is told so. Where the box in the
    header is void, all points are read once for their box.
    """
    path = as_place(path)
    promise = read_promise(path)
    evlrs = promise.extended <= RECORD_BYTES
    with _laspy_as_input_error(path, promise, [0]), laspy.open(source_of(path), read_evlrs=evlrs) as reader:
        stated = read_las_crs(reader.header)
    bounds = _box_of_points(path, promise) if promise.has_void_box else promise.bounds
    differs = not np.allclose(bounds, promise.bounds, rtol=0.0, atol=HEADER_SLACK)
    return CloudHeader(
        path,
        promise.n_points,
        bounds,
        stated.crs,
        stated.plan_unit,
        stated.height_unit,
        stated.unread,
        promise.n_points > 0 and differs,
    )


def read_points(path: str | Path, bounds: Box, *, frame: Frame = AS_IT_IS) -> tuple[PointCloud, dict[str, int]]:
    """Read the usable points of a file within a box (step 1.1).

    Dropped are, in this order: points outside the box, withheld points, the noise classes 7 and 18, and
    points with a height that is not within ±10 km.

    Parameters
    ----------
    path : str or Path
        LAS, LAZ or COPC file.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax in the region's CRS (m); the borders belong to the box.
    frame : Frame
        How coordinates of the file become those of the region.

    Returns
    -------
    PointCloud
        The kept points in the order of the file; possibly none.
    dict of str to int
        ``read`` = ``outside`` + ``withheld`` + ``noise`` + ``absurd`` + ``kept``; each point counts once.
        Where there are any, ``key points`` are those of ``read`` with the class of model key points: ground.

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
    counts = dict.fromkeys(COUNTED, 0)
    places, classes = [np.empty((0, 3))], [np.empty(0, np.uint8)]
    for chunk in _place(path, promise, _chunks(path, promise), frame):
        kept = select_usable(chunk, bounds, counts)
        places.append(coordinates_of(chunk)[kept])
        classes.append(chunk.classification[kept])
    return PointCloud(np.concatenate(places), np.concatenate(classes)), counts


def read_chunks(path: Path, bounds: Box, *, frame: Frame = AS_IT_IS) -> Iterator[tuple[PointChunk, int]]:
    """Read a file by chunks, without those parts of a COPC file that are away from a box.

    Parameters
    ----------
    path : Path
        LAS, LAZ or COPC file.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax in the region's CRS (m).
    frame : Frame
        How coordinates of the file become those of the region.

    Yields
    ------
    PointChunk
        Some million points in the region's CRS, in the order of the file; the first chunk may be empty, others are
        not.
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
    n_skipped, chunks = 0, _chunks(path, promise)
    if promise.n_points and not promise.has_void_box:
        near = box_to_file(frame, bounds)
        index = read_index(path, promise) if _share(promise, near) < QUERY_SHARE else None
        if index is not None:
            wanted = _near(index.box, near)
            n_skipped, chunks = int(index.count[~wanted].sum()), _query(path, promise, index, wanted)
    placed = _place(path, promise, chunks, frame)
    first = next(placed, None)
    if first is None:
        with _laspy_as_input_error(path, promise, [0]), laspy.open(source_of(path), read_evlrs=False) as reader:
            empty = take_chunk(laspy.ScaleAwarePointRecord.zeros(0, header=reader.header))
        yield empty, n_skipped
        return
    yield first, n_skipped
    for chunk in placed:
        yield chunk, 0


def select_usable(chunk: PointChunk, bounds: Box, counts: dict[str, int]) -> NDArray[np.bool_]:
    """Select the usable points of a chunk, and count what became of each.

    Parameters
    ----------
    chunk : PointChunk
        Points of a file in the region's CRS, n of them.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax (m); the borders belong to the box.
    counts : dict of str to int
        The counts of `read_points`; this chunk's are added.

    Returns
    -------
    bool, (n,)
        Which points to keep.
    """
    verdict = judge_points(
        chunk.x, chunk.y, chunk.z, chunk.scale, chunk.offset, chunk.classification, chunk.withheld, bounds
    )
    for reason, number in zip(REASONS, count_values(verdict)[: len(REASONS)].tolist(), strict=True):
        counts[reason] += number
    counts["read"] += len(chunk)
    if chunk.n_key_points:
        counts[KEY_POINTS] = counts.get(KEY_POINTS, 0) + chunk.n_key_points
    return np.asarray(verdict == KEPT)


def _place(path: Path, promise: LasPromise, chunks: Iterator[PointChunk], frame: Frame) -> Iterator[PointChunk]:
    """Give chunks in the region's CRS."""
    if frame == AS_IT_IS:
        yield from chunks
        return
    box = promise.bounds[:4]
    if frame.source and promise.has_void_box:
        box = _box_of_points(path, promise)[:4]
    middle = (0.0, 0.0)
    if frame.source and promise.n_points:
        xmin, ymin, xmax, ymax = box_to_region(frame, box)
        middle = (xmin + xmax) / 2, (ymin + ymax) / 2
    for chunk in chunks:
        yield place_chunk(chunk, frame, middle)


def _box_of_points(path: Path, promise: LasPromise) -> tuple[float, float, float, float, float, float]:
    """Read all points of a file for their box, in the file's CRS."""
    ends = np.concatenate([ends_of(chunk) for chunk in _chunks(path, promise)])
    (xmin, ymin, zmin), (xmax, ymax, zmax) = ends.min(axis=0).tolist(), ends.max(axis=0).tolist()
    return xmin, ymin, xmax, ymax, zmin, zmax


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


def _chunks(path: Path, promise: LasPromise) -> Iterator[PointChunk]:
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
            record = reader.read_points(step)
            if len(record) == 0:
                break
            n_read[0] += len(record)
            chunk = take_chunk(record)
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


def _query(path: Path, promise: LasPromise, index: CopcIndex, near: NDArray[np.bool_]) -> Iterator[PointChunk]:
    n_read = [0]
    with _laspy_as_input_error(path, promise, n_read):
        for chunk in read_nodes(path, index, near, step=_step(promise)):
            n_read[0] += len(chunk)
            _check_within_header(path, promise, chunk)
            yield chunk


def _step(promise: LasPromise) -> int:
    return max(1, min(CHUNK_POINTS, CHUNK_BYTES // promise.point_size))


def _check_within_header(path: Path, promise: LasPromise, chunk: PointChunk) -> None:
    if promise.has_void_box:
        return
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
