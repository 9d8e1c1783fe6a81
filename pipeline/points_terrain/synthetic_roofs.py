"""Roofs of synthetic houses: flat, shed, gable, hip, pyramid and mansard, over rectangles and L-shapes."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

ROOF_TYPES = ("flat", "shed", "gable", "hip", "pyramid", "mansard")

_FLAT, _SHED, _GABLE, _HIP, _PYRAMID, _MANSARD = range(6)
_SHARES = (0.14, 0.14, 0.30, 0.14, 0.16, 0.12)  # of the types, before some give way to the outline
_SLOPES = np.tan(np.radians((15.0, 55.0)))  # m per m
_STEEP, _SHALLOW = np.tan(np.radians((45.0, 55.0))), np.tan(np.radians((15.0, 25.0)))  # of a mansard roof
_LARGEST_RISE = 12.0  # m from eaves to ridge; wide houses have lower slopes, at least the least one
_LONGEST_PYRAMID = 1.6  # length per width of a house below a pyramid
_RIDGE_ACROSS = 0.3  # share of the houses whose ridge goes along their short side
_EAVES, _EAVES_WAVE, _EAVES_OWN = 4.0, 3.0, 2.5  # m: least, half of what the place adds, and what the house adds
_WAVES = (60.0, 45.0)  # m: houses side by side have eaves of about one height, so that their roofs cross
_INTO_WING = 0.01  # m; outlines are on whole millimetres, so that points lie beside their wing by that
_MOST_PLANES = 8


@dataclass(frozen=True, eq=False)
class RoofShapes:
    """Roofs of ``n`` houses: over a wing the lowest of its planes, where wings overlap the higher of both."""

    kind: NDArray[np.int8]  #: (n,): index into `ROOF_TYPES`
    eaves: NDArray[np.float64]  #: (n,): height of the eaves; of a flat roof its height (m, absolute)
    #: (n + 1,): house ``i`` has the wings ``start[i]`` to ``start[i + 1]``: two of an L-shape with a sloped roof,
    #: else one
    start: NDArray[np.int64]
    centre: NDArray[np.float64]  #: (w, 2): middle of each wing's rectangle in the city's CRS (m)
    axis: NDArray[np.float64]  #: (w, 2): unit vector along its ridge
    half: NDArray[np.float64]  #: (w, 2): half of its length along the ridge and of its width (m)
    #: (w, 8, 3): planes: slopes eastwards and northwards, and height above the wing's centre (m); those not used
    #: are at an infinite height
    plane: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.kind)


def flat_shapes(polygons: NDArray[np.object_], height: NDArray[np.float64]) -> RoofShapes:
    """Give houses flat roofs.

    Parameters
    ----------
    polygons : object, (n,)
        Their outlines.
    height : float64, (n,)
        Heights of their roofs (m, absolute).
    """
    n = len(polygons)
    plane = _no_planes(n)
    plane[:, 0, 2] = height
    rectangle = _envelopes(polygons)
    return RoofShapes(np.full(n, _FLAT, np.int8), height.copy(), np.arange(n + 1), *rectangle, plane)


def draw_roofs(
    polygons: NDArray[np.object_], ground: NDArray[np.float64], flat: NDArray[np.float64], *, seed: int
) -> RoofShapes:
    """Give each house a roof by its number and its place.

    Parameters
    ----------
    polygons : object, (n,)
        Outlines: rectangles and L-shapes have roofs that fit them, others that of a rectangle around them.
    ground : float64, (n,)
        Height that their eaves are measured from (m, absolute).
    flat : float64, (n,)
        Height of the roofs that are drawn flat (m, absolute).
    seed : int
        Not negative; the same seed gives the same roofs, and those of the first houses do not depend on others.

    Returns
    -------
    RoofShapes
        Slopes are 15 to 55 degrees, eaves 4 to 12.5 m above `ground`; houses within some 10 m of each other have
        eaves of about the same height.
    """
    n = len(polygons)
    chance = np.random.default_rng([seed, 2]).random((n, 8))
    kind = np.searchsorted(np.cumsum(_SHARES)[:-1], chance[:, 0], side="right").astype(np.int8)
    corner = _inner_corners(polygons)
    bent = corner >= 0
    centre, axis, half = _envelopes(polygons)
    kind[bent & (kind == _SHED)] = _GABLE
    long = half[:, 0] > _LONGEST_PYRAMID * half[:, 1]
    kind[(kind == _PYRAMID) & (bent | long)] = _HIP
    turned = ~bent & (chance[:, 1] < _RIDGE_ACROSS)
    axis[turned] = np.column_stack((-axis[turned, 1], axis[turned, 0]))
    half[turned] = half[turned, ::-1]
    two = bent & (kind != _FLAT)
    start = np.concatenate(([0], np.cumsum(1 + two))).astype(np.int64)
    house = np.repeat(np.arange(n), 1 + two)
    centre, axis, half = centre[house], axis[house], half[house]
    for k in np.flatnonzero(two).tolist():
        wings = slice(start[k], start[k + 1])
        centre[wings], axis[wings], half[wings] = _wings(polygons[k], int(corner[k]))
    x, y = shapely.get_coordinates(shapely.centroid(polygons)).reshape(-1, 2).T
    wave = np.sin(x / _WAVES[0]) * np.cos(y / _WAVES[1])
    eaves = ground + _EAVES + _EAVES_WAVE * (1 + wave) + _EAVES_OWN * chance[:, 2]
    eaves[kind == _FLAT] = flat[kind == _FLAT]
    plane = _planes(kind[house], eaves[house], axis, half, chance[house])
    return RoofShapes(kind, eaves, start, centre, axis, half, plane)


def take_roofs(shapes: RoofShapes, houses: NDArray[np.int64]) -> RoofShapes:
    """Give the roofs of some houses, in their order (int64, (k,))."""
    count = np.diff(shapes.start)[houses]
    start = np.concatenate(([0], np.cumsum(count)))
    wing = np.arange(start[-1]) + np.repeat(shapes.start[houses] - start[:-1], count)
    of_wings = (each[wing] for each in (shapes.centre, shapes.axis, shapes.half, shapes.plane))
    return RoofShapes(shapes.kind[houses], shapes.eaves[houses], start, *of_wings)


def shape_heights(shapes: RoofShapes, house: NDArray[np.int64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of roofs at places.

    Parameters
    ----------
    shapes : RoofShapes
        Roofs.
    house : int64, (k,)
        Whose roof is wanted at each place.
    xy : float64, (k, 2)
        The places, within the outline of that house (m).

    Returns
    -------
    float64, (k,)
        Heights (m, absolute).

    Examples
    --------
    >>> square = np.array([shapely.box(0, 0, 4, 4)], object)
    >>> shape_heights(flat_shapes(square, np.array([7.5])), np.array([0]), np.array([[1.0, 2.0]])).tolist()
    [7.5]
    """
    height = np.full(len(xy), -np.inf)
    count = np.diff(shapes.start)[house]
    for k in range(int(count.max(initial=0))):
        at = np.flatnonzero(count > k)
        wing = shapes.start[house[at]] + k
        away = xy[at] - shapes.centre[wing]
        a, b, c = np.moveaxis(shapes.plane[wing], 2, 0)
        low = (a * away[:, :1] + b * away[:, 1:] + c).min(axis=1, initial=np.inf)
        u = (away * shapes.axis[wing]).sum(axis=1)
        v = away[:, 1] * shapes.axis[wing, 0] - away[:, 0] * shapes.axis[wing, 1]
        within = (np.abs(np.column_stack((u, v))) <= shapes.half[wing] + _INTO_WING).all(axis=1)
        mine = within | (count[at] == 1)
        height[at[mine]] = np.maximum(height[at[mine]], low[mine])
    return height


def highest_places(shapes: RoofShapes) -> NDArray[np.float64]:
    """Highest place of each roof (m, absolute), float64 (n,): over the middle or a corner of one of its wings."""
    if not len(shapes):
        return np.empty(0)
    places = np.concatenate((shapes.centre[:, None], wing_rings(shapes)), axis=1) - shapes.centre[:, None]
    a, b, c = np.moveaxis(shapes.plane[:, None], 3, 0)
    highest = (a * places[..., :1] + b * places[..., 1:] + c).min(axis=2).max(axis=1)
    result: NDArray[np.float64] = np.maximum.reduceat(highest, shapes.start[:-1])
    return result


def wing_rings(shapes: RoofShapes) -> NDArray[np.float64]:
    """Corners of each wing's rectangle, counter-clockwise, float64 (w, 4, 2)."""
    u = shapes.axis * shapes.half[:, :1]
    v = np.column_stack((-shapes.axis[:, 1], shapes.axis[:, 0])) * shapes.half[:, 1:]
    corners = [-u - v, u - v, u + v, v - u]
    return np.stack([shapes.centre + corner for corner in corners], axis=1)


def _no_planes(n: int) -> NDArray[np.float64]:
    plane = np.zeros((n, _MOST_PLANES, 3))
    plane[:, :, 2] = np.inf
    return plane


def _envelopes(
    polygons: NDArray[np.object_],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Smallest rectangle around each: centre, unit vector along the longer side, half lengths."""
    if not len(polygons):
        return np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2))
    rings = shapely.get_coordinates(shapely.normalize(shapely.oriented_envelope(polygons))).reshape(-1, 5, 2)
    return _rectangles(rings)


def _rectangles(
    rings: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Centre, unit vector along the longer side, and half lengths of rectangles (n, 4 or 5, 2)."""
    first, second = rings[:, 1] - rings[:, 0], rings[:, 2] - rings[:, 1]
    lengths = np.column_stack((np.hypot(*first.T), np.hypot(*second.T)))
    longer = np.where((lengths[:, 0] >= lengths[:, 1])[:, None], first, second)
    axis = longer / lengths.max(axis=1)[:, None]
    return rings[:, :4].mean(axis=1), axis, 0.5 * np.sort(lengths, axis=1)[:, ::-1]


def _inner_corners(polygons: NDArray[np.object_]) -> NDArray[np.int64]:
    """Inner corner of each L-shape, counted along its ring oriented counter-clockwise; -1 for other outlines."""
    found = np.full(len(polygons), -1, np.int64)
    six = (shapely.get_num_coordinates(polygons) == 7) & (shapely.get_num_interior_rings(polygons) == 0)
    rows = np.flatnonzero(six)
    if not len(rows):
        return found
    ring = shapely.get_coordinates(shapely.orient_polygons(polygons[rows])).reshape(-1, 7, 2)[:, :6]
    to, after = np.roll(ring, -1, axis=1) - ring, np.roll(ring, -2, axis=1) - np.roll(ring, -1, axis=1)
    turn = np.roll(to[..., 0] * after[..., 1] - to[..., 1] * after[..., 0], 1, axis=1)
    square = np.abs((to * after).sum(axis=2)) < 0.01 * np.hypot(*to.T).T * np.hypot(*after.T).T
    bent = ((turn < 0).sum(axis=1) == 1) & square.all(axis=1)
    found[rows[bent]] = turn[bent].argmin(axis=1)
    return found


def _wings(
    polygon: shapely.Polygon, corner: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Both wings of an L-shape, which overlap at its outer corner: ridges go along the outer walls."""
    ring = np.roll(shapely.get_coordinates(shapely.orient_polygons(polygon))[:6], -corner, axis=0)
    outer = ring[3]
    one = np.array([outer, ring[4], ring[5], outer + ring[5] - ring[4]])
    two = np.array([outer, outer + ring[1] - ring[2], ring[1], ring[2]])
    centre, axis, half = _rectangles(np.stack((one, two)))
    along = np.stack((ring[4] - outer, ring[2] - outer))
    along /= np.hypot(*along.T)[:, None]
    swap = np.abs((axis * along).sum(axis=1)) < 0.5
    axis[swap], half[swap] = along[swap], half[swap, ::-1]
    return centre, axis, half


def _planes(
    kind: NDArray[np.int8],
    eaves: NDArray[np.float64],
    axis: NDArray[np.float64],
    half: NDArray[np.float64],
    chance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Planes of wings: one a side that slopes, two of mansard roofs."""
    run = half.min(axis=1)
    gabled = (kind == _GABLE) | (kind == _SHED) | ((kind == _MANSARD) & (chance[:, 5] < 0.5))
    run = np.where(gabled, half[:, 1], run) * np.where(kind == _SHED, 2.0, 1.0)
    slope = np.tan(np.radians(15.0 + 40.0 * chance[:, 3]))
    slope = np.minimum(slope, np.maximum(_SLOPES[0], _LARGEST_RISE / run))
    slopes = np.repeat(slope[:, None], 2, axis=1)  # of the gable ends, and of the sides along the ridge
    pyramid = kind == _PYRAMID
    # Both pairs of sides reach the top over the middle; the longer way up has the lower slope.
    slopes[pyramid] = _pyramid_slopes(slope[pyramid], half[pyramid])
    steep = _STEEP[0] + (_STEEP[1] - _STEEP[0]) * chance[:, 3]
    mansard = kind == _MANSARD
    slopes[mansard] = steep[mansard, None]
    upper = _SHALLOW[0] + (_SHALLOW[1] - _SHALLOW[0]) * chance[:, 4]
    turn = run * (0.25 + 0.2 * chance[:, 6])  # from the eaves to where a mansard roof changes its slope
    plane = _no_planes(len(kind))
    plane[kind == _FLAT, 0, 2] = eaves[kind == _FLAT]
    across = np.column_stack((-axis[:, 1], axis[:, 0]))
    shed_side = np.where(chance[:, 7] < 0.5, 2, 3)
    for side in range(4):
        out = (axis, -axis, across, -across)[side]
        far = half[:, side // 2]
        sloped = (kind != _FLAT) & ~(gabled & (side < 2)) & ((kind != _SHED) | (shed_side == side))
        s = slopes[:, side // 2]
        lower = np.column_stack((-s[:, None] * out, eaves + s * far))
        plane[sloped, side] = lower[sloped]
        above = np.column_stack((-upper[:, None] * out, eaves + s * turn + upper * (far - turn)))
        plane[sloped & mansard, 4 + side] = above[sloped & mansard]
    return plane


def _pyramid_slopes(slope: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slopes of the ends and of the sides of pyramids, from that over the shorter way up."""
    rise = np.maximum(slope * half.min(axis=1), _SLOPES[0] * half.max(axis=1))
    rise = np.minimum(rise, _SLOPES[1] * half.min(axis=1))
    slopes: NDArray[np.float64] = rise[:, None] / half
    return slopes
