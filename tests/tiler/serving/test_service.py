"""The service of a run folder: what it takes, what it refuses, and edits that wait together."""

import http.client
import json
import re
import shutil
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.data.errors import CityError, ConfigError
from tests.tiler.editing.test_edit import mesh_of, read_input, write
from tests.tiler.tiles3d.test_update import read_all
from tiler.config.config import make_config
from tiler.editing.edit import held_city
from tiler.editing.requests import ConflictError
from tiler.export.export import export_run
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.serving.bodies import MOST_BYTES, make_asked
from tiler.serving.edit_queue import REST, EditQueue
from tiler.serving.serve import FOLDER, serve_city, view_city
from tiler.store.folder_lock import only_run
from tiler.store.out_folder import CITY_MODEL
from tiler.tiles3d.globe import Globe, geocentric
from tiler.tiles3d.slices import cut_pieces, make_slices
from tiler.tiles3d.update import TILES
from tiler.workflow.audit import Audit, Damage
from tiler.workflow.run import run

TOKEN = "0123456789abcdef"


def ask(url: str, path: str, body: Any = None, method: str = "", **headers: str) -> tuple[int, Any]:
    """Ask for a path; gives status and JSON, or bytes of another type."""
    connection = http.client.HTTPConnection(url.split("/")[2], timeout=120)
    data = body if isinstance(body, bytes | None) else json.dumps(body).encode()
    given = {"Content-Type": "application/json"} | {name.replace("_", "-"): text for name, text in headers.items()}
    try:
        connection.request(method or ("GET" if body is None else "POST"), path, data, given)
        reply = connection.getresponse()
        content = reply.read()
        is_json = reply.headers.get("Content-Type", "").startswith("application/json")
        return reply.status, json.loads(content) if is_json else content
    finally:
        connection.close()


@pytest.fixture(scope="module")
def city(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A city that is served."""
    return shutil.copytree(small_run, tmp_path_factory.mktemp("served") / "city")


@pytest.fixture(scope="module")
def url(city: Path) -> Iterator[str]:
    with serve_city(city, "127.0.0.1:0") as url:
        yield url


def footprint(shape: shapely.Polygon) -> dict[str, Any]:
    return json.loads(shapely.to_geojson(shape))  # type: ignore[no-any-return]


def version(url: str) -> str:
    with urllib.request.urlopen(urllib.request.Request(f"{url}tiles/tileset.json", method="HEAD")) as answer:
        return str(answer.headers["ETag"])


def test_an_edit_is_done_once_and_a_later_one_of_the_building_conflicts(
    url: str, city: Path, tmp_path: Path
) -> None:
    (house, shape), *_ = read_input(city).items()
    assert ask(url, "/city")[1]["revision"] == 0
    before = version(url)
    assert ask(url, "/edits/one")[0] == 404
    edit = {"id": "one", "action": "replace", "building": house, "height": 7.5, "date": "2027-01-01"}
    edit["footprint"] = footprint(shape.buffer(-0.5))
    status, done = ask(url, "/edits", edit)
    assert (status, done["number"], done["buildings"]) == (201, 1, [house])
    (told,) = done["notes"]
    assert re.fullmatch(rf"{house}: [1-9]\d* roof points in the cloud do not count", told)
    assert done["ran"] < done["tasks"]
    again = ask(url, "/edits", edit)
    assert again == (200, {key: done[key] for key in again[1]})
    assert ask(url, "/edits/one") == again
    status, told = ask(url, "/edits", edit | {"height": 8})
    assert (status, "is that of another edit" in told["error"]) == (422, True)
    status, told = ask(url, "/edits", {"action": "remove", "building": house, "base": 0})
    assert (status, [one["number"] for one in told["changed"]], told["revision"]) == (409, [1], 1)
    assert ask(url, "/edits") == (200, [again[1]])
    with pytest.raises(ConfigError, match="another run is at work there"), held_city(city):
        pass
    while ask(url, "/city")[1]["state"] != REST:
        time.sleep(0.05)
    made = json.loads((city / CITY_MODEL).read_text())["CityObjects"][house]["attributes"]
    assert made["roof_height"] - made["ground_height"] == pytest.approx(7.5)
    assert version(url) != before  # by which the page knows that there are new tiles
    assert ask(url, "/tiles/tileset.json", If_None_Match=before)[0] == 200
    assert ask(url, "/tiles/tileset.json", If_None_Match=version(url))[0] == 304
    export_run(city, tmp_path / "tiles", name="3dtiles")
    assert read_all(city / FOLDER / TILES) == read_all(tmp_path / "tiles")


SQUARE = {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]]}


@pytest.mark.parametrize(
    ("body", "headers", "status", "words"),
    [
        ({"action": "add", "building": "x", "glb": "%"}, {}, 422, "not in base64"),
        ({"action": "add", "building": "x", "glb": "Z2xURg==", "position": [0, 0, 0]}, {}, 422, "is no GLB file"),
        ({"action": "remove", "building": "x", "base": 99}, {}, 422, "base 99: the last edit is number"),
        ({"action": "remove", "building": "x"}, {"Content_Type": "text/plain"}, 415, "application/json expected"),
        ({"action": "remove", "building": "x"}, {"Origin": "http://evil.example"}, 403, "other origins"),
        ({"action": "remove", "building": "x"}, {"Host": "evil.example"}, 403, "127.0.0.1 or localhost"),
        ({"action": "remove", "building": "x"}, {}, 422, "is not in the city"),
        ({"action": "remove"}, {}, 422, "has no building"),
        ({"action": "remove", "building": "x", "footprint": SQUARE}, {}, 422, "remove none"),
        ({"action": "burn", "building": "x"}, {}, 422, "'burn' is not one of"),
        ({"action": "add", "building": "x", "footprint": SQUARE, "height": -1}, {}, 422, "height: -1 is less"),
        ({"action": "add", "building": "x", "footprint": SQUARE}, {}, 422, "0 of 1 features meet the region"),
        ({"action": "add", "building": "x", "footprint": SQUARE, "crs": "no"}, {}, 422, "crs 'no': is unknown"),
        ({"action": "add", "building": "x", "footprint": {"type": "Point"}}, {}, 422, "is no GeoJSON"),
        ({"action": "add", "footprint": SQUARE}, {}, 422, "give the new one an id"),
        ({"action": "remove", "building": "x", "id": "../x"}, {}, 422, "id: '../x' does not match"),
        (b'{"action": "add", "height": NaN}', {}, 422, "NaN is no number"),
        (b"[" * 100_000, {}, 422, "is no JSON"),
        (b"[1]", {}, 422, "body: [1] is not of type 'object'"),
        (b"1" * (MOST_BYTES + 1), {}, 413, "bytes, bound"),
    ],
)
def test_what_is_no_edit_is_refused(body: Any, headers: dict[str, str], status: int, words: str, url: str) -> None:
    found, told = ask(url, "/edits", body, **headers)
    assert found == status
    assert words in told["error"]


def test_the_page_and_the_tiles_are_there(url: str) -> None:
    assert b'src="page.js"' in ask(url, "/")[1]
    assert ask(url, "/tiles/tileset.json")[0] == 200
    assert ask(url, "/edits", method="DELETE")[0] == 405
    assert ask(url, "/tiles/%2e%2e/%2e%2e/run.json")[0] == 403


@pytest.fixture(scope="module")
def viewed(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """A city that is shown, and not edited."""
    city = shutil.copytree(small_run, tmp_path_factory.mktemp("viewed") / "city")
    with view_city(city, "127.0.0.1:0") as url:
        yield url, city


@pytest.mark.parametrize("beside", [-9.0, 9.0])  # a seam, which leaves the box of its tile
def test_a_section_has_the_cells_of_an_upright_slice(
    beside: float, viewed: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    url, city = viewed
    region = json.loads((city / "run.json").read_text())["region"]
    xmin, ymin, xmax, ymax = region["bounds"]
    (seam,) = {tile["box"][2] for tile in json.loads((city / "run.json").read_text())["tiles"].values()} - {xmax}
    line = (seam + beside, ymin + 5, seam + beside, ymax - 5)
    globe = Globe(region["crs"], (xmin, ymin, xmax, ymax))
    ends = geocentric(globe.geographic(np.array([[*line[:2], 0.0], [*line[2:], 0.0]]))).tolist()
    query = "&".join(f"{name}={','.join(map(repr, end))}" for name, end in zip(("from", "to"), ends, strict=True))
    status, data = ask(url, f"/section?{query}")
    rows = np.frombuffer(data, "<f4", offset=24).reshape(-1, 10)
    expected = np.concatenate([*cut_pieces(open_pieces(city), make_slices([], [",".join(map(repr, line))]))])
    assert (status, len(rows)) == (200, len(expected))
    np.testing.assert_allclose(rows[:, 9], expected[:, 9], rtol=1e-6)
    places = geocentric(globe.geographic(expected[:, :9].reshape(-1, 3)))
    np.testing.assert_allclose(np.frombuffer(data, "<f8", 3) + rows[:, :9].reshape(-1, 3), places, atol=1e-3)
    assert ask(url, "/section?from=1,2&to=1,2,3")[0] == 422
    assert ask(url, "/section?from=1,2,3&to=4e6,2,3")[0] == 422
    monkeypatch.setattr("tiler.serving.section.MOST_TRIANGLES", 3)
    assert ask(url, f"/section?{query}")[0] == 422


def test_a_city_that_is_shown_is_not_edited(viewed: tuple[str, Path], url: str) -> None:
    for place in (url, viewed[0]):
        with urllib.request.urlopen(f"{place}tiles/tileset.json") as answer:
            assert answer.headers["Citystitch-Section"] == "yes"  # by which the page offers it
    assert ask(viewed[0], "/edits", {"action": "remove", "building": "x"})[0] >= 400
    assert ask(viewed[0], "/city")[0] == 404
    with pytest.raises(ConfigError, match="is at work"), only_run(viewed[1]):
        pass


def test_others_need_the_token(small_run: Path, tmp_path: Path) -> None:
    city = shutil.copytree(small_run, tmp_path / "city")
    for address, token, words in (
        ("0.0.0.0:0", "", "give --token-file"),
        ("127.0.0.1:0", "short", "at least 16 expected"),
    ):
        with pytest.raises(ConfigError, match=words), serve_city(city, address, token=token):
            pass
    with serve_city(city, "127.0.0.1:0", token=TOKEN) as url:
        remove = {"action": "remove", "building": "nobody"}
        for path in ("/", "/page.js", "/city", "/edits", "/tiles/tileset.json", f"/?token={TOKEN}x"):
            assert ask(url, path)[0] == 401
        assert ask(url, "/edits", remove, Authorization=f"Bearer {TOKEN}x")[0] == 401
        assert ask(url, "/edits", remove, Authorization=f"Bearer {TOKEN}", Origin="http://other.example")[0] == 422
        connection = http.client.HTTPConnection(url.split("/")[2])
        connection.request("GET", f"/?token={TOKEN}")
        reply = connection.getresponse()
        cookie = reply.headers["Set-Cookie"].split(";")[0]
        assert (reply.status, reply.headers["Location"], TOKEN in cookie) == (302, "/", False)
        connection.close()
        assert ask(url, "/city", Cookie=cookie)[0] == 200
        assert ask(url, "/edits", remove, Cookie=cookie)[0] == 401


def test_edits_that_wait_are_one_transaction_and_end_in_the_bytes_of_one_run(
    small_run: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(small_run, tmp_path / "city")
    shapes = read_input(folder)
    (gone, _), (moved, shape), (other, _), *_ = shapes.items()
    new = {"action": "replace", "building": moved, "footprint": footprint(shape.buffer(-0.4))}
    bodies: list[dict[str, Any]] = [
        {"action": "remove", "building": gone, "base": 0},
        {"action": "replace", "building": gone, "footprint": footprint(shapes[gone]), "base": 0},
        new | {"id": "mine"},
        {"action": "remove", "building": other} | {"id": "kept"},
        {"action": "remove", "building": "nobody"},
    ]
    after: list[tuple[int, bool, list[Damage]]] = []

    def look(number: int) -> None:
        after.append((number, (folder / CITY_MODEL).exists(), [*Audit(folder)]))

    with held_city(folder) as city:
        queue = EditQueue(city, look)
        waiting = [queue.put(make_asked(body, city)) for body in bodies]
        assert queue.put(make_asked(bodies[2], city)) is waiting[2]
        with queue:
            found = [one.exception(100) or one.result() for one in waiting]  # type: ignore[union-attr]
    assert isinstance(found[1], ConflictError)
    assert [edit.number for edit in found[1].edits] == [1]
    assert isinstance(found[4], CityError)
    done = [one for one in found if not isinstance(one, BaseException)]
    assert [one.edit.number for one in done] == [1, 2, 3]
    assert done[0].record is done[1].record is done[2].record
    assert after == [(3, False, [])]  # the files of the city models come later
    del shapes[gone], shapes[other]
    shapes[moved] = shape.buffer(-0.4)
    final = write(tmp_path / "final.gpkg", *shapes.values(), ids=list(shapes))
    given = json.loads((folder / "run.json").read_text())["parameters"]
    run(make_config(given | {"footprints": str(final), "out": str(tmp_path / "whole")}))
    assert mesh_of(folder) == mesh_of(tmp_path / "whole")


@pytest.mark.long
def test_workers_of_the_service_make_the_same_bytes(small_run: Path, tmp_path: Path) -> None:
    (house, shape), *_ = read_input(small_run).items()
    body = {"action": "replace", "building": house, "footprint": footprint(shape.buffer(-0.4))}
    cities = [shutil.copytree(small_run, tmp_path / name) for name in ("alone", "workers")]
    for city, workers in zip(cities, (0, 2), strict=True):
        with serve_city(city, "127.0.0.1:0", workers=workers) as url:
            assert ask(url, "/edits", body)[0] == 201
        # The server has ended, and has written the city models before.
        assert not [*Audit(city)]
    assert mesh_of(cities[0]) == mesh_of(cities[1])
    assert read_all(cities[0] / FOLDER / TILES) == read_all(cities[1] / FOLDER / TILES)
