"""CGNS: named patches and families, read by VTK's reader and by the CGNS library's own check."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.helpers.hand_pieces import box_pieces
from tests.helpers.patch_readers import assert_same_patches, corners_of, expected_of, patch_of, read_cgns
from tests.helpers.programs import run_program
from tests.tiler.export.conftest import Exported
from tiler.cli.main import main
from tiler.formats import cgns
from tiler.formats.cgns import write_cgns
from tiler.mesh_files.mesh_pieces import open_pieces

WORDS = ("--buildings", "patches")


def test_numbers_beyond_32_bits_are_read_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgns, "INT32_LIMIT", 10)
    pieces = box_pieces()
    write_cgns(tmp_path / "box.cgns", pieces, crs="EPSG:28992")
    with h5py.File(tmp_path / "box.cgns") as file:
        zone = file["city/air"]
        places = ["", "cells/ElementRange/", "cells/ElementConnectivity/", "ZoneBC/top/PointRange/"]
        assert {zone[f"{place} data"].dtype for place in places} == {np.dtype(np.int64)}
        assert {zone[place or "."].attrs["type"] for place in places} == {b"I8"}
    path = tmp_path / "box.cgns"
    assert_same_patches(read_cgns(path), expected_of(pieces, path, "cgns"))


def test_families_units_and_crs_stand_in_the_file(small_run: Path, exported: Exported) -> None:
    with h5py.File(exported(small_run, "cgns", *WORDS)) as file:
        base = file["city"]
        labels = {name: node.attrs["label"].decode() for name, node in base.items() if name != " data"}
        kinds = {
            name: base[name]["FamilyBC/ data"][()].tobytes().decode()
            for name, label in labels.items()
            if label == "Family_t"
        }
        units = [row.tobytes().decode().strip() for row in base["DimensionalUnits/ data"][()]]
        crs = base["CRS/ data"][()].tobytes().decode()
    walls = {name for name, kind in kinds.items() if kind == "BCWall"}
    assert {name for name in kinds if name not in walls} == {"top", "west", "east", "south", "north"}
    assert "ground" in walls
    assert all(name == "ground" or name.startswith("building_") for name in walls)
    assert units == ["Null", "Meter", "Null", "Null", "Null"]
    assert crs == json.loads((small_run / "run.json").read_text())["region"]["crs"]


def test_zones_are_refused(small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["export", str(small_run), "--format", "cgns", "-o", str(tmp_path / "x.cgns")]
    assert main([*command, "--buildings", "zones"]) == 2
    assert "--buildings zones: format cgns takes patches" in capsys.readouterr().err


def check_with_cgns(path: Path) -> dict[str, Any]:
    """What the CGNS library's check says of a file; it ends with 0 either way."""
    text = run_program(["cgnscheck", "-v", str(path)], path.parent)
    assert "checking complete" in text, text[-3000:]
    sets = re.findall(
        r'checking element set "(\w+)"\n +Element Set Type=TRI_3\n.*\n.*\n'
        r" +\[internal,external\] Faces=\[(\d+),(\d+)\]",
        text,
    )
    size = re.search(r"Vertex Size=\[(\d+)\]\s+Cell Size=\[(\d+)\]", text)
    assert size
    return {
        "points": int(size[1]),
        "cells": int(size[2]),
        "outer": {name: int(outer) for name, inner, outer in sets if inner == "0"},
        "families": set(re.findall(r'^    Family="(\w+)"$', text, re.MULTILINE)),
        "complaints": len(re.findall(r"^(?:WARNING|ERROR)", text, re.MULTILINE)),
    }


@pytest.mark.long
def test_the_cgns_library_has_no_complaints(small_run: Path, exported: Exported) -> None:
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    expected = {name: len(rows) for name, rows in corners_of(open_pieces(small_run), patch_of).items()}
    assert expected.pop("Internal") == counts["cells"]
    assert check_with_cgns(exported(small_run, "cgns", *WORDS)) == {
        "points": counts["points"],
        "cells": counts["cells"],
        "outer": expected,
        "families": set(expected),
        "complaints": 0,
    }


def not_a_face(file: h5py.File) -> None:
    file["city/air/ground/ElementConnectivity/ data"][:3] = [1, 1, 2]


def beyond_the_elements(file: h5py.File) -> None:
    file["city/air/ZoneBC/north/PointRange/ data"][1, 0] = 10**8


def no_such_family(file: h5py.File) -> None:
    file["city"].move("ground", "floor")
    file["city/floor"].attrs.modify("name", np.bytes_("floor"))


def no_such_point(file: h5py.File) -> None:
    file["city/air/cells/ElementConnectivity/ data"][0] = 10**8


@pytest.mark.long
@pytest.mark.parametrize("damage", [not_a_face, beyond_the_elements, no_such_family, no_such_point])
def test_the_cgns_library_sees_what_is_broken(
    small_run: Path, exported: Exported, tmp_path: Path, damage: Any
) -> None:
    sound = check_with_cgns(exported(small_run, "cgns", *WORDS))
    path = Path(shutil.copy(exported(small_run, "cgns", *WORDS), tmp_path / "broken.cgns"))
    with h5py.File(path, "r+") as file:
        damage(file)
    assert check_with_cgns(path) != sound
