"""The events of a run: what is written, when, and what a reader finds of a run at work, ended or killed."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from pipeline.data.errors import CityError, ConfigError, InputError, OutputError
from tests.helpers.towns import Town, make_town
from tiler.cli.main import make_parser
from tiler.config.config import make_config
from tiler.config.config_file import with_file
from tiler.engine.stage import Facts, Scope
from tiler.engine.task import Record
from tiler.engine.watcher import RunStart, Watcher
from tiler.monitoring.event_log import EventLog
from tiler.monitoring.events import begin_file, list_numbers, open_log, read_events
from tiler.monitoring.watchers import Watchers, describe_command
from tiler.workflow.run import run

BOX = (0.0, 0.0, 10.0, 10.0)
ROOT = Path(__file__).resolve().parents[3]
KILLED = """
import os, signal, sys, time
from itertools import count
from pathlib import Path
from tiler.monitoring.event_log import EventLog
from tiler.monitoring.events import begin_file
from tiler.monitoring.watchers import Watchers
path = Path(sys.argv[1])
file = begin_file(path)
Watchers([EventLog(path, file, every=0.05)]).say("first")
while not path.stat().st_size:
    time.sleep(0.01)
os.write(file, b'{"t": 1, "event": "mess')
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"))


def start_of(out: Path, n: int = 2, command: str = "citystitch run a.laz") -> RunStart:
    tiles = {f"{k}_0": (10.0 * k, 0.0, 10.0 * k + 10.0, 10.0) for k in range(n)}
    seams = {f"y{k}_0": (10.0 * k, 0.0, 10.0 * k, 10.0) for k in range(n + 1)}
    expected = {"points": (Scope.FILE, 1), "columns": (Scope.TILE, n)}
    return RunStart(
        out, command, (0.0, 0.0, 10.0 * n, 10.0), "EPSG:28992", 10.0, 2, tiles, seams, expected, frozenset({"fit"})
    )


def make_log(path: Path, every: float = 0.0) -> Watchers:
    return Watchers([EventLog(path, begin_file(path), every=every)])


def record_of(stage: str, name: str, **others: Any) -> Record:
    return Record(stage, name, "", "", others.pop("facts", {}), others.pop("notes", {}), **others)


def kinds(path: Path) -> list[str]:
    return [event["event"] for event in read_events(path)]


def test_every_event_has_its_line(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    log = make_log(path)
    before = time.time()
    log.begin(start_of(tmp_path))
    log.submitted("columns", "0_0")
    facts: Facts = {"counts": {"cells": 7, "facets": 0}, "order": "heights", "seams": {"x0_0": {"faces": 3}}}
    log.done("columns", 1, 2, record_of("columns", "0_0", facts=facts, notes={"odd": 2}, seconds={"all": 1.23456}))
    log.done("columns", 2, 2, record_of("columns", "1_0", reused=True, peak_memory=2**30))
    log.failed("columns", "1_0", "it is too wet")
    log.failed("pieces", "1_0", "not run: columns 1_0 is not there", ("columns", "1_0"))
    log.say("a 'line'\nand \udcff another")
    log.end("done")
    found = list(read_events(path))
    assert all(before - 0.001 <= event.pop("t") <= time.time() + 0.001 for event in found)
    assert [json.dumps(event) for event in found] == [json.dumps(event) for event in EXPECTED(tmp_path)]


def EXPECTED(out: Path) -> list[dict[str, Any]]:  # noqa: N802
    head = {
        "error": "",
        "command": "citystitch run a.laz",
        "bounds": [0.0, 0.0, 20.0, 10.0],
        "crs": "EPSG:28992",
        "tile_size": 10.0,
        "workers": 2,
    }
    done = {"event": "done", "stage": "columns"}
    return [
        {"event": "run", "status": "running", **head},
        {"event": "tiles", "tiles": [["0_0", 0.0, 0.0, 10.0, 10.0], ["1_0", 10.0, 0.0, 20.0, 10.0]]},
        {"event": "seams", "seams": [[f"y{k}_0", 10.0 * k, 0.0, 10.0 * k, 10.0] for k in range(3)]},
        {"event": "planned", "stage": "points", "scope": "file", "total": 1},
        {"event": "planned", "stage": "columns", "scope": "tile", "total": 2},
        {"event": "submitted", "stage": "columns", "name": "0_0"},
        {**done, "name": "0_0", "done": 1, "total": 2, "seconds": 1.235, "memory": 0, "reused": False}
        | {"notes": {"odd": 2}, "facts": {"cells": 7}},
        {**done, "name": "1_0", "done": 2, "total": 2, "seconds": 0.0, "memory": 2**30, "reused": True}
        | {"notes": {}, "facts": {}},
        {"event": "failed", "stage": "columns", "name": "1_0", "reason": "it is too wet"}
        | {"command": f"citystitch run {out}/config.toml --only 1_0 --traceback"},
        {"event": "failed", "stage": "pieces", "name": "1_0", "reason": "not run: columns 1_0 is not there"}
        | {"command": "", "needs": ["columns", "1_0"]},
        {"event": "message", "text": "a 'line'\nand \udcff another"},
        {"event": "run", "status": "done", **head},
    ]


def test_many_tiles_are_told_in_chunks(tmp_path: Path) -> None:
    log = make_log(tmp_path / "e")
    log.begin(start_of(tmp_path, 2500))
    log.end("done")
    found = [event["tiles"] for event in read_events(tmp_path / "e") if event["event"] == "tiles"]
    assert [len(chunk) for chunk in found] == [1000, 1000, 500]
    assert found[2][-1] == ["2499_0", 24990.0, 0.0, 25000.0, 10.0]


@pytest.mark.parametrize(
    ("stage", "scope", "name", "ends"),
    [
        ("columns", Scope.TILE, "1_0", "config.toml --only 1_0 --traceback"),
        # The tile on the one side of it, as there is none on the other.
        ("seams", Scope.SEAM, "y0_0", "config.toml --only 0_0 --traceback"),
        ("seams", Scope.SEAM, "y2_0", "config.toml --only 1_0 --traceback"),
        ("fit", Scope.TILE, "1_0", "citystitch run a.laz --traceback"),
        ("points", Scope.FILE, "1_0", "citystitch run a.laz --traceback"),
        ("report", Scope.REGION, "region", "citystitch run a.laz --traceback"),
    ],
)
def test_the_command_shows_the_failure(tmp_path: Path, stage: str, scope: Scope, name: str, ends: str) -> None:
    command = describe_command(start_of(tmp_path), stage, scope, name)
    assert command.endswith(ends)
    assert make_parser().parse_args(command.split()[1:]).traceback
    assert (describe_command(start_of(tmp_path, command=""), "fit", Scope.TILE, "1_0")) == ""


def test_numbers_are_finite_and_tell_something() -> None:
    facts: Facts = {"n": 3, "extent": [1.0, 2.0], "i0": 5, "proved": True, "bad": float("nan"), "zero": 0.0}
    assert list_numbers(facts) == {"n": 3}


def test_a_whole_run(town: Town) -> None:
    record = json.loads((town.out / "run.json").read_text())
    found = list(read_events(town.out / "events.jsonl"))
    assert (found[0]["event"], found[0]["status"]) == ("run", "running")
    assert (found[-1]["event"], found[-1]["status"], found[-1]["error"]) == ("run", "done", "")
    assert found[0]["bounds"] == record["region"]["bounds"]
    assert {tile[0]: tile[1:] for event in found if event["event"] == "tiles" for tile in event["tiles"]} == {
        name: tile["box"] for name, tile in record["tiles"].items()
    }
    done = [event for event in found if event["event"] == "done"]
    assert Counter(event["stage"] for event in done) == record["ran"]
    submitted = [(event["stage"], event["name"]) for event in found if event["event"] == "submitted"]
    assert sorted(submitted) == sorted((event["stage"], event["name"]) for event in done)
    pieces = {event["name"]: event["facts"]["cells"] for event in done if event["stage"] == "pieces"}
    assert pieces == {name: tile["counts"]["cells"] for name, tile in record["tiles"].items()}
    assert all(0.0 < event["facts"]["worst_ratio"] < 1.0 for event in done if event["stage"] == "columns")
    assert [event["text"] for event in found if event["event"] == "message"][-1] == (
        f"{record['tasks']['ran']} of {record['tasks']['all']} tasks ran, 0 results were there"
    )
    planned = {event["stage"]: event["total"] for event in found if event["event"] == "planned"}
    assert planned == Counter(event["stage"] for event in done)
    options = make_parser().parse_args(found[0]["command"].split()[1:])
    assert make_config(with_file(vars(options))).out == str(town.out)


def test_a_run_that_fails_says_so_and_the_next_starts_the_file_anew(town: Town, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(CityError, match="seams: seams") as error:
        run(town.config(out, domain_height=17.0))
    found = list(read_events(out / "events.jsonl"))
    assert (found[-1]["status"], found[-1]["error"]) == ("failed", str(error.value))
    failed = {(event["stage"], event["name"]): event for event in found if event["event"] == "failed"}
    (seam,) = (event for (stage, _), event in failed.items() if stage == "seams")
    assert seam["reason"] in str(error.value)
    assert seam["command"]
    north = failed["columns", "2271_45708"]
    assert (north["reason"], north["command"]) == (f"not run: seams {seam['name']} is not there", "")
    with (out / "events.jsonl").open("rb") as old:
        run(town.config(out))
        assert old.read().count(b"\n") == len(found)
    again = list(read_events(out / "events.jsonl"))
    assert [event["status"] for event in again if event["event"] == "run"] == ["running", "done"]
    assert any(event["reused"] for event in again if event["event"] == "done")


class Broken(Watcher):
    """A watcher that fails at the end."""

    def end(self, status: str, error: str = "") -> None:
        raise OutputError(f"{status}: no room")


class Heard(Watcher):
    """A watcher that keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[Any] = []

    def begin(self, start: RunStart) -> None:
        self.told.append("begin")

    def say(self, text: str) -> None:
        self.told.append(text)

    def end(self, status: str, error: str = "") -> None:
        self.told.append((status, error))


def test_watchers_hear_of_a_run_that_does_not_begin(tmp_path: Path) -> None:
    heard, config = Heard(), make_config({"pointcloud": [str(tmp_path / "no.laz")], "out": str(tmp_path / "out")})
    with pytest.raises(CityError) as error:
        run(config, watchers=[heard])
    assert heard.told == [("failed", str(error.value))]
    assert not (tmp_path / "out" / "events.jsonl").exists()


def test_who_comes_late_hears_what_was_said_and_all_hear_the_end(tmp_path: Path) -> None:
    first, late = Heard(), Heard()
    watchers = Watchers([first, Broken()])
    watchers.say("early")
    watchers.add(late)
    watchers.begin(start_of(tmp_path))
    watchers.say("then")
    with pytest.raises(OutputError, match="done: no room"):
        watchers.end("done")
    watchers.end("failed")
    assert first.told == ["early", "begin", "then", ("done", "")]
    assert late.told == ["begin", "early", "then", ("done", "")]


def test_lines_are_written_now_and_then_without_further_events(tmp_path: Path) -> None:
    path = tmp_path / "e"
    log = make_log(path, every=0.2)
    log.say("one")
    assert kinds(path) == []
    end = time.monotonic() + 20
    while kinds(path) != ["message"]:
        assert time.monotonic() < end
        time.sleep(0.02)
    log.end("done")
    assert kinds(path) == ["message", "run"]


def test_a_cut_off_line_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "e"
    process = subprocess.run([sys.executable, "-c", KILLED, str(path)], cwd=ROOT, check=False)
    assert process.returncode == -signal.SIGKILL
    assert path.read_bytes().endswith(b"mess")
    assert [event["text"] for event in read_events(path)] == ["first"]
    path.write_bytes(b'[]\n{"event":"run"}\nnonsense\n\xff\n{"event":"tiles"}\n\0\0\0')
    assert kinds(path) == ["run", "tiles"]
    with pytest.raises(InputError, match="cannot be read"):
        list(read_events(tmp_path / "none"))


def test_a_handler_may_say_something_in_the_middle_of_a_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal comes while a line is written: its handler adds one, and neither is lost."""
    log = make_log(tmp_path / "e")
    write, calls = os.write, count()

    def interrupted(file: int, data: memoryview) -> int:
        if next(calls) == 1:  # the first line is written in part
            log.say("handler")
        return write(file, data[:10])

    monkeypatch.setattr(os, "write", interrupted)
    log.say("outer")
    monkeypatch.undo()
    log.end("done")
    texts = [event.get("text") for event in read_events(tmp_path / "e")]
    assert sorted(texts, key=str) == [None, "handler", "outer"]


def test_a_full_disk_ends_the_run_where_it_can_be_told(tmp_path: Path) -> None:
    log = Watchers([EventLog(Path("/dev/full"), os.open("/dev/full", os.O_WRONLY), every=0.01)])

    def speak() -> None:
        for _ in range(6000):  # the thread that writes gets its turn when the machine has time
            log.say("a line")
            time.sleep(0.01)

    with pytest.raises(OutputError, match=r"/dev/full: cannot be written \(No space left on device\); free space"):
        speak()
    with pytest.raises(OutputError, match="No space left"):
        log.end("failed")


def test_a_line_after_a_cut_one_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = make_log(tmp_path / "e")
    write = os.write

    def full(file: int, data: memoryview) -> int:
        if len(data) < 20:
            raise OSError(28, "No space left on device")
        return write(file, data[:20])

    monkeypatch.setattr(os, "write", full)
    log.say("this line does not fit into the disk")
    monkeypatch.undo()
    log.end("failed", "no room")
    assert [event["error"] for event in read_events(tmp_path / "e")] == ["no room"]


def test_a_log_takes_the_place_of_nothing_but_a_log(tmp_path: Path) -> None:
    path = tmp_path / "log"
    log = Watchers([EventLog(path, open_log(path), every=0.0)])
    log.say("one")
    log.end("done")
    os.close(open_log(path))
    assert path.read_bytes() == b""
    path.write_text("a point cloud")
    for place, reason in ((path, "is there, and no log"), (tmp_path, "cannot be written"), (path / "x", "cannot")):
        with pytest.raises(ConfigError, match=f"--log-json {place}: {reason}"):
            open_log(place)
    assert path.read_text() == "a point cloud"
