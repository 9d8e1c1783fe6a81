"""Stages of land cover: polygons of the region once, and those around each tile."""

from collections.abc import Iterator

import numpy as np
import pyproj

from pipeline.data.citymodel import Footprints
from pipeline.data.errors import InputError
from tiler.citymodels.tables import pack_polygons, unpack_polygons
from tiler.config.config import Config
from tiler.engine.stage import Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.footprints.footprint_index import FootprintBlock, block_footprints
from tiler.landcover.cover_files import scan_cover
from tiler.landcover.cover_table import CoverRow
from tiler.landcover.water import water_stages
from tiler.landcover.water_points import WET
from tiler.objects.places import place
from tiler.stages.readers import grow, put_rows, read_rows
from tiler.stages.surroundings import COVERED, rows_of_cover

COVER = "cover"
TOLERANCE = 0.5  # clearances; by which outlines are simplified


def cover_file_stages(config: Config) -> list[Stage]:
    """Stage of the polygons of the region; none without files."""
    names = ("land_cover", "land_cover_identity", "land_cover_field", "cover_table", "clearance")
    wet = (Read(WET),) if config.water_points else ()
    return [Stage(COVER, Scope.REGION, read_cover, wet, names)] if config.covered else []


def cover_stages(config: Config) -> list[Stage]:
    """Stages from the polygons of the region to what is meshed; none without files."""
    if not config.covered:
        return []
    return [Stage(COVERED, Scope.TILE, take_cover, (Read(COVER),), ("cover_reach",)), *water_stages(config)]


def read_cover(task: Task) -> Facts:
    """Read the polygons of all files whose class the table knows, and deal them out to cells."""
    given = task.parameters
    table = [CoverRow(*row) for row in given.cover_table]
    rows = {word: k for k, row in enumerate(table, 1) for word in row.classes}

    def scan() -> Iterator[FootprintBlock]:
        for path in given.land_cover:
            yield from scan_cover(
                place(path),
                crs=pyproj.CRS.from_user_input(task.context.crs),
                bounds=task.context.bounds,
                field=given.land_cover_field,
                rows=rows,
                tolerance=TOLERANCE * given.clearance,
            )
        if WET in task.refs:
            row = next(k for k, row in enumerate(table, 1) if row.level)
            for result in task.read(WET):
                polygons = unpack_polygons(result.arrays, "outline")
                ids = np.array([f"{row:03d}-{name}" for name in result.arrays["names"].tolist()], np.str_)
                yield block_footprints(Footprints(polygons, ids, np.full(len(ids), np.nan)), [])

    facts = put_rows(task, scan(), "")
    if not facts["n"] and given.land_cover:
        raise InputError(
            f"{', '.join(given.land_cover)}: no polygon of a known class in the region; its attribute "
            f"{given.land_cover_field} must be one of the table's words, as {', '.join(list(rows)[:5])}: give "
            "--land-cover-field, --land-cover-table, or leave --land-cover out"
        )
    return {"n": facts["n"], "counts": {"land cover polygons": facts["n"]}}


def take_cover(task: Task) -> Facts:
    """Take the polygons that count for a tile and its seams; each once."""
    found = read_rows(task, grow(task.box, task.parameters.cover_reach), stage=COVER)
    _, kept = rows_of_cover(found.ids)
    task.put(**pack_polygons(found.polygons[kept], "outline"), ids=found.ids[kept], level=found.given_height[kept])
    return {"n": len(kept)}
