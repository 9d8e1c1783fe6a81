"""CityJSON as our writers write it: an object a line, then a vertex a line; vertices wait in another file."""

import json
from collections.abc import Callable, Iterable
from typing import IO

import numpy as np
import pyproj
from numpy.typing import NDArray

COPY_BYTES = 1 << 20

compact = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


def reference_system(crs: pyproj.CRS | None) -> str | None:
    """Name a CRS by its EPSG code as OGC does; None if it has no code."""
    code = None if crs is None else crs.to_epsg()
    return None if code is None else f"https://www.opengis.net/def/crs/EPSG/0/{code}"


class ObjectLines:
    """Writes ``CityObjects`` and ``vertices`` of a document, from behind the comma after its head on."""

    def __init__(self, write: Callable[[bytes], object], vertex_file: IO[bytes]) -> None:
        self._write, self._vertex_file = write, vertex_file
        self.n_objects = self.n_vertices = 0
        write(b'"CityObjects":{')

    def add_objects(self, texts: Iterable[str]) -> None:
        """Write objects, a name and what it names each."""
        for text in texts:
            self._write(f"{',' if self.n_objects else ''}\n{text}".encode("ascii"))
            self.n_objects += 1

    def add_vertices(self, rows: NDArray[np.int64]) -> None:
        """Put vertices, (n, 3), behind those that wait."""
        if len(rows):
            # All at once: a call for each takes twelve times as long, the encoder of lists three times.
            text = ",\n".join(["[%d,%d,%d]"] * len(rows)) % tuple(rows.ravel().tolist())
            self._vertex_file.write(f"{',' if self.n_vertices else ''}\n{text}".encode("ascii"))
            self.n_vertices += len(rows)

    def finish(self) -> None:
        """Write the vertices."""
        self._write(b'\n},\n"vertices":[')
        self._vertex_file.seek(0)
        while piece := self._vertex_file.read(COPY_BYTES):
            self._write(piece)
        self._write(b"\n]")
