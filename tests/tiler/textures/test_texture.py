"""`citystitch texture`: a city whose every place has a colour, seen by VTK from known cameras."""

import csv
import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.benchmarks.texture_truth import measure
from tests.helpers.oriented_images import Array, Pose, colour_of, scene_of, take_images, write_colmap
from tests.helpers.patch_readers import read_document
from tests.tiler.export.test_formats_glb import validate
from tiler.cli.main import main
from tiler.textures.vegetation import FEATURES, FORMAT

SIZE = (640, 480)


@pytest.fixture(scope="module")
def flight(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Pose], Array]:
    """Folder of images and cameras of COLMAP, the poses, and the triangles of the city."""
    triangles = scene_of(small_run)
    x, y, z = ((triangles.reshape(-1, 3).min(axis=0) + triangles.reshape(-1, 3).max(axis=0)) / 2).tolist()
    around = [(0, -250), (250, 0), (0, 250), (-250, 0)]
    poses = [Pose(f"{k}.png", (x + dx, y + dy, z + 200), (x, y, z), SIZE) for k, (dx, dy) in enumerate(around)]
    folder = tmp_path_factory.mktemp("flight")
    take_images(triangles, poses, folder)
    write_colmap(poses, folder, triangles.reshape(-1, 3).min(axis=0))
    return folder, poses, triangles


def words(run: Path, folder: Path, out: Path, triangles: Array, *more: str) -> list[str]:
    origin = ",".join(map(repr, triangles.reshape(-1, 3).min(axis=0).tolist()))
    given = ["--cameras", str(folder), "--images", str(folder), f"--origin={origin}", "--texel", "0.4"]
    return ["texture", str(run), *given, "--least-resolution", "0.5", "-o", str(out), *more]


def test_texels_have_the_colours_of_their_places_and_hidden_points_are_those_of_rays(
    small_run: Path, flight: tuple[Path, list[Pose], Array], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, poses, triangles = flight
    found = measure(small_run, folder, poses, triangles, 0.4)
    assert found["IoU"] >= 0.95
    assert found["hidden points"] > 500
    assert found["mean error of 255"] < 25
    assert main(words(small_run, folder, tmp_path / "a", triangles)) == 0
    assert main(words(small_run, folder, tmp_path / "b", triangles)) == 0
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert all((tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes() for path in files)
    rows = list(csv.DictReader((tmp_path / "a/buildings.csv").read_text().splitlines()))
    record = json.loads((tmp_path / "a/textures.json").read_text())
    assert (record["buildings"], record["images_left_out"]) == (len(rows), 0) == (15, 0)
    tiles = [path for path in files if path.suffix == ".glb"]
    issues = validate(tmp_path / "a" / tiles[0], monkeypatch)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
    off = np.concatenate([errors_of(tmp_path / "a" / path) for path in tiles])
    assert np.median(off) < 25
    listed = list(csv.DictReader((tmp_path / "a/surfaces.csv").read_text().splitlines()))
    assert len([row for row in listed if float(row["visible"]) == 0]) == record["surfaces"] - record["textured"]


def errors_of(path: Path) -> Array:
    """Compare the page of each textured triangle, at its middle, with the colour of that place."""
    document, take = read_document(path)
    assert all(node["extras"]["texture_visible"] > 0.5 for node in document["nodes"])
    pages = [Image.open(BytesIO(view_of(path, document, image["bufferView"]))) for image in document["images"]]
    found = [np.empty(0)]
    for node in document["nodes"]:
        for one in document["meshes"][node["mesh"]]["primitives"]:
            if "TEXCOORD_0" in one["attributes"]:
                page = np.asarray(pages[one["material"]], np.float64)
                accessor = document["accessors"][one["attributes"]["TEXCOORD_0"]]
                rows = np.frombuffer(view_of(path, document, accessor["bufferView"]), "<f4")
                uv = rows.reshape(-1, 3, 2).mean(axis=1)
                x, y, z = take(one["attributes"]["POSITION"]).astype(np.float64).reshape(-1, 3, 3).mean(axis=1).T
                places = np.column_stack((x, -z, y)) + document["asset"]["extras"]["origin"]
                column, row = (uv * [page.shape[1], page.shape[0]]).astype(int).T
                found.append(np.abs(page[row, column] - colour_of(places)).mean(axis=1))
    return np.concatenate(found)


def view_of(path: Path, document: dict[str, Any], number: int) -> bytes:
    data = path.read_bytes()
    first = 28 + int.from_bytes(data[12:16], "little") + document["bufferViews"][number]["byteOffset"]
    return data[first : first + document["bufferViews"][number]["byteLength"]]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"images.txt": ("0.png", "none.png")}, "images left out"),
        ({"cameras.txt": ("640 480", "960 720")}, "none of 4 images can be used; 0.png: is 640 x 480 pixels"),
        ({"cameras.txt": ("PINHOLE", "FOV")}, "camera model FOV"),
        ({"--origin": ("", "0,0,0")}, "m from the city; bound: 5000 m"),
        ({"--origin": ("", "1,2")}, "--origin 1,2: is not X,Y,Z"),
    ],
)
def test_images_that_cannot_be_used_are_told(
    small_run: Path,
    flight: tuple[Path, list[Pose], Array],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, tuple[str, str]],
    told: str,
) -> None:
    folder, _, triangles = flight
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    more = []
    for name, (old, new) in change.items():
        if name.startswith("--"):
            more.append(f"{name}={new}")
        else:
            text = (tmp_path / name).read_text()
            assert old in text
            (tmp_path / name).write_text(text.replace(old, new))
    code = main(words(small_run, tmp_path, tmp_path / "out", triangles, *more))
    captured = capsys.readouterr()
    assert told in captured.out + captured.err
    assert code == (0 if "left out" in told else 2 if "X,Y,Z" in told else 1)
    assert "Traceback" not in captured.err


def test_plants_hide_what_is_behind_them(
    small_run: Path, flight: tuple[Path, list[Pose], Array], tmp_path: Path
) -> None:
    folder, _, triangles = flight
    rows = [0.0] * FEATURES
    everywhere = {"format": FORMAT, "patch": 20, "mean": rows, "spread": [1.0] * FEATURES}
    document = everywhere | {"weights": [[[0.0]] * FEATURES], "offsets": [[1.0]]}
    (tmp_path / "plants.json").write_text(json.dumps(document))
    more = ["--vegetation", str(tmp_path / "plants.json")]
    assert main(words(small_run, folder, tmp_path / "out", triangles, *more)) == 0
    assert json.loads((tmp_path / "out/textures.json").read_text())["textured"] == 0
    listed = (tmp_path / "out/surfaces.csv").read_text().splitlines()[1:]
    reasons = [line.split(",")[-1] for line in listed]
    assert reasons.count("behind plants") > 50
    assert set(reasons) <= {"behind plants", "hidden", "no image faces it", "outside all images"}
