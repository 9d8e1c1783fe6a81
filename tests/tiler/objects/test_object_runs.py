"""Runs into moto's S3 behind a proxy that fails: killed, resumed, paused, with results that vanish."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.flaky_proxy import FlakyProxy, flaky_proxy
from tests.helpers.object_servers import BUCKET, SECRET, S3Server, environment, s3_server
from tests.helpers.towns import TILE, Town, make_town
from tests.runs.test_run import hashes
from tiler.objects.places import place

pytest.importorskip("obstore")
pytest.importorskip("moto")

PATIENCE = 120  # s


@pytest.fixture(scope="module")
def server() -> Iterator[S3Server]:
    with s3_server() as found:
        yield found


@pytest.fixture
def proxy(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[FlakyProxy]:
    with flaky_proxy(server.port) as found:
        for name, value in environment(found.url).items():
            monkeypatch.setenv(name, value)
        yield found


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"))


def words(town: Town, url: str, *more: str) -> list[str]:
    command = [sys.executable, "-m", "tiler.cli.main", "run", str(town.folder / "tiles"), "--footprints"]
    command += [str(town.folder / "footprints.gpkg"), "--tile-size", f"{TILE:g}", "--domain-height", "70"]
    return [*command, "--out", url, "--store-patience", str(PATIENCE), "--no-dashboard", *more]


def run_to_end(town: Town, url: str, *more: str) -> str:
    done = subprocess.run(words(town, url, *more), capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert SECRET not in done.stdout + done.stderr
    return done.stdout


def fetch(url: str, folder: Path) -> dict[str, str]:
    command = [sys.executable, "-m", "tiler.cli.main", "fetch", url, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return hashes(folder)


def secrets_in(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and SECRET.encode() in path.read_bytes()]


def wait_for_key(path: str, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not place(path).is_dir():
        assert time.monotonic() < end, f"{path} was not put"
        time.sleep(0.1)


@pytest.mark.long
def test_a_run_that_is_killed_among_faults_and_resumed_has_the_bytes_of_one_on_a_disk(
    town: Town, proxy: FlakyProxy, tmp_path: Path
) -> None:
    url = f"s3://{BUCKET}/killed"

    def fault(number: int, method: str, path: str) -> str:
        return {3: "500", 17: "503", 31: "cut", 47: "lost"}.get(number % 61, "")

    proxy.fault = fault
    command = words(town, url, "--workers", "2")
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        wait_for_key(f"{url}/store.zarr/model")
    finally:
        os.killpg(run.pid, signal.SIGKILL)
        run.wait(60)
    assert not place(f"{url}/mesh.pvtu").is_file()
    # A result was damaged meanwhile: that is found, and it is computed again.
    result = next(place(f"{url}/store.zarr/terrain").rglob("*.zip"))
    result.write_bytes(result.read_bytes()[:-1] + b"x")
    text = run_to_end(town, url, "--workers", "2")
    assert "damaged-artefact" in (place(url) / "run.json").read_bytes().decode()
    assert "taken over from" in text
    assert min(proxy.failed[kind] for kind in ("500", "503", "cut", "lost")) > 3
    proxy.fault = lambda _number, _method, _path: ""
    assert fetch(url, tmp_path / "out") == hashes(town.out)
    assert secrets_in(tmp_path / "out") == []


@pytest.mark.long
def test_a_store_that_vanishes_for_a_minute_pauses_the_run(town: Town, proxy: FlakyProxy, tmp_path: Path) -> None:
    url, gone = f"s3://{BUCKET}/paused", [0.0, 0.0]

    def fault(number: int, method: str, path: str) -> str:
        now = time.monotonic()
        if method == "PUT" and "/store.zarr/houses/" in path and not gone[1]:
            gone[:] = [now, now + 60.0]
        return "cut" if gone[0] <= now < gone[1] else ""

    proxy.fault = fault
    run_to_end(town, url)
    assert gone[1]
    assert proxy.failed["cut"] > 3
    assert fetch(url, tmp_path / "out") == hashes(town.out)


@pytest.mark.long
def test_a_store_that_stays_away_ends_the_run_which_goes_on_later(
    town: Town, proxy: FlakyProxy, tmp_path: Path
) -> None:
    url = f"s3://{BUCKET}/away"
    proxy.fault = lambda _number, method, path: "503" if method == "PUT" and "/store.zarr/houses/" in path else ""
    done = subprocess.run(
        words(town, url, "--store-patience", "2"), capture_output=True, text=True, check=False, timeout=280
    )
    assert done.returncode == 1
    assert "no sound answer for" in done.stderr
    assert "bound 2 s (status 503); the same command goes on where the run ended" in done.stderr
    proxy.fault = lambda _number, _method, _path: ""
    run_to_end(town, url)
    assert fetch(url, tmp_path / "out") == hashes(town.out)


@pytest.mark.long
def test_inputs_in_a_bucket_give_the_bytes_of_those_on_a_disk(
    town: Town, proxy: FlakyProxy, tmp_path: Path
) -> None:
    for path in (*(town.folder / "tiles").iterdir(), town.folder / "footprints.gpkg"):
        name = f"{path.parent.name}/{path.name}" if path.suffix == ".laz" else path.name
        (place(f"s3://{BUCKET}/inputs") / name).write_bytes(path.read_bytes())
    command = [sys.executable, "-m", "tiler.cli.main", "run", f"s3://{BUCKET}/inputs/tiles", "--footprints"]
    command += [f"s3://{BUCKET}/inputs/footprints.gpkg", "--tile-size", f"{TILE:g}", "--domain-height", "70", "-q"]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "out")], capture_output=True, text=True, check=False, timeout=280
    )
    assert done.returncode == 0, done.stdout + done.stderr
    parts = ("mesh", "boundary", "city")
    pieces = {name: value for name, value in hashes(town.out).items() if name.startswith(parts)}
    found = hashes(tmp_path / "out")
    assert len(pieces) > 8
    assert {name: found[name] for name in pieces} == pieces
    assert secrets_in(tmp_path / "out") == []


@pytest.mark.long
def test_without_rights_bucket_or_credentials_one_error_says_so(town: Town, proxy: FlakyProxy) -> None:
    def fails(url: str) -> str:
        done = subprocess.run(words(town, url), capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1
        assert SECRET not in done.stderr
        return done.stderr

    assert "no such bucket" in fails("s3://nobucket/run")
    proxy.fault = lambda _number, _method, _path: "403"
    assert "access denied" in fails(f"s3://{BUCKET}/run")
