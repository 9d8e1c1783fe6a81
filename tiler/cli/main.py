"""The command line: `citystitch run | plan | check | status | report | render | export` and others."""

import argparse
import dataclasses
import gc
import json
import logging
import os
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.data.errors import CityError, ConfigError
from tiler.cli.negative_values import mark_values
from tiler.cli.parser import EXPORT_OPTION, SYNTH_BUILDINGS, Handler, build_parser
from tiler.config.config import KEPT, Config, make_config
from tiler.config.config_file import annotated_defaults, with_file
from tiler.jobs.submission import describe_job, find_run, job_line
from tiler.mesh_files.run_files import refuse_strangers
from tiler.objects.places import place, refuse_bucket
from tiler.words.plain_text import printable
from tiler.words.std_streams import guard_streams

if TYPE_CHECKING:
    from tiler.engine.watcher import Watcher
    from tiler.interface.synth import SynthFiles
    from tiler.towns.styles import Town
    from tiler.towns.town import TownFiles

T = TypeVar("T")
EXIT_FAILED, EXIT_INTERRUPTED = 1, 130
DEMO_TILES = 3  # tiles along each side of the demo's city, fewer where they would be too small
LEAST_DEMO_TILE = 150.0  # m
BLOCK = Path(__file__).parents[1] / "demo_block"  # real data of a few hundred kilobytes


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the program's name; those of the process if not given.
    """
    _find_cache()
    if arguments is None:
        guard_streams()
        _silence_libraries()
    parser = make_parser()
    options, unknown = parser.parse_known_args(mark_values(sys.argv[1:] if arguments is None else arguments))
    if unknown:
        options.parser.refuse_unknown(unknown)
    handler: Handler = options.handler
    try:
        return handler(options)
    except CityError as error:
        if options.traceback:
            raise
        print("citystitch:", "\n".join(map(printable, error.lines)), file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("citystitch: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        if options.traceback:
            raise
        reason = printable(" ".join(str(error).split()))
        print(f"citystitch: {type(error).__name__}: {reason}; --traceback tells where", file=sys.stderr)
        return EXIT_FAILED
    finally:
        if arguments is None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is said; Python would end with a traceback
            gc.freeze()  # the process ends: a last look for garbage in all that was imported takes 0.2 s


def say(text: str) -> None:
    """Print one line at once, whatever a path or an attribute in it holds; into a log file, too."""
    print(printable(text), flush=True)


def _find_cache() -> None:
    """Let compiled code be cached in the temporary folder where neither package nor home can be written."""
    places = (Path(__file__).parents[1], Path.home())
    if "NUMBA_CACHE_DIR" not in os.environ and not any(os.access(place, os.W_OK) for place in places):
        os.environ["NUMBA_CACHE_DIR"] = str(Path(tempfile.gettempdir()) / f"citystitch-{os.getuid()}")


def _silence_libraries() -> None:
    """
    Keep the warnings of libraries from the user, who can do nothing about them, here and in workers.

    Their logs are kept from the terminal in this process alone: Dask adds no handler of its own where there is one
    already, and says a lot, with tracebacks, about connections that end when a run is interrupted.
    """
    logging.getLogger().addHandler(logging.NullHandler())
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        os.environ["PYTHONWARNINGS"] = "ignore"


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of all commands."""
    return build_parser(HANDLERS)


def _run(options: argparse.Namespace) -> int:
    config = make_config(with_file(vars(options)))
    if options.only is None:
        dashboard = None if options.no_dashboard else options.dashboard_address
        words = {"quiet": options.quiet, "verbose": options.verbose, "log": options.log_json}
        if options.lods is not None:
            return _run_levels(options, dashboard=dashboard, report=options.report, **words)
        return _run_config(config, dashboard=dashboard, report=options.report, **words)
    if options.log_json is not None:
        raise ConfigError("--log-json tells of a whole run; leave out it or --only")
    from tiler.workflow.single_tile import run_alone

    print(run_alone(config, options.only, say=None if options.quiet else say))
    return 0


def _run_levels(options: argparse.Namespace, **words: Any) -> int:
    """Make a mesh of each level of a city model; the exit code is that of the worst."""
    values = with_file(vars(options))
    if not values.get("buildings") or options.log_json is not None:
        raise ConfigError("--lods: takes levels of --buildings, and no --log-json; give a city model")
    levels = options.lods.split(",")
    configs = [make_config(values | {"lod": lod, "out": f"{values['out']}/lod{lod}"}) for lod in levels]
    codes = []
    for config in configs:
        say(f"level {config.lod}: {config.out}")
        codes.append(_run_config(config, **words))
    return max(codes)


def _run_config(
    config: Config,
    *,
    quiet: bool = False,
    verbose: bool = False,
    log: Path | None = None,
    dashboard: str | None = None,
    report: bool = False,
) -> int:
    from tiler.executors.dask_settings import keep_memory, start_fork_server
    from tiler.store.out_folder import has_record

    if config.workers and not config.on_cluster and not has_record(config.out):
        start_fork_server()  # at once, as there is something to do; else with the first task
    elif not config.workers:
        keep_memory()
    _collect_seldom()
    from tiler.monitoring.event_log import EventLog
    from tiler.monitoring.events import open_log
    from tiler.monitoring.terminal import make_view, print_last_line, print_summary
    from tiler.store.out_folder import refuse_result
    from tiler.workflow.run import run

    if report:
        refuse_bucket(config.out, "--report")
        if config.keep != KEPT[0]:
            raise ConfigError(f"--report: reads store and pieces, --keep {config.keep} leaves one; give either")
    out = place(config.out)
    watchers: list[Watcher] = []
    if log is not None:
        refuse_result(out, log)
        watchers.append(EventLog(log, open_log(log), every=0.0))
    watchers.append(make_view(quiet=quiet, verbose=verbose))
    record = run(config, watchers=watchers, dashboard=dashboard)
    if report:
        _report_run(out, quiet=quiet)
    if quiet:
        print_last_line(record, out)
    else:
        print_summary(record, out)
    code: int = record["exit_code"]
    return code


def _start_workers_with(module: str, workers: int) -> None:
    """Let workers to come import a module instead of all that a run needs."""
    from tiler.executors.dask_settings import start_fork_server

    if workers:
        start_fork_server(module)


def _collect_seldom() -> None:
    """Look for cycles of objects seldom: imports and tasks leave next to none."""
    from tiler.executors.dask_settings import GARBAGE

    gc.set_threshold(GARBAGE)


def _plan(options: argparse.Namespace) -> int:
    _collect_seldom()
    from tiler.report.plan_report import plan_run

    config = make_config(with_file(vars(options)))
    plan_run(config, json_file=options.json_file, picture=options.picture)
    return 0


def _check(options: argparse.Namespace) -> int:
    if options.workers and (options.store or options.cfd or options.export):
        raise ConfigError("--workers: goes with check alone, not with --store, --cfd or --export; leave it out")
    if options.store:
        from tiler.workflow.audit import audit_run

        return 0 if audit_run(options.directory, print) else EXIT_FAILED
    refuse_bucket(options.directory, "check without --store")
    if options.directory.suffix == ".gpkg" and not (options.cfd or options.direction or options.export):
        from tiler.generalisation.prove import check_generalisation

        return _print_proof(check_generalisation(options.directory))
    refuse_strangers(options.directory)
    if options.cfd:
        from tiler.check.cfd_guidelines import check_guidelines
        from tiler.export.wind_profile import WEST

        return _print_proof(check_guidelines(options.directory, options.direction or [WEST]))
    if options.direction:
        raise ConfigError("--direction: is for check --cfd; give that too")
    if options.export:
        from tiler.check.export_proofs import check_export

        return _print_proof(check_export(options.directory, options.export))
    return _check_folder(options.directory, options.workers)


def _check_folder(directory: Path, workers: int = 0) -> int:
    _start_workers_with("tiler.check.check", workers)
    from tiler.check.check import check_run
    from tiler.store.results import StoredTerrain

    return _print_proof(check_run(directory, StoredTerrain, workers=workers))


def _print_proof(report: Any) -> int:
    print("\n".join(map(printable, report.lines())))
    return 0 if report.ok else EXIT_FAILED


def _status(options: argparse.Namespace) -> int:
    from rich.console import Console

    from tiler.monitoring.status import print_status, read_status
    from tiler.store.out_folder import PROGRESS

    directory = find_run(options.job)
    job = describe_job(directory)
    if job is not None and not options.as_json:
        say(job_line(job))
    if job is not None and not (directory / PROGRESS).is_file():
        if options.as_json:
            print(json.dumps({"state": "not begun", "job": job}, indent=1))
        return 0
    status = read_status(directory)
    if options.as_json:
        print(json.dumps(status if job is None else status | {"job": job}, indent=1))
    else:
        print_status(directory, status, Console(highlight=False))
    return 0


def _dashboard(options: argparse.Namespace) -> int:
    from tiler.dashboard.server import show_folder

    show_folder(options.directory, f"{options.host}:{options.port}", say)
    return 0


def _view(options: argparse.Namespace) -> int:
    from tiler.serving.serve import view_city
    from tiler.store.out_folder import RUN_RECORD
    from tiler.tiles3d.view import serve_tiles, show_until_interrupted

    serve = view_city if (options.directory / RUN_RECORD).is_file() else serve_tiles
    show_until_interrupted("view", serve(options.directory, f"{options.host}:{options.port}"), say)
    return 0


def _serve(options: argparse.Namespace) -> int:
    from tiler.serving.serve import Placed, read_token, show_city

    placed = Placed(options.geoid_height, options.vertical_crs)
    more = {"token": read_token(options.token_file), "workers": options.workers, "placed": placed}
    show_city(options.directory, f"{options.host}:{options.port}", say, **more)
    return 0


def _report(options: argparse.Namespace) -> int:
    _collect_seldom()
    from tiler.report.write import write_report

    refuse_strangers(options.directory)
    say(str(write_report(options.directory, truth=options.truth)))
    return 0


def _report_run(out: Path, *, quiet: bool) -> None:
    """Write the report of a run that has just ended; the mesh is there, whatever becomes of it."""
    from tiler.report.write import write_report

    try:
        path = write_report(out)
        if not quiet:
            say(f"report: {path}")
    except Exception as error:
        reason = str(error) if isinstance(error, CityError) else f"{type(error).__name__}: {error}"
        print(
            f"citystitch: no report: {printable(reason)}; citystitch report {printable(str(out))} tries again",
            file=sys.stderr,
        )


def _fetch(options: argparse.Namespace) -> int:
    from tiler.workflow.fetch import fetch_run

    return 0 if fetch_run(options.source, options.directory, say) else EXIT_FAILED


def _synth(options: argparse.Namespace) -> int:
    if options.style == "boxes":
        names = ("lidar", "trees", "water", "variants", "degrade", "broken", "parameters", "footprints")
        if given := [name for name in names if getattr(options, name)]:
            raise ConfigError(f"--{given[0]}: goes with a town; give its --style, as --style detached")
    if options.class_errors is not None and not options.lidar:
        raise ConfigError("--class-errors: are those of the points of --lidar; give both or neither")
    if options.style == "boxes":
        _write_city(options.directory, options, options.workers)
    else:
        _write_town(options.directory, options)
    return 0


def _write_town(directory: Path, options: argparse.Namespace) -> None:
    from tiler.towns.town import CLASS_ERRORS, make_output, open_town, write_faults, write_houses, write_town
    from tiler.towns.town_tile import ModelOptions

    if options.buildings != SYNTH_BUILDINGS or options.roofs != "flat":
        raise ConfigError(
            f"--style {options.style}: has lots and rules of its own; --buildings and --roofs go with boxes, "
            "leave them out"
        )
    variants = options.variants.split(",") if options.variants else ()
    models = ModelOptions(
        tuple(options.levels.split(",")), options.walls, options.block_height, solid=not options.surfaces
    )
    if options.broken:
        directory.mkdir(parents=True, exist_ok=True)
        write_faults(directory / "broken.city.jsonl")
    output = make_output(models, variants, options.degrade, truth=options.lidar > 0, seed=options.seed)
    errors = CLASS_ERRORS if options.class_errors is None else options.class_errors
    town = open_town(
        options.size,
        options.style,
        rules=options.rules,
        seed=options.seed,
        relief=options.relief,
        trees=options.trees,
        water=options.water,
    )
    scan: dict[str, Any] = {"lidar": options.lidar, "class_errors": errors, "workers": options.workers}
    if options.parameters or options.footprints:
        _write_given(directory, options, partial(write_houses, output=output, town=town, **scan), town)
        return
    files = write_town(directory, town, output, density=options.density, **scan)
    say(_houses_line(files))


def _houses_line(files: "TownFiles") -> str:
    points = f"{len(files.clouds)} LAZ files in {files.clouds[0].parent}, " if files.clouds else ""
    return (
        f"{files.houses} houses: {points}{files.models.name}, {files.footprints.name} and {files.parameters.name}"
    )


def _write_given(
    directory: Path, options: argparse.Namespace, write: "Callable[..., TownFiles]", town: "Town"
) -> None:
    """Make the models of parameters, or of footprints by rules where their attributes say nothing."""
    from tiler.towns.augment import augment, write_augmented
    from tiler.towns.parameter_files import read_json, read_xml

    if options.parameters and options.footprints:
        raise ConfigError("--parameters and --footprints do not go together; give one of them")
    if given := [name for name in ("trees", "water") if getattr(options, name)]:
        raise ConfigError(f"--{given[0]}: goes with towns that are drawn; leave out --parameters and --footprints")
    if options.parameters:
        read = read_xml if options.parameters.suffix == ".xml" else read_json
        files = write(directory, lambda: read(options.parameters))
        say(_houses_line(files))
        return
    ground = {"ground": town.ground} if options.lidar else {}
    found = augment(options.footprints, town.rules, seed=options.seed, **ground)
    files = write(directory, lambda: found.houses, crs=found.crs)
    write_augmented(directory / "augmented.gpkg", found)
    for what, number in sorted(found.counts.items()):
        say(f"{number} {what}")
    say(_houses_line(files))
    say(
        f"{len(found.outlines)} footprints in augmented.gpkg, {files.houses} of them houses in {files.models.name}"
    )


def _write_city(directory: Path, options: argparse.Namespace, workers: int = 0) -> "SynthFiles":
    _start_workers_with("tiler.interface.synth", workers)
    from tiler.interface.synth import write_city

    files = write_city(
        directory,
        size=options.size,
        buildings=options.buildings,
        density=options.density,
        relief=options.relief,
        seed=options.seed,
        roofs=options.roofs,
        workers=workers,
    )
    clouds, shapefile = files.clouds[0].parent, files.shapefile
    say(f"{len(files.clouds)} LAZ files in {clouds}, footprints in {shapefile} and {files.footprints.name}")
    return files


def _demo(options: argparse.Namespace) -> int:
    out: Path = options.out
    files = _write_city(out / "city", options)
    clouds, footprints = [str(path) for path in files.clouds], str(files.shapefile)
    tile_size = max(options.size / DEMO_TILES, LEAST_DEMO_TILE)
    city = {
        "pointcloud": clouds,
        "footprints": footprints,
        "tile_size": tile_size,
        "workers": 2,
        "roofs": "planes",
    }
    block = {
        "pointcloud": [str(BLOCK / "cloud.laz")],
        "footprints": str(BLOCK / "footprints.geojson"),
        "mesh_size": 5.0,
        "roofs": "planes",
    }
    pictures = {out / "demo.png": "overview", out / "tiles.png": "tiles"}
    codes = [
        _demonstrate("a synthetic city, tile by tile", city, out / "result", pictures),
        _demonstrate("a block of Amsterdam", block, out / "block", {out / "block.png": "boundary"}),
    ]
    return max(codes)


def _demonstrate(title: str, inputs: dict[str, Any], out: Path, pictures: dict[Path, str]) -> int:
    """Mesh, check and draw; returns the exit code of the check."""
    from tiler.pictures.render import render_run

    print(f"\n{title}")
    _run_config(make_config(inputs | {"out": str(out), "overwrite": True}), report=True)
    code = _check_folder(out)
    for picture, what in pictures.items():
        try:
            render_run(out, picture, what=what)
        except ConfigError as error:  # the meshes are the demo's job; they need no pyvista and no OpenGL
            say(f"no picture: {error}")
            break
        say(f"picture: {picture}")
    say(f"mesh:    {out / 'mesh.pvtu'} (open it in ParaView)")
    return code


def _render(options: argparse.Namespace) -> int:
    from tiler.executors.dask_settings import FREED, keep_memory
    from tiler.pictures.render import render_run

    refuse_strangers(options.directory)
    keep_memory(FREED)  # what is read for a picture is not needed while it is drawn
    render_run(options.directory, options.output, what=options.what, say=say)
    say(str(options.output))
    return 0


def _export(options: argparse.Namespace) -> int:
    from tiler.export.export import export_run

    refuse_strangers(options.directory)
    given = {
        name.removeprefix(EXPORT_OPTION): value
        for name, value in vars(options).items()
        if name.startswith(EXPORT_OPTION)
    }
    words = {"name": options.format, "overwrite": options.overwrite, "options": given}
    return _tell(export_run(options.directory, options.output, **words), options.output)


def _convert(options: argparse.Namespace) -> int:
    from tiler.convert.convert import Asked, convert_models

    asked = _from_options(Asked, options, name=options.format)
    return _tell(convert_models(options.inputs, options.output, asked), options.output)


def _generalise(options: argparse.Namespace) -> int:
    from tiler.generalisation.generalise import generalise
    from tiler.generalisation.options import read_options

    inputs, asked = read_options(vars(options))
    if options.plan:
        from tiler.generalisation.plan import plan_generalisation

        for line in plan_generalisation(inputs, asked):
            say(line)
        return 0
    if options.output is None:
        raise ConfigError("generalise: nothing says where to write; give -o FILE.gpkg, or --plan")
    words = {"workers": options.workers, "overwrite": options.overwrite}
    return _tell(generalise(inputs, options.output, asked, **words), options.output)


def _detail(options: argparse.Namespace) -> int:
    from tiler.detail.detail import DetailAsked, detail_models

    asked = _from_options(DetailAsked, options)
    return _tell(detail_models(options.inputs, options.output, asked), options.output)


def _facade_rules(options: argparse.Namespace) -> int:
    from tiler.detail.image_rules import RulesAsked, write_facade_rules

    asked = _from_options(RulesAsked, options)
    return _tell(write_facade_rules(options.image, options.output, asked), options.output)


def _vegetation(options: argparse.Namespace) -> int:
    from tiler.textures.vegetation import train_classifier

    lines = train_classifier(options.images, options.masks, options.output, overwrite=options.overwrite)
    return _tell(lines, options.output)


def _texture(options: argparse.Namespace) -> int:
    from tiler.textures.texture import TextureAsked, texture_models

    asked = _from_options(TextureAsked, options)
    return _tell(texture_models(options.inputs, options.output, asked), options.output)


def _from_options(kind: type[T], options: argparse.Namespace, **given: Any) -> T:
    """Make a dataclass of the options with the names of its fields, but for those that are given."""
    entries: Any = kind
    names = [entry.name for entry in dataclasses.fields(entries) if entry.name not in given]
    return kind(**{name: getattr(options, name) for name in names}, **given)


def _tell(lines: Iterable[str], output: Path) -> int:
    """Print what a command has to say, and at last what it wrote."""
    for line in lines:
        say(line)
    say(str(output))
    return 0


def _wind(options: argparse.Namespace) -> int:
    from tiler.wind.outlet_profile import write_outlet_profile
    from tiler.wind.study import WindMaps, assess_wind

    if options.profile is not None:
        lines = write_outlet_profile(options.directory, options.profile, overwrite=options.overwrite)
        return _tell(lines, options.profile)
    if options.rose is None or options.output is None:
        raise ConfigError("wind: give --rose and --output for maps, or --profile for the profile at the outlet")
    maps = WindMaps(options.rose, options.rose_height, options.resolution)
    lines = assess_wind(options.directory, options.output, maps, overwrite=options.overwrite)
    return _tell(lines, options.output)


def _kernels(_: argparse.Namespace) -> int:
    from tiler.executors.kernels import cache_folder, compile_all

    if failed := compile_all():
        print(f"citystitch: kernels are not compiled: {printable(failed[0])}", file=sys.stderr)
        return EXIT_FAILED
    say(f"kernels are compiled for this machine, kept in {cache_folder()} and the like")
    return 0


def _edit(options: argparse.Namespace) -> int:
    from tiler.editing.edit import city_at, edit_city, list_edits
    from tiler.editing.uploads import Upload

    directory, more = options.directory, {"workers": options.workers, "say": say}
    if options.out and options.at is None:
        raise ConfigError("--out: is for --at; an edit changes the folder itself, leave it out")
    if options.as_list:
        for edit in list_edits(directory, say):
            say(f"{edit.number:>4}  {edit.date}  {edit.action:<7}  {', '.join(edit.ids)}  {edit.source}".rstrip())
        return 0
    if options.at is not None:
        if options.out is None:
            raise ConfigError("--at: makes the city of a day in another folder; name it with --out")
        record = city_at(directory, options.at, options.out, **more)
        say(f"{options.out}: the city of {options.at}, {_count_tasks(record)}")
        return int(record["exit_code"])
    name, upload = options.replace or (options.remove or "", options.add)
    action = "replace" if options.replace else "remove" if options.remove is not None else "add"
    upload = None if upload is None else Upload(Path(upload), options.position)
    done = edit_city(directory, action, name, upload, date=options.date, base=options.base, **more)
    edit = done.edit
    say(
        f"edit {edit.number} of {edit.date} is done: {edit.action} {', '.join(edit.ids)}; "
        f"{_count_tasks(done.record)}, {done.files} files changed"
    )
    return int(done.record["exit_code"])


def _count_tasks(record: Mapping[str, Any]) -> str:
    """Write how much of a run was computed."""
    tasks = record["tasks"]
    return f"{tasks['ran']} of {tasks['all']} tasks ran in {record['seconds_total']:.1f} s"


def _config(_: argparse.Namespace) -> int:
    print(annotated_defaults())
    return 0


HANDLERS: Mapping[str, Handler] = {
    "run": _run,
    "plan": _plan,
    "check": _check,
    "status": _status,
    "dashboard": _dashboard,
    "view": _view,
    "serve": _serve,
    "report": _report,
    "fetch": _fetch,
    "synth": _synth,
    "demo": _demo,
    "render": _render,
    "export": _export,
    "edit": _edit,
    "convert": _convert,
    "generalise": _generalise,
    "detail": _detail,
    "facade-rules": _facade_rules,
    "texture": _texture,
    "vegetation": _vegetation,
    "wind": _wind,
    "kernels": _kernels,
    "config": _config,
}


if __name__ == "__main__":
    sys.exit(main())
