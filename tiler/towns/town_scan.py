"""A town as an airborne laser scanner sees it in strips, and the truth of each of its houses."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.architecture.levels import at_eaves, make_level, outline_rings, part_ring
from pipeline.architecture.parameters import House
from pipeline.architecture.plants import Tree
from pipeline.architecture.scanner import (
    BEAM,
    FLIGHT,
    FORWARD,
    HALF_SWATH,
    SPACING,
    Array,
    Cell,
    Faces,
    Pulses,
    aim,
    aimed_boxes,
    list_crowns,
    list_faces,
    meet_crowns,
    meet_faces,
    meet_ground,
    strips_over,
)
from pipeline.architecture.surfaces import GROUND as FOOT
from pipeline.architecture.surfaces import ROOF, Surface, to_town
from pipeline.data.classes import BUILDING, GROUND, HIGH_VEGETATION, UNCLASSIFIED
from pipeline.data.errors import ConfigError
from pipeline.data.pointcloud import PointCloud
from tiler.towns.styles import LOWEST, Box, Town

CELL = 50.0  # m, of pulses that are drawn together
RANGE_SIGMA, PLAN_SIGMA, STRIP_SIGMA = 0.02, 0.05, 0.02  # m: along a pulse, in x and y, and of a strip's heights
APART = 0.7  # m between two returns of a pulse
DEEPER = 1.5  # m, mean depth in a crown from which a pulse returns
SPEED = 60.0  # m/s, of the aircraft
STEEPEST = 0.8  # of the ground against the pulses
_CLASSES = np.array([UNCLASSIFIED, GROUND, HIGH_VEGETATION, BUILDING], np.uint8)


class Scan(NamedTuple):
    """Points, and what LAS says of each besides."""

    cloud: PointCloud
    fields: dict[str, NDArray[Any]]


def check_flight(town: Town) -> None:
    """Raise ConfigError for a town that this flight cannot scan: too high a building, or too steep ground."""
    if town.top - LOWEST > FLIGHT / 2:
        raise ConfigError(
            f"--lidar: roofs up to {town.top - LOWEST:.0f} m above the lowest ground, expected at most "
            f"{FLIGHT / 2:.0f} m, half of the flight's height; lower the rules' storeys or --relief"
        )
    if (fall := town.steepest * np.hypot(HALF_SWATH / FLIGHT, FORWARD)) > STEEPEST:
        most = town.relief * STEEPEST / fall
        raise ConfigError(f"--lidar: --relief {town.relief:g} m hides ground; expected at most {most:.0f} m")


def reach_of(town: Town) -> float:
    """How far from a place (m) stands what a pulse passes on its way there."""
    return float((town.top - LOWEST) * np.hypot(HALF_SWATH / FLIGHT, FORWARD))


def scan_strips(
    town: Town, box: Box, houses: Sequence[House], trees: Sequence[Tree], *, density: float, errors: float
) -> Iterator[Scan]:
    """Scan a box of a town, a row of cells of a strip after the other.

    Parameters
    ----------
    box : tuple of 4 floats
        West, south, east, north (m); points on the western or southern side are inside.
    houses, trees : sequences
        All within `reach_of` the box.
    density : float
        Pulses per square metre of a strip.
    errors : float
        Share of the points that have a wrong class.

    Notes
    -----
    Strips are numbered, and pulses drawn, by their place alone: a box has the points of the whole.
    """
    west, south, east, north = np.array(box) + reach_of(town) * np.array([-1, -1, 1, 1])
    columns = range(int(np.floor(west / CELL)), int(np.ceil(east / CELL)))
    rows = range(int(np.floor(south / CELL)), int(np.ceil(north / CELL)))
    seen = [one for house in houses for body in make_level(house, "2.3", solid=False) for one in body.surfaces]
    faces = list_faces([one for one in seen if one.kind != FOOT], LOWEST)
    crowns, corners = list_crowns(trees, LOWEST)
    for strip in strips_over(west, east):
        scene = _Scene(
            faces,
            aimed_boxes(faces.corners, faces.start, strip),
            crowns,
            aimed_boxes(corners, np.arange(0, len(corners), 8), strip),
        )
        for i in columns:
            if abs((i + 0.5) * CELL - (strip + 0.5) * SPACING) < HALF_SWATH + CELL / 2:
                yield _join(
                    _scan_cell(town, box, (strip, i, j), scene, density=density, errors=errors) for j in rows
                )


def _join(cells: Iterable[dict[str, NDArray[Any]]]) -> Scan:
    found = list(cells)
    rows = {name: np.concatenate([one[name] for one in found]) for name in found[0]}
    return Scan(PointCloud(rows.pop("xyz"), rows.pop("classification")), rows)


class _Scene(NamedTuple):
    """What pulses of a strip may meet: faces and crowns, and their boxes as of `aimed_boxes`."""

    faces: Faces
    seen_faces: Array
    crowns: Array
    seen_crowns: Array


def _scan_cell(
    town: Town, box: Box, numbers: tuple[int, int, int], scene: _Scene, *, density: float, errors: float
) -> dict[str, NDArray[Any]]:
    """Scan a cell of pulses; of its points those in the box."""
    strip, i, j = numbers
    rng = np.random.default_rng([town.seed, 6, *(number % 2**32 for number in numbers)])
    side = max(round(CELL * density**0.5), 1)
    n = side * side
    jitter, turn, deep = rng.random((n, 2)), rng.random(n) * 2 * np.pi, rng.exponential(DEEPER, (n, 2))
    noise = rng.standard_normal((n, 4, 3)) * (PLAN_SIGMA, PLAN_SIGMA, RANGE_SIGMA)
    wrong, other = rng.random((n, 4)) < errors, rng.integers(1, len(_CLASSES), (n, 4))
    lift = STRIP_SIGMA * np.random.default_rng([town.seed, 8, strip % 2**32]).standard_normal()
    pulses = aim(strip, Cell(CELL * i, CELL * j, CELL, side), jitter)
    swath = np.abs(pulses.x - (strip + 0.5) * SPACING) < HALF_SWATH
    heights, kinds = _meet(town, pulses, turn, deep, scene)
    kept, rank, count = _take_returns(heights)
    kept &= swath[:, None]
    east, north = pulses.x[:, None] + pulses.east[:, None] * heights, pulses.y[:, None] + pulses.north * heights
    xyz = np.round(np.stack((east, north, LOWEST + heights + lift), axis=-1) + noise, 2)
    with np.errstate(invalid="ignore"):
        kept &= (xyz[..., 0] >= box[0]) & (xyz[..., 0] < box[2]) & (xyz[..., 1] >= box[1]) & (xyz[..., 1] < box[3])
    kinds = np.where(wrong, (kinds + other) % len(_CLASSES), kinds)
    pulse, _ = np.nonzero(kept)
    return {
        "xyz": xyz[kept],
        "classification": _CLASSES[kinds[kept]],
        "return_number": rank[kept].astype(np.uint8),
        "number_of_returns": count[pulse].astype(np.uint8),
        "scan_angle": np.round(np.degrees(np.arctan(-pulses.east[pulse])) / 0.006).astype(np.int16),
        "point_source_id": np.full(len(pulse), strip % 2**16, np.uint16),
        "gps_time": 1e5 * (strip % 1000) + pulses.y[pulse] * np.sign(pulses.north) / SPEED,
    }


def _meet(town: Town, pulses: Pulses, turn: Array, deep: Array, scene: _Scene) -> tuple[Array, NDArray[np.int64]]:
    """Meet a town with pulses: twice in crowns, at the middle of the pulse, and at a place of its border.

    Heights above the lowest ground, NaN where nothing returns, and classes as places in `_CLASSES`: (n, 4) each.
    """
    n = len(pulses.x)
    heights, kinds = np.full((n, 4), np.nan), np.full((n, 4), 2)
    border = pulses.shift(BEAM * np.cos(turn), BEAM * np.sin(turn))
    for column, rays in ((2, pulses), (3, border)):
        built, ground = meet_faces(scene.faces, scene.seen_faces, rays), meet_ground(town.ground, LOWEST, rays)
        wet = ground <= town.water_level - LOWEST
        heights[:, column] = np.where(built > ground, built, np.where(wet, np.nan, ground))
        kinds[:, column] = np.where(built > ground, 3, 1)
        if column == 2:
            solid = np.maximum(built, ground)
    enters, leaves = meet_crowns(scene.crowns, scene.seen_crowns, pulses)
    heights[:, 0] = enters - deep[:, 0]
    heights[:, 1] = heights[:, 0] - APART - deep[:, 1]
    heights[:, :2][heights[:, :2] <= np.maximum(leaves, solid)[:, None]] = np.nan
    heights[np.abs(heights[:, 3] - solid) < APART, 3] = np.nan
    return heights, kinds


def _take_returns(heights: Array) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Tell which of the places that a pulse meets return, their numbers from the highest down, and how many."""
    order = np.argsort(-heights, axis=1, kind="stable")  # NaN come last
    kept = np.zeros(heights.shape, np.bool_)
    rank = np.zeros(heights.shape, np.int64)
    last, count = np.full(len(heights), np.inf), np.zeros(len(heights), np.int64)
    for column in order.T[:, :, None]:
        h = np.take_along_axis(heights, column, axis=1)[:, 0]
        good = h <= last - APART
        last, count = np.where(good, h, last), count + good
        np.put_along_axis(kept, column, good[:, None], axis=1)
        np.put_along_axis(rank, column, count[:, None], axis=1)
    return kept, rank, count


def describe_truth(house: House) -> dict[str, Any]:
    """Give the truth that reconstructions are held against: outlines, heights, parts and planes of a house.

    Planes are ``z = a (x - x0) + b (y - y0) + c`` with ``origin`` (x0, y0), those of the main roof first:
    ``main`` in number, and then those of dormers and parts.
    """
    origin = (house.x, house.y)
    main = [one for one in make_level(house, "2.0")[0].surfaces if one.kind == ROOF]
    found = [(body.part, one) for body in make_level(house, "2.2") for one in body.surfaces if one.kind == ROOF]
    found.sort(key=lambda pair: pair[1].border not in [one.border for one in main])
    planes = [{"part": part, "plane": _plane(one, origin), "ring": one.border} for part, one in found]
    outer = at_eaves(house)
    return {
        "id": house.id,
        "type": house.roof.shape,
        "ground": house.z,
        "eaves": round(house.z + house.height, 3),
        "ridge": round(house.z + house.height + house.roof.rise, 3),
        "outline": _ring(house, outline_rings(house)[0]),
        "roof_outline": _ring(outer, outline_rings(outer)[0]),
        "parts": [
            {"kind": part.kind, "outline": _ring(house, part_ring(house, part)), "height": part.height}
            for part in house.parts
        ],
        "dormers": len(house.dormers),
        "main": len(main),
        "origin": origin,
        "planes": planes,
    }


def _ring(house: House, ring: Sequence[tuple[float, float]]) -> list[tuple[float, ...]]:
    (placed,) = to_town(house, [Surface(FOOT, [(x, y, 0.0) for x, y in ring], [])])
    return [corner[:2] for corner in placed.border]


def _plane(surface: Surface, origin: tuple[float, float]) -> list[float]:
    places = np.array(surface.border) - (*origin, 0.0)
    rows = np.column_stack((places[:, :2], np.ones(len(places))))
    return [round(value, 6) for value in np.linalg.lstsq(rows, places[:, 2], rcond=None)[0].tolist()]
