"""The files of a finished run that writers read, found by its index files."""

from dataclasses import dataclass, replace
from math import floor
from pathlib import Path

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.regions import Region, Regions

RUN_RECORD, VOLUME_INDEX, BOUNDARY_INDEX = "run.json", "mesh.pvtu", "boundary.pvtp"
MOST_ORIGIN = 1e9  # m


@dataclass(frozen=True)
class RunFiles:
    """The files of a finished run that a writer may read."""

    directory: Path  #: folder of the run
    #: VTU and VTP pieces, in the order of the index files: by name of tile
    volumes: tuple[Path, ...]
    boundaries: tuple[Path, ...]
    depth: float = 0.0  #: depth of its soil (m), 0 where it has none
    parts: int = 0  #: parts of the mesh that share no face, 0 where its record does not tell
    #: west, south, east and north side (m) of the part of the mesh that these are the files of; None where they
    #: are those of the whole mesh
    sides: tuple[float, float, float, float] | None = None
    #: place in the CRS (m) that coordinates are to count from
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: patches of the ground by number: names and roughness lengths (m); none without land cover
    ground: tuple[tuple[str, float | None], ...] = ()
    leaves: bool = False  #: whether cells tell their leaf area density
    regions: Regions = (Region.AIR,)  #: what cells are filled with

    @property
    def ground_names(self) -> tuple[str, ...]:
        """Names of the patches of the ground, by number."""
        return tuple(name for name, _ in self.ground)

    @property
    def origin_words(self) -> str:
        """The origin as text, empty where it is that of the CRS."""
        return " ".join(f"{value:.0f}" for value in self.origin) if any(self.origin) else ""

    @property
    def whole(self) -> bool:
        """Whether these are the files of the whole mesh."""
        return self.sides is None


RunSource = Path | RunFiles


def find_files(directory: Path) -> RunFiles:
    """Find the pieces of a finished run.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.
    """
    from tiler.mesh_files.vtk_files import read_piece_paths
    from tiler.store.run_folder import read_run_record

    refuse_strangers(directory)
    record = directory / RUN_RECORD
    found = read_run_record(record)
    if found.status != "done":
        raise InputError(f"{record}: the run is {found.status!r}, not 'done'; finish it or run again")
    volumes, boundaries = (read_piece_paths(directory / name) for name in (VOLUME_INDEX, BOUNDARY_INDEX))
    ground = tuple((patch.name, patch.roughness) for patch in found.ground)
    return RunFiles(
        directory,
        tuple(volumes),
        tuple(boundaries),
        found.depth,
        len(found.parts),
        ground=ground,
        leaves=found.leaves,
        regions=found.regions,
    )


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


def crs_of(source: RunSource) -> str:
    """Read the CRS of a run's coordinates; errors as `tiler.store.run_folder.read_crs`."""
    from tiler.store.run_folder import read_crs

    return read_crs((source.directory if isinstance(source, RunFiles) else source) / RUN_RECORD)


def take_origin(files: RunFiles, text: str) -> RunFiles:
    """Let coordinates count from a place of their own.

    Parameters
    ----------
    files : RunFiles
        Files of a run.
    text : str
        ``x,y,z`` (m), or ``auto``: the region's south-western corner in whole metres, at height 0.

    Raises
    ------
    ConfigError
        If it is neither, or not in whole metres: only then no digit of a coordinate is lost.
    """
    from tiler.store.run_folder import read_run_record

    if text == "auto":
        west, south, _, _ = read_run_record(files.directory / RUN_RECORD).bounds
        return replace(files, origin=(float(floor(west)), float(floor(south)), 0.0))
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(f"--origin {text}: three numbers x,y,z, or auto, expected") from None
    if not all(value.is_integer() and abs(value) <= MOST_ORIGIN for value in (x, y, z)):
        raise ConfigError(f"--origin {text}: whole metres of at most {MOST_ORIGIN:.0e} expected")
    return replace(files, origin=(x, y, z))


def take_largest_part(files: RunFiles) -> RunFiles:
    """Take the pieces of the part of a mesh that has the most cells, where parts share no face.

    Raises
    ------
    InputError
        If the record of the run does not tell of parts.
    ConfigError
        If a tile has cells of this part and of another one.
    """
    from tiler.store.run_folder import read_run_record

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
