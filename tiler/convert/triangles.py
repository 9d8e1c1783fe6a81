"""Buildings at one level of detail as triangles, for formats of surfaces."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.facades.pictures import Picture
from tiler.cityinput.face_planes import cut_face
from tiler.cityinput.faces import PICTURED, Faces, join_faces
from tiler.cityinput.levels import best_shapes
from tiler.convert.features import plain_value, rings_of
from tiler.convert.inputs import ModelSource


@dataclass(frozen=True, eq=False)
class SolidBuilding:
    """A building as triangles."""

    id: str
    attributes: dict[str, Any]  # its own, then those of its parts that it has not itself
    xyz: NDArray[np.float64]  # (n, 3): vertices
    # (t, 3): their corners, counter-clockwise seen from the side that the faces look to
    triangles: NDArray[np.int64]
    kind: NDArray[np.int8]  # (t,): kind of the face that each is of
    pictures: Sequence[Picture]  # of faces of kind `PICTURED`
    picture: NDArray[np.int64]  # (p,): which of them each triangle of that kind shows


def iter_triangles(source: ModelSource, lod: str) -> Iterator[SolidBuilding]:
    """Give each building that has surfaces, of the shapes that `levels.best_shapes` gives."""
    for building in source.buildings():
        shapes = best_shapes(building, lod)
        if not shapes:
            source.told["buildings without surfaces above level 0"] += bool(building.shapes)
            continue
        faces = join_faces(shape.faces for shape in shapes)
        xyz, number = np.unique(np.round(faces.xyz / source.step), axis=0, return_inverse=True)
        xyz = xyz * source.step
        triangles, face, n_fans = triangulate(faces, xyz, number.ravel().tolist())
        source.told["faces that cross themselves, cut into triangles around a corner"] += n_fans
        parts = [own for owner, own in building.attributes.items() if owner not in building.kinds]
        attributes = {key: value for own in parts for key, value in own.items()}
        attributes |= building.attributes.get(building.id, {})
        kept = {key: plain_value(value) for key, value in attributes.items()}
        if len(triangles):
            kind, shown = faces.kind[face], np.cumsum(faces.kind == PICTURED) - 1
            picture = shown[face[kind == PICTURED]]
            yield SolidBuilding(building.id, kept, xyz, triangles, kind, building.pictures, picture)


def triangulate(
    faces: Faces, xyz: NDArray[np.float64], number: list[int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Cut faces, polygons with holes, into triangles.

    `xyz`, float64 (n, 3), are places, each there once, and `number` says which of them each vertex of the faces is
    at. Gives corners of triangles as rows of `xyz`, int64 (t, 3), their faces, int64 (t,), and how many faces are
    no polygons in their plane: triangles meet in their first corner.
    """
    found: list[list[int]] = []
    of: list[int] = []
    n_fans = 0
    for k, (_, rings) in enumerate(rings_of(faces, number)):
        if not rings:
            continue
        parts = [rings[0]] if len(rings) == 1 and len(rings[0]) == 3 else cut_face(rings, xyz)
        if parts is None:
            n_fans += 1
            parts = [[rings[0][0], a, b] for a, b in pairwise(rings[0][1:])]
        found += parts
        of += [k] * len(parts)
    return np.array(found, np.int64).reshape(-1, 3), np.array(of, np.int64), n_fans
