"""The options of every command."""

import argparse
import dataclasses
import importlib.metadata
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, get_args, get_origin, get_type_hints

from pipeline.data.errors import ConfigError
from tiler.config.config import ANYWHERE, Config
from tiler.config.config_file import POSITIONAL
from tiler.config.domain_height import Height
from tiler.convert import NAMES
from tiler.detail import RULES
from tiler.export.export import list_formats, load_format
from tiler.generalisation import HEIGHTS as BLOCK_KEEPS
from tiler.jobs.submission import add_job_commands
from tiler.objects.places import place, refuse_bucket
from tiler.words.plain_text import suggest

Handler = Callable[[argparse.Namespace], int]
Group = Any  # of options, as `ArgumentParser.add_argument_group` makes it
EXIT_CODES = (
    "Exit codes: 0 done, 1 failed, 2 wrong usage or configuration, 3 done but for parts listed in run.json, "
    "130 stopped."
)
METAVARS = {str: "NAME", float: "NUMBER", int: "NUMBER"}
# What a value is, where its type does not tell.
KINDS = {
    **dict.fromkeys(("footprints", "refine_areas", "land_cover_table", "trees", "cluster"), "FILE"),
    **dict.fromkeys(("tls_ca", "tls_cert", "tls_key"), "FILE"),
    **{"out": "DIR", "crs": "EPSG", "layer": "LAYER", "scheduler": "ADDRESS"},
    **{"generalised": "FILE", "focus": "X,Y,RADIUS"},
    **dict.fromkeys(("id_attribute", "height_attribute", "roof_attribute"), "ATTRIBUTE"),
    **dict.fromkeys(("refine_attribute", "land_cover_field"), "ATTRIBUTE"),
}
# Options that are given once for each value.
APPENDED = {"refine": "PLACE,SIZE", "lod_zones": "FILE|PLACE,LEVEL,SIZE"}
WRONG_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)")
LODS = next(entry.metadata["choices"] for entry in dataclasses.fields(Config) if entry.name == "lod")
SYNTH_BUILDINGS = 500  # of a city of boxes
# What `pipeline.architecture` and `tiler.towns` have, without their numpy; a test holds these against theirs.
TOWN_STYLES = ("boxes", "detached", "grid", "terraces", "blocks", "apartments", "towers", "wings", "mixed")
TOWN_WALLS, BLOCK_HEIGHTS = ("walls", "eaves"), ("eaves", "third", "half", "two-thirds", "ridge")
# What `tiler.generalisation` has, without its imports; a test holds these against the defaults there.
GENERALISE_NUMBERS = (
    ("least_share", 0.3, "SHARE", "Th1: share of a cell that buildings cover, from which they become a block"),
    ("most_area", 20_000.0, "M2", "Th2: cells up to this are aggregated for LoD0A"),
    ("fragment", 400.0, "M2", "smaller cells are joined to a neighbour"),
    ("street_width", 6.0, "M", "width of streets along cells; half of it is cut from a block"),
    ("yard_width", 0.0, "M", "a block fills open space between buildings up to this width; 0: all of the cell"),
    ("block_gap", 6.0, "M", "without roads: closer buildings belong to one block"),
    ("adjacent", 0.1, "M", "buildings up to this apart are adjacent"),
    ("default_height", 6.0, "M", "height of buildings without a known height"),
    ("tile_size", 1000.0, "M", "side of the tiles, which are processed one by one"),
)
EXPORT_OPTION = "option of a format: "  # begins the names of these among what was parsed
# What a first run needs stands first in the help of a run, what is for studies of the method last.
ESSENTIAL = (
    *("footprints", "buildings", "terrain", "out", "crs", "bounds", "mesh_size", "domain_height", "border"),
    *("tile_size", "workers", "overwrite"),
)
RESEARCH = (
    *("vertex_tolerance", "ground_margin", "ground_percentile", "roof_height", "roof_percentile"),
    *("roof_clearance", "simplify", "clearance_floor", "roof_group", "min_angle", "mesher", "least_spacing"),
    *("most_spacing", "stagger", "improve_passes", "layer_height", "smoother", "smoothing_tolerance"),
    "fem_tolerance",
)
TITLES = {
    "essentials": "essentials",
    "input": "input, in more detail",
    "terrain": "terrain",
    "buildings": "buildings",
    "simplify": "city model",
    "mesh": "mesh: layers, grading, pad, soil",
    "run": "execution",
    "watch": "display and reports",
    "research": "research: alternative methods and their tolerances",
}


class Parser(argparse.ArgumentParser):
    """A parser whose errors offer what was meant."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2, the error, and what was meant."""
        if found := WRONG_CHOICE.search(message):
            known = [name.strip("'") for name in found[2].split(", ")]
            message += suggest(found[1], known)
        self.print_usage(sys.stderr)
        self.exit(2, f"{self.prog}: error: {message}\n")

    def refuse_unknown(self, words: Sequence[str]) -> NoReturn:
        """End with exit code 2 because of words that are no options of this parser."""
        known = re.findall(r"--[a-z][a-z-]*", self.format_help())
        for word in words:
            name = word.partition("=")[0]
            if name.startswith("-"):
                self.error(f"unknown option {name}{suggest(name, known)}")
        self.error(f"unrecognized arguments: {' '.join(words)}")


ON_GLOBE: dict[str, dict[str, Any]] = {  # where 3D Tiles lie
    "geoid_height": {
        "type": float,
        "metavar": "M",
        "help": "height of the geoid above the ellipsoid, added to all heights (default: 0)",
    },
    "vertical_crs": {
        "metavar": "EPSG",
        "help": "CRS of the heights, such as EPSG:5709; PROJ adds the height of the geoid at each place",
    },
}


def build_parser(handlers: Mapping[str, Handler]) -> argparse.ArgumentParser:
    """Make the parser of all commands; the parameters of a run come from `Config`.

    Parameters
    ----------
    handlers : mapping
        What does each command, by its name.
    """
    common = Parser(add_help=False)
    common.add_argument("--traceback", action="store_true", help="show the traceback of an error")
    parser = Parser(
        prog="citystitch",
        description="LiDAR point clouds and building footprints in, one conforming tetrahedral city mesh out.",
        epilog=EXIT_CODES,
    )
    parser.add_argument("--version", action=_Version, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(name: str, handler: Handler, text: str) -> argparse.ArgumentParser:
        sub: argparse.ArgumentParser = commands.add_parser(
            name, help=text, description=text, epilog=EXIT_CODES, parents=[common], conflict_handler="resolve"
        )
        sub.set_defaults(handler=handler, parser=sub)
        return sub

    def command(name: str, text: str) -> argparse.ArgumentParser:
        return add(name, handlers[name], text)

    _add_run(command("run", "mesh a region from point clouds and footprints"))
    plan = command("plan", "forecast size, tasks, memory and time of a run, without running it")
    plan.add_argument("--json", type=Path, dest="json_file", metavar="FILE", help="also write the plan as JSON")
    plan.add_argument("--picture", type=Path, metavar="FILE.svg", help="draw tiles, files and footprints")
    _add_inputs(plan)
    _add_check(command("check", "verify a mesh from the written files"))
    status = command("status", "show the progress of a run, whether it is alive, and how to resume it")
    status.add_argument("job", metavar="DIR|JOB", help="folder of a run, or number of its job")
    status.add_argument("--json", action="store_true", dest="as_json", help="print the status as JSON")
    board = command("dashboard", "show the page of a running, ended or dead run, from its folder")
    board.add_argument("directory", type=_on_disk, metavar="DIR", help="folder of a run")
    view = command("view", "show a finished run, or exported 3D Tiles, in a browser")
    view.add_argument("directory", type=_on_disk, metavar="DIR", help="folder of the run, or of the tiles")
    serve = command("serve", "show a finished run in a browser, and take edits over HTTP")
    _add_serve(serve)
    _add_address(board, view, serve)
    _add_report(command("report", "write report.html: output and quality of a run, and what was left out"))
    _add_fetch(command("fetch", "fetch the folder of a run from a bucket, and verify its checksums"))
    synth = command(
        "synth", "write a synthetic city: point cloud and footprints, or a town of houses with architecture"
    )
    synth.add_argument("directory", type=Path, metavar="DIR", help="folder to write to")
    _add_city(synth, size=1000.0, buildings=SYNTH_BUILDINGS)
    _add_workers(synth, "make tiles")
    _add_town(synth)
    _add_demo(command("demo", "mesh, check and draw a synthetic city in tiles and a block of a real one"))
    _add_render(command("render", "draw a picture of a run"))
    add_job_commands(add, _add_inputs)
    _add_edit(
        command("edit", "replace, remove or add buildings in a finished run, and mesh the affected tiles again")
    )
    _add_export(command("export", "write the mesh of a run for other programs, each vertex once"))
    _add_convert(command("convert", "write city models, or that of a run, as another format of city models"))
    _add_detail(command("detail", "write city models with windows, doors and balconies by rules, at LoD3"))
    _add_facade_rules(
        command("facade-rules", "find storeys, bays and windows in an image of a façade, as rules for detail")
    )
    _add_texture(command("texture", "put oriented images on walls and roofs of city models, a GLB a tile"))
    _add_vegetation(command("vegetation", "train a classifier of plants in images, for texture"))
    _add_generalise(
        command("generalise", "make blocks of buildings between streets: cells and LoD0C, LoD0B, LoD0A")
    )
    _add_wind(command("wind", "map mean wind and comfort from results of a wind case and a wind rose"))
    command("kernels", "compile all kernels for this machine, before the first run")
    command("config", "print all parameters of a run, annotated, as a configuration file")
    return parser


def _add_run(run: argparse.ArgumentParser) -> None:
    """Add the inputs and parameters of a run, and what it shows and writes."""
    shown = _add_inputs(run)
    shown.add_argument(
        "--dashboard-address",
        default=ANYWHERE,
        metavar="HOST:PORT",
        help="address of the page of the run (default: a free port of 127.0.0.1)",
    )
    shown.add_argument("--no-dashboard", action="store_true", help="show no page of the run")
    _add_choice(shown)
    words = shown.add_mutually_exclusive_group()
    words.add_argument("-q", "--quiet", action="store_true", help="print errors and the last line only")
    words.add_argument("-v", "--verbose", action="store_true", help="also print a line for each item")
    shown.add_argument("--log-json", type=Path, metavar="FILE", help="write events, one JSON object a line")
    shown.add_argument(
        "--report",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="write report.html at the end, as `citystitch report` does",
    )


def _add_render(render: argparse.ArgumentParser) -> None:
    """Add which picture of a run is drawn."""
    render.add_argument("directory", type=_on_disk, metavar="DIR", help="folder of a run")
    render.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="PNG file to write")
    render.add_argument(
        "--what",
        choices=("boundary", "mesh", "overview", "tiles", "sizes", "quality", "citymodel", "levels"),
        default="boundary",
        help="what to draw; sizes: triangles from above, by the length of their edges; quality: the boundary by "
        "the cells behind it; citymodel: its solids on the terrain; levels: the boundary by level of detail",
    )


def _add_demo(demo: argparse.ArgumentParser) -> None:
    """Add where the demonstration writes, and its city."""
    demo.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="folder to write to (default: demo)"
    )
    _add_city(demo, size=600.0, buildings=220, roofs="mixed")


def _add_inputs(parser: argparse.ArgumentParser) -> Group:
    """Add point clouds, and the parameters of a run; gives the group of further options."""
    parser.usage = f"{parser.prog} POINTCLOUD... [--footprints FILE] [--out DIR] [--option VALUE ...]"
    parser.add_argument(
        POSITIONAL, nargs="*", metavar="POINTCLOUD", help="files, globs or folders; or one config.toml"
    )
    return _add_parameters(parser)


def _add_parameters(parser: argparse.ArgumentParser) -> Group:
    """Add an option for every parameter of a run; what is not given is left to the file or default.

    Gives the group of further options: on what a command shows and writes.
    """
    hints = get_type_hints(Config)
    entries = [entry for entry in dataclasses.fields(Config) if entry.name != POSITIONAL]
    entries.sort(key=lambda entry: (list(TITLES).index(_group_of(entry)), _rank(entry)))
    groups = {key: parser.add_argument_group(title) for key, title in TITLES.items()}
    for entry in entries:
        data, wanted = entry.metadata, hints[entry.name]
        group = groups[_group_of(entry)]
        words: dict[str, Any] = {"dest": entry.name, "default": argparse.SUPPRESS, "help": _help(entry)}
        if wanted is bool:
            words["action"] = argparse.BooleanOptionalAction
        elif get_origin(wanted) is tuple and get_args(wanted)[0] == Height:
            words |= {"type": str, "nargs": "+", "metavar": "M|nH"}
        elif get_origin(wanted) is tuple and get_args(wanted)[0] is int:
            words |= {"type": str, "metavar": "N,N"}
        elif entry.name in APPENDED:
            words |= {"type": str, "action": "append", "metavar": APPENDED[entry.name]}
        elif get_origin(wanted) is tuple and get_args(wanted)[0] is str:
            words |= {"type": str, "nargs": "+", "metavar": "FILE"}
        elif get_origin(wanted) is tuple:
            words |= {"type": get_args(wanted)[0], "nargs": 4, "metavar": ("XMIN", "YMIN", "XMAX", "YMAX")}
        elif wanted == Height:
            words |= {"type": str, "metavar": "M|auto" if entry.name == "shift_z" else "M|nH"}
        else:
            unit = KINDS.get(entry.name, "" if wanted is str else data["unit"].upper())
            words |= {"type": wanted, "metavar": unit or METAVARS[wanted]}
            if data["choices"]:
                words |= {"choices": data["choices"], "metavar": None}
        group.add_argument(f"--{entry.name.replace('_', '-')}", **words)
    return groups["watch"]


def _group_of(entry: "dataclasses.Field[Any]") -> str:
    """Group of a parameter in the help: essentials, its section, or research."""
    if entry.name in ESSENTIAL:
        return "essentials"
    return "research" if entry.name in RESEARCH else str(entry.metadata["section"])


def _rank(entry: "dataclasses.Field[Any]") -> int:
    return ESSENTIAL.index(entry.name) if entry.name in ESSENTIAL else 0


class _Version(argparse.Action):
    """Prints the version: read only when it is asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print it and end."""
        try:
            version = importlib.metadata.version("citystitch")
        except importlib.metadata.PackageNotFoundError:
            version = "of a source tree that is not installed"
        print(f"citystitch {version}")
        parser.exit()


def _help(entry: "dataclasses.Field[Any]") -> str:
    data = entry.metadata
    shown = isinstance(entry.default, (int, float)) and not isinstance(entry.default, bool)
    default = f"default: {entry.default:g}" if shown else f"default: {entry.default}" if entry.default else ""
    facts = ", ".join(fact for fact in (default, data["unit"], data["source"]) if fact)
    return f"{data['text']} ({facts})".replace("%", "%%") if facts else data["text"]


def _add_city(parser: argparse.ArgumentParser, *, size: float, buildings: int, roofs: str = "flat") -> None:
    parser.add_argument("--size", type=float, default=size, help=f"side of the city in m (default: {size:g})")
    parser.add_argument(
        "--buildings", type=int, default=buildings, help=f"number of buildings (default: {buildings})"
    )
    parser.add_argument("--density", type=float, default=1.5, help="points per m2 (default: 1.5)")
    parser.add_argument("--relief", type=float, default=20.0, help="height of the hills in m (default: 20)")
    parser.add_argument("--seed", type=int, default=1, help="same seed, same bytes (default: 1)")
    parser.add_argument(
        "--roofs",
        choices=("flat", "mixed"),
        default=roofs,
        help=f"roofs of the city; mixed: flat, shed, gable, hip, pyramid and mansard ones (default: {roofs})",
    )


def _add_choice(shown: Group) -> None:
    """Add which part of the region, or which levels, a run makes."""
    shown.add_argument("--only", metavar="TILE", help="mesh one tile alone, in this process, to examine a failure")
    shown.add_argument(
        "--lods",
        metavar="LOD,...",
        help="make a mesh of each of these levels of --buildings, as of --lod, in OUT/lod1.2 and so on",
    )


def _add_town(synth: argparse.ArgumentParser) -> None:
    """Add what towns of houses with architecture have besides."""
    town = synth.add_argument_group("towns of houses drawn by rules, with their city model")
    town.add_argument(
        "--style",
        choices=TOWN_STYLES,
        default="boxes",
        help="boxes: blocks, or roofs as of --roofs; others: houses with architecture (default: boxes)",
    )
    town.add_argument(
        "--rules", type=Path, metavar="FILE", help="TOML or JSON file with rules that replace those of the style"
    )
    town.add_argument(
        "--levels",
        default="1.2,2.2",
        metavar="LOD,...",
        help="levels of detail of the city model: 0.0 to 3.3 (default: 1.2,2.2)",
    )
    town.add_argument("--walls", choices=TOWN_WALLS, default="walls", help="place of walls (default: walls)")
    town.add_argument(
        "--block-height",
        choices=BLOCK_HEIGHTS,
        default="half",
        help="height of the blocks of level 1, as a share of the roof (default: half)",
    )
    town.add_argument(
        "--lidar",
        type=float,
        default=0.0,
        metavar="N",
        help="scan in strips, with N pulses per m2 of a strip, instead of --density; also writes truth.jsonl",
    )
    town.add_argument(
        "--class-errors",
        type=float,
        metavar="SHARE",
        help="share of the points of --lidar with a wrong class (default: 0.01)",
    )
    town.add_argument(
        "--trees",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="share of the corners of lots with a tree (default: 0)",
    )
    town.add_argument(
        "--water",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="share of the relief that lakes fill (default: 0)",
    )
    town.add_argument(
        "--variants",
        default="",
        metavar="NAME,...",
        help="write each of these representations to a file in variants/; all: all 392",
    )
    town.add_argument(
        "--degrade",
        type=float,
        default=0.0,
        metavar="SIGMA",
        help="also write twins with the same ids, with normal noise of SIGMA m on their parameters",
    )
    town.add_argument(
        "--broken",
        action="store_true",
        help="also write broken.city.jsonl: each fault of a solid once, by name",
    )
    town.add_argument(
        "--parameters",
        type=Path,
        metavar="FILE",
        help="make models of these parameters: parameters.jsonl or .xml, also edited",
    )
    town.add_argument(
        "--footprints",
        type=Path,
        metavar="FILE",
        help="make houses on these footprints; rules of the style replace missing attributes",
    )
    town.add_argument(
        "--surfaces", action="store_true", help="surfaces with chimneys and overhangs, instead of solids without"
    )


def _add_report(report: argparse.ArgumentParser) -> None:
    report.add_argument("directory", type=_on_disk, metavar="DIR", help="folder of a run")
    words = "truth.jsonl of the meshed synthetic town, to compare its roofs"
    report.add_argument("--truth", type=Path, metavar="FILE", help=words)


def _add_fetch(fetch: argparse.ArgumentParser) -> None:
    fetch.add_argument("source", metavar="s3://BUCKET/NAME", help="value of --out of the run")
    fetch.add_argument("directory", type=Path, metavar="DIR", help="folder to write")


def _add_workers(parser: Any, what: str) -> None:
    parser.add_argument(
        "--workers", type=int, default=0, metavar="N", help=f"processes that {what} (default: 0, this one)"
    )


def _add_check(check: argparse.ArgumentParser) -> None:
    check.add_argument(
        "directory", type=place, metavar="DIR|FILE.gpkg", help="folder of a run, or an output of generalise"
    )
    what = check.add_mutually_exclusive_group()
    what.add_argument("--store", action="store_true", help="instead verify the checksum of every file of the run")
    what.add_argument(
        "--cfd",
        action="store_true",
        help="instead compare domain and cells with the guidelines for wind simulations of COST 732 and AIJ",
    )
    what.add_argument(
        "--export",
        type=Path,
        metavar="PATH",
        help="instead prove an exported mesh of any cells against the run: a file .vtu or .msh, or a case folder "
        "of OpenFOAM",
    )
    _add_workers(check, "check pieces")
    check.add_argument(
        "--direction",
        type=float,
        action="append",
        metavar="DEGREES",
        help="with --cfd: direction from which the wind comes, degrees clockwise from north (default: 270); "
        "repeatable",
    )


def _add_wind(wind: argparse.ArgumentParser) -> None:
    wind.add_argument("directory", type=_on_disk, metavar="DIR", help="an exported wind case that has run")
    wind.add_argument(
        "--profile",
        type=Path,
        metavar="FILE.csv",
        help="instead write the profile at the outlet of bare ground, for --wind-table of another export",
    )
    wind.add_argument(
        "--rose",
        type=Path,
        metavar="FILE.csv",
        help="wind rose: columns direction, share, scale, shape (Weibull), or direction, speed, share",
    )
    wind.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder to write")
    wind.add_argument("--overwrite", action="store_true", help="replace it if it exists")
    wind.add_argument(
        "--rose-height",
        type=float,
        metavar="M",
        help="height at which the rose's speeds are (default: that of --wind-height)",
    )
    wind.add_argument(
        "--resolution", type=float, default=1.0, metavar="M", help="size of a pixel in m (default: 1)"
    )


class _ExportHelp(argparse.Action):
    """Print help with the table of formats, which is made of their modules."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        names = list_formats()
        width = max(map(len, names))
        rows = []
        for name in names:
            kind = load_format(name)
            options = ", ".join(f"--{option.replace('_', '-')}" for option in kind.options)
            rows.append(f"  {name:<{width}}  {kind.description}" + (f" ({options})" if options else ""))
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
        parser.epilog = "\n".join(["formats:", *rows, "", EXIT_CODES])
        parser.print_help()
        parser.exit()


def _add_address(*servers: argparse.ArgumentParser) -> None:
    for server in servers:
        server.add_argument(
            "--port", type=int, default=0, metavar="N", help="port to listen at; 0: a free one (default)"
        )
        server.add_argument(
            "--host", default="127.0.0.1", help="address to listen at (default: 127.0.0.1, this machine alone)"
        )


def _add_serve(serve: argparse.ArgumentParser) -> None:
    """Add what the service of a run folder needs."""
    serve.add_argument("directory", type=_on_disk, metavar="DIR", help="folder of a finished run")
    serve.add_argument(
        "--token-file", type=Path, metavar="FILE", help="token of clients; needed where other machines ask"
    )
    serve.add_argument("--workers", type=int, default=0, metavar="N", help="worker processes (default: this one)")
    for option, words in ON_GLOBE.items():
        serve.add_argument(f"--{option.replace('_', '-')}", default=0.0 if "type" in words else "", **words)


def _add_edit(edit: argparse.ArgumentParser) -> None:
    """Add what is done with a city and its journal."""
    edit.add_argument("directory", type=_on_disk, metavar="DIR", help="folder of a finished run")
    what = edit.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--replace",
        nargs=2,
        metavar=("ID", "FILE"),
        help="replace a building by the footprint of a vector file, or the building of a CityJSON or GLB file",
    )
    what.add_argument("--remove", metavar="ID", help="remove a building")
    what.add_argument("--add", type=Path, metavar="FILE", help="add what such a file has")
    what.add_argument("--list", action="store_true", dest="as_list", help="print the edits so far")
    what.add_argument("--at", metavar="DATE", help="make the city of a day, YYYY-MM-DD, in --out")
    edit.add_argument(
        "--position",
        type=_position,
        metavar="X,Y,Z",
        help="easting, northing and height (m) of the origin of a GLB file (default: what the file says)",
    )
    edit.add_argument("--out", type=_on_disk, metavar="DIR", help="folder for the city of a day")
    edit.add_argument("--date", default="", help="day from which the edit applies, YYYY-MM-DD (default: today)")
    edit.add_argument(
        "--base", type=int, metavar="N", help="refuse the edit if an edit after number N changed the same building"
    )
    _add_workers(edit, "mesh")


def _add_export(export: argparse.ArgumentParser) -> None:
    """Add the options of all formats; each format names those that it takes."""
    export.add_argument("-h", "--help", nargs=0, action=_ExportHelp, help="show this help message and exit")
    export.add_argument("directory", type=_on_disk, metavar="DIR", help="folder of a run")
    export.add_argument("--format", choices=list_formats(), metavar="NAME", required=True, help="see below")
    export.add_argument("-o", "--output", type=Path, required=True, help="file or folder to write")
    export.add_argument("--overwrite", action="store_true", help="replace it if it exists")
    given: dict[str, dict[str, Any]] = {
        "parts": {"type": int, "metavar": "N", "help": "decompose the mesh for N processes"},
        "cells": {
            "choices": ("prism", "hybrid"),
            "help": "prisms of a layered mesh instead of tetrahedra, a third as many; hybrid: prisms near ground "
            "and roofs of any mesh",
        },
        "prism_layers": {
            "type": int,
            "metavar": "N",
            "help": "of a hybrid mesh, how many prisms stand on the ground and on roofs (default: 10)",
        },
        "case": {"choices": ("wind",), "help": "add the files of a simulation"},
        "direction": {
            "type": float,
            "action": "append",
            "metavar": "DEGREES",
            "help": "direction from which the wind comes, degrees clockwise from north (default: 270); "
            "repeatable, a case each",
        },
        "wind_speed": {"type": float, "metavar": "M/S", "help": "speed of the undisturbed wind (default: 5)"},
        "wind_height": {
            "type": float,
            "metavar": "M",
            "help": "height of that speed above the inlet's lowest ground (default: 10)",
        },
        "wind_table": {
            "metavar": "FILE",
            "help": "CSV file of the profile: height (m), speed (m/s), and optionally k and epsilon",
        },
        "roughness": {
            "type": float,
            "metavar": "M",
            "help": "roughness length z0 upstream and of the ground (default: 0.5)",
        },
        "patch_roughness": {
            "action": "append",
            "metavar": "PATCH=M",
            "help": "roughness length of one patch of ground, walls or roofs; repeatable",
        },
        "buildings": {
            "choices": ("patches", "zones"),
            "help": "one patch a building instead of walls and roofs; zones: one face zone beside them",
        },
        "largest_part": {
            "action": "store_true",
            "help": "of a mesh in parts that share no face, export only the one with the most cells",
        },
        "origin": {
            "metavar": "X,Y,Z|auto",
            "help": "origin of the coordinates in whole metres; auto: the region's south-western corner",
        },
        **ON_GLOBE,
        "slice_height": {
            "type": float,
            "action": "append",
            "metavar": "M",
            "help": "add the cells at this height above the ground; repeatable",
        },
        "slice_line": {
            "action": "append",
            "metavar": "X0,Y0,X1,Y1",
            "help": "add the cells along a vertical plane between two places of the CRS; repeatable",
        },
        "generalised": {
            "metavar": "FILE",
            "help": "blocks of `citystitch generalise`, which stand for houses in the upper levels of 3D Tiles",
        },
        "compression": {"choices": ("draco",), "help": "pack the meshes of 3D Tiles (default: not)"},
        "scalars": {"action": "store_true", "help": "add arrays to colour by: tile, and radius ratio of cells"},
        "workers": {"type": int, "metavar": "N", "help": "threads that write (default: 0, one)"},
    }
    for option, words in given.items():
        export.add_argument(
            f"--{option.replace('_', '-')}", dest=EXPORT_OPTION + option, default=argparse.SUPPRESS, **words
        )


def _add_convert(convert: argparse.ArgumentParser) -> None:
    """Add inputs, output and options of a conversion."""
    _add_models(convert)
    convert.add_argument("--format", choices=NAMES, required=True, help="format to write")
    convert.add_argument(
        "-o",
        "--output",
        type=_on_disk,
        required=True,
        metavar="FILE",
        help="file to write, or folder of tiles",
    )
    convert.add_argument(
        "--lod",
        choices=LODS,
        default="auto",
        help="level of detail in an OBJ or GLB; others have all (default: auto)",
    )
    convert.add_argument(
        "--tile-size",
        type=float,
        default=0.0,
        metavar="METRES",
        help="write a folder with a file for each tile of this size; a building is in the tile of its middle",
    )
    convert.add_argument("--overwrite", action="store_true", help="replace the file or folder if it exists")


def _add_generalise(parser: argparse.ArgumentParser) -> None:
    """Add buildings, barriers, thresholds and output of a generalisation."""
    parser.add_argument(
        "models", nargs="*", type=_on_disk, metavar="MODEL|DIR", help="city models, or the folder of a run"
    )
    parser.add_argument("--footprints", type=_on_disk, metavar="FILE", help="vector file of buildings instead")
    parser.add_argument(
        "-o", "--output", type=_on_disk, metavar="FILE.gpkg",
        help="GeoPackage of all levels; FILE.city.json and FILE.levels.json go beside it",
    )  # fmt: skip
    parser.add_argument("--overwrite", action="store_true", help="replace the files if they exist")
    parser.add_argument("--plan", action="store_true", help="forecast time and memory, and write nothing")
    _add_workers(parser, "work on squares")
    source = parser.add_argument_group("buildings")
    source.add_argument("--layer", default="", help="layer of --footprints (default: the only one)")
    source.add_argument(
        "--id-attribute", default="", metavar="ATTRIBUTE", help="attribute with the id of a footprint"
    )
    source.add_argument(
        "--height-attribute", default="", metavar="ATTRIBUTE", help="attribute with its height (m)"
    )
    source.add_argument("--crs", default="", metavar="EPSG", help="metric CRS (default: that of the buildings)")
    source.add_argument(
        "--bounds", type=float, nargs=4, metavar=("XMIN", "YMIN", "XMAX", "YMAX"), help="bounds of the region (m)"
    )
    lines = parser.add_argument_group("barriers and other objects, vector files")
    for name, text in (
        ("roads", "streets (default: the medial axis of the open space between buildings)"),
        ("railways", "further barriers"),
        ("water", "further barriers; areas are cut out of blocks"),
        ("others", "areas that are no barriers but are cut out of blocks, such as parks"),
    ):
        lines.add_argument(f"--{name}", nargs="+", type=_on_disk, default=(), metavar="FILE", help=text)
    limits = parser.add_argument_group("thresholds (docs/generalisation.md)")
    for name, default, unit, text in GENERALISE_NUMBERS:
        limits.add_argument(
            f"--{name.replace('_', '-')}", type=float, default=default, metavar=unit,
            help=f"{text} (default: {default:g})",
        )  # fmt: skip
    limits.add_argument(
        "--block-height",
        choices=BLOCK_KEEPS,
        default=BLOCK_KEEPS[0],
        help="height of a block: mean of its buildings by area, or the height that keeps their volume (default: "
        "area)",
    )
    marks = parser.add_argument_group("landmarks, which stay unchanged at every level")
    marks.add_argument(
        "--landmark-height", type=float, default=0.0, metavar="M", help="buildings from this height on"
    )
    marks.add_argument(
        "--landmark-volume", type=float, default=0.0, metavar="M3", help="buildings from this volume on"
    )
    marks.add_argument(
        "--landmark-tag", default="", metavar="ATTRIBUTE[=VALUE]", help="buildings with this attribute"
    )
    marks.add_argument(
        "--landmarks", default="", metavar="FILE|ID,...", help="buildings with these ids; a file has one a line"
    )


def _add_models(parser: argparse.ArgumentParser) -> None:
    """Add city models as input, and how their coordinates are read and written."""
    parser.add_argument(
        "inputs", nargs="+", type=_on_disk, metavar="MODEL|DIR",
        help="CityJSON, CityJSONSeq, CityGML or GeoPackage files; or the folder of a run",
    )  # fmt: skip
    parser.add_argument("--crs", default="", metavar="EPSG", help="reproject to this CRS, in plan")
    parser.add_argument(
        "--axis-order",
        choices=("xy", "yx"),
        default="",
        help="order of coordinates, instead of the detected one",
    )


def _add_detail(detail: argparse.ArgumentParser) -> None:
    """Add inputs, output and options of detail by rules."""
    _add_models(detail)
    add = detail.add_argument
    add(
        "-o", "--output", type=_on_disk, required=True, metavar="FILE", help="file .glb, .city.json or .city.jsonl"
    )
    add(
        "--rules", default="residential", metavar="NAME|FILE",
        help=f"{', '.join(RULES)}, or a file of rules, JSON or TOML (default: residential)",
    )  # fmt: skip
    add("--viewpoint", default="", metavar="X,Y,Z", help="viewpoint; without it: full detail")
    add(
        "--distance", default="", metavar="FULL,REDUCED",
        help="distances (m) from the viewpoint up to which assets are full, and from which they are flat "
        "(default: 50,200)",
    )  # fmt: skip
    add(
        "--facing", type=float, default=None, metavar="DEGREES",
        help="angle between façade and viewpoint from which assets are flat; up to half of it they are full",
    )  # fmt: skip
    add(
        "--keep", default="", metavar="LABEL=PERCENT,...",
        help="least share of polygons by semantics: floor, window, door, balcony",
    )  # fmt: skip
    add("--lod", choices=LODS, default="auto", help="level of detail that gets façades (default: auto)")
    add("--json", type=Path, default=None, dest="json_file", metavar="FILE", help="also write the table as JSON")
    add("--overwrite", action="store_true", help="replace the files if they exist")


def _add_facade_rules(rules: argparse.ArgumentParser) -> None:
    """Add image, size and output of rules."""
    add = rules.add_argument
    add("image", type=_on_disk, metavar="IMAGE", help="rectified image of the façade alone")
    add("--size", required=True, metavar="WIDTH,HEIGHT", help="width and height of the façade (m)")
    add("-o", "--output", type=_on_disk, required=True, metavar="FILE", help="JSON file of rules to write")
    add("--overwrite", action="store_true", help="replace the file if it exists")


def _add_vegetation(train: argparse.ArgumentParser) -> None:
    """Add images, labels and output of a training."""
    add = train.add_argument
    add("images", type=_on_disk, metavar="DIR", help="folder of images")
    add(
        "--masks", type=_on_disk, required=True, metavar="DIR",
        help="folder of their labels, NAME.png: not black where there are plants",
    )  # fmt: skip
    add("-o", "--output", type=_on_disk, required=True, metavar="FILE", help="JSON file to write")
    add("--overwrite", action="store_true", help="replace the file if it exists")


def _add_texture(texture: argparse.ArgumentParser) -> None:
    """Add cameras, images, output and options of textures."""
    _add_workers(texture, "texture tiles")
    add = texture.add_argument
    add(
        "inputs", nargs="+", type=_on_disk, metavar="MODEL|DIR",
        help="city model files; or the folder of a run, whose ground hides, too",
    )  # fmt: skip
    add(
        "--cameras", type=_on_disk, required=True, metavar="FILE|DIR",
        help="cameras of COLMAP, Bundler, OpenSfM or OpenDroneMap",
    )  # fmt: skip
    add("--images", type=_on_disk, required=True, metavar="DIR", help="folder of the images")
    add("-o", "--output", type=_on_disk, required=True, metavar="DIR", help="folder to write")
    add(
        "--origin", default="", metavar="X,Y,Z",
        help="place in the CRS of the city that coordinates of the cameras count from (needed unless OpenSfM "
        "states a reference)",
    )  # fmt: skip
    add(
        "--geoid-height", type=float, default=0.0, metavar="M",
        help="height of the geoid above the ellipsoid, taken from heights of an OpenSfM reference (default: 0)",
    )  # fmt: skip
    add("--vegetation", type=_on_disk, default=None, metavar="FILE", help="classifier of plants, which hide")
    add("--texel", type=float, default=0.1, metavar="M", help="side of a texel (default: 0.1)")
    add(
        "--least-resolution", type=float, default=2.0, metavar="NUMBER",
        help="pixels per metre that an image must have of a surface (default: 2)",
    )  # fmt: skip
    add("--tile-size", type=float, default=250.0, metavar="METRES", help="side of a tile (default: 250)")
    add("--overwrite", action="store_true", help="replace the folder if it exists")


def _position(text: str) -> tuple[float, ...]:
    """Take a place in space."""
    found = tuple(map(float, text.split(",")))
    if len(found) != 3:
        raise argparse.ArgumentTypeError(f"{text!r}: three numbers X,Y,Z expected")
    return found


def _on_disk(text: str) -> Path:
    """Take the folder of a command that reads files of a disk."""
    try:
        refuse_bucket(text, "this command")
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return Path(text)
