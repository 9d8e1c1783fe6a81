"""The numbers of the report: read from the store tile by tile, added up in arrays of fixed size."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.quality.histograms import QUALITY_BINS, Histogram, merge_histograms
from tiler.citymodels.tables import unpack_polygons
from tiler.report.record import RunFacts
from tiler.report.svg_map import FootprintRaster
from tiler.store.store import Store

MAP_PIXELS = 900  # of the longer side of the map of footprints
HEIGHT_BIN, TERRAIN_BIN = 1.0, 0.1  # m
NO_HISTOGRAM = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class Numbers:
    """Figures of all tiles, from the store."""

    #: each measure over all cells (`pipeline.quality.histograms.QUALITY_BINS`); empty without pieces
    quality: dict[str, Histogram]
    #: (n,): least radius ratio of each tile of `RunFacts.tiles`; NaN where the store does not tell
    worst: NDArray[np.float64]
    #: heights of buildings above their ground, and heights of the terrain's nodes
    buildings: "Bins"
    terrain: "Bins"
    #: (rows, columns): how much of each pixel is within clean footprints, 0 to 255; row 0 in the north
    footprints: NDArray[np.uint8]


class Bins:
    """Values counted in bins of a width from 0 on, up and down as far as there are some.

    Examples
    --------
    >>> bins = Bins(1.0)
    >>> bins.add(np.array([2.5, -0.5, 2.9]))
    >>> bins.low, bins.counts.tolist(), bins.n
    (-1.0, [1, 0, 0, 2], 3)
    """

    MOST = 200_000  # bins

    def __init__(self, width: float) -> None:
        self.width, self._first = width, 0
        self.counts = NO_HISTOGRAM
        self.minimum, self.maximum, self._total = np.inf, -np.inf, 0.0

    @property
    def low(self) -> float:
        """Where the first bin begins."""
        return self._first * self.width

    @property
    def n(self) -> int:
        """How many values were counted."""
        return int(self.counts.sum())

    @property
    def mean(self) -> float:
        """Mean of the values; NaN without some."""
        return self._total / self.n if self.n else float("nan")

    def add(self, values: NDArray[np.float64]) -> None:
        """Count values (n,); those that are not finite, or farther off than any height, are left out."""
        values = values[np.abs(values) < self.MOST / 2 * self.width]
        if not len(values):
            return
        place = np.floor(values / self.width).astype(np.int64)
        first, last = int(place.min()), int(place.max())
        if not len(self.counts):
            self._first, self.counts = first, np.zeros(1, np.int64)
        low, high = min(first, self._first), max(last + 1, self._first + len(self.counts))
        counts = np.zeros(high - low, np.int64)
        counts[self._first - low : self._first - low + len(self.counts)] = self.counts
        self._first, self.counts = low, counts + np.bincount(place - low, minlength=high - low)
        self.minimum, self.maximum = min(self.minimum, float(values.min())), max(self.maximum, float(values.max()))
        self._total += float(values.sum())


def collect_numbers(store: Store, facts: RunFacts) -> Numbers:
    """Read what all tiles tell.

    Parameters
    ----------
    store : Store
        Store of the run.
    facts : RunFacts
        Its record, with a region.

    Raises
    ------
    InputError
        If a result is damaged.

    Notes
    -----
    Some milliseconds a tile; memory is that of one tile's results.
    """
    assert facts.bounds is not None
    names, there = facts.tiles.names, set(store.names("pieces"))
    worst = np.full(len(names), np.nan)
    quality: dict[str, Histogram] = {}
    for k, name in enumerate(names):
        if name in there:
            parts = _read_quality(store, name)
            worst[k] = parts["radius_ratio"].minimum
            quality = {
                key: merge_histograms([quality[key], new]) if quality else new for key, new in parts.items()
            }
    buildings, terrain = Bins(HEIGHT_BIN), Bins(TERRAIN_BIN)
    for name in store.names("model"):
        found, _ = store.read("model", name, names=("ground", "roof"))
        buildings.add(found["roof"] - found["ground"])
    for name in store.names("terrain"):
        terrain.add(store.read("terrain", name, names=("z",))[0]["z"].ravel())
    return Numbers(quality, worst, buildings, terrain, draw_footprints(store, facts.bounds))


def draw_footprints(store: Store, bounds: tuple[float, float, float, float]) -> NDArray[np.uint8]:
    """Draw the clean footprints of all tiles, as `Numbers.footprints` has them."""
    raster = FootprintRaster(bounds, MAP_PIXELS)
    for name in store.names("houses"):
        arrays: dict[str, NDArray[Any]] = store.read("houses", name, names=("outline", "outline_start"))[0]
        raster.add(unpack_polygons(arrays, "outline"))
    return raster.shares()


def _read_quality(store: Store, name: str) -> dict[str, Histogram]:
    arrays, _ = store.read("pieces", name)
    return {
        key: Histogram(*limits, arrays[key], *arrays[f"{key}_range"].tolist())
        for key, (limits, _) in QUALITY_BINS.items()
    }
