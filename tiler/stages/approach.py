"""Terrain of a region and its pad: that of the region, and outside of it the ground that flattens outwards."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.points_terrain.approach import Border, approach_terrain, border_nodes, make_border
from pipeline.points_terrain.raster import NodeWindow, cut_nodes, grow_window, node_window, window_of
from tiler.config.config import Config
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.stages.inputs import own_window
from tiler.stages.readers import join_rasters
from tiler.stages.surroundings import LEVELLED
from tiler.store.store import Store

APPROACH, RIM = "approach", "rim"


def approach_stages(config: Config) -> list[Stage]:
    """Stages from the terrain of the region to that of region and pad; none without a pad."""
    if not config.padded:
        return []
    parameters = ("core_bounds", "dtm_spacing")
    reads = (Read(RIM), Read("terrain", 2 * config.dtm_spacing))
    return [
        Stage(RIM, Scope.REGION, find_rim, (Read("terrain"),), parameters),
        Stage(APPROACH, Scope.TILE, lay_approach, reads, parameters),
    ]


def known_rim() -> Stage:
    """Stage that takes the rim of another run, of the whole region, for one of its tiles alone."""
    return Stage(RIM, Scope.REGION, take_rim, (), ("rim_store", "rim_digest"))


def terrain_stage(config: Config) -> str:
    """Name of the stage that has the terrain of all that is meshed, with level water where there is land cover."""
    return LEVELLED if config.covered else ground_stage(config)


def ground_stage(config: Config) -> str:
    """Name of the stage that has the terrain of region and pad as points and pad make it."""
    return APPROACH if config.padded else "terrain"


def find_rim(task: Task) -> Facts:
    """Find the terrain along the border of the region, and the height at which the pad ends."""
    window = node_window(task.parameters.core_bounds, task.parameters.dtm_spacing)
    nodes = border_nodes(window)
    z = np.full(len(nodes), np.nan)
    inner = _within(window)
    for result in task.read("terrain", ()):
        part = NodeWindow(*(result.facts[name] for name in ("i0", "j0", "nx", "ny")))
        if grow_window(part, 0, within=inner) != part:
            arrays, _ = task.store.read("terrain", result.name, names=("z",))
            _take_nodes(z, nodes, arrays["z"], part)
    border = make_border(z, window)
    task.put(z=border.z)
    return {"rim": border.rim, "counts": {"border nodes without terrain": int(np.isnan(z).sum())}}


def take_rim(task: Task) -> Facts:
    """Take the rim of another run."""
    arrays, attributes = Store(Path(task.parameters.rim_store)).read(RIM, task.name)
    task.put(**arrays)
    facts: Facts = attributes["facts"]
    return facts


def lay_approach(task: Task) -> Facts:
    """Take the terrain of the region, and lay the ground of the pad around it (step 1.3)."""
    given = task.parameters
    spacing, bounds = given.dtm_spacing, task.context.bounds
    window = node_window(given.core_bounds, spacing)
    (rim,) = task.read(RIM)
    border = Border(rim.arrays["z"], float(rim.facts["rim"]), window)
    own = own_window(task)
    if grow_window(own, 0, within=_within(window)) == own:
        z = np.full((own.ny, own.nx), np.nan)
    else:
        z = approach_terrain(border, own, node_window(bounds, spacing), spacing=spacing).z
    known = join_rasters(task, "terrain", grow_window(own, 0, within=window), spacing)
    if known.z.size:
        part = cut_nodes(z, own, window_of(known))
        np.copyto(part, known.z, where=~np.isnan(known.z))
    task.put_rasters(z=z)
    return {"i0": own.i0, "j0": own.j0, "nx": own.nx, "ny": own.ny, "spacing": spacing}


def _within(window: NodeWindow) -> NodeWindow:
    """Nodes of a window without the outermost ones."""
    return NodeWindow(window.i0 + 1, window.j0 + 1, window.nx - 2, window.ny - 2)


def _take_nodes(
    z: NDArray[np.float64], nodes: NDArray[np.int64], part: NDArray[np.float64], at: NodeWindow
) -> None:
    """Take the heights of some nodes from a raster, where it has them."""
    i, j = nodes[:, 0] - at.i0, nodes[:, 1] - at.j0
    there = (i >= 0) & (i < at.nx) & (j >= 0) & (j < at.ny)
    z[there] = part[j[there], i[there]]
