"""One tile from files to files: what a worker runs."""

import dataclasses
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from pipeline.building_facts import describe_buildings, measure_model
from pipeline.building_points import has_building_class
from pipeline.city import City
from pipeline.citymodel import Footprints
from pipeline.columns import expand_cells, extract_boundary, lowest_gap
from pipeline.errors import GeometryError, InputError
from pipeline.ground_filter import classify_ground
from pipeline.notes import Note
from pipeline.pointcloud import GROUND, WATER, PointCloud
from pipeline.quality import measure_cells, quality_percentiles
from pipeline.simplify import simplify_city
from pipeline.terrain import bin_ground, fill_dtm
from pipeline.tile import TileMesh, build_city, mesh_city
from tiler.cityjson import write_city_model
from tiler.clouds import read_points
from tiler.config import Config
from tiler.options import city_options, mesh_options
from tiler.region import Region
from tiler.store import Store, write_columns, write_dtm
from tiler.vectors import read_footprints
from tiler.vtk_files import write_vtp, write_vtu

FULL_CITY_MODEL = "citymodel-full.city.json"
CITY_MODEL = "citymodel.city.json"


@dataclass(frozen=True)
class TileJob:
    """Everything that a tile needs to know; small, and the same in any process.

    Attributes
    ----------
    name : str
        Name of the tile.
    region : Region
        What is meshed.
    clouds : tuple of Path
        Readable point-cloud files that may touch the tile.
    config : Config
        Parameters of the run.
    out : Path
        Folder of the run.
    """

    name: str
    region: Region
    clouds: tuple[Path, ...]
    config: Config
    out: Path


@dataclass
class TileRecord:
    """What came of a tile, for the run's record.

    Attributes
    ----------
    name : str
        Name of the tile.
    counts : dict
        Numbers of things by name.
    quality : dict
        Percentiles by measure.
    seconds : dict
        Wall time by step (s).
    facts : dict
        Further values: what the mesher did, smallest gap.
    fidelity : dict
        Distance of the point cloud to the city model (m), by kind of point.
    notes : list of Note
        What was dropped, repaired or defaulted.
    unreadable : dict
        Files left out, with the reason.
    peak_memory : int
        Largest resident memory of the process so far (bytes).
    """

    name: str
    counts: dict[str, int] = field(default_factory=dict)
    quality: dict[str, dict[str, float]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    fidelity: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)
    peak_memory: int = 0


def mesh_tile(job: TileJob, announce: Callable[[str, float], None] | None = None) -> TileRecord:
    """Run all steps on one tile and write its results.

    Parameters
    ----------
    job : TileJob
        The tile.
    announce : callable, optional
        Called with the name and the seconds of each step when it is done.
    """
    record = TileRecord(job.name)

    @contextmanager
    def trace(step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        record.seconds[step] = round(record.seconds.get(step, 0.0) + seconds, 4)
        if announce is not None:
            announce(step, seconds)

    config, bounds = job.config, job.region.bounds
    store = Store(job.out / "store.zarr")
    with trace("1.1 read point cloud"):
        cloud = _read_cloud(job, record)
    with trace("1.2 read footprints"):
        footprints = _read_footprints(job, record)
    with trace("1.3 terrain"):
        cloud = _with_ground(cloud, job, record)
        binned, count = bin_ground(cloud, bounds, spacing=config.dtm_spacing)
        record.counts["terrain nodes"] = int(count.size)
        record.counts["terrain nodes filled"] = int((count == 0).sum())
        dtm = fill_dtm(binned)
        write_dtm(store, job.name, dtm)
    options = city_options(config)
    full = build_city(cloud, footprints, dtm, bounds, options, trace)
    if config.footprints and len(footprints.polygons) == 0 and has_building_class(cloud):
        record.notes.append(
            Note(
                "building-points-without-footprints",
                config.footprints,
                detail="the cloud has buildings, the file none in the region; check --crs and the files' CRSs",
            )
        )
    if len(full.model) and not has_building_class(cloud):
        record.notes.append(
            Note("no-building-class", detail="roof points are those that are not ground, water, plants or noise")
        )
    with trace("1.7 export city model"):
        record.notes += _export(job, job.out / FULL_CITY_MODEL, full, describe_buildings(cloud, full))
    simple = simplify_city(full, cloud, dtm, options, trace)
    with trace("2.4 export city model"):
        record.notes += _export(job, job.out / CITY_MODEL, simple, describe_buildings(cloud, simple))
    with trace("2.4 fidelity"):
        record.fidelity = measure_model(cloud, dtm, simple, full.model.polygons)
        record.fidelity |= {"outline": simple.outline} if simple.outline else {}
    record.counts |= simple.counts
    record.counts |= {"buildings": len(simple.model), "buildings before merging": len(full.model)}
    del cloud, footprints, full
    mesh = mesh_city(simple, dtm, bounds, mesh_options(config), min_angle=config.min_angle, trace=trace)
    record.notes += [*simple.notes, *mesh.notes]
    with trace("3.6 export mesh"):
        _export_mesh(job, store, simple, mesh, record)
    record.peak_memory = _peak_memory()
    return record


def _read_cloud(job: TileJob, record: TileRecord) -> PointCloud:
    parts: list[PointCloud] = []
    counts: dict[str, int] = {}
    for path in job.clouds:
        try:
            part, found = read_points(path, job.region.bounds)
        except InputError as error:
            if not job.config.skip_unreadable:
                raise
            record.unreadable[str(path)] = str(error)
            continue
        parts.append(part)
        for name, number in found.items():
            counts[f"points {name}"] = counts.get(f"points {name}", 0) + number
    record.counts |= counts
    if sum(len(part.xyz) for part in parts) == 0:
        raise InputError(
            f"tile {job.name}, step 1.1: none of {counts.get('points read', 0)} points lies in the region "
            f"{job.region.bounds} and can be used; check --bounds and the point clouds"
        )
    return PointCloud(
        np.concatenate([part.xyz for part in parts]), np.concatenate([part.classification for part in parts])
    )


def _read_footprints(job: TileJob, record: TileRecord) -> Footprints:
    config = job.config
    if not config.footprints:
        none = np.empty(0)
        return Footprints(none.astype(object), none.astype(np.str_), none)
    footprints: Footprints
    footprints, notes = read_footprints(
        Path(config.footprints),
        crs=pyproj.CRS.from_user_input(job.region.crs),
        bounds=job.region.bounds,
        layer=config.layer,
        id_attribute=config.id_attribute,
        height_attribute=config.height_attribute,
    )
    record.notes += notes
    if len(footprints.polygons) == 0:
        record.notes.append(Note("no-footprints-in-region", config.footprints, detail="terrain only"))
    return footprints


def _with_ground(cloud: PointCloud, job: TileJob, record: TileRecord) -> PointCloud:
    if job.config.ground_filter:
        record.notes.append(Note("ground-filter", detail="ground found by progressive morphological opening"))
        return classify_ground(cloud)
    if not np.isin(cloud.classification, (GROUND, WATER)).any():
        classes = ", ".join(str(c) for c in np.unique(cloud.classification))
        raise InputError(
            f"tile {job.name}, step 1.3: no point is classified as ground (2) or water (9), only as {classes}; "
            "classify the cloud, or give --ground-filter"
        )
    return cloud


def _export(job: TileJob, path: Path, city: City, attributes: dict[str, Sequence[object]]) -> tuple[Note, ...]:
    model = city.model
    low, high = job.region.bounds[:2], job.region.bounds[2:]
    heights = (float(model.ground.min()), float(model.roof.max())) if len(model) else (0.0, 0.0)
    bounds = (*low, heights[0], *high, heights[1])
    return write_city_model(path, model, crs=job.region.crs, bounds=bounds, attributes=attributes)


def _export_mesh(job: TileJob, store: Store, city: City, mesh: TileMesh, record: TileRecord) -> None:
    gap, inverted = lowest_gap(mesh.columns)
    if inverted:
        raise GeometryError(
            f"tile {job.name}, step 3.5: {inverted} levels do not ascend, the worst by {gap:.3g} m; raise "
            "--roof-clearance"
        )
    write_columns(store, job.name, mesh.columns)
    cells = expand_cells(mesh.columns)
    boundary = extract_boundary(mesh.columns, city.model.numbers)
    write_vtu(job.out / "mesh" / f"{job.name}.vtu", cells)
    write_vtp(job.out / "boundary" / f"{job.name}.vtp", cells.points, boundary)
    record.counts |= {
        "cells": len(cells.cells),
        "points": len(cells.points),
        "facets": len(boundary.facets),
        "triangles": len(mesh.columns.plane.triangles),
        "columns": len(mesh.columns.plane.xy),
    }
    record.facts = {"smallest gap (m)": round(gap, 4)} | dataclasses.asdict(mesh.report)
    record.quality = quality_percentiles(measure_cells(cells))


def _peak_memory() -> int:
    """Peak resident memory: VmHWM where the system tells it, as ru_maxrss survives a fork."""
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) * 1024
    except (OSError, IndexError, ValueError):
        peak: Any = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return int(peak) if sys.platform == "darwin" else int(peak) * 1024
