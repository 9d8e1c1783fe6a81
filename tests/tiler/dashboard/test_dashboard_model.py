"""The state of a run from its events: counts, map, metrics, and what becomes of events that are none."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import InputError
from tests.helpers.simulated_runs import simulate, write_events
from tiler.dashboard.event_reader import EventReader
from tiler.dashboard.map_view import MOST_SHOWN, Question, describe_map
from tiler.dashboard.metrics import families, write_text
from tiler.dashboard.page_data import _describe_at_work, _describe_step, describe_page
from tiler.monitoring.items import STATES, State
from tiler.monitoring.run_state import MOST, TILE, RunState, Series
from tiler.store.out_folder import EVENTS
from tiler.words.stage_groups import group_stages


def fold(*events: object) -> RunState:
    model = RunState()
    for event in events:
        model.fold(event)
    return model


def begun(*more: dict[str, Any]) -> RunState:
    """A run of two tiles side by side and two stages, and what happened then."""
    return fold(
        {"event": "run", "t": 10.0, "status": "running", "workers": 2},
        {"event": "tiles", "tiles": [["0_0", 0, 0, 10, 10], ["1_0", 10, 0, 20, 10]]},
        {"event": "planned", "stage": "houses", "scope": "tile", "total": 2},
        {"event": "planned", "stage": "pieces", "scope": "tile", "total": 2},
        *more,
    )


def item(event: str, stage: str, name: str, **more: Any) -> dict[str, Any]:
    return {"event": event, "t": 11.0, "stage": stage, "name": name} | more


def states(model: RunState, stage: str = "") -> list[str]:
    return [STATES[code] for code in model.items[TILE].codes(stage)]


def test_a_tile_goes_from_waiting_to_done() -> None:
    events = [
        item("submitted", "houses", "0_0"),
        item("done", "houses", "0_0", seconds=2.0),
        item("submitted", "pieces", "0_0"),
        item("done", "pieces", "0_0", seconds=1.0),
    ]
    seen = [states(begun(*events[:k]))[0] for k in range(5)]
    assert seen == ["waiting", "running", "begun", "running", "done"]
    model = begun(*events)
    assert states(model) == ["done", "waiting"]
    assert [begun(*events[:k]).items[TILE].values("progress", "")[0] for k in (0, 2, 4)] == [0.0, 50.0, 100.0]
    assert model.items[TILE].values("seconds", "")[0] == 3.0
    assert model.items[TILE].values("seconds", "pieces")[0] == 1.0
    assert np.isnan(model.items[TILE].values("seconds", "")[1])


def test_one_failure_shows_whatever_else_is_done() -> None:
    model = begun(
        item("done", "houses", "0_0"),
        item("failed", "pieces", "0_0", reason="too steep", command="citystitch run x"),
    )
    assert states(model) == ["failed", "waiting"]
    assert states(model, "houses") == ["done", "waiting"]
    assert [(one.name, one.reason, one.command) for one in model.failures] == [
        ("0_0", "too steep", "citystitch run x")
    ]


def test_a_tile_that_is_taken_again_around_a_hole_counts_once() -> None:
    done = item("done", "houses", "0_0", seconds=2.0, notes={"footprint-sliver": 3})
    again = done | {"reused": True, "seconds": 0.0}
    model = begun(done, again)
    assert states(model, "houses")[0] == "done"
    assert model.notes == {"footprint-sliver": 3}
    assert model.stages["houses"].done == 1
    assert model.items[TILE].values("dropped", "")[0] == 3
    reused = begun(done | {"reused": True, "seconds": 0.0})
    assert np.isnan(reused.items[TILE].values("seconds", "")[0]), "no time of this run"
    assert reused.items[TILE].values("dropped", "")[0] == 3


def test_what_a_run_that_ends_has_in_hand_is_given_up() -> None:
    model = begun(item("submitted", "houses", "1_0"), {"event": "run", "t": 12.0, "status": "stopped"})
    assert states(model) == ["waiting", "waiting"]
    assert _describe_at_work(model, alive=False) == []
    assert model.stages["houses"].counts[State.RUNNING] == 0


def test_what_is_no_event_is_counted_and_changes_nothing() -> None:
    strange: list[object] = [
        None, 3, [], {}, {"event": "unheard"}, {"event": "done", "stage": "houses"},
        {"event": "tiles", "tiles": [["a", 1]]}, {"event": "planned", "stage": "x", "total": "many"},
        {"event": "message", "text": "x", "t": float("nan")}, item("done", "houses", "0_0", notes=[1]),
        item("done", "houses", "0_0", seconds=1e999),
    ]  # fmt: skip
    model = begun()
    for event in strange:
        model.fold(event)
    assert model.ignored == len(strange)
    assert states(model) == ["waiting", "waiting"]


def test_facts_of_tiles_are_values_to_colour_by() -> None:
    model = begun(
        item("done", "houses", "1_0", facts={"cells": 7, "worst_ratio": 0.3, "name": "x", "much": 1e999})
    )
    found = describe_map(model, "r", Question(value="cells"))
    assert found["rows"] == [[0, State.WAITING, None], [1, State.BEGUN, 7.0]]
    assert found["range"] == [7.0, 7.0]
    assert sorted(model.items[TILE].facts) == ["cells", "worst_ratio"]


def test_the_map_tells_what_changed_and_nothing_else() -> None:
    model = begun()
    first = describe_map(model, "r", Question())
    assert first["whole"]
    assert first["boxes"] == [[0, 0, 10, 10], [10, 0, 20, 10]]
    since = model.version + 1
    model.fold(item("done", "houses", "1_0"))
    later = describe_map(model, "r", Question(since=since, key=first["key"]))
    assert not later["whole"]
    assert later["rows"] == [[1, State.BEGUN, None]]
    model.fold({"event": "planned", "stage": "late", "scope": "tile", "total": 2})
    assert describe_map(model, "r", Question(since=model.version + 1, key=first["key"]))["whole"], (
        "done is done no more"
    )
    assert describe_map(model, "another", Question(since=since, key=first["key"]))["whole"]


@pytest.mark.parametrize("n", [10, MOST_SHOWN, MOST_SHOWN + 1, 20_000])
def test_a_map_of_any_size_counts_every_tile_once(n: int) -> None:
    width = int(np.ceil(np.sqrt(n)))
    rows = [
        [f"{k}", k % width * 9.5, k // width * 9.5, (k % width + 1) * 9.5, (k // width + 1) * 9.5]
        for k in range(n)
    ]
    model = fold(
        {"event": "tiles", "tiles": rows}, {"event": "planned", "stage": "p", "scope": "tile", "total": n},
        item("failed", "p", "3"), *[item("done", "p", str(k), facts={"worst": k}) for k in range(4, n, 2)],
    )  # fmt: skip
    found = describe_map(model, "r", Question(value="worst"))
    assert len(found["rows"]) <= MOST_SHOWN
    expected = [0] * len(State)
    expected[State.FAILED], expected[State.DONE] = 1, len(range(4, n, 2))
    expected[State.WAITING] = n - sum(expected)
    assert found["tiles"] == expected
    if n > MOST_SHOWN:
        assert found["level"] > 1
        assert np.sum([row[3] for row in found["rows"]], axis=0).tolist() == expected
        assert [row[1] for row in found["rows"]].count(State.FAILED) == 1
        assert min(row[2] for row in found["rows"] if row[2] is not None) == 4.0, "the worst tile, not the mean"
        near = describe_map(model, "r", Question(view=(0.0, 0.0, 90.0, 90.0)))
        assert near["level"] == 1
        assert len(near["rows"]) == 100
    else:
        assert found["level"] == 1


def test_the_file_is_followed_line_by_line_and_begun_anew(tmp_path: Path) -> None:
    path = write_events(tmp_path, simulate(9, done=1.0))
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:20]) + lines[20][:15])
    follower = EventReader(tmp_path, lambda: True)
    follower.advance()
    assert (follower.model.version, follower.model.ignored) == (20, 0)
    with path.open("a") as file:
        file.write(lines[20][15:] + "".join(lines[21:]))
    follower.advance()
    assert follower.model.version == len(lines)
    assert states(follower.model) == ["done"] * 9
    before = follower.run
    other = tmp_path / "other"
    write_events(other, simulate(4, done=0.0, running=1, status="running")).replace(path)
    follower.advance()
    assert follower.run != before
    assert states(follower.model) == ["running", *["waiting"] * 3]


def test_reading_a_long_file_is_dealt_out_over_questions(tmp_path: Path) -> None:
    write_events(tmp_path, simulate(4000))
    follower = EventReader(tmp_path, lambda: False)
    follower.advance(0.0)
    assert 0 < follower.share < 1
    while follower.share < 1:
        follower.advance(0.0)
    assert states(follower.model).count("done") == 4000
    assert follower.model.ignored == 0


def test_a_run_without_events_is_told_from_its_record(small_run: Path, tmp_path: Path) -> None:
    record = json.loads((small_run / "run.json").read_bytes())
    record["missing"] = {"7_7": {"stage": "columns", "name": "7_7", "reason": "why", "command": "do"}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    answer = describe_page(EventReader(tmp_path), Question(value="cells"))
    assert answer["head"]["status"] == "done"
    assert answer["map"]["tiles"][State.DONE] == len(record["tiles"]) == 4
    assert sum(row[2] for row in answer["map"]["rows"]) == pytest.approx(record["counts"]["cells"], rel=1e-3)
    assert [(one["name"], one["command"]) for one in answer["failures"]] == [("7_7", "do")]


def test_a_folder_of_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds neither events\.jsonl nor run\.json"):
        EventReader(tmp_path).advance()
    (tmp_path / "run.json").write_text("[]")
    with pytest.raises(InputError, match="is damaged"):
        EventReader(tmp_path).advance()


def test_a_run_whose_process_is_gone_is_dead(tmp_path: Path) -> None:
    write_events(tmp_path, simulate(4, done=0.5, status="running"))
    assert describe_page(EventReader(tmp_path), Question())["head"]["status"] == "dead"
    assert describe_page(EventReader(tmp_path, lambda: True), Question())["head"]["status"] == "running"


def test_what_is_left_follows_from_measured_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the terminal tells it: a stage that nobody has measured counts by its usual part of the work."""
    monkeypatch.setattr("tiler.dashboard.page_data.time.time", lambda: 110.0)
    (tmp_path / EVENTS).write_text("")
    follower = EventReader(tmp_path, lambda: True)
    follower.advance()
    follower.model = begun(
        item("submitted", "houses", "0_0") | {"t": 100.0},
        item("done", "houses", "0_0", seconds=4.0, total=2) | {"t": 104.0},
        item("done", "pieces", "0_0", seconds=2.0, total=2) | {"t": 106.0},
    )
    head = describe_page(follower, Question())["head"]
    assert head["left"] == pytest.approx((4.0 + 2.0) * 10.0 / 6.0)  # 6 s of work took 10 s
    assert head["share"] == pytest.approx(0.5)
    follower.model.fold({"event": "planned", "stage": "columns", "scope": "tile", "total": 2})
    more = (4.0 + 2.0) * 2 * 0.13 / (0.13 + 0.10)
    head = describe_page(follower, Question())["head"]
    assert head["left"] == pytest.approx((4.0 + 2.0 + more) * 10.0 / 6.0)
    assert head["share"] == pytest.approx(6.0 / (12.0 + more), abs=1e-4)


def test_what_runs_is_no_more_than_workers_can_run() -> None:
    """Workers have several tasks in hand; those behind the first wait."""
    model = RunState()
    model.fold({"event": "run", "t": 1.0, "status": "running", "workers": 2})
    model.fold({"event": "tiles", "tiles": [[f"{k}_0", k, 0, k + 1, 1] for k in range(4)]})
    model.fold({"event": "planned", "stage": "columns", "scope": "tile", "total": 4})
    for k in range(4):
        model.fold(item("submitted", "columns", f"{k}_0") | {"t": 2.0 + k})
    assert model.stages["columns"].counts[State.RUNNING] == 2
    assert list(model.queued) == [("columns", "2_0"), ("columns", "3_0")]
    model.fold(item("done", "columns", "0_0") | {"t": 9.0})
    assert model.stages["columns"].counts[State.RUNNING] == 2
    assert model.at_work["columns", "2_0"] == 9.0  # since when it runs
    model.fold(item("done", "columns", "3_0") | {"t": 9.5})  # of the other worker's own
    assert (model.stages["columns"].counts[State.RUNNING], list(model.queued)) == (2, [])
    model.fold(item("failed", "columns", "1_0", reason="wet") | {"t": 10.0})
    model.fold(item("done", "columns", "2_0") | {"t": 11.0})
    assert (model.stages["columns"].counts[State.RUNNING], model.at_work) == (0, {})


def test_stages_are_told_as_steps() -> None:
    model = begun(
        item("done", "near-0", "0_0", seconds=1.0, total=2),
        item("done", "shapes-0", "0_0", seconds=2.0, total=2),
        item("done", "canopy", "0_0", seconds=3.0, total=1),
    )
    steps = {name: _describe_step(model, name, names) for name, names in group_stages(model.stages).items()}
    assert {"simplification", "canopy"} <= set(steps)
    assert not {"near-0", "shapes-0"} & set(steps)
    assert (steps["simplification"]["done"], steps["simplification"]["seconds"]) == (2, 3.0)


def test_intervals_are_bounded_and_lose_nothing() -> None:
    series = Series()
    for t in range(5000):
        series.add(float(t), seconds=1.0, memory=t, running=1)
    rows = series.rows()
    assert len(rows) <= MOST
    assert sum(row[0] for row in rows) == 5000
    assert rows[-1][2] == 4999


def test_metrics_count_what_the_page_counts() -> None:
    model = begun(
        item("done", "houses", "0_0", seconds=2.5, memory=7, facts={"cells": 11, "worst_ratio": 0.25}),
        item("done", "pieces", "0_0", reused=True, facts={"bytes": 40}),
        item("failed", "houses", "1_0", reason="r"),
    )
    text = write_text(families(model, alive=True))
    samples = dict(re.findall(r"^([a-z_]+(?:\{[^}]*\})?) (\S+)$", text, re.MULTILINE))
    assert samples['citystitch_items{stage="houses",scope="tile",state="done"}'] == "1"
    assert samples['citystitch_items{stage="pieces",scope="tile",state="reused"}'] == "1"
    assert samples['citystitch_items{stage="pieces",scope="tile",state="waiting"}'] == "1"
    assert samples['citystitch_tiles{state="failed"}'] == "1"
    assert samples['citystitch_failures_total{stage="houses"}'] == "1"
    assert samples['citystitch_stage_seconds_total{stage="houses"}'] == "2.5"
    assert samples["citystitch_cells"] == "11"
    assert samples["citystitch_written_bytes"] == "40"
    assert samples["citystitch_memory_peak_bytes"] == "7"
    assert samples['citystitch_quality_minimum{measure="worst_ratio"}'] == "0.25"
    assert samples['citystitch_run_status{status="running"}'] == "1"
    dead = write_text(families(model, alive=False))
    assert 'citystitch_run_status{status="dead"} 1' in dead
