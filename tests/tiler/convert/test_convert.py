"""`citystitch convert`: every format read again by our reader, and by schemas, ISO 19107 and other programs."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyogrio
import pytest
import pyvista
from lxml import etree

import tiler
from pipeline.data.errors import CityError, ConfigError, InputError
from tests.conftest import SHARED
from tests.helpers.iso19107 import check_solids
from tests.helpers.patch_readers import read_document
from tests.tiler.cityinput.models import (
    CORNERS,
    PLACE,
    box_solid,
    city_json,
    house_gml,
    solid,
    write_gml,
    write_json,
    write_sequence,
)
from tiler.cityinput.face_planes import signed_volume
from tiler.cityinput.faces import ModelBuilding
from tiler.cityinput.sources import read_model_header, scan_model
from tiler.cli.main import main
from tiler.convert import NAMES
from tiler.convert.convert import TARGETS, Asked, convert_models
from tiler.convert.features import iter_features
from tiler.convert.inputs import open_source

SCHEMAS = SHARED / "schemas"
MODELS = SHARED / "city_models"
LEVELS = ("cityjson", "cityjsonseq", "citygml2", "citygml3", "gpkg")
VOLUME = 10 * 8 * 5.5  # m3 of the house
ATTRIBUTES = {"measuredHeight": 7.0, "name": "a <b> & ü", "year": 1980, "share": 0.25, "tags": ["x", 1]}


def model(name: str = "house", part: str = "part") -> dict[str, Any]:
    """A building with an outline, and a part with three levels."""
    low, low_corners = box_solid(7.5, "1.2", len(CORNERS))
    high, high_corners = box_solid(8.0, "1.3", len(CORNERS) + 8)
    outline = {"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2, 3]]]}
    objects = {
        name: {"type": "Building", "attributes": ATTRIBUTES, "geometry": [outline], "children": [part]},
        part: {
            "type": "BuildingPart",
            "attributes": {"own": "p"},
            "geometry": [low, high, solid()],
            "parents": [name],
        },
    }
    return city_json(objects, [*CORNERS, *low_corners, *high_corners])


def convert(path: Path, name: str, folder: Path, **asked: Any) -> Path:
    output = folder / f"{name}{TARGETS[name].suffixes[0]}"
    convert_models([path], output, Asked(name, **asked))
    return output


def buildings_of(path: Path) -> list[ModelBuilding]:
    return [each for each in scan_model(path, attributes=True) if isinstance(each, ModelBuilding)]


def shapes_of(path: Path) -> dict[tuple[str, float], tuple[bool, int, list[list[float]]]]:
    """Whether each geometry is a solid, how many faces it has, and its vertices in their order."""
    return {
        (shape.owner, shape.lod): (shape.closed, len(shape.faces), np.round(shape.faces.xyz, 3).tolist())
        for one in buildings_of(path)
        for shape in one.shapes
    }


def validate_gml(path: Path, version: str) -> list[str]:
    """What the OGC schemas say against a file, by xmllint or else by lxml: both are libxml2."""
    schema = SCHEMAS / f"citygml-{version}-all.xsd"
    if not schema.is_file():
        pytest.skip(f"{schema}: not there")
    if program := shutil.which("xmllint"):
        done = subprocess.run(
            [program, "--nonet", "--noout", "--huge", "--schema", schema, path],
            check=False,
            capture_output=True,
            text=True,
        )
        return [] if done.returncode == 0 else done.stderr.splitlines()
    parser = etree.XMLParser(no_network=True, huge_tree=True)
    rules = etree.XMLSchema(etree.parse(str(schema), parser))
    return [] if rules.validate(etree.parse(str(path), parser)) else [str(line) for line in rules.error_log]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_sequence(tmp_path / "in.jsonl", [model(), model("h2", "p2")])


def test_the_command_knows_all_formats(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tuple(TARGETS) == NAMES
    path = tmp_path / "a.gml"
    assert main(["convert", str(source), "--format", "citygml2", "-o", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["2 geometries of level 1.2 beside 1.3: CityGML has one a whole level", str(path)]


@pytest.mark.parametrize("name", ["cityjson", "cityjsonseq"])
def test_cityjson_keeps_everything(source: Path, tmp_path: Path, name: str) -> None:
    path = convert(source, name, tmp_path)
    assert shapes_of(path) == shapes_of(source)
    assert [one.attributes for one in buildings_of(path)] == [
        {"house": ATTRIBUTES, "part": {"own": "p"}},
        {"h2": ATTRIBUTES, "p2": {"own": "p"}},
    ]
    kinds = [shape.faces.kind.tolist() for one in buildings_of(path) for shape in one.shapes]
    assert kinds == [shape.faces.kind.tolist() for one in buildings_of(source) for shape in one.shapes]
    assert str(read_model_header(path).crs) == "EPSG:28992"


@pytest.mark.parametrize("name", ["citygml2", "citygml3"])
def test_citygml_keeps_whole_levels_ids_and_attributes(source: Path, tmp_path: Path, name: str) -> None:
    path = convert(source, name, tmp_path)
    given = shapes_of(source)
    expected = {("house", 0.0): given["house", 0.0], ("part", 1.0): given["part", 1.3]}
    expected |= {("part", 2.0): given["part", 2.2]}
    found = shapes_of(path)
    assert {key: value for key, value in found.items() if key[0] in ("house", "part")} == expected
    assert len(found) == 6
    house = buildings_of(path)[0]
    assert house.attributes == {"house": ATTRIBUTES | {"tags": '["x", 1]'}, "part": {"own": "p"}}
    kinds = {shape.lod: shape.faces.kind.tolist() for shape in house.shapes}
    assert kinds[2.0] == buildings_of(source)[0].shapes[3].faces.kind.tolist()


def test_a_geopackage_has_a_layer_a_level(source: Path, tmp_path: Path) -> None:
    path = convert(source, "gpkg", tmp_path)
    layers = {name for name, _ in pyogrio.list_layers(path)}
    assert layers == {"pand", "lod12_3d", "lod13_3d", "lod22_3d"}
    table = pyogrio.raw.read(path, layer="lod22_3d")
    assert dict(zip(table[0]["fields"].tolist(), [column[1] for column in table[3]], strict=True)) == {
        "identificatie": "h2", "part": "p2", "measuredHeight": 7.0, "name": "a <b> & ü", "year": 1980,
        "share": 0.25, "tags": '["x", 1]', "own": "p",
    }  # fmt: skip
    given = shapes_of(source)
    for lod in (1.2, 1.3, 2.2):
        assert shapes_of(path)["part", lod] == given["part", lod]
    assert pyogrio.read_info(path, layer="pand")["crs"] == "EPSG:28992"


@pytest.mark.parametrize(("name", "version"), [("citygml2", "2.0"), ("citygml3", "3.0")])
def test_citygml_obeys_the_schemas(source: Path, tmp_path: Path, name: str, version: str) -> None:
    document = model("0 ü", "_g1")
    document["CityObjects"]["_g1"]["geometry"][2]["semantics"]["values"][0][1] = None
    document["CityObjects"]["0 ü"]["attributes"] |= {"none": None, "flag": True, "control \x01": "a\x02b"}
    surfaces = {"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 2, 3]]]}
    document["CityObjects"]["more"] = {"type": "Building", "geometry": [surfaces, surfaces | {"lod": "3"}]}
    odd = write_json(tmp_path / "odd.json", document)
    output = tmp_path / "a.gml"
    lines = convert_models([source, odd], output, Asked(name))
    assert validate_gml(output, version) == []
    assert "2 ids that XML does not take, kept as gml:name" in lines
    assert len(shapes_of(output)) == 6 + 3 + 2
    odd_one = buildings_of(output)[2].shapes
    # The face without a kind stands in the solid, the others in boundary surfaces that it links to.
    assert {(shape.lod, shape.closed, len(shape.faces)) for shape in odd_one} == {
        (0.0, False, 1), (1.0, True, 6), (2.0, True, 1), (2.0, False, 6),
    }  # fmt: skip
    text = output.read_text()
    output.write_text(text.replace("gml:posList>", "gml:posLists>"))
    assert validate_gml(output, version) != []


@pytest.mark.skipif(not MODELS.is_dir(), reason="shared data are not there")
@pytest.mark.parametrize(
    "name",
    [
        "3dbag/tile_901_trimmed.jsonl", "citygml4j/lod2_buildings_v3.gml", "berlin/Block020023.gml",
        "vienna/Fichtegasse.gml", "zurich/zurich-lod2-citygml1.xml", "plateau/53392547_bldg_6697_op2.gml",
        "cjio/multi_lod.json",
    ],
)  # fmt: skip
def test_real_models_obey_the_schemas_and_keep_buildings_and_faces(name: str, tmp_path: Path) -> None:
    given = MODELS / name
    faces = {
        level: sum(len(shape.faces) for one in buildings_of(given) for shape in one.shapes if shape.lod == level)
        for level in (0.0, 1.0, 1.2, 1.3, 2.0, 2.2)
    }
    n = len(buildings_of(given))
    for target in LEVELS:
        path = convert(given, target, tmp_path)
        whole = target.startswith("citygml")
        found = [(shape.lod, len(shape.faces)) for one in buildings_of(path) for shape in one.shapes]
        assert len(buildings_of(path)) == n
        for level, count in faces.items():
            wanted = 0 if whole and level == 1.2 else count
            assert sum(k for lod, k in found if lod == (int(level) if whole else level)) >= wanted
    for version in ("2.0", "3.0"):
        assert validate_gml(tmp_path / f"citygml{version[0]}.gml", version) == []
    document = json.loads((tmp_path / "cityjson.json").read_text())
    schema = json.loads((SCHEMAS / "cityjson/2.0/cityjson.min.schema.json").read_text())
    some = dict(list(document["CityObjects"].items())[:20])
    jsonschema.Draft7Validator(schema).validate(document | {"CityObjects": some})
    features = json.loads((SCHEMAS / "cityjson/2.0/cityjsonfeature.min.schema.json").read_text())
    for line in (tmp_path / "cityjsonseq.jsonl").read_text().splitlines()[1:10]:
        jsonschema.Draft7Validator(features).validate(json.loads(line))


@pytest.mark.long
def test_a_run_is_converted_and_its_solids_stay_valid_through_every_format(
    sloped_run: Path, tmp_path: Path
) -> None:
    own = json.loads((sloped_run / "citymodel.city.json").read_text())
    assert own["transform"]["scale"] == [0.001] * 3
    given = check_solids(own)
    assert given
    assert set().union(*given.values()) == set()
    for target in ("cityjson", "citygml2", "citygml3", "gpkg"):
        path = convert(sloped_run, target, tmp_path)
        back = path
        if target != "cityjson":
            (tmp_path / target).mkdir()
            back = convert(path, "cityjson", tmp_path / target)
        document = json.loads(back.read_text())
        # Whole levels of CityGML are told to the checker as what they were.
        for thing in document["CityObjects"].values():
            for item in thing["geometry"]:
                item["lod"] = {"1": "1.3", "2": "2.2"}.get(item["lod"], item["lod"])
        found = check_solids(document)
        assert set().union(*found.values()) == set(), target
        levels = [lod for _, lod in found]
        for lod in ("2.2", "1.3") if target.startswith("citygml") else ("2.2", "1.3", "1.2"):
            assert levels.count(lod) == [lod for _, lod in given].count(lod)
        assert {name for name, _ in found} == {name for name, _ in given}
    attributes = {name: one["attributes"] for name, one in own["CityObjects"].items() if "attributes" in one}
    for one in buildings_of(tmp_path / "cityjson.json"):
        for name, kept in one.attributes.items():
            assert kept == attributes.get(name, {})


def test_obj_holds_closed_surfaces_of_one_level(source: Path, tmp_path: Path) -> None:
    for lod, volume in (("auto", VOLUME), ("1.2", 80 * 5.5), ("1.3", 80 * 6.0)):
        path = convert(source, "obj", tmp_path, lod=lod, overwrite=True)
        surface = pyvista.read(path)
        assert surface.n_open_edges == 0
        assert surface.clean().volume == pytest.approx(2 * volume, rel=1e-6) or lod == "auto"
        bounds = np.array(surface.bounds)
        assert bounds[:4] == pytest.approx([PLACE[0], PLACE[0] + 10, PLACE[1], PLACE[1] + 8], abs=0.01)
    lines = convert(source, "obj", tmp_path, overwrite=True).read_text().splitlines()
    assert [line for line in lines if line[0] in "og"] == [
        line for name in ("house", "h2") for line in (f"o {name}", "g ground", "g roof", "g wall")
    ]
    places = np.array([line.split()[1:] for line in lines if line[0] == "v"], np.float64)
    corners = np.array([line.split()[1:] for line in lines if line[0] == "f"], np.int64) - 1
    apart = places[corners] - places[0]
    assert np.linalg.det(apart).sum() / 6 == pytest.approx(2 * VOLUME)  # all look outwards


def test_glb_has_a_node_a_building_with_its_attributes(source: Path, tmp_path: Path) -> None:
    document, take = read_document(convert(source, "glb", tmp_path))
    assert [(node["name"], node["extras"]["year"], node["extras"]["own"]) for node in document["nodes"]] == [
        ("house", 1980, "p"), ("h2", 1980, "p"),
    ]  # fmt: skip
    assert document["scenes"] == [{"nodes": [0, 1]}]
    origin = document["asset"]["extras"]["origin"]
    for node, mesh in zip(document["nodes"], document["meshes"], strict=True):
        volume = 0.0
        for part in mesh["primitives"]:
            accessor = document["accessors"][part["attributes"]["POSITION"]]
            xyz = take(part["attributes"]["POSITION"]).reshape(-1, 3)
            assert (xyz.min(axis=0).tolist(), xyz.max(axis=0).tolist()) == (accessor["min"], accessor["max"])
            volume += np.linalg.det(xyz[take(part["indices"]).reshape(-1, 3)].astype(np.float64)).sum() / 6
        assert volume == pytest.approx(VOLUME)
        east, up, south = node["translation"]
        assert (origin[0] + east, origin[1] - south, origin[2] + up) == (PLACE[0], PLACE[1], 2.0)


def test_axes_are_those_of_the_register_in_citygml_and_easting_first_elsewhere(tmp_path: Path) -> None:
    path = write_gml(tmp_path / "vienna.gml", house_gml(), crs="EPSG:31256")
    text = path.read_text().replace("100000", "1000").replace("450000", "340000").replace("100010", "1010")
    path.write_text(text.replace("450008", "340008").replace("450004", "340004"))
    found = convert(path, "citygml2", tmp_path)
    assert 'srsName="urn:ogc:def:crs:EPSG::31256"' in found.read_text()
    assert "<gml:lowerCorner>340000.000 1000.000 2.000</gml:lowerCorner>" in found.read_text()
    header = read_model_header(found)
    assert header.swapped
    assert header.bounds == (1000.0, 340000.0, 1010.0, 340008.0, 2.0, 9.0)
    back = tmp_path / "back"
    back.mkdir()
    (one,) = buildings_of(convert(found, "cityjsonseq", back))
    (first,) = buildings_of(path)
    assert np.array_equal(np.round(one.shapes[0].faces.xyz, 3), first.shapes[0].faces.xyz)


def test_models_are_reprojected_in_plan(source: Path, tmp_path: Path) -> None:
    degrees = convert(source, "cityjson", tmp_path, crs="EPSG:4326")
    transform = json.loads(degrees.read_text())["transform"]
    assert transform["scale"] == [1e-9, 1e-9, 0.001]
    with pytest.raises(ConfigError, match="is in degrees, and format obj in metres"):
        convert(degrees, "obj", tmp_path)
    again = tmp_path / "again"
    again.mkdir()
    back = buildings_of(convert(degrees, "cityjson", again, crs="EPSG:28992"))
    for one, other in zip(back, buildings_of(source), strict=True):
        for shape, own in zip(one.shapes, other.shapes, strict=True):
            assert np.abs(shape.faces.xyz - own.faces.xyz).max() < 0.002


def test_the_same_id_twice_is_two_buildings(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a.json", model())
    output = tmp_path / "both.json"
    (line,) = convert_models([path, path], output, Asked("cityjson"))
    assert line == "2 ids that were there before, or missing, with a number behind them"
    assert [one.id for one in buildings_of(output)] == ["house", "house_2"]
    assert set(json.loads(output.read_text())["CityObjects"]) == {"house", "part", "house_2", "part_2"}


def test_faces_that_collapse_on_the_grid_are_counted_and_holes_stay(tmp_path: Path) -> None:
    corners = [[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [2, 2, 0], [2, 4, 0], [4, 4, 0], [4, 2, 0]]
    faces = [[[0, 1, 2, 3], [4, 5, 6, 7]], [[0, 1, 1, 0]]]
    geometry = {"type": "MultiSurface", "lod": "2", "boundaries": faces}
    path = write_json(tmp_path / "a.json", city_json({"a": {"type": "Building", "geometry": [geometry]}}, corners))
    output = tmp_path / "a.obj"
    convert_models([path], output, Asked("obj"))
    assert pyvista.read(output).area == pytest.approx(96.0)
    output = tmp_path / "b.json"
    assert convert_models([path], output, Asked("cityjson")) == ["1 faces without area"]
    (one,) = buildings_of(output)
    assert np.diff(one.shapes[0].faces.face_start).tolist() == [2]


def test_orientation_of_surfaces_is_kept(tmp_path: Path) -> None:
    text = write_gml(tmp_path / "a.gml", house_gml()).read_text()
    turned = text.replace("<gml:Polygon>", "<gml:OrientableSurface orientation='-'><gml:baseSurface><gml:Polygon>")
    turned = turned.replace("</gml:Polygon>", "</gml:Polygon></gml:baseSurface></gml:OrientableSurface>")
    (tmp_path / "b.gml").write_text(turned)
    volumes = [
        signed_volume(shape.faces)
        for name in ("a.gml", "b.gml")
        for one in buildings_of(tmp_path / name)
        for shape in one.shapes
    ]
    assert volumes == pytest.approx([VOLUME, -VOLUME])


def test_one_building_is_held_at_a_time(source: Path) -> None:
    with open_source([source]) as opened:
        features = iter_features(opened)
        assert [one.id for one in next(features).objects] == ["house", "part"]
        assert opened.told["faces without area"] == 0
        assert [one.id for one in next(features).objects] == ["h2", "p2"]


def test_tiles_have_each_building_once_and_whole(tmp_path: Path) -> None:
    far = model("far", "q")
    far["vertices"] = [[x + 95_000, y - 40_000, z] for x, y, z in far["vertices"]]
    bare = city_json({"bare": {"type": "Building"}}, [])
    path = write_sequence(tmp_path / "in.jsonl", [model(), far, model("h2", "p2"), bare])
    for name in LEVELS:
        out = tmp_path / name
        told = tiler.convert_models(path, out, name, tile_size=50)
        assert {"2 files, a tile each", "1 buildings without surfaces, which are in no tile"} <= set(told)
        names = ["2000_9000", "2002_8999"]  # a corner is at 100 000, 450 000
        assert [one.stem for one in sorted(out.iterdir())] == names
        tiles = [shapes_of(one) for one in sorted(out.iterdir())]
        assert {owner for owner, _ in tiles[1]} == {"far", "q"}
        assert tiles[0] | tiles[1] == shapes_of(convert(path, name, tmp_path))
        first = read_model_header(sorted(out.iterdir())[0])
        assert str(first.crs) == "EPSG:28992"
        assert first.bounds[2] <= 100_010
    tiler.convert_models(path, out, name, tile_size=50, overwrite=True)
    (out / "mine.txt").touch()
    with pytest.raises(CityError, match="is no folder of tiles"):
        tiler.convert_models(path, out, name, tile_size=50, overwrite=True)


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ({"name": "dxf", "output": "a.dxf"}, "format 'dxf': must be one of cityjson, "),
        ({"name": "cityjson", "output": "tiles", "tile_size": 2.0}, "tile size 2 m: at least 10 m"),
        ({"name": "cityjson", "output": "a.gml"}, "ends with .json"),
        ({"name": "cityjson", "output": "a.json", "lod": "1.2"}, "all levels side by side"),
        ({"name": "cityjsonseq", "output": "in.jsonl"}, "is one of the inputs"),
        ({"name": "citygml2", "output": "old.gml"}, "exists"),
        ({"name": "cityjson", "output": "a.json", "input": "nowhere"}, "cannot be read"),
        ({"name": "cityjson", "output": "a.json", "input": "."}, "holds no citymodel.city.json"),
        ({"name": "cityjson", "output": "a.json", "input": "cloud.las"}, "is no city model"),
        ({"name": "cityjson", "output": "a.json", "input": "empty.jsonl"}, "no building with a surface"),
        ({"name": "cityjson", "output": "a.json", "input": "plain.jsonl", "crs": "EPSG:28992"}, "has no CRS that"),
    ],
)
def test_what_cannot_be_converted_is_refused(
    source: Path, tmp_path: Path, words: dict[str, Any], match: str
) -> None:
    (tmp_path / "old.gml").touch()
    (tmp_path / "cloud.las").write_bytes(b"LASF")
    write_sequence(tmp_path / "empty.jsonl", [city_json({"a": {"type": "Building"}}, [])])
    write_sequence(tmp_path / "plain.jsonl", [city_json(model()["CityObjects"], CORNERS * 3, crs="")])
    asked: dict[str, Any] = {key: value for key, value in words.items() if key not in ("output", "input")}
    before = sorted(tmp_path.iterdir())
    with pytest.raises(CityError, match=match):
        convert_models([tmp_path / words.get("input", "in.jsonl")], tmp_path / words["output"], Asked(**asked))
    assert sorted(tmp_path.iterdir()) == before


def test_files_of_two_crss_are_refused(source: Path, tmp_path: Path) -> None:
    other = write_json(tmp_path / "b.json", city_json(model()["CityObjects"], CORNERS * 3, crs="EPSG:25832"))
    with pytest.raises(InputError, match="convert them one by one"):
        convert_models([source, other], tmp_path / "c.json", Asked("cityjson"))
