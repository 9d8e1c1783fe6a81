"""Well-known binary from files, parsed only where its sizes and its nesting can do no harm (step 1.2)."""

import struct
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.vectors.features import to_objects

# GEOS descends into nested geometries by recursion and ends the process where the stack ends: 10,000 levels do.
DEEPEST = 8  # levels of collections; polygons of a multipolygon are two
# A level takes 9 bytes, so that shorter blobs have less than 500 levels, which any stack holds.
_SHORT = 4096  # bytes
_POINT, _LINE, _POLYGON, _MULTIPOLYGON, _COLLECTION = 1, 2, 3, 6, 7
_MULTI = (4, 5, _MULTIPOLYGON, _COLLECTION)
_CURVES = range(8, 15)
# What GEOS knows polyhedral surfaces, TINs and triangles as: the bytes behind their kind are the same.
_SURFACES = {15: _MULTIPOLYGON, 16: _MULTIPOLYGON, 17: _POLYGON}

_ENVELOPES = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}  # bytes by the code in the header of a GeoPackage's geometry


def strip_header(blob: object) -> tuple[bytes | None, str]:
    """Take the header of a GeoPackage's geometry away; None and the reason where there is no sound one."""
    if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
        return None, "has no header of a GeoPackage"
    envelope = _ENVELOPES.get(blob[3] >> 1 & 7)
    return (None, "has a header of an unknown kind") if envelope is None else (blob[8 + envelope :], "")


def parse_wkb(wkb: NDArray[np.object_]) -> tuple[NDArray[np.object_], set[int], dict[int, str]]:
    """Parse geometries of unknown origin.

    Parameters
    ----------
    wkb : object, (n,)
        Well-known binary, ISO or EWKB, None where there is none.

    Returns
    -------
    geometry : object, (n,)
        Geometries, rings closed; None where there is none, or where it cannot be parsed.
    surfaces : set of int
        Rows of polyhedral surfaces, TINs, triangles, and of collections that hold one: now polygons.
    broken : dict of int to str
        Why a geometry cannot be parsed, by row: it is damaged, a curve, or nested deeper than `DEEPEST`.

    References
    ----------
    OGC 06-103r4, section 8.2; the flags of EWKB as PostGIS writes them.
    """
    plain, surfaces, broken = wkb.copy(), set[int](), dict[int, str]()
    for row, blob in enumerate(wkb):
        try:
            if blob is not None and not _is_harmless(blob):
                plain[row], has_surface = _make_plain(blob)
                surfaces |= {row} if has_surface else set()
        except struct.error:
            plain[row], broken[row] = None, "its geometry cannot be parsed: it is cut off"
        except ValueError as error:
            plain[row], broken[row] = None, f"its geometry cannot be parsed: {error}"
    with np.errstate(invalid="ignore"):  # GEOS compares NaN coordinates
        try:
            geometry = np.asarray(shapely.from_wkb(plain, on_invalid="fix"), np.object_)
        except NotImplementedError:  # a multipolygon holds a curve, and shapely gives none of them
            geometry = np.array([_parse_one(blob) for blob in plain], np.object_)
    for row in np.flatnonzero(shapely.is_missing(geometry)).tolist():
        if wkb[row] is not None:
            broken.setdefault(row, "its geometry cannot be parsed")
    return geometry, surfaces, broken


def join_blobs(blobs: Sequence[bytes]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Put bytes one behind the other: uint8 (k,), and where each begins and the last ends, int64 (n + 1,)."""
    return np.frombuffer(b"".join(blobs), np.uint8), np.cumsum([0, *map(len, blobs)], dtype=np.int64)


def cut_blobs(data: NDArray[np.uint8], start: NDArray[np.int64]) -> NDArray[np.object_]:
    """Give the bytes that `join_blobs` joined, or of a range of them: the first start is that of the data."""
    whole, ends = data.tobytes(), (start - start[0]).tolist()
    return to_objects([whole[first:last] for first, last in pairwise(ends)])


def is_curve(blob: bytes | None) -> bool:
    """Whether a geometry is a curve or has curves for its sides."""
    return blob is not None and len(blob) >= 5 and _read_header(blob, 0)[0] in _CURVES


def _parse_one(blob: bytes | None) -> shapely.Geometry | None:
    try:
        return shapely.from_wkb(blob, on_invalid="fix")
    except NotImplementedError:
        return None


def _is_harmless(blob: bytes) -> bool:
    kind = _read_header(blob, 0)[0]
    return kind <= _POLYGON or (kind <= _MULTIPOLYGON and len(blob) < _SHORT)


def _read_header(blob: bytes, place: int) -> tuple[int, int, str, int, int]:
    """Read what stands before each part: kind, code, byte order of `struct`, numbers of a vertex, its end."""
    order = "<" if blob[place : place + 1] == b"\x01" else ">"
    (code,) = struct.unpack_from(order + "I", blob, place + 1)
    has_z, has_m, number = bool(code & 0x80000000), bool(code & 0x40000000), code & 0x0FFFFFFF
    has_z, has_m = has_z or number // 1000 in (1, 3), has_m or number // 1000 in (2, 3)
    return number % 1000, code, order, 2 + has_z + has_m, place + (9 if code & 0x20000000 else 5)


def _make_plain(blob: bytes) -> tuple[bytes, bool]:
    """Walk through all parts, and name surfaces as GEOS knows them; an error at what does harm."""
    plain, place, left, has_surface = bytearray(blob), 0, [1], False
    while left:
        if left[-1] == 0:
            left.pop()
            continue
        left[-1] -= 1
        kind, code, order, width, stop = _read_header(blob, place)
        if kind in _SURFACES:
            struct.pack_into(order + "I", plain, place + 1, code - kind + _SURFACES[kind])
            kind, has_surface = _SURFACES[kind], True
        if kind == _POINT:
            place = stop + 8 * width
            continue
        (count,) = struct.unpack_from(order + "I", blob, stop)
        place = stop + 4
        if kind == _LINE:
            place += 8 * width * count
        elif kind == _POLYGON:
            for _ in range(count):
                (length,) = struct.unpack_from(order + "I", blob, place)
                place += 4 + 8 * width * length
        elif kind in _MULTI:
            left.append(count)
        else:
            raise ValueError(f"a part of type {kind} is not known here")
        if len(left) > DEEPEST:
            raise ValueError(f"collections nest deeper than {DEEPEST} levels")
    if place > len(blob):
        raise ValueError(f"claims {place} bytes, has {len(blob)}")
    return bytes(plain), has_surface
