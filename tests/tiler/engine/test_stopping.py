"""Ctrl-C in a real terminal's way: a signal to the whole process group of a run with workers."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers.towns import Town
from tests.runs.test_run import hashes
from tiler.interface.synth import write_city
from tiler.workflow.run import run

STOPPED = 130


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    folder = tmp_path_factory.mktemp("town")
    write_city(folder / "city", size=420.0, buildings=40, density=0.5, relief=5, seed=3)
    start = Town(folder / "city", folder / "out", {})
    return Town(start.folder, start.out, run(start.config(start.out)))


def start(town: Town, out: Path, workers: int) -> "subprocess.Popen[str]":
    config = town.config(out)
    command = [
        sys.executable,
        "-m",
        "tiler.cli.main",
        "run",
        *config.pointcloud,
        "--footprints",
        config.footprints,
    ]
    command += ["--out", str(out), "--tile-size", str(config.tile_size), "--domain-height", "70"]
    command += ["--workers", str(workers)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def wait_for(out: Path, stage: str) -> None:
    """Wait until a stage has a result."""
    end = time.monotonic() + 120
    while not list((out / "store.zarr" / stage).glob("[!.]*")):
        assert time.monotonic() < end
        time.sleep(0.02)


def interrupt(process: "subprocess.Popen[str]", number: int = signal.SIGINT) -> None:
    os.killpg(process.pid, number)


@pytest.mark.parametrize(("workers", "number"), [(0, signal.SIGTERM), (2, signal.SIGINT)])
def test_one_ctrl_c_lets_what_runs_end(workers: int, number: int, town: Town, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(town, out, workers)
    wait_for(out, "ground")
    if number == signal.SIGINT:
        interrupt(process)
    else:
        process.terminate()
    text, _ = process.communicate(timeout=120)
    assert process.returncode == STOPPED, text
    assert "stopping when what runs is done; once more ends at once" in text
    assert "the same command goes on" in text
    assert "Traceback" not in text
    assert json.loads((out / "run.json").read_text())["status"] == "stopped"
    assert not list(out.rglob("*.partial"))
    record = run(town.config(out))
    assert sum(record["reused"].values()) > 0
    assert hashes(out) == hashes(town.out)


def test_a_ctrl_c_when_all_is_said_changes_nothing() -> None:
    code = """
import atexit, os, signal, sys
atexit.register(os.kill, os.getpid(), signal.SIGINT)
sys.argv[1:] = ["run", "no/such.laz"]
from tiler.cli.main import main
sys.exit(main())
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr == "citystitch: no/such.laz: no such file or folder; check the path\n"


def test_two_end_at_once_and_nothing_is_lost(town: Town, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(town, out, 2)
    wait_for(out, "ground")
    interrupt(process)
    time.sleep(0.05)
    interrupt(process)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == STOPPED, text
    assert "Traceback" not in text
    run(town.config(out))
    assert hashes(out) == hashes(town.out)
