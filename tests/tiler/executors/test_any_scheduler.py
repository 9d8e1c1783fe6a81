"""Somebody's scheduler: workers of other versions or on another disk are refused, before a run and in it."""

import dataclasses
import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from distributed import Client, LocalCluster

from tests.helpers.namespaces import dask_command
from tests.helpers.sparse_city import ROOT, SparseCity, children, count_results, make_city, start
from tests.runs.test_run import hashes
from tests.tiler.engine.test_engine import grid_layout, make, nothing
from tiler.config.config import Config
from tiler.engine.stage import Facts, Scope, Stage
from tiler.engine.task import Task
from tiler.executors import dask_executor, worker_requirements
from tiler.executors.remote_cluster import connect
from tiler.executors.versions import LIBRARIES, MISSING, NATIVE, describe_versions
from tiler.executors.worker_requirements import (
    ClusterMismatchError,
    Mismatch,
    Requirements,
    UnansweredError,
    check_cluster,
    check_files,
    compare_files,
    compare_versions,
    find_mismatch,
    own_requirements,
    require_files,
)
from tiler.store.out_folder import PROBE
from tiler.workflow.run import use_absolute_paths


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """A cluster within this process."""
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def other_versions(**others: str) -> dict[str, str]:
    return describe_versions() | others


def test_all_that_computes_is_told() -> None:
    found = describe_versions()
    assert found.keys() == {"python", "citystitch", "dask", "distributed", *LIBRARIES, *NATIVE}
    assert MISSING not in found.values()
    assert found["python"] == f"{sys.version_info[0]}.{sys.version_info[1]}"


def test_every_library_of_the_keys_is_compared() -> None:
    from tiler.engine.keys import CODE

    assert set(CODE) <= describe_versions().keys()


def test_citystitch_counts_by_its_sources(tmp_path: Path) -> None:
    for package in ("pipeline", "stitch", "tiler"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    words = "from tiler.executors.versions import describe_versions; print(describe_versions(())['citystitch'])"

    def ask() -> str:
        command = [sys.executable, "-c", words]
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, cwd=tmp_path)
        return done.stdout.strip()

    assert ask() == describe_versions(())["citystitch"]
    with (tmp_path / "stitch" / "grid.py").open("a") as file:
        file.write("# a word more\n")
    assert ask() != describe_versions(())["citystitch"]


def test_differences_are_a_line_each() -> None:
    here = {"numpy": "2.4", "zarr": "3.1"}
    there: dict[str, Any] = {f"tcp://10.0.0.{k}:1": {"numpy": "2.3", "zarr": "3.1"} for k in range(5)}
    there |= {"tcp://b:1": {"numpy": "2.4", "zarr": "missing"}, "tcp://c:1": SyntaxError("old\npython")}
    assert compare_versions(here, there) == [
        "numpy: 2.4 here, 2.3 there (tcp://10.0.0.0:1, tcp://10.0.0.1:1, tcp://10.0.0.2:1 and 2 more)",
        "zarr: 3.1 here, missing there (tcp://b:1)",
        "versions: cannot be told there (SyntaxError: old python) (tcp://c:1)",
    ]
    assert compare_files({"tcp://a:1": {}, "tcp://b:1": {"/out": "is another folder there"}}) == [
        "/out: is another folder there (tcp://b:1)"
    ]


def test_a_cluster_of_the_same_versions_will_do(client: Client, tmp_path: Path) -> None:
    file = tmp_path / "a.laz"
    file.write_bytes(b"12")
    with require_files(tmp_path, [file]) as given:
        check_cluster(client, "inproc", given)
        assert (tmp_path / PROBE).is_file()
    assert not (tmp_path / PROBE).exists()


def test_other_versions_are_refused(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    here = other_versions(GEOS="9.9.9", distributed="1.0")
    monkeypatch.setattr(worker_requirements, "own_versions", lambda: here)
    with pytest.raises(ClusterMismatchError) as caught:
        check_cluster(client, "tcp://a:1", own_requirements())
    first, *lines, last = caught.value.lines
    assert first == "tcp://a:1: this cluster cannot take the tasks of this run, and nothing was written"
    assert last.startswith("install the same versions there")
    there = describe_versions()
    assert len(lines) == 3
    assert lines[0] == f"distributed: 1.0 here, {there['distributed']} there (scheduler tcp://a:1)"
    assert lines[1].startswith(f"distributed: 1.0 here, {there['distributed']} there (inproc://")
    assert lines[2].startswith(f"GEOS: 9.9.9 here, {there['GEOS']} there (inproc://")
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("fault", ["gone", "other", "input gone", "input other"])
def test_other_files_are_refused(
    fault: str, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_requirements, "GRACE", 0.0)
    file = tmp_path / "a.laz"
    file.write_bytes(b"12")
    with require_files(tmp_path, [file]) as given:
        match fault:
            case "gone":
                (tmp_path / PROBE).unlink()
                line = f"{tmp_path}: the output folder is not seen there (No such file or directory)"
            case "other":
                (tmp_path / PROBE).write_text("{}")
                line = f"{tmp_path}: is another folder there"
            case "input gone":
                file.unlink()
                line = f"{file}: the input is not seen there (No such file or directory)"
            case _:
                file.write_bytes(b"123")
                line = f"{file}: the input has 3 bytes there, 2 here"
        with pytest.raises(ClusterMismatchError) as caught:
            check_cluster(client, "tcp://a:1", given)
    address = next(iter(client.nthreads()))
    assert caught.value.lines[1:-1] == [f"{line} ({address})"]
    assert caught.value.lines[-1].startswith("workers must see output folder and inputs")


def test_a_worker_that_does_not_answer_is_told(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_requirements, "ANSWER", 0.2)
    monkeypatch.setattr(worker_requirements, "ASK_VERSIONS", "__import__('time').sleep(1)")
    with pytest.raises(UnansweredError, match=r"not all workers have answered within 0\.2 s"):
        check_cluster(client, "tcp://a:1", own_requirements())


def test_a_task_is_refused_by_a_worker_that_joins_late(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Requirements are looked at once for a run, in the worker; the run ends, whatever its policy."""

    @functools.cache
    def find_other(requirements: Requirements) -> Mismatch | None:
        with monkeypatch.context() as patch:
            patch.setattr(worker_requirements, "own_versions", lambda: other_versions(numpy="0.1"))
            return find_mismatch(requirements)

    with connect(client.scheduler.address) as executor:
        make(tmp_path / "good", executor).run(Stage("a", Scope.TILE, nothing))
    monkeypatch.setattr(dask_executor, "find_mismatch", find_other)
    with connect(client.scheduler.address, requirements=Requirements("another")) as executor:
        engine = make(tmp_path / "bad", executor, layout=grid_layout(2))
        with pytest.raises(ClusterMismatchError) as caught:
            engine.run(Stage("a", Scope.TILE, nothing))
    first, line, last = caught.value.lines
    assert "a worker has joined that cannot take tasks of this run; all that was done is kept" in first
    assert line.startswith("numpy: ")
    assert "0.1 there (inproc://" in line
    assert last.startswith("install the same versions there")
    assert engine.store.names("a") == []


class Unsendable:
    """A stage's function that cannot be pickled."""

    def __call__(self, _: Task) -> Facts:
        """Give nothing."""
        return {}

    def __reduce__(self) -> str:
        """Refuse."""
        raise ZeroDivisionError("a fault on purpose")


def test_tasks_that_cannot_be_sent_end_a_run_and_nothing_waits_for_them(client: Client, tmp_path: Path) -> None:
    with connect(client.scheduler.address) as executor:
        engine = make(tmp_path, executor)
        with pytest.raises(Exception, match=r"(?i)pickle|serialize|purpose"):
            engine.run(Stage("a", Scope.TILE, Unsendable()))
        engine.run(Stage("b", Scope.TILE, nothing))
    assert len(engine.store.names("b")) == len(engine.layout.tiles)


@pytest.mark.parametrize("workers", [{"scheduler": "tcp://a:1"}, {"cluster": "slurm.toml"}])
def test_paths_of_a_run_on_a_cluster_are_absolute(workers: dict[str, str]) -> None:
    given = Config(pointcloud=("a/*.laz",), footprints="f.gpkg", out="out")
    assert use_absolute_paths(given) == given
    found = use_absolute_paths(dataclasses.replace(given, **workers))  # type: ignore[arg-type]
    here = str(Path.cwd())
    assert found.pointcloud == (f"{here}/a/*.laz",)
    assert (found.footprints, found.out) == (f"{here}/f.gpkg", f"{here}/out")


def test_requirements_without_files_ask_for_none() -> None:
    assert check_files(own_requirements()) == {}


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, Any]]:
    """A scheduler; gives its address, and a function that adds a worker with what it must see first of Python."""
    folder.mkdir()
    place = folder / "scheduler.json"

    with ExitStack() as stack:

        def add(command: list[str], log: str, path: str = str(ROOT)) -> None:
            # Not in ROOT, which would be the first place that Python looks in.
            process = start(["env", "-C", str(folder), f"PYTHONPATH={path}", *command], folder / log)
            stack.callback(_end, process)

        add(
            dask_command("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(place)),
            "s.txt",
        )
        address = _wait(lambda: place.exists() and json.loads(place.read_text() or "{}").get("address"))

        def worker(name: str, path: str = str(ROOT)) -> str:
            words = ("--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--memory-limit", "0")
            add(dask_command("worker", str(address), *words), name, path)
            _wait(lambda: "Registered to" in (folder / name).read_text())
            return name

        yield str(address), worker


def _wait(ready: Any, seconds: float = 90.0) -> Any:
    end = time.monotonic() + seconds
    while not (found := ready()):
        assert time.monotonic() < end
        time.sleep(0.1)
    return found


def _end(process: "subprocess.Popen[bytes]") -> None:
    below = children(process)
    process.kill()
    process.wait()
    for one in below:
        one.kill()


@pytest.mark.long
def test_wrong_workers_take_no_part_in_a_run(tmp_path: Path) -> None:
    """One with another numpy is told. One without citystitch dies of its first task, and the others go on."""
    city = make_city(tmp_path, 2, buildings=12)
    out, wrong, bare = tmp_path / "out", tmp_path / "wrong", tmp_path / "bare"
    (wrong / "numpy-0.1.dist-info").mkdir(parents=True)
    (wrong / "numpy-0.1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: numpy\nVersion: 0.1\n")
    bare.mkdir()
    (bare / "tiler.py").touch()
    with cluster(tmp_path / "one") as (address, worker):
        worker("good.txt")
        worker("wrong.txt", f"{wrong}:{ROOT}")
        command = city.command(out, "--scheduler", address)
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
        assert done.returncode == 2, done.stderr
        told = done.stderr[done.stderr.index("citystitch: ") :]  # Dask may say before that a worker is slow
        head, line, advice = told.splitlines()[:3]
        assert head.startswith(f"citystitch: {address}: this cluster cannot take the tasks of this run")
        assert line.startswith("numpy: ")
        assert ", 0.1 there (tcp://127.0.0.1:" in line
        assert "install the same versions" in advice
        assert not out.exists()
    told = _run_with_a_late_worker(city, out, f"{wrong}:{ROOT}", tmp_path / "late", code=2)
    assert "a worker has joined that cannot take tasks of this run" in told
    assert ", 0.1 there (tcp://127.0.0.1:" in told
    assert "Traceback" not in told
    told = _run_with_a_late_worker(city, out, f"{bare}:{ROOT}", tmp_path / "later", code=0)
    assert "results were there" in told
    assert "No module named 'tiler" in (tmp_path / "later" / "late.txt").read_text()
    assert hashes(out) == city.hashes
    assert not (out / PROBE).exists()


def _run_with_a_late_worker(city: SparseCity, out: Path, path: str, folder: Path, *, code: int) -> str:
    """Run with a good worker; another, with what it sees first of Python, joins in the middle. Gives all words."""
    before, words = sum(count_results(out).values()), folder.with_suffix(".txt")
    with cluster(folder) as (address, worker):
        worker("good.txt")
        process = start(city.command(out, "--scheduler", address), words)
        try:
            _wait(lambda: sum(count_results(out).values()) > before + 5)
            os.kill(process.pid, signal.SIGSTOP)  # until the other one is there
            worker("late.txt", path)
            os.kill(process.pid, signal.SIGCONT)
            assert process.wait(120) == code, words.read_text()
        finally:
            _end(process)
    return words.read_text()
