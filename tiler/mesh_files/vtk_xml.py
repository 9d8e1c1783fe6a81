"""VTK's XML container: named arrays, appended raw in zlib blocks, streamed to disk and read back.

Files are little-endian with UInt64 headers. Nothing here knows of meshes: see `tiler.mesh_files.vtk_files`.
"""

import io
import os
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePath
from typing import Any, BinaryIO
from xml.sax.saxutils import quoteattr

import numpy as np
from deflate import DeflateError, zlib_compress, zlib_decompress
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.mesh_files.threads import map_threads
from tiler.objects.places import read_at_most
from tiler.store.atomic import replacing

BLOCK_BYTES = 1 << 18  # uncompressed bytes of a zlib block
LEVEL = 1  # of libdeflate
OTHER_LEVELS = (2, 6, 12, 0)
THOROUGH = 10  # a level that finds what steady sequences repeat: less than half the bytes of the others
HEAD_BYTES = 1 << 20  # bound on the XML in front of the data
PIECE_HEAD = 1 << 16  # bytes of a piece of our own in which it ends
TOGETHER, BLOCK = 16, 1000  # heads of pieces that are read at a time, and that wait
INDEX_BYTES = 1 << 28  # bound on an index file
MAX_RATIO = 1032  # zlib cannot compress better than this
# VTK's names of the types that we write.
VTK_TYPES = {
    "float64": "Float64",
    "float32": "Float32",
    "int64": "Int64",
    "int32": "Int32",
    "uint8": "UInt8",
    "int8": "Int8",
}
DTYPES = {name: np.dtype(dtype).newbyteorder("<") for dtype, name in VTK_TYPES.items()}


@dataclass(frozen=True, eq=False)
class Stream:
    """One array on its way to the disk: ``block(i, j)`` takes its numbers ``i`` to ``j``.

    It gives what packs them, perhaps in another thread.
    """

    name: str
    dtype: np.dtype[Any]
    components: int
    n_items: int
    block: Callable[[int, int], Callable[[], bytes]]


Sections = dict[str, list[Stream]]


@dataclass(frozen=True)
class _Head:
    """The XML of a file: `piece` has the counts, `start` is where appended data begins."""

    piece: ET.Element
    start: int


def stream_items(
    name: str, dtype: np.dtype[Any], components: int, n_items: int, items: Callable[[int, int], NDArray[Any]]
) -> Stream:
    """Make a stream of numbers that ``items(i, j)`` makes, to be written as `dtype`."""
    return Stream(name, dtype, components, n_items, lambda i, j: partial(compress_block, items(i, j), dtype))


def compress_block(items: NDArray[Any], dtype: np.dtype[Any], *, level: int = LEVEL) -> bytes:
    """Compress a block of numbers, written as `dtype`, to a zlib stream."""
    return bytes(zlib_compress(items.astype(dtype.newbyteorder("<"), copy=False).tobytes(), level))


def write_data_file(
    path: Path, kind: str, counts: Mapping[str, int], sections: Sections, *, threads: int = 0
) -> None:
    """Write a file of one piece: ``counts`` are the piece's attributes, ``kind`` is VTK's data set type.

    Blocks are packed by so many threads, as they come; the bytes are the same.

    Raises
    ------
    OutputError
        If the file cannot be written; then it is not there, or is the old one.

    Notes
    -----
    meshio (5.3) unpacks arrays to base64 and puts their new offsets into the XML one by one, where it then looks
    up the old ones of the others: no array begins at an offset that an earlier one has there.
    """
    streams = [stream for streams in sections.values() for stream in streams]
    with replacing(path) as part, part.open("wb") as file:
        file.write(_render(kind, counts, sections, [0] * len(streams)))
        start, offsets = file.tell(), []
        unpacked, taken = 0, set[int]()
        for stream in streams:
            offsets.append(file.tell() - start)
            taken.add(start + unpacked)
            unpacked += 4 * -(-(8 + stream.n_items * stream.dtype.itemsize) // 3)
            _write_blocks(file, stream, taken, threads)
        file.write(b"\n  </AppendedData>\n</VTKFile>\n")
        file.seek(0)
        file.write(_render(kind, counts, sections, offsets))


def _render(kind: str, counts: Mapping[str, int], sections: Sections, offsets: Sequence[int]) -> bytes:
    """Make the XML in front of the data; its length does not depend on the offsets."""
    left = iter(offsets)
    numbers = " ".join(f'{name}="{n}"' for name, n in counts.items())
    lines = [*_opening(kind, ' header_type="UInt64" compressor="vtkZLibDataCompressor"')]
    lines += [f"  <{kind}>", f"    <Piece {numbers}>"]
    for section, streams in sections.items():
        lines.append(f"      <{section}>")
        for stream in streams:
            where = f'offset="{next(left)}"'
            lines.append(f'        <DataArray {_declare(stream)} format="appended" {where:<28}/>')
        lines.append(f"      </{section}>")
    lines += ["    </Piece>", f"  </{kind}>", '  <AppendedData encoding="raw">', "   _"]
    return "\n".join(lines).encode()


def _opening(kind: str, more: str) -> list[str]:
    return [
        '<?xml version="1.0"?>',
        f'<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian"{more}>',
    ]


def _declare(stream: Stream) -> str:
    return _declaration(VTK_TYPES[stream.dtype.name], stream.name, str(stream.components))


def _declaration(vtk_type: str, name: str, components: str) -> str:
    # VTK leaves the number out for scalars, and meshio makes columns (n, 1) of them if it is there.
    width = "" if components == "1" else f" NumberOfComponents={quoteattr(components)}"
    return f"type={quoteattr(vtk_type)} Name={quoteattr(name)}{width}"


def _write_blocks(file: BinaryIO, stream: Stream, taken: Collection[int], threads: int) -> None:
    """Write one array: its table of block sizes, then its blocks; the table is filled in afterwards.

    It ends at none of the places that are taken.
    """
    dtype = stream.dtype
    step = BLOCK_BYTES // dtype.itemsize
    n_blocks = -(-stream.n_items // step)
    table = np.zeros(3 + n_blocks, "<u8")
    table[:3] = n_blocks, BLOCK_BYTES, stream.n_items * dtype.itemsize % BLOCK_BYTES
    start = file.tell()
    file.write(table.tobytes())
    blocks = (stream.block(k * step, min((k + 1) * step, stream.n_items)) for k in range(n_blocks))
    for k, packed in enumerate(map_threads(lambda pack: pack(), blocks, threads)):
        last = k == n_blocks - 1
        block = _end_elsewhere(packed, {end - file.tell() for end in taken}) if last else packed
        table[3 + k] = len(block)
        file.write(block)
    end = file.tell()
    file.seek(start)
    file.write(table.tobytes())
    file.seek(end)


def _end_elsewhere(block: bytes, lengths: Collection[int]) -> bytes:
    """Pack a block anew if its length is one of some; that of one that cannot be packed remains."""
    for level in OTHER_LEVELS:
        if len(block) not in lengths:
            break
        block = bytes(zlib_compress(zlib.decompress(block), level))
    return block


def write_index(path: Path, pieces: Sequence[Path], kind: str) -> None:
    """Write the index file over existing pieces; see `tiler.mesh_files.vtk_files.write_pvtp`."""
    if not pieces:
        raise ValueError("an index file needs at least one piece")
    found = _declare_all(pieces, kind)
    declared = next(found)
    for piece, other in zip(pieces[1:], found, strict=True):
        if other != declared:
            raise InputError(f"{piece}: declares other arrays than {pieces[0]}; run the tile again")
    lines = [*_opening(f"P{kind}", ' header_type="UInt64"'), f'  <P{kind} GhostLevel="0">']
    for section in ("Points", "PointData", "CellData"):
        arrays = [f"      <PDataArray {array}/>" for array in declared[section]]
        lines += [f"    <P{section}>", *arrays, f"    </P{section}>"]
    for piece in pieces:
        source = PurePath(os.path.relpath(str(piece), str(path.parent))).as_posix()
        lines.append(f"    <Piece Source={quoteattr(source)}/>")
    lines += [f"  </P{kind}>", "</VTKFile>", ""]
    with replacing(path) as part, part.open("wb") as file:
        file.write("\n".join(lines).encode())


def _declare_all(pieces: Sequence[Path], kind: str) -> Iterator[dict[str, list[str]]]:
    """Read the declarations of pieces in their order, some at a time: most of it is waiting for disk or bucket."""
    with ThreadPoolExecutor(TOGETHER) as pool:
        for start in range(0, len(pieces), BLOCK):
            yield from pool.map(lambda piece: _declarations(piece, kind), pieces[start : start + BLOCK])


def _declarations(path: Path, kind: str) -> dict[str, list[str]]:
    try:
        head = io.BytesIO(read_at_most(path, PIECE_HEAD))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); run the tile again") from error
    piece = _read_head(path, head, kind).piece
    return {
        section: [
            _declaration(array.get("type", ""), array.get("Name", ""), array.get("NumberOfComponents", "1"))
            for array in piece.findall(f"{section}/DataArray")
        ]
        for section in ("Points", "PointData", "CellData")
    }


def damaged(path: Path, why: str) -> InputError:
    """Make the error for a file that cannot be what it should be."""
    return InputError(f"{path}: not a file of ours or damaged ({why}); run the tile again")


def parse_xml(path: Path, text: bytes) -> ET.Element:
    """Parse the XML of a file; declarations, by which a few bytes can expand without end, are refused."""
    if b"<!" in text or b"\0" in text:  # zeros: UTF-16, in which the former would not be found
        raise damaged(path, "it has declarations")
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError, LookupError, RecursionError) as error:
        raise damaged(path, str(error)) from None


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open a file to read; whatever the system says against it becomes an `InputError`."""
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); run the tile again") from error


def _read_head(path: Path, file: BinaryIO, kind: str) -> _Head:
    text = file.read(HEAD_BYTES)
    end = text.find(b"<AppendedData")
    start = text.find(b"_", end)
    if end < 0 or start < 0:
        raise damaged(path, "no appended data")
    root = parse_xml(path, text[:end] + b"</VTKFile>")
    piece = root.find(f"./{kind}/Piece")
    if piece is None or root.get("header_type") != "UInt64" or root.get("byte_order") != "LittleEndian":
        raise damaged(path, f"no little-endian {kind} with UInt64 headers")
    return _Head(piece, start + 1)


def read_data_file(path: Path, kind: str) -> dict[str, dict[str, NDArray[Any]]]:
    """Read all arrays of a file of one piece, by section and name.

    Raises
    ------
    InputError
        If the file is missing or damaged.

    Notes
    -----
    The length of every array follows from the counts of the piece and is bounded by the size of the
    file, so a damaged file cannot ask for more memory than zlib could have packed into it.
    """
    with opened(path) as file:
        head = _read_head(path, file, kind)
        size = file.seek(0, os.SEEK_END)
        try:
            sections = {
                section.tag: {
                    array.get("Name", ""): _read_array(file, head, array, section.tag, size) for array in section
                }
                for section in head.piece
            }
        except (ValueError, KeyError, TypeError, DeflateError) as error:
            raise damaged(path, f"{error}") from None
    rows = "Cells" if kind == "UnstructuredGrid" else "Polys"
    missing = {"Points", "PointData", "CellData", rows} - sections.keys()
    if missing or "Points" not in sections["Points"] or sections["Points"]["Points"].dtype != np.float64:
        raise damaged(path, f"no float64 points or no section {sorted(missing)}")
    return sections


def read_point_array(path: Path, kind: str, name: str) -> NDArray[Any] | None:
    """Read one point array of a file of one piece, and no other; None if it has none of that name.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    with opened(path) as file:
        head = _read_head(path, file, kind)
        size = file.seek(0, os.SEEK_END)
        arrays = [array for array in head.piece.findall("PointData/DataArray") if array.get("Name") == name]
        try:
            return _read_array(file, head, arrays[0], "PointData", size) if arrays else None
        except (ValueError, KeyError, TypeError, DeflateError) as error:
            raise damaged(path, f"{error}") from None


def _read_array(file: BinaryIO, head: _Head, array: ET.Element, section: str, size: int) -> NDArray[Any]:
    """Read one appended array; its length follows from the counts of the piece."""
    name, components = array.attrib["Name"], int(array.get("NumberOfComponents", "1"))
    dtype = DTYPES[array.attrib["type"]]
    n_rows = _expected_rows(head.piece, section, name)
    n_bytes = n_rows * components * dtype.itemsize
    if components < 1 or n_rows < 0 or n_bytes > MAX_RATIO * size:
        raise ValueError(f"array {name!r} of {n_bytes} bytes in a file of {size}")
    file.seek(head.start + int(array.attrib["offset"]))
    data = np.empty(n_bytes, np.uint8)
    filled = 0
    for packed, most in _read_blocks(file, name, size):
        block = zlib_decompress(packed, min(most, n_bytes - filled))
        data[filled : filled + len(block)] = np.frombuffer(block, np.uint8)
        filled += len(block)
    if filled != n_bytes:
        raise ValueError(f"array {name!r} has {filled} of {n_bytes} bytes")
    native = data.view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return native.reshape(n_rows, components) if components > 1 else native


def _expected_rows(piece: ET.Element, section: str, name: str) -> int:
    if section in ("Points", "PointData"):
        return int(piece.attrib["NumberOfPoints"])
    n_rows = int(piece.attrib["NumberOfPolys" if "NumberOfPolys" in piece.attrib else "NumberOfCells"])
    return n_rows * {"Polys": 3, "Cells": 4}.get(section, 1) if name == "connectivity" else n_rows


def _read_blocks(file: BinaryIO, name: str, size: int) -> Iterator[tuple[bytes, int]]:
    """Read the blocks of an array, packed, and how many bytes each has at most."""
    n_blocks, block_bytes, _ = np.frombuffer(file.read(24), "<u8", 3).tolist()
    if n_blocks * 8 > size or not 0 < block_bytes <= MAX_RATIO * size:
        raise ValueError(f"array {name!r} of {n_blocks} blocks of {block_bytes} bytes in a file of {size}")
    for packed in np.frombuffer(file.read(8 * n_blocks), "<u8", n_blocks).tolist():
        if packed > size:
            raise ValueError(f"array {name!r} has a block of {packed} bytes in a file of {size}")
        yield file.read(packed), block_bytes
