"""A look at the footprints before a run: how many there are, where, and how finely they are drawn."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints
from tiler.cityinput.model_blocks import Wanted, read_model_blocks
from tiler.cityinput.sources import MODEL
from tiler.config.config import Config
from tiler.footprints.footprint_source import FootprintSource, make_footprints, open_source
from tiler.footprints.model_places import ModelPlaces, give_way
from tiler.georeference.frame import Frame, box_to_region
from tiler.objects.places import place
from tiler.planning.region import Region
from tiler.pointclouds.clouds import CloudHeader
from tiler.vectors.layers import BATCH, scan_layer

SAMPLE_FEATURES = 100_000  # features that are read; of a larger file the first ones, and they stand for all
CHAIN_TOLERANCE = 0.2  # m; what a run takes from outlines before anything else


@dataclass(frozen=True, eq=False)
class FootprintSample:
    """Footprints of a region, or the first ones of very many."""

    total: int  # how many the region has; an estimate unless the sample is complete
    complete: bool  # whether the sample has all of them
    polygons: NDArray[np.object_]  # (n,): polygons and multipolygons of the sample, in the region's CRS
    box: NDArray[np.float64]  # (n, 4): xmin, ymin, xmax, ymax of each (m)
    area: NDArray[np.float64]  # (n,): their areas (m2)
    # (n,): how much finer than the mesh their walls are: the sum of 1/e - 1/h over walls, with e the length of the
    # wall, but at least the clearance and at most the mesh size h (1/m)
    detail: NDArray[np.float64]
    octaves: NDArray[np.float64]  # (n,): the same as the sum of log2(h/e)

    def __len__(self) -> int:
        return len(self.polygons)


def sample_footprints(
    config: Config,
    region: Region,
    *,
    frame: Frame | None = None,
    models: Sequence[CloudHeader] = (),
    limit: int = SAMPLE_FEATURES,
) -> FootprintSample | None:
    """Read the footprints of a region, or enough of them to know the rest; None if no buildings are configured.

    Parameters
    ----------
    config, region
        Parameters of the run; the region.
    frame : Frame, optional
        How coordinates of the footprints become those of the region; by default as the CRSs have it.
    models : sequence of CloudHeader
        City models of the region, where buildings are theirs.
    limit : int
        Reading stops after this many footprints.

    Raises
    ------
    InputError, ConfigError
        As a run does: if the file, its layer or attributes cannot be read.

    Notes
    -----
    Ids are not looked at. Beside city models, footprints give way to those buildings of the models that were
    read. The number in the region of a file that is larger is that of all its features, less the share of the
    layer's extent that lies outside; it counts where the layer tells its number and extent.
    """
    found = [_read_models(config, region, models, limit)] if config.buildings else []
    found += [_read_file(config, region, frame, limit)] if config.footprints else []
    if not found:
        return None
    polygons = [one.polygons for one in found]
    if len(found) == 2:
        ids = np.arange(len(polygons[1])).astype(np.str_)
        beside = Footprints(polygons[1], ids, np.full(len(ids), np.nan))
        polygons[1] = give_way(beside, ModelPlaces(polygons[0], np.empty(0, np.int64)), region.bounds)[0].polygons
    rest = sum(one.total - len(one.polygons) for one in found)
    return _make_sample(
        config,
        np.concatenate(polygons),
        sum(map(len, polygons)) + rest,
        complete=all(one.complete for one in found),
    )


@dataclass(frozen=True, eq=False)
class _Outlines:
    """Outlines that were read, how many there are in the region, and whether that is all of them."""

    polygons: NDArray[np.object_]
    total: int
    complete: bool


def _read_file(config: Config, region: Region, frame: Frame | None, limit: int) -> _Outlines:
    """Read the footprints of a file, or the first of very many."""
    crs = pyproj.CRS.from_user_input(region.crs)
    source = open_source(
        place(config.footprints),
        crs=crs,
        bounds=region.bounds,
        layer=config.layer,
        id_attribute=config.id_attribute,
        frame=frame,
        height_attribute=config.height_attribute,
        roof_attribute=config.roof_attribute,
    )
    parts = (
        make_footprints(source, features, frozenset(), Counter())[0].polygons
        for features in scan_layer(source.layer, source.columns, source.box, batch=min(BATCH, limit))
    )
    return _take_some(parts, limit, lambda: _number_within(source, region, crs))


def _read_models(config: Config, region: Region, models: Sequence[CloudHeader], limit: int) -> _Outlines:
    """Read the outlines of the buildings of city models; of very many those of the first ones."""
    wanted = Wanted(config.lod, config.height_attribute, roof_points=False, ground_points=False)
    blocks = (
        block.rows.outlines
        for header in models
        if header.kind == MODEL
        for block in read_model_blocks(header.path, header.frame, region.bounds, wanted)
    )
    return _take_some(blocks, limit, lambda: sum(header.n_buildings for header in models))


def _take_some(parts: Iterable[NDArray[np.object_]], limit: int, estimate: Callable[[], int]) -> _Outlines:
    """Take parts until there are as many as the limit; of more, `estimate` says how many there are in all."""
    taken, n_read = [np.empty(0, np.object_)], 0
    for part in parts:
        if n_read >= limit:
            return _Outlines(np.concatenate(taken), max(n_read, estimate()), complete=False)
        taken.append(part)
        n_read += len(part)
    return _Outlines(np.concatenate(taken), n_read, complete=True)


def _make_sample(config: Config, polygons: NDArray[np.object_], total: int, *, complete: bool) -> FootprintSample:
    at_walls = config.wall_size or config.mesh_size
    detail, octaves = measure_detail(polygons, clearance=config.clearance, mesh_size=at_walls)
    return FootprintSample(
        total, complete, polygons, shapely.bounds(polygons).reshape(-1, 4), shapely.area(polygons), detail, octaves
    )


def measure_detail(
    polygons: NDArray[np.object_], *, clearance: float, mesh_size: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure how much finer than the mesh the walls of each polygon are: detail and octaves of `FootprintSample`.

    Examples
    --------
    >>> measure_detail(np.array([shapely.box(0, 0, 5, 40)]), clearance=1.0, mesh_size=10.0)
    (array([0.2]), array([2.]))
    """
    simple = shapely.simplify(polygons, CHAIN_TOLERANCE, preserve_topology=False)
    rings, owner = shapely.get_rings(simple, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    same = ring[1:] == ring[:-1]
    length = np.hypot(*(xy[1:] - xy[:-1])[same].T)
    edge = np.clip(length, min(clearance, mesh_size), mesh_size)
    house = owner[ring[1:][same]]
    detail = np.bincount(house, weights=1 / edge - 1 / mesh_size, minlength=len(polygons))
    octaves = np.bincount(house, weights=np.log2(mesh_size / edge), minlength=len(polygons))
    return detail.astype(np.float64), octaves.astype(np.float64)


def _number_within(source: FootprintSource, region: Region, crs: pyproj.CRS) -> int:
    """Share of a layer's features that a region has, were they spread evenly over the layer's extent."""
    extent, n = source.layer.extent, source.layer.n_features
    if extent is None or n < 0:
        return 0
    extent = box_to_region(source.frame, extent)
    sides = [max(0.0, min(extent[k + 2], region.bounds[k + 2]) - max(extent[k], region.bounds[k])) for k in (0, 1)]
    area = (extent[2] - extent[0]) * (extent[3] - extent[1])
    return round(n * sides[0] * sides[1] / area) if area > 0 else n
