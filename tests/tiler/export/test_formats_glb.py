"""glTF: structure, exact boxes, every facet once, and no complaint of the Khronos validator."""

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import Marker
from tests.helpers.hand_pieces import HandPieces, box_pieces
from tests.helpers.programs import run_program
from tests.tiler.export.test_formats_surfaces import Facets, facets_of, open_edges, rows_of
from tiler.cli.main import main
from tiler.export.export import export_run
from tiler.export.foam_patches import PATCHES
from tiler.formats import glb
from tiler.formats.glb import write_glb
from tiler.mesh_files.mesh_pieces import open_pieces

SCRIPT = Path(__file__).resolve().parents[2] / "helpers" / "validate_gltf.js"
VALIDATOR = "npm install --global gltf-validator; see .ci/run"


@pytest.fixture(scope="module")
def exported(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small city's boundary as GLB."""
    path = tmp_path_factory.mktemp("glb") / "city.glb"
    assert main(["export", str(small_run), "--format", "glb", "-o", str(path)]) == 0
    return path


def read_document(path: Path) -> tuple[dict[str, Any], Callable[[int], NDArray[Any]]]:
    """Read the document, and give what takes the numbers of an accessor."""
    data = path.read_bytes()
    magic, version, total, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, size % 4, kind) == (b"glTF", 2, len(data), 0, b"JSON")
    document = json.loads(data[20 : 20 + size])
    length, kind = struct.unpack_from("<I4s", data, 20 + size)
    body = data[28 + size :]
    assert (length, kind, document["buffers"]) == (len(body), b"BIN\0", [{"byteLength": len(body)}])
    types = {5126: ("<f4", 3, "VEC3"), 5125: ("<u4", 1, "SCALAR")}

    def take(k: int) -> NDArray[Any]:
        accessor = document["accessors"][k]
        dtype, width, name = types[accessor["componentType"]]
        view = document["bufferViews"][accessor["bufferView"]]
        start, n = accessor.get("byteOffset", 0), width * accessor["count"]
        assert accessor["type"] == name
        assert start + 4 * n <= view["byteLength"]
        return np.frombuffer(body, dtype, n, view.get("byteOffset", 0) + start)

    return document, take


def read_glb(path: Path) -> tuple[dict[str, Any], NDArray[np.float32], dict[str, NDArray[np.uint32]]]:
    """Read the document, positions (n, 3), and triangles (k, 3) by material."""
    document, take = read_document(path)
    (mesh,) = document["meshes"]
    assert {primitive["attributes"]["POSITION"] for primitive in mesh["primitives"]} == {0}
    facets = {
        document["materials"][primitive["material"]]["name"]: take(primitive["indices"]).reshape(-1, 3)
        for primitive in mesh["primitives"]
    }
    assert len(facets) == len(mesh["primitives"])
    return document, take(0).reshape(-1, 3), facets


def turned(points: NDArray[np.float64], origin: list[float]) -> NDArray[np.float64]:
    """Coordinates as glTF has them: east, up, south of the origin, in single precision."""
    east, north, up = np.moveaxis(points - origin, -1, 0)
    return np.stack((east, up, -north), axis=-1).astype(np.float32).astype(np.float64)


def check_document(path: Path, pieces: Any) -> dict[str, Any]:
    document, positions, facets = read_glb(path)
    expected = facets_of(pieces)
    origin = document["asset"]["extras"]["origin"]
    numbers = {name: int(marker) for marker, name in PATCHES.items()}
    marker = np.concatenate([np.full(len(rows), numbers[name]) for name, rows in facets.items()])
    corners = np.concatenate(list(facets.values()))
    found = Facets(positions.astype(np.float64)[corners], marker)
    wanted = Facets(turned(expected.corners, origin), expected.marker)
    assert rows_of(found, building=False) == rows_of(wanted, building=False)
    assert np.array_equal(np.unique(corners), np.arange(len(positions)))
    assert len(positions) == len(np.unique(expected.corners.reshape(-1, 3), axis=0))
    # Closed by its indices: in single precision two vertices may have one place.
    by_index = np.column_stack((np.arange(len(positions)), np.zeros((len(positions), 2))))
    assert open_edges(Facets(by_index[corners], marker)) == 0
    box = document["accessors"][0]
    assert box["min"] == positions.min(axis=0).tolist()
    assert box["max"] == positions.max(axis=0).tolist()
    return document


def test_every_facet_is_there_with_its_material(small_run: Path, exported: Path) -> None:
    document = check_document(exported, open_pieces(small_run))
    extras, record = document["asset"]["extras"], json.loads((small_run / "run.json").read_text())
    west, south, east, north = record["region"]["bounds"]
    assert extras["crs"] == record["region"]["crs"]
    assert np.allclose(extras["origin"][:2], [(west + east) / 2, (south + north) / 2], atol=1)
    clear = {m["name"] for m in document["materials"] if m.get("alphaMode") == "BLEND"}
    assert clear == {"top", "west", "east", "south", "north"}
    assert all(material["doubleSided"] for material in document["materials"])


@pytest.mark.parametrize("seed", range(3))
def test_pieces_in_any_order_make_the_same_surface(tmp_path: Path, seed: int) -> None:
    pieces = box_pieces(seed=seed)
    write_glb(tmp_path / "box.glb", pieces, crs="EPSG:28992")
    document = check_document(tmp_path / "box.glb", pieces)
    marks = {primitive["extras"]["marker"] for primitive in document["meshes"][0]["primitives"]}
    assert marks == {m.value for m in Marker} - {Marker.WALL, Marker.EAST, Marker.BOTTOM, Marker.FOUNDATION}


def test_export_is_the_same_bytes_again(small_run: Path, exported: Path, tmp_path: Path) -> None:
    export_run(small_run, tmp_path / "again.glb", name="glb")
    assert (tmp_path / "again.glb").read_bytes() == exported.read_bytes()


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
def test_the_validator_has_no_complaints(small_run: Path, exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report = validate(exported, monkeypatch)
    counts = json.loads((small_run / "run.json").read_text())["counts"]
    assert report["issues"]["messages"] == []
    assert report["info"]["totalTriangleCount"] == counts["facets"]


@pytest.mark.long
def test_the_validator_complains_of_a_broken_file(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = exported.read_bytes()
    (tmp_path / "broken.glb").write_bytes(data[:-4] + b"\xfe\xff\xff\xff")
    assert validate(tmp_path / "broken.glb", monkeypatch)["issues"]["numErrors"] > 0
