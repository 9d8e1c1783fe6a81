"""A synthetic city as arrays: hills, a pond, buildings, and the points that a flight would give."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.classes import BUILDING, GROUND, HIGH_NOISE, HIGH_VEGETATION, LOW_NOISE, UNCLASSIFIED, WATER
from pipeline.data.errors import GeometryError
from pipeline.data.pointcloud import PointCloud
from pipeline.geometry.inside import find_inside
from pipeline.points_terrain.synthetic_roofs import (
    RoofShapes,
    draw_roofs,
    flat_shapes,
    highest_places,
    shape_heights,
    take_roofs,
)

ROOFS = ("flat", "mixed")
ORIGIN = (318_000.0, 6_399_000.0)  # lower left corner in EPSG:3006 (m): western Sweden, as in the paper

_BASE = 10.0  # m, lowest ground
_N_WAVES = 8
_HEIGHTS = (5.0, 40.0)  # m above ground
_LARGEST_RADIUS = 18.0  # m, circle around a building or a pair
_LEAST_RADIUS = 2.5  # m, of the largest circle
_FILLING = 0.36  # largest radius per mean spacing; from about 0.45 circles placed at random find no room
_TOUCHING, _OVERLAPPING = 0.08, 0.02  # pairs per building
_ROWS, _IN_ROW = 0.04, 4  # rows of terraced houses per building, with mixed roofs; houses in one
_L_SHAPED = 0.4  # share of the single buildings
_MAX_ROUNDS = 500
# Shares of the points in open space, and of all points for noise.
_VEGETATION, _UNCLASSIFIED, _NOISE = 0.05, 0.01, 0.0005
_WATER_RETURNS = 0.25  # share of the points on water that come back
_GROUND_SIGMA, _ROOF_SIGMA = 0.03, 0.05  # m


@dataclass(frozen=True, eq=False)
class SyntheticCity:
    """Hills, a pond and buildings on a square."""

    size: float  #: side of the square (m); its lower left corner is `ORIGIN`
    density: float  #: points per square metre
    seed: int  #: what all of it was drawn from
    #: (8, 4): terrain as a sum of sines: wave numbers in x and y (1/m), phase, amplitude (m)
    waves: NDArray[np.float64]
    base: float  #: height (m) to which the waves are added
    #: (4,): centre x, y, radius and water level (m); the shore is blended into the hills over one more radius
    pond: NDArray[np.float64]
    polygons: NDArray[np.object_]  #: (n,): footprints as shapely Polygons, coordinates on whole millimetres
    ids: NDArray[np.str_]  #: (n,): their ids
    #: (n,): terrain at the centroid, and the flat roof above it, or the highest place of another roof (m,
    #: absolute)
    ground: NDArray[np.float64]
    roof: NDArray[np.float64]
    roofs: str  #: one of `ROOFS`
    shapes: RoofShapes  #: the roofs


class _Counts(NamedTuple):
    """How many circles hold a building, a pair that touches, a pair that overlaps, and a row."""

    single: int
    touching: int
    overlapping: int
    rows: int


def make_city(
    *, size: float, buildings: int, density: float, relief: float, seed: int, roofs: str = "flat"
) -> SyntheticCity:
    """Make a city of randomly placed and rotated buildings (paper, section 2.2, benchmark b).

    Parameters
    ----------
    size : float
        Side of the square (m).
    buildings : int
        Number of footprints: rectangles and L-shapes, 8 pairs in a hundred that share a wall exactly, and
        2 in a hundred that overlap.
    density : float
        Points per square metre.
    relief : float
        Highest minus lowest ground (m).
    seed : int
        Not negative; the same seed gives the same city.
    roofs : str
        "flat", or "mixed": flat, shed, gable, hip, pyramid and mansard roofs, and 16 buildings in a hundred in
        rows of four that share walls.

    Returns
    -------
    SyntheticCity

    Raises
    ------
    ValueError
        If a parameter is out of range, or there is no room for so many buildings.
    GeometryError
        If chance left no room for some of them.

    Notes
    -----
    Cost grows like n log n: buildings are placed as circles, in rounds, and a round keeps each circle
    that meets none before it.

    Examples
    --------
    >>> city = make_city(size=200, buildings=20, density=1.5, relief=5, seed=1)
    >>> len(city.polygons), len(set(city.ids))
    (20, 20)
    """
    spacing = size / max(buildings, 1) ** 0.5
    radius = min(_FILLING * spacing, size / 6, _LARGEST_RADIUS)
    if roofs not in ROOFS:
        raise ValueError(f"roofs {roofs!r}; one of {', '.join(ROOFS)}")
    if not (0 < size < 1e6 and buildings >= 0 and density >= 0 and relief >= 0 and seed >= 0):
        raise ValueError(f"size {size}, buildings {buildings}, density {density}, relief {relief}, seed {seed}")
    if radius < _LEAST_RADIUS:
        most = int((_FILLING * size / _LEAST_RADIUS) ** 2)
        raise ValueError(f"{buildings} buildings do not fit on {size:g} m x {size:g} m; ask for at most {most}")
    rng = np.random.default_rng([seed, 0])
    waves, base = _hills(rng, size, relief)
    n_touching = max(int(_TOUCHING * buildings), int(buildings >= 4))
    n_overlapping = max(int(_OVERLAPPING * buildings), int(buildings >= 6))
    n_rows = max(int(_ROWS * buildings), int(buildings >= 12)) if roofs == "mixed" else 0
    n_single = buildings - 2 * (n_touching + n_overlapping) - _IN_ROW * n_rows
    counts = _Counts(n_single, n_touching, n_overlapping, n_rows)
    radii = radius * rng.uniform(0.7, 1.0, sum(counts))
    shore = size * np.array([*np.abs(rng.integers(0, 2, 2) - rng.uniform(0.08, 0.15, 2)), 0.05])
    centres = _place(rng, radii, size, shore)
    rings = _draw(rng, radii, counts)
    polygons = _turn(rng, rings, centres, counts)
    pond = np.array([shore[0] + ORIGIN[0], shore[1] + ORIGIN[1], shore[2] / 2, 0.0])
    pond[3] = _wave_height(waves, base, pond[:1], pond[1:2])[0]
    x, y = shapely.get_coordinates(shapely.centroid(polygons)).T
    ground = _terrain(waves, base, pond, x, y)
    roof = ground + rng.uniform(*_HEIGHTS, buildings)
    ids = np.array([f"B{number:06d}" for number in range(1, buildings + 1)], dtype=np.str_)
    if roofs == "mixed":
        shapes = draw_roofs(polygons, ground, roof, seed=seed)
        roof = highest_places(shapes)
    else:
        shapes = flat_shapes(polygons, roof)
    return SyntheticCity(size, density, seed, waves, base, pond, polygons, ids, ground, roof, roofs, shapes)


def cut_city(city: SyntheticCity, boxes: Iterable[tuple[float, float, float, float]]) -> Iterator[SyntheticCity]:
    """Give the city around each box: the same ground, and the buildings whose envelopes meet the box.

    Parameters
    ----------
    city : SyntheticCity
        The city.
    boxes : iterable of tuples of 4 floats
        xmin, ymin, xmax, ymax in EPSG:3006 (m).

    Yields
    ------
    SyntheticCity
    """
    tree = shapely.STRtree(city.polygons)
    for box in boxes:
        near = np.sort(tree.query(shapely.box(*box)))
        yield replace(
            city,
            polygons=city.polygons[near],
            ids=city.ids[near],
            ground=city.ground[near],
            roof=city.roof[near],
            shapes=take_roofs(city.shapes, near),
        )


def terrain_height(city: SyntheticCity, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give the true height of the ground.

    Parameters
    ----------
    city : SyntheticCity
        The city.
    x, y : float64, (n,)
        Places in EPSG:3006 (m).

    Returns
    -------
    float64, (n,)
        Heights (m); on the pond the water level.
    """
    return _terrain(city.waves, city.base, city.pond, x, y)


def city_points(
    city: SyntheticCity, bounds: tuple[float, float, float, float], part: tuple[int, int]
) -> PointCloud:
    """Draw the points of one part of the city, as one file of a flight holds them.

    Parameters
    ----------
    city : SyntheticCity
        The city, or what `cut_city` gives of it around the part, which is quicker.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax of the part in EPSG:3006 (m).
    part : tuple of 2 ints
        Column and row of the part, which seed its points: parts can be made in any order.

    Returns
    -------
    PointCloud
        Uniformly random: ground (2), roofs (6), vegetation (5) and unclassified (1) in open space, water
        (9) and noise far below and above (7, 18).
    """
    rng = np.random.default_rng([city.seed, 1, *part])
    xmin, ymin, xmax, ymax = bounds
    n = round(city.density * (xmax - xmin) * (ymax - ymin))
    x, y = rng.uniform(xmin, xmax, n), rng.uniform(ymin, ymax, n)
    ground, roof = terrain_height(city, x, y), _roof_at(city, x, y)
    wet = np.hypot(x - city.pond[0], y - city.pond[1]) < city.pond[2]
    lot, noise = rng.random(n), rng.random(n)
    open_ground = np.isnan(roof) & ~wet
    classes = np.full(n, GROUND, np.uint8)
    classes[wet] = WATER
    classes[open_ground & (lot < _VEGETATION + _UNCLASSIFIED)] = UNCLASSIFIED
    classes[open_ground & (lot < _VEGETATION)] = HIGH_VEGETATION
    classes[~np.isnan(roof)] = BUILDING
    z = np.where(np.isnan(roof), ground, roof)
    z += rng.normal(0, 1, n) * np.where(classes == BUILDING, _ROOF_SIGMA, _GROUND_SIGMA)
    z[classes == HIGH_VEGETATION] += rng.uniform(0.5, 4.0, n)[classes == HIGH_VEGETATION]
    z[classes == UNCLASSIFIED] += rng.uniform(0.0, 2.0, n)[classes == UNCLASSIFIED]
    low, high = noise < _NOISE, noise > 1 - _NOISE
    classes[low], classes[high] = LOW_NOISE, HIGH_NOISE
    z[low] = ground[low] - 30.0
    z[high] = ground[high] + 200.0
    keep = ~wet | (lot < _WATER_RETURNS)
    return PointCloud(np.column_stack((x, y, z))[keep], classes[keep])


def _hills(rng: np.random.Generator, size: float, relief: float) -> tuple[NDArray[np.float64], float]:
    """Draw the waves, and scale them so that the square's relief is as asked."""
    length = size * np.geomspace(0.25, 1.2, _N_WAVES)
    direction = rng.uniform(0, 2 * np.pi, _N_WAVES)
    wave_number = 2 * np.pi / length
    waves = np.column_stack(
        (
            wave_number * np.cos(direction),
            wave_number * np.sin(direction),
            rng.uniform(0, 2 * np.pi, _N_WAVES),
            length,
        )
    )
    x, y = (side.ravel() for side in np.meshgrid(*[np.linspace(0, size, 129)] * 2))
    height = _wave_height(waves, 0.0, x + ORIGIN[0], y + ORIGIN[1])
    factor = relief / (height.max() - height.min())
    waves[:, 3] *= factor
    return waves, float(_BASE - factor * height.min())


def _wave_height(
    waves: NDArray[np.float64], base: float, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    height = np.full(len(x), base)
    for kx, ky, phase, amplitude in waves:
        height += amplitude * np.sin(kx * (x - ORIGIN[0]) + ky * (y - ORIGIN[1]) + phase)
    return height


def _terrain(
    waves: NDArray[np.float64],
    base: float,
    pond: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> NDArray[np.float64]:
    t = np.clip(np.hypot(x - pond[0], y - pond[1]) / pond[2] - 1, 0, 1)
    weight = t * t * (3 - 2 * t)
    height: NDArray[np.float64] = pond[3] * (1 - weight) + _wave_height(waves, base, x, y) * weight
    return height


def _place(
    rng: np.random.Generator, radii: NDArray[np.float64], size: float, pond: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Place circles at random in the square so that none meets another or the shore (pond: x, y, radius)."""
    centres = np.empty((len(radii), 2))
    left = np.arange(len(radii))
    if len(radii) == 0:
        return centres
    gap = min(1.0, 0.1 * float(radii.max()))
    for _ in range(_MAX_ROUNDS):
        centres[left] = radii[left, None] + rng.random((len(left), 2)) * (size - 2 * radii[left, None])
        pending = np.zeros(len(radii), bool)
        pending[left] = True
        from scipy.spatial import cKDTree  # 0.3 s, which the parts of a city need not wait for

        pairs = cKDTree(centres).query_pairs(2 * float(radii.max()) + gap, output_type="ndarray")
        i, j = pairs.min(axis=1), pairs.max(axis=1)
        close = np.hypot(*(centres[i] - centres[j]).T) < radii[i] + radii[j] + gap
        drowned = np.flatnonzero(np.hypot(*(centres - pond[:2]).T) < radii + pond[2])
        # Of two that meet, the one placed in this round gives way; of two placed in this round, the later.
        left = np.union1d(np.where(pending[j], j, i)[close], drowned)
        if len(left) == 0:
            return centres
    raise GeometryError(f"{len(left)} of {len(radii)} buildings found no room; ask for fewer or a larger size")


def _draw(
    rng: np.random.Generator, radii: NDArray[np.float64], counts: _Counts
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw shapes around the origin: four-cornered rings (a, 4, 2) and six-cornered rings (b, 6, 2).

    Rows follow the circles: singles (L-shapes last), then both of each pair, then the houses of each row.
    """
    aspect = rng.uniform(1.0, 2.0, len(radii))
    half = np.column_stack((aspect, np.ones(len(radii)))) * (radii / np.hypot(aspect, 1))[:, None]
    w, d = half.T
    u, v = rng.uniform(-0.2, 0.3, (2, len(radii)))
    n_l = int(_L_SHAPED * counts.single)
    single, bent = slice(0, counts.single - n_l), slice(counts.single - n_l, counts.single)
    last = np.cumsum(counts)
    touching, overlapping = slice(last[0], last[1]), slice(last[1], last[2])
    wt, dt, ct = w[touching], d[touching], (u * w)[touching]
    wo, do, co = w[overlapping], d[overlapping], (u * w)[overlapping]
    squares = [
        _rectangle(-w[single], -d[single], w[single], d[single]),
        _rectangle(-wt, -dt, ct, dt),
        _rectangle(ct, -dt, wt, dt),
        _rectangle(-wo, -do, co + 0.15 * wo, 0.7 * do),
        _rectangle(co - 0.15 * wo, -0.6 * do, wo, do),
    ]
    wr, dr = w[last[2] :], d[last[2] :]
    between = np.linspace(-1.0, 1.0, _IN_ROW + 1) + np.zeros((counts.rows, 1))
    if counts.rows:
        between[:, 1:-1] += rng.uniform(-0.12, 0.12, (counts.rows, _IN_ROW - 1))
    squares += [_rectangle(between[:, k] * wr, -dr, between[:, k + 1] * wr, dr) for k in range(_IN_ROW)]
    wl, dl, x, y = w[bent], d[bent], (u * w)[bent], (v * d)[bent]
    corners = [(-wl, -dl), (wl, -dl), (wl, y), (x, y), (x, dl), (-wl, dl)]
    bends = np.stack([np.column_stack(corner) for corner in corners], axis=1)
    return np.concatenate(squares), bends


def _rectangle(
    x0: NDArray[np.float64], y0: NDArray[np.float64], x1: NDArray[np.float64], y1: NDArray[np.float64]
) -> NDArray[np.float64]:
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    return np.stack([np.column_stack(corner) for corner in corners], axis=1)


def _turn(
    rng: np.random.Generator,
    rings: tuple[NDArray[np.float64], NDArray[np.float64]],
    centres: NDArray[np.float64],
    counts: _Counts,
) -> NDArray[np.object_]:
    """Turn the rings by their circle's angle, move them there, and order them by circle."""
    squares, bends = rings
    n_straight = counts.single - len(bends)
    circles = np.arange(len(centres))
    _, touching, overlapping, rows = np.split(circles, np.cumsum(counts)[:-1])
    pairs = (touching, touching, overlapping, overlapping)
    of_square = np.concatenate((circles[:n_straight], *pairs, *([rows] * _IN_ROW)))
    of_bend = circles[n_straight : counts.single]
    angle = rng.uniform(0, 2 * np.pi, len(centres))
    polygons = [
        shapely.polygons(_moved(ring, angle[circle], centres[circle]))
        for ring, circle in ((squares, of_square), (bends, of_bend))
    ]
    order = np.argsort(np.concatenate((of_square, of_bend)), kind="stable")
    ordered: NDArray[np.object_] = np.concatenate(polygons)[order]
    return ordered


def _moved(
    rings: NDArray[np.float64], angle: NDArray[np.float64], centres: NDArray[np.float64]
) -> NDArray[np.float64]:
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = rings[..., 0], rings[..., 1]
    turned = np.stack((cos * x - sin * y, sin * x + cos * y), axis=-1)
    return np.round(turned + centres[:, None] + ORIGIN, 3)


def _roof_at(city: SyntheticCity, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give the highest roof above each point, NaN in the open."""
    roof = np.full(len(x), -np.inf)
    xy = np.column_stack((x, y))
    which, hits = find_inside(xy, city.polygons)
    np.maximum.at(roof, hits, shape_heights(city.shapes, which, xy[hits]))
    roof[np.isneginf(roof)] = np.nan
    return roof
