"""Meshes are the same bytes whatever instructions numpy and its BLAS find on a processor."""

import importlib
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from tiler.cli.main import BLOCK

# Instructions that numpy looks for when it is imported.
CHOSEN = importlib.import_module("numpy._core._multiarray_umath").__cpu_dispatch__
# As on a machine of 2008: no fused multiply and add, no wide vectors.
OLD = {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": " ".join(CHOSEN)}
RUN = """
import sys
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
from tiler.cli.main import main

print("found:", *(name for name in __cpu_dispatch__ if __cpu_features__[name]))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the names of instructions are those of x86-64")
def test_a_block_is_the_same_bytes_on_an_old_processor(tmp_path: Path) -> None:
    kept = []
    for name, instructions in (("new", {}), ("old", OLD)):
        out = tmp_path / name
        words = [
            "run",
            str(BLOCK / "cloud.laz"),
            "--footprints",
            str(BLOCK / "footprints.geojson"),
            "--out",
            str(out),
        ]
        done = subprocess.run(
            [sys.executable, "-c", RUN, *words],
            env=os.environ | instructions,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert ("found:" in done.stdout.splitlines()) >= (name == "old"), "they cannot be switched off"
        made = [*(out / "store.zarr").rglob("*.zip"), *out.glob("*/*.vt?"), *out.glob("*.city.json")]
        kept.append({str(path.relative_to(out)): path.read_bytes() for path in made})
    assert len(kept[0]) > 20
    assert kept[0] == kept[1]
