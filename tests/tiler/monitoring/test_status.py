"""The status of a run: alive, dead, finished, failed, from what is on disk alone."""

import fcntl
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.data.errors import CityError, ConfigError, InputError
from tests.helpers.towns import Town, make_town
from tests.runs.test_run import hashes
from tiler.cli.main import main, make_parser
from tiler.config.config import make_config
from tiler.config.config_file import with_file
from tiler.engine.stage import Scope
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart
from tiler.monitoring.events import Event
from tiler.monitoring.progress import ProgressFile, command_line
from tiler.monitoring.run_state import RunState
from tiler.monitoring.status import read_status
from tiler.monitoring.watchers import Watchers
from tiler.store.folder_lock import LOCK, is_held, only_run
from tiler.workflow.run import run

ROOT = Path(__file__).resolve().parents[3]
KILLED = """
import os, signal, sys
import tiler.monitoring.progress
from tiler.config.config import make_config
from tiler.monitoring.progress import ProgressFile
from tiler.workflow.run import run
tiler.monitoring.progress.EVERY = 0.0
take = ProgressFile.take
def stop(self, event, state):
    take(self, event, state)
    if event.get("stage") == "columns" and event.get("done") == event.get("total", 0):
        os.kill(os.getpid(), signal.SIGKILL)
ProgressFile.take = stop
run(make_config(eval(sys.argv[1])))
"""


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"))


def show(out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert main(["status", str(out)]) == 0
    return capsys.readouterr().out


def row(text: str, stage: str) -> list[str]:
    """The row of a stage in the table: done, of, used again, running, failed, left, and its time."""
    (found,) = (line.split() for line in text.splitlines() if re.match(rf"{stage} +\d", line))
    return found[1:]


def test_a_finished_run(town: Town, capsys: pytest.CaptureFixture[str]) -> None:
    status = read_status(town.out)
    record = json.loads((town.out / "run.json").read_text())
    assert (status["state"], status["held"], status["error"]) == ("done", False, "")
    assert {name: stage["finished"] for name, stage in status["stages"].items()} == record["finished"]
    n = {stage.name: len(list(stage.iterdir())) for stage in (town.out / "store.zarr").iterdir() if stage.is_dir()}
    assert {name: stage["done"] for name, stage in status["stages"].items()} == n
    assert all(stage["left"] == stage["running"] == 0 for stage in status["stages"].values())
    assert status["running"] == []
    text = show(town.out, capsys)
    assert ": done, " in text
    assert row(text, "mesh")[:6] == ["4", "4", "0", "0", "0", "0"]
    assert text.splitlines()[-1] == f"next: citystitch check {town.out}"


def test_json_is_all_of_it(town: Town, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", str(town.out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == read_status(town.out)


def test_a_run_at_work(
    town: Town, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tiler.monitoring.progress.EVERY", 0.0)
    out = tmp_path / "out"
    seen: dict[str, Any] = {}

    take = ProgressFile.take

    def look(self: ProgressFile, event: Event, state: RunState) -> None:
        take(self, event, state)
        if event.get("stage") == "seams" and event.get("done") == event.get("total", 0):
            seen["status"], seen["text"] = read_status(out), show(out, capsys)

    monkeypatch.setattr(ProgressFile, "take", look)
    run(town.config(out))
    status = seen["status"]
    assert (status["state"], status["held"], status["pid"]) == ("running", True, os.getpid())
    stages = status["stages"]
    assert "finished" in stages["model"]
    assert (stages["columns"]["total"], stages["columns"]["done"]) == (4, 0)
    assert (stages["seams"]["done"], stages["seams"]["finished"] > 0) == (12, True)
    running = Counter(item["stage"] for item in status["running"])
    assert running == {name: stage["running"] for name, stage in stages.items() if stage["running"]}
    assert status["n_running"] == running.total() > 0
    # Pieces are given out with the columns that they are made of: those of three tiles.
    assert (stages["pieces"]["left"], stages["report"]["left"]) == (1, 1)
    assert next(iter(stages)) == "points"
    assert f"running, process {os.getpid()} on {socket.gethostname()}, since " in seen["text"]
    assert f"next: wait, and ask again: citystitch status {out}" in seen["text"].replace("\n", " ")


def test_a_killed_run_is_told_to_be_dead_and_gone_on_with(
    town: Town, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a folder"
    config: dict[str, Any] = {
        "pointcloud": [str(town.folder / "tiles")],
        "footprints": str(town.folder / "footprints.gpkg"),
    }
    config |= {"out": str(out), "tile_size": 140.0, "domain_height": 70.0}
    process = subprocess.run([sys.executable, "-c", KILLED, repr(config)], cwd=ROOT, check=False)
    assert process.returncode == -signal.SIGKILL
    status = read_status(out)
    assert (status["state"], status["held"]) == ("stopped", False)
    # A tile's piece is made after its columns in one submission: the last tile's was at work.
    assert {count: status["stages"]["pieces"][count] for count in ("done", "running", "left")} == {
        "done": 3,
        "running": 1,
        "left": 0,
    }
    text = show(out, capsys)
    assert "stopped without a word after " in text
    command = text.splitlines()[-1]
    assert main(shlex.split(command)[1:]) == 0
    assert read_status(out)["state"] == "done"
    assert read_status(out)["stages"]["model"]["reused"] == 4
    assert hashes(out) == hashes(town.out)


def test_a_failed_run(town: Town, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    config = town.config(out, domain_height=17.0)
    with pytest.raises(CityError, match="seams: seams") as error:
        run(config)
    status = read_status(out)
    assert (status["state"], status["error"]) == ("failed", str(error.value))
    seams = status["stages"]["seams"]
    assert seams["failed"] == 1
    assert seams["total"] == sum(seams[count] for count in ("done", "failed", "running", "left"))
    text = show(out, capsys)
    assert row(text, "seams")[4] == "1"
    assert f"error: {error.value}" in " ".join(text.split())
    options = make_parser().parse_args(shlex.split(text.splitlines()[-1])[1:])
    assert make_config(with_file(vars(options))) == config


def progress_of(out: Path, command: str | None = None) -> Watchers:
    config = make_config({"pointcloud": ["a.laz"], "out": str(out)})
    told = Watchers([ProgressFile(out, config, command=command)])
    expected = {"first": (Scope.TILE, 2), "second": (Scope.TILE, 3)}
    told.begin(RunStart(out, "", (0.0, 0.0, 1.0, 1.0), "EPSG:28992", 1.0, 2, {}, {}, expected))
    return told


def test_a_folder_that_is_held_by_a_run_of_which_nothing_is_written_yet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    progress_of(tmp_path).end("failed", "no room")
    with only_run(tmp_path):
        assert read_status(tmp_path)["state"] == "running"
        assert "a run has begun, but not with its stages" in show(tmp_path, capsys)
    assert read_status(tmp_path)["state"] == "failed"
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    progress_of(tmp_path)
    path = tmp_path / "progress.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"pid": dead.pid}))
    with only_run(tmp_path):
        assert "a run has begun, but not with its stages" in show(tmp_path, capsys)


@pytest.mark.parametrize(
    "others",
    [
        {},
        {"split_levels": False, "manifold": True, "workers": 3},
        {"bounds": (-1000.5, 2.0, 1e6, 3e5), "crs": "EPSG:28992"},
        {"pointcloud": ["a b.laz", "c's.laz"], "out": "somewhere else", "height_attribute": "h o"},
    ],
)
def test_the_command_has_all_parameters(tmp_path: Path, others: dict[str, Any]) -> None:
    config = make_config({"pointcloud": ["a.laz"], "out": str(tmp_path), "overwrite": True} | others)
    options = make_parser().parse_args(shlex.split(command_line(config))[1:])
    assert make_config(with_file(vars(options))) == replace(config, overwrite=False)


def test_stages_of_the_users_own_have_no_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    progress_of(tmp_path, "")
    assert "call tiler.workflow.run.run again, with the same stages" in show(tmp_path, capsys)


def test_what_is_no_run_and_what_is_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match=r"holds neither run\.json nor progress\.json; give the folder of a run"):
        read_status(tmp_path)
    assert main(["status", str(tmp_path)]) == 1
    progress_of(tmp_path)
    path = tmp_path / "progress.json"
    whole = path.read_text()
    for damage in (
        whole[:40],
        "[]",
        whole.replace("total", "totol"),
        whole.replace('"started": "', '"started": "x'),
    ):
        path.write_text(damage)
        with pytest.raises(InputError, match=r"progress\.json: is damaged .*; run again"):
            read_status(tmp_path)


def test_the_file_is_written_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    progress = progress_of(tmp_path)
    path = tmp_path / "progress.json"
    begin = path.read_text()
    for k in range(2):
        progress.submitted("first", f"{k}")
        progress.done(
            "first", k + 1, 2, Record("first", f"{k}", "", "", {}, {"odd": 2}, {"all": 1.5}, reused=k == 0)
        )
    assert path.read_text() == begin
    now = time.perf_counter()
    monkeypatch.setattr("time.perf_counter", lambda: now + 2.1)
    progress.submitted("second", "a")
    status = read_status(tmp_path)
    first = status["stages"]["first"]
    assert (first["done"], first["reused"], first["seconds"], first["left"]) == (2, 1, 3.0, 0)
    assert status["notes"] == {"odd": 4}
    assert [(item["stage"], item["name"]) for item in status["running"]] == [("second", "a")]
    assert status["stages"]["second"]["left"] == 2


def test_asking_does_not_keep_a_run_out(tmp_path: Path) -> None:
    """A lock that is held for a blink is waited for; a run's own is not."""
    (tmp_path / LOCK).touch()
    asked = os.open(tmp_path / LOCK, os.O_RDONLY)
    fcntl.flock(asked, fcntl.LOCK_SH)
    assert not is_held(tmp_path)
    timer = threading.Timer(0.08, os.close, (asked,))
    timer.start()
    with only_run(tmp_path):
        assert is_held(tmp_path)
        with pytest.raises(ConfigError, match="another run is at work there"), only_run(tmp_path):
            pass
    timer.join()
