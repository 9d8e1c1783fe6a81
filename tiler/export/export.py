"""Files for other programs, made from a finished run: `citystitch export` (step 3.6).

A format is a module of `tiler.formats` by its name, with a `Format` called ``FORMAT``. Its writer gets the run's
pieces and a path, and makes the file appear whole or not at all; what it may read, and whether it may replace a
file, is seen to here.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from pipeline.data.errors import ConfigError
from tiler import formats
from tiler.mesh_files.run_files import (
    BOUNDARY_INDEX,
    RUN_RECORD,
    VOLUME_INDEX,
    RunFiles,
    crs_of,
    find_files,
    take_largest_part,
    take_origin,
)
from tiler.mesh_files.threads import check_workers

EXPORT_RECORD = "export.json"  # in every folder that was exported: only such a one is ever replaced
LARGEST_PART = "largest_part"  # taken by every format of the mesh, not by those of the city model
CELLS = ("cells", "prism_layers")  # what cells are: tetrahedra, prisms, or both
ORIGIN = "origin"  # taken by all of these but glb, which has its own
WORKERS = "workers"  # taken where they save time: docs/formats.md
PER_BUILDING = ("buildings", LARGEST_PART, ORIGIN)


@dataclass(frozen=True)
class Format:
    """A kind of file to export."""

    description: str  #: what it holds, in a few words
    #: given a path and the files of a run, and the options as keywords, writes that file or folder. It may return
    #: what must be known of it, a list of str
    write: Callable[..., list[str] | None]
    options: tuple[str, ...] = ()  #: options of the command line that it takes, without dashes
    buildings: tuple[str, ...] = ("patches",)  #: what the option ``buildings`` may be, where it is taken
    folder: bool = False  #: whether it is a folder
    suffix: str = ""  #: what the name of the file must end with, if anything
    companion: str = ""  #: suffix of a second file beside it, if there is one


def list_formats() -> tuple[str, ...]:
    """List the names of all formats, without importing any."""
    return tuple(sorted(module.name for module in iter_modules(formats.__path__)))


def load_format(name: str) -> Format:
    """Import a format; ValueError if there is none of this name."""
    if name not in list_formats():
        raise ValueError(f"format {name!r} must be one of {', '.join(list_formats())}")
    found: Format = import_module(f"{formats.__name__}.{name}").FORMAT
    return found


NO_OPTIONS: Mapping[str, Any] = {}


def export_run(
    directory: Path, output: Path, *, name: str, overwrite: bool = False, options: Mapping[str, Any] = NO_OPTIONS
) -> list[str]:
    """Write a run's mesh for other programs.

    Parameters
    ----------
    directory : Path
        Folder of a finished run.
    output : Path
        The file or folder; it appears whole or not at all.
    name : str
        Format, one of `list_formats`.
    overwrite : bool
        Whether a file of that name may be replaced, or a folder that was exported; one of the run's own never is.
    options : mapping of str to value
        What the format takes; see docs/formats.md.

    Returns
    -------
    list of str
        What must be known of the file, a line each: most have nothing.

    Raises
    ------
    ValueError
        If there is no such format.
    ConfigError
        If the file exists and may not be replaced, or is one of the run's own; if an option is not one of the
        format's, or out of range.
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.
    OutputError
        If the file cannot be written.
    """
    from tiler.store.kept import IN_PIECES, need  # with numpy, which the parser does without

    kind = load_format(name)
    for option in options:
        if option not in kind.options:
            taken = ", ".join(f"--{known.replace('_', '-')}" for known in kind.options) or "none"
            raise ConfigError(
                f"--{option.replace('_', '-')}: format {name} does not take it; its options: {taken}"
            )
    check_workers(options.get(WORKERS, 0))
    asked = options.get("buildings", kind.buildings[0])
    if asked not in kind.buildings:
        raise ConfigError(f"--buildings {asked}: format {name} takes {' or '.join(kind.buildings)}")
    if not output.name.endswith(kind.suffix):
        raise ConfigError(f"{output}: a file of format {name} ends with {kind.suffix}; give another --output")
    given = dict(options)
    need(directory, IN_PIECES)
    files = find_files(directory)
    for target in (output, output.with_suffix(kind.companion)) if kind.companion else (output,):
        _check_target(target, files, overwrite=overwrite)
    if kind.folder and output.exists() and not (output / EXPORT_RECORD).is_file():
        raise ConfigError(f"{output}: holds no {EXPORT_RECORD}, so it was not exported; give another --output")
    if given.pop(LARGEST_PART, False):
        files = take_largest_part(files)
    said = []
    if (origin := given.pop(ORIGIN, None)) is not None:
        files = take_origin(files, origin)
        said.append(f"coordinates count from {files.origin_words or '0 0 0'} m, in {crs_of(files)}")
    return said + (kind.write(output, files, **given) or [])


def _check_target(output: Path, files: RunFiles, *, overwrite: bool) -> None:
    own = {RUN_RECORD, VOLUME_INDEX, BOUNDARY_INDEX}
    mine = {path.resolve() for path in (*files.volumes, *files.boundaries, *(files.directory / n for n in own))}
    if output.resolve() in mine:
        raise ConfigError(f"{output}: is a file of the run itself; give another --output")
    if output.exists() and not overwrite:
        raise ConfigError(f"{output}: exists; give another --output, or --overwrite")
