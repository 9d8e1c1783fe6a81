"""Stages of generalised blocks in zones of detail: which cells are replaced, and by what (step 1.2)."""

from collections.abc import Iterator
from itertools import islice, pairwise

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints, number_ids, take_footprints
from pipeline.data.errors import InputError
from pipeline.data.notes import Note
from pipeline.data.roof_forms import block_forms, no_forms
from tiler.config.config import Config
from tiler.config.zone_levels import find_levels
from tiler.config.zones import BLOCKS, LEVELS
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.footprints.footprint_index import FootprintBlock, block_footprints
from tiler.footprints.model_places import ModelPlaces, give_way
from tiler.footprints.plan_shapes import scan_shapes
from tiler.objects.places import place
from tiler.stages.readers import extent_of, hull, own_notes, put_rows, read_outlines
from tiler.store.run_folder import CELLS_REPLACED
from tiler.vectors.features import to_objects
from tiler.vectors.lengths import number_of

CELLS, BLOCK_ROWS = "block-cells", "blocks"  # stages; the first is also the layer of cells
LAYERS = {"0C": "lod0c", "0B": "lod0b", "0A": "lod0a"}  # of `citystitch generalise`
BATCH = 5000  # rows that are held at once
Row = tuple[shapely.Geometry, str, float, NDArray[np.float64]]  # outline, id, height (m) and form
OPTION = "generalised"


def block_stages(config: Config) -> list[Stage]:
    """Stages of the cells at a level of blocks, and of the blocks in them; none without zones or blocks."""
    if not config.has_blocks:
        return []
    parameters = ("generalised", "generalised_identity", "zones")
    return [
        Stage(CELLS, Scope.REGION, read_cells, (), parameters),
        Stage(BLOCK_ROWS, Scope.REGION, read_blocks, (Read(CELLS),), parameters),
    ]


def read_cells(task: Task) -> Facts:
    """Read the cells whose representative point lies in a zone of blocks.

    A cell is at level 0A where all cells of its block are; where they are not, it is at 0B. The id of a row is its
    level, point and id with spaces between them.
    """
    zones, level, parent = task.parameters.zones, dict[str, int](), dict[str, str]()
    for _, geometry, (name, above) in _scan(task, "cells", ["id", "parent"]):
        if str(name) in level:
            raise InputError(f"{task.parameters.generalised}: two cells are called {name}; make the file anew")
        point = geometry.representative_point()
        level[str(name)] = int(find_levels(zones, np.array([[point.x, point.y]]))[0])
        parent[str(name)] = str(above or "")
    top = LEVELS.index("0A")
    torn = {parent[name] for name, found in level.items() if found != top and parent[name]}
    level = {name: top - 1 if k == top and parent[name] in torn else k for name, k in level.items()}

    def rows() -> Iterator[Row]:
        for _, geometry, (name,) in _scan(task, "cells", ["id"]):
            found = LEVELS[level[str(name)]]
            if found in BLOCKS:
                point = geometry.representative_point()
                yield geometry, f"{found} {point.x!r} {point.y!r} {name}", np.nan, no_forms(1)[0]

    facts = put_rows(task, _pack(task, rows()), "")
    if not facts["n"]:
        name = place(task.parameters.generalised).name
        task.note(Note("no-cells-in-zones", name, detail="no building is replaced: is it of another place?"))
    return facts | {"counts": {CELLS_REPLACED: facts["n"]}}


def read_blocks(task: Task) -> Facts:
    """Read the blocks of these cells, each with the level and the point of its cell."""
    points: dict[str, dict[str, tuple[float, float]]] = {level: {} for level in BLOCKS}
    (found,) = task.read(CELLS, ())
    arrays = task.store.read(CELLS, found.name, names=("id", "id_end"))[0] if found.facts["n"] else {}
    letters, ends = (arrays.get(name, np.empty(0, np.int64)) for name in ("id", "id_end"))
    text = letters.tobytes()
    for first, last in pairwise([0, *ends.tolist()]):
        level, x, y, name = text[first:last].decode().split(" ", 3)
        points[level][name] = float(x), float(y)

    seen: dict[str, set[str]] = {level: set() for level in BLOCKS}

    def rows() -> Iterator[Row]:
        for level in (level for level in BLOCKS if points[level]):
            for subject, geometry, (name, height, cell) in _scan(task, LAYERS[level], ["id", "height", "cell"]):
                at, metres = points[level].get(str(cell)), number_of(height)
                if at is None:
                    continue
                if not metres > 0:
                    raise InputError(f"{subject}: a height of {height} m; above 0 expected, mend or remove it")
                seen[level].add(str(name) if level == "0A" else str(cell))
                yield geometry, str(name), metres, block_forms(LEVELS.index(level), *at)

    facts = put_rows(task, _pack(task, rows()), "")
    _refuse_bare_cells(task, points, seen)
    return facts


def _refuse_bare_cells(
    task: Task, points: dict[str, dict[str, tuple[float, float]]], seen: dict[str, set[str]]
) -> None:
    """Raise InputError if a cell whose buildings are left out has nothing that stands for them."""
    for _, _, (name, above, members) in _scan(task, "cells", ["id", "parent", "members"]):
        for level in BLOCKS:
            wanted = str(above) if level == "0A" else str(name)
            if str(name) in points[level] and not number_of(members) == 0 and wanted not in seen[level]:
                raise InputError(
                    f"{task.parameters.generalised}: cell {name} has buildings, and layer {LAYERS[level]} nothing "
                    "that stands for them; make the file anew with citystitch generalise"
                )


def replace_by_blocks(task: Task, footprints: Footprints) -> tuple[Footprints, int]:
    """Put blocks in the place of the footprints of a tile whose point lies in a cell that has some.

    Of others, the place that blocks have is taken, as buildings of a city model do beside footprints.

    Returns
    -------
    Footprints
        What meets the tile.
    int
        Footprints that are gone, with their point in the tile.
    """
    around = hull(task.box, extent_of(footprints.polygons))
    cells = read_outlines(task, around, stage=CELLS).polygons
    points = shapely.point_on_surface(footprints.polygons)
    replaced = np.zeros(len(footprints.ids), np.bool_)
    replaced[shapely.STRtree(cells).query(points, predicate="intersects")[0]] = True
    blocks = read_outlines(task, around, stage=BLOCK_ROWS)
    bounds = task.context.bounds
    places = ModelPlaces(blocks.polygons, np.sort(number_ids(blocks.ids)))
    left, notes = give_way(take_footprints(footprints, ~replaced), places, bounds)
    task.notes(own_notes(task, notes))
    mine = take_footprints(blocks, shapely.intersects(blocks.polygons, shapely.box(*task.box)))
    gone = shapely.intersects(points[replaced], shapely.box(*task.box))
    joined = Footprints(
        *(
            np.concatenate([getattr(part, name) for part in (mine, left)])
            for name in ("polygons", "ids", "given_height", "forms")
        )
    )
    return joined, int(gone.sum())


def _scan(task: Task, layer: str, names: list[str]) -> Iterator[tuple[str, shapely.Geometry, list[object]]]:
    crs = pyproj.CRS.from_user_input(task.context.crs)
    text = f"{task.parameters.generalised}:{layer}"
    return scan_shapes(text, names, OPTION, crs=crs, bounds=task.context.bounds)


def _pack(task: Task, rows: Iterator[Row]) -> Iterator[FootprintBlock]:
    """Pack the rows that meet the region, some thousand at a time."""
    here = shapely.box(*task.context.bounds)
    near = (row for row in rows if shapely.box(*row[0].bounds).intersects(here))
    while batch := list(islice(near, BATCH)):
        polygons, ids, heights, forms = zip(*batch, strict=True)
        found = Footprints(to_objects(list(polygons)), np.array(ids, np.str_), np.array(heights), np.array(forms))
        yield block_footprints(found, ())
