"""Well-known binary from files, parsed only where its nesting cannot exhaust the stack (step 1.2)."""

import struct
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

# GEOS descends into nested geometries by recursion and ends the process where the stack ends: 10,000 levels do.
DEEPEST = 8  # levels of collections; polygons of a multipolygon are two
# A level takes 9 bytes, so that shorter blobs have less than 500 levels, which any stack holds.
_SHORT = 4096  # bytes
_POLYGON, _COLLECTIONS = 3, (4, 5, 6, 7)
_LEAVES = (1, 2, 3)


class Header(NamedTuple):
    """What stands before each geometry and each part of one.

    Attributes
    ----------
    kind : int
        Type without its flags: 1 point to 17 triangle.
    order : str
        ``"<"`` or ``">"``, as `struct` has it.
    dimensions : int
        Numbers of a vertex.
    has_z : bool
        Whether the third of them is Z.
    stop : int
        First byte behind the header.
    """

    kind: int
    order: str
    dimensions: int
    has_z: bool
    stop: int


def read_header(blob: bytes, place: int) -> Header:
    """Read the header of a geometry, ISO or EWKB; struct.error where the blob ends in it."""
    order = "<" if blob[place : place + 1] == b"\x01" else ">"
    (code,) = struct.unpack_from(order + "I", blob, place + 1)
    place += 5
    if code & 0x20000000:
        place += 4
    has_z, has_m = bool(code & 0x80000000), bool(code & 0x40000000)
    code &= 0x0FFFFFFF
    has_z, has_m = has_z or code // 1000 in (1, 3), has_m or code // 1000 in (2, 3)
    return Header(code % 1000, order, 2 + has_z + has_m, has_z, place)


def parse_wkb(wkb: NDArray[np.object_]) -> NDArray[np.object_]:
    """Parse geometries of unknown origin.

    Parameters
    ----------
    wkb : object, (n,)
        Well-known binary, None where there is none.

    Returns
    -------
    object, (n,)
        Geometries, rings closed; None where there is none, where it cannot be parsed or is a curve or surface (see
        `tiler.vectors.wkb_shapes`), and where collections are nested deeper than `DEEPEST` in more than 4 kB.

    References
    ----------
    OGC 06-103r4, section 8.2; the flags of EWKB as PostGIS writes them.
    """
    flat = np.array([blob if blob is None or is_flat(blob) else None for blob in wkb], np.object_)
    with np.errstate(invalid="ignore"):  # GEOS compares NaN coordinates
        try:
            return np.asarray(shapely.from_wkb(flat, on_invalid="fix"), np.object_)
        except NotImplementedError:  # one is a curve, and shapely gives none of them
            return np.array([_parse_one(blob) for blob in flat], np.object_)


def _parse_one(blob: bytes | None) -> shapely.Geometry | None:
    try:
        return shapely.from_wkb(blob, on_invalid="fix")
    except NotImplementedError:
        return None


def is_flat(blob: bytes) -> bool:
    """Whether a geometry can be parsed by recursion without harm.

    Examples
    --------
    >>> is_flat(shapely.to_wkb(shapely.Point(0, 0)))
    True
    >>> is_flat(struct.pack("<BII", 1, 7, 1) * 1000)
    False
    """
    if len(blob) < _SHORT:
        return True
    try:
        kind = read_header(blob, 0).kind
        return kind == _POLYGON or kind in _LEAVES or (kind in _COLLECTIONS and _walk(blob))
    except struct.error:
        return False


def _walk(blob: bytes) -> bool:
    """Walk through all parts; False where they nest too deep or have kinds without a known length."""
    place, left = 0, [1]
    while left:
        if left[-1] == 0:
            left.pop()
            continue
        left[-1] -= 1
        header = read_header(blob, place)
        kind, order, width, place = header.kind, header.order, 8 * header.dimensions, header.stop
        if kind == 1:
            place += width
            continue
        (count,) = struct.unpack_from(order + "I", blob, place)
        place += 4
        if kind in _COLLECTIONS:
            left.append(count)
            if len(left) > DEEPEST:
                return False
        elif kind == 2:
            place += count * width
        elif kind == _POLYGON:
            for _ in range(count):
                (length,) = struct.unpack_from(order + "I", blob, place)
                place += 4 + length * width
        else:
            return False
    return place <= len(blob)
