"""How faithful a planar city model is: area errors, lost houses, clearance, touching corners (step 2.1)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.roofs import Roofs
from pipeline.roofs.roof_surfaces import square_gaps
from pipeline.simplification.graph import MILLIMETRES, WallGraph, find_close, find_crossings, find_near, make_graph
from pipeline.simplification.labels import Territories
from pipeline.simplification.shaping import Shaped

# Clearances above this (m) are not measured: walls are as good as apart.
FARTHEST = 5.0


@dataclass(frozen=True, eq=False)
class Fidelity:
    """What a simplification did to the houses."""

    #: (n,): area of each house's symmetric difference with its original (m²); the whole area if it is lost
    house_error: NDArray[np.float64]
    area_error: float  #: sum of `house_error` over the sum of the original areas; 0 without houses
    lost: tuple[int, ...]  #: indices of the originals without a face
    #: least distance of two vertices, or of a vertex and a foreign wall, among all walls (m), 0 if walls cross;
    #: `FARTHEST` if that is less
    min_clearance: float
    corner_touches: int  #: vertices in which houses touch without a common wall
    n_walls: int  #: walls, each counted once
    sharpest: float  #: least angle between two walls (degrees), 180 without walls


def measure_simplification(
    originals: NDArray[np.object_], polygons: NDArray[np.object_], house: NDArray[np.int64]
) -> Fidelity:
    """Measure a simplified city against the footprints that it was made of, from its polygons alone.

    Parameters
    ----------
    originals : object, (n,)
        shapely Polygons (m).
    polygons : object, (k,)
        Their simplification: faces that share walls vertex by vertex (m).
    house : int64, (k,)
        Row of the original that each belongs to.

    Examples
    --------
    >>> from pipeline.simplification.planar import shape_planar
    >>> pair = np.array([shapely.box(0, 0, 4, 4), shapely.box(4.4, 0, 9, 4)])
    >>> city = shape_planar(pair, np.zeros(2, int), clearance=0.5, min_area=5.0, min_courtyard_area=5.0)
    >>> found = measure_simplification(pair, city.polygons, city.house)
    >>> found.house_error.round(3).tolist(), found.min_clearance, found.n_walls
    ([1.6, 0.0], 4.0, 7)
    """
    area = shapely.area(originals)
    kept = shapely.area(shapely.intersection(polygons, originals[house]))
    change = shapely.area(polygons) - 2 * kept
    error = area + np.bincount(house, change, len(originals))
    walls, outer = _collect_walls(polygons)
    ends = np.bincount(walls.edges[outer].reshape(-1), minlength=len(walls.xy))
    return Fidelity(
        house_error=error,
        area_error=float(error.sum() / area.sum()) if len(area) else 0.0,
        lost=tuple(np.setdiff1d(np.arange(len(originals)), house).tolist()),
        min_clearance=_measure_clearance(walls) / MILLIMETRES,
        corner_touches=int((ends > 2).sum()),
        n_walls=len(walls.edges),
        sharpest=_find_sharpest(walls),
    )


def find_sharpest(polygons: NDArray[np.object_]) -> float:
    """Find the least angle (degrees) between two walls of polygons, of millimetres, that share walls."""
    return _find_sharpest(_collect_walls(polygons, 1.0)[0])


def measure_moved_roofs(
    territories: Territories, shaped: Shaped, roofs: Roofs, building: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Measure how far roofs are off where walls moved: a face is under the roof of its own house everywhere.

    Parameters
    ----------
    territories, shaped
        Ground of the parts of houses before and after their walls were moved.
    roofs : Roofs
        Roof of each part, NaN where it is not known.
    building : int64, (n,)
        The building of each part.

    Returns
    -------
    float64, (b,)
        RMSE of the roofs of each building (m), over its faces; NaN for those without a known roof or a face.
    """
    known = ~np.isnan(roofs.plane[:, 2])
    n = int(building.max(initial=-1)) + 1
    ours = np.flatnonzero(known[shaped.house])
    faces, house = shaped.polygons[ours], shaped.house[ours]
    at, by = shapely.STRtree(territories.polygons).query(faces, predicate="intersects")
    other = known[territories.house[by]] & (shaped.cluster[ours][at] == territories.cluster[by])
    other &= house[at] != territories.house[by]
    same = shapely.equals_identical(faces[at], territories.polygons[by])
    other &= ~np.isin(at, at[same])
    order = np.lexsort((by[other], at[other]))
    at, by = at[other][order], by[other][order]
    moved = shapely.intersection(faces[at], territories.polygons[by]) if len(at) else np.empty(0, object)
    moved = shapely.transform(moved, lambda xy: xy / MILLIMETRES)
    squares = np.bincount(building[house[at]], square_gaps(moved, roofs, house[at], territories.house[by]), n)
    area = np.bincount(building[house], shapely.area(faces), n) / MILLIMETRES**2
    with np.errstate(invalid="ignore"):
        rmse: NDArray[np.float64] = np.sqrt(squares / area)
    return rmse


def _collect_walls(
    polygons: NDArray[np.object_], unit: float = MILLIMETRES
) -> tuple[WallGraph, NDArray[np.bool_]]:
    """Collect the walls of all polygons, each once; tell which belong to one polygon only."""
    xy, ring = shapely.get_coordinates(shapely.get_rings(polygons), return_index=True)
    start = np.flatnonzero(ring[1:] == ring[:-1])
    rows = np.column_stack((start, start + 1))
    grid = np.rint(xy * unit)
    walls = make_graph(grid, np.zeros(len(xy), np.int64), rows, np.zeros(len(rows)))
    number = np.unique(grid, axis=0, return_inverse=True)[1].reshape(-1)
    code = np.sort(number[rows], axis=1) @ np.array([len(walls.xy), 1])
    _, uses = np.unique(code, return_counts=True)
    return walls, uses == 1


def _measure_clearance(walls: WallGraph) -> float:
    far = FARTHEST * MILLIMETRES
    if len(find_crossings(walls)[0]):
        return 0.0
    _, to_walls = find_close(walls, far)
    _, apart = find_near(walls, far)
    return float(min(to_walls.min(initial=far), apart.min(initial=far)))


def _find_sharpest(walls: WallGraph) -> float:
    vertex, head = walls.edges.T.reshape(-1), walls.edges[:, ::-1].T.reshape(-1)
    way = walls.xy[head] - walls.xy[vertex]
    bearing = np.degrees(np.arctan2(way[:, 1], way[:, 0]))
    order = np.lexsort((bearing, vertex))
    vertex, bearing = vertex[order], bearing[order]
    first, count = np.unique(vertex, return_index=True, return_counts=True)[1:]
    after = np.roll(np.arange(len(vertex)), -1)
    after[first + count - 1] = first
    turn = (bearing[after] - bearing) % 360
    return float(np.minimum(turn, 360 - turn).min(initial=180.0))
