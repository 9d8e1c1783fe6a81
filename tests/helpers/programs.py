"""Programs that read what we write. One that is not there is a failure: the tests that call them are `long`."""

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

# Debian 12; see .ci/run
PACKAGES = "apt-get install -y openfoam gmsh python3-dolfinx cgns-convert gdal-bin libcitygml-bin tmux"
FOAM = "/usr/share/openfoam"
MPI = ("mpirun", "--allow-run-as-root", "--oversubscribe", "-np")


def run_program(words: Sequence[str], folder: Path, *, timeout: float = 900.0) -> str:
    """Run a program; returns what it says. Whether that is good is for the caller to see."""
    program = words[4 + 1] if words[0] == "mpirun" else words[0]
    for name in {words[0], program}:
        if shutil.which(name) is None:
            pytest.fail(f"no program {name}; {PACKAGES}")
    place = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    place.setdefault("WM_PROJECT_DIR", FOAM)
    done = subprocess.run(
        list(words), cwd=folder, env=place, capture_output=True, text=True, timeout=timeout, check=False
    )
    return done.stdout + done.stderr


def run_foam(name: str, case: Path, *words: str, parts: int | None = None, timeout: float = 3600.0) -> str:
    """Run a program of OpenFOAM to its end, on `parts` processes if given."""
    serial = [name, *words]
    text = run_program(
        serial if parts is None else [*MPI, str(parts), *serial, "-parallel"], case, timeout=timeout
    )
    assert "FOAM FATAL" not in text, text[-3000:]
    assert re.search(r"^End$", text, re.MULTILINE), text[-3000:]
    return text


def read_check(text: str) -> dict[str, float]:
    """Read the numbers that checkMesh prints: of the mesh, its volume and regions, and faces by patch."""
    patterns = {
        "points": r"^    points: +(\d+)",
        "faces": r"^    faces: +(\d+)",
        "internal faces": r"^    internal faces: +(\d+)",
        "cells": r"^    cells: +(\d+)",
        "tetrahedra": r"^    tetrahedra: +(\d+)",
        "regions": r"Number of regions: (\d+)",
        "volume": r"Total volume = ([-+.\deE]+)\.  Cell",
    }
    found = {}
    for name, pattern in patterns.items():
        match = re.search(pattern, text, re.MULTILINE)
        assert match, f"checkMesh says nothing of {name}: {text[-2000:]}"
        found[name] = float(match[1])
    table = re.search(r"^    Patch +Faces +Points.*\n((?:    \w+ +\d+ +\d+.*\n)+)", text, re.MULTILINE)
    assert table, text[-2000:]
    for line in table[1].splitlines():
        name, n, *_ = line.split()
        found[f"patch {name}"] = float(n)
    return found


def mesh_is_ok(text: str) -> bool:
    """Tell whether checkMesh is content: it ends with 0 either way."""
    return bool(re.search(r"^Mesh OK\.$", text, re.MULTILINE)) and "Failed" not in text and "***" not in text
