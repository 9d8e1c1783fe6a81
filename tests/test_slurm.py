"""Runs as jobs of a real SLURM: four nodes on this machine, started by the tests (`tests.slurm_here`)."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.slurm_here import Slurm, skip_without_slurm, slurm_here
from tests.sparse_city import ROOT, SparseCity, make_city
from tests.test_run import hashes
from tiler.jobs import JobRecord, read_record

pytestmark = pytest.mark.long

TABLE = """
type = "slurm"
partition = "city"
python = "{python}"
setup = ["export PYTHONPATH={root}"]

[controller]
walltime = "{controller}"
margin = {margin}
memory = 1

[worker]
min_workers = {workers}
max_workers = {workers}
walltime = "{worker}"
margin = {rest}
stagger = {stagger}
memory = 1
"""
LONG = {"controller": "00:30:00", "margin": 60, "worker": "00:30:00", "rest": 60, "stagger": 0, "workers": 3}


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    folder = tmp_path_factory.mktemp("slurm")
    with slurm_here(folder) as slurm:
        slurm.environment |= {"XDG_STATE_HOME": str(folder / "home"), "PYTHONPATH": str(ROOT)}
        yield slurm


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    skip_without_slurm()
    return make_city(tmp_path_factory.mktemp("city"), 4, buildings=40)


def call(slurm: Slurm, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "tiler.cli", *words],
        env=slurm.environment, cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def submit(slurm: Slurm, city: SparseCity, out: Path, *others: str, **table: object) -> str:
    """Submit the city; returns the job's number."""
    path = out.parent / f"{out.name}.toml"
    path.write_text(TABLE.format(python=sys.executable, root=ROOT, **{**LONG, **table}))
    run = city.command(out, "--cluster", str(path), *others)
    text = call(slurm, "submit", *run[run.index("run") + 1 :])
    assert text.startswith("job ")
    return text.split()[1].rstrip(";")


def record(out: Path) -> JobRecord:
    found = read_record(out)
    assert found is not None
    return found


def wait_for_end(slurm: Slurm, out: Path, seconds: float) -> None:
    slurm.wait(lambda: record(out).state not in ("submitted", "running", "handed over"), seconds, "end of the run")
    assert record(out).state == "done", log(out)


def log(out: Path) -> str:
    return "".join(path.read_text() for path in sorted((out / "job" / "logs").glob("controller-*")))


def results(out: Path) -> dict[str, str]:
    """Hashes of all but what the jobs need and print."""
    return {name: found for name, found in hashes(out).items() if not name.startswith("job/")}


def worker_jobs(slurm: Slurm) -> list[str]:
    rows = slurm.ask("squeue", "--noheader", "--states=running", "--format=%A %j").splitlines()
    return [job for job, name in map(str.split, rows) if name == "citystitch-worker"]


def test_a_submitted_run_gives_the_bytes_of_a_serial_one(slurm: Slurm, city: SparseCity, tmp_path: Path) -> None:
    out = tmp_path / "out"
    job = submit(slurm, city, out)
    assert job in call(slurm, "status", job)
    wait_for_end(slurm, out, 200)
    assert results(out) == city.hashes
    slurm.wait(lambda: slurm.states()[job] == "COMPLETED", 30, "end of the job")
    slurm.wait(lambda: not worker_jobs(slurm), 30, "end of the workers")
    status = json.loads(call(slurm, "status", job, "--json"))
    assert status["state"] == "done"
    assert (status["job"]["state"], status["job"]["queue"]) == ("done", "COMPLETED")
    assert "no job follows" in call(slurm, "logs", str(out))
    assert len(list((out / "job" / "logs").glob("worker-*.log"))) >= 3


def test_a_cancelled_job_leaves_no_job(slurm: Slurm, city: SparseCity, tmp_path: Path) -> None:
    out = tmp_path / "out"
    job = submit(slurm, city, out)
    slurm.wait(lambda: bool(worker_jobs(slurm)), 100, "workers")
    assert "is cancelled" in call(slurm, "cancel", job)
    slurm.wait(lambda: not {"RUNNING", "PENDING"} & set(slurm.states().values()), 60, "an empty queue")
    assert record(out).state == "cancelled"
