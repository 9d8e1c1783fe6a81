"""Towns as files: the same bytes, valid solids, parameters that are read back, and points that fit the houses."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import laspy
import numpy as np
import pyogrio
import pyproj
import pytest
import shapely

from pipeline.architecture.heights import house_heights
from pipeline.architecture.levels import LEVELS, Footprint
from pipeline.architecture.parameters import House
from pipeline.architecture.rules import PRESETS
from pipeline.data.errors import ConfigError, InputError
from tests.helpers.iso19107 import check_solids
from tiler.cityinput.cityjson import read_buildings, read_objects
from tiler.cli.main import main
from tiler.towns.parameter_files import XML_END, XML_HEAD, house_json, house_xml, read_json, read_xml
from tiler.towns.rule_files import read_rules, rule_schema
from tiler.towns.styles import STYLES
from tiler.towns.town import make_output, open_town, write_town
from tiler.towns.town_models import house_feature, model_head
from tiler.towns.town_tile import ModelOptions, house_outline


def houses_of(style: str, size: float) -> list[House]:
    town = open_town(size, style, rules=None, seed=4, relief=10)
    return list(town.houses(town.bounds))


def write_json(houses: Sequence[House], path: Path) -> None:
    path.write_text("".join(map(house_json, houses)))


def write_xml(houses: Sequence[House], path: Path) -> None:
    path.write_text(XML_HEAD + "".join(map(house_xml, houses)) + XML_END)


def write_models(houses: Sequence[House], path: Path, levels: Sequence[str], walls: Footprint = "walls") -> None:
    lines = (house_feature(house, levels=levels, footprint=walls) for house in houses)
    path.write_text(model_head(pyproj.CRS(3006)) + "".join(lines))


def read_document(path: Path) -> dict[str, Any]:
    """CityJSONSeq as one document."""
    head: dict[str, Any]
    head, *features = (json.loads(line) for line in path.read_text().splitlines())
    for feature in features:
        first = len(head["vertices"])
        head["vertices"] += feature["vertices"]
        for name, thing in feature["CityObjects"].items():
            for one in thing.get("geometry", []):
                one["boundaries"] = _shift(one["boundaries"], first)
            head["CityObjects"][name] = thing
    return head


def _shift(numbers: Any, by: int) -> Any:
    return numbers + by if isinstance(numbers, int) else [_shift(one, by) for one in numbers]


@pytest.mark.parametrize(("style", "size"), [("detached", 70.0), ("terraces", 45.0), ("grid", 45.0)])
@pytest.mark.parametrize("walls", ["walls", "eaves"])
def test_all_solids_are_valid(tmp_path: Path, style: str, size: float, walls: Any) -> None:
    houses = houses_of(style, size)[: 2 if walls == "walls" else 1]
    path = tmp_path / "town.city.jsonl"
    assert houses
    write_models(houses, path, LEVELS, walls)
    document = read_document(path)
    found = check_solids(document, LEVELS)
    assert len(found) >= 12 * len(houses)
    assert {key: faults for key, faults in found.items() if faults} == {}
    # The check is one that fails: a vertex is moved.
    document["vertices"][0][0] += 400
    assert any(check_solids(document, LEVELS).values())


def test_the_model_is_read_as_the_houses_are(tmp_path: Path) -> None:
    houses = houses_of("detached", 80.0)
    path = tmp_path / "town.city.jsonl"
    write_models(houses, path, ("1.2", "2.2"))
    _, objects = read_objects(path)
    buildings = [
        building for thing, vertices in objects for building in read_buildings(thing, vertices, "measuredHeight")
    ]
    assert [building.id for building in buildings] == [house.id for house in houses]
    for building, house in zip(buildings, houses, strict=True):
        assert building.height == pytest.approx(house.height + house.roof.rise, abs=0.001)
        assert {shape.lod for shape in building.shapes} == {1.2, 2.2}
        assert len({shape.owner for shape in building.shapes}) == 1 + len(house.parts)
        top = max(shape.faces.xyz[:, 2].max() for shape in building.shapes if shape.lod == 2.2)
        assert top == pytest.approx(house.z + house.height + house.roof.rise, abs=0.002) or house.dormers


@pytest.mark.parametrize("style", STYLES)
def test_parameters_are_read_back(tmp_path: Path, style: str) -> None:
    houses = houses_of(style, 120.0)
    assert houses
    write_json(houses, tmp_path / "houses.jsonl")
    write_xml(houses, tmp_path / "houses.xml")
    assert list(read_json(tmp_path / "houses.jsonl")) == houses
    assert list(read_xml(tmp_path / "houses.xml")) == houses
    text = (tmp_path / "houses.xml").read_text()
    assert all(f"<{name}>" in text for name in ("origin", "xSize", "floors", "roofType", "embrasure"))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"length": "wide"}, "length is 'wide'"),
        ({"storeys": 2.5}, "storeys is 2.5"),
        ({"colour": "red"}, "House has no 'colour'"),
        ({"roof": {"shape": "onion"}}, "shape is 'onion'"),
        ({"dormers": [{"side": True}]}, "side is True"),
        ({"plan": [[[0, 0], [6, 0], [6, 5], [3, -1]]]}, "plan: Self-intersection"),
        ({"plan": [[[0, 0], [0, 4], [4, 4]]]}, "plan: its border has to be counter-clockwise"),
    ],
)
def test_wrong_parameters_are_told_with_their_line(tmp_path: Path, change: dict[str, Any], told: str) -> None:
    write_json(houses_of("detached", 60.0)[:2], tmp_path / "houses.jsonl")
    lines = (tmp_path / "houses.jsonl").read_text().splitlines()
    lines[1] = json.dumps(json.loads(lines[1]) | change)
    (tmp_path / "houses.jsonl").write_text("\n".join(lines))
    with pytest.raises(InputError, match=f"line 2.*{told}"):
        list(read_json(tmp_path / "houses.jsonl"))


def test_a_broken_xml_is_told_with_its_house(tmp_path: Path) -> None:
    write_xml(houses_of("detached", 60.0)[:2], tmp_path / "houses.xml")
    text = (tmp_path / "houses.xml").read_text()
    (tmp_path / "houses.xml").write_text(text.replace("<xSize>", "<xLength>").replace("</xSize>", "</xLength>"))
    with pytest.raises(InputError, match="is no house"):
        list(read_xml(tmp_path / "houses.xml"))


def test_a_town_has_the_same_bytes_and_its_points_lie_on_houses_and_ground(tmp_path: Path) -> None:
    town = open_town(150.0, "detached", rules=None, seed=4, relief=10)
    one, two = (
        write_town(tmp_path / name, town, make_output(ModelOptions(("2.2",))), density=5.0)
        for name in ("one", "two")
    )
    for first, second in zip(
        [*one.clouds, one.footprints, one.models, one.parameters],
        [*two.clouds, two.footprints, two.models, two.parameters],
        strict=True,
    ):
        assert first.read_bytes() == second.read_bytes()
    houses = list(town.houses(town.bounds))
    las = laspy.read(one.clouds[0])
    xyz, built = np.column_stack((las.x, las.y, las.z)), np.asarray(las.classification) == 6
    assert len(xyz) == round(5.0 * 150 * 150)
    highest = np.full(len(xyz), -np.inf)
    for house in houses:
        highest = np.fmax(highest, house_heights(house, xyz[:, :2]))
    ground = town.ground(xyz[:, 0], xyz[:, 1])
    np.testing.assert_array_equal(built, highest > ground)
    assert 0.1 < built.mean() < 0.5
    error = xyz[:, 2] - np.where(built, highest, ground)
    assert 0.04 < error[built].std() < 0.06
    assert 0.02 < error[~built].std() < 0.04
    outlines = shapely.from_wkb(pyogrio.raw.read(one.footprints)[2])
    inside = shapely.contains_xy(shapely.union_all(outlines), *xyz[:, :2].T)
    assert built[inside].mean() > 0.99  # a foot may stand in a hill


def test_a_town_is_meshed_from_its_model_and_from_its_points(tmp_path: Path) -> None:
    size = "90"
    assert (
        main(
            ["synth", str(tmp_path / "t"), "--style", "detached", "--size", size, "--density", "6", "--seed", "4"]
        )
        == 0
    )
    common = ["--mesh-size", "8", "--domain-height", "40", "--workers", "0"]
    points = [
        "run",
        str(tmp_path / "t/tiles"),
        "--footprints",
        str(tmp_path / "t/footprints.gpkg"),
        "--id-attribute",
        "id",
    ]
    assert main([*points, "--out", str(tmp_path / "p"), *common]) == 0
    model = ["run", str(tmp_path / "t/tiles"), "--buildings", str(tmp_path / "t/town.city.jsonl")]
    assert main([*model, "--out", str(tmp_path / "m"), *common]) == 0
    assert main(["check", str(tmp_path / "p")]) == main(["check", str(tmp_path / "m")]) == 0
    for name in ("p", "m"):
        fidelity = json.loads((tmp_path / name / "run.json").read_text())["fidelity"]["roof"]
        assert fidelity["p50"] < 0.15


def test_rules_are_files_with_a_schema(tmp_path: Path) -> None:
    schema = rule_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    for preset in PRESETS.values():
        jsonschema.validate(preset, schema)
    for wrong in ({"windows": 1}, {"storeys": 0}, {"roof_shape": "onion"}, {"length": {"uniform": [9]}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema)
    (tmp_path / "rules.toml").write_text(
        'roof_shape = "hipped"\nstoreys = { choice = [2, 3], weights = [1, 2] }\n'
    )
    (tmp_path / "rules.json").write_text(
        json.dumps({"roof_shape": "hipped", "storeys": {"choice": [2, 3], "weights": [1, 2]}})
    )
    assert read_rules(tmp_path / "rules.toml") == read_rules(tmp_path / "rules.json")
    town = open_town(100, "grid", rules=tmp_path / "rules.toml", seed=1, relief=0)
    assert {house.roof.shape for house in town.houses(town.bounds)} <= {"hipped", "pyramidal"}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--levels", "2.2,4.0"], "--levels 4.0: expected some of 0.0, 0.1"),
        (["--size", "0"], "--size 0"),
        (["--density", "-1"], "--density -1"),
        (["--seed", "-1"], "seed -1"),
        (["--buildings", "9"], "--style detached: has lots"),
        (["--rules", "none.toml"], "none.toml: cannot be read"),
    ],
)
def test_wrong_options_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    assert main(["synth", str(tmp_path / "t"), "--style", "detached", "--size", "50", *words]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "t").exists()


def test_files_of_another_town_are_not_mixed_with(tmp_path: Path) -> None:
    town = open_town(60.0, "grid", rules=None, seed=1, relief=0)
    files = write_town(tmp_path, town, make_output(ModelOptions(("1.2",))), density=1.0)
    shutil.copy(files.clouds[0], tmp_path / "tiles" / "other.laz")
    with pytest.raises(ConfigError, match=r"other.laz: is not of this town"):
        write_town(tmp_path, town, make_output(ModelOptions(("1.2",))), density=1.0)


@pytest.mark.parametrize(("style", "seed", "size"), [("blocks", 12, 150.0), ("mixed", 1, 430.0)])
def test_houses_do_not_overlap_and_do_not_depend_on_tiles(style: str, seed: int, size: float) -> None:
    town = open_town(size, style, rules=None, seed=seed, relief=10, trees=0.3)
    houses = list(town.houses(town.bounds))
    assert len({house.id for house in houses}) == len(houses) > 50
    assert style != "mixed" or len({house.width for house in houses}) > 5
    outlines = [shapely.Polygon(border, holes) for _, (border, *holes) in map(house_outline, houses)]
    one, other = shapely.STRtree(outlines).query(outlines, "intersects")
    pairs = [(outlines[i], outlines[k]) for i, k in zip(one, other, strict=True) if i < k]
    assert max((a.intersection(b).area for a, b in pairs), default=0.0) < 0.01
    west, south, east, north = town.bounds
    middle = west + 0.43 * size
    for thing in (town.houses, town.plants, town.open_lots):
        halves = [*thing((west, south, middle, north)), *thing((middle, south, east, north))]
        assert sorted(map(repr, halves)) == sorted(map(repr, thing(town.bounds)))


def test_edited_parameters_are_a_house_like_others(tmp_path: Path) -> None:
    house = replace(houses_of("detached", 60.0)[0], storeys=1, height=3.0, dormers=(), openings=())
    write_json([house], tmp_path / "houses.jsonl")
    (read,) = read_json(tmp_path / "houses.jsonl")
    write_models([read], tmp_path / "m.city.jsonl", ("3.3",))
    assert not any(check_solids(read_document(tmp_path / "m.city.jsonl"), ["3.3"]).values())
