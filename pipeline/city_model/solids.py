"""Buildings as solids: oriented faces over one table of vertices, for the export (steps 1.7 and 2.4)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import CityModel
from pipeline.data.notes import Note
from pipeline.geometry.rounding import round_corners


@dataclass(frozen=True, eq=False)
class Solids:
    """Prisms over footprints, on an integer grid.

    Building ``i`` has the rings ``building_start[i]:building_start[i + 1]``: its shell, counter-clockwise
    seen from above, then its courtyards, clockwise. Ring ``r`` has the corners
    ``ring_start[r]:ring_start[r + 1]``, the first not repeated.

    Attributes
    ----------
    vertices : int64, (v, 3)
        Grid coordinates, each vertex once, ascending by x, y, z.
    building_start : int64, (n + 1,)
        First ring of each building.
    ring_start : int64, (r + 1,)
        First corner of each ring.
    low, high : int64, (k,)
        Vertex of each corner at its building's ground and roof; ``high`` is -1 where there is no solid.
    walls : int64, (k, 4)
        Vertices of the wall from each corner to the next of its ring, counter-clockwise seen from outside.
    has_solid : bool, (n,)
        True where the roof is above the ground on the grid.
    """

    vertices: NDArray[np.int64]
    building_start: NDArray[np.int64]
    ring_start: NDArray[np.int64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    walls: NDArray[np.int64]
    has_solid: NDArray[np.bool_]


def build_solids(model: CityModel, origin: NDArray[np.float64], *, grid: float) -> tuple[Solids, tuple[Note, ...]]:
    """Build the solids of a city model, rounded to a grid.

    Parameters
    ----------
    model : CityModel
        The buildings.
    origin : float64, (3,)
        Point with the grid coordinates (0, 0, 0) (m), itself a multiple of `grid`.
    grid : float
        Spacing of the grid (m).

    Returns
    -------
    Solids
        The solids, buildings in the model's order. A footprint that vanishes has no ring.
    tuple of Note
        ``footprint-lost``: a footprint vanishes on the grid. ``footprint-split``: the grid cuts it at a
        neck, the largest part is taken. ``solid-flat``: the roof is not above the ground on the grid,
        there is no solid. ``solid-touching``: a ring meets itself or another one in a point, so four
        walls share a vertical edge.

    Raises
    ------
    ValueError
        If a footprint is not a Polygon, or a height is not finite.

    Notes
    -----
    Cost is O(k log k) in the corners. Rounding goes through a noded overlay, so no ring becomes
    invalid and no corner is repeated.

    Examples
    --------
    >>> one = np.ones(1)
    >>> square = np.array([shapely.box(0, 0, 2, 2)])
    >>> model = CityModel(
    ...     square, np.array(["a"]), np.array([1]), 0 * one, flat_roofs(3 * one), (("a",),), np.array(["a"])
    ... )
    >>> solids, _ = build_solids(model, np.zeros(3), grid=1.0)
    >>> len(solids.vertices), len(solids.walls)
    (8, 4)
    """
    _check(model)
    polygons, notes = _round(model, grid)
    rings, ring_owner = shapely.get_rings(polygons, return_index=True)
    closed, closed_ring = shapely.get_coordinates(rings, return_index=True)
    first = np.diff(closed_ring, prepend=-1) > 0
    xy, corner_ring = closed[~first], closed_ring[~first]
    owner = ring_owner[corner_ring]
    ring_start = np.searchsorted(corner_ring, np.arange(len(rings) + 1))

    heights = _to_grid(np.column_stack([model.ground, model.roof]), origin[2], grid)
    has_solid = heights[:, 1] > heights[:, 0]
    plane = _to_grid(xy, origin[:2], grid)
    raised = has_solid[owner]
    vertices, index = _number_rows(
        np.concatenate(
            [
                np.column_stack([plane, heights[owner, 0]]),
                np.column_stack([plane, heights[owner, 1]])[raised],
            ]
        )
    )
    low, high = index[: len(plane)], np.full(len(plane), -1, dtype=np.int64)
    high[raised] = index[len(plane) :]
    onward = np.arange(1, len(plane) + 1)
    onward[ring_start[1:] - 1] = ring_start[:-1]
    solids = Solids(
        vertices=vertices,
        building_start=np.searchsorted(ring_owner, np.arange(len(model) + 1)),
        ring_start=ring_start,
        low=low,
        high=high,
        walls=np.column_stack([low, low[onward], high[onward], high]),
        has_solid=has_solid,
    )
    return solids, (*notes, *_flat(model, has_solid), *_touching(model, owner, low))


def _check(model: CityModel) -> None:
    odd = np.flatnonzero(shapely.get_type_id(model.polygons) != shapely.GeometryType.POLYGON)
    if len(odd):
        i = odd[0]
        kind = getattr(model.polygons[i], "geom_type", "nothing")
        raise ValueError(f"building {model.ids[i]}: its footprint is a {kind}, must be a Polygon; split it")
    bad = np.flatnonzero(~(np.isfinite(model.ground) & np.isfinite(model.roof)))
    if len(bad):
        i = bad[0]
        raise ValueError(
            f"building {model.ids[i]}: ground {model.ground[i]} m and roof {model.roof[i]} m must be finite"
        )


def _round(model: CityModel, grid: float) -> tuple[NDArray[np.object_], list[Note]]:
    """Put footprints on the grid, still valid, shells counter-clockwise."""
    notes = []
    polygons, clear = round_corners(model.polygons, grid)
    clear &= shapely.get_num_interior_rings(polygons) == 0
    polygons[clear] = _begin_earlier(shapely.orient_polygons(polygons[clear]))
    polygons[~clear] = shapely.set_precision(model.polygons[~clear], grid, mode="valid_output")
    for i in np.flatnonzero(shapely.get_type_id(polygons) != shapely.GeometryType.POLYGON):
        parts = shapely.get_parts(polygons[i])
        polygons[i] = parts[np.argmax(shapely.area(parts))]
        notes.append(_note("footprint-split", model, i, f"{len(parts)} parts on a grid of {grid} m"))
    notes += [
        _note("footprint-lost", model, i, f"no area on a grid of {grid} m")
        for i in np.flatnonzero(shapely.is_empty(polygons))
    ]
    return shapely.orient_polygons(polygons), notes


def _begin_earlier(polygons: NDArray[np.object_]) -> NDArray[np.object_]:
    """Begin each ring of polygons without courtyards one corner earlier, as those of a noded overlay begin."""
    xy, owner = shapely.get_coordinates(polygons, return_index=True)
    n_corners = np.bincount(owner, minlength=len(polygons))
    before = np.arange(len(xy)) - 1
    before[np.cumsum(n_corners) - n_corners] += n_corners - 1  # the last corner of a ring is its first again
    turned: NDArray[np.object_] = shapely.set_coordinates(polygons, xy[before])
    return turned


def _to_grid(values: NDArray[np.float64], origin: NDArray[np.float64], grid: float) -> NDArray[np.int64]:
    return np.rint((values - origin) / grid).astype(np.int64)


def _number_rows(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give the distinct rows in ascending order, and the place of each row among them."""
    order = np.lexsort(rows.T[::-1])
    ranked = rows[order]
    new = np.ones(len(rows), dtype=np.bool_)
    new[1:] = np.any(ranked[1:] != ranked[:-1], axis=1)
    index = np.empty(len(rows), dtype=np.int64)
    index[order] = np.cumsum(new) - 1
    return ranked[new], index


def _flat(model: CityModel, has_solid: NDArray[np.bool_]) -> list[Note]:
    return [
        _note("solid-flat", model, i, f"roof {model.roof[i]:.3f} m, ground {model.ground[i]:.3f} m")
        for i in np.flatnonzero(~has_solid)
    ]


def _touching(model: CityModel, owner: NDArray[np.int64], low: NDArray[np.int64]) -> list[Note]:
    pairs, times = np.unique(np.column_stack([owner, low]), axis=0, return_counts=True)
    touching, points = np.unique(pairs[times > 1, 0], return_counts=True)
    return [
        _note("solid-touching", model, i, f"touches itself in {count} points, expected 0")
        for i, count in zip(touching, points, strict=True)
    ]


def _note(kind: str, model: CityModel, i: np.intp, detail: str) -> Note:
    """Note at a corner of building `i`; NaN where its footprint is empty."""
    x, y = (shapely.bounds(model.polygons[i])[:2]).tolist()
    return Note(kind, str(model.ids[i]), x, y, detail)
