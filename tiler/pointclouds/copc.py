"""COPC: the nodes of a file's octree that meet a box, each read once (step 1.1)."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import LasZipVlr
from numpy.typing import NDArray

from pipeline.errors import InputError
from tiler.pointclouds.las_chunks import PointChunk, coordinates_of, take_chunk
from tiler.pointclouds.las_header import AGAIN, LasPromise

# m that a point may lie outside its node, or a node's box outside the octree's cube.
NODE_SLACK = 1.0

_INFO = struct.Struct("<5d2Q2d")  # centre x y z, half side, spacing; page offset, page size; GPS time
_MANY_BYTES = 2**30  # of one node, uncompressed; writers put some 10^5 points of 30 to 60 bytes there
_ENTRY = np.dtype(
    [
        ("level", "<i4"),
        ("key", "<i4", 3),
        ("offset", "<u8"),
        ("size", "<i4"),
        ("count", "<i4"),
    ]
)


@dataclass(frozen=True, eq=False)
class CopcIndex:
    """The nodes of a COPC file that hold points, in the order of the file.

    Attributes
    ----------
    box : float64, (n, 4)
        xmin, ymin, xmax, ymax of each node (m).
    offset, size : int64, (n,)
        First byte and number of bytes of the node's points.
    count : int64, (n,)
        Number of points.
    """

    box: NDArray[np.float64]
    offset: NDArray[np.int64]
    size: NDArray[np.int64]
    count: NDArray[np.int64]


def read_index(path: Path, promise: LasPromise) -> CopcIndex | None:
    """Read the octree of a COPC file.

    Parameters
    ----------
    path : Path
        LAS, LAZ or COPC file; known by its content, not by its name.
    promise : LasPromise
        Its header, from `read_promise`.

    Returns
    -------
    CopcIndex or None
        None for a file that is no COPC, and for one whose octree cannot be trusted: pages or nodes beyond
        the file, nodes that do not add up to the header's points, or a cube that does not hold the header's
        bounds. Such a file can still be read from end to end.

    References
    ----------
    COPC 1.0, sections "Info VLR" and "Hierarchy VLR".
    """
    with path.open("rb") as file:
        head = file.read(375 + 54 + _INFO.size)
        if len(head) < 375 + 54 + _INFO.size or head[377:381] != b"copc" or promise.n_points == 0:
            return None
        x, y, _, half, _, place, length, _, _ = _INFO.unpack_from(head, 375 + 54)
        n_bytes = file.seek(0, 2)
        total = 0
        todo, seen, pages = [(place, length)], {place}, []
        while todo:
            place, length = todo.pop()
            total += length
            if not (0 < length <= n_bytes and 0 <= place <= n_bytes - length and total <= n_bytes):
                return None
            file.seek(place)
            page = np.frombuffer(file.read(length - length % _ENTRY.itemsize), _ENTRY)
            below = page[page["count"] == -1]
            found = [(int(row["offset"]), int(row["size"])) for row in below if int(row["offset"]) not in seen]
            todo += found
            seen.update(offset for offset, _ in found)
            pages.append(page[page["count"] > 0])
    nodes = np.concatenate(pages)
    nodes = nodes[np.argsort(nodes["offset"], kind="stable")]
    index = _index(nodes, np.array([x - half, y - half]), 2 * half)
    return index if _fits(index, nodes, promise, n_bytes, (x, y, half)) else None


def read_nodes(path: Path, index: CopcIndex, wanted: NDArray[np.bool_], *, step: int) -> Iterator[PointChunk]:
    """Read the points of some nodes.

    Parameters
    ----------
    path : Path
        The file.
    index : CopcIndex
        Its octree.
    wanted : bool, (n,)
        Which nodes.
    step : int
        Points to read at once, or those of one node if that has more.

    Yields
    ------
    PointChunk
        Points in the order of the file, in its CRS.

    Raises
    ------
    InputError
        If points lie more than 1 m outside their node: a box would not find them.
    """
    rows = np.flatnonzero(wanted)
    batch = (np.cumsum(index.count[rows]) - index.count[rows]) // step
    with path.open("rb") as file:
        header = laspy.LasHeader.read_from(file)
        zipped = next(vlr for vlr in header.vlrs if isinstance(vlr, LasZipVlr)).record_data
        for part in np.split(rows, np.flatnonzero(np.diff(batch)) + 1):
            blobs = [_read_bytes(file, int(index.offset[row]), int(index.size[row])) for row in part]
            table = [(int(index.count[row]), int(index.size[row])) for row in part]
            raw = np.zeros(int(index.count[part].sum()) * header.point_format.size, np.uint8)
            lazrs.decompress_points_with_chunk_table(b"".join(blobs), zipped, raw, table)
            record = laspy.PackedPointRecord.from_buffer(raw, header.point_format)
            chunk = take_chunk(
                laspy.ScaleAwarePointRecord(record.array, header.point_format, header.scales, header.offsets)
            )
            _check_within_nodes(path, coordinates_of(chunk), np.repeat(index.box[part], index.count[part], axis=0))
            yield chunk


def _index(nodes: NDArray[np.void], corner: NDArray[np.float64], side: float) -> CopcIndex:
    width = side / 2.0 ** nodes["level"]
    low = corner + nodes["key"][:, :2] * width[:, None]
    box = np.hstack((low, low + width[:, None]))
    return CopcIndex(box, *(nodes[name].astype(np.int64) for name in ("offset", "size", "count")))


def _fits(
    index: CopcIndex,
    nodes: NDArray[np.void],
    promise: LasPromise,
    n_bytes: int,
    cube: tuple[float, float, float],
) -> bool:
    x, y, half = cube
    xmin, ymin, xmax, ymax, _, _ = promise.bounds
    reach = max(abs(xmin - x), abs(xmax - x), abs(ymin - y), abs(ymax - y))
    return bool(
        index.count.sum() == promise.n_points
        and reach <= half + NODE_SLACK
        and (index.count < _MANY_BYTES // promise.point_size).all()
        and index.size.sum() <= n_bytes  # none lies over another
        and (nodes["level"] >= 0).all()
        and (nodes["level"] < 32).all()
        and (index.size > 0).all()
        and (index.offset >= 0).all()
        and (index.offset <= n_bytes - index.size).all()
    )


def _read_bytes(file: BinaryIO, offset: int, size: int) -> bytes:
    file.seek(offset)
    return file.read(size)


def _check_within_nodes(path: Path, xyz: NDArray[np.float64], box: NDArray[np.float64]) -> None:
    stray = ((xyz[:, :2] < box[:, :2] - NODE_SLACK) | (xyz[:, :2] > box[:, 2:] + NODE_SLACK)).any(axis=1)
    if stray.any():
        x, y, _ = xyz[stray][0]
        raise InputError(
            f"{path}: {np.count_nonzero(stray)} of {len(xyz)} points lie more than {NODE_SLACK:g} m outside their "
            f"node of the COPC index, the first at ({x:.2f}, {y:.2f}): the index is damaged; {AGAIN}, or write it "
            f"as a plain file: pdal translate {path.name} plain.laz"
        )
