"""Buildings of a city model as files have them: polygons in space by level of detail, whatever the format."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # a run imports no façades
    from pipeline.facades.pictures import Picture

# What a face is; outlines are polygons that say where a building stands, without being a part of its surface.
UNKNOWN, ROOF, GROUND, WALL, OUTLINE = range(5)
# Of buildings that rules have detailed; files are read without them. The last are flat, with a picture each.
WINDOW, DOOR, INSTALLATION, PICTURED = range(5, 9)
KINDS = {
    "RoofSurface": ROOF,
    "OuterCeilingSurface": WALL,
    "OuterFloorSurface": WALL,
    "GroundSurface": GROUND,
    "WallSurface": WALL,
    "ClosureSurface": WALL,
    "InteriorWallSurface": WALL,
    "CeilingSurface": WALL,
    "FloorSurface": WALL,
    "GenericThematicSurface": UNKNOWN,
}
NO_LOD = -1.0
FARTHEST = 1e8  # coordinates beyond this are of no place, in metres or degrees

Ring = Sequence[Sequence[float]]


@dataclass(frozen=True, eq=False)
class Faces:
    """Polygons in space, in the coordinates of their file."""

    xyz: NDArray[np.float64]  # (n, 3): vertices of all rings, none of them repeated at the end of its ring
    # (r + 1,): the vertices of ring k are the rows ``ring_start[k]`` to ``ring_start[k + 1]``
    ring_start: NDArray[np.int64]
    face_start: NDArray[np.int64]  # (f + 1,): the rings of each face: the first is its border, others are holes
    kind: NDArray[np.int8]  # (f,): `UNKNOWN`, `ROOF`, `GROUND`, `WALL` or `OUTLINE`

    def __len__(self) -> int:
        return len(self.kind)


@dataclass(frozen=True, eq=False)
class Shape:
    """A building, or a part of it, at one level of detail."""

    owner: str  # id of the building or part that it belongs to
    lod: float  # level of detail; `NO_LOD` where the file states none
    closed: bool  # whether it is a solid: its faces are then oriented outwards
    faces: Faces
    several: bool = False  # whether it is several solids, one after the other


@dataclass(frozen=True, eq=False)
class ModelBuilding:
    """A building of a city model with its parts."""

    id: str  # its id, ``""`` where the file has none
    shapes: tuple[Shape, ...]  # all that is stated of it and its parts
    height: float = float("nan")  # height above ground by an attribute (m), NaN where there is none
    faults: tuple[str, ...] = ()  # what could not be read
    # Attributes of the building and of each of its parts, by id; those of a GeoPackage only where asked for.
    attributes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    # Owners that are neither building nor part: the type of each, by id; a road, say, is an owner alone.
    kinds: Mapping[str, str] = field(default_factory=dict)
    # Storeys and installations: the building or part of each, by id.
    parents: Mapping[str, str] = field(default_factory=dict)
    pictures: "Sequence[Picture]" = ()  # of faces of kind `PICTURED`, in their order


@dataclass
class FaceList:
    """Faces as they are read: vertices of each ring, number of rings of each face, and its kind."""

    rings: list[Any] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    kinds: list[int] = field(default_factory=list)

    def add(self, rings: Sequence[Any], kind: int) -> bool:
        """Add a face by its rings, float64 (k, 3) without a repeated end; whether its border has 3 vertices."""
        kept = [ring for ring in rings if len(ring) >= 3]
        if not kept or len(rings[0]) < 3:
            return False
        self.rings += kept
        self.sizes.append(len(kept))
        self.kinds.append(kind)
        return True

    def done(self) -> Faces:
        """Give all of them as arrays."""
        xyz = np.concatenate([np.empty((0, 3)), *self.rings])
        lengths = np.fromiter(map(len, self.rings), np.int64, len(self.rings))
        return Faces(
            xyz,
            np.concatenate(([0], np.cumsum(lengths))),
            np.concatenate(([0], np.cumsum(np.array(self.sizes, np.int64)))),
            np.array(self.kinds, np.int8),
        )


def join_faces(several: Iterable[Faces]) -> Faces:
    """Put faces one after the other; none gives none."""
    parts = list(several)
    if len(parts) == 1:
        return parts[0]
    first = np.zeros(1, np.int64)
    n_xyz = np.cumsum([0, *(len(faces.xyz) for faces in parts)])
    n_rings = np.cumsum([0, *(len(faces.ring_start) - 1 for faces in parts)])
    return Faces(
        np.concatenate([np.empty((0, 3)), *(faces.xyz for faces in parts)]),
        np.concatenate([first, *(f.ring_start[1:] + n for f, n in zip(parts, n_xyz, strict=False))]),
        np.concatenate([first, *(f.face_start[1:] + n for f, n in zip(parts, n_rings, strict=False))]),
        np.concatenate([np.empty(0, np.int8), *(faces.kind for faces in parts)]),
    )


def check_places(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give vertices back; ValueError where a coordinate is NaN, infinite or beyond `FARTHEST`."""
    if xyz.size and not -FARTHEST <= xyz.min() <= xyz.max() <= FARTHEST:  # not where one is NaN
        raise ValueError(f"a coordinate is no number, or beyond ±{FARTHEST:g}")
    return xyz


def drop_end(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leave out the last vertex where it repeats the first."""
    return ring[:-1] if len(ring) > 1 and (ring[0] == ring[-1]).all() else ring
