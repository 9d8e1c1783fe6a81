"""Well-known binary with curves and surfaces, which GEOS does not take, as plain geometries (step 1.2)."""

import struct
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tiler.vectors.arcs import linearise_arcs
from tiler.vectors.wkb import DEEPEST, Header, read_header

_POINT, _LINE, _POLYGON = 1, 2, 3
_ARCS, _COMPOUND, _CURVED_POLYGON = 8, 9, 10
_SURFACE, _TIN, _TRIANGLE = 15, 16, 17
# What is made of the parts of each collection: multipoint, multiline, multipolygon, collection, multicurve,
# multisurface, polyhedral surface, TIN.
_COLLECTIONS = {
    4: shapely.GeometryType.MULTIPOINT,
    5: shapely.GeometryType.MULTILINESTRING,
    6: shapely.GeometryType.MULTIPOLYGON,
    7: shapely.GeometryType.GEOMETRYCOLLECTION,
    11: shapely.GeometryType.MULTILINESTRING,
    12: shapely.GeometryType.MULTIPOLYGON,
    15: shapely.GeometryType.MULTIPOLYGON,
    16: shapely.GeometryType.MULTIPOLYGON,
}
_SINGLE = {
    shapely.GeometryType.MULTIPOINT: (shapely.GeometryType.POINT, shapely.MultiPoint),
    shapely.GeometryType.MULTILINESTRING: (shapely.GeometryType.LINESTRING, shapely.MultiLineString),
    shapely.GeometryType.MULTIPOLYGON: (shapely.GeometryType.POLYGON, shapely.MultiPolygon),
}


@dataclass(frozen=True)
class Shape:
    """A geometry made plain.

    Attributes
    ----------
    geometry : shapely.Geometry
        Points, lines, polygons, or collections of these; with Z where the blob has it.
    curved : bool
        Whether arcs were made segments.
    surface : bool
        Whether it is, or holds, a TIN, a triangle or a polyhedral surface.
    """

    geometry: shapely.Geometry
    curved: bool
    surface: bool


def read_shape(blob: bytes, *, tolerance: float, max_vertices: int) -> Shape:
    """Read a geometry of any kind of SQL/MM.

    Parameters
    ----------
    blob : bytes
        Well-known binary, ISO or EWKB.
    tolerance : float
        Largest distance of a segment from its arc, in units of the coordinates.
    max_vertices : int
        Largest number of vertices that are made.

    Returns
    -------
    Shape

    Raises
    ------
    ValueError
        If the blob is cut off, nests too deep, has a kind that is unknown or that its place does not allow, or
        makes more vertices.

    References
    ----------
    OGC 06-103r4, section 8.2; ISO/IEC 13249-3, section 5.1.68.
    """
    reader = _Reader(blob, tolerance, max_vertices)
    try:
        with np.errstate(invalid="ignore"):  # GEOS compares NaN coordinates
            geometry = reader.read(1)
    except (struct.error, shapely.errors.ShapelyError, TypeError) as error:
        raise ValueError(str(error)) from error
    return Shape(geometry, reader.curved, reader.surface)


class _Reader:
    """Reads a blob from its start to its end."""

    def __init__(self, blob: bytes, tolerance: float, max_vertices: int) -> None:
        self.blob, self.place, self.tolerance, self.left = blob, 0, tolerance, max_vertices
        self.curved = self.surface = False

    def read(self, depth: int) -> shapely.Geometry:
        header = self._header()
        kind = header.kind
        if depth > DEEPEST:
            raise ValueError(f"collections nest deeper than {DEEPEST} levels")
        self.surface |= kind in (_SURFACE, _TIN, _TRIANGLE)
        if kind == _POINT:
            return shapely.Point(self._points(header, 1)[0])
        if kind in (_LINE, _ARCS):
            return shapely.LineString(self._chain(header))
        count = self._count(header)
        if kind in (_POLYGON, _TRIANGLE):
            return _polygon([self._points(header, self._count(header)) for _ in range(count)])
        if kind == _COMPOUND:
            return shapely.LineString(_join([self._curve(depth + 1) for _ in range(count)]))
        if kind == _CURVED_POLYGON:
            return _polygon([self._curve(depth + 1) for _ in range(count)])
        if kind not in _COLLECTIONS:
            raise ValueError(f"a geometry of type {kind} is not known")
        parts = [self.read(depth + 1) for _ in range(count)]
        return _collect(kind, parts)

    def _curve(self, depth: int) -> NDArray[np.float64]:
        """Read a line, a circular string, or a compound curve of these."""
        header = self._header()
        if header.kind in (_LINE, _ARCS):
            return self._chain(header)
        if header.kind != _COMPOUND or depth > DEEPEST:
            raise ValueError(f"a geometry of type {header.kind} is no curve")
        return _join([self._curve(depth + 1) for _ in range(self._count(header))])

    def _chain(self, header: Header) -> NDArray[np.float64]:
        points = self._points(header, self._count(header))
        if header.kind == _LINE or not len(points):
            return points
        self.curved = True
        chain = linearise_arcs(points, self.tolerance)
        self._spend(len(chain) - len(points))
        return chain

    def _header(self) -> Header:
        header = read_header(self.blob, self.place)
        self.place = header.stop
        return header

    def _count(self, header: Header) -> int:
        (count,) = struct.unpack_from(header.order + "I", self.blob, self.place)
        self.place += 4
        if count > len(self.blob):
            raise ValueError(f"claims {count} parts in {len(self.blob)} bytes")
        return int(count)

    def _points(self, header: Header, count: int) -> NDArray[np.float64]:
        """Read x, y and, where there is one, z of vertices; their M is left out."""
        self._spend(count)
        n = header.dimensions
        flat = np.frombuffer(self.blob, np.dtype(header.order + "f8"), count * n, self.place)
        self.place += count * n * 8
        return flat.reshape(count, n)[:, : 3 if header.has_z else 2].astype(np.float64)

    def _spend(self, count: int) -> None:
        self.left -= count
        if self.left < 0:
            raise ValueError("has too many vertices")


def _collect(kind: int, parts: list[shapely.Geometry]) -> shapely.Geometry:
    """Make a collection of parts, and refuse those that its kind does not allow."""
    whole = _COLLECTIONS[kind]
    if whole is shapely.GeometryType.GEOMETRYCOLLECTION:
        return shapely.GeometryCollection(parts)
    single, make = _SINGLE[whole]
    members = [each for part in parts for each in shapely.get_parts(part) if not each.is_empty]
    if any(shapely.get_type_id(each) != single for each in members):
        raise ValueError(f"a collection of type {kind} holds a part of another kind")
    return make(members)


def _polygon(rings: list[NDArray[np.float64]]) -> shapely.Polygon:
    """Make a polygon of rings, closed where they are not; holes without an area are left out."""
    if not rings or not len(rings[0]):
        return shapely.Polygon()
    if len(rings[0]) < 3:
        raise ValueError(f"has a ring of {len(rings[0])} points")
    columns = min(ring.shape[1] for ring in rings)
    closed = [shapely.linearrings(ring[:, :columns]) for ring in rings if len(ring) >= 3]
    return shapely.polygons(closed[0], holes=closed[1:] or None)


def _join(chains: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Join the chains of a compound curve: each begins where the one before it ends."""
    chains = [chain for chain in chains if len(chain)]
    if not chains:
        raise ValueError("has an empty curve")
    columns = min(chain.shape[1] for chain in chains)
    pieces = [chains[0][:, :columns]] + [chain[1:, :columns] for chain in chains[1:]]
    return np.concatenate(pieces)
