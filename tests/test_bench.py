"""The benchmarks' own reckoning."""

import json
from pathlib import Path

from tests.benchmarks.bench import inner_seconds


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
