"""The land cover of a run, read from its store tile by tile."""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.geometry.inside import find_inside
from pipeline.points_terrain.canopy import Canopy, densities_at
from stitch.tiling.land_cover import LandCover, find_patches
from tiler.citymodels.tables import unpack_polygons
from tiler.engine.stage import REGION_ITEM, Box
from tiler.landcover.water import LEVELS
from tiler.stages.pieces import CANOPY, make_canopy
from tiler.stages.surroundings import COVERED, patch_of_ids, rows_of_cover
from tiler.store.store import Store

AROUND = 9  # canopies of tiles that stay in memory


class _Around:
    """Results of a stage by tile, and which of these lie around a box; parameters as of `StoredCover`."""

    def __init__(self, path: Path, stage: str, tiles: Mapping[str, Box]) -> None:
        self.store = Store(path)
        known = set(self.store.names(stage))
        self._names = [name for name in tiles if name in known]
        self._boxes = shapely.STRtree([shapely.box(*tiles[name]) for name in self._names])

    def find(self, box: shapely.Polygon) -> list[str]:
        """List the tiles whose boxes meet a box, in their order."""
        return [self._names[k] for k in np.sort(self._boxes.query(box)).tolist()]


class StoredCanopy:
    """Leaf area density at places, by the canopies of all tiles around them; parameters as of `StoredCover`."""

    def __init__(self, path: Path, tiles: Mapping[str, Box], size: float) -> None:
        self._tiles, self._size = _Around(path, CANOPY, tiles), size
        self._take = lru_cache(maxsize=AROUND)(self._read)

    def __call__(self, places: NDArray[np.float64], /) -> NDArray[np.float32]:
        """Density at each place (m2/m3), (n, 3) to float32 (n,)."""
        if len(places) == 0:
            return np.empty(0, np.float32)
        box = shapely.box(*places[:, :2].min(axis=0) - self._size, *places[:, :2].max(axis=0) + self._size)
        return densities_at([self._take(name) for name in self._tiles.find(box)], places)

    def _read(self, name: str) -> Canopy:
        arrays, attributes = self._tiles.store.read(CANOPY, name)
        return make_canopy(arrays, attributes["facts"], self._size)


class StoredCover:
    """Patches of the ground at places, by the polygons of all tiles around them.

    Parameters
    ----------
    path : Path
        Folder of the store.
    tiles : mapping of str to tuple of 4 floats
        Boxes of the tiles (m).
    core : tuple of 4 floats, or None
        The region without its pad (m).
    pad : int
        Number of the patch outside of it.
    """

    def __init__(self, path: Path, tiles: Mapping[str, Box], core: Box | None, pad: int) -> None:
        self._tiles, self._core, self._pad = _Around(path, COVERED, tiles), core, pad
        levels = self._tiles.store.read(LEVELS, REGION_ITEM)[0]
        self._levels = dict(zip(levels["ids"].tolist(), levels["level"].tolist(), strict=True))

    def __call__(self, xy: NDArray[np.float64], /) -> NDArray[np.int8]:
        """Patch at each place, (n, 2) to int8 (n,)."""
        if len(xy) == 0:
            return np.empty(0, np.int8)
        ids, polygons = self._around(xy)
        return find_patches(LandCover(polygons, patch_of_ids(ids), self._core, self._pad), xy)

    def levels_at(self, xy: NDArray[np.float64], *, alone: float) -> NDArray[np.float64]:
        """Level of the water at each place (m); NaN where there is none, or other water within `alone` (m)."""
        level = np.full(len(xy), np.nan)
        if len(xy) == 0:
            return level
        ids, polygons = self._around(xy)
        rows = np.array([k for k, name in enumerate(ids.tolist()) if name in self._levels], np.int64)
        known = np.array([self._levels[ids[k]] for k in rows.tolist()], np.float64)
        polygon, place = find_inside(xy, polygons[rows])
        level[place] = known[polygon]
        if self._core is not None:
            level[((xy < self._core[:2]) | (xy > self._core[2:])).any(axis=1)] = np.nan
        place, near = shapely.STRtree(polygons[rows]).query(
            shapely.points(xy), predicate="dwithin", distance=alone
        )
        level[place[known[near] != level[place]]] = np.nan
        return level

    def _around(self, xy: NDArray[np.float64]) -> tuple[NDArray[np.str_], NDArray[np.object_]]:
        """Polygons of the tiles around places, each once."""
        around = self._tiles.find(shapely.box(*xy.min(axis=0), *xy.max(axis=0)))
        found = [self._tiles.store.read(COVERED, name)[0] for name in around]
        ids, kept = rows_of_cover(np.concatenate([np.empty(0, "<U20"), *(arrays["ids"] for arrays in found)]))
        outlines = [np.empty(0, np.object_), *(unpack_polygons(arrays, "outline") for arrays in found)]
        return ids, np.concatenate(outlines)[kept]
