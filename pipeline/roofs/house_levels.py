"""Houses divided where their roofs step: a low annex behind a tall front house (after step 1.5, ours)."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.geometry.group_order import sort_points
from pipeline.geometry.outlines import Outline, open_outline, points_by_piece
from pipeline.geometry.rings import make_canonical
from pipeline.geometry.segments import add_places
from pipeline.roofs.cuts import cut_best
from pipeline.roofs.lines import sum_squares
from pipeline.roofs.regions import join_cells
from pipeline.roofs.roof_points import RoofPoints

SPREAD = 0.3  # m², a cell stays whole if its squares are less than this for each point of its house
STRAIGHT = 1e-3  # m, square root of the area of the triangle at a vertex that is dropped as straight

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LevelOptions:
    """When a house is divided."""

    clearance: float  #: a new wall passes through a vertex or keeps this distance from it (m)
    min_step: float = 2.5  #: least step of the roof at every new wall (m)
    min_area: float = 15.0  #: least area of a part (m²)
    min_points: int = 10  #: least number of roof points of a part
    #: least share of the squares around the mean height of a house that its division takes away
    min_explained: float = 0.35
    max_depth: int = 8  #: how often a piece is cut in two: 1 for one cut through a house, 0 for none


@dataclass(frozen=True, eq=False)
class HouseParts:
    """Houses, some of them divided."""

    #: (p,): shapely Polygons (m): the parts of each house one after the other, or the house itself
    polygons: NDArray[np.object_]
    house: NDArray[np.int64]  #: (p,): row of the house that the part belongs to, ascending


def split_levels(polygons: NDArray[np.object_], points: RoofPoints, options: LevelOptions) -> HouseParts:
    """Divide houses along straight cuts, parallel to their walls, where their roofs step.

    Parameters
    ----------
    polygons : object, (b,)
        Valid shapely Polygons (m), courtyards as holes.
    points : RoofPoints
        Their roof points, as from `locate_roof_points`.

    Returns
    -------
    HouseParts
        Parts in canonical form that cover each house without overlap and share their vertices to the bit; a
        house that is not divided keeps its polygon, to the bit.

    Raises
    ------
    ValueError
        If the options are out of range, or polygons and points do not match.

    Notes
    -----
    A house is cut in two where its points fall best into two heights, its pieces again, down to `max_depth`
    or until little is left to gain. Then neighbouring pieces are joined, too small ones first, then those
    with the closest medians, until the roof steps by `min_step` at every wall that is left. The step at a
    wall is the lesser of two: that between the medians of both parts, and that between the medians of the
    points within 2 m of the wall. So a gable or a shed roof, which slopes without a step, is not divided, and
    parts may be L-shaped, in three pieces or around a courtyard without a rule of their own. The house is
    left whole if all this explains less than `min_explained`.

    A new wall ends on an outer wall within 1 nm of it, at a vertex that only the parts have: the house next
    door does not, until the walls of both are noded. Houses do not see each other; points count once for
    each house that contains them.
    """
    _check(polygons, points, options)
    found = _divide(polygons, points, options)
    parts = [part for i, polygon in enumerate(polygons) for part in found.get(i, [polygon])]
    count = np.ones(len(polygons), np.int64)
    count[list(found)] = [len(pieces) for pieces in found.values()]
    result = np.empty(len(parts), dtype=object)
    result[:] = parts
    return HouseParts(result, np.repeat(np.arange(len(polygons)), count))


def _divide(
    polygons: NDArray[np.object_], points: RoofPoints, options: LevelOptions
) -> dict[int, list[shapely.Polygon]]:
    """Try all houses whose heights alone leave room for a step; of each of them its parts, or itself."""
    found, areas = {}, shapely.area(polygons).tolist()
    for i, (first, stop) in enumerate(pairwise(points.start.tolist() if options.max_depth else [])):
        z = points.z[first:stop]
        if _may_step(areas[i], z, options) and _squares(z) >= _least_squares(len(z), areas[i], options):
            # What is found must not depend on the order of the points; most houses need not be sorted for it.
            xyz = sort_points(np.array([0, stop - first]), points.xyz[first:stop])
            found[i] = _split(polygons[i], xyz, options)
    return found


def _split(polygon: shapely.Polygon, xyz: Array, options: LevelOptions) -> list[shapely.Polygon]:
    cells, points = _cut_to_cells(polygon, xyz, options)
    if len(cells) == 1:
        return [polygon]
    region, within = join_cells(
        cells,
        points,
        min_step=options.min_step,
        min_area=options.min_area,
        min_points=options.min_points,
    )
    if not region.any() or within > (1 - options.min_explained) * _squares(xyz[:, 2]):
        return [polygon]
    pieces = np.array([cell.polygon for cell in cells], dtype=object)
    dissolved = np.array(
        [shapely.coverage_union_all(pieces[region == k]) for k in np.unique(region)], dtype=object
    )
    return list(make_canonical(shapely.coverage_simplify(dissolved, STRAIGHT)))


def _cut_to_cells(
    polygon: shapely.Polygon, xyz: Array, options: LevelOptions
) -> tuple[list[Outline], list[Array]]:
    """Cut a house into cells that share all vertices, and deal out its points."""
    todo = [(open_outline(polygon), xyz, options.max_depth)]
    cells: list[Outline] = []
    points: list[Array] = []
    corners = np.empty((0, 2))
    least = _least_squares(len(xyz), polygon.area, options)
    while todo:
        piece, inside, depth = todo.pop()
        if depth > 0 and _may_step(piece.area, inside[:, 2], options) and _squares(inside[:, 2]) >= least:
            pieces, ends = cut_best(
                piece.with_corners(corners),
                inside,
                clearance=options.clearance,
                min_area=options.min_area,
                min_points=options.min_points,
            )
            if len(pieces):
                corners = add_places(corners, ends)
                todo.extend((part, within, depth - 1) for part, within in points_by_piece(pieces, inside))
                continue
        cells.append(piece)
        points.append(inside)
    return [cell.with_corners(corners) for cell in cells], points


def _may_step(area: float, z: Array, options: LevelOptions) -> bool:
    """Tell whether two parts with medians `min_step` apart are possible; `z` is ascending."""
    half = max(options.min_points // 2, 1)
    enough = len(z) >= 2 * options.min_points and area >= 2 * options.min_area
    return enough and bool(z[-half] - z[half - 1] >= options.min_step)


def _least_squares(n_points: int, area: float, options: LevelOptions) -> float:
    """Squares around the mean height of a house of so many points, or of its piece, below which it stays whole."""
    smallest = n_points * options.min_area / area  # points of the smallest part
    return max(SPREAD * n_points, smallest * options.min_step**2)


def _squares(z: Array) -> float:
    return float(sum_squares(np.ascontiguousarray(z)))


def _check(polygons: NDArray[np.object_], points: RoofPoints, options: LevelOptions) -> None:
    if len(points.start) != len(polygons) + 1:
        raise ValueError(f"{len(polygons)} polygons do not match the points of {len(points.start) - 1}")
    lengths = (options.clearance, options.min_step, options.min_area)
    if not (all(length > 0 for length in lengths) and options.min_points >= 1 and options.max_depth >= 0):
        raise ValueError(f"clearance, min_step and min_points must be positive, max_depth not negative: {options}")
