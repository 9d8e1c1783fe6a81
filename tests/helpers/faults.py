"""Faults on purpose: functions of stages that fail for some items, in any process."""

import ctypes
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tiler.engine.engine import Engine
from tiler.engine.stage import Facts, Stage
from tiler.engine.task import Task


def raises(_: Task) -> None:
    raise ZeroDivisionError("a fault on purpose")


def segfaults(_: Task) -> None:
    ctypes.string_at(0)


def hangs(_: Task) -> None:
    time.sleep(3600)


def hangs_in_c(_: Task) -> None:
    """Hold the interpreter for ever: no Python thread runs any more."""
    ctypes.PyDLL(None).sleep(3600)


def swallows_memory(_: Task) -> None:
    np.ones(2**33, np.uint8)


def is_killed(_: Task) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@dataclass(frozen=True)
class Faulty:
    """The function of a stage, but for some of its items."""

    function: Callable[[Task], Facts | None]
    faults: Mapping[str, Callable[[Task], None]]

    def __call__(self, task: Task) -> Facts | None:
        if task.name in self.faults:
            self.faults[task.name](task)
        return self.function(task)


@dataclass(frozen=True)
class Once:
    """A fault that happens the first time only; `mark` is where it is remembered."""

    fault: Callable[[Task], None]
    mark: Path

    def __call__(self, task: Task) -> None:
        if not self.mark.exists():
            self.mark.touch()
            self.fault(task)


Faults = Mapping[str, Mapping[str, Callable[[Task], None]]]  # by stage and item


@contextmanager
def injected(faults: Faults) -> Iterator[None]:
    """Let items of a run's stages fail; their keys are what they were."""
    original = Engine.run

    def run(self: Engine, *stages: Stage, **others: Any) -> None:
        wrapped = [
            replace(stage, function=Faulty(stage.function, faults[stage.name])) if stage.name in faults else stage
            for stage in stages
        ]
        original(self, *wrapped, **others)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Engine, "run", run)
        yield
