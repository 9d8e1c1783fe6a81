"""The sections of the report: which numbers, charts and tables it shows, and in which words."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.quality.histograms import Histogram, percentile, share_below
from pipeline.quality.point_fidelity import KINDS
from pipeline.quality.residuals import ResidualSums, conclude
from stitch.tiling.grid import make_grid, tile_box
from tiler.config.config import Config
from tiler.config.zone_levels import read_described
from tiler.config.zones import LEVELS
from tiler.engine.run_context import tile_key
from tiler.mesh_files.mesh_parts import report_parts
from tiler.monitoring.progress import command_line
from tiler.report.charts import Series, draw_bars, draw_gantt, draw_histogram, rebin
from tiler.report.collect import Bins, Numbers
from tiler.report.left_out import report_left_out
from tiler.report.maps import draw_levels, draw_map, gather_tiles
from tiler.report.page import figure, figures, folded, heading, number, paragraph, table, text
from tiler.report.record import PLACES, SHOWN, NoteGroup, RunFacts
from tiler.report.samples import NEAR, Samples
from tiler.report.timeline import Timeline
from tiler.store.run_folder import PARTS, WRONG_FIELD
from tiler.words.note_words import GROUPS, group_of, say_notes
from tiler.words.plain_text import format_box
from tiler.words.stage_groups import group_stages, title_of_stage

PERCENTILES = (0, 0.1, 1, 5, 50, 95, 100)


@dataclasses.dataclass(frozen=True)
class Measure:
    """How a measure of quality is shown: its name, what is good, and the bins of its histogram."""

    title: str
    words: str
    bins: int


MEASURES = {
    "radius_ratio": Measure("radius ratio", "1 for a regular tetrahedron, 0 for a flat one", 40),
    "min_dihedral": Measure("least dihedral angle (degrees)", "70.5 for a regular tetrahedron", 45),
    "aspect_ratio": Measure("aspect ratio", "1 for a regular tetrahedron, more for a flat one", 50),
}
SHORTEST = 0.01  # s, of a stage that has a bar
WORST_SHADE = 0.7  # radius ratio of the lightest shade of the map
CHART_BINS = 40
WITHIN = 0.25  # m; the share of points that are closer is told
CLOSE = f"share within {WITHIN:g} m"
POINT_KINDS = {
    "roof": "roof points inside buildings, against the roof",
    "missed": "roof points of footprints where the model has no building, against the terrain",
    "ground": "ground points outside buildings, against the terrain",
    "swallowed": "ground points that were built over, against the roof",
}


METHODS = {
    "planes": "planes of points",
    "family": "gable, hip or the like",
    "skeleton": "hipped, by its outline",
    "flat": "one height",
    "model": "surfaces of the city model",
}
POINT_COLUMNS = ("rmse", "p50", "p95", "bias")
SURFACES = {
    "roof on roof": "roof points over roofs",
    "ground on ground": "ground points over ground",
    "water on ground": "water points over ground",
    "roof on ground": "roof points over ground: buildings that were dropped, or have no footprint",
    "ground on roof": "ground points under roofs: floors, passages, what was built over",
    "water on roof": "water points under roofs",
}


def describe_summary(facts: RunFacts) -> Iterator[str]:
    """Describe how the run ended, and its key figures."""
    members = facts.members
    status, counts, bounds = members["status"], members.get("counts", {}), facts.bounds
    if status != "done":
        yield paragraph(f"The run {status}: {members.get('error', '')}", "bad")
    elif members.get("exit_code"):
        yield paragraph("The mesh is whole but for parts that are listed below (exit code 3).", "bad")
    else:
        yield paragraph("The mesh is whole: every tile was meshed.")
    lost = report_left_out(members.get("left_out") or {})
    if members.get("parts", {}).get("n", 1) > 1:
        yield paragraph(f"{_describe_parts(members['parts'])}: no flow passes between them.", "bad")
    if lost:
        yield heading("Buildings that are not in the mesh")
        yield _bullets(lost)
    pairs = [
        ("cells", "cells"),
        ("points", "points"),
        ("facets", "facets"),
        ("buildings", "buildings"),
        (PARTS, "building parts"),
    ]
    shown = [(words, number(counts[name])) for words, name in pairs if name in counts]
    if bounds is not None:
        area = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) / 1e6
        shown += [("region", f"{area:,.3g} km²"), ("tiles", number(len(facts.tiles.names)))]
    if "quality" in members:
        shown.append(("worst radius ratio", number(members["quality"]["radius_ratio"]["0"])))
    for patch in (members.get("land_cover") or {}).get("patches", []):
        if patch["area (m2)"]:
            shown.append((patch["patch"], f"{patch['area (m2)']:,.0f} m²"))
    shown.append(("time", f"{members.get('seconds_total', 0.0):,.1f} s"))
    if "peak_memory_bytes" in members:
        shown.append(("peak memory of a process", f"{members['peak_memory_bytes'] / 2**20:,.0f} MiB"))
    yield figures(shown)
    if messages := [message for message in members.get("messages", ()) if message not in lost]:
        yield _bullets(messages)


def describe_map(facts: RunFacts, numbers: Numbers, timeline: Timeline | None) -> Iterator[str]:
    """Show the tiles over the footprints, by quality, cells, and time where it is known."""
    tiles, members, bounds = facts.tiles, facts.members, facts.bounds
    assert bounds is not None
    region = members["region"]
    size = float(region["tile_size"])
    missing = list(_find_missing(facts))
    yield paragraph(
        f"Region {format_box(bounds)} in {region['crs']}, tiles of {size:g} m: "
        f"{len(tiles.names):,} meshed, {len(region.get('absent', ())):,} absent, "
        f"{facts.lengths.get('missing', 0):,} missing."
    )
    shown = gather_tiles(tiles.names, tiles.box, numbers.worst, tile_size=size, least=True)
    if shown.tiles_along > 1:
        yield paragraph(f"Blocks of {shown.tiles_along} x {shown.tiles_along} tiles are drawn as one.")
    marks = [
        (np.concatenate([np.empty((0, 2)), *(group.places for group in facts.notes)]), style)
        for style in ("note", "note inner")
    ]
    least = float(np.nanmin(numbers.worst)) if np.isfinite(numbers.worst).any() else 0.0
    worst = draw_map(
        "Tiles by worst radius ratio, over footprints",
        bounds,
        shown,
        limits=(WORST_SHADE, min(least, WORST_SHADE - 0.1)),
        unit="",
        footprints=numbers.footprints,
        missing=missing,
        marks=marks,
    )
    words = "Worst radius ratio of each tile; the darker the worse (lighter on a dark page)."
    more = any(group.count > len(group.places) for group in facts.notes)
    sample = f" (the first {PLACES} of each kind)" if more else ""
    yield figure(worst, f"{words} Dots: where something was dropped, repaired or defaulted{sample}.")
    others = [("cells", tiles.cells.astype(np.float64), "", "Cells of each tile.")]
    if timeline is not None and timeline.by_tile:
        spent = np.array([timeline.by_tile.get(name, np.nan) for name in tiles.names])
        others.append(("time", spent, " s", "Time of all tasks of each tile."))
    maps = []
    for name, values, unit, caption in others:
        shown = gather_tiles(tiles.names, tiles.box, values, tile_size=size, least=False)
        limits = (0.0, float(np.nanmax(shown.value, initial=0.0)) or 1.0)
        chart = draw_map(
            f"Tiles by {name}", bounds, shown, limits=limits, unit=unit, footprints=None, missing=missing
        )
        maps.append(figure(chart, caption))
    yield f'<div class="pair">{"".join(maps)}</div>'
    if zones := read_described(members.get("zones") or ()):
        parts = {level: members["counts"].get(f"parts at level {level}", 0) for level in LEVELS}
        told = ", ".join(f"{n:,} at {level}" for level, n in parts.items() if n)
        words = "Zones of detail: a building has the level of the finest one that its point lies in."
        yield figure(draw_levels(bounds, zones), f"{words} Building parts: {told or 'none'}.")


def describe_quality(facts: RunFacts, numbers: Numbers, samples: Samples) -> Iterator[str]:
    """Show percentiles and histograms of the quality of cells: of all, and of those near seams."""
    head = ["percentile", *(f"{p:g}" for p in PERCENTILES)]
    near = f"cells within {NEAR:g} m of seams"
    rows = []
    for name, found in numbers.quality.items():
        rows.append([f"{MEASURES[name].title}, all cells", *_percentiles(found)])
        if samples.near:
            rows.append([f"{MEASURES[name].title}, {near}", *_percentiles(samples.near[name])])
    yield table(f"Quality of {number(facts.members['counts']['cells'])} cells", head, rows)
    if samples.near:
        n = int(samples.near["radius_ratio"].counts.sum())
        yield paragraph(f"Near seams are {n:,} cells of air{_chosen(samples)}.")
    else:
        yield paragraph("There are no seams between tiles.")
    charts = []
    for name, found in numbers.quality.items():
        measure = MEASURES[name]
        series = [Series("all cells", rebin(found.counts, measure.bins))]
        if samples.near:
            series.append(Series(near, rebin(samples.near[name].counts, measure.bins)))
        chart = draw_histogram(f"Histogram: {measure.title}", measure.title, (found.low, found.high), series)
        charts.append(figure(chart, f"{measure.words}."))
    yield f'<div class="pair">{"".join(charts)}</div>'


def format_heights(facts: RunFacts, numbers: Numbers) -> Iterator[str]:
    """Show heights of buildings and terrain."""
    if domain := facts.members.get("domain"):
        names = {"height (m)": "height of the domain (m)"}
        yield figures([(names.get(name, name), number(value, 1)) for name, value in domain.items()])
    charts = []
    for bins, title, axis in (
        (numbers.buildings, "building parts", "height of building parts above their ground (m)"),
        (numbers.terrain, "terrain", "height of the terrain (m)"),
    ):
        if not bins.n:
            charts.append(paragraph(f"The run has no {title}."))
            continue
        low, high, share = _coarsen(bins)
        chart = draw_histogram(f"Histogram: {axis}", axis, (low, high), [Series(title, share)])
        words = (
            f"{bins.n:,} {'terrain nodes' if title == 'terrain' else title}: {bins.minimum:,.1f} to "
            f"{bins.maximum:,.1f} m, mean {bins.mean:,.1f} m."
        )
        charts.append(figure(chart, words))
    yield f'<div class="pair">{"".join(charts)}</div>'


def describe_fidelity(facts: RunFacts, samples: Samples) -> Iterator[str]:
    """Show how far points are from the mesh and from the city model, and outlines from the footprints."""
    rows = [
        [
            words,
            number(samples.points[kind].n),
            *_residuals(samples.points[kind]),
            number(share_below(samples.points[kind].absolute, WITHIN)),
        ]
        for kind, words in SURFACES.items()
        if kind in samples.points and samples.points[kind].n
    ]
    head = ["points", "number", "RMSE (m)", "median (m)", "95 % below (m)", "99 % below (m)", "bias (m)", CLOSE]
    sloped = "roof_fit" in facts.members["fidelity"]
    shape = "A part's roof is one plane, so chimneys" if sloped else "A part's roof has one height, so slopes"
    yield heading("The mesh's surface")
    yield paragraph(
        f"Height of ground and roofs of the mesh over LiDAR points by class{_chosen(samples)}{_thinned(samples)}; "
        "percentiles are of absolute values, outliers count. "
        f"{shape} and dormers show here."
    )
    yield table("Heights of the mesh over LiDAR points", head, rows)
    found = facts.members["fidelity"]
    rows = [
        [POINT_KINDS[kind], number(found[kind]["n"]), *(number(found[kind].get(name)) for name in POINT_COLUMNS)]
        for kind in KINDS
        if kind in found
    ]
    head = ["points", "number", "RMSE (m)", "median (m)", "95 % below (m)", "bias (m)"]
    yield heading("The city model and its terrain")
    yield table("Heights of the city model over LiDAR points, all points, outliers too", head, rows)
    yield from _describe_roof_fit(found)
    if outline := found.get("outline"):
        names = (
            ("area that outlines gained or lost", f"{100 * outline['area_error']:.2f} %"),
            ("least distance of walls", f"{outline['min_clearance']:.2f} m"),
            ("sharpest corner", f"{outline['sharpest']:.1f}°"),
        )
        yield figures(names)


def _describe_roof_fit(found: dict[str, Any]) -> Iterator[str]:
    """Show how roofs of planes fit their points, by method, and the worst of them."""
    if "roof_fit" in found:
        names = ("buildings", "points", "rmse", "median", "within")
        rows = [
            [METHODS[method], *(number(fit.get(name)) for name in names)]
            for method, fit in found["roof_fit"].items()
        ]
        head = ["roof", "building parts", "points", "RMSE (m)", "median of medians (m)", CLOSE]
        rows.append(["all", *(number(value) for value in _sum_fits(found["roof_fit"]))])
        if "full_roof_fit" in found:
            rows.append(["all of the full city model", *map(number, _sum_fits(found["full_roof_fit"]))])
        yield heading("Roofs by method")
        yield table("Roofs over their points, façade points and what stands on roofs too", head, rows)
    if found.get("worst_roofs"):
        rows = [
            [
                one["id"],
                METHODS[one["method"]],
                *(number(one[name]) for name in ("parts", "points", "rmse", "within")),
                f"{one['worst_part']} at {one['x']:.1f}, {one['y']:.1f}: {one['why']}",
            ]
            for one in found["worst_roofs"]
        ]
        head = [
            "house",
            "roof",
            "parts",
            "points",
            "RMSE (m)",
            CLOSE,
            "worst part, and what is known of it",
        ]
        yield folded("The houses whose roofs fit worst", table("Roofs of largest RMSE", head, rows))


def _sum_fits(fits: dict[str, dict[str, Any]]) -> tuple[Any, ...]:
    """Building parts and points of all methods, RMSE (m) and share of the points within `WITHIN`; no median."""
    seen = [fit for fit in fits.values() if "rmse" in fit]
    n = sum(fit["points"] for fit in seen)
    rmse = (sum(fit["points"] * fit["rmse"] ** 2 for fit in seen) / n) ** 0.5 if n else None
    within = sum(fit["points"] * fit["within"] for fit in seen) / n if n else None
    return sum(fit["buildings"] for fit in fits.values()), n, rmse, None, within


def format_time(facts: RunFacts, timeline: Timeline | None) -> Iterator[str]:
    """Show where the time went: by stage, and when each stage worked."""
    members = facts.members
    seconds: dict[str, float] = members.get("seconds", {})
    alone = {name: value for name, value in seconds.items() if ":" not in name}
    steps = {step: sum(alone[name] for name in names) for step, names in group_stages(alone).items()}
    if timeline is not None:
        tips = [
            f"{name}: {first:.2f} to {last:.2f} s, {n} tasks, {reused} used again, {failed} failed"
            for name, first, last, n, reused, failed in zip(
                timeline.stages, timeline.first, timeline.last, timeline.tasks, timeline.reused, timeline.failed,
                strict=True,
            )
        ]  # fmt: skip
        chart = draw_gantt("When each step worked", timeline.duration, timeline.stages, timeline.busy, tips)
        yield figure(
            f'<div class="narrow">{chart}</div>',
            "When each step worked; the darker the more of its tasks at a time.",
        )
    else:
        yield paragraph("When each task worked is not known: the folder has no events.jsonl.")
    rows = [(name, value, f"{value:,.2f} s") for name, value in steps.items() if value >= SHORTEST]
    bars = f'<div class="narrow">{draw_bars("Time of all tasks by step", rows)}</div>'
    yield figure(bars, "Time of all tasks of each step, over all workers.")
    ran, reused, finished = (members.get(name, {}) for name in ("ran", "reused", "finished"))
    details = [
        [
            _describe_step(name),
            number(ran.get(name)),
            number(reused.get(name)),
            number(value, 2),
            number(finished.get(name), 1),
        ]
        for name, value in sorted(seconds.items())
    ]
    head = ("step", "tasks ran", "used again", "time (s)", "done after (s)")
    yield folded("All steps in detail", table("Steps", head, details))


def describe_notes(facts: RunFacts) -> Iterator[str]:
    """List what failed, was dropped, repaired or defaulted."""
    members, lengths = facts.members, facts.lengths
    if missing := members.get("missing"):
        rows = [
            [name, title_of_stage(f["stage"]), f["name"], f["reason"], f["command"]]
            for name, f in _first(missing.items())
        ]
        yield heading("Tiles that failed")
        yield table(
            _first_of("tiles", lengths["missing"]), ("tile", "step", "item", "reason", "alone"), rows, numbers=9
        )
    if others := members.get("set_aside"):
        rows = [[f["name"], title_of_stage(f["stage"]), f["reason"]] for f in others[:SHOWN]]
        yield heading("What else failed")
        yield table(_first_of("items", lengths["set_aside"]), ("item", "step", "reason"), rows, numbers=9)
    if unreadable := members.get("unreadable"):
        yield heading("Files that were left out")
        yield table(
            _first_of("files", lengths["unreadable"]), ("file", "reason"), _first(unreadable.items()), numbers=9
        )
    if not facts.notes:
        yield paragraph("Nothing was dropped, repaired or defaulted.")
        return
    yield paragraph(f"Ids and places of up to {SHOWN} of each kind; run.json has the first 10,000, the store all.")
    for group in GROUPS:
        kinds = [notes for notes in facts.notes if group_of(notes.kind) == group]
        if not kinds:
            continue
        yield heading(f"{group.capitalize()}: {sum(notes.count for notes in kinds):,}")
        yield from (_list_notes(notes) for notes in sorted(kinds, key=lambda notes: (-notes.count, notes.kind)))


def report_parameters(facts: RunFacts) -> Iterator[str]:
    """List parameters, those that are not the default's first, and versions."""
    given: dict[str, Any] = facts.members.get("parameters", {})
    changed: list[list[str]] = []
    others: list[list[str]] = []
    for entry in dataclasses.fields(Config):
        if entry.name not in given:
            continue
        value, data = _as_tuple(given[entry.name]), entry.metadata
        row = [entry.name, _format_value(value), data["unit"], data["text"]]
        (others if value == entry.default else changed).append(row)
    head = ("parameter", "value", "unit", "meaning")
    yield table("Parameters that differ from their defaults", head, changed, numbers=9)
    yield folded(f"{len(others)} parameters at their defaults", table("Parameters", head, others, numbers=9))
    try:
        config = Config(**{name: _as_tuple(value) for name, value in given.items()})
        yield f"<p>The same again: <code>{text(command_line(config))}</code></p>"
    except WRONG_FIELD:
        yield paragraph("The parameters are those of another version.")
    yield table("Versions", ("package", "version"), facts.members.get("versions", {}).items(), numbers=9)


def _find_missing(facts: RunFacts) -> Iterator[tuple[tuple[float, float, float, float], str]]:
    """Boxes of tiles that failed, as the grid of the run has them."""
    found, bounds = facts.members.get("missing") or {}, facts.bounds
    if not found or bounds is None:
        return
    given = facts.members["parameters"]
    grid = make_grid(
        bounds,
        tile_size=float(facts.members["region"]["tile_size"]),
        mesh_size=float(given["mesh_size"]),
        open_size=float(given["open_size"]),
    )
    for name, failure in found.items():
        yield (
            tile_box(grid, tile_key(name)),
            f"{name} failed: {title_of_stage(failure['stage'])}: {failure['reason']}",
        )


def _residuals(sums: ResidualSums) -> list[str]:
    found = conclude(sums)
    values = (found.rmse, found.p50, found.p95, percentile(sums.absolute, 99), found.bias)
    return [number(value) for value in values]


def _describe_step(name: str) -> str:
    """Name a stage, or a step of one as ``"houses: 2.0 split levels"``, in words of its group."""
    stage, colon, step = name.partition(":")
    return f"{title_of_stage(stage)}{colon}{step}"


def _chosen(samples: Samples) -> str:
    if samples.tiles == samples.all_tiles:
        return ""
    return f" (a sample: {samples.tiles:,} of {samples.all_tiles:,} tiles, evenly chosen)"


def _thinned(samples: Samples) -> str:
    if samples.n_points == samples.all_points:
        return ""
    return f" (a sample: {samples.n_points:,} of the {samples.all_points:,} points there, evenly chosen)"


def _describe_parts(parts: dict[str, Any]) -> str:
    told = report_parts([part["cells"] for part in parts["largest"]], parts["n"])
    return told[:1].upper() + told[1:]


def _bullets(lines: Sequence[str]) -> str:
    return '<ul class="messages">' + "".join(f"<li>{text(line)}</li>" for line in lines) + "</ul>"


def _percentiles(found: Histogram) -> list[str]:
    return [number(percentile(found, p), 2 if found.high > 1 else 3) for p in PERCENTILES]


def _coarsen(bins: Bins) -> tuple[float, float, NDArray[np.float64]]:
    """Give range and shares of some `CHART_BINS` bins, each of a whole number of those counted."""
    n = len(bins.counts)
    each = -(-n // CHART_BINS)
    counts = np.concatenate([bins.counts, np.zeros(-n % each, np.int64)])
    return bins.low, bins.low + len(counts) * bins.width, rebin(counts, len(counts) // each)


def _list_notes(notes: NoteGroup) -> str:
    rows = [
        [item.get("subject", ""), number(item.get("x"), 1), number(item.get("y"), 1), item.get("detail", "")]
        for item in notes.items
    ]
    head = ("id or file", "x (m)", "y (m)", "detail")
    return folded(say_notes(notes.kind, notes.count), table(_first_of("notes", notes.count), head, rows))


def _first_of(what: str, count: int) -> str:
    return f"{count:,} {what}" if count <= SHOWN else f"The first {SHOWN} of {count:,} {what}; run.json has more"


def _first(items: Any) -> list[Sequence[Any]]:
    return list(items)[:SHOWN]


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _format_value(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
