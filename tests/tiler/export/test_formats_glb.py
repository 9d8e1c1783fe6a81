"""glTF: structure, exact boxes, every facet once, and no complaint of the Khronos validator."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from tests.helpers.hand_pieces import HandPieces, box_pieces
from tests.helpers.patch_readers import corners_of, open_edges, patch_of, read_document, surface_of
from tests.helpers.programs import run_program
from tests.tiler.export.conftest import Exported
from tiler.export.foam_patches import PATCHES
from tiler.formats import glb
from tiler.formats.glb import write_glb
from tiler.mesh_files.mesh_pieces import open_pieces

SCRIPT = Path(__file__).resolve().parents[2] / "helpers" / "validate_gltf.js"
VALIDATOR = "npm install --global gltf-validator; see .ci/run"


def test_vertices_are_there_once_in_their_exact_box_and_surfaces_are_closed(
    small_run: Path, exported: Exported
) -> None:
    path = exported(small_run, "glb")
    document, take = read_document(path)
    positions, (mesh,) = take(0).reshape(-1, 3), document["meshes"]
    corners = np.concatenate([take(primitive["indices"]).reshape(-1, 3) for primitive in mesh["primitives"]])
    assert np.array_equal(np.unique(corners), np.arange(len(positions)))
    expected = surface_of(corners_of(open_pieces(small_run), patch_of))
    assert len(positions) == len(np.unique(expected.reshape(-1, 3), axis=0))
    # Closed by its indices: in single precision two vertices may have one place.
    by_index = np.column_stack((np.arange(len(positions)), np.zeros((len(positions), 2))))
    assert open_edges(by_index[corners]) == 0
    box = document["accessors"][0]
    assert box["min"] == positions.min(axis=0).tolist()
    assert box["max"] == positions.max(axis=0).tolist()
    extras, record = document["asset"]["extras"], json.loads((small_run / "run.json").read_text())
    west, south, east, north = record["region"]["bounds"]
    assert extras["crs"] == record["region"]["crs"]
    assert np.allclose(extras["origin"][:2], [(west + east) / 2, (south + north) / 2], atol=1)
    clear = {m["name"] for m in document["materials"] if m.get("alphaMode") == "BLEND"}
    assert clear == {"top", "west", "east", "south", "north"}
    assert all(material["doubleSided"] for material in document["materials"])
    marks = [primitive["extras"]["marker"] for primitive in mesh["primitives"]]
    assert [PATCHES[Marker(mark)] for mark in marks] == [
        document["materials"][primitive["material"]]["name"] for primitive in mesh["primitives"]
    ]


def test_what_glb_cannot_hold_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(glb, "MOST_BYTES", 1000)
    with pytest.raises(InputError, match="bytes as GLB; bound: 1000; use --format ply"):
        write_glb(tmp_path / "x.glb", box_pieces(), crs="EPSG:28992")
    with pytest.raises(InputError, match="has no facets"):
        write_glb(tmp_path / "x.glb", HandPieces((), 0, []), crs="EPSG:28992")
    assert not list(tmp_path.iterdir())


def validate(path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Ask Khronos' validator, which may be installed for all users."""
    # The text also holds what npm warns of, before or after the folder.
    said = run_program(["npm", "root", "--global"], path.parent)
    folder = next(line for line in said.splitlines() if Path(line).is_absolute())
    monkeypatch.setenv("NODE_PATH", os.pathsep.join((folder, os.environ.get("NODE_PATH", ""))))
    text = run_program(["node", str(SCRIPT), str(path)], path.parent)
    if "Cannot find module 'gltf-validator'" in text:
        pytest.fail(f"no gltf-validator; {VALIDATOR}")
    report: dict[str, Any] = json.loads(text)
    return report


@pytest.mark.long
def test_the_validator_has_no_complaints(
    small_run: Path, exported: Exported, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = validate(exported(small_run, "glb"), monkeypatch)
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    assert report["issues"]["messages"] == []
    assert report["info"]["totalTriangleCount"] == counts["facets"]


@pytest.mark.long
def test_the_validator_complains_of_a_broken_file(
    small_run: Path, exported: Exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = exported(small_run, "glb").read_bytes()
    (tmp_path / "broken.glb").write_bytes(data[:-4] + b"\xfe\xff\xff\xff")
    assert validate(tmp_path / "broken.glb", monkeypatch)["issues"]["numErrors"] > 0
