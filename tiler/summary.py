"""What the stages of a run tell, collected for its record."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from pipeline.clusters import add_counts
from pipeline.notes import Note, count_notes
from tiler.config import Config
from tiler.context import absent_tiles, tile_name
from tiler.engine import Engine
from tiler.planning import Plan
from tiler.stage import REGION_ITEM
from tiler.task import Record, read_notes

EXIT_DONE, EXIT_INCOMPLETE = 0, 3
# Notes of these kinds say that something is missing which the input has: the exit code tells.
INCOMPLETE = {"building-beyond-region", "building-lost", "building-points-without-footprints"}
LISTED = 10_000  # notes of a kind that the record lists; the store has all


def summarise_run(engine: Engine, plan: Plan, config: Config, rounds: int) -> dict[str, Any]:
    """Collect what all stages tell, for the record.

    Parameters
    ----------
    engine : Engine
        The engine, all stages run.
    plan : Plan
        The plan of the run.
    config : Config
        Its parameters.
    rounds : int
        How often clusters of houses were simplified.
    """
    records = engine.records
    notes = [*_collect_notes(engine), *_notes_of_clouds(engine, config)]
    unreadable = dict(plan.unreadable)
    unreadable |= {
        plan.layout.files[name].path: record.facts["unreadable"]
        for (stage, name), record in records.items()
        if stage == "points" and record.facts["unreadable"]
    }
    report = records["report", REGION_ITEM].facts
    outline = _join_outlines(
        [record.facts["outline"] for (stage, _), record in records.items() if stage == "model"]
    )
    incomplete = unreadable or INCOMPLETE & {note.kind for note in notes}
    return {
        "exit_code": EXIT_INCOMPLETE if incomplete else EXIT_DONE,
        "region": {
            "bounds": list(plan.region.bounds),
            "crs": plan.region.crs,
            "tile_size": plan.region.tile_size,
            "absent": [tile_name(key) for key in absent_tiles(plan.grid)],
        },
        "tiles": {
            name: {
                "status": "done",
                "box": list(plan.layout.tiles[name]),
                "counts": records["columns", name].facts["counts"] | records["pieces", name].facts["counts"],
                "facts": records["columns", name].facts["facts"],
            }
            for name in sorted(plan.layout.tiles)
        },
        "counts": _join_counts(engine, plan, rounds),
        "quality": report["quality"],
        "fidelity": report["fidelity"] | ({"outline": outline} if outline else {}),
        "reused": dict(sorted(Counter(record.stage for record in records.values() if record.reused).items())),
        "seconds": _join_seconds(records.values()),
        "peak_memory_bytes": max(record.peak_memory for record in records.values()),
        "messages": list(plan.messages),
        "unreadable": unreadable,
        "notes": group_notes(notes),
    }


def _collect_notes(engine: Engine) -> list[Note]:
    """Read the notes of all results that have some, by stage and item."""
    notes: list[Note] = []
    for stage, name in sorted(key for key, record in engine.records.items() if record.notes):
        notes += read_notes(engine.store, stage, name)
    return notes


def _notes_of_clouds(engine: Engine, config: Config) -> list[Note]:
    """Notes on what the point clouds say of buildings."""
    notes = []
    clouds = [record.facts for (stage, _), record in engine.records.items() if stage == "points"]
    houses = sum(record.facts["n"] for (stage, _), record in engine.records.items() if stage == "houses")
    marks = any(facts["marks_buildings"] and facts["counts"] for facts in clouds)
    if config.ground_filter:
        notes.append(Note("ground-filter", detail="ground found by progressive morphological opening"))
    if config.footprints and not engine.records["footprints", REGION_ITEM].facts["n"] and marks:
        detail = "the cloud has buildings, the file none in the region; check --crs and the files' CRSs"
        notes.append(Note("building-points-without-footprints", config.footprints, detail=detail))
    without = sum(not facts["marks_buildings"] for facts in clouds)
    if houses and without:
        detail = (
            f"{without} of {len(clouds)} files: roof points are those that are not ground, water, plants or noise"
        )
        notes.append(Note("no-building-class", detail=detail))
    return notes


def _join_counts(engine: Engine, plan: Plan, rounds: int) -> dict[str, int]:
    """Add up the numbers of all stages."""
    total: Counter[str] = Counter()
    total["files"] = len(plan.headers)
    total["files empty"] = sum(header.n_points == 0 for header in plan.headers)
    total["tiles"] = len(plan.layout.tiles)
    total["tiles absent"] = len(absent_tiles(plan.grid))
    total["rounds of simplification"] = rounds
    total["footprints read"] = engine.records["footprints", REGION_ITEM].facts["n"]
    for (stage, _), record in sorted(engine.records.items(), key=lambda item: item[0]):
        counts = record.facts.get("counts", {})
        if stage == "points":
            counts = {f"points {name}": n for name, n in counts.items()}
        if stage != "pieces":
            add_counts(total, counts)
        else:
            total["facets"] += counts["facets"]
    total["points"] = engine.records["numbers", REGION_ITEM].facts["points"]
    faces = [record.facts["faces"] for (stage, _), record in engine.records.items() if stage == "proofs"]
    total["seams"], total["seam faces"] = sum(n > 0 for n in faces), sum(faces)
    return dict(total)


def _join_outlines(parts: Sequence[dict[str, float]]) -> dict[str, float]:
    """Join the errors of outlines over tiles."""
    known = [part for part in parts if part.get("area")]
    if not known:
        return {}
    joined = {"area_error": sum(part["changed_area"] for part in known) / sum(part["area"] for part in known)}
    for name in ("min_clearance", "sharpest"):
        joined[name] = min(part[name] for part in known)
    return {name: round(value, 6) for name, value in joined.items()}


def _join_seconds(records: Iterable[Record]) -> dict[str, float]:
    """Seconds by stage, and by step of stages."""
    total: defaultdict[str, float] = defaultdict(float)
    for record in records:
        for step, seconds in record.seconds.items():
            total[record.stage if step == "all" else f"{record.stage}: {step}"] += seconds
    return {name: round(seconds, 3) for name, seconds in sorted(total.items())}


def group_notes(notes: Sequence[Note]) -> dict[str, dict[str, Any]]:
    """Group notes by kind, with their number and the places of the first `LISTED` of each, for the record."""
    kinds: dict[str, dict[str, Any]] = {
        kind: {"count": number, "items": []} for kind, number in count_notes(notes).items()
    }
    for note in notes:
        if len(kinds[note.kind]["items"]) == LISTED:
            continue
        item: dict[str, Any] = {"subject": note.subject, "detail": note.detail}
        if not math.isnan(note.x):
            item |= {"x": round(note.x, 3), "y": round(note.y, 3)}
        kinds[note.kind]["items"].append(item)
    return kinds
