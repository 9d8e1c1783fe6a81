"""Buildings as solids: oriented faces over one table of vertices, for the export (steps 1.7 and 2.4)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.sloped_solids import ROOM, Face, build_cut_solids, put_on_grid, straighten
from pipeline.data.citymodel import CityModel
from pipeline.data.notes import Note
from pipeline.data.roofs import is_flat, roof_heights
from pipeline.geometry.rounding import round_corners

PARTED = 5  # steps of the grid by which corners of courtyards are moved for solids where they meet other rings


@dataclass(frozen=True, eq=False)
class Solids:
    """Solids of buildings at one level of detail: prisms with a roof over each, and others.

    Building ``i`` has the rings ``building_start[i]:building_start[i + 1]``: its shell, counter-clockwise
    seen from above, then its courtyards, clockwise. Ring ``r`` has the corners
    ``ring_start[r]:ring_start[r + 1]``, the first not repeated.
    """

    building_start: NDArray[np.int64]  #: (n + 1,): first ring of each building
    ring_start: NDArray[np.int64]  #: (r + 1,): first corner of each ring
    #: (k,): vertex of each corner at its building's ground and roof; -1 where there is no solid
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    #: (k, 4): vertices of the wall from each corner to the next of its ring, counter-clockwise seen from outside
    walls: NDArray[np.int64]
    has_solid: NDArray[np.bool_]  #: (n,): true where the roof is above the ground on the grid
    #: faces of the buildings whose roof is several faces, by row: these hold instead of the prism
    others: dict[int, list[Face]]


@dataclass(frozen=True, eq=False)
class Levels:
    """Solids of buildings at several levels of detail, on an integer grid."""

    vertices: NDArray[np.int64]  #: (v, 3): grid coordinates, each vertex once, ascending by x, y, z
    footprints: Solids  #: the outlines at their ground: `low` alone, no building has a solid
    #: a level each. Their outlines differ from `footprints` where rings meet, and under sloped roofs
    solids: tuple[Solids, ...]


def build_solids(
    model: CityModel,
    origin: NDArray[np.float64],
    *,
    grid: float,
    blocks: NDArray[np.float64] | None = None,
) -> tuple[Levels, tuple[Note, ...]]:
    """Build the solids of a city model, rounded to a grid.

    Parameters
    ----------
    model : CityModel
        The buildings.
    origin : float64, (3,)
        Point with the grid coordinates (0, 0, 0) (m), itself a multiple of `grid`.
    grid : float
        Spacing of the grid (m).
    blocks : float64, (n, m), optional
        Heights of flat roofs (m) of `m` levels, also 0, after which comes one with the model's own roofs. By
        default there is one level, with the highest place of each roof.

    Returns
    -------
    Levels
        The solids, buildings in the model's order. A footprint that vanishes has no ring.
    tuple of Note
        ``footprint-lost``: a footprint vanishes on the grid. ``footprint-split``: the grid cuts it at a
        neck, the largest part is taken. ``solid-flat``: the highest place of the roof is not above the ground on
        the grid, there is no solid at some level. ``solid-touching``: a ring meets itself or another one in a
        point, where four walls would share a vertical edge; courtyards end `PARTED` steps of the grid before it.
        ``solid-into-ground``: a sloped roof meets the ground, it is raised over that.

    Raises
    ------
    ValueError
        If a footprint is not a Polygon, or a height is not finite.

    Notes
    -----
    Cost is O(k log k) in the corners. Rounding goes through a noded overlay, so no ring becomes
    invalid and no corner is repeated. Faces of sloped roofs are planar but for rounding and the tolerances of
    `sloped_solids`: 7 mm at a grid of 1 mm.

    Examples
    --------
    >>> from pipeline.data.roofs import flat_roofs
    >>> one = np.ones(1)
    >>> square = np.array([shapely.box(0, 0, 2, 2)])
    >>> model = CityModel(
    ...     square, np.array(["a"]), np.array([1]), 0 * one, flat_roofs(3 * one), (("a",),), np.array(["a"])
    ... )
    >>> levels, _ = build_solids(model, np.zeros(3), grid=1.0)
    >>> len(levels.vertices), len(levels.solids[0].walls)
    (8, 4)
    """
    _check(model)
    polygons, notes = _round(model, grid)
    footprints = _list_rings(polygons, origin, grid)
    notes += _part_touching(model, polygons, grid)
    rings = _list_rings(polygons, origin, grid)
    ground = _to_grid(model.ground, origin[2], grid)
    tops = model.roof[:, None] if blocks is None else blocks
    raised = [_raise(rings, ground, top, top[rings.owner]) for top in _to_grid(tops, origin[2], grid).T]
    if blocks is not None:
        on_grid = put_on_grid(model.roofs, model.ground, origin, grid=grid)
        straight = straighten(polygons, model.roofs)
        outline = _list_rings(straight, origin, grid)
        top = on_grid.heights(outline.owner, outline.xy)
        others = build_cut_solids(straight, ground, on_grid)
        raised.append(_raise(outline, ground, _to_grid(model.roof, origin[2], grid), top, others))
        notes += _sunk(model, polygons)
    has_solid = np.all([level.has_solid for level in raised], axis=0)
    on_ground = _raise(footprints, ground, ground, ground[footprints.owner])
    vertices, (outlines, *solids) = _number_levels([on_ground, *raised])
    notes += _flat(model, has_solid)
    return Levels(vertices, outlines, tuple(solids)), tuple(notes)


def repeated_corners(polygon: shapely.Polygon) -> NDArray[np.float64]:
    """Places where rings of a polygon meet each other or themselves, float64 (k, 2).

    Examples
    --------
    >>> hole = [(1, 2), (2, 1), (0, 0)]
    >>> repeated_corners(shapely.Polygon([(0, 0), (5, 0), (5, 5), (0, 5)], [hole])).tolist()
    [[0.0, 0.0]]
    """
    xy, ring = shapely.get_coordinates(shapely.get_rings(polygon), return_index=True)
    corners, times = np.unique(xy[np.diff(ring, prepend=-1) == 0], axis=0, return_counts=True)
    repeated: NDArray[np.float64] = corners[times > 1]
    return repeated


@dataclass(frozen=True, eq=False)
class _Rings:
    """Rings of outlines as of `Solids`: corners on the grid (k, 2), buildings of these, the corner after each."""

    building_start: NDArray[np.int64]
    ring_start: NDArray[np.int64]
    xy: NDArray[np.int64]
    owner: NDArray[np.int64]
    onward: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Raised:
    """Rings with their ground and roof at a level: vertices of corners (k, 3), and of other solids."""

    rings: _Rings
    has_solid: NDArray[np.bool_]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    others: dict[int, tuple[list[Face], NDArray[np.int64]]]


def _list_rings(polygons: NDArray[np.object_], origin: NDArray[np.float64], grid: float) -> _Rings:
    rings, ring_owner = shapely.get_rings(polygons, return_index=True)
    closed, closed_ring = shapely.get_coordinates(rings, return_index=True)
    first = np.diff(closed_ring, prepend=-1) > 0
    xy, corner_ring = closed[~first], closed_ring[~first]
    ring_start = np.searchsorted(corner_ring, np.arange(len(rings) + 1))
    onward = np.arange(1, len(xy) + 1)
    onward[ring_start[1:] - 1] = ring_start[:-1]
    return _Rings(
        np.searchsorted(ring_owner, np.arange(len(polygons) + 1)),
        ring_start,
        _to_grid(xy, origin[:2], grid),
        ring_owner[corner_ring],
        onward,
    )


def _raise(
    rings: _Rings,
    ground: NDArray[np.int64],
    roof: NDArray[np.int64],
    top: NDArray[np.int64],
    others: dict[int, tuple[list[Face], NDArray[np.int64]]] | None = None,
) -> _Raised:
    """Raise rings from the ground to a roof; `top` (k,) is its height at each corner, `roof` (n,) the highest."""
    low = np.column_stack([rings.xy, ground[rings.owner]])
    has_solid = roof > ground
    kept = {row: solid for row, solid in (others or {}).items() if has_solid[row]}
    return _Raised(rings, has_solid, low, np.column_stack([rings.xy, top]), kept)


def _number_levels(levels: Sequence[_Raised]) -> tuple[NDArray[np.int64], tuple[Solids, ...]]:
    """Number the vertices of all levels, each once; the first one has no solids but all feet."""
    used = []
    for level in levels:
        raised = level.has_solid[level.rings.owner]
        raised[np.isin(level.rings.owner, list(level.others))] = False
        used.append(raised)
    tables = [np.empty((0, 3), np.int64)]
    for level, raised in zip(levels, used, strict=True):
        standing = raised | (level is levels[0])
        tables += [level.low[standing], level.high[raised], *(vertices for _, vertices in level.others.values())]
    vertices, index = _number_rows(np.concatenate(tables))
    numbers = iter(np.split(index, np.cumsum([len(table) for table in tables[1:]])[:-1]))
    solids = []
    for level, raised in zip(levels, used, strict=True):
        low, high = np.full((2, len(raised)), -1)
        low[raised | (level is levels[0])] = next(numbers)
        high[raised] = next(numbers)
        rings, others = level.rings, {}
        for row, (faces, _) in level.others.items():
            number = next(numbers)
            others[row] = [(kind, tuple(number[ring] for ring in face)) for kind, face in faces]
        walls = np.column_stack([low, low[rings.onward], high[rings.onward], high])
        solids.append(Solids(rings.building_start, rings.ring_start, low, high, walls, level.has_solid, others))
    return vertices, tuple(solids)


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


def _part_touching(model: CityModel, polygons: NDArray[np.object_], grid: float) -> list[Note]:
    """Part outlines in place where their rings meet, so that no solid has four walls there."""
    notes = []
    for i in np.flatnonzero(shapely.get_num_interior_rings(polygons) > 0):
        places = repeated_corners(polygons[i])
        if len(places):
            polygons[i] = _part(polygons[i], places, grid)
            notes.append(_note("solid-touching", model, i, f"touches itself in {len(places)} points, expected 0"))
    return notes


def _part(polygon: shapely.Polygon, places: NDArray[np.float64], grid: float) -> shapely.Polygon:
    """Move the corners of courtyards at some places into these; the outline as it is if it became invalid."""
    holes = [shapely.get_coordinates(ring)[:-1] for ring in polygon.interiors]
    for hole in holes:
        met = (hole[:, None] == places).all(axis=2).any(axis=1)
        before, after = np.roll(hole, 1, axis=0)[met] - hole[met], np.roll(hole, -1, axis=0)[met] - hole[met]
        hole[met] = np.rint(hole[met] / grid + PARTED * _look_right(before, after)) * grid
    parted = shapely.Polygon(polygon.exterior, holes)
    return parted if parted.is_valid and not len(repeated_corners(parted)) else polygon


def _look_right(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions that halve the angles on the right of corners, from which `before` and `after` lead on (k, 2)."""
    u, v = _unit(after), _unit(before)
    to_left = u[:, 0] * v[:, 1] > u[:, 1] * v[:, 0]  # the smaller angle is on the left
    across = np.column_stack((u[:, 1] - v[:, 1], v[:, 0] - u[:, 0]))  # right of the way from one to the other
    wide = (u * v).sum(axis=1) < 0
    return _unit(np.where(wide[:, None], across, np.where(to_left[:, None], -u - v, u + v)))


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    scaled: NDArray[np.float64] = vectors / np.sqrt((vectors * vectors).sum(axis=1, keepdims=True))
    return scaled


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


def _sunk(model: CityModel, polygons: NDArray[np.object_]) -> list[Note]:
    """Tell of the sloped roofs that meet the ground."""
    xy, owner = shapely.get_coordinates(polygons, return_index=True)
    over = roof_heights(model.roofs, owner, xy) - model.ground[owner]
    lowest = np.full(len(model), np.inf)
    np.minimum.at(lowest, owner, over)
    return [
        _note("solid-into-ground", model, i, f"roof {lowest[i]:.2f} m above ground; least: {ROOM:g} m")
        for i in np.flatnonzero(~is_flat(model.roofs) & (lowest < ROOM))
    ]


def _note(kind: str, model: CityModel, i: np.intp, detail: str) -> Note:
    """Note at a corner of building `i`; NaN where its footprint is empty."""
    x, y = (shapely.bounds(model.polygons[i])[:2]).tolist()
    return Note(kind, str(model.ids[i]), x, y, detail)
