"""Files for other programs, made from a finished run: `citystitch export` (step 3.6).

Formats are entries of `FORMATS`. A writer gets the run's pieces and a path, and makes the file appear whole or not
at all; what it may read, and whether it may replace a file, is seen to here. The command line shows the table in
its help, so writers import what they need when they are called.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError, InputError

RUN_RECORD, VOLUME_INDEX, BOUNDARY_INDEX = "run.json", "mesh.pvtu", "boundary.pvtp"
EXPORT_RECORD = "export.json"  # in every folder that was exported: only such a one is ever replaced


@dataclass(frozen=True)
class RunFiles:
    """The files of a finished run that a writer may read.

    Attributes
    ----------
    directory : Path
        Folder of the run.
    volumes, boundaries : tuple of Path
        VTU and VTP pieces, in the order of the index files: by name of tile.
    depth : float
        Depth of its soil (m), 0 where it has none.
    parts : int
        Parts of the mesh that share no face, 0 where its record does not tell.
    sides : tuple of float or None
        West, south, east and north side (m) of the part of the mesh that these are the files of; None where they
        are those of the whole mesh.
    """

    directory: Path
    volumes: tuple[Path, ...]
    boundaries: tuple[Path, ...]
    depth: float = 0.0
    parts: int = 0
    sides: tuple[float, float, float, float] | None = None

    @property
    def whole(self) -> bool:
        """Whether these are the files of the whole mesh."""
        return self.sides is None


RunSource = Path | RunFiles


@dataclass(frozen=True)
class Format:
    """A kind of file to export.

    Attributes
    ----------
    description : str
        What it holds, in a few words.
    write : callable
        Given a path and the files of a run, and the options as keywords, writes that file or folder.
    options : tuple of str
        Options of the command line that it takes, without dashes.
    buildings : tuple of str
        What the option ``buildings`` may be, where it is taken.
    folder : bool
        Whether it is a folder.
    suffix : str
        What the name of the file must end with, if anything.
    companion : str
        Suffix of a second file beside it, if there is one.
    """

    description: str
    write: Callable[..., None]
    options: tuple[str, ...] = ()
    buildings: tuple[str, ...] = ("patches",)
    folder: bool = False
    suffix: str = ""
    companion: str = ""


def _write_vtu(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.mesh_files.merged import write_merged_volume

    write_merged_volume(path, files.volumes, **options)


def _write_vtp(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.mesh_files.merged import write_merged_boundary

    write_merged_boundary(path, files.boundaries, files.volumes, **options)


def _write_openfoam(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.formats.openfoam import export_openfoam

    export_openfoam(path, files, **options)


def _write_xdmf(path: Path, files: RunFiles) -> None:
    from tiler.formats.xdmf import export_xdmf

    export_xdmf(path, files)


def _write_cgns(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.formats.cgns import export_cgns

    export_cgns(path, files, **options)


def _write_msh(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.formats.msh import export_msh

    export_msh(path, files, **options)


def _write_msh2(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.formats.msh import export_msh2

    export_msh2(path, files, **options)


def _write_stl(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.formats.stl import export_stl

    export_stl(path, files, **options)


def _write_obj(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.formats.obj import export_obj

    export_obj(path, files, **options)


def _write_ply(path: Path, files: RunFiles) -> None:
    from tiler.formats.ply import export_ply

    export_ply(path, files)


def _write_glb(path: Path, files: RunFiles, **options: Any) -> None:
    from tiler.formats.glb import export_glb

    export_glb(path, files, **options)


def _write_cityjsonseq(path: Path, files: RunFiles) -> None:
    from tiler.formats.cityjsonseq import export_cityjsonseq

    export_cityjsonseq(path, files.directory)


def _write_gpkg(path: Path, files: RunFiles) -> None:
    from tiler.formats.gpkg import export_gpkg

    export_gpkg(path, files.directory)


LARGEST_PART = "largest_part"  # taken by every format of the mesh, not by those of the city model
PER_BUILDING = ("buildings", LARGEST_PART)
FORMATS: Mapping[str, Format] = {
    "vtu": Format("the volume mesh as one VTK file", _write_vtu, options=("scalars", LARGEST_PART)),
    "vtp": Format("the marked boundary as one VTK file", _write_vtp, options=("scalars", LARGEST_PART)),
    "openfoam": Format(
        "a case folder of OpenFOAM",
        _write_openfoam,
        options=("parts", "case", "buildings", LARGEST_PART),
        buildings=("patches", "zones"),
        folder=True,
    ),
    "xdmf": Format(
        "mesh and marked facets for FEniCS and ParaView, with a file .h5 beside it",
        _write_xdmf,
        options=(LARGEST_PART,),
        suffix=".xdmf",
        companion=".h5",
    ),
    "cgns": Format("mesh and named patches as CGNS in HDF5", _write_cgns, options=PER_BUILDING, suffix=".cgns"),
    "msh": Format("Gmsh's MSH 4.1, binary", _write_msh, options=PER_BUILDING, suffix=".msh"),
    "msh2": Format(
        "Gmsh's MSH 2.2, text, as gmshToFoam reads it", _write_msh2, options=PER_BUILDING, suffix=".msh"
    ),
    "stl": Format("the boundary as STL, text, one solid a patch", _write_stl, options=PER_BUILDING, suffix=".stl"),
    "obj": Format(
        "the boundary as Wavefront OBJ, one group a patch", _write_obj, options=PER_BUILDING, suffix=".obj"
    ),
    "ply": Format(
        "the boundary as PLY, binary, with marker and building", _write_ply, options=(LARGEST_PART,), suffix=".ply"
    ),
    "glb": Format(
        "the boundary as glTF 2.0, binary, one material a patch", _write_glb, options=PER_BUILDING, suffix=".glb"
    ),
    "cityjsonseq": Format(
        "the simplified city model as CityJSONSeq, one feature a building", _write_cityjsonseq, suffix=".jsonl"
    ),
    "gpkg": Format("the simplified footprints with heights as GeoPackage", _write_gpkg, suffix=".gpkg"),
}
NO_OPTIONS: Mapping[str, Any] = {}


def export_run(
    directory: Path, output: Path, *, name: str, overwrite: bool = False, options: Mapping[str, Any] = NO_OPTIONS
) -> None:
    """Write a run's mesh for other programs.

    Parameters
    ----------
    directory : Path
        Folder of a finished run.
    output : Path
        The file or folder; it appears whole or not at all.
    name : str
        Format, one of `FORMATS`.
    overwrite : bool
        Whether a file of that name may be replaced, or a folder that was exported; one of the run's own never is.
    options : mapping of str to value
        What the format takes; see docs/formats.md.

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
    if name not in FORMATS:
        raise ValueError(f"format {name!r} must be one of {', '.join(FORMATS)}")
    kind = FORMATS[name]
    for option in options:
        if option not in kind.options:
            taken = ", ".join(f"--{known.replace('_', '-')}" for known in kind.options) or "none"
            raise ConfigError(
                f"--{option.replace('_', '-')}: format {name} does not take it; its options: {taken}"
            )
    asked = options.get("buildings", kind.buildings[0])
    if asked not in kind.buildings:
        raise ConfigError(f"--buildings {asked}: format {name} takes {' or '.join(kind.buildings)}")
    if not output.name.endswith(kind.suffix):
        raise ConfigError(f"{output}: a file of format {name} ends with {kind.suffix}; give another --output")
    given = dict(options)
    files = find_files(directory)
    for target in (output, output.with_suffix(kind.companion)) if kind.companion else (output,):
        _check_target(target, files, overwrite=overwrite)
    if kind.folder and output.exists() and not (output / EXPORT_RECORD).is_file():
        raise ConfigError(f"{output}: holds no {EXPORT_RECORD}, so it was not exported; give another --output")
    if given.pop(LARGEST_PART, False):
        files = take_largest_part(files)
    kind.write(output, files, **given)


def find_files(directory: Path) -> RunFiles:
    """Find the pieces of a finished run.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.
    """
    from tiler.mesh_files.vtk_files import read_piece_paths
    from tiler.workflow.run_folder import read_run_record

    refuse_strangers(directory)
    record = directory / RUN_RECORD
    found = read_run_record(record)
    if found.status != "done":
        raise InputError(f"{record}: the run is {found.status!r}, not 'done'; finish it or run again")
    volumes, boundaries = (read_piece_paths(directory / name) for name in (VOLUME_INDEX, BOUNDARY_INDEX))
    return RunFiles(directory, tuple(volumes), tuple(boundaries), found.depth, len(found.parts))


def refuse_strangers(directory: Path) -> None:
    """Raise InputError if a folder is not that of a run: whatever else it may hold."""
    if not directory.is_dir():
        what = "is a file" if directory.exists() else "no such folder"
        raise InputError(f"{directory}: {what}; run citystitch first, or give what --out of a run was")
    if not (directory / RUN_RECORD).is_file():
        raise InputError(
            f"{directory}: is not the folder of a run, it has no {RUN_RECORD}; run citystitch first, or give what "
            "--out of a run was"
        )


def take_largest_part(files: RunFiles) -> RunFiles:
    """Take the pieces of the part of a mesh that has the most cells, where parts share no face.

    Raises
    ------
    InputError
        If the record of the run does not tell of parts.
    ConfigError
        If a tile has cells of this part and of another one.
    """
    from tiler.workflow.run_folder import read_run_record

    record = files.directory / RUN_RECORD
    found = read_run_record(record)
    parts = found.parts
    if not parts:
        raise InputError(f"{record}: does not say which parts the mesh has; run again")
    if len(parts) == 1:
        return files
    if divided := parts[0].divided:
        raise ConfigError(
            f"--largest-part: tile {divided[0]} has cells of this part and of another one, and pieces are taken "
            "whole; mesh again with another --bounds or --tile-size"
        )
    wanted = set(parts[0].tiles)
    kept = [tuple(path for path in paths if path.stem in wanted) for paths in (files.volumes, files.boundaries)]
    boxes = [box for name in parts[0].tiles if (box := found.tiles.get(name)) is not None]
    if len(boxes) < len(wanted):
        raise InputError(f"{record}: does not tell the boxes of all tiles; run again")
    west, south, east, north = zip(*boxes, strict=True)
    sides = (min(west), min(south), max(east), max(north))
    return replace(files, volumes=kept[0], boundaries=kept[1], parts=1, sides=sides)


def _check_target(output: Path, files: RunFiles, *, overwrite: bool) -> None:
    own = {RUN_RECORD, VOLUME_INDEX, BOUNDARY_INDEX}
    mine = {path.resolve() for path in (*files.volumes, *files.boundaries, *(files.directory / n for n in own))}
    if output.resolve() in mine:
        raise ConfigError(f"{output}: is a file of the run itself; give another --output")
    if output.exists() and not overwrite:
        raise ConfigError(f"{output}: exists; give another --output, or --overwrite")
