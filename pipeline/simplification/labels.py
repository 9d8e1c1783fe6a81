"""Which face of the wall graph belongs to which house, and the walls that this makes needless (step 2.1)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs, roof_heights
from pipeline.simplification.graph import MILLIMETRES, Faces, WallGraph, trace_faces

OPEN = -1  # label of open ground and courtyards
# A face is built if houses cover at least this share of it.
BUILT_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Territories:
    """Interior-disjoint pieces of the plane that belong to one house each."""

    polygons: NDArray[np.object_]  #: (t,): shapely Polygons (mm)
    house: NDArray[np.int64]  #: (t,): house of each
    cluster: NDArray[np.int64]  #: (t,): cluster of each


def claim_ground(
    graph: WallGraph, houses: NDArray[np.object_], cluster: NDArray[np.int64], roofs: Roofs | None = None
) -> tuple[WallGraph, Territories]:
    """Share out the faces of the noded walls: what several houses cover goes to the highest or smallest of them.

    Parameters
    ----------
    graph : WallGraph
        All walls of the houses, noded.
    houses : object, (n,)
        Valid shapely Polygons (mm).
    cluster : int64, (n,)
        Their clusters.
    roofs : Roofs, optional
        Known roofs of the houses, NaN where there is none. A face goes to the highest house if the roofs of all
        that cover it are known, or else to the smallest.

    Returns
    -------
    graph : WallGraph
        Without the walls that have the same house, or open ground, on both sides.
    territories : Territories
        What each house has; of two equal ones the first has all.
    """
    faces = trace_faces(graph)
    place = shapely.point_on_surface(faces.polygons)
    at, by = shapely.STRtree(houses).query(place, predicate="intersects")
    same = faces.cluster[at] == cluster[by]
    at, by = at[same], by[same]
    drop = np.zeros(len(at))
    if roofs is not None:
        drop = -roof_heights(roofs, by, shapely.get_coordinates(place)[at] / MILLIMETRES)
        unknown = np.bincount(at, np.isnan(drop), len(place)) > 0
        drop[unknown[at]] = 0.0
    order = np.lexsort((by, shapely.area(houses)[by], drop, at))
    face, first = np.unique(at[order], return_index=True)
    label = np.full(len(faces.polygons), OPEN)
    label[face] = by[order][first]
    graph, faces, label = dissolve(graph, faces, label)
    built = label != OPEN
    return graph, Territories(faces.polygons[built], label[built], faces.cluster[built])


def label_faces(faces: Faces, territories: Territories) -> NDArray[np.int64]:
    """Give each face to the house that covers most of it, or to the open ground.

    Returns
    -------
    int64, (f,)
        House, of equal ones the first; `OPEN` where less than `BUILT_SHARE` of the face was built.
    """
    label = np.full(len(faces.polygons), OPEN)
    at, by = shapely.STRtree(territories.polygons).query(faces.polygons, predicate="intersects")
    same = faces.cluster[at] == territories.cluster[by]
    at, by = at[same], by[same]
    if not len(at):
        return label
    # Sums in one order, whatever other clusters are in the tree.
    order = np.lexsort((by, at))
    at, by = at[order], by[order]
    face_area = shapely.area(faces.polygons)
    area = face_area[at]
    other = ~shapely.equals_identical(faces.polygons[at], territories.polygons[by])
    area[other] = shapely.area(shapely.intersection(faces.polygons[at[other]], territories.polygons[by[other]]))
    pairs, index = np.unique(np.column_stack((at, territories.house[by])), axis=0, return_inverse=True)
    share = np.bincount(index.reshape(-1), area) / face_area[pairs[:, 0]]
    order = np.lexsort((pairs[:, 1], -share, pairs[:, 0]))
    face, first = np.unique(pairs[order, 0], return_index=True)
    built = np.bincount(pairs[:, 0], share, len(faces.polygons))[face] >= BUILT_SHARE
    label[face[built]] = pairs[order, 1][first][built]
    return label


def dissolve(
    graph: WallGraph, faces: Faces, label: NDArray[np.int64]
) -> tuple[WallGraph, Faces, NDArray[np.int64]]:
    """Drop the walls between faces of one label; give the faces that are left and their labels."""
    sides = np.append(label, OPEN)[faces.sides]
    walls = sides[:, 0] != sides[:, 1]
    if walls.all():
        return graph, faces, label
    left = graph.keep(walls)
    # What bounds two faces of different labels lies on a closed ring: nothing dangles, so rows stay in step.
    sides = sides[walls]
    traced = trace_faces(left)
    labels = np.full(len(traced.polygons), OPEN)
    for side in (0, 1):
        bounded = traced.sides[:, side] >= 0
        labels[traced.sides[bounded, side]] = sides[bounded, side]
    return left, traced, labels


def drop_small_faces(
    graph: WallGraph, faces: Faces, label: NDArray[np.int64], *, min_area: float, min_courtyard_area: float
) -> NDArray[np.int64]:
    """Give faces that are too small to the neighbour with the longest common wall.

    Parameters
    ----------
    graph, faces, label
        As `dissolve` leaves them.
    min_area : float
        A face of a house goes if it is smaller, unless it is the house's largest (mm²).
    min_courtyard_area : float
        A courtyard is filled if it is smaller (mm²).

    Returns
    -------
    int64, (f,)
        The new labels.
    """
    area = shapely.area(faces.polygons)
    small = np.where(label == OPEN, area < min_courtyard_area, (area < min_area) & ~_is_largest(label, area))
    label = label.copy()
    sides = np.append(label, OPEN)[faces.sides]
    gives, takes = [], []
    for side in (0, 1):
        face = faces.sides[:, side]
        mine = (face >= 0) & small[face]
        gives.append(np.column_stack((face, sides[:, 1 - side], np.arange(len(face))))[mine])
        takes.append(graph.lengths()[mine])
    rows = np.concatenate(gives)
    pairs, index = np.unique(rows[:, :2], axis=0, return_inverse=True)
    length = np.bincount(index.reshape(-1), np.concatenate(takes), len(pairs))
    order = np.lexsort((pairs[:, 1], -length, pairs[:, 0]))
    face, first = np.unique(pairs[order, 0], return_index=True)
    label[face] = pairs[order, 1][first]
    return label


def _is_largest(label: NDArray[np.int64], area: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which faces are the largest of their label."""
    order = np.lexsort((np.arange(len(label)), -area, label))
    _, first = np.unique(label[order], return_index=True)
    largest = np.zeros(len(label), np.bool_)
    largest[order[first]] = True
    return largest
