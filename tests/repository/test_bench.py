"""The benchmarks' own reckoning."""

import json
from pathlib import Path

from tests.benchmarks.bench import count_samples, inner_seconds


def test_inner_items_have_others_all_around_and_count_by_their_median(tmp_path: Path) -> None:
    places = [(x, y) for x in range(7, 11) for y in range(3, 7)]
    done = [("columns", f"{x}_{y}", x + y / 100 if x in (8, 9) and y in (4, 5) else 50.0) for x, y in places]
    done += [("seams", f"x{x}_{y}", float(x)) for x, y in places if x > 7]
    done += [("seams", f"y{x}_{y}", 1.8 * y) for x, y in places if y > 3]
    done += [("report", "region", 5.0), ("points", "7_3", 1.0), ("points", "8_4", 2.0)]
    events = [{"event": "done", "stage": stage, "name": name, "seconds": s} for stage, name, s in done]
    events.append({"event": "failed", "stage": "columns", "name": "8_4", "seconds": 99.0})
    (tmp_path / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))

    assert inner_seconds(tmp_path) == {"columns": (8.05 + 9.04) / 2, "seams": 9.0}


def test_compiled_code_counts_for_the_function_that_calls_it() -> None:
    run = "thread (1): MainThread;_run (/home/site/tiler/workflow/run.py:221)"
    task = f"{run};run_task (/home/site/tiler/engine/task.py:293)"
    cut = f"{task};make_seam (/home/site/tiler/stages/mesh.py:9);cut_walls (/home/site/stitch/tiling/walls.py:97)"
    lines = [
        f"{cut} 2",
        f"{cut};_compile_for_args (numba/core/dispatcher.py:400) 30",
        f"{task};make_seam (/home/site/tiler/stages/mesh.py:9);_amin (numpy/_core/_methods.py:45) 500",
        "thread (1): MainThread;_run (/home/site/tiler/workflow/run.py:221) 6000",
        f"thread (2): {cut.replace('MainThread', 'zarr_io')} 70000",
    ]

    assert count_samples(lines) == {
        "stitch/tiling/walls.py: cut_walls": 32,
        "tiler/stages/mesh.py: make_seam": 500,
        "driver: outside of tasks": 6000,
    }
