"""The page of a run in headless Chromium: `apt-get install chromium`, `npm install --global playwright-core`."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.simulated_runs import simulate, write_events
from tiler.dashboard.event_reader import EventReader
from tiler.dashboard.server import serve

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]
NEEDED = "apt-get install chromium nodejs npm && npm install --global playwright-core; see .ci/run"
N = 36


def run_browser(script: str, url: str, out: Path, *more: str) -> "subprocess.Popen[str]":
    """Begin a script of this folder in node, with the browser that is installed."""
    programs = {name: shutil.which(name) for name in ("chromium", "node", "npm")}
    if None in programs.values():
        pytest.fail(f"needs {programs}: {NEEDED}")
    root = subprocess.run(["npm", "root", "--global"], capture_output=True, text=True, check=True).stdout.strip()
    if not Path(root, "playwright-core").is_dir():
        pytest.fail(f"no playwright-core: {NEEDED}")
    words = [
        "node",
        str(Path(__file__).resolve().parents[2] / "helpers" / script),
        url,
        str(programs["chromium"]),
        str(out),
        *more,
    ]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ | {"NODE_PATH": root})


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a user sees of a run of 36 tiles, two failed, that goes on: two more fail while the page is open."""
    folder, out = tmp_path_factory.mktemp("run"), tmp_path_factory.mktemp("pictures")
    path = write_events(folder, simulate(N, done=0.5, failed=2, running=3, reused=0.3, status="running"))
    last: dict[str, Any] = {}
    with serve(EventReader(folder, lambda: True)) as url, run_browser("browse.js", url, out) as job:
        assert job.stdout is not None
        for line in job.stdout:
            if line.strip() == "ready":
                more = [
                    {"event": "failed", "stage": "pieces", "name": name, "reason": "r"} for name in ("2_0", "3_0")
                ]
                with path.open("a") as file:
                    file.writelines(json.dumps(event) + "\n" for event in more)
            else:
                last = json.loads(line)
        assert job.wait(60) == 0, last
    assert (out / "desktop.png").stat().st_size > 10_000
    return last


def test_there_is_no_error_and_nothing_is_fetched_from_elsewhere(seen: dict[str, Any]) -> None:
    assert seen["console"] == []
    assert seen["foreign"] == []
    assert seen["images"] == 0, "a file name became an element"


def test_the_map_shows_the_tiles_in_their_states(seen: dict[str, Any]) -> None:
    assert sum(seen["legend"].values()) == sum(seen["drawn"]) == N
    assert list(seen["legend"].values()) == seen["drawn"]
    assert (seen["legend"]["failed"], seen["legend"]["running"]) == (2, 3)
    assert seen["legend"]["done"] + seen["legend"]["reused"] >= 16
    red, green, blue = seen["colours"]["failed"]
    assert red > 2 * max(green, blue), "a failed tile is dark red"


def test_a_failure_is_listed_with_the_command_that_reproduces_it(seen: dict[str, Any]) -> None:
    item, reason, command = seen["failures"][0]
    assert item == "mesh: columns of cells 0_0"
    assert reason == "a column does not ascend <img src=x onerror=alert(1)>"
    assert command.startswith("citystitch run out/config.toml --only 0_0 --traceback")
    assert len(seen["failures"]) == 2


def test_filters_work(seen: dict[str, Any]) -> None:
    without = list(seen["drawn"])
    without[3] = 0
    assert seen["withoutDone"] == without
    assert seen["ground"]["failed"] == 0
    assert seen["ground"]["done"] + seen["ground"]["reused"] > seen["legend"]["done"] + seen["legend"]["reused"]
    assert seen["failuresOfGround"] == "None in terrain."


def test_values_are_coloured_by_a_scale(seen: dict[str, Any]) -> None:
    low, high = (int(text.replace(",", "")) for text in seen["scale"])
    assert 10_000 <= low < high <= 90_000
    assert seen["valueColour"] != seen["colours"]["done"]


def test_keys_alone_reach_everything(seen: dict[str, Any]) -> None:
    reached = [name for name, _ in seen["tabs"]]
    wanted = [
        "theme",
        "value",
        "stage",
        "closer",
        "wider",
        "fit",
        "map",
        "waiting",
        "failed",
        "terrain",
        "mesh: columns of cells 0_0",
    ]
    places = [reached.index(name) for name in wanted]
    assert places == sorted(places), "in the order in which they are read"
    assert {outline for _, outline in seen["tabs"]} == {"solid"}, "the focus shows"
    assert seen["keys"][0].startswith("Tile 0_5 ")
    assert seen["keys"][1].startswith("Tile 1_4 ")
    assert "failed" in seen["keyFailed"]
    assert "a column does not ascend" in seen["keyFailed"]
    assert seen["zoom"] > 2


def test_a_phone_needs_no_sideways_scrolling(seen: dict[str, Any]) -> None:
    assert seen["phoneOverflow"] <= 0
    assert seen["phoneSmall"] == []


def test_what_is_new_appears_by_itself(seen: dict[str, Any]) -> None:
    assert seen["later"]["failed"] == seen["failuresLater"] == 4
    assert sum(seen["later"].values()) == N
