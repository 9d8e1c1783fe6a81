"""Blocks of `citystitch generalise` for a tileset: cut into the smallest cells, and which house is in which."""

import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely

from pipeline.data.errors import InputError
from tiler.footprints.plan_shapes import scan_shapes
from tiler.objects.places import place
from tiler.stages.blocks import LAYERS
from tiler.tiles3d.cells import CellBuffers, CellGrid, encode
from tiler.tiles3d.terrain import Site
from tiler.vectors.layers import describe_layer, scan_layer
from tiler.vectors.lengths import number_of

OPTION = "--generalised"
AT_ONCE = 1000  # blocks that are cut
COLUMNS = ["id", "parent", "height", "ground_height", "members", "landmark"]


@dataclass(frozen=True)
class Block:
    """An object of LoD0C, LoD0B or LoD0A that stands for several houses."""

    #: its id, and its level, a key of `LAYERS`
    id: str
    level: str
    members: int  #: number of houses
    #: heights of its ground and of its roof (m)
    ground: float
    top: float
    side: float  #: side of a square of its area (m)


Pieces = Mapping[str, tuple[Block, Any]]  # by id: blocks, and their outlines as far as they lie in a cell


class BlockNames:
    """Names of the blocks that each house is in; in a file, as a country has millions.

    Parameters
    ----------
    path : Path
        A file that does not exist.
    """

    def __init__(self, path: Path) -> None:
        self._base = sqlite3.connect(path)
        self._base.execute("PRAGMA journal_mode = OFF")
        self._base.execute("PRAGMA synchronous = OFF")
        self._base.execute("CREATE TABLE own (level, id, parent, PRIMARY KEY (level, id)) WITHOUT ROWID")

    def add(self, level: str, rows: Iterator[tuple[str, str]]) -> None:
        """Add objects of a level, with the one that stands for each one level up."""
        self._base.executemany("INSERT OR REPLACE INTO own VALUES (?, ?, ?)", ((level, *row) for row in rows))

    def find(self, house: str) -> list[str]:
        """List the objects of LoD0C, LoD0B and LoD0A that stand for a house, each once; none if it is unknown."""
        found: list[str] = []
        for level in ("1", *LAYERS)[:-1]:
            key = (level, found[-1] if found else house)
            row = self._base.execute("SELECT parent FROM own WHERE level = ? AND id = ?", key).fetchone()
            if row is None:
                break
            found.append(row[0])
        return list(dict.fromkeys(found))

    def close(self) -> None:
        """Let go of the file."""
        self._base.close()


def deal_blocks(text: str, crs: str, site: Site, grid: CellGrid, buffers: CellBuffers, names: BlockNames) -> None:
    """Deal the blocks of a file out to the smallest cells that they meet, and learn who is in which.

    Parameters
    ----------
    text : str
        GeoPackage of `citystitch generalise`.
    crs : str
        CRS of the run.
    site, grid
        Region and cells.
    buffers : CellBuffers
        Takes lines that `load_pieces` reads.
    names : BlockNames
        Takes the names.

    Raises
    ------
    ConfigError, InputError
        If the file cannot be read, is another one, or states no ground.

    Notes
    -----
    The file is read once a layer, some thousand objects at a time.
    """
    houses = describe_layer(place(text), "lod1")
    names.add(
        "1",
        (
            (str(name), str(above))
            for rows in scan_layer(houses, COLUMNS[:2], None, geometry=False)
            for name, above in zip(rows.columns["id"], rows.columns["parent"], strict=True)
        ),
    )
    west, south, east, north = site.bounds
    bounds = west, south, east, north
    for level, layer in LAYERS.items():
        some = scan_shapes(f"{text}:{layer}", COLUMNS, OPTION, crs=pyproj.CRS.from_user_input(crs), bounds=bounds)
        while rows := list(islice(some, AT_ONCE)):
            names.add(level, ((str(name), str(above or "")) for _, _, (name, above, *_) in rows))
            blocks = [found for row in rows if (found := _read_block(level, *row)) is not None]
            _deal(blocks, site, grid, buffers)
    buffers.flush()


def _read_block(level: str, subject: str, outline: Any, values: Sequence[Any]) -> tuple[Block, Any] | None:
    """Read an object of a level; None where it is a house as it is."""
    name, _, height, ground, members, landmark = values[0], *map(number_of, values[1:])
    if members <= 1 or landmark:
        return None
    if not (height > 0 and math.isfinite(ground)):
        raise InputError(
            f"{subject}: a height of {height:g} m above ground at {ground:g} m; both are needed: make the file of "
            "the run, citystitch generalise RUN"
        )
    return Block(str(name), level, int(members), ground, ground + height, outline.area**0.5), outline


def _deal(blocks: Sequence[tuple[Block, Any]], site: Site, grid: CellGrid, buffers: CellBuffers) -> None:
    last = 2**grid.depth - 1
    outlines = np.array([outline for _, outline in blocks], np.object_)
    corners = shapely.bounds(outlines)[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2)
    lon, lat, _ = site.globe.geographic(np.column_stack((corners, np.zeros(len(corners))))).T
    x, y = grid.columns_and_rows(lon, lat)
    for (block, outline), xs, ys in zip(blocks, x.reshape(-1, 4), y.reshape(-1, 4), strict=True):
        # A box of the CRS is no box on the globe: one cell more on each side holds it.
        near = [np.arange(max(some.min() - 1, 0), min(some.max() + 1, last) + 1) for some in (xs, ys)]
        columns, rows = (some.ravel() for some in np.meshgrid(*near))
        boxes = np.array([grid.box((grid.depth, a, b)) for a, b in zip(columns, rows, strict=True)]).reshape(-1, 4)
        places = site.globe.plan(boxes[:, [0, 2, 2, 0]].ravel(), boxes[:, [1, 1, 3, 3]].ravel())
        pieces = shapely.intersection(outline, shapely.polygons(places.reshape(-1, 4, 2)))
        for cell, piece in zip(encode(columns, rows).tolist(), pieces, strict=True):
            if piece.area > 0:
                line = json.dumps([*vars(block).values(), shapely.to_wkb(take_areas(piece), hex=True)])
                buffers.add(cell, (line + "\n").encode())


def take_areas(geometry: Any) -> Any:
    """Take the areas of an intersection or a difference, without lines and points."""
    parts = shapely.get_parts(geometry)
    return shapely.multipolygons(parts[shapely.area(parts) > 0])


def load_pieces(data: bytes) -> Pieces:
    """Read the lines of a cell."""
    found: dict[str, tuple[Block, Any]] = {}
    for line in data.splitlines():
        *values, outline = json.loads(line)
        block = Block(*values)
        # An object that is the same at several levels is of the lowest.
        found.setdefault(block.id, (block, shapely.from_wkb(outline)))
    return found


def join_pieces(parts: Sequence[Pieces], least: float, step: float) -> Pieces:
    """Join the pieces in the cells below to those of a cell; of blocks whose side is more than `least` (m)."""
    own: dict[str, list[Any]] = {}
    blocks: dict[str, Block] = {}
    for part in parts:
        for name, (block, outline) in part.items():
            if block.side > least:
                own.setdefault(name, []).append(outline)
                blocks[name] = block
    return {name: (blocks[name], shapely.union_all(own[name], grid_size=step)) for name in sorted(own)}
