"""Walls and roofs of a tile as rectangles with triangles, and what hides them: in files, a bin each."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import is_ground
from tiler.cityinput.face_planes import area_vectors, cut_face
from tiler.cityinput.faces import ROOF, UNKNOWN, WALL, ModelBuilding, join_faces
from tiler.cityinput.levels import best_shapes
from tiler.convert.features import plain_value, rings_of, unique_name
from tiler.convert.inputs import ModelSource
from tiler.export.surface import open_surface
from tiler.mesh_files.run_files import find_files
from tiler.tiles3d.cells import CellBuffers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Box = tuple[float, float, float, float]
BITS = 1 << 20  # of a number of a bin in each direction, from -BITS / 2 on
LEVEL = 1e-3  # sine of the slope up to which a surface is level: its longest edge is its axis
TEXTURED = (ROOF, WALL, UNKNOWN)


@dataclass(frozen=True, eq=False)
class Surface:
    """A wall or roof in the rectangle around it."""

    #: number of its building in the tile, and of the face in its building
    building: int
    face: int
    kind: int  #: kind of the face, see `tiler.cityinput.faces`
    origin: Array  #: (3,): lower left corner of the rectangle (m)
    axes: Array  #: (3, 3): unit vectors: to the right, which is horizontal, up, and outwards
    size: Array  #: (2,): width and height (m)
    corners: Array  #: (t, 3, 3): its triangles (m)

    @property
    def area(self) -> float:
        """Its area (m²)."""
        a, b, c = self.corners.swapaxes(0, 1)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@dataclass(frozen=True, eq=False)
class Tile:
    """The buildings of a tile: names, attributes, and all surfaces that look anywhere but down."""

    names: list[str]
    attributes: list[dict[str, Any]]
    surfaces: list[Surface]


@dataclass(frozen=True, eq=False)
class Bins:
    """Squares of the plane, and files with what is in each."""

    folder: Path  #: where ``buildings/CODE`` and ``triangles/CODE`` are
    side: float  #: side of a square (m); they begin at multiples of it in the CRS
    tiles: list[int]  #: bins with buildings, by the middle of their box, ascending
    boxes: dict[int, Box]  #: box of the triangles of each bin that has some (m)
    top: float  #: height of the highest of all (m)

    def name(self, code: int) -> str:
        """Name a bin by its place: ``i_j``, eastwards and northwards."""
        i, j = divmod(code, BITS)
        return f"{i - BITS // 2}_{j - BITS // 2}"

    def triangles(self, code: int) -> Array:
        """Read the triangles (t, 3, 3) of a bin (m)."""
        return np.fromfile(self.folder / "triangles" / str(code)).reshape(-1, 3, 3)

    def tile(self, code: int) -> Tile:
        """Read the buildings of a bin."""
        names, attributes, surfaces = [], [], []
        for k, line in enumerate((self.folder / "buildings" / str(code)).read_bytes().splitlines()):
            read = json.loads(line)
            names.append(read["name"])
            attributes.append(read["attributes"])
            for face, kind, flat in read["faces"]:
                found = _make_surface(k, face, kind, np.array(flat).reshape(-1, 3, 3))
                if found is not None:
                    surfaces.append(found)
        return Tile(names, attributes, surfaces)


def sort_city(source: ModelSource, run: Path | None, folder: Path, side: float) -> Bins:
    """Sort buildings, and the ground of a run, into bins; memory is what waits for the files.

    `source.told` counts what cannot be drawn.
    """
    for name in ("buildings", "triangles"):
        (folder / name).mkdir()
    buildings, triangles = CellBuffers(folder / "buildings"), CellBuffers(folder / "triangles")
    boxes: dict[int, Box] = {}
    seen: set[int] = set()
    top = -np.inf
    for building in source.buildings():
        faces = list(_cut(building, source))
        if not faces:
            continue
        corners = np.concatenate([own for _, _, own in faces])
        low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
        top = max(top, float(high[2]))
        name = unique_name(building.id or "building", seen)
        head = {"name": name, "attributes": plain_value(building.attributes.get(building.id, {}))}
        rows = [[face, kind, own.ravel().tolist()] for face, kind, own in faces if kind in TEXTURED]
        line = json.dumps(head | {"faces": rows}, separators=(",", ":"))
        buildings.add(int(_codes((low + high)[np.newaxis, :2] / 2, side)[0]), line.encode() + b"\n")
        _add_triangles(triangles, boxes, corners, side)
    if run is not None:
        surface = open_surface(find_files(run))
        for k in range(len(surface.names)):
            piece = surface.read(k)
            corners = piece.points[piece.facets[is_ground(piece.marker)]]
            top = max(top, float(corners[..., 2].max(initial=-np.inf)))
            _add_triangles(triangles, boxes, corners, side)
    buildings.flush()
    triangles.flush()
    return Bins(folder, side, sorted(buildings.cells), boxes, top)


def _codes(xy: Array, side: float) -> Ints:
    i, j = np.floor(xy / side).astype(np.int64).T + BITS // 2
    found: Ints = i * BITS + j
    return found


def _add_triangles(buffers: CellBuffers, boxes: dict[int, Box], corners: Array, side: float) -> None:
    codes = _codes(corners.mean(axis=1)[:, :2], side)
    buffers.add_rows(codes, corners.reshape(-1, 9))
    for code in np.unique(codes).tolist():
        xy = corners[codes == code].reshape(-1, 3)[:, :2]
        least, most = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
        old = boxes.get(code, (*least, *most))
        boxes[code] = (
            min(least[0], old[0]), min(least[1], old[1]), max(most[0], old[2]), max(most[1], old[3]),
        )  # fmt: skip


def _cut(building: ModelBuilding, source: ModelSource) -> Any:
    """Give number, kind and triangles (t, 3, 3) of each face of a building at its best level."""
    faces = join_faces(shape.faces for shape in best_shapes(building, "auto"))
    if not len(faces):
        return
    xyz, number = np.unique(np.round(faces.xyz / source.step), axis=0, return_inverse=True)
    xyz = xyz * source.step
    for k, (kind, rings) in enumerate(rings_of(faces, number.ravel().tolist())):
        own = cut_face(rings, xyz) if rings else None
        if own:
            yield k, kind, xyz[np.array(own)]
        else:
            source.told["faces without area or that cross themselves, left out"] += 1


def _make_surface(building: int, face: int, kind: int, corners: Array) -> Surface | None:
    """Put a rectangle around a face; None where it looks down."""
    rings = np.arange(0, 3 * len(corners) + 1, 3)
    normal = area_vectors(corners.reshape(-1, 3), rings).sum(axis=0)
    length = float(np.linalg.norm(normal))
    if length == 0:
        return None
    normal = normal / length
    if normal[2] < -LEVEL:
        return None
    along = np.array([-normal[1], normal[0], 0.0])
    if np.linalg.norm(along) < LEVEL:
        edges = (corners - corners[:, [1, 2, 0]]).reshape(-1, 3)
        along = edges[np.argmax(np.round(np.linalg.norm(edges, axis=1), 6))].copy()
        along[2] = 0.0
    along = along / np.linalg.norm(along)
    up = np.array(
        [
            normal[1] * along[2] - normal[2] * along[1],
            normal[2] * along[0] - normal[0] * along[2],
            normal[0] * along[1] - normal[1] * along[0],
        ]
    )
    points = corners.reshape(-1, 3)
    axes = np.array([along, up, normal])
    local = (points - points[0]) @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    origin = points[0] + low[0] * along + low[1] * up + (low[2] + high[2]) / 2 * normal
    return Surface(building, face, kind, origin, axes, high[:2] - low[:2], corners)
