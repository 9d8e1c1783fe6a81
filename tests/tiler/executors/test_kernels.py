"""Kernels are numba's, and are compiled beforehand where workers need them."""

import ast
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.quality import quality
from tests.helpers.sparse_city import SparseCity, make_city
from tiler.cli.main import main
from tiler.engine.schedule import StoppedError
from tiler.executors import kernels
from tiler.executors.kernels import UNCACHED, WAYS, are_compiled, compile_kernels, prepare
from tiler.interface.synth import write_city
from tiler.workflow.run import run

ROOT = Path(__file__).parents[3]
ONE = """
from pipeline.data.kernel import kernel


@kernel(error_model="numpy")
def divide(n):
    return n / (n - n)


print(divide(1), divide.stats.cache_path)
"""


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    return make_city(tmp_path_factory.mktemp("sparse"), 1, buildings=2)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Ways that were to be compiled, in an empty cache and without doing so."""
    ways: list[str] = []

    def compile_way(way: str) -> str:
        ways.append(way)
        kernels._stamp(tmp_path, way).touch()
        return ""

    monkeypatch.setattr(kernels, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(kernels, "compile_kernels", compile_way)
    return ways


def test_the_options_of_a_kernel_are_those_of_numba() -> None:
    measure: Any = quality._measure_some
    assert (measure.targetoptions["nogil"], measure.targetoptions["error_model"]) == (True, "numpy")
    assert measure.__name__ == "_measure_some"


@pytest.mark.parametrize("kept", [True, False])
def test_a_kernel_without_a_folder_for_the_cache_is_compiled_without(kept: bool, tmp_path: Path) -> None:
    module, nowhere = tmp_path / "one.py", tmp_path / "file"
    module.write_text(ONE)
    nowhere.write_text("")
    cache = tmp_path / "__pycache__"
    if not kept:
        cache.write_text("")
    places = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"), str(nowhere))
    told = subprocess.check_output([sys.executable, module], env=os.environ | places, cwd=ROOT, text=True)
    assert told == f"inf {cache if kept else None}\n"


def test_no_kernel_is_for_kernels_and_gives_arrays_to_python() -> None:
    # numba keeps the types of such arrays beside a kernel; where another kernel was loaded first that was compiled
    # with it, they can be missing: "In 'NRT_adapt_ndarray_to_python', 'descr' is NULL".
    functions = dict[tuple[str, str], ast.FunctionDef]()
    by_python, by_kernels = set[tuple[str, str]](), set[tuple[str, str]]()
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
            if not isinstance(node, ast.FunctionDef):
                continue
            is_kernel = any(ast.unparse(one).split("(")[0] == "kernel" for one in node.decorator_list)
            if is_kernel:
                functions[module, node.name] = node
            names = {inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)} - {node.name}
            used = by_kernels if is_kernel else by_python
            used |= {places.get(name, (module, name)) for name in names}
    assert len(by_kernels & functions.keys()) > 20
    both = by_python & by_kernels & functions.keys()
    result = {place: ast.unparse(functions[place].returns or ast.Pass()) for place in both}
    assert {place: kind for place, kind in result.items() if kind not in ("None", "bool", "int", "float")} == {}


def test_workers_find_kernels_compiled(asked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    prepare("layered", 0, said.append)
    assert (asked, said) == ([], [])
    assert not are_compiled(["layered"])
    for _ in range(2):
        prepare("layered", 2, said.append)
    assert (asked, said) == (["layered"], ["compiling kernels for this machine, once"])
    assert [are_compiled(["layered"]), are_compiled()] == [True, False]
    monkeypatch.setattr(kernels, "code_versions", lambda: (("numba", "0"),))
    assert not are_compiled(["layered"])


def test_what_fails_before_a_run_is_told(asked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(kernels, "compile_kernels", lambda way: "exit code 1: no space left")
    prepare("adaptive", 1, said.append)
    assert said[1:] == ["kernels are compiled as they are called: exit code 1: no space left"]


@pytest.mark.parametrize("workers", [0, 2])
def test_that_kernels_are_not_kept_is_told(
    workers: int, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(kernels, "cache_folder", lambda: None)
    prepare("adaptive", workers, said.append)
    assert (asked, said) == ([], [UNCACHED])


def test_a_run_of_the_block_that_fails_leaves_no_stamp(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(kernels, "cache_folder", lambda: tmp_path)
    monkeypatch.setitem(WAYS, "adaptive", ("--mesher", "other"))
    assert compile_kernels("adaptive").startswith("exit code 2: usage: citystitch run")
    assert not are_compiled(["adaptive"])


def test_the_command_tells_what_fails(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    errors = dict.fromkeys(WAYS, "") | {"layered": "exit code 1: no space left"}
    monkeypatch.setattr(kernels, "compile_kernels", errors.__getitem__)
    assert main(["kernels"]) == 1
    assert capsys.readouterr().err == "citystitch: kernels are not compiled: exit code 1: no space left\n"
    errors["layered"] = ""
    assert main(["kernels"]) == 0
    assert str(kernels.cache_folder()) in capsys.readouterr().out


def test_a_run_prepares_the_workers_of_this_machine_alone(
    city: SparseCity, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[tuple[str, int]] = []

    def note(way: str, workers: int, say: Callable[[str], None]) -> None:
        asked.append((way, workers))

    monkeypatch.setattr("tiler.workflow.run.prepare", note)
    run(city.config(tmp_path / "0", workers=0, mesher="layered"))
    run(city.config(tmp_path / "1", workers=1, roofs="flat"))
    run(city.config(tmp_path / "2", workers=0, roofs="skeleton"))
    run(city.config(tmp_path / "3", workers=0, roofs="planes", mesher="layered"))
    run(city.config(tmp_path / "4", workers=0))
    assert asked == [("layered", 0), ("adaptive", 1), ("planes", 0), ("layered", 0), ("planes", 0)]


def test_ctrl_c_while_kernels_are_compiled_stops_a_run(
    city: SparseCity, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(way: str, workers: int, say: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tiler.workflow.run.prepare", interrupted)
    out = tmp_path / "out"
    with pytest.raises(StoppedError, match="stopped before the first task"):
        run(city.config(out, workers=1))
    assert json.loads((out / "run.json").read_text())["status"] == "stopped"


@pytest.mark.long
@pytest.mark.timeout(900)
def test_after_the_command_a_run_compiles_next_to_nothing(tmp_path: Path) -> None:
    """What the built-in block does not meet, one kernel or two of a hundred, is compiled when it is called."""
    cache = tmp_path / "numba"
    kept = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-m", "tiler.cli"]
    told = subprocess.check_output([*command, "kernels"], env=kept, text=True)
    assert f"kept in {cache}" in told
    compiled = set(cache.rglob("*.nb?"))
    assert len(compiled) > 200
    files = write_city(tmp_path / "city", size=400, buildings=60)
    words = [*map(str, files.clouds), "--footprints", str(files.footprints), "--tile-size", "200", "--quiet"]
    for mesher in ("adaptive", "layered"):
        out = ["--out", str(tmp_path / mesher), "--mesher", mesher]
        subprocess.run([*command, "run", *words, *out], env=kept, check=True)
        assert len(set(cache.rglob("*.nb?")) - compiled) <= 0.05 * len(compiled)
