"""The region to mesh and the pad around it: chosen, laid out in tiles, and checked against these."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError, InputError
from stitch.pieces.numbering import MOST_TILES
from stitch.tiling.grid import Bounds, TileGrid, make_grid, tiles_present
from stitch.tiling.smallest_tile import LEAST_TILE
from tiler.cityinput.sources import MODEL
from tiler.config.config import Config
from tiler.config.domain_height import EXPECTED_TALLEST, check_widths, widths_in_metres
from tiler.config.step_options import expected_levels
from tiler.engine.run_context import SHARED
from tiler.georeference.crs import box_around
from tiler.pointclouds.clouds import CloudHeader

ASTRAY_TILES = 20  # a file longer than this many tiles is likely to have astray points ...
MOST_IN_ALL = 10_000_000  # tiles of the region's box; half a million make a country
MOST_NODES = 400_000_000  # of the terrain of one tile, 8 bytes each
MOST_CELLS = 2**31  # of one tile, whose local indices have 32 bits
INPUTS = {"cloud": "point clouds", "terrain": "rasters of terrain", "model": "buildings"}
PAST = 1.0  # m that a file reaches beyond a region before anything is said of it
SPARSEST = 100.0  # m2; ... where it has fewer points than one in this area


@dataclass(frozen=True)
class Pad:
    """A region within its pad, a margin of bare ground.

    Notes
    -----
    Guidelines keep the sides of the domain away from buildings: five times the height of the tallest one towards
    the inlet and the sides, fifteen times behind (Franke et al., COST action 732, 2007), or ten (Tominaga et al.,
    AIJ, 2008); both are cited in full in `tiler.config.domain_height`.
    """

    core: Bounds  # the region that was asked for, with its buildings and points (m)
    grid: TileGrid  # tiles of core and pad


def pad_bounds(core: Bounds, widths: Sequence[float]) -> Bounds:
    """Grow a region by the widths of its pad: west, east, south, north (m).

    Examples
    --------
    >>> pad_bounds((0.0, 0.0, 10.0, 20.0), (1.0, 2.0, 3.0, 4.0))
    (-1.0, -3.0, 12.0, 24.0)
    """
    west, east, south, north = widths
    return core[0] - west, core[1] - south, core[2] + east, core[3] + north


def pad_grid(core: TileGrid, bounds: Bounds, *, mesh_size: float, open_size: float) -> TileGrid:
    """Lay tiles over a region and its pad, `bounds` (m), between multiples of the tile size, as any.

    One that shares area with an absent tile of the region is absent too; all others are there. Every line within
    the region is a line of the larger grid: no tile of this has parts of two of the region's.
    """
    whole = make_grid(bounds, tile_size=core.tile_size, mesh_size=mesh_size, open_size=open_size)
    column, row = (_tiles_below(outer, inner) for outer, inner in zip(whole.lines, core.lines, strict=True))
    meets = np.logical_and.outer(column >= 0, row >= 0)
    present = ~meets | tiles_present(core)[np.ix_(np.maximum(column, 0), np.maximum(row, 0))]
    return replace(whole, present=None if present.all() else present)


def _tiles_below(outer: NDArray[np.float64], inner: NDArray[np.float64]) -> NDArray[np.int64]:
    """Which interval of some lines each interval of finer ones meets; -1 where it meets none."""
    low, high = np.maximum(outer[:-1], inner[0]), np.minimum(outer[1:], inner[-1])
    at = np.searchsorted(inner, (low + high) / 2, side="right") - 1
    found: NDArray[np.int64] = np.where(high - low > SHARED, np.clip(at, 0, len(inner) - 2), -1)
    return found


@dataclass(frozen=True)
class Region:
    """A box in a metric CRS."""

    bounds: Bounds  # the box (m)
    crs: str  # the CRS as ``EPSG:NNNN`` where it has a code, else as WKT
    tile_size: float  # side of a tile (m); tiles are aligned to multiples of it in the CRS


def check_points(clouds: Sequence[CloudHeader]) -> None:
    """Raise InputError if no cloud has a point."""
    if any(cloud.n_points > 0 for cloud in clouds):
        return
    if clouds and all(cloud.kind == MODEL for cloud in clouds):
        raise InputError(
            f"{clouds[0].path}: no Building with a surface in {len(clouds)} city models; others are not meshed"
        )
    raise InputError(
        f"point cloud: {len(clouds)} files hold no point at all; nothing can be meshed without ground points"
    )


def choose_bounds(asked: Sequence[float], clouds: Sequence[CloudHeader]) -> Bounds:
    """Take the bounds asked for, else the whole metres inside the extent of all clouds with points.

    InputError if no cloud has a point, or none meets the bounds.
    """
    check_points(clouds)
    xmin, ymin, xmax, ymax = box_around([cloud.bounds for cloud in clouds if cloud.n_points > 0])
    if not asked:
        return float(math.ceil(xmin)), float(math.ceil(ymin)), float(math.floor(xmax)), float(math.floor(ymax))
    kind = clouds[0].kind
    one = {"cloud": "point cloud", "terrain": "raster", "model": "building"}[kind]
    if asked[0] >= xmax or asked[2] <= xmin or asked[1] >= ymax or asked[3] <= ymin:
        raise InputError(
            f"bounds {_words(asked)}: no {one} there, the {INPUTS[kind]} cover "
            f"{_words((xmin, ymin, xmax, ymax))}; correct --bounds"
        )
    return asked[0], asked[1], asked[2], asked[3]


def describe_pad(core: Bounds, clouds: Sequence[CloudHeader]) -> list[str]:
    """Describe how many files have points beyond a region, where its pad takes no account of them."""
    boxes = [cloud.bounds for cloud in clouds if cloud.n_points > 0]
    beyond = sum(
        min(box[0] - core[0], box[1] - core[1], core[2] - box[2], core[3] - box[3]) <= -PAST for box in boxes
    )
    if not beyond:
        return []
    return [
        f"{beyond} of {len(boxes)} point clouds reach beyond the region {_words(core)}: its pad is bare ground, "
        "whatever points and footprints there are"
    ]


def describe_overhang(bounds: Bounds, clouds: Sequence[CloudHeader]) -> list[str]:
    """State by how much the region reaches beyond the point clouds; nothing where it does not."""
    xmin, ymin, xmax, ymax = box_around([cloud.bounds for cloud in clouds if cloud.n_points > 0])
    beyond = {"west": xmin - bounds[0], "south": ymin - bounds[1]}
    beyond |= {"east": bounds[2] - xmax, "north": bounds[3] - ymax}
    sides = ", ".join(f"{by:.1f} m {side}" for side, by in beyond.items() if by > 0)
    what = INPUTS[min((cloud.kind for cloud in clouds), key=list(INPUTS).index)] if sides else ""
    return [f"the region reaches beyond the {what} ({sides}); terrain is carried on there"] if sides else []


def check_sizes(region: Region, config: Config) -> None:
    """Refuse a region of more tiles, or tiles of more terrain or cells, than can be counted.

    A slip in one number, or a header that nobody checked, would otherwise take all memory before the first point.

    Raises
    ------
    ConfigError
        With the number against its bound.

    Notes
    -----
    The cells are the fewest that an empty tile has: three for each triangle and level, at the largest spacing.
    """
    width, height = region.bounds[2] - region.bounds[0], region.bounds[3] - region.bounds[1]
    n_tiles = math.ceil(width / region.tile_size) * math.ceil(height / region.tile_size)
    if n_tiles > MOST_IN_ALL:
        raise ConfigError(
            f"region {_words(region.bounds)}: {n_tiles:.3g} tiles of {region.tile_size:g} m > {MOST_IN_ALL:.3g}; "
            "raise --tile-size or give smaller --bounds"
        )
    extent = min(region.tile_size, max(width, height))
    if config.dtm_spacing > extent:
        raise ConfigError(
            f"dtm_spacing = {config.dtm_spacing:g} m > {extent:g} m, the extent of a tile, whose terrain may "
            "have no node; lower --dtm-spacing"
        )
    area = min(width, 1.5 * region.tile_size) * min(height, 1.5 * region.tile_size)
    nodes = area / config.dtm_spacing**2 if config.dtm_spacing > 1e-9 else math.inf
    if nodes > MOST_NODES:
        raise ConfigError(
            f"dtm_spacing = {config.dtm_spacing:g} m: {nodes:.3g} nodes in a tile of {region.tile_size:g} m > "
            f"{MOST_NODES:.3g}; raise --dtm-spacing or lower --tile-size"
        )
    layered = config.mesher == "layered"
    spacing = config.layer_height_or_default if layered else config.most_spacing * config.largest_size
    cells = 6 * area / config.largest_size**2 * expected_levels(config, spacing)
    cells += 6 * area / config.largest_size**2 * config.underground / (config.most_spacing * config.largest_size)
    if cells > MOST_CELLS:
        raise ConfigError(
            f"mesh_size = {config.mesh_size:g} m: at least {cells:.3g} cells in a tile of {region.tile_size:g} m "
            f"> {MOST_CELLS:.3g}; raise --mesh-size, or lower --tile-size or --domain-height"
        )


def check_region(region: Region, mesh_size: float, clouds: Sequence[CloudHeader], *, kind: str = "mesh") -> None:
    """Refuse a region that is smaller than a cell, or tiles that are too small for the cells or too many.

    The size of cells is the largest one, and its `kind` says which option gives it, ``mesh`` or ``open``.
    A single file that is much larger than a tile is named: a few astray points make its extent absurd.

    Raises
    ------
    ConfigError
        With the extent against its bound.
    """
    width, height = region.bounds[2] - region.bounds[0], region.bounds[3] - region.bounds[1]
    if min(width, height) <= 0:
        raise ConfigError(
            f"the point clouds have no whole metre of the region in them, for cells of {mesh_size:g} m: "
            "a point, a line or degrees; see citystitch plan, or give --bounds"
        )
    if min(width, height) < mesh_size:
        raise ConfigError(
            f"region {_words(region.bounds)}: {width:g} x {height:g} m is smaller than one cell of "
            f"{mesh_size:g} m; lower --{kind}-size or give larger --bounds"
        )
    if region.tile_size < LEAST_TILE * mesh_size:
        raise ConfigError(
            f"tile size {region.tile_size:g} m is below {LEAST_TILE:g} {kind} sizes of {mesh_size:g} m; give "
            f"--tile-size {math.ceil(LEAST_TILE * mesh_size)} or more, or lower --{kind}-size"
        )
    for cloud in clouds:
        span = max(cloud.bounds[2] - cloud.bounds[0], cloud.bounds[3] - cloud.bounds[1])
        sparse = cloud.n_points and span**2 > cloud.n_points * SPARSEST
        if sparse and span > ASTRAY_TILES * region.tile_size and max(width, height) > region.tile_size:
            raise InputError(
                f"{cloud.path}: its header spans {span / 1000:.0f} km, more than {ASTRAY_TILES} tiles of "
                f"{region.tile_size:g} m, with {cloud.n_points} points; if points lie astray in it, give --bounds "
                "around the others"
            )
    least = math.ceil(max(width, height) / (MOST_TILES - 1))
    if max(width, height) > (MOST_TILES - 1) * region.tile_size:
        raise ConfigError(
            f"region {_words(region.bounds)}: more than {MOST_TILES - 1} tiles of {region.tile_size:g} m to a "
            f"side; give --tile-size {least} or more, or smaller --bounds"
        )


def find_pad(core: TileGrid, config: Config, tallest: float) -> Pad:
    """Lay the pad around a region, given the height of its tallest building (m).

    ConfigError if the pad needs buildings and there are none, or it makes the region too large.
    """
    widths = widths_in_metres(config.pad, tallest)
    check_widths(widths, mesh_size=config.mesh_size, dtm_spacing=config.dtm_spacing)
    bounds = pad_bounds(core.bounds, widths)
    region = Region(bounds, "", config.tile_size_or_default)
    check_region(region, config.mesh_size, [])
    check_sizes(region, config)
    return Pad(core.bounds, pad_grid(core, bounds, mesh_size=config.mesh_size, open_size=config.graded_size))


def foresee_pad(core: TileGrid, config: Config) -> TileGrid:
    """Tiles of a region and its pad before there is a city model: multiples are those of an expected building."""
    return find_pad(core, config, EXPECTED_TALLEST).grid if config.padded else core


def _words(bounds: Sequence[float]) -> str:
    return " ".join(f"{value:.1f}" for value in bounds)
