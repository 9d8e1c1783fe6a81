"""LAS headers as laspy reads them, once the counts that it would believe fit in the file (step 1.1)."""

import math
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import laspy

from pipeline.data.errors import InputError, OutputError

COORDINATE_LIMIT = 1e8  # m; beyond it no projected CRS has coordinates
SCALE_LIMIT = 100.0  # units of the file for one step of the stored integers
AGAIN = "copy the file again or leave it out with --skip-unreadable"

Box3 = tuple[float, float, float, float, float, float]

# Byte sizes of ASPRS LAS 1.4 R15, tables 3, 5 and 6.
_HEADER, _LAS_14_HEADER = 227, 375
_VLR_HEADER, _EVLR_HEADER = 54, 60
# Points that a LAZ file may claim: these, and so many for each byte of compressed points. Surveys have less than
# 0.4 points a byte, a made-up plane with noise 2, copies of one point 100; reading any claim would take years.
FREE_POINTS = 2_000_000
POINTS_PER_BYTE = 16
# Bytes of the records before the points, and of those behind them that are read: a CRS takes some kilobytes.
# Waveforms behind the points may be larger, and are left alone.
RECORD_BYTES = 64_000_000
_MANY_RECORDS = 1_000_000
_EMPTY_LAZ = 1000  # what follows the header of a LAZ file without points is shorter than this


_POINTS = laspy.PointFormat(3)


class _Header(laspy.LasHeader):  # type: ignore[misc]  # laspy has no types
    """A header to be filled by `read_from`: laspy makes it with a deep copy of a format, half of the time."""

    def __init__(self) -> None:
        super().__init__(point_format=_POINTS)


def read_las_header(path: Path, *, evlrs: bool = False) -> laspy.LasHeader:
    """Read the header of a LAS, LAZ or COPC file, and refuse what the file cannot hold.

    `evlrs`: the records behind the points are read too, where they have no more than `RECORD_BYTES`.

    Raises
    ------
    InputError
        If the file is missing, is not LAS, is shorter than its header claims, or has a scale or an offset that is
        not finite or absurd.

    References
    ----------
    ASPRS LAS 1.4 R15, section 2.4; LASzip: the point data begin with the byte offset of the chunk table.
    """
    with laspy_as_input_error(path, lambda: "the header cannot be read"):
        try:
            with path.open("rb") as file:
                size = file.seek(0, os.SEEK_END)
                end, n_behind = _check_records(path, file, size)
                file.seek(0)
                header = _Header.read_from(file)
                if evlrs and n_behind <= RECORD_BYTES:
                    header.read_evlrs(file)
                _check_points(path, header, end - header.offset_to_point_data)
                if header.are_points_compressed and header.point_count:
                    _check_chunk_table(path, header, file, size)
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(f"{path}: cannot be read ({reason}); check the path and its permissions") from error
    return header


def box_of_header(header: laspy.LasHeader) -> Box3:
    """Give xmin, ymin, xmax, ymax, zmin, zmax of a header in the file's CRS; all NaN without points."""
    if header.point_count == 0:
        return (math.nan,) * 6
    (xmin, ymin, zmin), (xmax, ymax, zmax) = header.mins.tolist(), header.maxs.tolist()
    return xmin, ymin, xmax, ymax, zmin, zmax


def has_void_box(header: laspy.LasHeader) -> bool:
    """Return whether the box of a header cannot be that of its points: laspy gives it as written.

    An end is exactly 0, as writers leave what they did not know, or the ends are no interval.
    """
    if header.point_count == 0:
        return False
    ends = list(zip(header.mins.tolist(), header.maxs.tolist(), strict=True))
    plan = ends[:2]
    return (
        any(not low <= high or not math.isfinite(high - low) for low, high in ends)  # NaN too
        or (header.point_count > 1 and any(low == high for low, high in plan))
        or any(value == 0 or abs(value) > COORDINATE_LIMIT for pair in plan for value in pair)
    )


@contextmanager
def laspy_as_input_error(path: Path, what: Callable[[], str]) -> Iterator[None]:
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
        raise InputError(f"{path}: {what()} ({type(error).__name__}: {error}); {AGAIN}") from error


def _check_records(path: Path, file: BinaryIO, size: int) -> tuple[int, int]:
    """Follow the records before and behind the points; gives where the points end, and the bytes of those behind.

    laspy reads as many records as a header counts, and as many bytes as a record claims: 2^31 empty ones, or all
    the waveforms of a flight.
    """
    file.seek(0)
    head = file.read(_LAS_14_HEADER)
    if head[:4] != b"LASF":
        raise InputError(f"{path}: is no LAS or LAZ file: it begins with {head[:4]!r}, not b'LASF'; leave it out")
    extended = head[25:26] >= b"\4"
    if len(head) < (_LAS_14_HEADER if extended else _HEADER):
        raise InputError(f"{path}: ends at byte {size}, within its header; {AGAIN}")
    header_size, begin, n_vlrs = struct.unpack_from("<HII", head, 94)
    if not header_size + n_vlrs * _VLR_HEADER <= begin <= size:
        raise InputError(
            f"{path}: header of {header_size} bytes, {n_vlrs} records, points from byte {begin}, but it "
            f"has {size} bytes; {AGAIN}"
        )
    if begin - header_size > RECORD_BYTES:
        raise InputError(f"{path}: {begin - header_size} bytes of records > {RECORD_BYTES}; {AGAIN}")
    end = _follow(file, header_size, n_vlrs, _VLR_HEADER, 2, begin)
    if end > begin:
        raise InputError(f"{path}: its {n_vlrs} records end at byte {end}, points begin at {begin}; {AGAIN}")
    first, n_evlrs = struct.unpack_from("<QI", head, 235) if extended else (size, 0)
    if n_evlrs == 0:
        return size, 0
    if not begin <= first <= size - n_evlrs * _EVLR_HEADER:
        raise InputError(
            f"{path}: {n_evlrs} extended records from byte {first}, but the file has {size} bytes; {AGAIN}"
        )
    if n_evlrs > _MANY_RECORDS:
        raise InputError(f"{path}: {n_evlrs} extended records > {_MANY_RECORDS}; {AGAIN}")
    end = _follow(file, first, n_evlrs, _EVLR_HEADER, 8, size)
    if end > size:
        raise InputError(f"{path}: its {n_evlrs} extended records end at byte {end} of {size}; {AGAIN}")
    return first, end - first


def _follow(file: BinaryIO, place: int, n: int, n_header: int, n_length: int, limit: int) -> int:
    """Give the byte behind n records of which each states its length, or behind the first beyond the limit."""
    for _ in range(n):
        file.seek(place + 20)
        place += n_header + int.from_bytes(file.read(n_length), "little")
        if place > limit:
            break
    return place


def _check_points(path: Path, header: laspy.LasHeader, n_bytes: int) -> None:
    n = header.point_count
    if n == 0 and n_bytes >= _EMPTY_LAZ:  # laspy gives an empty cloud
        raise InputError(
            f"{path}: the header claims 0 points, but {n_bytes} bytes follow it: its writer did not finish; "
            f"{AGAIN}"
        )
    if n == 0:
        return
    most = FREE_POINTS + POINTS_PER_BYTE * n_bytes
    if header.are_points_compressed and n > most:  # lazrs goes on making up points from the bytes behind
        raise InputError(
            f"{path}: none of {n} points could be read: {n_bytes} bytes are believed to hold "
            f"at most {most} ({POINTS_PER_BYTE} a byte and {FREE_POINTS}); {AGAIN}"
        )
    held = n_bytes // header.point_format.size
    if not header.are_points_compressed and held < n:  # laspy gives fewer, and logs it
        raise InputError(f"{path}: {held} of {n} points could be read: the file ends early; {AGAIN}")
    for axis, scale, offset in zip("xyz", header.scales, header.offsets, strict=True):  # laspy multiplies by NaN
        if not 0 < scale <= SCALE_LIMIT:
            raise InputError(f"{path}: {axis} scale {scale:g} is not within 0 to {SCALE_LIMIT:g}; {AGAIN}")
        if not abs(offset) <= COORDINATE_LIMIT:
            raise InputError(f"{path}: {axis} offset {offset:g} is not within ±{COORDINATE_LIMIT:g} m; {AGAIN}")


def _check_chunk_table(path: Path, header: laspy.LasHeader, file: BinaryIO, size: int) -> None:
    """Find the chunk table of a LAZ file: it is written last, so a file that was cut off has none.

    lazrs finds that out after all points were read, and takes memory for as many chunks as are stated.
    """
    begin = header.offset_to_point_data
    table = _read_int64(file, begin)
    if table == -1:  # the file was written as a stream, and the place is in its last 8 bytes
        table = _read_int64(file, size - 8)
    if not begin + 8 < table <= size - 8:
        raise InputError(
            f"{path}: 0 of {header.point_count} points could be read: the file ends at byte {size}, its chunk "
            f"table should begin at byte {table}; {AGAIN}"
        )
    file.seek(table + 4)
    n_chunks = int.from_bytes(file.read(4), "little")
    if n_chunks > table - begin:
        raise InputError(f"{path}: {n_chunks} chunks in {table - begin} bytes of points; {AGAIN}")


def _read_int64(file: BinaryIO, place: int) -> int:
    file.seek(place)
    return int.from_bytes(file.read(8), "little", signed=True)
