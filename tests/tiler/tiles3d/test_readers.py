"""Readers that are not ours: 3d-tiles-tools and glTF-Validator, CesiumJS and 3DTilesRendererJS in a browser."""

import functools
import http.server
import json
import os
import shutil
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pipeline.data.errors import InputError
from tests.helpers.programs import run_program
from tests.helpers.tilesets import walk_tree
from tiler.export.export import export_run
from tiler.tiles3d.view import serve_tiles

HELPERS = Path(__file__).resolve().parents[2] / "helpers"
PACKAGES = "npm install --global gltf-validator playwright-core cesium 3d-tiles-tools; see .ci/run"


@pytest.fixture(scope="module")
def tiles(sloped_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sloped city as 3D Tiles."""
    path = tmp_path_factory.mktemp("read") / "tiles"
    export_run(sloped_run, path, name="3dtiles")
    return path


@pytest.fixture(scope="module")
def packed(sloped_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, packed by Draco."""
    path = tmp_path_factory.mktemp("packed") / "tiles"
    export_run(sloped_run, path, name="3dtiles", options={"compression": "draco"})
    return path


def run_script(name: str, *words: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run a script of node with the packages of all users; gives what it prints last."""
    monkeypatch.setenv("NODE_PATH", str(node_modules(folder)))
    text = run_program(["node", str(HELPERS / name), *words], folder)
    if "Cannot find module" in text:
        pytest.fail(f"{text[-300:]}; {PACKAGES}")
    found: dict[str, Any] = json.loads(text.strip().splitlines()[-1])
    return found


def node_modules(folder: Path) -> Path:
    said = run_program(["npm", "root", "--global"], folder)
    return next(Path(line) for line in said.splitlines() if Path(line).is_absolute())


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Files of a folder, without a line for each."""

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def serve_folder(folder: Path) -> Iterator[str]:
    handler = functools.partial(Quiet, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


def test_the_server_gives_out_the_folder_alone(tiles: Path) -> None:
    with serve_tiles(tiles, "127.0.0.1:0") as url:
        with urllib.request.urlopen(f"{url}tiles/tileset.json") as answer:
            assert answer.read() == (tiles / "tileset.json").read_bytes()
        with urllib.request.urlopen(url) as answer:
            assert b'src="page.js"' in answer.read()
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        for path, host in (("tiles/%2e%2e/run.json", "127.0.0.1"), ("tiles/tileset.json", "elsewhere.example")):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(urllib.request.Request(url + path, headers={"Host": host}))
    with (
        pytest.raises(InputError, match=r"has no tileset.json; write one by citystitch export"),
        serve_tiles(tiles.parent, "127.0.0.1:0"),
    ):
        pass


@pytest.mark.long
@pytest.mark.parametrize("kind", ["tiles", "packed"])
def test_tools_and_validator_read_the_same_tree(
    kind: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiles: Path = request.getfixturevalue(kind)
    found = run_script("read_tiles.mjs", str(tiles), folder=tiles, monkeypatch=monkeypatch)
    assert found["messages"] == []
    wanted = {
        f"content/{level}/{x}/{y}.glb": (tile.region.tolist(), tile.error)
        for (level, x, y), tile in walk_tree(tiles).items()
    }
    assert {one["contents"][0]: (one["region"], one["error"]) for one in found["tiles"]} == wanted


@pytest.mark.long
def test_the_validator_sees_a_broken_content(tiles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(tiles, tmp_path / "broken")
    path = tmp_path / "broken/content/0/0/0.glb"
    path.write_bytes(path.read_bytes().replace(b'"max":[', b'"max":[1', 1))
    found = run_script("read_tiles.mjs", str(tmp_path / "broken"), folder=tiles, monkeypatch=monkeypatch)
    assert found["messages"]


@pytest.mark.long
def test_browsers_show_the_city(
    sloped_run: Path, tiles: Path, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Our page those of Draco, CesiumJS the others."""
    chromium = os.environ.get("CHROMIUM", "/usr/bin/chromium")
    site = tmp_path / "site"
    site.mkdir()
    (site / "cesium").symlink_to(node_modules(tmp_path) / "cesium/Build/Cesium")
    (site / "tiles").symlink_to(tiles)
    shutil.copy(HELPERS / "cesium.html", site)
    with serve_tiles(packed, "127.0.0.1:0") as url, serve_folder(site) as root:
        words = (url, f"{root}/cesium.html", chromium, str(tmp_path))
        seen = run_script("browse_tiles.mjs", *words, folder=tmp_path, monkeypatch=monkeypatch)
    assert "error" not in seen, seen["error"]
    assert (seen["console"], seen["foreign"]) == ([], [])
    assert "level 0 to 0" in seen["far"]
    assert seen["unknown"] == [-9999]  # of a block no error of its roof is known
    depth = max(level for level, _, _ in walk_tree(tiles))
    assert f"to {depth}, LoD" in seen["near"]
    assert "LoD 2.2" in seen["near"]
    model = json.loads((sloped_run / "citymodel.city.json").read_text())["CityObjects"]
    assert len({row["id"] for row in seen["picked"]}) > 3
    for row in seen["picked"]:
        known = model[row["id"]]["attributes"]
        assert float(row["height"]) == pytest.approx(known["height"], abs=0.006)
        assert row["roof method"] == known["roof_method"]
    assert seen["mixed"] == 0  # triangles of more than one colour
    assert seen["modes"]["height"] > seen["modes"]["surface"] > 1
    assert seen["length"].count(" m") == 3
    assert (seen["ended"], seen["overflow"]) == ("", 0)
    globe = seen["cesium"]
    assert globe["failed"] == []
    assert globe["loaded"] > 0
    assert globe["error"] == walk_tree(tiles)[0, 0, 0].error
    assert len(globe["found"]) > 3
    houses = {name for name, thing in model.items() if "parents" not in thing} | set(model)
    for name, row in globe["found"].items():
        assert name in houses
        assert row["roof_height"] > row["ground_height"]
