"""Meshes as arrays: the plane mesh, the columns over it, and the explicit tetrahedra and boundary."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.data.regions import Region, Regions


class Marker(IntEnum):
    """What a facet bounds; ground with soil below, and walls and roofs of solids, have cells on both sides."""

    GROUND = 1
    WALL = 2
    ROOF = 3
    TOP = 4
    WEST = 5
    EAST = 6
    SOUTH = 7
    NORTH = 8
    MISSING = 9  # a seam whose other tile is not there
    BOTTOM = 11  # what the soil ends at; 10 is the number of the air in Gmsh's files
    FOUNDATION = 12  # the soil's top under a building, or without soil the floor of a solid


# Markers from here on are ground, too: that of the patches of land cover, by number from 1.
GROUND_PATCHES = 30


def is_ground(marker: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Tell which facets (f,) are ground, of any patch."""
    found: NDArray[np.bool_] = (marker == Marker.GROUND) | (marker > GROUND_PATCHES)
    return found


# Markers of the facets between two regions, where a mesh has both: they point out of the first.
INTERFACES = {
    (Region.AIR, Region.SOIL): (Marker.GROUND,),
    (Region.AIR, Region.BUILDING): (Marker.WALL, Marker.ROOF),
    (Region.SOIL, Region.BUILDING): (Marker.FOUNDATION,),
}


def find_inside(marker: NDArray[np.int32], regions: Regions) -> NDArray[np.bool_]:
    """Tell which facets (f,) have cells on both sides in a mesh of some regions.

    Examples
    --------
    >>> find_inside(np.array([Marker.GROUND, Marker.WALL], np.int32), (Region.AIR, Region.SOIL)).tolist()
    [True, False]
    """
    found = [mark for pair, marks in INTERFACES.items() if {*pair} <= {*regions} for mark in marks]
    inside: NDArray[np.bool_] = np.isin(marker, found)
    return inside | is_ground(marker) if Marker.GROUND in found else inside


@dataclass(frozen=True, eq=False)
class PlaneMesh:
    """Triangulation of the plane with the walls as edges (step 3.1)."""

    #: (n, 2): vertices in the region's CRS (m), sorted by (x, y): local order is region-wide order
    xy: NDArray[np.float64]
    #: (m, 3): vertex indices, ascending in each row; orientation is that of the coordinates
    triangles: NDArray[np.int32]
    #: (m,): row of the city model whose footprint holds the triangle, -1 on open ground
    building: NDArray[np.int32]


# How the segments of neighbouring columns are merged: see `ColumnMesh.order`.
MergeOrder = Literal["levels", "heights"]


@dataclass(frozen=True, eq=False)
class ColumnMesh:
    """Columns of vertices over a plane mesh: the volume mesh until a file is written."""

    plane: PlaneMesh  #: the triangles that the columns stand on
    z_start: NDArray[np.int64]  #: (n + 1,): column ``i`` has the levels ``z[z_start[i]:z_start[i + 1]]``
    z: NDArray[np.float64]  #: (z_start[-1],): heights of the levels (m), ascending in every column
    #: (m, 3): for each corner of a triangle, the level of that corner's column where the triangle's cells begin:
    #: the ground, or the roof in a building
    bottom: NDArray[np.int32]
    #: which column's next segment comes first where columns are merged into cells: the one with the most segments
    #: left above it (the paper's equations 1-3), or the one whose middle is lowest. Ties go to the highest vertex.
    #: Either order is that of two columns alone, so any cells that it makes conform
    order: MergeOrder = "levels"
    #: what takes the place of heights in the order "heights", ascending in every column: beside steep tops of
    #: walls it differs from them. By default it is `z`
    key: NDArray[np.float64] | None = None
    #: where roofs slope, by how much each level was moved that stands for one, for the sake of cells (m)
    moved: NDArray[np.float64] | None = None

    @property
    def merge_keys(self) -> NDArray[np.float64]:
        """Keys by which columns are merged: `key`, or the heights."""
        return self.z if self.key is None else self.key


@dataclass(frozen=True, eq=False)
class SeamEdges:
    """Outer edges of a tile's plane mesh that are seams, and what lies beyond them."""

    vertices: NDArray[np.int32]  #: (k, 2): vertices of each edge, ascending
    #: (k, 2): for each of the two, the level of its column where the cells beyond the edge begin. Not read where
    #: `missing`
    bottom: NDArray[np.int32]
    building: NDArray[np.int64]  #: (k,): number of the building beyond, -1 on open ground
    missing: NDArray[np.bool_]  #: (k,): whether there is no tile beyond


@dataclass(frozen=True, eq=False)
class TetMesh:
    """Explicit tetrahedra."""

    points: NDArray[np.float64]  #: (n, 3): vertices in the region's CRS (m)
    cells: NDArray[np.int32]  #: (m, 4): vertex indices; ``det(p1 - p0, p2 - p0, p3 - p0) > 0`` in every row


@dataclass(frozen=True, eq=False)
class Boundary:
    """The boundary of a `TetMesh` as marked triangles."""

    facets: NDArray[np.int32]  #: (k, 3): indices of the mesh's points, counter-clockwise seen from outside the air
    marker: NDArray[np.int32]  #: (k,): a `Marker` value each
    #: (k,): number of the building (`CityModel.numbers`) that a wall or roof belongs to, -1 elsewhere
    building: NDArray[np.int64]
