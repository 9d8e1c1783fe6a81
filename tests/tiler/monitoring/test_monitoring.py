"""`deploy/monitoring`: Prometheus takes its files, alerts pass their tests, all names exist."""

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.simulated_runs import simulate
from tiler.dashboard.metrics import Family, families, write_text
from tiler.monitoring.run_state import RunState

FOLDER = Path(__file__).resolve().parents[3] / "deploy" / "monitoring"
NAME = re.compile(r"\b(?:citystitch|dask)_[a-z_]+")
LABELS = {"job", "instance"}  # what Prometheus adds


@pytest.fixture(scope="module")
def metrics() -> dict[str, Family]:
    """Metrics of a run with failures and notes, by the name of their samples."""
    model = RunState()
    for event in simulate(60, done=0.5, failed=2, running=2, status="running"):
        model.fold(event)
    assert model.ignored == 0
    return {one.sample_name: one for one in families(model, alive=True)}


def promtool(*words: str) -> str:
    if shutil.which("promtool") is None:
        pytest.fail("no promtool: apt-get install prometheus; see .ci/run")
    done = subprocess.run(
        ["promtool", *words], cwd=FOLDER, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def expressions() -> list[str]:
    """All queries of the Grafana dashboard and of the alerts."""
    board = json.loads((FOLDER / "grafana.json").read_text())
    found = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    found += [one["query"] for one in board["templating"]["list"] if one["type"] == "query"]
    return found + re.findall(r"^ *expr: (.*)$", (FOLDER / "alerts.yml").read_text(), re.MULTILINE)


@pytest.mark.long
def test_prometheus_takes_the_configuration_and_the_rules() -> None:
    assert "SUCCESS" in promtool("check", "config", "prometheus.yml")
    assert re.search(r"SUCCESS: 7 rules found", promtool("check", "rules", "alerts.yml"))


@pytest.mark.long
def test_alerts_pass_their_tests() -> None:
    assert "SUCCESS" in promtool("test", "rules", "alerts_test.yml")


@pytest.mark.long
def test_what_a_run_exposes_is_what_prometheus_reads(metrics: dict[str, Family]) -> None:
    if shutil.which("promtool") is None:
        pytest.fail("no promtool: apt-get install prometheus; see .ci/run")
    words = ["promtool", "check", "metrics"]
    text = write_text(list(metrics.values()))
    done = subprocess.run(words, input=text, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_every_alert_has_a_test_that_it_fires_and_one_that_it_does_not() -> None:
    names = re.findall(r"- alert: (\w+)", (FOLDER / "alerts.yml").read_text())
    tests = (FOLDER / "alerts_test.yml").read_text()
    assert len(names) == 7
    for name in names:
        assert re.search(rf"alertname: {name}\n +exp_alerts:", tests), name
        assert re.search(rf"alertname: {name}}}", tests), name


def test_queries_name_metrics_that_exist(metrics: dict[str, Family]) -> None:
    queries = expressions()
    assert len(queries) > 20
    for query in queries:
        assert NAME.findall(query) or "up{" in query, query
        for name in NAME.findall(query):
            assert name in metrics, f"{query}: no metric {name}"


def test_queries_use_labels_and_values_that_exist(metrics: dict[str, Family]) -> None:
    for query in expressions():
        for name, inner in re.findall(r"(citystitch_[a-z_]+)\{([^}]*)\}", query):
            known: dict[str, set[str]] = {}
            for labels, _ in metrics[name].samples:
                for label, value in labels.items():
                    known.setdefault(label, set()).add(value)
            for label, value in re.findall(r'(\w+)=~?"([^"]*)"', inner):
                assert label in LABELS | set(known), f"{query}: {name} has no label {label}"
                if label not in LABELS:
                    assert set(value.split("|")) <= known[label], f"{query}: {label} is never {value}"
        for label in re.findall(r"by \(([^)]*)\)", query):
            names = NAME.findall(query)
            known_labels = LABELS | {
                key for name in names for labels, _ in metrics[name].samples for key in labels
            }
            assert {one.strip() for one in label.split(",")} <= known_labels, query


def test_the_dashboard_has_what_grafana_asks_for() -> None:
    board: dict[str, Any] = json.loads((FOLDER / "grafana.json").read_text())
    assert board["uid"] == "citystitch"
    assert len({panel["id"] for panel in board["panels"]}) == len(board["panels"])
    taken: set[tuple[int, int]] = set()
    for panel in board["panels"]:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, f"{panel['title']} lies over another panel"
        assert max(x for x, _ in cells) < 24
        taken |= cells


def test_docs_name_every_metric(metrics: dict[str, Family]) -> None:
    text = (FOLDER.parents[1] / "docs" / "monitoring.md").read_text()
    assert set(NAME.findall(text)) - {"dask_scheduler_workers"} >= set(metrics)
    unknown = {name for name in NAME.findall(text) if name.startswith("citystitch_") and not name.endswith("_")}
    assert unknown <= set(metrics)
