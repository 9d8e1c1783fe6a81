"""`citystitch generalise` on a town of six blocks: levels by hand, any order, workers and tiles."""

import dataclasses
import json
import re
import shutil
import sqlite3
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyogrio
import pytest
import shapely

import tiler
from pipeline.data.errors import CityError
from tests.conftest import SHARED
from tests.helpers.iso19107 import check_solids
from tests.tiler.cityinput.models import house_json, write_json
from tiler.cli.main import main
from tiler.cli.parser import GENERALISE_NUMBERS
from tiler.config.zones import LOD
from tiler.convert.inputs import open_source
from tiler.generalisation import HEIGHTS
from tiler.generalisation.options import Asked
from tiler.generalisation.prove import check_generalisation

PLACE = np.array([100_000.0, 450_000.0])  # in the Netherlands, EPSG:28992: a corner of tiles
LEVELS = ("lod1", "lod0c", "lod0b", "lod0a")
COLUMNS = ["id", "level", "height", "parent", "cell", "members", "landmark", "area", "volume", "ground_height"]
STREETS = [((x, -20), (x, 120)) for x in (0, 60, 120, 180)] + [((-20, y), (200, y)) for y in (0, 50, 100)]
Layer = dict[str, dict[str, Any]]


def box(x: float, y: float, width: float, depth: float) -> shapely.Polygon:
    west, south = PLACE
    return shapely.box(west + x, south + y, west + x + width, south + y + depth)


def town() -> dict[str, tuple[shapely.Polygon, float]]:
    """Two houses of 20 by 20 m side by side, of 6 and 12 m, in each of five blocks; a shed and a tower."""
    houses = {}
    for i in range(3):
        for j in range(2):
            if (i, j) != (2, 1):
                houses[f"a{i}{j}"] = box(60 * i + 8, 50 * j + 15, 20, 20), 6.0
                houses[f"b{i}{j}"] = box(60 * i + 28, 50 * j + 15, 20, 20), 12.0
    return houses | {"shed": (box(140, 70, 10, 10), 3.0), "tower": (box(72, 5, 10, 8), 50.0)}


def write(
    path: Path, shapes: list[Any], *, crs: str | None = "EPSG:28992", layer: str = "", **columns: Any
) -> Path:
    values = [np.array(list(value), float if name == "height" else object) for name, value in columns.items()]
    wkb, kind = shapely.to_wkb(np.array(shapes)), shapes[0].geom_type
    place = {"layer": layer, "append": path.exists()} if layer else {}
    pyogrio.raw.write(path, wkb, values, list(columns), geometry_type=kind, crs=crs, **place)
    return path


def write_town(path: Path, houses: dict[str, tuple[shapely.Polygon, float]]) -> Path:
    outlines, heights = zip(*houses.values(), strict=True)
    return write(path, list(outlines), id=houses, height=heights)


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    """Houses, streets and a park of 10 by 10 m, as arguments."""
    write_town(tmp_path / "houses.gpkg", town())
    write(tmp_path / "roads.gpkg", [shapely.LineString(PLACE + line) for line in STREETS])
    write(tmp_path / "park.gpkg", [box(10, 75, 10, 10)])
    return [
        *("--footprints", str(tmp_path / "houses.gpkg"), "--roads", str(tmp_path / "roads.gpkg")),
        *("--others", str(tmp_path / "park.gpkg"), "--landmark-height", "40", "--landmarks", "gone"),
        *("--most-area", "5000", "--tile-size", "100"),
    ]


def make(output: Path, arguments: list[str], *more: str) -> Path:
    assert main(["generalise", *arguments, "-o", str(output), "--traceback", *more]) == 0
    return output


def read(path: Path, layer: str) -> Layer:
    """Rows of a layer by id."""
    meta, _, wkb, values = pyogrio.raw.read(path, layer=layer)
    rows = zip(shapely.from_wkb(wkb), *values, strict=True)
    found = [dict(zip(("geometry", *meta["fields"]), row, strict=True)) for row in rows]
    return {row["id"]: row for row in found}


def bytes_of(output: Path) -> list[bytes]:
    return [output.with_suffix(suffix).read_bytes() for suffix in (".gpkg", ".city.json", ".levels.json")]


def test_all_levels_of_a_town(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = make(tmp_path / "out.gpkg", files)
    lod1, lod0c, lod0b, lod0a = levels = [read(out, name) for name in LEVELS]
    cells = read(out, "cells")
    # Cells cover the hull of the layers, an octagon, without overlaps; its corners are fragments.
    assert len(cells) == 16
    assert sum(row["area"] for row in cells.values()) == 30_000
    assert shapely.union_all([row["geometry"] for row in cells.values()]).area == 30_000
    inner = [row for row in cells.values() if row["members"]]
    assert [row["area"] for row in inner] == [3000.0] * 6
    assert {row["landuse"] for row in cells.values() if not row["members"]} == {"Other"}
    of = {name: cells[row["cell"]] for name, row in lod1.items()}
    assert (of["a01"]["landuse"], of["shed"]["landuse"]) == ("Building", "Other")
    # A - A_other: 54 by 44 m within the streets, and what a park of 100 m2 leaves beside the houses on it.
    assert of["a00"]["share"] == pytest.approx(800 / (54 * 44))
    assert of["a01"]["other_area"] == pytest.approx(3000 - (54 * 44 - 100))
    assert of["a10"]["building_area"] == 880
    # Each level stands for all buildings, and each parent is an object one level up.
    for low, high in pairwise(levels):
        assert {row["parent"] for row in low.values()} == set(high)
        assert sum(row["members"] for row in high.values()) == len(lod1) == 12
    assert list(lod0a["tower"]) == ["geometry", *COLUMNS]
    for level in levels:
        tower = level["tower"]
        assert (tower["landmark"], tower["height"], tower["geometry"].area) == (1, 50.0, 80.0)
    pair = lod0c[lod1["a00"]["parent"]]
    assert (pair["members"], pair["height"], pair["area"], pair["volume"]) == (2, 9.0, 800.0, 7200.0)
    block = lod0b[pair["parent"]]
    assert (block["height"], block["area"], block["id"]) == (9.0, pytest.approx(54 * 44), of["a00"]["id"])
    assert lod0b[of["a10"]["id"]]["area"] == pytest.approx(54 * 44 - 80)  # without the tower
    assert lod0b[of["a01"]["id"]]["area"] == pytest.approx(54 * 44 - 100)  # without the park
    # The two cells of a column share the longer border; three would be more than twice 5,000 m2.
    column = lod0a[block["parent"]]
    assert (column["members"], column["area"]) == (4, pytest.approx(54 * 94 - 100))
    assert lod1["shed"]["parent"] == lod0c[lod1["shed"]["parent"]]["parent"] in lod0a
    assert {row["level"] for row in lod0a.values()} == {"0A"}
    told = json.loads(out.with_suffix(".levels.json").read_text())
    assert told["levels"]["lod0c"]["objects"] == 7
    assert "--landmarks: 1 of no building: gone" in told["notes"]
    assert told["levels"]["lod1"]["polygons"] == 72
    assert told["levels"]["lod0c"]["polygons_left"] == pytest.approx(42 / 72, abs=1e-6)
    assert told["levels"]["lod0c"]["volume_error"] == 0.0
    assert "LoD0B" in capsys.readouterr().out
    _check_city_json(out.with_suffix(".city.json"), levels)


def _check_city_json(path: Path, levels: list[Layer]) -> None:
    document = json.loads(path.read_text())
    schema = SHARED / "schemas/cityjson/2.0/cityjson.min.schema.json"
    if schema.is_file():
        jsonschema.Draft7Validator(json.loads(schema.read_text())).validate(document)
    found = check_solids(document, ("1.0", "1.2"))
    assert found
    assert set().union(*found.values()) == set()
    objects = document["CityObjects"]
    assert set(objects) == set().union(*levels)
    for name, thing in objects.items():
        assert all(name in objects[child]["parents"] for child in thing.get("children", ()))
        assert all(name in objects[parent]["children"] for parent in thing.get("parents", ()))
    tops = [name for name, thing in objects.items() if "parents" not in thing]
    assert set(tops) == set(levels[3])
    with open_source([path]) as source:  # what reads city models finds the buildings
        assert sorted(one.id for one in source.buildings()) == sorted(levels[0])


def test_bytes_do_not_depend_on_order_and_cells_not_on_tiles(files: list[str], tmp_path: Path) -> None:
    without = [*files[:2], *files[4:]]  # roads
    out, found = make(tmp_path / "out.gpkg", files), make(tmp_path / "axis.gpkg", without)
    write_town(tmp_path / "houses.gpkg", dict(reversed(town().items())))
    write(tmp_path / "roads.gpkg", [shapely.LineString(PLACE + line[::-1]) for line in STREETS[::-1]])
    assert bytes_of(out) == bytes_of(make(tmp_path / "again.gpkg", files))
    assert bytes_of(found) == bytes_of(make(tmp_path / "again.gpkg", without, "--overwrite"))
    _check_order_of_models(out.with_suffix(".city.json"), files[2:])
    whole = make(tmp_path / "whole.gpkg", files, "--tile-size", "1000")
    for layer in ("cells", *LEVELS):
        parts = [[row["geometry"] for row in read(path, layer).values()] for path in (out, whole)]
        shapes = [shapely.simplify(shapely.normalize(part), 1e-6) for part in parts]
        assert sorted(shapely.to_wkt(shapes[0])) == sorted(shapely.to_wkt(shapes[1]))


def _check_order_of_models(path: Path, arguments: list[str]) -> None:
    """The buildings of a result make it again, in any order."""
    document = json.loads(path.read_text())
    written = []
    for name, objects in (
        ("one", document["CityObjects"]),
        ("two", dict(reversed(document["CityObjects"].items()))),
    ):
        model = write_json(path.with_name(f"{name}.json"), document | {"CityObjects": objects})
        written.append(bytes_of(make(path.with_name(f"{name}.gpkg"), [str(model), *arguments])))
    assert written[0] == written[1]


def test_a_change_of_one_building_touches_its_cell_and_parents_alone(files: list[str], tmp_path: Path) -> None:
    before = make(tmp_path / "before.gpkg", files)
    write_town(tmp_path / "houses.gpkg", town() | {"a00": (box(8, 15, 20, 21), 7.0)})
    after = make(tmp_path / "after.gpkg", files)
    changed = set()
    for layer in ("cells", *LEVELS):
        one, other = read(before, layer), read(after, layer)
        assert set(one) == set(other)
        changed |= {(layer, name) for name in one if str(one[name]) != str(other[name])}
    chain = [("lod1", "a00")]
    for layer in LEVELS[1:]:
        chain.append((layer, read(before, chain[-1][0])[chain[-1][1]]["parent"]))
    assert changed == {*chain, ("cells", chain[2][1])}


def test_without_roads_streets_are_found(files: list[str], tmp_path: Path) -> None:
    """Blocks lie 20 and 30 m apart, the axis in the middle; one is in the next tile, and none near the side."""
    (tmp_path / "houses.gpkg").unlink()
    houses = {name: one for name, one in town().items() if name[0] in "ab"}
    write_town(tmp_path / "houses.gpkg", houses | {"far": (box(1290, 10, 10, 10), 3.0)})
    arguments = [*files[:2], *files[6:], "--fragment", "0", "--tile-size", "1000", "--yard-width", "4"]
    out = make(tmp_path / "out.gpkg", arguments)
    told = json.loads(out.with_suffix(".levels.json").read_text())["notes"]
    assert "no roads: streets are the medial axis of the open space between buildings" in told
    cells = read(out, "cells")
    assert len(cells) == 6
    cell = cells[read(out, "lod1")["a10"]["cell"]]["geometry"]
    np.testing.assert_allclose(np.array(cell.bounds)[[0, 2, 3]] - PLACE[[0, 0, 1]], [58, 118, 50], atol=0.6)
    blocks = [row["area"] for row in read(out, "lod0b").values() if row["members"] == 2]
    assert blocks == [800.0] * 5  # no yard is so narrow: what is built


def test_city_models_and_volumes_of_blocks(tmp_path: Path) -> None:
    """The house with a gabled roof, from 6 to 9 m over a ground of 2 m, in a cell with a pond and beside rails."""
    model = write_json(tmp_path / "house.city.json", house_json())
    write(tmp_path / "roads.gpkg", [shapely.LineString(PLACE + line) for line in STREETS])
    arguments = [str(model), "--roads", str(tmp_path / "roads.gpkg"), "--least-share", "0.02", "--fragment", "0"]
    arguments += ["--water", str(write(tmp_path / "pond.gpkg", [box(20, 20, 10, 10)]))]
    rails = shapely.LineString(PLACE + np.array([(50, -20), (50, 120)]))
    arguments += ["--railways", str(write(tmp_path / "rails.gpkg", [rails]))]
    out = make(tmp_path / "out.gpkg", arguments, "--block-height", "volume", "--street-width", "0")
    (house,), (block,) = (list(read(out, layer).values()) for layer in ("lod1", "lod0b"))
    assert (house["height"], house["ground_height"]) == (pytest.approx(5.5), 2.0)
    assert block["volume"] == pytest.approx(house["volume"]) == pytest.approx(440.0)
    assert (
        block["area"] == 50 * 50 - 100
    )  # the cell ends at the rails; the pond is a cell of its own, all of it other
    ponds = [row for row in read(out, "cells").values() if row["area"] == 100]
    assert [row["other_area"] for row in ponds] == [100.0]


@pytest.mark.filterwarnings("ignore:.crs. was not provided")
def test_copies_layers_and_files_without_a_crs(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = make(tmp_path / "out.gpkg", files)
    write_town(tmp_path / "houses.gpkg", {"z": (town()["a00"][0].reverse(), 2.0)} | town())
    streets = [shapely.LineString(PLACE + line) for line in STREETS]
    for layer, shapes in (("roads", streets), ("rails", streets[:1])):
        write(tmp_path / "net.gpkg", shapes, layer=layer)
    park = write(tmp_path / "bare.gpkg", [box(10, 75, 10, 10)], crs=None)
    more = ("--roads", f"{tmp_path}/net.gpkg:roads", "--others", str(park))
    again = make(tmp_path / "again.gpkg", files, *more)
    assert bytes_of(out)[:2] == bytes_of(again)[:2]  # a copy counts once
    given: dict[str, Any] = {
        "footprints": tmp_path / "houses.gpkg",
        "roads": tmp_path / "roads.gpkg",
        "others": str(park),
    }
    given |= {"landmark_height": 40.0, "landmarks": "gone", "most_area": 5000.0, "tile_size": 100.0}
    lines = tiler.generalise_models((), tmp_path / "api.gpkg", **given)
    assert bytes_of(again) == bytes_of(tmp_path / "api.gpkg")
    assert lines[1].startswith("LoD1")
    with pytest.raises(TypeError, match="'landmark_hight'; did you mean landmark_height"):
        tiler.generalise_models((), tmp_path / "no.gpkg", landmark_hight=40.0)
    told = json.loads(again.with_suffix(".levels.json").read_text())
    assert told["counts"]["buildings with the outline of another one, left out"] == 1
    assert "bare.gpkg: states no CRS, taken as EPSG:28992" in told["notes"]
    (tmp_path / "bare.geojson").write_text(
        '{"type": "Feature", "properties": {}, "geometry": ' + shapely.to_geojson(box(10, 75, 10, 10)) + "}"
    )
    model = house_json()
    for thing in model["CityObjects"].values():
        thing["attributes"] = {LOD: "0B"}
    blocks = write_json(tmp_path / "blocks.city.json", model)
    for words, message in (
        (
            (*files, "--roads", str(tmp_path / "net.gpkg")),
            "has 2 layers; name one of them: roads, rails; write --roa",
        ),
        ((*files, "--roads", f"{tmp_path}/net.gpkg:x"), "has no layer 'x'"),
        ((*files, "--others", str(tmp_path / "bare.geojson")), "GeoJSON without a CRS means degrees"),
        ((str(blocks),), "has blocks of level 0B among its buildings"),
    ):
        assert main(["generalise", *words, "-o", str(tmp_path / "no.gpkg")]) in (1, 2)
        assert message in capsys.readouterr().err


@pytest.mark.long
def test_workers_write_the_same_bytes(files: list[str], tmp_path: Path) -> None:
    alone = make(tmp_path / "alone.gpkg", files)
    assert bytes_of(alone) == bytes_of(make(tmp_path / "two.gpkg", files, "--workers", "2"))


def test_check_finds_a_change_of_any_field(files: list[str], tmp_path: Path) -> None:
    out = make(tmp_path / "out.gpkg", files)
    assert main(["check", str(out)]) == 0
    unseen = []
    with closing(sqlite3.connect(out, isolation_level=None)) as base:
        for (trigger,) in base.execute("select name from sqlite_master where type = 'trigger'").fetchall():
            base.execute(f'drop trigger "{trigger}"')
        for layer in ("cells", *LEVELS):
            columns = [row[1] for row in base.execute(f"pragma table_info({layer})")][1:]
            row = base.execute(
                f"select rowid, {', '.join(columns)} from {layer} order by members desc, id limit 1"
            ).fetchone()
            for name, value in zip(columns, row[1:], strict=True):
                if value is None:  # of the ground, which is not known here
                    continue
                other = change(value)
                base.execute(f"update {layer} set {name} = ? where rowid = ?", (other, row[0]))
                unseen += [(layer, name)] if check_generalisation(out).ok else []
                base.execute(f"update {layer} set {name} = ? where rowid = ?", (value, row[0]))
        rowid, blob = base.execute("select rowid, geom from lod0b limit 1").fetchone()
        for damaged in (blob[:60], blob[:3] + b"\x0f" + blob[4:], b"GP", "no geometry", None):
            base.execute("update lod0b set geom = ? where rowid = ?", (damaged, rowid))
            with pytest.raises(CityError, match="no result of citystitch generalise"):
                check_generalisation(out)
        base.execute("update lod0b set geom = ? where rowid = ?", (blob, rowid))
    for path, texts in (
        (out.with_suffix(".levels.json"), [r'"volume_error": ', r'"cells": ', r'"polygons": ']),
        (out.with_suffix(".city.json"), [r'"height":', r'"level":"', r'"children":\["', r'"vertices":\[\n\[']),
    ):
        text = path.read_text()
        for each in texts:
            path.write_text(re.sub(f"({each})", r"\g<1>9", text, count=1))
            unseen += [(path.name, each)] if check_generalisation(out).ok else []
        path.write_text(text)
    assert unseen == []
    assert check_generalisation(out).ok
    out.with_suffix(".levels.json").unlink()
    with pytest.raises(CityError, match="no result of citystitch generalise"):
        check_generalisation(out)


def change(value: Any) -> Any:
    """Give another text, number, or a geometry that is moved by a metre."""
    if isinstance(value, bytes):
        start = 8 + (0, 32, 48, 48, 64)[value[3] >> 1 & 7]
        return value[:start] + shapely.to_wkb(
            shapely.transform(shapely.from_wkb(value[start:]), lambda xy: xy + 15)
        )
    return value + "x" if isinstance(value, str) else value + 1


def test_a_plan_counts_buildings_and_writes_nothing(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(tmp_path.iterdir())
    assert main(["generalise", *files, "--plan", "--tile-size", "100"]) == 0
    told = capsys.readouterr().out
    assert "12 buildings in " in told
    assert "memory: some 260 MB a process, and 0.0 MB more in the first" in told
    assert sorted(tmp_path.iterdir()) == before
    assert main(["generalise", *files]) == 2
    assert "give -o FILE.gpkg, or --plan" in capsys.readouterr().err


def test_what_cannot_be_done_is_one_clear_error(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(tmp_path / "roads.gpkg", tmp_path / "there.gpkg")
    cases = [
        ((), "there.gpkg: exists"),
        (("-o", "a.shp"), "a GeoPackage ends with .gpkg"),
        (("-o", "nowhere/a.gpkg"), "nowhere: no such folder"),
        (("--roads", "none.gpkg"), "none.gpkg: no such file"),
        (("--least-share", "2"), "--least-share 2: expected 0 to 1"),
        (("model.json",), "give city models or the folder of a run, or --footprints"),
        (("--bounds", "0", "0", "1", "1"), "no building in the region"),
        (("--landmark-tag", "listed"), "has no attribute 'listed'"),
        (("--crs", "EPSG:4326"), "is in degrees"),
        (("--crs", "EPSG:3857"), "stretches lengths"),
        (("--landmarks", "none.txt"), "none.txt: no such file"),
        (("-o", str(tmp_path / "roads.gpkg"), "--overwrite"), "roads.gpkg: is one of the inputs"),
    ]
    for more, message in cases:
        output = "out.gpkg" if more else "there.gpkg"
        models = more if more == ("model.json",) else ()
        code = main(["generalise", *models, *files, "-o", str(tmp_path / output), *more[len(models) :]])
        told = capsys.readouterr().err
        assert (code in (1, 2), message in told, told.count("\n")) == (True, True, 1), told
    assert not (tmp_path / "out.gpkg").exists()


def test_the_parser_has_the_defaults_of_the_options() -> None:
    defaults = {field.name: field.default for field in dataclasses.fields(Asked) if field.name != "landmarks"}
    assert {name: value for name, value, *_ in GENERALISE_NUMBERS} | {"block_height": HEIGHTS[0]} == defaults
    assert issubclass(CityError, Exception)
