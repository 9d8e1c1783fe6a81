"""A tileset that follows the edits of its run: cells that they touch, and those above as far as they change."""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping
from itertools import product
from math import floor
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pipeline.data.errors import InputError
from pipeline.quality.roof_fits import RoofFits
from tiler.citymodels.cityjson import write_city_blocks
from tiler.citymodels.tables import take_buildings, unpack_buildings
from tiler.mesh_files.run_files import RunFiles
from tiler.stages.citymodel import describe_buildings
from tiler.store.atomic import replacing_folder
from tiler.store.out_folder import CITY_MODEL, STORE
from tiler.store.store import Store
from tiler.tiles3d.base import Base, Content, Made, SortedPiece, open_base
from tiler.tiles3d.buildings import Part, read_parts
from tiler.tiles3d.cells import Cell, decode, encode
from tiler.tiles3d.slices import ROW as SLICE_ROW
from tiler.tiles3d.subtrees import SUBTREE_LEVELS, Tile, subtree_path, write_tree
from tiler.tiles3d.terrain import ROW
from tiler.tiles3d.tileset import content_path, export_tileset, find_lowest, write_content, write_root
from tiler.tiles3d.update_state import (
    MODEL,
    RunTile,
    UpdateState,
    hash_rows,
    lowest_ground,
    make_run_tile,
    measure_change,
    read_stamps,
)

TILES, MADE = "tiles", "made"  # below the folder: the tileset, and what is kept beside it
SCHEMA = 2  # version of the latter
MERGING_LEVEL = 0.03


def update_tileset(
    folder: Path,
    files: RunFiles,
    *,
    geoid_height: float = 0.0,
    vertical_crs: str = "",
    merging_level: float = 0.0,
) -> int:
    """Bring the tileset of a run up to date; of a new folder, or another run, make all of it.

    Parameters
    ----------
    folder : Path
        Its folder: the tileset is in `TILES` below it.
    files : RunFiles
        Files of the run.
    geoid_height, vertical_crs
        See `tiler.tiles3d.tileset.export_tileset`.
    merging_level : float
        Share of a cell below which a change does not go further up, see `measure_change`; `MERGING_LEVEL` is that
        of the paper. All changes together that a cell has not handed up are below it.

    Returns
    -------
    int
        Number of cells that were made anew.

    Raises
    ------
    CityError
        As of `export_tileset`.

    Notes
    -----
    A cell above is made anew where what a cell below hands up has changed; from there on all above keep theirs.
    With a merging level of 0, the bytes are those of a whole export, whatever was held back before. Killed in
    between, the next call makes all of it.

    References
    ----------
    E. Gobbetti and others: *Reconstructing and exploring massive detailed cityscapes* (2011): the merging level.
    """
    base = open_base(files, geoid_height=geoid_height, vertical_crs=vertical_crs)
    state = [SCHEMA, geoid_height, vertical_crs, base.crs, list(base.site.bounds), base.site.tiles.tolist()]
    state += [list(base.surface.names), list(base.surface.ground)]
    kept = UpdateState(folder / MADE, state)
    if kept.is_sound():
        return _Update(base, files, kept, folder / TILES, merging_level).run()
    with replacing_folder(folder) as new:
        kept = UpdateState(new / MADE, state)
        export_tileset(new / TILES, files, geoid_height=geoid_height, vertical_crs=vertical_crs, keep=kept)
        return len(kept.read_tree())


class _Update:
    """One update."""

    def __init__(self, base: Base, files: RunFiles, kept: UpdateState, folder: Path, merging_level: float) -> None:
        self._merging_level = merging_level
        self._base, self._files, self._kept, self._folder = base, files, kept, folder
        self._store = Store(files.directory / STORE)
        self._pieces: dict[str, SortedPiece] = {}  # those that were read
        self._origin, self._moved = kept.read_origin(), False
        self._tree: dict[Cell, Tile] = {}
        self._made = 0

    def run(self) -> int:
        """Do it; returns the number of cells that were made."""
        kept, names = self._kept, self._base.surface.names
        stamps = read_stamps(self._files)
        old = {name: kept.read_run(name) for name in names}
        changed = [name for name in names if (old[name].model, old[name].boundary) != stamps[name]]
        late = [] if self._merging_level else kept.late_cells()
        if not changed and not late:
            return 0
        kept.begin()
        new = dict(old)
        for name in changed:
            arrays, _ = self._store.read(MODEL, name, names=("ground",))
            ground = lowest_ground(arrays)
            new[name] = make_run_tile(stamps[name], self._piece(name), old[name].parts, ground)
        low = min((tile.ground_height for tile in new.values() if tile.ground_height is not None), default=0.0)
        self._moved = floor(low) != self._origin[2]  # then coordinates have other last digits in all parts
        self._origin[2] = float(floor(low))
        lowest = find_lowest(tile.numbers for tile in new.values())
        before = find_lowest(tile.numbers for tile in old.values())
        moved = {number for number in before.keys() | lowest.keys() if before.get(number) != lowest.get(number)}
        dirty = {int(code) for name in changed for code in _differing(old[name].ground, new[name].ground)}
        gone, came = set[str](), defaultdict[int, list[Part]](list)
        for name in names:
            touched, parts, rows = self._find_parts(name, old[name], stamps[name][0], moved, lowest)
            places = dict(zip((part.id for part in parts), self._base.leaves_of_parts(parts), strict=True))
            for part in parts:
                came[places[part.id]].append(part)
            dirty |= {
                place for one in touched if (place := old[name].parts.get(one, ("", 0, "", None))[3]) is not None
            }
            gone |= touched
            if touched:
                kept_parts = {
                    one: (*row, places.get(one) if one in touched else old[name].parts[one][3])
                    for one, row in rows.items()
                }
                new[name] = RunTile(**(vars(new[name]) | {"parts": kept_parts}))
        self._tree = kept.read_tree()
        self._make(sorted(dirty | came.keys()), new, gone, came, {cell: kept.read_cell(cell) for cell in late})
        self._finish()
        for name in names:
            if new[name] is not old[name]:
                kept.save_run(name, new[name])
        kept.finish(self._tree, self._origin)
        return self._made

    def _piece(self, name: str) -> SortedPiece:
        if name not in self._pieces:
            self._pieces[name] = self._base.sort_piece(self._base.surface.names.index(name))
        return self._pieces[name]

    def _find_parts(
        self, name: str, old: RunTile, model: str, moved: Collection[int], lowest: Mapping[int, float]
    ) -> tuple[set[str], list[Part], dict[str, tuple[str, int, str]]]:
        """Find the buildings of a tile that changed: ids, the parts that are there now, and all rows."""
        touched = {one for one, (_, number, _, _) in old.parts.items() if number in moved}
        touched |= old.parts.keys() if self._moved else set()
        if not touched and old.model == model:
            return set(), [], {}
        arrays, _ = self._store.read(MODEL, name)
        rows = hash_rows(arrays)
        before = {one: (house, number, row) for one, (house, number, row, _) in old.parts.items()}
        touched |= _differing(before, rows)
        # A house is made as a whole.
        houses = {states[one][0] for one in touched for states in (before, rows) if one in states}
        touched |= {one for states in (before, rows) for one, row in states.items() if row[0] in houses}
        buildings = unpack_buildings(arrays)
        some = take_buildings(buildings, np.flatnonzero(np.isin(buildings.model.ids, sorted(touched))))
        if not len(some.model):
            return touched, [], rows
        with TemporaryDirectory() as temporary:
            path = Path(temporary) / CITY_MODEL
            block = some.model, describe_buildings(some, RoofFits())
            write_city_blocks(path, [block], crs=self._base.crs, bounds=(*self._origin, *self._origin))
            return touched, list(read_parts(path, lowest, Counter())), rows

    def _make(
        self,
        dirty: list[int],
        new: Mapping[str, RunTile],
        gone: Collection[str],
        came: Mapping[int, list[Part]],
        handed: dict[Cell, Made | None],
    ) -> None:
        """Make the smallest cells of some codes, then those above as far as something changes.

        `handed` has what cells hand up that differs from before.
        """
        base, depth = self._base, self._base.grid.depth
        for code in dirty:
            cell = (depth, *decode(code))
            there = self._kept.read_cell(cell)
            parts = [unit.part for unit in (there.units if there else []) if unit.part is not None]
            parts = [part for part in parts if part.id not in gone] + came.get(code, [])
            ground = [
                self._piece(name).ground[code] for name in base.surface.names if str(code) in new[name].ground
            ]
            rows = np.concatenate([np.empty((0, ROW)), *ground])
            self._put(cell, base.smallest(cell, rows, parts, np.empty((0, SLICE_ROW))), handed)
        for level in range(depth - 1, -1, -1):
            for x, y in sorted({(x // 2, y // 2) for below, x, y in handed if below == level + 1}):
                cell = level, x, y
                children = dict(self._children(cell, handed))
                self._put(cell, base.coarse(cell, children) if children else None, handed)
                if children and cell not in self._tree:
                    raise InputError(f"cell {cell}: has neither ground nor buildings; run again")

    def _children(self, cell: Cell, handed: Mapping[Cell, Made | None]) -> Iterator[tuple[tuple[int, int], Made]]:
        level, x, y = cell
        for row, column in product((0, 1), (0, 1)):
            child = level + 1, 2 * x + column, 2 * y + row
            self._kept.release(child)
            made = handed[child] if child in handed else self._kept.read_cell(child)
            if made is not None:
                yield (column, row), made

    def _put(self, cell: Cell, content: Content | None, handed: dict[Cell, Made | None]) -> None:
        """Write a cell, or take it away, and note whether it hands up something else than before."""
        self._made += 1
        path, before = content_path(self._folder, cell), self._kept.read_handed(cell)
        if content is None:
            path.unlink(missing_ok=True)
            self._kept.remove(cell)
            handed[cell] = None
            self._tree.pop(cell, None)
            return
        if not path.exists() or path.read_bytes() != content.data:
            write_content(self._folder, cell, content.data)
        self._tree[cell] = content.tile
        if self._kept.save(cell, content.made):
            if before is not None and measure_change(before, content.made) < self._merging_level:
                self._kept.hold(cell, before)
            else:
                handed[cell] = content.made

    def _finish(self) -> None:
        """Write tree and root."""
        grid, tree = self._base.grid, self._tree
        if (0, 0, 0) not in tree:
            raise InputError(f"{self._files.directory}: has neither ground nor buildings; mesh the region again")
        leaves = np.array([[x, y] for level, x, y in tree if level == grid.depth], np.int64)
        codes = np.sort(encode(leaves[:, 0], leaves[:, 1]))
        written = write_tree(self._folder, codes, grid.depth, lambda cell, _: (tree[cell], None))
        roots = {subtree_path(self._folder, cell) for cell in tree if cell[0] % SUBTREE_LEVELS == 0}
        for path in set(self._folder.glob("subtrees/*/*/*.subtree")) - roots:
            path.unlink()
        write_root(self._folder, written, self._base)


def _differing(before: Mapping[str, object], after: Mapping[str, object]) -> set[str]:
    """Give the keys whose values differ."""
    return {key for key in before.keys() | after.keys() if before.get(key) != after.get(key)}
