"""Stages that measure how far footprints lie beside the roofs of the point cloud, and the shift that fits best."""

import hashlib
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.classes import BUILDING, GROUND
from pipeline.data.errors import InputError
from pipeline.data.notes import Note
from pipeline.geometry.inside import cover_polygons
from pipeline.points_terrain.alignment import (
    LEAST_HOUSES,
    REACH,
    SIDE,
    STEP,
    TOLD,
    best_shift,
    describe_shift,
    score_shifts,
)
from tiler.config.config import Config
from tiler.engine.records import Records
from tiler.engine.run_context import find_owned
from tiler.engine.stage import REGION_ITEM, Box, Facts, Read, Scope, Stage
from tiler.engine.task import Task
from tiler.stages.inputs import halo_of_points
from tiler.stages.readers import extent_of, grow, read_cloud, read_outlines, read_own_outlines
from tiler.store.out_folder import STORE
from tiler.store.store import Store

SAMPLE = 24  # footprints of a tile that are looked at
LEAST_AREA, MOST_AREA = 20.0, 4000.0  # m2, of such a footprint
AROUND = 50.0  # m around a tile, within which such a footprint lies
MISALIGNED = "footprints-misaligned"


def alignment_stages(config: Config) -> list[Stage]:
    """Stages from points and footprints to the shift of the region."""
    reach = halo_of_points(config, AROUND + REACH + 2 * STEP)
    # The footprints of a tile do not change when others do; with --align they wait for what is measured here.
    footprints = Read("footprints") if config.align else Read("outlines", own=True)
    reads = (footprints, Read("points", reach))
    return [
        Stage("alignment", Scope.TILE, score_tile, reads, ("ground_filter",), version=2),
        Stage("shift", Scope.REGION, find_shift, (Read("alignment", optional=True),)),
    ]


def score_tile(task: Task) -> Facts:
    """Score shifts of some footprints of a tile."""
    polygons = _sample(task)
    areas = shapely.buffer(shapely.envelope(polygons), REACH + 2 * STEP, cap_style="square", join_style="mitre")
    extent = extent_of(areas)
    if extent is None:
        return {"houses": 0, "roof_points": 0}
    cover = cover_polygons(areas)
    cloud = read_cloud(
        task,
        extent,
        classes=(GROUND, BUILDING),
        ground_filter=task.parameters.ground_filter,
        cover=cover,
    )
    scores, n_roof = score_shifts(polygons, cloud.xyz[:, :2], cloud.classification == BUILDING)
    task.put(scores=scores)
    return {"houses": len(polygons), "roof_points": n_roof}


def find_shift(task: Task) -> Facts:
    """Add up the scores of all tiles, and find the shift that fits best."""
    total, houses, n_roof = np.zeros((SIDE, SIDE), np.int64), 0, 0
    for result in task.read("alignment"):
        if result.facts["houses"]:
            total += result.arrays["scores"]
            houses, n_roof = houses + result.facts["houses"], n_roof + result.facts["roof_points"]
    shift = best_shift(total, n_roof, houses)
    return {"houses": houses, "shift": None if shift is None else list(shift)}


def shift_of(facts: Facts) -> tuple[float, float]:
    """Give the shift of the facts of the stage ``shift`` that is worth telling, else (0, 0) (m)."""
    found = facts["shift"]
    return (found[0], found[1]) if found is not None and np.hypot(*found) >= TOLD else (0.0, 0.0)


def shift_of_run(config: Config) -> tuple[float, float]:
    """Take the shift of a whole run, for one of its tiles alone.

    Raises
    ------
    InputError
        If the run has not measured it.
    """
    try:
        facts = Store(Path(config.out) / STORE).attributes("shift", REGION_ITEM)["facts"]
    except InputError as error:
        raise InputError(
            f"{config.out}: the shift of the footprints follows from the whole region, and its run has not come "
            f"that far ({error}); run it without --only first"
        ) from None
    return shift_of(facts)


def describe_alignment(records: Records, config: Config) -> tuple[Facts, list[Note], list[str]]:
    """Return the shift between footprints and roofs: for the record, as notes, and in words."""
    if not config.footprints:
        return {}, [], []
    facts = records["shift", REGION_ITEM].facts
    shift = shift_of(facts)
    record = {"houses": facts["houses"], "shift": facts["shift"], "applied": bool(config.align and any(shift))}
    if facts["shift"] is None:
        few = facts["houses"] < LEAST_HOUSES
        why = f"{facts['houses']} houses to measure it" if few else f"no shift up to {REACH:g} m fits"
        return record, [Note("alignment-unknown", config.footprints, detail=why)], []
    if not any(shift):
        return record, [], []
    place = f"the footprints lie {describe_shift(shift)} the roofs in the point cloud, by {facts['houses']} houses"
    move = "they were moved onto them (--align)" if config.align else "--align moves them onto the roofs"
    return record, [Note(MISALIGNED, config.footprints, detail=f"{place}; {move}")], [f"{place}; {move}"]


def _sample(task: Task) -> NDArray[np.object_]:
    """Footprints of the tile to measure by: of a common size, whole within the region, chosen by their ids."""
    found = read_outlines(task) if "footprints" in task.refs else read_own_outlines(task)
    area, box = shapely.area(found.polygons), shapely.bounds(found.polygons).reshape(-1, 4)
    fit = (area >= LEAST_AREA) & (area <= MOST_AREA) & shapely.is_valid(found.polygons)
    fit &= find_owned(task.box, task.context.bounds, (box[:, :2] + box[:, 2:]) / 2)
    fit &= _within(box, grow(task.box, AROUND)) & _within(box, grow(task.context.bounds, -REACH))
    rows = np.flatnonzero(fit)
    names = [hashlib.blake2b(name.encode(), digest_size=8).digest() for name in found.ids[rows].tolist()]
    chosen = sorted(range(len(rows)), key=names.__getitem__)[:SAMPLE]
    return found.polygons[rows[chosen]]


def _within(box: NDArray[np.float64], outer: Box) -> NDArray[np.bool_]:
    beyond = np.column_stack([outer[:2] - box[:, :2], box[:, 2:] - outer[2:]])
    return np.asarray(beyond.max(axis=1, initial=-np.inf) <= 0, np.bool_)
