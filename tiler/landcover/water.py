"""Water at one height: levels of bodies over the whole region, and the terrain with them."""

from collections import Counter
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.notes import Note
from pipeline.geometry.components import join_pairs
from pipeline.geometry.inside import find_inside
from pipeline.points_terrain.raster import HEIGHT_UNIT
from stitch.tiling.grid import Bounds
from tiler.citymodels.tables import unpack_polygons
from tiler.config.config import Config
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.stages.approach import ground_stage
from tiler.stages.surroundings import COVERED, LEVELLED, patch_of_ids
from tiler.store.store import Store

WATER, LEVELS = "water", "levels"
SHARE = 0.05  # of the terrain's nodes in a body; the height below which so many lie is its level
STEP = 0.01  # m; heights are counted in
BANK = 1.5  # spacings of the terrain around a body that are level, too: so all places in it are
TOUCHING = 0.01  # m; water that is this close is one body


def water_stages(config: Config) -> list[Stage]:
    """Stages from the terrain to that with level water; none without land cover."""
    if not config.covered:
        return []
    ground = ground_stage(config)
    parameters = ("dtm_spacing", "cover_table", *(("core_bounds",) if config.padded else ()))
    reads = (Read(ground, own=True), Read(COVERED, own=True))
    return [
        Stage(WATER, Scope.TILE, measure_water, reads, parameters),
        Stage(LEVELS, Scope.REGION, find_levels, (Read(WATER),)),
        Stage(LEVELLED, Scope.TILE, level_water, (*reads, Read(LEVELS)), parameters),
    ]


def known_levels() -> Stage:
    """Stage that takes the levels of another run, of the whole region, for one of its tiles alone."""
    return Stage(LEVELS, Scope.REGION, take_levels, (), ("levels_store", "levels_digest"))


def measure_water(task: Task) -> Facts:
    """Count the heights of the terrain in each polygon of water at a tile, and find which of these touch."""
    ids, polygons, declared = _read_water(task)
    (ground,) = (result for name in task.refs if name not in (COVERED, LEVELS) for result in task.read(name))
    xy, z = _nodes(ground.arrays["z"], ground.facts), ground.arrays["z"].ravel()
    polygon, node = find_inside(xy, polygons, among=~np.isnan(z) & _in_core(task, xy))
    step = np.rint(z[node] / STEP).astype(np.int64)
    pairs, count = np.unique(np.stack((polygon, step), axis=1), axis=0, return_counts=True)
    one, two = shapely.STRtree(polygons).query(polygons, predicate="dwithin", distance=TOUCHING)
    task.put(
        ids=ids,
        declared=declared,
        of=pairs[:, 0],
        step=pairs[:, 1],
        count=count,
        touching=np.stack((one, two), axis=1)[one < two].reshape(-1, 2),
    )
    return {"n": len(ids)}


def find_levels(task: Task) -> Facts:
    """Find the level of each body of water, of polygons that touch: declared, or a low share of its heights.

    Of several declared levels of a body the lowest counts, and is told.
    """
    number: dict[str, int] = {}
    pairs, steps = set[tuple[int, int]](), Counter[tuple[int, int]]()
    declared: dict[int, float] = {}
    for result in task.read(WATER):
        arrays = result.arrays
        mine = [number.setdefault(name, len(number)) for name in arrays["ids"].tolist()]
        pairs |= {(mine[a], mine[b]) for a, b in arrays["touching"].tolist()}
        declared |= {mine[k]: v for k, v in enumerate(arrays["declared"].tolist()) if np.isfinite(v)}
        rows = zip(*(arrays[name].tolist() for name in ("of", "step", "count")), strict=True)
        steps.update({(mine[k], step): n for k, step, n in rows})
    body = join_pairs(len(number), np.array(sorted(pairs), np.int64).reshape(-1, 2))
    heights: dict[int, Counter[int]] = {}
    for (k, step), n in steps.items():
        heights.setdefault(int(body[k]), Counter())[step] += n
    given: dict[int, set[float]] = {}
    for k, value in declared.items():
        given.setdefault(int(body[k]), set()).add(value)
    level = {one: _low(counts) for one, counts in heights.items()} | {one: min(v) for one, v in given.items()}
    names = sorted(name for name, k in number.items() if int(body[k]) in level)
    found = np.array([level[int(body[number[name]])] for name in names], np.float64)
    task.put(ids=np.array(names, np.str_), level=np.rint(found / HEIGHT_UNIT) * HEIGHT_UNIT)
    for values in given.values():
        if len(values) > 1:
            detail = f"its polygons state {', '.join(f'{v:g}' for v in sorted(values))} m: the lowest counts"
            task.note(Note("water-levels-differ", detail=detail))
    bodies = {int(body[number[name]]) for name in names}
    return {"counts": {"bodies of water": len(bodies), "bodies of water with a declared level": len(given)}}


def take_levels(task: Task) -> Facts:
    """Take the levels of another run."""
    arrays, attributes = Store(Path(task.parameters.levels_store)).read(LEVELS, task.name)
    task.put(**arrays)
    facts: Facts = attributes["facts"]
    return facts


def level_water(task: Task) -> Facts:
    """Give the nodes of a tile's terrain in water, and next to it, the level of their body; the lowest counts."""
    ids, polygons, _ = _read_water(task)
    (levels,) = (result.arrays for result in task.read(LEVELS))
    (ground,) = (result for name in task.refs if name not in (COVERED, LEVELS) for result in task.read(name))
    facts = {name: ground.facts[name] for name in ("i0", "j0", "nx", "ny", "spacing")}
    known = dict(zip(levels["ids"].tolist(), levels["level"].tolist(), strict=True))
    rows = np.array([k for k, name in enumerate(ids.tolist()) if name in known], np.int64)
    level = np.array([known[ids[k]] for k in rows.tolist()], np.float64)
    z = ground.arrays["z"]
    xy, new = _nodes(z, facts), z.ravel().copy()
    among = ~np.isnan(new) & _in_core(task, xy)
    # Nodes in a body are of it; those beside are of the lowest that is near.
    for areas in (shapely.buffer(polygons[rows], BANK * facts["spacing"]), polygons[rows]):
        polygon, node = find_inside(xy, areas, among=among)
        lowest = np.full(len(xy), np.inf)
        np.minimum.at(lowest, node, level[polygon])
        new = np.where(np.isinf(lowest), new, lowest)
    changed = int((new != z.ravel())[among].sum())
    task.put_rasters(z=new.reshape(z.shape))
    return facts | {"counts": {"terrain nodes in water": changed}}


def _read_water(task: Task) -> tuple[NDArray[np.str_], NDArray[np.object_], NDArray[np.float64]]:
    """Ids, polygons and declared levels (m) of the water around a tile, which is what the table says is level."""
    (found,) = (result.arrays for result in task.read(COVERED))
    is_level = np.array([False, *(row[2] for row in task.parameters.cover_table)])
    rows = np.flatnonzero(is_level[patch_of_ids(found["ids"])])
    return found["ids"][rows], unpack_polygons(found, "outline", rows), found["level"][rows]


def _nodes(z: NDArray[np.float64], facts: Facts) -> NDArray[np.float64]:
    """Places of the nodes of a raster (m), (n, 2), row by row."""
    ny, nx = z.shape
    x, y = (np.arange(n) + facts[first] for n, first in ((nx, "i0"), (ny, "j0")))
    return np.stack(np.meshgrid(x * facts["spacing"], y * facts["spacing"]), axis=-1).reshape(-1, 2)


def _in_core(task: Task, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether places are in the region without its pad."""
    core: Bounds | None = task.parameters.get("core_bounds", None)
    if core is None:
        return np.ones(len(xy), np.bool_)
    low, high = np.array(core[:2]), np.array(core[2:])
    inside: NDArray[np.bool_] = np.all((xy >= low) & (xy <= high), axis=1)
    return inside


def _low(counts: Counter[int]) -> float:
    """Height below which a low share of the nodes lies (m).

    Examples
    --------
    >>> _low(Counter({100: 1, 120: 30, 300: 5}))
    1.2
    """
    steps = np.array(sorted(counts), np.int64)
    total = np.cumsum([counts[step] for step in steps.tolist()])
    return float(steps[np.searchsorted(total, SHARE * total[-1])] * STEP)
