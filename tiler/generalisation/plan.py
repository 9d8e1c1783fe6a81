"""The plan of a generalisation: how long it takes, and how much memory, by where its buildings are."""

from collections import Counter

import numpy as np
import shapely

from tiler.generalisation.buildings import open_buildings
from tiler.generalisation.options import Asked, Inputs
from tiler.generalisation.shards import Tile, around, by_tile
from tiler.generalisation.summary import Told

# Measured (docs/generalisation.md): processor time of all steps, and memory of a process with tiles of 1 km.
SECONDS = (0.35, 0.00075)  # a km² with buildings, and a building
BYTES = (260e6, 5e3)  # of a process, and of a building in a tile and its neighbours
KEPT = 2.6e3  # bytes of a tile in the first process


def plan_generalisation(inputs: Inputs, asked: Asked) -> list[str]:
    """Count the buildings by tiles, and forecast time and memory; gives lines. Errors as of `generalise`.

    All buildings are read, some thousand at a time; barriers are not.
    """
    told, count = Told(), Counter[Tile]()
    with open_buildings(inputs, asked, told) as source:
        for batch in source.batches:
            middle = shapely.get_coordinates(shapely.point_on_surface(batch.outlines))
            for tile, rows in by_tile(np.floor(middle / asked.tile_size).astype(np.int64)):
                count[tile] += len(rows)
    n, most = sum(count.values()), max((sum(count[near] for near in around(tile)) for tile in count), default=0)
    area = len(count) * (asked.tile_size / 1000) ** 2
    seconds = SECONDS[0] * area + SECONDS[1] * n
    process = BYTES[0] + BYTES[1] * most
    return [
        *told.lines(),
        f"{n:,} buildings in {len(count):,} tiles of {asked.tile_size:g} m, {most:,} at most in one and around it",
        f"tasks: {6 * len(count):,}, some {seconds:,.0f} s of processor time",
        f"memory: some {process / 1e6:,.0f} MB a process, and {KEPT * len(count) / 1e6:,.1f} MB more in the first "
        "for all tiles; open land without barriers is one cell, which is not foreseen",
    ]
