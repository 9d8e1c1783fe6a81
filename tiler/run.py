"""A run: from a configuration to a folder with the mesh, its city model and its record."""

import dataclasses
import json
import os
import platform
import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pipeline.errors import CityError, ConfigError
from tiler.atomic import replacing
from tiler.config import Config
from tiler.context import RunContext, pack_tiles
from tiler.engine import Engine
from tiler.executors import Executor, connect, local, serial
from tiler.planning import Plan, identify, make_plan
from tiler.stage import REGION_ITEM
from tiler.stages.city import first_round, house_stage, later_round, model_stage, shape_stage
from tiler.stages.citymodel import CITY_MODEL, FULL_CITY_MODEL, city_model_stages
from tiler.stages.inputs import input_stages
from tiler.stages.mesh import mesh_stages
from tiler.stages.pieces import piece_stages
from tiler.summary import summarise_run
from tiler.task import Record
from tiler.vtk_files import write_pvtp, write_pvtu

SCHEMA = 1  # version of run.json's layout
# What a run writes, and all that --overwrite removes.
RESULTS = ("run.json", CITY_MODEL, FULL_CITY_MODEL, "mesh.pvtu", "boundary.pvtp", "mesh", "boundary", "store.zarr")
LIBRARIES = ("citystitch", "numpy", "scipy", "shapely", "numba", "triangle", "laspy", "lazrs", "pyogrio", "pyproj")
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
        Called with the name of each stage and the seconds of all its items when it is done.
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
        plan = make_plan(config, say or _silent)
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


def _mesh_region(config: Config, out: Path, plan: Plan, announce: Announce | None) -> dict[str, Any]:
    """Run all stages, and write the indexes of their pieces."""
    context = RunContext(
        plan.region.bounds, plan.region.crs, config.tile_size, config.mesh_size, pack_tiles(plan.grid), str(out)
    )
    footprints = Path(config.footprints) if config.footprints else None
    parameters = SimpleNamespace(
        **dataclasses.asdict(config),
        layer_height_or_default=config.layer_height_or_default,
        footprints_identity=identify(footprints) if footprints else "",
    )
    with _executor(config) as executor:
        engine = Engine(
            out / "store.zarr",
            plan.layout,
            parameters=parameters,
            context=context,
            executor=executor,
            progress=_Steps(announce),
        )
        rounds = run_stages(engine, config)
    tiles = sorted(plan.layout.tiles)
    write_pvtu(out / "mesh.pvtu", [out / "mesh" / f"{tile}.vtu" for tile in tiles])
    write_pvtp(out / "boundary.pvtp", [out / "boundary" / f"{tile}.vtp" for tile in tiles])
    return summarise_run(engine, plan, config, rounds)


def run_stages(engine: Engine, config: Config) -> int:
    """Run all stages in their order; returns how often clusters of houses were simplified.

    Parameters
    ----------
    engine : Engine
        Engine over the region's items.
    config : Config
        Parameters of the run.
    """
    rounds = run_city_stages(engine, config)
    engine.run(*city_model_stages(), *mesh_stages(config))
    engine.run(*piece_stages(config))
    return rounds


def run_city_stages(engine: Engine, config: Config) -> int:
    """Run the stages up to the simplified city model; parameters and result as for `run_stages`."""
    engine.run(*input_stages(config))
    largest = engine.records["footprints", REGION_ITEM].facts["largest"]
    engine.run(house_stage(config, largest))
    engine.run(*first_round(config))
    engine.run(shape_stage(0))
    last = 0
    while True:
        engine.run(*later_round(config, last + 1))
        if not engine.records[f"join-{last + 1}", REGION_ITEM].facts["joined"]:
            break
        last += 1
        engine.run(shape_stage(last))
    engine.run(model_stage(config, last))
    return last + 1


@contextmanager
def _executor(config: Config) -> Iterator[Executor]:
    if config.scheduler:
        with connect(config.scheduler) as executor:
            yield executor
    elif config.workers:
        with local(config.workers) as executor:
            yield executor
    else:
        with serial() as executor:
            yield executor


class _Steps:
    """Announces each stage when its last item is done, with the seconds of all."""

    def __init__(self, announce: Announce | None) -> None:
        self._announce = announce
        self._seconds: defaultdict[str, float] = defaultdict(float)

    def __call__(self, stage: str, done: int, total: int, record: Record) -> None:
        self._seconds[stage] += record.seconds.get("all", 0.0)
        if done == total and self._announce is not None:
            self._announce(f"{stage} ({total})", self._seconds[stage])


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
