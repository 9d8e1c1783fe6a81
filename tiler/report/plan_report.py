"""What `citystitch plan` prints and writes: a run's inputs, tiles, tasks and what they will take."""

import json
import platform
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from pipeline.data.errors import ConfigError
from stitch.tiling.grid import TileGrid, seams_present, tiles_present
from tiler.config.config import Config
from tiler.engine.task_limits import machine_memory
from tiler.georeference.units import unit_name
from tiler.monitoring.terminal import plain
from tiler.planning import forecast as rates
from tiler.planning.footprint_sample import FootprintSample, sample_footprints
from tiler.planning.forecast import CELLS_A_POINT, Forecast, forecast_run
from tiler.planning.plan import Survey, check_sources, survey_inputs
from tiler.store.atomic import replacing
from tiler.words.plain_text import say_nothing

SCHEMA = 1  # version of the JSON file's layout
WORKERS = (1, 4, 16, 64)  # numbers of workers that times are given for, besides the one asked for
COVERED = 2.2  # times as many cells at most with edges of land cover; measured: 1.1 to 2.1 (docs/land-cover.md)
BUSIEST = 5  # tiles with the most cells that the JSON file lists
UNITS = ((1e9, "billion"), (1e6, "million"), (1e3, "thousand"))
WIDTH = 80  # characters, where the terminal is not narrower
LABEL = 11


def plan_run(
    config: Config, *, json_file: Path | None = None, picture: Path | None = None, console: Console | None = None
) -> dict[str, Any]:
    """Forecast what a run would do and take; the output folder is not touched.

    Parameters
    ----------
    config : Config
        Parameters of the run.
    json_file : Path, optional
        File to write the plan to.
    picture : Path, optional
        SVG file to draw the plan to.
    console : rich.console.Console, optional
        Where to print.

    Returns
    -------
    dict
        The plan as the JSON file has it.

    Raises
    ------
    CityError
        As a run: if an input is missing or unreadable, or does not fit the others.
    """
    check_sources(config)
    for path in (json_file, picture):
        if path is not None and not path.parent.is_dir():
            raise ConfigError(f"{path}: there is no folder {path.parent}; make it, or choose another")
    if picture is not None and picture.suffix.lower() != ".svg":
        raise ConfigError(f"{picture}: the picture of a plan is SVG; name it {picture.with_suffix('.svg').name}")
    survey = survey_inputs(config, say_nothing)
    sample = sample_footprints(config, survey.region, frame=survey.georeference.footprints, models=survey.clouds)
    memory = None if config.on_cluster else machine_memory()
    forecast = forecast_run(survey, sample, config, memory=memory)
    plan = describe_plan(survey, sample, forecast, config, memory)
    _print_plan(plan, console or _console())
    if json_file is not None:
        with replacing(json_file) as part:
            part.write_text(json.dumps(plan, indent=1) + "\n")
    if picture is not None:
        from tiler.report.plan_map import draw_plan

        draw_plan(survey, sample, picture)
    return plan


def describe_plan(
    survey: Survey, sample: FootprintSample | None, forecast: Forecast, config: Config, memory: float | None
) -> dict[str, Any]:
    """Put a plan into plain values, for JSON; parameters as `plan_run` makes them."""
    loads, grid, by_level = forecast.loads, survey.meshed, forecast.cells_by_level
    there = tiles_present(grid)
    numbers = sorted({*WORKERS, max(config.workers, 1)})
    names = [f"{i}_{j}" for i, j in loads.index[np.argsort(-loads.cells, kind="stable")[:BUSIEST]].tolist()]
    return {
        "schema": SCHEMA,
        "region": {
            "bounds": list(grid.bounds),
            "crs": survey.region.crs,
            "area": float(loads.area.sum()),
        }
        | ({"core": list(survey.region.bounds)} if config.padded else {}),
        "georeference": survey.georeference.record,
        "tiles": {
            "size": config.tile_size_or_default,
            "present": len(loads),
            "absent": int((~there).sum()),
            "seams": sum(int(seams.sum()) for seams in seams_present(grid)),
            "inner_seams": _inner_seams(grid),
            "most_cells": names,
        },
        "files": {
            "number": len(survey.headers),
            "empty": sum(header.n_points == 0 for header in survey.headers),
            "in_region": len(survey.clouds),
            "unreadable": survey.unreadable,
            "points": sum(header.n_points for header in survey.clouds),
            "points_in_region": round(loads.lidar_points.sum()),
            "kinds": {
                kind: n
                for kind in ("cloud", "model", "terrain")
                if (n := sum(header.kind == kind for header in survey.headers))
            },
        },
        "footprints": None
        if sample is None
        else {"number": sample.total, "complete": sample.complete, "sampled": len(sample)},
        "mesh": {
            "mesher": config.mesher,
            "mesh_size": config.mesh_size,
            "domain_height": config.domain_height,
            "cells": _rounded(loads.cells.sum()),
            "points": _rounded(loads.cells.sum() / CELLS_A_POINT),
            "cells_of_largest_tile": _rounded(loads.cells.max(initial=0.0)),
        }
        | ({"cells_with_land_cover": _rounded(COVERED * loads.cells.sum())} if config.land_cover else {})
        | ({"cells_by_level": {k: _rounded(n) for k, n in by_level.items()}} if by_level else {}),
        "tasks": {entry.stage: {"scope": entry.scope.value, "number": entry.number} for entry in forecast.tasks},
        "memory": {
            "worker_bytes": _rounded(forecast.tile_memory.max(initial=0.0)),
            "machine_bytes": memory,
        },
        "disk_bytes": _rounded(forecast.disk),
        "workers": config.workers,
        "seconds": {str(number): _rounded(forecast.seconds(number)) for number in numbers},
        "core_seconds": _rounded(forecast.work),
        "rates": {
            "cells per second and core": _rounded(1 / rates.SECONDS_A_CELL),
            "LiDAR points per second and core": _rounded(1 / rates.SECONDS_A_LIDAR_POINT),
            "footprints per second and core": _rounded(1 / rates.SECONDS_A_HOUSE),
            "tasks per second and core": _rounded(1 / rates.SECONDS_A_TASK),
            "measured on": rates.MEASURED_ON,
        },
        "planned_on": platform.machine(),
        "messages": list(survey.messages),
        "warnings": list(forecast.warnings),
    }


def _inner_seams(grid: TileGrid) -> int:
    there = tiles_present(grid)
    return int((there[1:] & there[:-1]).sum() + (there[:, 1:] & there[:, :-1]).sum())


def _rounded(value: float) -> float | int:
    """Keep two digits: estimates know no more."""
    if value <= 0:
        return 0
    digits = 1 - int(np.floor(np.log10(value)))
    short = round(float(value), digits)
    return int(short) if short >= 10 else short


def _print_plan(plan: dict[str, Any], console: Console) -> None:
    region, tiles, files, mesh = plan["region"], plan["tiles"], plan["files"], plan["mesh"]
    (xmin, ymin, xmax, ymax), area = region["bounds"], region["area"]
    crs = region["crs"] if len(region["crs"]) < 30 else "CRS as the clouds state it"
    rows = [
        ("region", f"{_km(xmax - xmin)} x {_km(ymax - ymin)}, {xmin:.0f} {ymin:.0f} {xmax:.0f} {ymax:.0f}, {crs}")
    ]
    rows.append(("", _describe_coordinates(plan["georeference"])))
    if "core" in region:
        xmin, ymin, xmax, ymax = region["core"]
        rows.append(("", f"of these {_km(xmax - xmin)} x {_km(ymax - ymin)} without the pad"))
    absent = f", {tiles['absent']:,} absent (no point cloud)" if tiles["absent"] else ""
    rows.append(
        ("tiles", f"{tiles['present']:,} of {tiles['size']:g} m{absent}; {tiles['inner_seams']:,} seams between")
    )
    empty = f" ({files['empty']} empty)" if files["empty"] else ""
    density = f"{files['points_in_region'] / area:.1f} a m2" if area else ""
    rows.append(("files", f"{files['number']:,}{empty}, {_describe_points(files, density)}"))
    rows.append(("footprints", _footprints(plan["footprints"])))
    rows.append(
        (
            "mesh",
            f"about {_count(mesh['cells'])} cells, {_count(mesh['points'])} points "
            f"({mesh['mesher']}, {mesh['mesh_size']:g} m); largest tile {_count(mesh['cells_of_largest_tile'])}",
        )
    )
    if "cells_with_land_cover" in mesh:
        rows.append(("", f"edges of land cover: up to {_count(mesh['cells_with_land_cover'])} cells"))
    if "cells_by_level" in mesh:
        parts = (f"{_count(n)} at {level}" for level, n in mesh["cells_by_level"].items())
        rows.append(("", f"in zones of detail: {', '.join(parts)}"))
    rows += _task_rows(plan["tasks"])
    machine = plan["memory"]["machine_bytes"]
    of = f" of {machine / 2**30:.0f} GiB here" if machine else "; the scheduler's machines are not known"
    rows.append(("memory", f"about {_size(plan['memory']['worker_bytes'])} a worker{of}"))
    rows.append(("disk", f"about {_size(plan['disk_bytes'])}"))
    times = ", ".join(f"{_time(seconds)} with {number}" for number, seconds in plan["seconds"].items())
    rows.append(("time", f"about {times} workers, a core each"))
    rate = plan["rates"]
    rows.append(
        (
            "",
            f"estimates, the time good to a factor of 2: from {_count(rate['cells per second and core'])} cells, "
            f"{_count(rate['LiDAR points per second and core'])} LiDAR points, "
            f"{rate['footprints per second and core']} footprints, {rate['tasks per second and core']} tasks "
            f"a second and core, measured on {rate['measured on']}",
        )
    )
    rows += [("[yellow]left out[/]", f"{path}: {reason}") for path, reason in files["unreadable"].items()]
    rows += [("[yellow]note[/]", message) for message in plan["messages"]]
    rows += [("[red]warning[/]", message) for message in plan["warnings"]]
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(width=LABEL, style="bold")
    table.add_column(overflow="fold")
    for label, text in rows:
        table.add_row(label, plain(text))
    console.print(table)


def _describe_coordinates(found: dict[str, Any]) -> str:
    """Say in which CRS and unit coordinates are, what they had in the files, and how true lengths are."""
    units = {cloud["unit of heights (m)"] for cloud in found["clouds"]}
    stated = all(cloud["unit of heights stated"] for cloud in found["clouds"])
    heights = " and ".join(sorted(unit_name(unit) for unit in units))
    taken = ", ".join(dict.fromkeys(cloud["taken as"] for cloud in found["clouds"]))
    return (
        f"coordinates of {taken}, heights in {heights}{'' if stated else ' (not stated)'}; a metre on the ground "
        f"is {found['scale of the projection']:.4f} m in plan"
    )


def _task_rows(tasks: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """One line for all tasks, one with the stages of each scope, and of each number where a pad makes two."""
    stages = Counter((entry["scope"], entry["number"]) for entry in tasks.values())
    parts = [f"{n} x {number:,} {scope}{'s' * (number != 1)}" for (scope, number), n in stages.items()]
    total = sum(entry["number"] for entry in tasks.values())
    return [
        ("tasks", f"{total:,}: stages {', '.join(parts)}"),
        ("", "more where houses must be joined in several rounds"),
    ]


def _describe_points(files: dict[str, Any], density: str) -> str:
    """What the files hold: points, unless none of them is a point cloud."""
    kinds = files["kinds"]
    if kinds.get("cloud", 0) == files["number"]:
        return f"{files['points_in_region']:,} points in the region, {density}"
    words = {
        "cloud": ("point cloud", "point clouds"),
        "model": ("city model", "city models"),
        "terrain": ("raster of terrain", "rasters of terrain"),
    }
    return ", ".join(f"{n} {words[kind][n != 1]}" for kind, n in kinds.items())


def _footprints(found: dict[str, Any] | None) -> str:
    if found is None:
        return "none given"
    if found["complete"]:
        return f"{found['number']:,} in the region"
    return f"about {_count(found['number'])}; the first {found['sampled']:,} were read"


def _count(value: float) -> str:
    for size, word in UNITS:
        if value >= size:
            return f"{value / size:.2g} {word}" if value < 100 * size else f"{value / size:.0f} {word}"
    return f"{value:.0f}"


def _size(value: float) -> str:
    for size, unit in ((2**40, "TiB"), (2**30, "GiB")):
        if value >= size:
            return f"{_rounded(value / size):g} {unit}"
    return f"{_rounded(value / 2**20):g} MiB"


def _time(seconds: float) -> str:
    for size, unit in ((2 * 86400, "days"), (2 * 3600, "h"), (120, "min")):
        if seconds >= size:
            step = {"days": 86400, "h": 3600, "min": 60}[unit]
            return f"{seconds / step:.0f} {unit}"
    return f"{seconds:.0f} s"


def _km(metres: float) -> str:
    return f"{metres / 1000:.0f} km" if metres >= 10_000 else f"{metres:.0f} m"


def _console() -> Console:
    console = Console(highlight=False)
    return console if console.width <= WIDTH else Console(highlight=False, width=WIDTH)
