"""A tileset of a finished run: its data sorted into cells tile by tile, then cells made from the smallest up."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker, is_ground
from tiler.export.export import EXPORT_RECORD
from tiler.export.foam_patches import patch_of_key
from tiler.export.surface import RunSurface, open_surface
from tiler.mesh_files.run_files import RUN_RECORD, RunFiles, crs_of
from tiler.store.atomic import replacing_folder
from tiler.store.out_folder import CITY_MODEL
from tiler.store.run_folder import read_run_record
from tiler.tiles3d.buildings import (
    Part,
    Unit,
    draw_units,
    generalise,
    load_parts,
    make_units,
    read_parts,
    write_part,
)
from tiler.tiles3d.cells import Cell, CellGrid, encode, make_grid
from tiler.tiles3d.content import Layer, make_content
from tiler.tiles3d.globe import Globe
from tiler.tiles3d.gltf import CELLS
from tiler.tiles3d.slices import ROW as SLICE_ROW
from tiler.tiles3d.slices import cut_pieces, make_slices, slice_surface
from tiler.tiles3d.spool import Spool
from tiler.tiles3d.subtrees import TILESET, Tile, make_tileset, write_tree
from tiler.tiles3d.terrain import ROW, Lattice, Site, add_skirt, coarsen, draw_lattice, lay_lattice, meshed_ground

SHARE = 128  # sides of a cell over the distance that its level allows
READ_AT_ONCE = 1000  # parts of buildings


@dataclass(frozen=True, eq=False)
class _Made:
    """What a cell hands to the one above it."""

    lattice: Lattice
    units: list[Unit]


def export_tileset(
    output: Path,
    files: RunFiles,
    *,
    geoid_height: float = 0.0,
    vertical_crs: str = "",
    slice_height: Sequence[float] = (),
    slice_line: Sequence[str] = (),
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
    slice_height, slice_line
        Where the volume mesh is cut: see `make_slices`.

    Returns
    -------
    list of str
        How many tiles there are, and by which operation they are placed on the globe.

    Raises
    ------
    ConfigError
        As of `Globe` and `make_slices`.
    InputError
        If a file of the run is missing or damaged.
    OutputError
        If the folder cannot be written.

    Notes
    -----
    Memory: a tile of the run, then the contents of the cells on one way down the tree, and the lowest wall of each
    building. Data of all cells wait in a temporary folder beside the output.
    """
    record = read_run_record(files.directory / RUN_RECORD)
    globe = Globe(crs_of(files), record.bounds, geoid_height=geoid_height, vertical_crs=vertical_crs)
    boxes = [box for box in record.tiles.values() if box is not None]
    site = Site(globe, record.bounds, np.array(boxes or [record.bounds], np.float64))
    grid = make_grid(globe.box)
    slices = make_slices(list(slice_height), list(slice_line))
    surface = open_surface(files)
    told: Counter[str] = Counter()
    with replacing_folder(output) as folder, TemporaryDirectory(dir=folder, prefix=".cells.") as name:
        ground, buildings, cut = (
            Spool(_make_folder(Path(name) / kind)) for kind in ("ground", "buildings", "slices")
        )
        lowest = _sort_ground(surface, globe, grid, ground)
        _sort_parts(read_parts(files.directory / CITY_MODEL, lowest, told), globe, grid, buildings)
        for rows in cut_pieces(surface.pieces, slices):
            lon, lat, _ = globe.geographic(rows[:, :9].reshape(-1, 3, 3).mean(axis=1)).T
            cut.add_rows(grid.leaves_of(lon, lat), rows)
        cut.flush()
        leaves = np.array(sorted(ground.cells | buildings.cells | cut.cells), np.int64)
        if not len(leaves):
            raise InputError(f"{files.directory}: has neither ground nor buildings; mesh the region again")
        maker = _Maker(folder, site, grid, ground, buildings, cut, surface.ground)
        tree = write_tree(folder, leaves, grid.depth, maker.make)
        box = tuple(np.radians(grid.box((0, 0, 0))).tolist())
        extras = {"crs": crs_of(files), "heights": globe.heights, "levels": grid.depth + 1}
        document = make_tileset(tree, box, grid.depth, extras)
        (folder / TILESET).write_text(json.dumps(document, indent=1) + "\n")
        (folder / EXPORT_RECORD).write_text(json.dumps({"format": "3dtiles", "tiles": tree.tiles}) + "\n")
    return [
        f"tiles: {tree.tiles}; levels: {grid.depth + 1}; the coarsest is {tree.error:.3g} m from the run",
        f"placed {globe.operation.describe()}; {globe.heights}",
        *(f"{number} {what}" for what, number in told.items() if number),
    ]


def _make_folder(path: Path) -> Path:
    path.mkdir()
    return path


def _sort_ground(surface: RunSurface, globe: Globe, grid: CellGrid, spool: Spool) -> dict[int, float]:
    """Sort the ground into cells, by the middle of each facet; gives the lowest wall of each building."""
    numbers: list[NDArray[np.int64]] = []
    heights: list[NDArray[np.float64]] = []
    for k in range(len(surface.names)):
        piece = surface.read(k)
        rows = np.flatnonzero(is_ground(piece.marker))
        corners = piece.points[piece.facets[rows]]
        lon, lat, _ = globe.geographic(corners.mean(axis=1)).T
        spool.add_rows(
            grid.leaves_of(lon, lat), np.column_stack((corners.reshape(-1, ROW - 1), piece.marker[rows]))
        )
        walls = piece.marker == Marker.WALL
        low = piece.points[piece.facets[walls], 2].min(axis=1)
        number, inverse = np.unique(piece.building[walls], return_inverse=True)
        least = np.full(len(number), np.inf)
        np.minimum.at(least, inverse, low)
        numbers.append(number)
        heights.append(least)
    spool.flush()
    found: dict[int, float] = {}
    for number, least in zip(np.concatenate(numbers).tolist(), np.concatenate(heights).tolist(), strict=True):
        found[number] = min(least, found.get(number, np.inf))
    return found


def _sort_parts(parts: Iterator[Part], globe: Globe, grid: CellGrid, spool: Spool) -> None:
    """Sort the buildings into cells, each whole, by the middle of its box."""
    waiting: list[Part] = []

    def sort() -> None:
        middles = [(np.min(part.xyz, axis=0) + np.max(part.xyz, axis=0)) / 2 for part in waiting]
        lon, lat, _ = globe.geographic(np.array(middles).reshape(-1, 3)).T
        for cell, part in zip(grid.leaves_of(lon, lat).tolist(), waiting, strict=True):
            spool.add(cell, write_part(part))
        waiting.clear()

    for part in parts:
        waiting.append(part)
        if len(waiting) == READ_AT_ONCE:
            sort()
    sort()
    spool.flush()


@dataclass(frozen=True, eq=False)
class _Maker:
    """Makes the content of each cell."""

    folder: Path
    site: Site
    grid: CellGrid
    ground: Spool
    buildings: Spool
    slices: Spool
    patches: tuple[str, ...]

    def make(self, cell: Cell, children: Mapping[tuple[int, int], Any]) -> tuple[Tile, _Made]:
        """Make a cell from what its children handed up, or of the smallest from what waits for it."""
        allowed = self.grid.side * 2 ** (self.grid.depth - cell[0]) / SHARE
        layers, made, error = (
            self._coarse(cell, children, allowed) if children else self._smallest(cell, 2 * allowed)
        )
        if not layers:
            raise InputError(f"cell {cell}: has neither ground nor buildings; run again")
        data, region = make_content(layers, self.site.globe, self._name)
        level, x, y = cell
        path = self.folder / f"content/{level}/{x}/{y}.glb"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return Tile(region, error, content=True), made

    def _name(self, material: int) -> str:
        return "cells" if material == CELLS else str(patch_of_key(material, self.patches).name)

    def _smallest(self, cell: Cell, depth: float) -> tuple[list[Layer], _Made, float]:
        _, x, y = cell
        code = int(encode(np.array([x]), np.array([y]))[0])
        box = self.grid.box(cell)
        rows = np.frombuffer(self.ground.read(code)).reshape(-1, ROW)
        units = make_units(load_parts(self.buildings.read(code)))
        layers = [layer] if (layer := draw_units(units)) else []
        surface, markers = meshed_ground(rows)
        if markers:
            names = [patch_of_key(marker, self.patches).name for marker in markers]
            layers.append(Layer("terrain", add_skirt(surface, self.site, box, depth), {"patch": names}))
        cut, quality = slice_surface(np.frombuffer(self.slices.read(code)).reshape(-1, SLICE_ROW))
        if len(quality):
            layers.append(Layer("cells", cut, {"quality": quality}))
        return layers, _Made(lay_lattice(self.site, box, surface), units), 0.0

    def _coarse(
        self, cell: Cell, children: Mapping[tuple[int, int], _Made], allowed: float
    ) -> tuple[list[Layer], _Made, float]:
        box = self.grid.box(cell)
        below = [unit for place in sorted(children) for unit in children[place].units]
        units, error = generalise(below, allowed)
        lattice = coarsen(self.site, box, {place: child.lattice for place, child in children.items()})
        layers = [layer] if (layer := draw_units(units)) else []
        surface = draw_lattice(self.site, box, lattice)
        if surface is not None:
            ground = add_skirt(surface, self.site, box, 2 * allowed)
            layers.append(Layer("terrain", ground, {"patch": [patch_of_key(Marker.GROUND, ()).name]}))
        if not layers and (layer := draw_units(below)):  # low buildings alone: they stay
            layers, units, error = [layer], below, max(unit.error for unit in below)
        return layers, _Made(lattice, units), max(error, lattice.error)
