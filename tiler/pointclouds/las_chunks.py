"""Points of a LAS, LAZ or COPC file by chunks: those near a box, as arrays of whole units (step 1.1)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.copc import CopcInfoVlr, HierarchyPage
from laspy.vlrs.known import LasZipVlr
from numpy.typing import NDArray

from pipeline.data.classes import GROUND, KEY_POINT
from pipeline.data.errors import InputError
from pipeline.points_terrain.las_points import Triple, find_coordinates
from tiler.georeference.frame import AS_IT_IS, STEP, Frame, box_to_file, box_to_region, origin_of, to_region
from tiler.objects.places import source_of
from tiler.pointclouds.las_header import AGAIN, Box3, box_of_header, has_void_box, laspy_as_input_error

CHUNK_POINTS = 1_000_000
SOME_POINTS = 50_000  # that count as a chunk where a file has none
CHUNK_BYTES = 64_000_000  # wins over CHUNK_POINTS where a point has many extra bytes
SLACK = (
    1.0  # m that a point may lie outside the header's box or its COPC node, or a node outside the octree's cube
)
QUERY_SHARE = 0.5  # a COPC file is read by its octree where less than this share of its box is wanted

# Fields to decompress in formats 6 to 10. laspy gives a field that is left out its chunk's first value for all
# points: without the flags, all of a chunk may be withheld.
FIELDS = (
    laspy.DecompressionSelection.XY_RETURNS_CHANNEL
    | laspy.DecompressionSelection.Z
    | laspy.DecompressionSelection.CLASSIFICATION
    | laspy.DecompressionSelection.FLAGS
)
LAST_LEGACY_FORMAT = 5
MOST_UNITS = 2**31 - 1
MOST_LEVELS = 32
_MANY_BYTES = 2**30  # of one COPC node, uncompressed; writers put some 10^5 points of 30 to 60 bytes there

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class PointChunk:
    """Some points of a file."""

    # (n,): coordinates in whole units
    x: NDArray[np.int32]
    y: NDArray[np.int32]
    z: NDArray[np.int32]
    # Size of a unit along each axis, and place of unit 0, in the file's CRS or the region's.
    scale: Triple
    offset: Triple
    classification: NDArray[np.uint8]  # (n,): ASPRS class of each point; model key points count as ground
    withheld: NDArray[np.bool_]  # (n,): whether the file says not to use a point
    n_key_points: int = 0  # how many points had the class of model key points

    def __len__(self) -> int:
        return len(self.x)


BoxedChunk = tuple[PointChunk, NDArray[np.float64] | None]  # and the box of each point's node, if known


@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes of a COPC file that hold points, in the order of the file; or chunks of any other file."""

    box: NDArray[np.float64] | None  # (n, 4): xmin, ymin, xmax, ymax in the file's CRS; None where unknown
    offset: NDArray[np.int64]  # (n,): first byte of the node's points
    size: NDArray[np.int64]  # (n,): how many bytes
    count: NDArray[np.int64]  # (n,): how many points


def nodes_near(path: Path, header: laspy.LasHeader, bounds: Box, frame: Frame = AS_IT_IS) -> Nodes | None:
    """Find the nodes of a COPC file that have all of its points in a box of the region's CRS (m).

    None where the file is to be read from end to end: it is no COPC, its octree cannot be trusted, or the box
    covers half or more of the box in the header.
    """
    if header.point_count == 0 or has_void_box(header):
        return None
    xmin, ymin, xmax, ymax = box_to_file(frame, bounds)
    (x0, y0), (x1, y1) = header.mins[:2].tolist(), header.maxs[:2].tolist()
    covered = max(min(x1, xmax) - max(x0, xmin), 0.0) * max(min(y1, ymax) - max(y0, ymin), 0.0)
    nodes = read_octree(path, header) if covered < QUERY_SHARE * (x1 - x0) * (y1 - y0) else None
    if nodes is None:
        return None
    assert nodes.box is not None
    low_x, low_y, high_x, high_y = nodes.box.T
    near = (low_x <= xmax + SLACK) & (high_x >= xmin - SLACK) & (low_y <= ymax + SLACK) & (high_y >= ymin - SLACK)
    return _take_nodes(nodes, near)


def _take_nodes(nodes: Nodes, rows: NDArray[np.bool_]) -> Nodes:
    box = None if nodes.box is None else nodes.box[rows]
    return Nodes(box, nodes.offset[rows], nodes.size[rows], nodes.count[rows])


def take_share(path: Path, header: laspy.LasHeader, nodes: Nodes | None, share: tuple[int, int]) -> Nodes | None:
    """Take one of equal shares of the points of some nodes, by default of the whole file, by its chunk table.

    Each node or chunk is in the share that has its first point.
    """
    if share == (0, 1) or header.point_count == 0:
        return nodes
    if nodes is None:
        nodes = _list_chunks(path, header)
    first = np.cumsum(nodes.count) - nodes.count
    return _take_nodes(nodes, first * share[1] // max(int(nodes.count.sum()), 1) == share[0])


def _list_chunks(path: Path, header: laspy.LasHeader) -> Nodes:
    """List the chunks of a LAZ file; those of an uncompressed one have some points each."""
    n, begin = header.point_count, header.offset_to_point_data
    if header.are_points_compressed:
        with laspy_as_input_error(path, lambda: "its chunk table cannot be read"), path.open("rb") as file:
            file.seek(begin)
            table = lazrs.read_chunk_table(file, lazrs.LazVlr(_zip_record(header)))
            count, size = np.array(table, np.int64).reshape(-1, 2).T
            begin += 8  # the place of the table itself
        count = np.minimum(count, n - (np.cumsum(count) - count))  # the last chunk is not full
    else:
        count = np.diff(np.append(np.arange(0, n, SOME_POINTS), n))
        size = count * int(header.point_format.size)
    return Nodes(None, begin + np.cumsum(size) - size, size, count)


def _zip_record(header: laspy.LasHeader) -> bytes:
    return bytes(next(one for one in header.vlrs if isinstance(one, LasZipVlr)).record_data)


def read_octree(path: Path, header: laspy.LasHeader) -> Nodes | None:
    """Read the octree of a file with points; None for one that is no COPC, or whose octree cannot be trusted.

    COPC is known by its content, not by its name. `laspy.copc.CopcReader.query` has the points of all nodes near a
    box in memory at once, so its pages alone are used.
    """
    info = next((one for one in header.vlrs if isinstance(one, CopcInfoVlr)), None)
    if info is None:
        return None
    found, total = [], 0
    with path.open("rb") as file:
        n_bytes = file.seek(0, 2)
        pages = [(info.hierarchy_root_offset, info.hierarchy_root_size)]
        for place, length in pages:
            total += length
            # laspy would follow pages in circles, and those that lie beyond the end of the file
            if not (0 < length <= n_bytes - place and total <= n_bytes):
                return None
            file.seek(place)
            for entry in HierarchyPage.from_bytes(file.read(length)).entries.values():
                if entry.point_count == -1:
                    pages.append((entry.offset, entry.byte_size))
                elif entry.point_count > 0:
                    key = entry.key
                    found.append((entry.offset, entry.byte_size, entry.point_count, key.level, key.x, key.y))
    offset, size, count, level, x, y = np.array(sorted(found), np.float64).reshape(-1, 6).T
    width = 2 * info.halfsize / 2.0**level
    low = (info.center[:2] - info.halfsize)[:, None] + np.array([x, y]) * width
    reach = np.abs(np.array([header.mins, header.maxs]) - info.center)[:, :2].max()
    sound = (
        count.sum() == header.point_count  # a page is missing, or a node is there twice
        and reach <= info.halfsize + SLACK  # NaN too: nodes are elsewhere than the points
        and ((level >= 0) & (level < MOST_LEVELS)).all()
        and (count < _MANY_BYTES // header.point_format.size).all()  # a node is read at once
        and ((size > 0) & (offset + size <= n_bytes)).all()
        and size.sum() <= n_bytes  # none lies over another
    )
    whole = (values.astype(np.int64) for values in (offset, size, count))
    return Nodes(np.vstack([low, low + width]).T, *whole) if sound else None


def read_chunks(
    path: Path, header: laspy.LasHeader, nodes: Nodes | None = None, frame: Frame = AS_IT_IS
) -> Iterator[PointChunk]:
    """Read points of a file by chunks of some million in the region's CRS, in the order of the file; at least one.

    Parameters
    ----------
    path, header
        LAS, LAZ or COPC file, and its header by `read_las_header`.
    nodes : Nodes, optional
        Which nodes of a COPC file, from `nodes_near`; all points by default.
    frame : Frame
        How coordinates of the file become those of the region.

    Raises
    ------
    InputError
        If the file cannot be read, ends early, is damaged, or has points more than 1 m outside the bounds that its
        header states, or outside their node of a COPC file: it would be missing from the tiles it belongs to.
    """
    middle = (0.0, 0.0)
    if frame.source and header.point_count:
        xmin, ymin, xmax, ymax = box_to_region(frame, box_of_points(path, header)[:4])
        middle = (xmin + xmax) / 2, (ymin + ymax) / 2
    for chunk in _read(path, header, nodes):
        yield place_chunk(chunk, frame, middle)


def box_of_points(path: Path, header: laspy.LasHeader) -> Box3:
    """Give the box that a header states, or that of all points where it is void, as `box_of_header`."""
    if not has_void_box(header):
        return box_of_header(header)
    ends = [f(coordinates_of(chunk), axis=0) for chunk in read_chunks(path, header) for f in (np.min, np.max)]
    (xmin, ymin, zmin), (xmax, ymax, zmax) = np.min(ends, axis=0).tolist(), np.max(ends, axis=0).tolist()
    return xmin, ymin, xmax, ymax, zmin, zmax


def _read(path: Path, header: laspy.LasHeader, nodes: Nodes | None) -> Iterator[PointChunk]:
    """Yield chunks in the file's CRS; fail if there are fewer points than the header or the nodes claim."""
    claimed = header.point_count if nodes is None else int(nodes.count.sum())
    if claimed == 0:
        yield take_chunk(laspy.ScaleAwarePointRecord.zeros(0, header=header))
        return
    n_read, header_box = 0, np.concatenate([header.mins[:2], header.maxs[:2]])
    with laspy_as_input_error(path, lambda: f"{n_read} of {header.point_count} points could be read"):
        for chunk, box in _all_chunks(path, header) if nodes is None else _node_chunks(path, header, nodes):
            n_read += len(chunk)
            if not has_void_box(header):
                _check_within(path, chunk, header_box, "the bounds in its header")
            if box is not None:
                _check_within(path, chunk, box, "their node of the COPC index")
            yield chunk
    if n_read != claimed:  # laspy logs it
        raise InputError(f"{path}: {n_read} of {claimed} points could be read; {AGAIN}")


def _step(header: laspy.LasHeader) -> int:
    return max(1, min(CHUNK_POINTS, CHUNK_BYTES // int(header.point_format.size)))


def _all_chunks(path: Path, header: laspy.LasHeader) -> Iterator[BoxedChunk]:
    with laspy.open(
        source_of(path), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False, decompression_selection=FIELDS
    ) as reader:
        for chunk in map(take_chunk, reader.chunk_iterator(_step(header))):
            yield chunk, None


def _node_chunks(path: Path, header: laspy.LasHeader, nodes: Nodes) -> Iterator[BoxedChunk]:
    """Yield as many nodes as have half a million points, or one; with the box of each point's node, if known.

    The bytes of the file are in memory, too.
    `laspy.LasReader.seek` would give other points: it takes each chunk for one of fixed size.
    """
    batch = (np.cumsum(nodes.count) - nodes.count) // max(1, _step(header) // 2)
    with path.open("rb") as file:
        for part in np.split(np.arange(len(batch)), np.flatnonzero(np.diff(batch)) + 1):
            box = None if nodes.box is None else np.repeat(nodes.box[part], nodes.count[part], axis=0)
            yield _read_nodes(file, header, nodes.offset[part], nodes.size[part], nodes.count[part]), box


def _read_nodes(
    file: BinaryIO,
    header: laspy.LasHeader,
    offset: NDArray[np.int64],
    size: NDArray[np.int64],
    count: NDArray[np.int64],
) -> PointChunk:
    """Read nodes that follow each other in the file; each has a first byte, bytes and points."""
    blobs = [_read_bytes(file, *place) for place in zip(offset.tolist(), size.tolist(), strict=True)]
    raw = np.frombuffer(b"".join(blobs), np.uint8)
    if header.are_points_compressed:
        zipped, raw = raw, np.zeros(int(count.sum()) * header.point_format.size, np.uint8)
        table = list(zip(count.tolist(), size.tolist(), strict=True))
        lazrs.decompress_points_with_chunk_table(zipped, _zip_record(header), raw, table, FIELDS.to_lazrs())
    packed = laspy.PackedPointRecord.from_buffer(raw, header.point_format)
    return take_chunk(
        laspy.ScaleAwarePointRecord(packed.array, packed.point_format, header.scales, header.offsets)
    )


def _read_bytes(file: BinaryIO, place: int, size: int) -> bytes:
    file.seek(place)
    return file.read(size)


def _check_within(path: Path, chunk: PointChunk, box: NDArray[np.float64], place: str) -> None:
    """Refuse points outside a box, or each its own: laspy gives them, and tiles are planned without them."""
    (x, y), (xmin, ymin, xmax, ymax) = plan_of(chunk), box.T
    stray = (x < xmin - SLACK) | (x > xmax + SLACK) | (y < ymin - SLACK) | (y > ymax + SLACK)
    if stray.any():
        raise InputError(
            f"{path}: {np.count_nonzero(stray)} of {len(x)} points lie more than {SLACK:g} m outside {place}, "
            f"the first at ({x[stray][0]:.2f}, {y[stray][0]:.2f}): the file is damaged; {AGAIN}, or rewrite it: "
            f"pdal translate {path.name} plain.laz"
        )


def take_chunk(record: laspy.ScaleAwarePointRecord) -> PointChunk:
    """Take what the steps need of points that laspy read, in the file's CRS.

    Class 8 is that of model key points, thinned ground, in the point formats 0 to 5 (LAS 1.4 R15, table 9), and
    reserved in the formats 6 to 10 (table 17).
    """
    classes = np.array(record.classification, np.uint8)
    key = (classes == KEY_POINT) & (record.point_format.id <= LAST_LEGACY_FORMAT)
    classes[key] = GROUND
    (a, b, c), (x, y, z) = record.scales.tolist(), record.offsets.tolist()
    withheld = np.asarray(np.asarray(record.withheld) != 0)
    units = [np.array(values) for values in (record.X, record.Y, record.Z)]  # the record's are 30 bytes apart
    n_key_points = int(np.count_nonzero(key))
    return PointChunk(units[0], units[1], units[2], (a, b, c), (x, y, z), classes, withheld, n_key_points)


def coordinates_of(chunk: PointChunk) -> NDArray[np.float64]:
    """Give the coordinates, float64 (n, 3)."""
    return np.asarray(find_coordinates(chunk.x, chunk.y, chunk.z, chunk.scale, chunk.offset))


def plan_of(chunk: PointChunk) -> NDArray[np.float64]:
    """Give the coordinates in plan, float64 (2, n)."""
    axes = zip((chunk.x, chunk.y), chunk.scale, chunk.offset, strict=False)
    return np.array([units * scale + offset for units, scale, offset in axes])


def place_chunk(chunk: PointChunk, frame: Frame, middle: tuple[float, float]) -> PointChunk:
    """Give a chunk of a file in the region's CRS (m).

    Where units and axes alone change, the units of the file stay, exactly. Reprojected points are rounded to
    millimetres and counted from near `middle`, that of the file in the region's CRS; a point without a place there
    is withheld.
    """
    if frame == AS_IT_IS:
        return chunk
    z_scale, z_offset = chunk.scale[2] * frame.height, chunk.offset[2] * frame.height
    if frame.source:
        start = origin_of(middle)
        units = (to_region(frame, coordinates_of(chunk)[:, :2]) - start) / STEP
        there = np.abs(units).max(axis=1) <= MOST_UNITS  # infinite or NaN where there is none
        x, y = np.rint(np.where(there[:, None], units, 0.0)).astype(np.int32).T.copy()
        scale, offset = (STEP, STEP, z_scale), (*start, z_offset)
        return replace(chunk, x=x, y=y, scale=scale, offset=offset, withheld=chunk.withheld | ~there)
    (east, x_unit), (north, y_unit) = frame.east, frame.north
    both = chunk.x, chunk.y
    x, y = (both[axis] if unit > 0 else -both[axis] for axis, unit in (frame.east, frame.north))
    scale = chunk.scale[east] * abs(x_unit), chunk.scale[north] * abs(y_unit), z_scale
    offset = chunk.offset[east] * x_unit, chunk.offset[north] * y_unit, z_offset
    return replace(chunk, x=x, y=y, scale=scale, offset=offset)
