"""How far city models are moved up or down onto the rasters of terrain: --shift-z auto."""

import hashlib
import heapq
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.notes import Note
from tiler.cityinput.faces import ModelBuilding
from tiler.cityinput.rasters import sample_heights
from tiler.cityinput.rows import ModelRows, join_rows, make_rows
from tiler.cityinput.sources import MODEL, TERRAIN, scan_model
from tiler.config.config import AUTO, Config
from tiler.planning.plan import Plan
from tiler.pointclouds.clouds import CloudHeader

SAMPLE = 2000  # buildings of a file that are looked at
ROUNDING = 1  # decimals of the shift (m)


def resolve_shift(config: Config, plan: Plan, say: Callable[[str], None]) -> tuple[Config, Plan]:
    """Measure the shift of the city models where it is asked for, and say what was found.

    Gives parameters with the shift in metres, and a plan with a note of kind ``model-shifted``. InputError if no
    building of a model stands on a raster.

    Notes
    -----
    The shift is the median of terrain minus feet over buildings that are chosen by their ids: the foot is the
    lowest height of a building's faces, the terrain the lowest cell of a raster at a corner of its outline. It
    does not depend on tiles or workers, and a run that is taken up again finds the same.
    """
    if config.shift_z != AUTO:
        return config, plan
    models, rasters = ([one for one in plan.clouds if one.kind == kind] for kind in (MODEL, TERRAIN))
    near = shapely.box(*plan.region.bounds)
    rows = join_rows([_sample(one, config) for one in models])
    inside = np.isfinite(rows.base) & shapely.intersects(near, rows.outlines)
    off = _ground_at(rows, rasters)[inside] - rows.base[inside]
    off = off[np.isfinite(off)]
    if not len(off):
        raise InputError(f"--shift-z {AUTO}: no building stands on a raster of terrain; give it in metres")
    shift = round(float(np.median(off)), ROUNDING) + 0.0
    told = f"{shift:+.{ROUNDING}f} m onto the terrain, as measured at {len(off)} buildings"
    text = f"city models were moved by {told}"
    say(text)
    plan.messages.append(text)
    notes = [*plan.georeference.notes, Note("model-shifted", models[0].path.name, detail=text)]
    moved = replace(plan, georeference=replace(plan.georeference, notes=notes))
    return replace(config, shift_z=shift), moved


def _sample(header: CloudHeader, config: Config) -> ModelRows:
    """Read the buildings of a file whose ids have the least hashes, as rows."""
    kept: list[tuple[int, int, ModelBuilding]] = []
    for k, each in enumerate(scan_model(header.path)):
        if not isinstance(each, ModelBuilding):
            continue
        digest = hashlib.blake2b(each.id.encode(), digest_size=8).digest()
        entry = -int.from_bytes(digest), -k, each  # the numbers differ, so buildings are not compared
        if len(kept) < SAMPLE:
            heapq.heappush(kept, entry)
        elif entry[:2] > kept[0][:2]:
            heapq.heapreplace(kept, entry)
    rows, _ = make_rows([each for _, _, each in sorted(kept)], header.frame, config.lod, Counter())
    return rows


def _ground_at(rows: ModelRows, rasters: Sequence[CloudHeader]) -> NDArray[np.float64]:
    """Lowest height of rasters at the corners of each building; NaN off all of them."""
    xy, row = shapely.get_coordinates(rows.outlines, return_index=True)
    z = np.full(len(xy), np.nan)
    for one in rasters:
        bare = np.isnan(z)
        z[bare] = sample_heights(one.path, one.frame, xy[bare])
    lowest = np.full(len(rows), np.inf)
    np.minimum.at(lowest, row, np.where(np.isnan(z), np.inf, z))
    return np.where(np.isfinite(lowest), lowest, np.nan)
