"""What the stages of a run tell, collected for its record."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.data.notes import Note, count_notes
from pipeline.points_terrain.terrain_fill import RIM as FAR_NODES
from tiler.config.config import Config
from tiler.config.domain_height import resolve_height
from tiler.config.zone_levels import describe_zones
from tiler.engine.engine import Engine
from tiler.engine.records import Records
from tiler.engine.run_context import absent_tiles, tile_name
from tiler.engine.stage import REGION_ITEM, Facts, whole_file
from tiler.engine.task import read_notes
from tiler.landcover.cover_table import describe_patches, read_table
from tiler.mesh_files.mesh_parts import MESH_IN_PARTS, describe_parts, note_parts
from tiler.objects.places import place
from tiler.planning.establish_georeference import FOOTPRINTS
from tiler.planning.own_stages import CORE_STAGE
from tiler.planning.plan import Plan
from tiler.report.left_out import describe_left_out, report_left_out
from tiler.stages.alignment import describe_alignment
from tiler.stages.approach import RIM
from tiler.stages.city_files import describe_feet
from tiler.stages.domain import LOW_DOMAIN
from tiler.stages.inputs import MODEL_OUTLINES
from tiler.stages.readers import join_shares
from tiler.store.run_folder import PATCH_OF_GROUND
from tiler.workflow.empty_run import explain_empty, is_empty
from tiler.workflow.failed_tiles import Missing, describe_missing

EXIT_DONE, EXIT_INCOMPLETE = 0, 3
# Notes of these kinds say that something is missing which the input has: the exit code tells.
INCOMPLETE = {
    *("crs-accuracy", "building-beyond-region", "building-lost", "building-points-without-footprints"),
    *("footprint-too-many-vertices", "footprint-unreadable", "footprint-not-finite", "footprint-not-polygon"),
}
DAMAGED = "damaged-artefact"  # kind of the notes on what was damaged or missing, and made anew
FAR_TERRAIN = "terrain-far-from-points"  # kind of the note on terrain that is interpolated over large gaps
FAR_SHARE = 0.01  # of the region from which on it is made
LISTED = 10_000  # notes of a kind that the record lists; the store has all


def summarise_run(
    engine: Engine, plan: Plan, config: Config, rounds: int, missing: Missing, damage: Mapping[str, str]
) -> dict[str, Any]:
    """Collect what all stages tell, for the record.

    Parameters
    ----------
    engine : Engine
        The engine, all stages run.
    plan : Plan
        The plan of the run, without the tiles that failed before there was a city model.
    config : Config
        Its parameters.
    rounds : int
        How often clusters of houses were simplified.
    missing : Missing
        Tiles that failed.
    damage : mapping of str to str
        What was wrong with artefacts that were made anew, by path.
    """
    records = engine.records
    clouds = join_shares({record.name: record.facts for record in records.of("points")})
    paths = {whole_file(name): item.path for name, item in plan.layout.files.items()}
    notes = [
        *plan.georeference.notes,
        *_collect_notes(engine),
        *_notes_of_clouds(engine, config, list(clouds.values())),
    ]
    notes += [Note(DAMAGED, path, detail=f"{what}; made anew") for path, what in sorted(damage.items())]
    unreadable = dict(plan.unreadable)
    unreadable |= {paths[name]: facts["unreadable"] for name, facts in clouds.items() if facts["unreadable"]}
    alignment, misaligned, words = describe_alignment(records, config)
    notes += misaligned
    if alignment.get("applied"):
        notes = [note for note in notes if (note.kind, note.subject) != ("crs-accuracy", FOOTPRINTS)]
    report = records["report", REGION_ITEM].facts
    notes += note_parts(report["parts"])
    notes += describe_feet(record.facts.get("feet", {}) for record in records.of("houses"))
    found = records["domain", REGION_ITEM].facts
    domain = resolve_height(config.domain_height, config.top, found)
    outline = _join_outlines([record.facts["outline"] for record in records.of("model")])
    left_out = describe_left_out(engine, notes)
    incomplete = unreadable or missing.tiles or missing.others or INCOMPLETE & {note.kind for note in notes}
    counts = _join_counts(engine, plan, rounds, clouds) | {"tiles missing": len(missing.tiles)}
    notes += _note_far_terrain(counts, config)
    empty = {"empty": explain_empty(config, plan.region, counts, notes)} if is_empty(config, counts) else {}
    absent = {tile_name(key) for key in absent_tiles(plan.grid)} - missing.tiles.keys()
    return {
        "exit_code": EXIT_INCOMPLETE if incomplete else EXIT_DONE,
        "region": {
            "bounds": list(plan.region.bounds),
            "crs": plan.region.crs,
            "tile_size": plan.region.tile_size,
            "absent": sorted(absent),
        }
        | ({} if domain.top is None else {"top": domain.top})
        | (_describe_pad(engine) if config.padded else {}),
        "georeference": plan.georeference.record | ({"alignment": alignment} if alignment else {}),
        "domain": {
            "height (m)": domain.height,
            "tallest building (m)": found["tallest"],
            "tallest building in the mesh (m)": found["tallest_meshed"],
        },
        "tiles": {
            name: {
                "status": "done",
                "box": list(plan.layout.tiles[name]),
                "counts": records["columns", name].facts["counts"] | records["pieces", name].facts["counts"],
                "facts": records["columns", name].facts["facts"],
            }
            for name in sorted(plan.layout.tiles.keys() - missing.tiles.keys())
        },
        **({"land_cover": _describe_cover(records, config)} if config.covered else {}),
        **({"zones": describe_zones(engine.parameters.zones)} if config.zoned else {}),
        **describe_missing(missing, place(config.out)),
        "counts": counts,
        **empty,
        "parts": describe_parts(report["parts"]),
        "quality": report["quality"],
        "fidelity": report["fidelity"] | ({"outline": outline} if outline else {}) | _roof_fit(records),
        "left_out": left_out,
        "tasks": {"all": len(records), "ran": len(records) - sum(records.count_reused().values())},
        "reused": records.count_reused(),
        "ran": records.count_ran(),
        "seconds": {name: round(seconds, 3) for name, seconds in sorted(records.seconds.items())},
        "peak_memory_bytes": records.peak_memory,
        "messages": [
            *plan.messages,
            *words,
            *_describe_damage(damage),
            *_describe_notes(notes),
            *report_left_out(left_out),
        ],
        "unreadable": unreadable,
        "notes": group_notes(notes),
    }


def _describe_cover(records: Records, config: Config) -> dict[str, Any]:
    """Describe the patches of the ground by number, with the area of each."""
    patches = describe_patches(read_table(config), padded=config.padded)
    area = np.sum([record.facts[PATCH_OF_GROUND] for record in records.of("columns")], axis=0)
    return {"patches": [row | {"area (m2)": round(float(area[k]), 1)} for k, row in enumerate(patches)]}


def _roof_fit(records: Records) -> dict[str, Any]:
    """Describe how roofs of planes fit their points, and those of the full city model."""
    simple, full = (
        records[stage, REGION_ITEM].facts if (stage, REGION_ITEM) in records else {}
        for stage in ("citymodel", "citymodel-full")
    )
    found = {name: simple[name] for name in ("roof_fit", "worst_roofs") if name in simple}
    return found | ({"full_roof_fit": full["roof_fit"]} if "roof_fit" in full else {})


def _describe_pad(engine: Engine) -> dict[str, Any]:
    """Return the region without its pad, and the height of the ground at the outer sides."""
    core, _ = engine.laid_out(CORE_STAGE)
    return {"core": list(core.bounds), "rim": engine.records[RIM, REGION_ITEM].facts["rim"]}


def describe_tasks(tasks: Mapping[str, int]) -> str:
    """Describe how many tasks ran, and how many results were taken as they were.

    Examples
    --------
    >>> describe_tasks({"all": 1204, "ran": 312})
    '312 of 1,204 tasks ran, 892 results were there'
    """
    return f"{tasks['ran']:,} of {tasks['all']:,} tasks ran, {tasks['all'] - tasks['ran']:,} results were there"


def _describe_damage(damage: Mapping[str, str]) -> list[str]:
    if not damage:
        return []
    return [f"{len(damage)} damaged or missing artefacts of an earlier run were made anew: {DAMAGED} in the notes"]


def _note_far_terrain(counts: Mapping[str, int], config: Config) -> list[Note]:
    """Make the note on terrain far from all ground points, as between two clouds in one tile, where it is much."""
    far, nodes = counts.get("terrain nodes from coarse level", 0), counts.get("terrain nodes", 0)
    if far < FAR_SHARE * nodes or not far:
        return []
    reach = FAR_NODES * config.dtm_spacing
    area = f"{far * config.dtm_spacing**2:,.0f} m² ({100 * far / nodes:.0f} % of the region)"
    detail = (
        f"{area} are more than {reach:g} m from any ground point: the terrain there is interpolated, and what "
        "stands there is unknown; see --bounds, or a smaller --tile-size, which leaves out tiles without points"
    )
    return [Note(FAR_TERRAIN, detail=detail)]


def _describe_notes(notes: Sequence[Note]) -> list[str]:
    """Notes that a user should read whatever else there is."""
    return [note.detail for note in notes if note.kind in (MESH_IN_PARTS, FAR_TERRAIN, LOW_DOMAIN)]


def _collect_notes(engine: Engine) -> list[Note]:
    """Read the notes of all results that have some, by stage and item."""
    return [note for item in engine.records.noted() for note in read_notes(engine.store, *item)]


def _notes_of_clouds(engine: Engine, config: Config, clouds: Sequence[Facts]) -> list[Note]:
    """Notes on what the point clouds say of buildings."""
    notes = []
    houses = sum(record.facts["n"] for record in engine.records.of("houses"))
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


def _join_counts(engine: Engine, plan: Plan, rounds: int, clouds: Mapping[str, Facts]) -> dict[str, int]:
    """Add up the numbers of all stages."""
    total: Counter[str] = Counter()
    for facts in clouds.values():
        total.update({f"points {name}": n for name, n in facts["counts"].items()})
    total["files"] = len(plan.headers)
    total["files empty"] = sum(header.n_points == 0 for header in plan.headers)
    total["tiles"] = len(plan.layout.tiles)
    total["tiles absent"] = len(absent_tiles(plan.grid))
    total["rounds of simplification"] = rounds
    sources = [stage for stage in ("footprints", MODEL_OUTLINES) if stage in engine.records.stages()]
    total["footprints read"] = sum(engine.records[stage, REGION_ITEM].facts["n"] for stage in sources)
    for stage in engine.records.stages():
        for record in engine.records.of(stage):
            counts = record.facts.get("counts", {})
            if stage == "pieces":
                total["facets"] += counts["facets"]
            elif stage != "points":
                total.update(counts)
    total["points"] = engine.records["report", REGION_ITEM].facts["points"]
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
