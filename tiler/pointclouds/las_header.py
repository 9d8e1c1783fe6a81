"""What a LAS header promises, checked against the file itself before a library trusts it (step 1.1)."""

import math
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pipeline.errors import InputError

COORDINATE_LIMIT = 1e8  # m; beyond it no projected CRS has coordinates
SCALE_LIMIT = 100.0  # units of the file for one step of the stored integers
AGAIN = "copy the file again or leave it out with --skip-unreadable"

# Byte sizes of ASPRS LAS 1.4 R15, tables 3, 5 and 6.
_SHORTEST_HEADER = 227
_LONGEST_HEADER = 375
_VLR_HEADER = 54
_EVLR_HEADER = 60
_COMPRESSED = 0x40  # LASzip sets the upper bits of the point format
# Points that a LAZ file may claim: these, and so many for each byte of compressed points. Surveys have less than
# 0.4 points a byte, a made-up plane with noise 2, copies of one point 100; reading any claim would take years.
FREE_POINTS = 2_000_000
POINTS_PER_BYTE = 16
# Bytes of the records before the points, and of those behind them that are read: a CRS takes some kilobytes.
# Waveforms behind the points may be larger, and are left alone.
RECORD_BYTES = 64_000_000
_MANY_RECORDS = 1_000_000
_RETURN_BYTES = 20  # of the shortest point, format 0
_EMPTY_LAZ = 1000  # what follows the header of a LAZ file without points is shorter than this


@dataclass(frozen=True)
class LasPromise:
    """The fixed fields of a LAS header that decide what has to be read.

    Attributes
    ----------
    n_points : int
        Number of points that the header claims.
    point_size : int
        Bytes of one uncompressed point.
    compressed : bool
        Whether the points are LAZ.
    bounds : tuple of 6 floats
        xmin, ymin, xmax, ymax, zmin, zmax in the file's CRS; all NaN if there are no points.
    extended : int
        Bytes of the records behind the points.
    has_void_box : bool
        Whether `bounds` cannot be the box of the points: an end is exactly 0, as writers leave what they did not
        know, or the ends are no interval. The points tell then.
    """

    n_points: int
    point_size: int
    compressed: bool
    bounds: tuple[float, float, float, float, float, float]
    extended: int = 0
    has_void_box: bool = False


def read_promise(path: Path) -> LasPromise:
    """Read a LAS/LAZ header and refuse what the file cannot hold.

    Libraries believe the counts of a header: one wrong field makes them allocate without end. So every
    count is compared with the size of the file first.

    Parameters
    ----------
    path : Path
        LAS, LAZ or COPC file.

    Returns
    -------
    LasPromise

    Raises
    ------
    InputError
        If the file is missing, is not LAS, is shorter than its header claims, or has a scale, an offset or
        bounds that are not finite or absurd.

    References
    ----------
    ASPRS LAS 1.4 R15, section 2.4; LASzip: the point data begin with the byte offset of the chunk table.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            head = file.read(_LONGEST_HEADER)
            begin, end = _point_bytes(path, head, size)
            promise = _parse(path, head, _check_records(path, head, file, size))
            _check_finished(path, promise, end - begin)
            if promise.compressed and promise.n_points:
                _check_chunk_table(path, promise, file, begin, size)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check the path and its permissions") from error
    return promise


def _point_bytes(path: Path, head: bytes, size: int) -> tuple[int, int]:
    """Give the first byte of the point data and the byte behind the last."""
    if head[:4] != b"LASF":
        raise InputError(f"{path}: is no LAS or LAZ file: it begins with {head[:4]!r}, not b'LASF'; leave it out")
    shortest = _LONGEST_HEADER if head[25:26] >= b"\4" else _SHORTEST_HEADER
    if len(head) < shortest:
        raise InputError(f"{path}: ends at byte {size}, within its {shortest}-byte header; {AGAIN}")
    header_size, begin, n_vlrs = struct.unpack_from("<HII", head, 94)
    if not header_size + n_vlrs * _VLR_HEADER <= begin <= size:
        raise InputError(
            f"{path}: header of {header_size} bytes, {n_vlrs} records, points from byte {begin}, but it "
            f"has {size} bytes; {AGAIN}"
        )
    first_evlr, n_evlrs = struct.unpack_from("<QI", head, 235) if head[25] >= 4 else (0, 0)
    if n_evlrs == 0:
        return begin, size
    if not begin <= first_evlr <= size - n_evlrs * _EVLR_HEADER:
        raise InputError(
            f"{path}: {n_evlrs} extended records from byte {first_evlr}, but the file has {size} bytes; {AGAIN}"
        )
    return begin, first_evlr


def _check_records(path: Path, head: bytes, file: BinaryIO, size: int) -> int:
    """Follow the records before and behind the points by their lengths; returns the bytes of those behind."""
    header_size, begin, n_vlrs = struct.unpack_from("<HII", head, 94)
    if begin - header_size > RECORD_BYTES:
        raise InputError(f"{path}: {begin - header_size} bytes of records > {RECORD_BYTES}; {AGAIN}")
    place = header_size
    for k in range(n_vlrs):
        file.seek(place + 20)
        place += _VLR_HEADER + int.from_bytes(file.read(2), "little")
        if place > begin:
            raise InputError(
                f"{path}: record {k + 1} of {n_vlrs} ends at byte {place}, points begin at {begin}; {AGAIN}"
            )
    if head[25] < 4:
        return 0
    first, n_evlrs = struct.unpack_from("<QI", head, 235)
    if n_evlrs > _MANY_RECORDS:
        raise InputError(f"{path}: {n_evlrs} extended records > {_MANY_RECORDS}; {AGAIN}")
    place = first
    for k in range(n_evlrs):
        file.seek(place + 20)
        place += _EVLR_HEADER + int.from_bytes(file.read(8), "little")
        if place > size:
            raise InputError(
                f"{path}: extended record {k + 1} of {n_evlrs} ends at byte {place} of {size}; {AGAIN}"
            )
    return place - first if n_evlrs else 0


def _parse(path: Path, head: bytes, extended: int) -> LasPromise:
    point_format, point_size, n_points = struct.unpack_from("<BHI", head, 104)
    if head[25] >= 4:
        n_points = struct.unpack_from("<Q", head, 247)[0]
    if point_size < _RETURN_BYTES:
        raise InputError(
            f"{path}: the header gives a point {point_size} bytes, the least point size is {_RETURN_BYTES}; "
            f"{AGAIN}"
        )
    bounds, void = _bounds(path, head, n_points)
    return LasPromise(n_points, point_size, point_format >= _COMPRESSED, bounds, extended, void)


def _bounds(
    path: Path, head: bytes, n_points: int
) -> tuple[tuple[float, float, float, float, float, float], bool]:
    """Give the box, and whether it is void."""
    scales = struct.unpack_from("<3d", head, 131)
    offsets = struct.unpack_from("<3d", head, 155)
    xmax, xmin, ymax, ymin, zmax, zmin = struct.unpack_from("<6d", head, 179)
    if n_points == 0:
        return (float("nan"),) * 6, False
    for axis, scale, offset in zip("xyz", scales, offsets, strict=True):
        if not 0 < scale <= SCALE_LIMIT:  # NaN fails too
            raise InputError(f"{path}: {axis} scale {scale:g} is not within 0 to {SCALE_LIMIT:g}; {AGAIN}")
        if not abs(offset) <= COORDINATE_LIMIT:
            raise InputError(f"{path}: {axis} offset {offset:g} is not within ±{COORDINATE_LIMIT:g} m; {AGAIN}")
    ends = (xmin, xmax), (ymin, ymax), (zmin, zmax)
    void = any(not low <= high or not math.isfinite(high - low) for low, high in ends)  # NaN too
    void |= n_points > 1 and (xmin == xmax or ymin == ymax)
    void |= any(value == 0 or abs(value) > COORDINATE_LIMIT for value in (xmin, xmax, ymin, ymax))
    return (xmin, ymin, xmax, ymax, zmin, zmax), void


def _check_finished(path: Path, promise: LasPromise, n_bytes: int) -> None:
    if promise.n_points == 0 and n_bytes >= _EMPTY_LAZ:
        raise InputError(
            f"{path}: the header claims 0 points, but {n_bytes} bytes follow it: its writer did not finish; "
            f"{AGAIN}"
        )
    most = FREE_POINTS + POINTS_PER_BYTE * n_bytes
    if promise.compressed and promise.n_points > most:
        raise InputError(
            f"{path}: none of {promise.n_points} points could be read: {n_bytes} bytes are believed to hold "
            f"at most {most} ({POINTS_PER_BYTE} a byte and {FREE_POINTS}); {AGAIN}"
        )
    held = n_bytes // promise.point_size
    if not promise.compressed and held < promise.n_points:
        raise InputError(
            f"{path}: {held} of {promise.n_points} points could be read: the file ends early; {AGAIN}"
        )


def _check_chunk_table(path: Path, promise: LasPromise, file: BinaryIO, begin: int, size: int) -> None:
    """Find the chunk table of a LAZ file: it is written last, so a file that was cut off has none."""
    table = _read_int64(file, begin)
    if table == -1:  # the file was written as a stream, and the place is in its last 8 bytes
        table = _read_int64(file, size - 8)
    if not begin + 8 < table <= size - 8:
        raise InputError(
            f"{path}: 0 of {promise.n_points} points could be read: the file ends at byte {size}, its chunk "
            f"table should begin at byte {table}; {AGAIN}"
        )
    file.seek(table + 4)
    n_chunks = int.from_bytes(file.read(4), "little")
    if n_chunks > table - begin:
        raise InputError(f"{path}: {n_chunks} chunks in {table - begin} bytes of points; {AGAIN}")


def _read_int64(file: BinaryIO, place: int) -> int:
    file.seek(place)
    return int.from_bytes(file.read(8), "little", signed=True)
