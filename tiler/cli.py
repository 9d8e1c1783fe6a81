"""The command line: `citystitch run | plan | check | status | report | render | export` and others."""

import argparse
import dataclasses
import gc
import json
import logging
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_origin, get_type_hints

from pipeline.errors import CityError, ConfigError
from tiler import fork_server
from tiler.addresses import ANYWHERE
from tiler.api import POSITIONAL, with_file
from tiler.config import Config, annotated_defaults, make_config
from tiler.domain import Height
from tiler.export import FORMATS
from tiler.jobs.commands import add_job_commands, describe_job, find_run, job_line
from tiler.places import place, refuse_bucket
from tiler.plain_text import printable

if TYPE_CHECKING:
    from tiler.synth import SynthFiles

EXIT_CODES = (
    "Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 3 done but for parts listed in run.json, "
    "130 stopped."
)
METAVARS = {str: "NAME", float: "NUMBER", int: "NUMBER"}
EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130
DEMO_TILES = 3  # tiles along each side of the demo's city, fewer where they would be too small
LEAST_DEMO_TILE = 150.0  # m
EXPORT_OPTIONS = {option for kind in FORMATS.values() for option in kind.options}
BLOCK = Path(__file__).with_name("demo_block")  # real data of a few hundred kilobytes


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the program's name; those of the process if not given.
    """
    _find_cache()
    if arguments is None:
        _silence_libraries()
    parser = make_parser()
    options = parser.parse_args(arguments)
    handler: Callable[[argparse.Namespace], int] = options.handler
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
            gc.freeze()  # the process ends: a last look for garbage in all that was imported takes 0.2 s


def say(text: str) -> None:
    """Print one line, whatever a path or an attribute in it holds."""
    print(printable(text))


def _find_cache() -> None:
    """Let compiled code be cached in the temporary folder where neither package nor home can be written."""
    places = (Path(__file__).parent, Path.home())
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
    """Make the parser of all commands; the parameters of a run come from `Config`."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--traceback", action="store_true", help="show where in the code an error arose")
    parser = argparse.ArgumentParser(
        prog="citystitch",
        description="LiDAR point clouds and building footprints in, one conforming tetrahedral city mesh out.",
        epilog=EXIT_CODES,
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, handler: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text, epilog=EXIT_CODES, parents=[common])
        sub.set_defaults(handler=handler)
        return sub

    run = command("run", _run, "mesh a region from point clouds and footprints")
    _add_inputs(run)
    run.add_argument(
        "--dashboard-address",
        default=ANYWHERE,
        metavar="HOST:PORT",
        help="where the page of the run is shown while it is at work (default: a free port of 127.0.0.1)",
    )
    run.add_argument("--no-dashboard", action="store_true", help="show no page of the run")
    run.add_argument("--only", metavar="TILE", help="mesh one tile alone, in this process: to look into a failure")
    words = run.add_mutually_exclusive_group()
    words.add_argument("-q", "--quiet", action="store_true", help="print errors and the last line only")
    words.add_argument("-v", "--verbose", action="store_true", help="print a line for each item too")
    run.add_argument("--log-json", type=Path, metavar="FILE", help="write what happens, a JSON object a line")
    run.add_argument(
        "--report",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="write report.html at the end, as `citystitch report` does",
    )
    _add_join(command("join", _join, "work at a run together with others, on any machines that share its folder"))
    plan = command("plan", _plan, "tell what a run would do and take, without doing it")
    plan.add_argument("--json", type=Path, dest="json_file", metavar="FILE", help="write the plan as JSON too")
    plan.add_argument("--picture", type=Path, metavar="FILE.png", help="draw tiles, files and footprints")
    _add_inputs(plan)
    check = command("check", _check, "prove from the written files that a mesh is right")
    check.add_argument("directory", type=place, help="folder of a run")
    check.add_argument(
        "--store", action="store_true", help="instead hold every artefact of the run against its checksum"
    )
    status = command("status", _status, "tell how far a run is, whether it is alive, and how to go on")
    status.add_argument("job", metavar="DIRECTORY|JOB", help="folder of a run, or number of its job")
    status.add_argument("--json", action="store_true", dest="as_json", help="print all of it as JSON")
    board = command("dashboard", _dashboard, "show the page of a run, at work, ended or dead, from its folder")
    board.add_argument("directory", type=_on_disk, help="folder of a run")
    board.add_argument(
        "--port", type=int, default=0, metavar="N", help="port to listen at; 0: a free one (default)"
    )
    board.add_argument(
        "--host", default="127.0.0.1", help="address to listen at (default: 127.0.0.1, this machine alone)"
    )
    report = command("report", _report, "write report.html: what a run made, how good it is, what was left out")
    report.add_argument("directory", type=_on_disk, help="folder of a run")
    _add_fetch(command("fetch", _fetch, "fetch the folder of a run from a bucket, and verify its checksums"))
    synth = command("synth", _synth, "write a synthetic city: point cloud and footprints")
    synth.add_argument("directory", type=Path, help="folder to write to")
    _add_city(synth, size=1000.0, buildings=500)
    demo = command("demo", _demo, "mesh, check and draw a synthetic city in tiles and a block of a real one")
    demo.add_argument("--out", type=Path, default=Path("demo"), help="folder to write to (default: demo)")
    _add_city(demo, size=600.0, buildings=220)
    render = command("render", _render, "draw a picture of a run")
    render.add_argument("directory", type=_on_disk, help="folder of a run")
    render.add_argument("-o", "--output", type=Path, required=True, help="PNG file to write")
    render.add_argument(
        "--what",
        choices=("boundary", "mesh", "overview", "tiles", "sizes", "quality", "citymodel"),
        default="boundary",
        help="what to draw; sizes: triangles from above, by the length of their edges; quality: the boundary by "
        "the cells behind it; citymodel: blocks on the terrain",
    )
    add_job_commands(command, _add_inputs)
    _add_export(command("export", _export, "write the mesh of a run for other programs, each vertex once"))
    command("config", _config, "print all parameters of a run, annotated, as a configuration file")
    return parser


def _add_inputs(parser: argparse.ArgumentParser) -> None:
    """Add point clouds, and the parameters of a run."""
    parser.add_argument(
        POSITIONAL, nargs="*", metavar="POINTCLOUD", help="files, globs or folders; or one config.toml"
    )
    _add_parameters(parser)


def _add_join(join: argparse.ArgumentParser) -> None:
    """Add the options of one that joins a run: those of the run, and a few of its own."""
    _add_inputs(join)
    join.add_argument("--member", default="", metavar="NAME", help="its name (default: its element of an array)")
    join.add_argument(
        "--max-idle",
        type=float,
        default=600.0,
        metavar="SECONDS",
        help="how long to wait for a folder that a run holds which is not one to join (default: 600)",
    )
    words = join.add_mutually_exclusive_group()
    words.add_argument("-q", "--quiet", action="store_true", help="print errors and the last line only")
    words.add_argument("-v", "--verbose", action="store_true", help="print a line for each item too")


def _add_parameters(parser: argparse.ArgumentParser) -> None:
    """Add an option for every parameter of a run; what is not given is left to the file or default."""
    hints = get_type_hints(Config)
    groups: dict[str, Any] = {}
    for entry in dataclasses.fields(Config):
        if entry.name == POSITIONAL:
            continue
        data, wanted = entry.metadata, hints[entry.name]
        group = groups.setdefault(data["section"], parser.add_argument_group(data["section"]))
        words: dict[str, Any] = {"dest": entry.name, "default": argparse.SUPPRESS, "help": _help(entry)}
        if wanted is bool:
            words["action"] = argparse.BooleanOptionalAction
        elif get_origin(wanted) is tuple and get_args(wanted)[0] == Height:
            words |= {"type": str, "nargs": "+", "metavar": "M|nH"}
        elif get_origin(wanted) is tuple:
            words |= {"type": get_args(wanted)[0], "nargs": 4, "metavar": ("XMIN", "YMIN", "XMAX", "YMAX")}
        elif wanted == Height:
            words |= {"type": str, "metavar": "M|nH"}
        else:
            unit = "" if wanted is str else data["unit"].upper()
            words |= {"type": wanted, "metavar": unit or METAVARS[wanted]}
            if data["choices"]:
                words |= {"choices": data["choices"], "metavar": None}
        group.add_argument(f"--{entry.name.replace('_', '-')}", **words)


def _help(entry: "dataclasses.Field[Any]") -> str:
    data = entry.metadata
    shown = isinstance(entry.default, (int, float)) and not isinstance(entry.default, bool)
    default = f"default: {entry.default:g}" if shown else f"default: {entry.default}" if entry.default else ""
    facts = ", ".join(fact for fact in (default, data["unit"], data["source"]) if fact)
    return f"{data['text']} ({facts})".replace("%", "%%") if facts else data["text"]


def _add_city(parser: argparse.ArgumentParser, *, size: float, buildings: int) -> None:
    parser.add_argument("--size", type=float, default=size, help=f"side of the city in m (default: {size:g})")
    parser.add_argument("--buildings", type=int, default=buildings, help=f"their number (default: {buildings})")
    parser.add_argument("--density", type=float, default=1.5, help="points per m2 (default: 1.5)")
    parser.add_argument("--relief", type=float, default=20.0, help="height of the hills in m (default: 20)")
    parser.add_argument("--seed", type=int, default=1, help="same seed, same bytes (default: 1)")


def _add_fetch(fetch: argparse.ArgumentParser) -> None:
    fetch.add_argument("source", metavar="s3://BUCKET/NAME", help="what --out of the run was")
    fetch.add_argument("directory", type=Path, help="folder to write")


def _add_export(export: argparse.ArgumentParser) -> None:
    """Add the options of all formats, and the table of these below them."""
    export.add_argument("directory", type=_on_disk, help="folder of a run")
    export.add_argument("--format", choices=tuple(FORMATS), metavar="NAME", required=True, help="see below")
    export.add_argument("-o", "--output", type=Path, required=True, help="file or folder to write")
    export.add_argument("--overwrite", action="store_true", help="replace it if it exists")
    given: dict[str, dict[str, Any]] = {
        "parts": {"type": int, "metavar": "N", "help": "decomposed for N processes instead of whole"},
        "case": {"choices": ("wind",), "help": "add the files of a simulation"},
        "buildings": {
            "choices": ("patches", "zones"),
            "help": "one patch a building instead of walls and roofs; zones: one face zone beside them (openfoam)",
        },
        "scalars": {"action": "store_true", "help": "add arrays to colour by: tile, and radius ratio of cells"},
    }
    for option, words in given.items():
        takers = ", ".join(name for name, kind in FORMATS.items() if option in kind.options)
        words |= {"default": argparse.SUPPRESS, "help": f"{takers}: {words['help']}"}
        export.add_argument(f"--{option}", **words)
    width = max(map(len, FORMATS))
    rows = [f"  {name:<{width}}  {kind.description}" for name, kind in FORMATS.items()]
    export.formatter_class = argparse.RawDescriptionHelpFormatter
    export.epilog = "\n".join(["formats:", *rows, "", EXIT_CODES])


def _run(options: argparse.Namespace) -> int:
    config = make_config(with_file(vars(options)))
    if options.only is None:
        dashboard = None if options.no_dashboard else options.dashboard_address
        words = {"quiet": options.quiet, "verbose": options.verbose, "log": options.log_json}
        return _run_config(config, dashboard=dashboard, report=options.report, **words)
    if options.log_json is not None:
        raise ConfigError("--log-json tells of a whole run; leave out it or --only")
    from tiler.alone import run_alone

    print(run_alone(config, options.only, say=None if options.quiet else say))
    return 0


def _run_config(
    config: Config,
    *,
    quiet: bool = False,
    verbose: bool = False,
    log: Path | None = None,
    dashboard: str | None = None,
    report: bool = False,
) -> int:
    if config.workers and not config.on_cluster:
        fork_server.begin()
    from tiler.events import EventLog, open_log
    from tiler.out_folder import refuse_result
    from tiler.run import run
    from tiler.terminal import make_views, print_last_line, print_summary

    gc.freeze()  # what was imported stays
    if report:
        refuse_bucket(config.out, "--report")
    out = place(config.out)
    watchers = make_views(quiet=quiet, verbose=verbose)
    if log is not None:
        refuse_result(out, log)
        watchers.append(EventLog(log, open_log(log), every=0.0))
    record = run(config, watchers=watchers, dashboard=dashboard)
    if report:
        _report_run(out, quiet=quiet)
    if quiet:
        print_last_line(record, out)
    else:
        print_summary(record, out)
    code: int = record["exit_code"]
    return code


def _join(options: argparse.Namespace) -> int:
    config = make_config(with_file(vars(options)))
    fork_server.begin()
    from tiler.joining.join import join
    from tiler.terminal import make_views, print_last_line, print_summary

    joined = join(
        config,
        member=options.member,
        max_idle=options.max_idle,
        views=lambda: make_views(quiet=options.quiet, verbose=options.verbose),
        say=None if options.quiet else say,
    )
    if joined.error:
        print(f"citystitch: {printable(joined.error)}", file=sys.stderr)
    elif joined.record is not None:
        show = print_last_line if options.quiet else print_summary
        show(joined.record, Path(config.out))
    elif not options.quiet:
        say(f"{config.out}: the run is done")
    return joined.exit_code


def _plan(options: argparse.Namespace) -> int:
    from tiler.plan_report import plan_run

    config = make_config(with_file(vars(options)))
    plan_run(config, json_file=options.json_file, picture=options.picture)
    return 0


def _check(options: argparse.Namespace) -> int:
    if options.store:
        from tiler.audit import audit_run

        return 0 if audit_run(options.directory, print) else EXIT_FAILED
    refuse_bucket(options.directory, "check without --store")
    return _check_folder(options.directory)


def _check_folder(directory: Path) -> int:
    from tiler.check import check_run
    from tiler.results import StoredTerrain

    report = check_run(directory, StoredTerrain)
    print("\n".join(map(printable, report.lines())))
    return 0 if report.ok else EXIT_FAILED


def _status(options: argparse.Namespace) -> int:
    from rich.console import Console

    from tiler.out_folder import PROGRESS
    from tiler.status import print_status, read_status

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


def _report(options: argparse.Namespace) -> int:
    from tiler.report import write_report

    say(str(write_report(options.directory)))
    return 0


def _report_run(out: Path, *, quiet: bool) -> None:
    """Write the report of a run that has just ended; the mesh is there, whatever becomes of it."""
    from tiler.report import write_report

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
    from tiler.objects.fetch import fetch_run

    return 0 if fetch_run(options.source, options.directory, say) else EXIT_FAILED


def _on_disk(text: str) -> Path:
    """Take the folder of a command that reads files of a disk."""
    try:
        refuse_bucket(text, "this command")
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return Path(text)


def _synth(options: argparse.Namespace) -> int:
    _write_city(options.directory, options)
    return 0


def _write_city(directory: Path, options: argparse.Namespace) -> "SynthFiles":
    from tiler.synth import write_city

    files = write_city(
        directory,
        size=options.size,
        buildings=options.buildings,
        density=options.density,
        relief=options.relief,
        seed=options.seed,
    )
    clouds, shapefile = files.clouds[0].parent, files.shapefile
    say(f"{len(files.clouds)} LAZ files in {clouds}, footprints in {shapefile} and {files.footprints.name}")
    return files


def _demo(options: argparse.Namespace) -> int:
    out: Path = options.out
    files = _write_city(out / "city", options)
    clouds, footprints = [str(path) for path in files.clouds], str(files.shapefile)
    tile_size = max(options.size / DEMO_TILES, LEAST_DEMO_TILE)
    city = {"pointcloud": clouds, "footprints": footprints, "tile_size": tile_size, "workers": 2}
    block = {
        "pointcloud": [str(BLOCK / "cloud.laz")],
        "footprints": str(BLOCK / "footprints.geojson"),
        "border": "clip",
        "mesh_size": 5.0,
    }
    pictures = {out / "demo.png": "overview", out / "tiles.png": "tiles"}
    codes = [
        _demonstrate("a synthetic city, tile by tile", city, out / "result", pictures),
        _demonstrate("a block of Amsterdam", block, out / "block", {out / "block.png": "boundary"}),
    ]
    return max(codes)


def _demonstrate(title: str, inputs: dict[str, Any], out: Path, pictures: dict[Path, str]) -> int:
    """Mesh, check and draw; returns the exit code of the check."""
    from tiler.render import render_run

    print(f"\n{title}")
    _run_config(make_config(inputs | {"out": str(out), "overwrite": True}), report=True)
    code = _check_folder(out)
    for picture, what in pictures.items():
        render_run(out, picture, what=what)
        say(f"picture: {picture}")
    say(f"mesh:    {out / 'mesh.pvtu'} (open it in ParaView)")
    return code


def _render(options: argparse.Namespace) -> int:
    from tiler.render import render_run

    render_run(options.directory, options.output, what=options.what, say=say)
    say(str(options.output))
    return 0


def _export(options: argparse.Namespace) -> int:
    from tiler.export import export_run

    given = {name: value for name, value in vars(options).items() if name in EXPORT_OPTIONS}
    export_run(options.directory, options.output, name=options.format, overwrite=options.overwrite, options=given)
    say(str(options.output))
    return 0


def _config(_: argparse.Namespace) -> int:
    print(annotated_defaults())
    return 0


if __name__ == "__main__":
    sys.exit(main())
