"""Buildings at lower levels of detail: flat parts, or one height for each outline (after step 2.3, ours).

The model is made in full first. So all houses whose level is the full one are as they would be without.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import merge_building_points
from pipeline.city_model.city import City
from pipeline.city_model.groups import group_roofs
from pipeline.city_model.roof_areas import block_heights, measure_roof_areas
from pipeline.data.citymodel import CityModel, number_ids
from pipeline.data.roofs import choose_roofs, flat_roofs, take_roofs
from pipeline.geometry.components import join_pairs
from pipeline.geometry.rings import make_canonical
from pipeline.roofs.house_roofs import FLAT
from pipeline.simplification.roof_crossings import party_walls

FULL, PARTS, BLOCK = 0, 1, 2  # as made; flat parts, LoD1.3; one height, LoD1.2


def reduce_detail(
    city: City, detail: NDArray[np.integer[Any]], *, step: float, clearance: float, tolerance: float
) -> tuple[City, NDArray[np.int64]]:
    """Lower the level of detail of some houses.

    Parameters
    ----------
    city : City
        Buildings of whole clusters, faces of one planar graph, with all parts of each house.
    detail : int, (n,)
        `FULL`, `PARTS` or `BLOCK` for each row, the same for all rows of a house.
    step : float
        Flat parts of a house that are closer in height than this (m) are joined.
    clearance : float
        Least height of a roof above the highest terrain at its walls (m).
    tolerance : float
        Vertices that no other wall meets are dropped where they are closer than this (m) to the line between
        their neighbours.

    Returns
    -------
    City
        Rows of houses with `FULL` as they were, to the bit. Of others, parts that share walls are one row with the
        mean height of their roofs, so that volumes stay; a house of one row has its own id.
    int64, (n,)
        The row of the result that each row became a part of.
    """
    model = city.model
    label, height = _join_parts(model, detail, step)
    _, first, row = np.unique(label, return_index=True, return_inverse=True)
    row = row.reshape(-1)
    changed = detail[first] != FULL
    order, count = np.argsort(row, kind="stable"), np.bincount(row)
    members = tuple(np.split(order, np.cumsum(count)[:-1]))
    polygons = model.polygons[first].copy()
    for k in np.flatnonzero(changed & (count > 1)).tolist():
        (polygons[k],) = shapely.get_parts(shapely.coverage_union_all(model.polygons[members[k]]))
    polygons = drop_straight(polygons, changed, tolerance)
    wall_ground = np.array([city.wall_ground[rows].max() for rows in members])
    mean = height[first]
    roofs = choose_roofs(
        changed, flat_roofs(np.maximum(mean, wall_ground + clearance)), take_roofs(model.roofs, first)
    )
    house = model.house[first]
    ids = np.where(changed & (_count(house) == 1), house, model.ids[first])
    ground = np.array([model.ground[rows].min() for rows in members])
    reduced = CityModel(
        polygons, ids, number_ids(ids), ground, roofs, tuple(model.members[k] for k in first.tolist()), house
    )
    return replace(
        city,
        model=reduced,
        points=merge_building_points(city.points, members),
        given_height=city.given_height[first],
        forms=city.forms[first],
        roof_source=np.array([city.roof_source[rows].min() for rows in members], np.int8),
        wall_ground=wall_ground,
        measured_roof=np.where(changed, mean, city.measured_roof[first]),
        group=np.arange(len(first), dtype=np.int32),
        row=city.row[first],
        roof_method=np.where(changed, FLAT, city.roof_method[first]).astype(np.int8),
        roof_fallback=np.where(changed, 0, city.roof_fallback[first]).astype(np.int8),
        roof_form=city.roof_form[first],
    ), row


def _join_parts(
    model: CityModel, detail: NDArray[np.integer[Any]], step: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Name the rows that become one by their first, and give the height of each (m)."""
    _, sides = party_walls(model.polygons)
    within = sides[model.house[sides[:, 0]] == model.house[sides[:, 1]]]
    mean, area = measure_roof_areas(model.polygons, model.roofs).mean, shapely.area(model.polygons)
    pairs = within[detail[within[:, 0]] == PARTS]
    height, group = group_roofs(mean, area, pairs, key=model.ids, threshold=step)
    same = (detail[within[:, 0]] == BLOCK) | (group[within[:, 0]] == group[within[:, 1]])
    label = join_pairs(len(model), within[same & (detail[within[:, 0]] != FULL)])
    return label, np.where(detail == BLOCK, block_heights(model)[:, 0], height)


def _count(names: NDArray[np.str_]) -> NDArray[np.int64]:
    """How often each name occurs."""
    _, index, count = np.unique(names, return_inverse=True, return_counts=True)
    return np.asarray(count[index.reshape(-1)])


def drop_straight(
    polygons: NDArray[np.object_], changed: NDArray[np.bool_], tolerance: float
) -> NDArray[np.object_]:
    """Drop vertices in straight walls that meet no other wall.

    Parameters
    ----------
    polygons : object, (n,)
        Faces of one planar graph that share vertices to the bit.
    changed : bool, (n,)
        Those that may lose vertices; what the others have stays in all.
    tolerance : float
        How far from the line between its neighbours a vertex may be (m).

    Returns
    -------
    object, (n,)
        Changed ones in canonical form, the others themselves; faces still share their vertices.

    Examples
    --------
    >>> house = shapely.Polygon([(0, 0), (2, 0), (4, 0), (4, 3), (0, 3)])
    >>> print(drop_straight(np.array([house]), np.array([True]), 0.01)[0])
    POLYGON ((0 0, 4 0, 4 3, 0 3, 0 0))
    """
    if not changed.any():
        return polygons
    rings, of = shapely.get_rings(polygons, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    open_rows = np.append(ring[1:] == ring[:-1], False)  # without the repeated first vertex of each ring
    xy, ring = xy[open_rows], ring[open_rows]
    unique, vertex = np.unique(np.ascontiguousarray(xy + 0.0).view(np.complex128).ravel(), return_inverse=True)
    vertex, place = vertex.reshape(-1), unique.view(np.float64).reshape(-1, 2)
    kept = np.zeros(len(unique), np.bool_)
    kept[vertex[~changed[of[ring]]]] = True
    while True:
        start = np.flatnonzero(np.diff(ring, prepend=-1))
        length = np.diff(np.append(start, len(ring)))
        at, within = np.arange(len(ring)), np.repeat(start, length)
        before = within + (at - within - 1) % np.repeat(length, length)
        after = within + (at - within + 1) % np.repeat(length, length)
        ends = np.sort(np.stack((vertex, vertex[after]), axis=1), axis=1)
        degree = np.bincount(np.unique(ends, axis=0).ravel(), minlength=len(unique))
        a, b, p = place[vertex[before]], place[vertex[after]], place[vertex]
        across = b - a
        span = np.hypot(*across.T)
        off = np.abs(across[:, 0] * (p - a)[:, 1] - across[:, 1] * (p - a)[:, 0]) / np.maximum(span, 1e-9)
        along = ((p - a) * across).sum(axis=1)
        bad = (off > tolerance) | (along <= 0) | (along >= span**2) | (np.repeat(length, length) <= 4)
        free = ~kept & (degree == 2)
        free[vertex[bad]] = False
        # Of neighbours that may go, those smallest in (x, y) do, and the others in the next round.
        first = free[vertex] & ~(free[vertex[before]] & (vertex[before] < vertex))
        gone = np.zeros(len(unique), np.bool_)
        gone[vertex[first & ~(free[vertex[after]] & (vertex[after] < vertex))]] = True
        if not gone.any():
            break
        left = ~gone[vertex]
        vertex, ring = vertex[left], ring[left]
    result = polygons.copy()
    made = shapely.polygons(shapely.linearrings(place[vertex], indices=ring), indices=of)
    result[changed] = make_canonical(made[changed])
    return result
