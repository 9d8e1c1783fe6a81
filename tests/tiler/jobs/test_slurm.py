"""Runs as jobs of a real SLURM: four nodes on this machine, started by the tests (`tests.helpers.slurm_here`)."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.slurm_here import Slurm, skip_without_slurm, slurm_here
from tests.helpers.sparse_city import ROOT, SparseCity, count_results, make_city
from tests.runs.test_run import hashes
from tiler.jobs.submission import read_record

pytestmark = pytest.mark.long

TABLE = """
type = "slurm"
partition = "city"
python = "{python}"
setup = ["export PYTHONPATH={root}", "{slow}"]

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
LONG = {
    "controller": "00:30:00",
    "margin": 60,
    "worker": "00:30:00",
    "rest": 60,
    "stagger": 0,
    "workers": 3,
    "slow": "",
}
# A worker imports this before its first task, and maybe twice; results that are there already take no time.
SLOW = """
import time
from tiler.engine import task_limits as limits

def slow(function, task, original=limits.run_task):
    def late(task):
        time.sleep({seconds})
        return function(task)

    return original(late, task)

if limits.run_task.__name__ != "slow":
    limits.run_task = slow
"""


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


@pytest.fixture(scope="module")
def village(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    skip_without_slurm()
    return make_city(tmp_path_factory.mktemp("village"), 2, buildings=12)


def call(slurm: Slurm, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "tiler.cli.main", *words],
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


def slow(folder: Path, seconds: float) -> str:
    """Line of shell that lets each task take so much longer (s)."""
    path = folder / f"slow_{round(1000 * seconds)}.py"
    path.write_text(SLOW.format(seconds=seconds))
    return f"export DASK_DISTRIBUTED__WORKER__PRELOAD={path}"


def wait_for_end(slurm: Slurm, out: Path, seconds: float) -> None:
    under_way = ("submitted", "running", "handed over")
    slurm.wait(lambda: read_record(out).state not in under_way, seconds, "end of the run")
    assert read_record(out).state == "done", log(out)


def log(out: Path) -> str:
    return "".join(path.read_text() for path in sorted((out / "job" / "logs").glob("citystitch-[0-9]*")))


def results(out: Path) -> dict[str, str]:
    """Hashes of all but what the jobs need and print."""
    return {name: found for name, found in hashes(out).items() if not name.startswith("job/")}


def worker_jobs(slurm: Slurm, out: Path) -> list[str]:
    """Numbers of the workers of a run that are at work."""
    logs = slurm.ask(
        "squeue", "--noheader", "--states=running", "--Format=JobID:20,Name:30,STDOUT:400"
    ).splitlines()
    rows = (line.split() for line in logs)
    return [job for job, name, log in rows if name == "citystitch-worker" and Path(log).is_relative_to(out)]


def test_a_submitted_run_gives_the_bytes_of_a_serial_one(slurm: Slurm, city: SparseCity, tmp_path: Path) -> None:
    out = tmp_path / "out"
    job = submit(slurm, city, out)
    assert job in call(slurm, "status", job)
    wait_for_end(slurm, out, 200)
    assert results(out) == city.hashes
    slurm.wait(lambda: slurm.states()[job] == "COMPLETED", 30, "end of the job")
    assert "PENDING" not in slurm.states().values()  # the job that would have followed
    slurm.wait(lambda: not worker_jobs(slurm, out), 30, "end of the workers")
    status = json.loads(call(slurm, "status", job, "--json"))
    assert status["state"] == "done"
    assert (status["job"]["state"], status["job"]["queue"]) == ("done", "")
    assert "no job follows" in call(slurm, "logs", str(out))
    assert len(list((out / "job" / "logs").glob("citystitch-worker-*.log"))) >= 3


def test_a_cancelled_job_leaves_no_job(slurm: Slurm, city: SparseCity, tmp_path: Path) -> None:
    out = tmp_path / "out"
    job = submit(slurm, city, out)
    slurm.wait(lambda: bool(worker_jobs(slurm, out)), 100, "workers")
    assert "is cancelled" in call(slurm, "cancel", job)
    slurm.wait(lambda: not {"RUNNING", "PENDING"} & set(slurm.states().values()), 60, "an empty queue")
    assert read_record(out).state == "cancelled"


@pytest.mark.timeout(900)
def test_lost_nodes_and_walltimes_cost_nothing(
    slurm: Slurm, city: SparseCity, village: SparseCity, tmp_path: Path
) -> None:
    """Two runs at a time, as they mostly sleep.

    Of the first all workers retire after 45 s, one is cancelled from outside, and the node of another goes down.
    The second has controllers of two minutes and needs more.
    """
    n, lossy, lasting = sum(city.stages().values()), tmp_path / "lossy", tmp_path / "lasting"
    brief = {"worker": "00:01:30", "rest": 40, "stagger": 5}  # a busy machine starts and ends them slowly
    submit(slurm, city, lossy, **brief, slow=slow(tmp_path, 0.8))
    first = submit(slurm, village, lasting, controller="00:02:00", margin=20, workers=1, slow=slow(tmp_path, 1.4))

    def wait_for_results(share: float) -> None:
        slurm.wait(lambda: sum(count_results(lossy).values()) >= share * n, 400, f"{share:.0%} of the results")

    wait_for_results(0.2)
    slurm.ask("scancel", worker_jobs(slurm, lossy)[0])
    wait_for_results(0.4)
    homes = {slurm.node_of(read_record(out).job) for out in (lossy, lasting)}
    slurm.wait(lambda: bool(nodes(slurm, lossy) - homes), 100, "a worker on a node of its own")
    lost = min(nodes(slurm, lossy) - homes)
    slurm.kill_node(lost)
    wait_for_end(slurm, lossy, 600)
    wait_for_end(slurm, lasting, 600)
    assert results(lossy) == city.hashes
    assert results(lasting) == village.hashes

    assert len(read_record(lossy).jobs) == 1
    lives = len(list((lossy / "job" / "logs").glob("citystitch-worker-*.log")))
    assert lives >= 3 + 2 + 3, "workers did not retire"
    assert "TIMEOUT" not in slurm.states().values()  # nobody waited for it
    found = read_record(lasting)
    assert found.jobs[0] == first
    assert len(found.jobs) > 1
    slurm.wait(lambda: slurm.states()[found.job] == "COMPLETED", 30, "end of the last job")
    assert {slurm.states()[job] for job in found.jobs} == {"COMPLETED"}


def nodes(slurm: Slurm, out: Path) -> set[str]:
    return {slurm.node_of(job) for job in worker_jobs(slurm, out)} - {""}
