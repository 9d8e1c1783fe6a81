"""Files for other programs, made from a finished run: `citystitch export` (step 3.6).

Formats are entries of `FORMATS`. A writer gets the run's pieces and a path, and makes the file appear whole or not
at all; what it may read, and whether it may replace a file, is seen to here. The command line shows the table in
its help, so writers import what they need when they are called.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import ConfigError, InputError

RUN_RECORD, VOLUME_INDEX, BOUNDARY_INDEX = "run.json", "mesh.pvtu", "boundary.pvtp"


@dataclass(frozen=True)
class RunFiles:
    """The files of a finished run that a writer may read.

    Attributes
    ----------
    directory : Path
        Folder of the run.
    volumes, boundaries : tuple of Path
        VTU and VTP pieces, in the order of the index files: by name of tile.
    """

    directory: Path
    volumes: tuple[Path, ...]
    boundaries: tuple[Path, ...]


@dataclass(frozen=True)
class Format:
    """A kind of file to export.

    Attributes
    ----------
    description : str
        What it holds, in a few words.
    write : callable
        Given a path and the files of a run, writes that file.
    """

    description: str
    write: Callable[[Path, RunFiles], None]


def _write_vtu(path: Path, files: RunFiles) -> None:
    from tiler.merged import write_merged_volume

    write_merged_volume(path, files.volumes)


def _write_vtp(path: Path, files: RunFiles) -> None:
    from tiler.merged import write_merged_boundary

    write_merged_boundary(path, files.boundaries)


FORMATS: Mapping[str, Format] = {
    "vtu": Format("the volume mesh as one VTK file", _write_vtu),
    "vtp": Format("the marked boundary as one VTK file", _write_vtp),
}


def export_run(directory: Path, output: Path, *, name: str, overwrite: bool = False) -> None:
    """Write a run's mesh as one file.

    Parameters
    ----------
    directory : Path
        Folder of a finished run.
    output : Path
        The file; it appears whole or not at all.
    name : str
        Format, one of `FORMATS`.
    overwrite : bool
        Whether a file of that name may be replaced; one of the run's own never is.

    Raises
    ------
    ValueError
        If there is no such format.
    ConfigError
        If the file exists and may not be replaced, or is one of the run's own.
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.
    OutputError
        If the file cannot be written.
    """
    if name not in FORMATS:
        raise ValueError(f"format {name!r} must be one of {', '.join(FORMATS)}")
    files = find_files(directory)
    _check_target(output, files, overwrite=overwrite)
    FORMATS[name].write(output, files)


def find_files(directory: Path) -> RunFiles:
    """Find the pieces of a finished run.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.
    """
    from tiler.run_folder import read_run_record
    from tiler.vtk_files import read_piece_paths

    record = directory / RUN_RECORD
    if not record.is_file():
        raise InputError(f"{record}: no such file; run citystitch first, or name its output folder")
    status = read_run_record(record).status
    if status != "done":
        raise InputError(f"{record}: the run is {status!r}, not 'done'; finish it or run again")
    volumes, boundaries = (read_piece_paths(directory / name) for name in (VOLUME_INDEX, BOUNDARY_INDEX))
    return RunFiles(directory, tuple(volumes), tuple(boundaries))


def _check_target(output: Path, files: RunFiles, *, overwrite: bool) -> None:
    own = {RUN_RECORD, VOLUME_INDEX, BOUNDARY_INDEX}
    mine = {path.resolve() for path in (*files.volumes, *files.boundaries, *(files.directory / n for n in own))}
    if output.resolve() in mine:
        raise ConfigError(f"{output}: is a file of the run itself; give another --output")
    if output.exists() and not overwrite:
        raise ConfigError(f"{output}: exists; give another --output, or --overwrite")
