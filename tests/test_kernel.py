"""Kernels: numba is imported when one is called, and what it keeps for its compiler is read when that asks."""

import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core import codegen

from pipeline import growth, quality
from pipeline.kernel import Kernel
from pipeline.kernel_library import Library, leave_unread

TWO = """
from pipeline.kernel import kernel


@kernel
def inner(n):
    return n + 1


@kernel(error_model="numpy")
def outer(n):
    return inner(n) * 2 / (n - n)


def library(one):
    (found,) = one.dispatcher.overloads.values()
    return found.library


def look(one):
    return type(library(one)).__name__, library(one)._unread is not None
"""


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """Folder of a module with a kernel and one that calls it."""
    (tmp_path / "two.py").write_text(TWO)
    return tmp_path


def tell(folder: Path, code: str) -> str:
    """What a fresh process prints that has the module."""
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import two; {code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    return done.stdout.strip()


def test_what_is_kept_for_the_compiler_is_read_when_it_asks(two: Path) -> None:
    there = "print('numba' in sys.modules, end=' ')"
    inner = "print(two.inner(1), two.look(two.inner), end=' ')"
    nowhere = "print(two.library(two.inner).get_pointer_to_function('nowhere'), two.look(two.inner)[1])"
    assert tell(two, f"{there}; {inner}; {there}") == "False 2 ('Library', False) True"  # compiled
    assert tell(two, f"{inner}; {nowhere}") == "2 ('Library', True) 0 True"  # loaded
    both = "two.inner(1); print(two.outer(1), two.look(two.inner), two.look(two.outer))"
    assert tell(two, both) == "inf ('Library', False) ('Library', False)"  # loaded, and linked into the other
    assert tell(two, both) == "inf ('Library', True) ('Library', True)"


def test_the_options_of_a_kernel_are_those_of_numba() -> None:
    measure: Any = quality._measure_some
    found = measure.dispatcher.targetoptions
    assert (found["nogil"], found["error_model"]) == (True, measure.targetoptions["error_model"])
    assert measure.__name__ == "_measure_some"


def test_a_numba_that_keeps_its_code_otherwise_has_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codegen.JITCPUCodegen, "_library_class", codegen.AOTCodeLibrary)
    leave_unread()
    assert codegen.JITCPUCodegen._library_class is codegen.AOTCodeLibrary
    monkeypatch.setattr(codegen.JITCPUCodegen, "_library_class", codegen.JITCodeLibrary)
    monkeypatch.delattr(codegen.CPUCodeLibrary, "_get_module_for_linking")
    leave_unread()
    assert codegen.JITCPUCodegen._library_class is codegen.JITCodeLibrary
    monkeypatch.undo()
    leave_unread()
    assert codegen.JITCPUCodegen._library_class is Library


def test_a_kernel_is_pickled_by_its_name() -> None:
    assert isinstance(growth.count_steps, Kernel)
    assert pickle.loads(pickle.dumps(growth.count_steps)) is growth.count_steps
