"""A run: from a configuration to a folder with the mesh, its city model and its record."""

import dataclasses
import json
import math
import os
import platform
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pipeline.errors import CityError, ConfigError, InputError
from pipeline.notes import Note, count_notes
from tiler.atomic import replacing
from tiler.clouds import CloudHeader, find_clouds, read_header
from tiler.config import Config, idle_parameters
from tiler.crs import resolve_crs
from tiler.engine import run_jobs
from tiler.region import Region, check_region, choose_bounds, describe_overhang, tile_name
from tiler.tile_task import CITY_MODEL, FULL_CITY_MODEL, TileJob, TileRecord, mesh_tile
from tiler.vectors import read_footprint_crs
from tiler.vtk_files import write_pvtp, write_pvtu

SCHEMA = 1  # version of run.json's layout
# What a run writes, and all that --overwrite removes.
RESULTS = ("run.json", CITY_MODEL, FULL_CITY_MODEL, "mesh.pvtu", "boundary.pvtp", "mesh", "boundary", "store.zarr")
LIBRARIES = ("citystitch", "numpy", "scipy", "shapely", "numba", "triangle", "laspy", "lazrs", "pyogrio", "pyproj")
EXIT_DONE, EXIT_INCOMPLETE = 0, 3

# Notes of these kinds say that something is missing which the input has: the exit code tells.
INCOMPLETE = {"building-lost", "building-points-without-footprints"}

Announce = Callable[[str, float], None]


def run(
    config: Config, *, announce: Announce | None = None, say: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """Mesh a region as configured.

    Parameters
    ----------
    config : Config
        Parameters of the run.
    announce : callable, optional
        Called with name and seconds of each step when it is done (with ``workers = 0``).
    say : callable, optional
        Called with sentences that the user should read.

    Returns
    -------
    dict
        What ``run.json`` holds. ``exit_code`` is 0, or 3 if parts were left out.

    Raises
    ------
    CityError
        If nothing could be made of the input; ``run.json`` then says so.
    """
    if not config.pointcloud:
        raise ConfigError("no point cloud: give files, globs or folders, as in `citystitch run tiles/*.laz`")
    out = Path(config.out)
    earlier = _check_folder(out, overwrite=config.overwrite)
    start = time.perf_counter()
    record: dict[str, Any] = {
        "schema": SCHEMA,
        "status": "running",
        "parameters": dataclasses.asdict(config),
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in LIBRARIES},
    }
    try:
        # Nothing of an earlier run is touched before the inputs are known to be there.
        plan = _plan(config, say or _silent)
        _clear_folder(out, earlier)
        earlier = []
        _write_record(out, record)
        record |= _mesh_region(config, out, plan, announce)
        record["status"] = "done"
    except CityError as error:
        record |= {"status": "failed", "error": str(error)}
        raise
    except BaseException as error:
        record |= {"status": "failed", "error": f"{type(error).__name__}: {error}"}
        raise
    finally:
        record["seconds_total"] = round(time.perf_counter() - start, 3)
        if not earlier:
            _write_record(out, record)
    return record


@dataclass(frozen=True)
class _Plan:
    """What is known before any point is read."""

    region: Region
    headers: list[CloudHeader]
    messages: list[str]
    unreadable: dict[str, str]


def _plan(config: Config, say: Callable[[str], None]) -> _Plan:
    paths = find_clouds(config.pointcloud)
    headers, unreadable = _read_headers(paths, skip=config.skip_unreadable)
    footprint_crs = read_footprint_crs(Path(config.footprints)) if config.footprints else None
    crs, messages = resolve_crs(config.crs or None, headers, footprint_crs)
    code = crs.to_epsg()
    region = Region(
        choose_bounds(config.bounds, headers), f"EPSG:{code}" if code else crs.to_wkt(), config.tile_size
    )
    check_region(region, config.mesh_size, headers)
    messages += [*describe_overhang(region.bounds, headers), *idle_parameters(config)]
    if not config.footprints:
        messages.append("no footprints given: the mesh has terrain only")
    for message in messages:
        say(message)
    return _Plan(region, headers, messages, unreadable)


def _mesh_region(config: Config, out: Path, plan: _Plan, announce: Announce | None) -> dict[str, Any]:
    clouds = tuple(header.path for header in plan.headers if header.n_points and _meets(header, plan.region))
    job = TileJob(tile_name(plan.region), plan.region, clouds, config, out)
    task = partial(mesh_tile, announce=announce) if config.workers == 0 else mesh_tile
    tiles = list(run_jobs(task, [job], workers=config.workers))
    write_pvtu(out / "mesh.pvtu", [out / "mesh" / f"{tile.name}.vtu" for tile in tiles])
    write_pvtp(out / "boundary.pvtp", [out / "boundary" / f"{tile.name}.vtp" for tile in tiles])
    unreadable = dict(plan.unreadable)
    for tile in tiles:
        unreadable |= tile.unreadable
    return _summary(plan.region, plan.headers, tiles, plan.messages, unreadable)


def _summary(
    region: Region,
    headers: Sequence[CloudHeader],
    tiles: Sequence[TileRecord],
    messages: Sequence[str],
    unreadable: dict[str, str],
) -> dict[str, Any]:
    (tile,) = tiles
    counts = {"files": len(headers), "files empty": sum(header.n_points == 0 for header in headers), **tile.counts}
    return {
        "exit_code": EXIT_INCOMPLETE
        if unreadable or INCOMPLETE & {note.kind for note in tile.notes}
        else EXIT_DONE,
        "region": {"bounds": list(region.bounds), "crs": region.crs, "tile_size": region.tile_size},
        "tiles": {tile.name: {"status": "done", "counts": tile.counts, "facts": tile.facts}},
        "counts": counts,
        "quality": tile.quality,
        "fidelity": tile.fidelity,
        "seconds": tile.seconds,
        "peak_memory_bytes": tile.peak_memory,
        "messages": list(messages),
        "unreadable": unreadable,
        "notes": group_notes(tile.notes),
    }


def group_notes(notes: Sequence[Note]) -> dict[str, dict[str, Any]]:
    """Group notes by kind, with their number and their places, for the record."""
    kinds: dict[str, dict[str, Any]] = {
        kind: {"count": number, "items": []} for kind, number in count_notes(notes).items()
    }
    for note in notes:
        item: dict[str, Any] = {"subject": note.subject, "detail": note.detail}
        if not math.isnan(note.x):
            item |= {"x": round(note.x, 3), "y": round(note.y, 3)}
        kinds[note.kind]["items"].append(item)
    return kinds


def _read_headers(paths: Sequence[Path], *, skip: bool) -> tuple[list[CloudHeader], dict[str, str]]:
    headers: list[CloudHeader] = []
    unreadable: dict[str, str] = {}
    for path in paths:
        try:
            headers.append(read_header(path))
        except InputError as error:
            if not skip:
                raise
            unreadable[str(path)] = str(error)
    return headers, unreadable


def _meets(header: CloudHeader, region: Region) -> bool:
    xmin, ymin, xmax, ymax = region.bounds
    return not (
        header.bounds[0] > xmax or header.bounds[2] < xmin or header.bounds[1] > ymax or header.bounds[3] < ymin
    )


def _check_folder(out: Path, *, overwrite: bool) -> list[str]:
    """Refuse an output folder that holds something to keep; returns the results that may be replaced."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; give another --out")
    earlier = [name for name in RESULTS if (out / name).exists()]
    if earlier and not (out / "run.json").is_file():
        raise ConfigError(f"{out}: holds {', '.join(earlier)}, but no run.json of a run; give another --out")
    if earlier and not overwrite and not _has_failed(out / "run.json"):
        raise ConfigError(
            f"{out}: holds the results of another run ({', '.join(earlier)}); give another --out, or --overwrite"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); give another --out") from error
    if not os.access(out, os.W_OK):
        raise ConfigError(f"{out}: cannot be written; give another --out")
    return earlier


def _has_failed(path: Path) -> bool:
    try:
        return bool(json.loads(path.read_text())["status"] == "failed")
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _clear_folder(out: Path, earlier: Sequence[str]) -> None:
    """Remove the results of an earlier run and make the folders of this one."""
    try:
        for name in earlier:
            path = out / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for folder in ("mesh", "boundary"):
            (out / folder).mkdir()
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); give another --out") from error


def _write_record(out: Path, record: dict[str, Any]) -> None:
    with replacing(out / "run.json") as part:
        part.write_text(json.dumps(record, indent=1, default=str) + "\n")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _silent(_: str) -> None:
    """Say nothing."""
