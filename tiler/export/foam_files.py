"""Files of OpenFOAM: headers, and long lists in binary, written in any order of their rows."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.export.pieces import blocks_of, slices
from tiler.mesh_files.transitions import NO_CORNER

POLY_MESH = "constant/polyMesh"
BANNER = "// Written by citystitch.\n"
LABEL_LIMIT = 2**31 - 1  # numbers that a 32 bit label can hold
COUNT_WIDTH = 20  # characters of a count that is known when its list is whole


def foam_header(name: str, kind: str, *, location: str, binary: bool = False, label: int = 32) -> str:
    """Make the head of a file.

    Parameters
    ----------
    name, kind : str
        Its ``object`` and ``class``.
    location : str
        Folder of it within the case.
    binary : bool
        Whether the lists in it are binary: little-endian, ``label`` bits an integer, 64 bits a float.
    """
    lines = ["FoamFile", "{", "    version     2.0;", f"    format      {'binary' if binary else 'ascii'};"]
    if binary:
        lines.append(f'    arch        "LSB;label={label};scalar=64";')
    lines += [f"    class       {kind};", f'    location    "{location}";', f"    object      {name};", "}", ""]
    return BANNER + "\n".join(lines) + "\n"


def write_at(file: BinaryIO, place: int, data: Any) -> None:
    """Write bytes, or an array, at a place of a file; other threads may write at others meanwhile."""
    left = memoryview(data).cast("B") if len(data) else memoryview(b"")
    while left:
        n = os.pwrite(file.fileno(), left, place)
        left, place = left[n:], place + n


class FoamList:
    """One binary list of `n` rows, written in pieces.

    Parameters
    ----------
    path : Path
        The file.
    header : str
        What stands before the list; `foam_header`.
    dtype : numpy dtype
        Of the numbers.
    width : int
        Numbers a row.
    n : int, optional
        Number of rows; if not given, that of those that were appended.
    """

    def __init__(self, path: Path, header: str, dtype: Any, *, width: int = 1, n: int | None = None) -> None:
        self._dtype, self._width, self._n, self._end = np.dtype(dtype).newbyteorder("<"), width, n, 0
        self._file: BinaryIO = path.open("wb")
        self._header = header
        self._head()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        self._file.close()

    @property
    def n(self) -> int:
        """Rows that the list has, or has so far."""
        return self._end if self._n is None else self._n

    def write(self, start: int, rows: NDArray[Any]) -> None:
        """Write rows from number `start` on."""
        place = self._start + start * self._width * self._dtype.itemsize
        write_at(self._file, place, np.ascontiguousarray(rows, self._dtype))

    def append(self, rows: NDArray[Any]) -> None:
        """Write rows behind those that were appended before."""
        self.write(self._end, rows)
        self._end += len(rows)

    def scatter(self, place: NDArray[np.int64], rows: NDArray[Any]) -> None:
        """Write each row at its own place: cheap where many follow each other."""
        for start, chosen in blocks_of(place):
            self.write(start, rows[chosen])

    def close(self) -> None:
        """Write the end of the list."""
        self._file.seek(self._start + self.n * self._width * self._dtype.itemsize)
        self._file.write(b")\n")
        self._head()

    def _head(self) -> None:
        self._file.seek(0)
        self._file.write(f"{self._header}{self.n:<{COUNT_WIDTH}d}\n(".encode())
        self._start = self._file.tell()


class FoamFaces:
    """The file ``faces`` of triangles: where each face begins, then their vertices.

    Parameters
    ----------
    path : Path
        The file.
    label : int
        Bits of an integer.
    n : int
        Number of faces.
    """

    def __init__(self, path: Path, *, label: int, n: int) -> None:
        self._dtype = np.dtype(f"<i{label // 8}")
        self._file: BinaryIO = path.open("wb")
        header = foam_header("faces", "faceCompactList", location=POLY_MESH, binary=True, label=label)
        self._file.write(f"{header}{n + 1}\n(".encode())
        for some in slices(n + 1):
            self._file.write((3 * np.arange(some.start, some.stop)).astype(self._dtype).data)
        self._file.write(f")\n{3 * n}\n(".encode())
        self._start, self._n = self._file.tell(), n

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self._file.seek(self._place(self._n))
            self._file.write(b")\n")
        self._file.close()

    def write(self, start: int, corners: NDArray[Any]) -> None:
        """Write the vertices (k, 3) of faces from number `start` on."""
        write_at(self._file, self._place(start), np.ascontiguousarray(corners, self._dtype))

    def _place(self, face: int) -> int:
        return self._start + 3 * face * self._dtype.itemsize


class FoamPolygons:
    """The file ``faces`` of triangles and quadrilaterals; until all are there they wait in a file beside it.

    Parameters are those of `FoamFaces`.
    """

    def __init__(self, path: Path, *, label: int, n: int) -> None:
        self._dtype, self._path, self._n = np.dtype(f"<i{label // 8}"), path, n
        self._header = foam_header("faces", "faceCompactList", location=POLY_MESH, binary=True, label=label)
        self._wait: BinaryIO = path.with_suffix(".wait").open("w+b")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self._join()
        self._wait.close()
        self._path.with_suffix(".wait").unlink()

    def write(self, start: int, corners: NDArray[Any]) -> None:
        """Write the vertices (k, 4) of faces from number `start` on; triangles end with `NO_CORNER`."""
        write_at(self._wait, 4 * start * self._dtype.itemsize, np.ascontiguousarray(corners, self._dtype))

    def _join(self) -> None:
        """Write where each face begins, then the corners of all."""
        end = 0
        with self._path.open("wb") as file:
            file.write(f"{self._header}{self._n + 1}\n(".encode())
            file.write(np.zeros(1, self._dtype).data)
            for rows in self._rows():
                ends = end + np.cumsum((rows != NO_CORNER).sum(axis=1))
                file.write(ends.astype(self._dtype).data)
                end = int(ends[-1])
            file.write(f")\n{end}\n(".encode())
            for rows in self._rows():
                file.write(rows[rows != NO_CORNER].data)
            file.write(b")\n")

    def _rows(self) -> Iterator[NDArray[Any]]:
        self._wait.seek(0)
        for some in slices(self._n):
            yield np.fromfile(self._wait, self._dtype, 4 * (some.stop - some.start)).reshape(-1, 4)


def read_foam_list(path: Path, width: int) -> NDArray[Any]:
    """Read a binary list: vectors (n, 3), or labels (n, 1) for a width of 1; InputError where it is damaged."""
    (rows,) = _read_lists(path, [("f8", 3) if width == 3 else ("", 1)])
    return rows


def read_foam_faces(path: Path) -> NDArray[np.int64]:
    """Read faces of three and four corners, (k, 4); -1 in the last place of a triangle."""
    start, corners = (rows[:, 0] for rows in _read_lists(path, [("", 1), ("", 1)]))
    width = np.diff(start)
    if not len(start) or start[0] != 0 or start[-1] != len(corners) or not np.isin(width, (3, 4)).all():
        raise InputError(f"{path}: has faces that are no triangles or quadrilaterals; export the case again")
    faces = np.full((len(width), 4), -1)
    faces[np.arange(4) < width[:, None]] = corners
    return faces


def _read_lists(path: Path, kinds: list[tuple[str, int]]) -> list[NDArray[Any]]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); export the case again") from None
    bits = re.search(rb"label=(32|64)", data[:2000])
    at, found = data.find(b"}") + 1, []
    for kind, width in kinds:
        head = re.compile(rb"\s*(\d+)\s*\(").match(data, at)
        dtype = np.dtype(f"<{kind or f'i{int(bits[1]) // 8}'}") if bits else None
        if head is None or dtype is None or b"binary" not in data[:2000]:
            raise InputError(f"{path}: is no binary list of OpenFOAM; export the case again")
        n = int(head[1]) * width
        at = head.end() + n * dtype.itemsize
        if data[at : at + 1] != b")":
            raise InputError(f"{path}: ends early; export the case again")
        rows = np.frombuffer(data, dtype, n, head.end()).reshape(-1, width)
        found.append(rows.astype(np.float64 if kind else np.int64))
        at += 1
    return found
