"""Kernels are compiled beforehand, side by side, and a run then finds them."""

import ast
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core.sigutils import normalize_signature

from pipeline.errors import ConfigError
from pipeline.kernel import Kernel
from tests.record_kernels import record_apart
from tests.sparse_city import SparseCity, make_city
from tiler.cli.main import main
from tiler.engine.engine import StoppedError
from tiler.executors import kernels
from tiler.executors.kernels import (
    OTHER,
    PARTS,
    RUN,
    are_compiled,
    compile_kernels,
    count_cores,
    prepare,
    read_list,
)
from tiler.workflow.run import run

ROOT = Path(__file__).parents[1]
GROWTH = {"pipeline.growth": read_list()[OTHER]["pipeline.growth"]}  # compiled in no time


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    return make_city(tmp_path_factory.mktemp("sparse"), 1, buildings=2)


class Deadly:
    """What a process does not survive, in the place of a kernel."""

    @property
    def dispatcher(self) -> Any:
        """Die."""
        os._exit(9)


DEADLY = Deadly()


def listed(monkeypatch: pytest.MonkeyPatch, folder: Path, **parts: kernels.Kernels) -> None:
    """Let there be only these kernels, and keep what says that they are compiled in a folder."""
    path = folder / "kernels.json"
    path.write_text(json.dumps({part: parts.get(part, {}) for part in PARTS}))
    monkeypatch.setattr(kernels, "LIST", path)
    monkeypatch.setattr(kernels, "stamp_folder", lambda: folder)


def test_all_that_is_listed_is_a_kernel() -> None:
    assert tuple(read_list()) == PARTS
    for module, names in (entry for part in read_list().values() for entry in part.items()):
        for name, signatures in names.items():
            assert isinstance(kernels._kernel(module, name), Kernel)
            assert all(normalize_signature(signature)[0] for signature in signatures)


def test_no_kernel_is_for_kernels_and_gives_arrays_to_python() -> None:
    # numba keeps the types of such arrays beside a kernel; where another kernel was loaded first that was compiled
    # with it, they can be missing: "In 'NRT_adapt_ndarray_to_python', 'descr' is NULL".
    jitted, used = dict[tuple[str, str], ast.FunctionDef](), set[tuple[str, str]]()
    for file in [path for package in ("pipeline", "stitch", "tiler") for path in (ROOT / package).rglob("*.py")]:
        module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        tree = ast.parse(file.read_text())
        places = {
            alias.asname or alias.name: (node.module or "", alias.name)
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and any(
                ast.unparse(one).split("(")[0] == "kernel" for one in node.decorator_list
            ):
                jitted[module, node.name] = node
                names = {inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)} - {node.name}
                used |= {places.get(name, (module, name)) for name in names}
    called = {(module, name) for part in read_list().values() for module, names in part.items() for name in names}
    assert called < jitted.keys()
    assert len(used & jitted.keys()) > 20
    result = {place: ast.unparse(jitted[place].returns or ast.Pass()) for place in called & used}
    assert [place for place, kind in result.items() if kind not in ("None", "bool", "int", "float")] == []


def _name(decorator: ast.expr) -> str:
    return ast.unparse(decorator.func if isinstance(decorator, ast.Call) else decorator)


@pytest.mark.parametrize("processes", [1, 2])
def test_what_is_compiled_is_not_compiled_again(
    processes: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    listed(monkeypatch, tmp_path, run=GROWTH)
    said: list[str] = []
    assert not are_compiled()
    prepare(processes, said.append)
    assert [line.startswith(kernels.WORDS) for line in said] == [True]
    assert [are_compiled((RUN,)), are_compiled()] == [True, False]
    prepare(processes, said.append)
    assert len(said) == 1
    assert compile_kernels(processes) == []
    assert are_compiled()
    listed(monkeypatch, tmp_path, run=GROWTH, other=GROWTH)  # other code
    assert not are_compiled((RUN,))


def test_what_is_compiled_is_noted_where_it_can_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    told, code, user = (tmp_path / name for name in ("told", "code", "user"))
    monkeypatch.setattr(kernels, "ROOT", code)
    monkeypatch.setenv("XDG_CACHE_HOME", str(user))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    assert kernels.stamp_folder() == user / "citystitch"
    beside = code / "pipeline" / "__pycache__"
    beside.mkdir(parents=True)
    assert kernels.stamp_folder() == beside
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(told))
    assert kernels.stamp_folder() == told
    folder = kernels.stamp_folder
    listed(monkeypatch, tmp_path, run=GROWTH)
    monkeypatch.setattr(kernels, "stamp_folder", folder)
    assert compile_kernels(1, (RUN,)) == []
    assert are_compiled((RUN,))
    assert [path.name.endswith("-run") for path in told.glob("citystitch-*")] == [True]


def test_where_numba_cannot_write_is_not_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    told = tmp_path / "told"
    told.write_text("a file")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(told))
    assert kernels.stamp_folder() != told
    command = [
        sys.executable,
        "-c",
        "from tiler.executors.kernels import describe_kernels; print(describe_kernels())",
    ]
    assert str(told) not in subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_without_a_compiler_nothing_is_to_be_compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    listed(monkeypatch, tmp_path, run=GROWTH)
    for value, compiled in (("1", True), ("0", False), ("", False)):
        monkeypatch.setenv("NUMBA_DISABLE_JIT", value)
        assert are_compiled() is compiled


def test_what_cannot_be_compiled_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    wrong = {
        "pipeline.growth": {"count_steps": ["(unicode_type,)"], "gone": ["(int64,)"]},
        "pipeline.gone": {"f": ["(int64,)"]},
    }
    listed(monkeypatch, tmp_path, run=wrong)
    said: list[str] = []
    prepare(2, said.append)
    assert len(said) == 4
    told = sorted(said[1:])
    assert told[0].startswith("not compiled beforehand: pipeline.gone.f(int64,): No module named")
    assert told[1].startswith("not compiled beforehand: pipeline.growth.count_steps(unicode_type,): ")
    assert told[2].startswith("not compiled beforehand: pipeline.growth.gone(int64,): ")
    assert not are_compiled((RUN,))


def test_a_process_that_dies_leaves_the_rest_to_the_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    deadly: kernels.Kernels = {__name__: {"DEADLY": ["(int64,)"]}}
    listed(monkeypatch, tmp_path, run=deadly | GROWTH)
    assert compile_kernels(2, (RUN,)) == [f"{__name__}: its process died"]
    assert compile_kernels(1, (RUN,)) == [f"{__name__}: its process died", "pipeline.growth: no process is left"]
    assert not are_compiled((RUN,))


def test_a_run_compiles_with_as_many_processes_as_it_has_workers(
    city: SparseCity, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[int] = []
    monkeypatch.setattr("tiler.workflow.run.prepare", lambda processes, say: asked.append(processes))
    for number, (workers, compilers) in enumerate(((0, None), (0, 3), (1, None), (1, 0))):
        run(city.config(tmp_path / str(number), workers=workers), compilers=compilers)
    assert asked == [3, 1]


def test_the_same_run_again_compiles_nothing_beforehand(
    city: SparseCity, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("tiler.workflow.run.prepare", lambda processes, say: asked.append("run"))
    config = city.config(tmp_path / "out", workers=1)
    for _ in range(2):
        run(config)
    assert asked == ["run"]
    run(dataclasses.replace(config, domain_height=90.0))
    assert asked == ["run"] * 2
    for _ in range(2):
        run(dataclasses.replace(config, domain_height=90.0, overwrite=True))
    assert asked == ["run"] * 4


def test_ctrl_c_while_kernels_are_compiled_stops_a_run(
    city: SparseCity, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(processes: int, say: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tiler.workflow.run.prepare", interrupted)
    out = tmp_path / "out"
    with pytest.raises(StoppedError, match="stopped before the first task"):
        run(city.config(out, workers=1))
    assert json.loads((out / "run.json").read_text())["status"] == "stopped"


def test_the_command_refuses_a_number_below_zero(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["kernels", "--workers", "-1"]) == ConfigError.exit_code
    assert "--workers -1: must be 0 or above" in capsys.readouterr().err


def test_no_more_processes_than_cores_compile() -> None:
    assert 1 <= count_cores() <= min(os.cpu_count() or 1, kernels.MOST)


@pytest.mark.long
def test_after_the_command_nothing_is_compiled(tmp_path: Path) -> None:
    kept = {"NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    command = [sys.executable, "-m", "tiler.cli.main", "kernels"]
    done = subprocess.run(command, env=os.environ | kept, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.rstrip().endswith(f"kept in {tmp_path / 'numba'}")
    called, compiled = record_apart(tmp_path / "cities", **kept)
    assert compiled == []
    assert called == read_list(), "python -m tests.record_kernels writes the list anew"
