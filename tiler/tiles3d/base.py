"""How a cell of a tileset is made: of the ground and the parts in it, or of those below."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.data.mesh import Marker, is_ground
from tiler.export.foam_patches import patch_of_key
from tiler.export.surface import RunSurface, open_surface
from tiler.mesh_files.run_files import RUN_RECORD, RunFiles, crs_of
from tiler.store.run_folder import read_run_record
from tiler.tiles3d.blocks import Pieces, join_pieces, load_pieces
from tiler.tiles3d.buildings import STEP, Part, Unit, draw_units, generalise, make_units
from tiler.tiles3d.cells import Cell, CellGrid, make_grid
from tiler.tiles3d.content import Layer, make_content
from tiler.tiles3d.globe import Array, Globe
from tiler.tiles3d.gltf import CELLS
from tiler.tiles3d.slices import slice_surface
from tiler.tiles3d.subtrees import Tile
from tiler.tiles3d.terrain import ROW, Lattice, Site, add_skirt, coarsen, draw_lattice, lay_lattice, meshed_ground

SHARE = 128  # sides of a cell over the distance that its level allows


@dataclass(frozen=True, eq=False)
class Made:
    """What a cell hands to the one above it."""

    lattice: Lattice
    units: list[Unit]
    pieces: Pieces = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Content:
    """A cell that is made: its file, what the tree tells of it, and what it hands up."""

    data: bytes
    tile: Tile
    made: Made


@dataclass(frozen=True, eq=False)
class SortedPiece:
    """The boundary of a tile of the run."""

    #: its ground in each cell, by code; sorted, so that the mesher's order of facets does not count
    ground: dict[int, Array]
    digests: dict[int, str]  #: hash of each
    lowest: dict[int, float]  #: lowest wall (m) of each building that it has, by number


@dataclass(frozen=True, eq=False)
class Base:
    """A run as tiles see it: way to the globe, quadtree, boundary, and whether contents are packed by Draco."""

    site: Site
    grid: CellGrid
    surface: RunSurface
    crs: str
    draco: bool = False

    def sort_piece(self, k: int) -> SortedPiece:
        """Read piece `k`, and sort its ground into cells by the middle of each facet."""
        piece = self.surface.read(k)
        facets = np.flatnonzero(is_ground(piece.marker))
        corners = piece.points[piece.facets[facets]]
        lon, lat, _ = self.site.globe.geographic(corners.mean(axis=1)).T
        rows = np.column_stack((corners.reshape(-1, ROW - 1), piece.marker[facets]))
        code = self.grid.leaves_of(lon, lat)
        order = np.lexsort((*rows.T, code))
        codes, first = np.unique(code[order], return_index=True)
        ground = dict(zip(codes.tolist(), np.split(rows[order], first[1:]), strict=True)) if len(codes) else {}
        walls = piece.marker == Marker.WALL
        low = piece.points[piece.facets[walls], 2].min(axis=1)
        number, inverse = np.unique(piece.building[walls], return_inverse=True)
        least = np.full(len(number), np.inf)
        np.minimum.at(least, inverse, low)
        digests = {k: hashlib.sha256(some.tobytes()).hexdigest() for k, some in ground.items()}
        return SortedPiece(ground, digests, dict(zip(number.tolist(), least.tolist(), strict=True)))

    def leaves_of_parts(self, parts: Sequence[Part]) -> list[int]:
        """Give the smallest cell of each part, by the middle of its box."""
        middles = [(np.min(part.xyz, axis=0) + np.max(part.xyz, axis=0)) / 2 for part in parts]
        lon, lat, _ = self.site.globe.geographic(np.array(middles).reshape(-1, 3)).T
        leaves: list[int] = self.grid.leaves_of(lon, lat).tolist()
        return leaves

    def smallest(
        self, cell: Cell, rows: Array, parts: Sequence[Part], sliced: Array, blocks: bytes = b""
    ) -> Content | None:
        """Make one of the smallest cells of its ground, parts and triangles of slices; None if it has none.

        `blocks` are those for the levels above, as `deal_blocks` wrote them.
        """
        box = self.grid.box(cell)
        units = make_units(parts)
        layers = [layer] if (layer := draw_units(units)) else []
        surface, markers = meshed_ground(rows)
        if markers:
            names = [patch_of_key(marker, self.surface.ground).name for marker in markers]
            ground = add_skirt(surface, self.site, box, 2 * self._allowed(cell))
            layers.append(Layer("terrain", ground, {"patch": names}))
        cut, quality = slice_surface(sliced)
        if len(quality):
            layers.append(Layer("cells", cut, {"quality": quality}))
        made = Made(lay_lattice(self.site, box, surface), units, load_pieces(blocks))
        return self._draw(layers, made, 0.0)

    def coarse(self, cell: Cell, children: Mapping[tuple[int, int], Made]) -> Content | None:
        """Make a cell from what its children handed up; None if that is nothing."""
        box, allowed = self.grid.box(cell), self._allowed(cell)
        below = [unit for place in sorted(children) for unit in children[place].units]
        pieces = join_pieces([children[place].pieces for place in sorted(children)], allowed / 2, STEP)
        units, error = generalise(below, allowed, pieces)
        lattice = coarsen(self.site, box, {place: child.lattice for place, child in children.items()})
        layers = [layer] if (layer := draw_units(units)) else []
        surface = draw_lattice(self.site, box, lattice)
        if surface is not None:
            ground = add_skirt(surface, self.site, box, 2 * allowed)
            layers.append(Layer("terrain", ground, {"patch": [patch_of_key(Marker.GROUND, ()).name]}))
        if not layers and (layer := draw_units(below)):  # low buildings alone: they stay
            layers, units, error = [layer], below, max(unit.error for unit in below)
        return self._draw(layers, Made(lattice, units, pieces), max(error, lattice.error))

    def _allowed(self, cell: Cell) -> float:
        """Give the distance (m) that the level of a cell allows."""
        side: float = self.grid.side * 2 ** (self.grid.depth - cell[0])
        return side / SHARE

    def _draw(self, layers: list[Layer], made: Made, error: float) -> Content | None:
        if not layers:
            return None
        data, region = make_content(layers, self.site.globe, self._name, draco=self.draco)
        return Content(data, Tile(region, error, content=True), made)

    def _name(self, material: int) -> str:
        return "cells" if material == CELLS else str(patch_of_key(material, self.surface.ground).name)


def open_base(files: RunFiles, *, geoid_height: float = 0.0, vertical_crs: str = "") -> Base:
    """Open a finished run for tiles; parameters and errors as of `tiler.tiles3d.tileset.export_tileset`."""
    record = read_run_record(files.directory / RUN_RECORD)
    crs = crs_of(files)
    globe = Globe(crs, record.bounds, geoid_height=geoid_height, vertical_crs=vertical_crs)
    boxes = [box for box in record.tiles.values() if box is not None]
    site = Site(globe, record.bounds, np.array(boxes or [record.bounds], np.float64))
    return Base(site, make_grid(globe.box), open_surface(files), crs)
