"""Subtrees of implicit tiling: which tiles, contents and further subtrees there are, and metadata of each tile.

References
----------
OGC 22-025r4, 3D Tiles 1.1, https://docs.ogc.org/cs/22-025r4/22-025r4.html, implicit tiling and metadata.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.store.atomic import replacing
from tiler.tiles3d.cells import Cell
from tiler.tiles3d.content import Region
from tiler.tiles3d.metadata import Blob, add_table, describe_class, frame_chunks

TILESET = "tileset.json"
SUBTREE_LEVELS = 5
TILE_CLASS = "tile"
SEMANTICS = {"region": "TILE_BOUNDING_REGION", "error": "TILE_GEOMETRIC_ERROR"}


@dataclass(frozen=True)
class Tile:
    """What the tree tells of a tile: the region of it and all below it, its error (m), whether it has content."""

    region: Region
    error: float
    content: bool


# Makes a tile, given its cell and what was made of its children, by column and row; and what its parent is given.
Make = Callable[[Cell, Mapping[tuple[int, int], Any]], tuple[Tile, Any]]


@dataclass(frozen=True)
class Tree:
    """What is known of a whole tree: the root's region, the root's error (m) for all levels, and the tiles."""

    region: Region
    error: float
    tiles: int


def write_tree(folder: Path, leaves: NDArray[np.int64], depth: int, make: Make) -> Tree:
    """Make the tiles of a quadtree from below, and write its subtrees, each when its last tile is made.

    Parameters
    ----------
    folder : Path
        Folder of the tileset; subtrees are ``subtrees/{level}/{x}/{y}.subtree`` in it.
    leaves : int64, (n,)
        The smallest tiles by ascending `encode`, at least one.
    depth : int
        Their level.
    make : callable
        Makes a tile.

    Returns
    -------
    Tree
        Its ``error``, halved from level to level, is nowhere less than that of a tile: what readers take that do
        not read metadata.

    Notes
    -----
    Memory: the leaves, the tiles of one subtree on each way down, and what `make` gives for each child on it.
    """
    walk = _Walk(folder, leaves, depth, make)
    tile, _ = walk.visit((0, 0, 0), 0, 0, len(leaves), {})
    return Tree(tile.region, walk.root_error, walk.tiles)


class _Walk:
    def __init__(self, folder: Path, leaves: NDArray[np.int64], depth: int, make: Make) -> None:
        self._folder, self._leaves, self._depth, self._make = folder, leaves, depth, make
        self.root_error, self.tiles = 0.0, 0

    def visit(
        self, cell: Cell, code: int, first: int, last: int, subtree: dict[tuple[int, int], Tile]
    ) -> tuple[Tile, Any]:
        """Make a tile, of a code on its level, after those below it; its leaves are rows `first` to `last`."""
        level, x, y = cell
        begins = level % SUBTREE_LEVELS == 0
        own: dict[tuple[int, int], Tile] = {} if begins else subtree
        children, made = [], {}
        for quarter in range(4) if level < self._depth else ():
            shift = 2 * (self._depth - level - 1)
            own_code = 4 * code + quarter
            a, b = first + np.searchsorted(self._leaves[first:last], np.array([own_code, own_code + 1]) << shift)
            if a < b:
                column, row = quarter & 1, quarter >> 1
                child = (level + 1, 2 * x + column, 2 * y + row)
                tile, given = self.visit(child, own_code, int(a), int(b), own)
                children.append(tile)
                made[column, row] = given
        tile, given = self._make(cell, made)
        boxes = np.array([tile.region, *(child.region for child in children)])
        low, high = boxes.min(axis=0), boxes.max(axis=0)
        region: Region = (*low[:2].tolist(), *high[2:4].tolist(), float(low[4]), float(high[5]))
        tile = Tile(region, max([tile.error, *(child.error for child in children)]), tile.content)
        self.root_error = max(self.root_error, tile.error * 2**level)
        self.tiles += 1
        own[level, code] = tile
        if begins:
            path = subtree_path(self._folder, cell)
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as part:
                part.write_bytes(make_subtree(level, code, own))
            subtree[level, code] = tile  # as a child of the subtree above
        return tile, given


def subtree_path(folder: Path, cell: Cell) -> Path:
    """Give the path of the subtree whose root is a cell."""
    level, x, y = cell
    return folder / f"subtrees/{level}/{x}/{y}.subtree"


def make_subtree(level: int, root: int, tiles: Mapping[tuple[int, int], Tile]) -> bytes:
    """Make a binary subtree.

    Parameters
    ----------
    level, root : int
        Level of its root, and the code of that there, as `encode` gives it.
    tiles : mapping of (int, int) to Tile
        By level and code all tiles of it, and the roots of the subtrees below it.
    """
    found: dict[int, Tile] = {}
    children = np.zeros(4**SUBTREE_LEVELS, np.bool_)
    for (deep, code), tile in tiles.items():
        down = deep - level
        place = code - (root << 2 * down)
        if down == SUBTREE_LEVELS:
            children[place] = True
        else:
            found[(4**down - 1) // 3 + place] = tile
    order = sorted(found)
    own = [found[place] for place in order]
    there, filled = np.zeros((2, (4**SUBTREE_LEVELS - 1) // 3), np.bool_)
    there[order], filled[order] = True, [tile.content for tile in own]
    blob = Blob()
    columns = {
        "region": np.array([tile.region for tile in own], np.float64),
        "error": np.array([tile.error for tile in own], np.float64),
    }
    table = add_table(blob, TILE_CLASS, columns)
    document = {
        "tileAvailability": _availability(blob, there),
        "contentAvailability": [_availability(blob, filled)],
        "childSubtreeAvailability": _availability(blob, children),
        "propertyTables": [table],
        "tileMetadata": 0,
    }
    data = blob.bytes()
    document |= {"buffers": [{"byteLength": len(data)}], "bufferViews": blob.views}
    return frame_chunks(b"subt", json.dumps(document, separators=(",", ":")).encode(), data)


def _availability(blob: Blob, bits: NDArray[np.bool_]) -> dict[str, int]:
    n = int(bits.sum())
    if n in (0, len(bits)):
        return {"constant": int(n > 0), "availableCount": n} if n else {"constant": 0}
    return {"bitstream": blob.add(np.packbits(bits, bitorder="little").tobytes()), "availableCount": n}


def make_tileset(tree: Tree, root: tuple[float, ...], depth: int, extras: Mapping[str, Any]) -> dict[str, Any]:
    """Give ``tileset.json`` of a tree whose root is a box of west, south, east and north (radians)."""
    empty = {"region": np.empty((0, 6)), "error": np.empty(0)}
    low, high = tree.region[4:]
    return {
        "asset": {"version": "1.1", "generator": "citystitch", "extras": dict(extras)},
        "schema": {"id": "citystitch", "classes": {TILE_CLASS: describe_class(empty, **SEMANTICS)}},
        "geometricError": 2 * max(tree.error, high - low),
        "root": {
            "boundingVolume": {"region": [*root, low, high]},
            "geometricError": tree.error,
            "refine": "REPLACE",
            "content": {"uri": "content/{level}/{x}/{y}.glb"},
            "implicitTiling": {
                "subdivisionScheme": "QUADTREE",
                "availableLevels": depth + 1,
                "subtreeLevels": SUBTREE_LEVELS,
                "subtrees": {"uri": "subtrees/{level}/{x}/{y}.subtree"},
            },
        },
    }
