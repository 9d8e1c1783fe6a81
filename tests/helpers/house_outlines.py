"""Outlines of houses for tests of roofs: shapes worked out by hand, and random ones."""

import math
from collections.abc import Callable

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

Array = NDArray[np.float64]

HAND: dict[str, shapely.Polygon] = {
    "rectangle": shapely.box(0, 0, 6, 4),
    "square": shapely.box(0, 0, 4, 4),
    "L": shapely.Polygon([(0, 0), (10, 0), (10, 4), (4, 4), (4, 12), (0, 12)]),
    "T": shapely.Polygon([(0, 0), (12, 0), (12, 4), (8, 4), (8, 12), (4, 12), (4, 4), (0, 4)]),
    "U": shapely.Polygon([(0, 0), (12, 0), (12, 10), (8, 10), (8, 4), (4, 4), (4, 10), (0, 10)]),
    "H": shapely.Polygon(
        [(0, 0), (4, 0), (4, 4), (8, 4), (8, 0), (12, 0), (12, 12), (8, 12), (8, 8), (4, 8), (4, 12), (0, 12)]
    ),
    "plus": shapely.Polygon(
        [(4, 0), (8, 0), (8, 4), (12, 4), (12, 8), (8, 8), (8, 12), (4, 12), (4, 8), (0, 8), (0, 4), (4, 4)]
    ),
    "courtyard": shapely.Polygon(shapely.box(0, 0, 12, 12).exterior, [shapely.box(4, 4, 8, 8).exterior]),
    "two courtyards": shapely.Polygon(
        shapely.box(0, 0, 20, 12).exterior, [shapely.box(4, 4, 8, 8).exterior, shapely.box(12, 4, 16, 8).exterior]
    ),
    "vertices in walls": shapely.Polygon([(0, 0), (3, 0), (6, 0), (6, 4), (1, 4), (0, 4)]),
    "courtyard at a corner": shapely.Polygon(shapely.box(0, 0, 12, 12).exterior, [[(0, 0), (3, 6), (6, 3)]]),
    "courtyard at a wall": shapely.Polygon(shapely.box(0, 0, 12, 8).exterior, [[(6, 0), (4, 3), (8, 3)]]),
    "stair of half metres": shapely.Polygon(
        [(0, 0), (8, 0), (8, 4), (7.5, 4), (7.5, 4.5), (7, 4.5), (7, 5), (6.5, 5), (6.5, 5.5), (0, 5.5)]
    ),
}


def symmetric_star(tips: int, inner: float, turn: float = 0.0) -> shapely.Polygon:
    """Make a star of tips 10 m from its middle and corners between them at the inner radius, turned by degrees."""
    angle = np.arange(2 * tips) * math.pi / tips + math.radians(turn)
    radius = np.where(np.arange(2 * tips) % 2, inner, 10.0)
    return shapely.Polygon(np.column_stack((radius * np.cos(angle), radius * np.sin(angle))))


def random_star(rng: np.random.Generator) -> shapely.Polygon:
    """Make a star-shaped polygon of 5 to 40 vertices."""
    n = int(rng.integers(5, 41))
    angle = (np.arange(n) + rng.uniform(0.1, 0.9, n)) * 2 * math.pi / n
    radius = rng.uniform(3, 15, n)
    return shapely.Polygon(np.column_stack((radius * np.cos(angle), radius * np.sin(angle))))


def random_rectangles(rng: np.random.Generator, n: int, extent: float) -> shapely.Polygon:
    """Unite rectangles with corners at any millimetre: the largest piece, with its courtyards."""
    corner, size = rng.uniform(0, extent, (n, 2)).round(3), rng.uniform(2, 8, (n, 2)).round(3)
    boxes = [shapely.box(x, y, x + w, y + h) for (x, y), (w, h) in zip(corner, size, strict=True)]
    return largest(shapely.set_precision(shapely.union_all(boxes), 1e-3))


def random_blocks(rng: np.random.Generator, n: int, extent: int) -> shapely.Polygon:
    """Unite rectangles with corners at whole metres, so that much happens at one time and place."""
    corner, size = rng.integers(0, extent, (n, 2)), rng.integers(2, 8, (n, 2))
    boxes = [shapely.box(x, y, x + w, y + h) for (x, y), (w, h) in zip(corner, size, strict=True)]
    return largest(shapely.union_all(boxes))


def with_courtyards(rng: np.random.Generator, polygon: shapely.Polygon) -> shapely.Polygon:
    """Cut up to five triangles and quadrangles out of a polygon."""
    low_x, low_y, high_x, high_y = polygon.bounds
    yards = []
    for _ in range(int(rng.integers(1, 6))):
        n = int(rng.integers(3, 5))
        angle = (np.arange(n) + rng.uniform(0, 0.6, n)) * 2 * math.pi / n
        middle = rng.uniform((low_x, low_y), (high_x, high_y))
        ring = middle + rng.uniform(0.6, 2.0) * np.column_stack((np.cos(angle), np.sin(angle)))
        yards.append(shapely.Polygon(ring))
    apart = [y for k, y in enumerate(yards) if not any(y.intersects(other) for other in yards[:k])]
    inside = [y for y in apart if shapely.prepare(polygon) is None and polygon.contains_properly(y)]
    return shapely.Polygon(polygon.exterior, [*polygon.interiors, *(y.exterior for y in inside)])


def crooked(rng: np.random.Generator, polygon: shapely.Polygon) -> shapely.Polygon:
    """Turn a polygon by any angle, and move each vertex by some centimetres: no edges are parallel any more."""
    turned = affinity.rotate(polygon, float(rng.uniform(0, 360)), origin=(0, 0))
    rings = [np.asarray(ring.coords)[:-1] for ring in (turned.exterior, *turned.interiors)]
    moved = [ring + rng.normal(0, 0.04, ring.shape) for ring in rings]
    return shapely.Polygon(moved[0], moved[1:])


def largest(geometry: shapely.Geometry) -> shapely.Polygon:
    """Give the polygon of most area."""
    return max(shapely.get_parts(geometry), key=lambda part: float(part.area))


KINDS: dict[str, Callable[[np.random.Generator], shapely.Polygon]] = {
    "star": random_star,
    "symmetric star": lambda rng: symmetric_star(
        int(rng.integers(3, 12)), float(rng.uniform(2, 4.5)), float(rng.uniform(0, 90))
    ),
    "star with courtyards": lambda rng: with_courtyards(rng, random_star(rng)),
    "rectangles": lambda rng: random_rectangles(rng, 6, 12),
    "many rectangles": lambda rng: random_rectangles(rng, 40, 30),
    "rectangles with courtyards": lambda rng: with_courtyards(rng, random_rectangles(rng, 25, 20)),
    "blocks": lambda rng: random_blocks(rng, 8, 14),
    "crooked": lambda rng: crooked(rng, random_rectangles(rng, 8, 12)),
    "many crooked": lambda rng: crooked(rng, random_rectangles(rng, 30, 25)),
}


def random_outlines(kind: str, count: int, seed: int) -> list[shapely.Polygon]:
    """Make polygons of a kind of `KINDS`, leaving out those that cross themselves or have an edge below 1 cm."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    found: list[shapely.Polygon] = []
    while len(found) < count:
        polygon = KINDS[kind](rng)
        rings = (np.asarray(ring.coords) for ring in (polygon.exterior, *polygon.interiors))
        shortest = min(float(np.hypot(*np.diff(ring, axis=0).T).min()) for ring in rings)
        if polygon.is_valid and shortest > 0.01:
            found.append(polygon)
    return found
