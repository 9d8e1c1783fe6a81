"""A tileset of a finished run: its data sorted into cells tile by tile, then cells made from the smallest up."""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Unpack

import numpy as np

from pipeline.data.errors import ConfigError, InputError
from tiler.export.export import EXPORT_RECORD
from tiler.mesh_files.run_files import RunFiles
from tiler.store.atomic import replacing, replacing_folder
from tiler.store.out_folder import CITY_MODEL
from tiler.tiles3d.base import Base, Made, SortedPiece, open_base
from tiler.tiles3d.blocks import BlockNames, deal_blocks
from tiler.tiles3d.buildings import Part, load_parts, read_parts, write_part
from tiler.tiles3d.cells import Cell, CellBuffers, encode
from tiler.tiles3d.slices import ROW as SLICE_ROW
from tiler.tiles3d.slices import SliceWords, cut_pieces, make_slices
from tiler.tiles3d.subtrees import TILESET, Tile, Tree, make_tileset, write_tree
from tiler.tiles3d.terrain import ROW
from tiler.tiles3d.update_state import UpdateState

READ_AT_ONCE = 1000  # parts of buildings
DRACO = "draco"


def export_tileset(
    output: Path,
    files: RunFiles,
    *,
    geoid_height: float = 0.0,
    vertical_crs: str = "",
    generalised: str = "",
    compression: str = "",
    keep: UpdateState | None = None,
    **cut_at: Unpack[SliceWords],
) -> list[str]:
    """Write a finished run as 3D Tiles 1.1.

    Parameters
    ----------
    output : Path
        The folder; it appears whole or not at all.
    files : RunFiles
        Files of the run.
    geoid_height, vertical_crs
        See `Globe`.
    generalised : str
        GeoPackage of `citystitch generalise`, whose blocks stand for houses in the upper levels; none by default.
    compression : str
        How meshes are packed: ``draco`` or not at all.
    keep : UpdateState, optional
        Takes what an update of the tileset needs, see `tiler.tiles3d.update`.
    slice_height, slice_line
        Where the volume mesh is cut: see `make_slices`.

    Returns
    -------
    list of str
        How many tiles there are, and by which operation they are placed on the globe.

    Raises
    ------
    ConfigError
        As of `Globe` and `make_slices`; if the compression is unknown, or its package is missing.
    InputError
        If a file of the run is missing or damaged, or that of blocks is, or has no house of the run.
    OutputError
        If the folder cannot be written.

    Notes
    -----
    Memory: a tile of the run, then the contents of the cells on one way down the tree, and the lowest wall of each
    building. Data of all cells wait in a temporary folder beside the output.
    """
    if compression not in ("", DRACO):
        raise ConfigError(f"--compression {compression}: expected {DRACO}, or none; change it")
    if compression and find_spec("DracoPy") is None:
        raise ConfigError(f"--compression {DRACO} needs DracoPy: pip install 'citystitch[{DRACO}]'")
    base = open_base(files, geoid_height=geoid_height, vertical_crs=vertical_crs)
    base = replace(base, draco=compression == DRACO)
    slices = make_slices(list(cut_at.get("slice_height", ())), list(cut_at.get("slice_line", ())))
    globe, grid = base.site.globe, base.grid
    told: Counter[str] = Counter()
    with replacing_folder(output) as folder, TemporaryDirectory(dir=folder, prefix=".cells.") as name:
        ground, buildings, cut, blocks = (
            CellBuffers(_make_folder(Path(name) / kind)) for kind in ("ground", "buildings", "slices", "blocks")
        )
        found = _sort_ground(base, ground)
        lowest = find_lowest(one.lowest for one in found.values())
        parts = read_parts(files.directory / CITY_MODEL, lowest, told)
        if generalised:
            with closing(BlockNames(Path(name) / "names")) as names:
                deal_blocks(generalised, base.crs, base.site, grid, blocks, names)
                parts = _name_blocks(parts, names, generalised, told)
                places = _sort_parts(parts, base, buildings)
        else:
            places = _sort_parts(parts, base, buildings)
        for rows in cut_pieces(base.surface.pieces, slices):
            lon, lat, _ = globe.geographic(rows[:, :9].reshape(-1, 3, 3).mean(axis=1)).T
            cut.add_rows(grid.leaves_of(lon, lat), rows)
        cut.flush()
        leaves = np.array(sorted(ground.cells | buildings.cells | cut.cells), np.int64)
        if not len(leaves):
            raise InputError(f"{files.directory}: has neither ground nor buildings; mesh the region again")
        own: dict[Cell, Tile] = {}

        def make(cell: Cell, children: Mapping[tuple[int, int], Made]) -> tuple[Tile, Made]:
            if cell[0] < grid.depth:
                content = base.coarse(cell, children)
            else:
                _, x, y = cell
                code = int(encode(np.array([x]), np.array([y]))[0])
                rows = np.frombuffer(ground.read(code)).reshape(-1, ROW)
                sliced = np.frombuffer(cut.read(code)).reshape(-1, SLICE_ROW)
                own_parts = load_parts(buildings.read(code))
                content = base.smallest(cell, rows, own_parts, sliced, blocks.read(code))
            if content is None:
                raise InputError(f"cell {cell}: has neither ground nor buildings; run again")
            write_content(folder, cell, content.data)
            own[cell] = content.tile
            if keep is not None:
                keep.save(cell, content.made)
            return content.tile, content.made

        tree = write_tree(folder, leaves, grid.depth, make)
        write_root(folder, tree, base)
        if keep is not None:
            keep.end(files, own, found, places)
    return [
        f"tiles: {tree.tiles}; levels: {base.grid.depth + 1}; the coarsest is {tree.error:.3g} m from the run",
        f"placed {base.site.globe.operation.describe()}; {base.site.globe.heights}",
        *(f"{number} {what}" for what, number in told.items() if number),
    ]


def _make_folder(path: Path) -> Path:
    path.mkdir()
    return path


def write_content(folder: Path, cell: Cell, data: bytes) -> None:
    """Write the content of a cell, whole or not at all."""
    path = content_path(folder, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        part.write_bytes(data)


def content_path(folder: Path, cell: Cell) -> Path:
    """Give the path of the content of a cell."""
    level, x, y = cell
    return folder / f"content/{level}/{x}/{y}.glb"


def write_root(folder: Path, tree: Tree, base: Base) -> None:
    """Write what is known of a tileset when its tree is written."""
    grid, globe = base.grid, base.site.globe
    box = tuple(np.radians(grid.box((0, 0, 0))).tolist())
    extras = {"crs": base.crs, "heights": globe.heights, "levels": grid.depth + 1}
    document = make_tileset(tree, box, grid.depth, extras)
    with replacing(folder / TILESET) as part:
        part.write_text(json.dumps(document, indent=1) + "\n")
    with replacing(folder / EXPORT_RECORD) as part:
        part.write_text(json.dumps({"format": "3dtiles", "tiles": tree.tiles}) + "\n")


def _sort_ground(base: Base, buffers: CellBuffers) -> dict[str, SortedPiece]:
    """Sort the ground into cells; gives what else is known of each piece."""
    found = {}
    for k, name in enumerate(base.surface.names):
        piece = base.sort_piece(k)
        for code, rows in piece.ground.items():
            buffers.add(code, rows.tobytes())
        found[name] = replace(piece, ground={})
    buffers.flush()
    return found


def find_lowest(tiles: Iterable[Mapping[int, float]]) -> dict[int, float]:
    """Give the lowest wall (m) of each building, by its number, of those in the pieces of tiles."""
    found: dict[int, float] = {}
    for lowest in tiles:
        for number, least in lowest.items():
            found[number] = min(least, found.get(number, np.inf))
    return found


def _name_blocks(parts: Iterator[Part], names: BlockNames, file: str, told: Counter[str]) -> Iterator[Part]:
    """Tell each part which blocks it is in."""
    n = unknown = 0
    for part in parts:
        blocks = names.find(part.house)
        n, unknown = n + 1, unknown + (not blocks)
        yield replace(part, blocks=blocks)
    if n and n == unknown:
        raise InputError(f"{file}: has no building of the run; make it of this run, citystitch generalise RUN")
    told[f"of {n} parts of buildings are in no object of {Path(file).name}, and stay houses"] = unknown


def _sort_parts(parts: Iterator[Part], base: Base, buffers: CellBuffers) -> dict[str, int]:
    """Sort the buildings into cells, each whole, by the middle of its box; gives the cell of each id."""
    places: dict[str, int] = {}
    while waiting := list(islice(parts, READ_AT_ONCE)):
        for part, cell in zip(waiting, base.leaves_of_parts(waiting), strict=True):
            buffers.add(cell, write_part(part))
            places[part.id] = cell
    buffers.flush()
    return places
