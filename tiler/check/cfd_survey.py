"""What guidelines for wind simulations ask of a mesh, measured on files of a run: distances, blockage, cells."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from pipeline.data.regions import Region
from pipeline.quality.histograms import Histogram, count_values, merge_histograms, no_values
from tiler.citymodels.building_index import BuildingIndex, index_buildings
from tiler.export.wind_profile import SIDES, flow_of, split_sides
from tiler.mesh_files.mesh_pieces import MeshPiece, open_pieces
from tiler.store.out_folder import CITY_MODEL, RUN_RECORD
from tiler.store.run_folder import read_run_record

Floats = NDArray[np.float64]
Bounds = tuple[float, float, float, float]
BATCH = 10_000  # buildings that are loaded together
STRIP = 1.0  # m; width of the strips in which the outline of the city is seen from the front
RATIOS, HEIGHTS = ((1.0, 6.0), 5000), ((0.0, 50.0), 10_000)


@dataclass(frozen=True, eq=False)
class Blocks:
    """The buildings: boxes of footprints (west, south, east, north), heights, areas (m, m2); (n, 4) and (n,)."""

    numbers: NDArray[np.int64]
    box: Floats
    ground: Floats
    roof: Floats
    area: Floats
    corners: Floats  # (c, 2), of all footprints
    building: NDArray[np.int64]  # (c,), row of the building of each corner

    @property
    def height(self) -> Floats:
        """Heights above ground (m)."""
        return self.roof - self.ground


@dataclass(frozen=True, eq=False)
class CfdSurvey:
    """What was measured."""

    bounds: Bounds  #: west, south, east and north side of the domain (m)
    blocks: Blocks  #: the buildings
    #: lowest point of the top, and mean of the ground (m)
    top: float
    ground: float
    growth: Histogram  #: of each two cells one above the other in a column's corner, the longer over the shorter
    #: heights above ground of the first and second node over each vertex of the ground (m)
    first: Histogram
    second: Histogram
    #: (n,): cube root of each building's volume over the length of edges on it; NaN where it has no facets
    cells_a_side: Floats

    @property
    def tallest(self) -> float:
        """Height of the tallest building (m)."""
        return float(self.blocks.height.max())

    def distance_to(self, side: str) -> float:
        """Return the least distance of a building from a side of the domain (m)."""
        k = {"west": 0, "south": 1, "east": 2, "north": 3}[side]
        gap = self.blocks.box[:, k] - self.bounds[k]
        return float((gap if k < 2 else -gap).min())

    def distances(self, direction: float) -> tuple[float, float, float]:
        """Return the least distances (m) to sides that wind enters, leaves by, passes; infinite: no such side."""
        inlet, outlet, lateral = (
            min((self.distance_to(side) for side in sides), default=math.inf)
            for sides in split_sides(direction, SIDES)
        )
        return inlet, outlet, lateral

    def blockage(self, direction: float) -> float:
        """Return the share of the domain's cross-section that buildings take, seen along the wind."""
        east, north = flow_of(direction)
        across = self.blocks.corners @ np.array([-north, east])
        west, south, far_east, far_north = self.bounds
        sides = np.array([[x, y] for x in (west, far_east) for y in (south, far_north)]) @ np.array([-north, east])
        start, n = float(sides.min()), len(self.blocks.height)
        low, high = np.full(n, np.inf), np.full(n, -np.inf)
        np.minimum.at(low, self.blocks.building, across)
        np.maximum.at(high, self.blocks.building, across)
        width = float(np.ptp(sides))
        return _front_area(low - start, high - start, self.blocks.height) / (width * (self.top - self.ground))


def _front_area(low: Floats, high: Floats, height: Floats) -> float:
    """Return the area (m2) that intervals of some heights cover together.

    Examples
    --------
    >>> _front_area(np.array([0.0, 2.0]), np.array([4.0, 6.0]), np.array([10.0, 5.0]))
    50.0
    """
    first = np.floor(low / STRIP + 0.5).astype(np.int64)
    n = np.maximum(np.floor(high / STRIP + 0.5).astype(np.int64) - first, 1)
    strip = np.repeat(first - first.min(initial=0), n) + np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
    front = np.zeros(int(strip.max(initial=0)) + 1)
    np.maximum.at(front, strip, np.repeat(height, n))
    return float(front.sum()) * STRIP


def survey_domain(directory: Path) -> CfdSurvey:
    """Measure the domain and the cells of a finished run.

    Raises
    ------
    InputError
        If the folder holds no finished run with buildings, or a file of it is missing or damaged.

    Notes
    -----
    Memory: one piece, and some 200 bytes a building.
    """
    record = read_run_record(directory / RUN_RECORD)
    with index_buildings(directory / CITY_MODEL) as index:
        if not len(index):
            raise InputError(
                f"{directory}: the mesh has no building, so there is nothing to measure the domain by"
            )
        blocks = _take_blocks(index)
        pieces = open_pieces(directory)
        growth, first, second = no_values(*RATIOS), no_values(*HEIGHTS), no_values(*HEIGHTS)
        tops, weight, total = [math.inf], 0.0, 0.0
        area, count = np.zeros(len(index)), np.zeros(len(index))
        for k in range(len(pieces.names)):
            piece = pieces.read(k)
            ratios, one, two = _measure_columns(piece)
            growth = merge_histograms([growth, count_values(ratios, *RATIOS)])
            first = merge_histograms([first, count_values(one, *HEIGHTS)])
            second = merge_histograms([second, count_values(two, *HEIGHTS)])
            top = piece.points[piece.facets[piece.marker == Marker.TOP], 2]
            tops.append(float(top.min(initial=math.inf)))
            corners = piece.points[piece.facets]
            size = _areas(corners)
            ground = piece.marker == Marker.GROUND
            weight += float(size[ground].sum())
            total += float((size[ground] * corners[ground, :, 2].mean(axis=1)).sum())
            house = np.isin(piece.marker, (Marker.WALL, Marker.ROOF)) & (piece.building >= 0)
            row = index.find_rows(piece.building[house])
            known = row >= 0
            area += np.bincount(row[known], size[house][known], minlength=len(index))
            count += np.bincount(row[known], minlength=len(index))
    with np.errstate(divide="ignore", invalid="ignore"):
        edge = np.sqrt(4 / math.sqrt(3) * area / count)
        cells = np.cbrt(blocks.area * blocks.height) / edge
    return CfdSurvey(record.bounds, blocks, min(tops), total / weight, growth, first, second, cells)


def _take_blocks(index: BuildingIndex) -> Blocks:
    box, ground, roof, area = [], [], [], []
    corners, building = [], []
    for start in range(0, len(index), BATCH):
        some = index.take(np.arange(start, min(start + BATCH, len(index))))
        box.append(shapely.bounds(some.footprints))
        ground.append(some.ground)
        roof.append(some.roof)
        area.append(shapely.area(some.footprints))
        places, row = shapely.get_coordinates(some.footprints, return_index=True)
        corners.append(places)
        building.append(row + start)
    joined = [np.concatenate(some) for some in (box, ground, roof, area, corners, building)]
    return Blocks(index.numbers, *joined)


def _areas(corners: Floats) -> Floats:
    a, b, c = (corners[:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(np.sqrt((normal**2).sum(axis=1)) / 2)


def _measure_columns(piece: MeshPiece) -> tuple[Floats, Floats, Floats]:
    """Measure steps along the vertical edges of a piece: ratios of two, first and second height above ground.

    Each cell has one vertical edge, from its first corner to its last.
    """
    air = np.ones(len(piece.cells), np.bool_) if piece.region is None else piece.region == Region.AIR
    low, high = piece.cells[air, 0], piece.cells[air, 3]
    z = piece.points[:, 2]
    low, high = np.where(z[low] < z[high], low, high), np.where(z[low] < z[high], high, low)
    upright = (piece.points[low, :2] == piece.points[high, :2]).all(axis=1)
    above = np.full(len(piece.points), -1, np.int64)
    above[low[upright]] = high[upright]
    start = np.flatnonzero(above >= 0)
    step = np.full(len(piece.points), np.nan)
    step[start] = z[above[start]] - z[start]
    inner = start[above[above[start]] >= 0]
    one, two = step[inner], step[above[inner]]
    ratios = np.maximum(one / two, two / one)
    ground = np.unique(piece.facets[piece.marker == Marker.GROUND])
    ground = ground[above[ground] >= 0]
    first = step[ground]
    ground = ground[above[above[ground]] >= 0]
    return ratios, first, step[ground] + step[above[ground]]
