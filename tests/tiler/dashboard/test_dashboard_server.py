"""The server of the page of a run: what it answers, what it refuses, and where it is mounted."""

import gzip
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.data.errors import ConfigError
from tests.helpers.simulated_runs import simulate, write_events
from tests.helpers.told import Listener, StageEnds
from tiler.cli.main import main
from tiler.config.config import make_config
from tiler.dashboard.event_reader import EventReader
from tiler.dashboard.server import read_address, serve
from tiler.interface.synth import write_city
from tiler.monitoring.items import State
from tiler.workflow.run import run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the events of 30 tiles."""
    out = tmp_path_factory.mktemp("events")
    write_events(out, simulate(30, done=0.5, failed=2, running=3, status="running"))
    return out


@pytest.fixture(scope="module")
def port(folder: Path) -> Iterator[int]:
    """Port of a server of that folder."""
    with serve(EventReader(folder)) as url:
        assert url.startswith("http://127.0.0.1:")
        assert url.endswith("/citystitch/")
        yield int(url.split(":")[2].split("/")[0])


def ask(port: int, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Ask for a path as it is written: no client cleans it up."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.putrequest("GET", path, skip_host="Host" in headers, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        reply = connection.getresponse()
        return reply.status, {name.lower(): value for name, value in reply.getheaders()}, reply.read()
    finally:
        connection.close()


def test_the_page_and_its_parts_are_there(port: int) -> None:
    for name, kind in {"": "html", "page.js": "javascript", "map.js": "javascript", "page.css": "css"}.items():
        status, headers, content = ask(port, f"/citystitch/{name}")
        assert status == 200
        assert kind in headers["content-type"]
        assert headers["x-content-type-options"] == "nosniff"
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "access-control-allow-origin" not in headers
        for foreign in (b"http://", b"https://", b"//cdn"):
            assert foreign not in content.replace(b"http://www.w3.org/2000/svg", b"")


def test_the_state_is_told_and_then_what_is_new(port: int) -> None:
    status, headers, content = ask(port, "/citystitch/api/state", Accept_Encoding="gzip")
    assert (status, headers["content-encoding"]) == (200, "gzip")
    answer = json.loads(gzip.decompress(content))
    assert answer["map"]["tiles"][State.FAILED] == len(answer["failures"]) == 2
    assert answer["map"]["tiles"][State.RUNNING] == 3
    assert sum(answer["map"]["tiles"]) == len(answer["map"]["rows"]) == 30
    key = urllib.parse.quote(answer["map"]["key"])
    _, _, content = ask(port, f"/citystitch/api/state?since={answer['version']}&key={key}")
    later = json.loads(content)
    assert later["map"]["rows"] == []
    assert "failures" not in later


@pytest.mark.parametrize(
    "path",
    [
        "/citystitch/../../../../etc/passwd", "/citystitch/..%2f..%2fserver.py", "/citystitch/server.py",
        "/citystitch/%2e%2e/model.py", "/citystitch//etc/passwd", "/etc/passwd", "/citystitch/page.html",
    ],
)  # fmt: skip
def test_no_path_leads_out_of_the_page(port: int, path: str) -> None:
    status, _, content = ask(port, path)
    assert status == 404
    assert b"root:" not in content


@pytest.mark.parametrize(
    "query", ["since=-1", "since=x", "since=9e9", "view=1,2,3", "view=1,2,3,nan", "view=a,b,c,d"]
)
def test_what_is_no_question_is_refused(port: int, query: str) -> None:
    assert ask(port, f"/citystitch/api/state?{query}")[0] == 400


def test_an_unknown_stage_or_value_is_an_empty_one(port: int) -> None:
    answer = json.loads(ask(port, "/citystitch/api/state?stage=<b>&value=nothing")[2])
    assert sum(answer["map"]["tiles"]) == answer["map"]["tiles"][State.WAITING] == 30
    assert answer["map"]["range"] is None


def test_only_names_of_this_machine_are_answered(port: int) -> None:
    assert ask(port, "/citystitch/api/state", Host="evil.example:80")[0] == 403
    assert ask(port, "/citystitch/", Host="evil.example")[0] == 403
    assert ask(port, "/metrics", Host="evil.example")[0] == 403
    assert ask(port, "/citystitch/", Host=f"localhost:{port}")[0] == 200


def test_metrics_are_at_both_places(port: int) -> None:
    for path in ("/metrics", "/citystitch/metrics"):
        status, headers, content = ask(port, path)
        assert status == 200
        assert headers["content-type"].startswith("text/plain; version=0.0.4")
        assert b'citystitch_tiles{state="failed"} 2\n' in content


def test_a_damaged_folder_is_told_by_the_page_and_fails_a_scrape(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{")
    with serve(EventReader(tmp_path)) as url:
        number = int(url.split(":")[2].split("/")[0])
        assert "is damaged" in json.loads(ask(number, "/citystitch/api/state")[2])["trouble"]
        assert ask(number, "/metrics")[0] == 503


@pytest.mark.parametrize(
    "address", ["", "8787x", "127.0.0.1:", "127.0.0.1:70000", "127.0.0.1:-1", "nowhere.invalid:1"]
)
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="dashboard address"):
        read_address(address)


def test_a_port_in_use_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["dashboard", str(folder), "--port", str(port)]) == 2
    assert f"dashboard address 127.0.0.1:{port}: cannot be listened at" in capsys.readouterr().err


def test_the_command_refuses_a_folder_of_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dashboard", str(tmp_path)]) == 1
    assert "holds neither" in capsys.readouterr().err


def test_the_command_serves_until_it_is_interrupted(folder: Path) -> None:
    words = [sys.executable, "-m", "tiler.cli.main", "dashboard", str(folder)]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"}
    ) as job:
        try:
            assert job.stdout is not None
            port = int(job.stdout.readline().split(":")[3].split("/")[0])
            assert ask(port, "/citystitch/api/state")[0] == 200
            job.send_signal(signal.SIGINT)
            assert job.wait(timeout=30) == 0
        finally:
            job.kill()


@pytest.mark.long
@pytest.mark.parametrize("workers", [0, 2])
def test_a_run_shows_its_page_and_its_bytes_stay(tmp_path: Path, small_run: Path, workers: int) -> None:
    """On Dask's own server where there is one; Dask's metrics have ours among them."""
    files = write_city(tmp_path / "city", size=300, buildings=15, density=1.0)
    given = {
        "pointcloud": [str(path) for path in files.clouds],
        "footprints": str(files.footprints),
        "out": str(tmp_path / "out"),
        "tile_size": 150.0,
        "domain_height": 60.0,
        "workers": workers,
    }
    answers, metrics, told = [], [], []

    def say(text: str) -> None:
        told.append(text)

    def announce(stage: str) -> None:
        port = int(told[0].split(":")[3].split("/")[0])
        time.sleep(1.1 if stage == "model" else 0.0)  # what happened is written once a second
        answers.append(json.loads(ask(port, "/citystitch/api/state")[2]))
        metrics.append(ask(port, "/metrics")[2].decode())

    run(make_config(given), watchers=[Listener(say), StageEnds(announce)], dashboard="127.0.0.1:0")
    assert told[0].startswith("dashboard: http://127.0.0.1:")
    assert {answer["head"]["status"] for answer in answers} == {"running"}
    assert {answer["dask"] for answer in answers} == {workers > 0}
    assert any(stage["name"] == "buildings" and stage["done"] >= 4 for stage in answers[-1]["stages"])
    assert 'citystitch_items{scope="tile",stage="houses",state="done"} 4' in metrics[-1].replace(
        'stage="houses",scope="tile"', 'scope="tile",stage="houses"'
    ).replace(".0\n", "\n")
    assert ("dask_scheduler_workers" in metrics[-1]) == (workers > 0)
    for piece in sorted((small_run / "mesh").iterdir()):
        assert (tmp_path / "out" / "mesh" / piece.name).read_bytes() == piece.read_bytes()


def test_a_server_that_is_stopped_at_once_ends(folder: Path) -> None:
    def serve_often() -> None:
        for _ in range(100):
            with serve(EventReader(folder)):
                pass

    serving = threading.Thread(target=serve_often, daemon=True)
    serving.start()
    serving.join(60)
    assert not serving.is_alive()
