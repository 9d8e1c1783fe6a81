"""Houses of other origins: footprints with attributes, edited parameters; their twins, and broken models."""

import json
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import pytest
import shapely
from shapely.affinity import translate

from pipeline.architecture.levels import FOOTPRINTS, TOPS
from tests.helpers.iso19107 import check_solids
from tests.tiler.citymodels.test_valid_solids import schema
from tests.tiler.convert.test_convert import validate_gml
from tests.tiler.towns.test_towns import read_document
from tiler.cli.main import main
from tiler.cli.parser import BLOCK_HEIGHTS, TOWN_STYLES, TOWN_WALLS
from tiler.towns.parameter_files import house_json, read_json
from tiler.towns.styles import STYLES

RING = shapely.Polygon([(0, 0), (12, 0), (12, 6), (6, 6), (6, 12), (0, 12)])


def write_footprints(path: Path) -> None:
    """Two houses that share a wall, and an L without attributes."""
    shapes = [
        shapely.box(0, 0, 10, 8),
        shapely.box(10, 0, 19, 8),
        translate(RING, 40),
    ]
    moved = [translate(one, 500_000, 6_000_000) for one in shapes]
    fields = {
        "id": np.array(["a", "b", "c"], object),
        "height": np.array([9.0, np.nan, np.nan]),
        "building:levels": np.array(["2", "many", None], object),
        "roof:shape": np.array(["hipped", None, None], object),
    }
    pyogrio.raw.write(
        path, shapely.to_wkb(moved), list(fields.values()), list(fields), geometry_type="Polygon", crs="EPSG:3006"
    )


def test_attributes_win_over_rules(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_footprints(tmp_path / "f.gpkg")
    style = ["--style", "detached", "--levels", "1.2,2.2"]
    given = ["--footprints", str(tmp_path / "f.gpkg"), "--degrade", "0.1", "--broken"]
    assert main(["synth", str(tmp_path / "t"), *style, *given]) == 0
    told = capsys.readouterr().out
    assert "1 attributes of storeys that are no such number: drawn by rules" in told
    assert "3 footprints in augmented.gpkg, 2 of them houses" in told
    a, b = read_json(tmp_path / "t/parameters.jsonl")
    assert (a.id, a.storeys, a.roof.shape, a.length, a.width) == ("a", 2, "hipped", 10.0, 8.0)
    assert a.height + a.roof.rise == pytest.approx(9.0, abs=0.005)
    assert {one.wall for one in a.openings} == {0, 2, 3}  # the right wall is shared
    assert 1 not in {one.wall for one in a.openings}
    assert 3 not in {one.wall for one in b.openings}
    meta, _, _, values = pyogrio.raw.read(tmp_path / "t/augmented.gpkg")
    table = dict(zip(meta["fields"].tolist(), values, strict=True))
    assert table["id"].tolist() == ["a", "b", "c"]
    assert table["height"][0] == 9.0
    assert (table["height"] > 2.5).all()
    for model in ("town", "twins"):
        document = read_document(tmp_path / f"t/{model}.city.jsonl")
        assert list(document["CityObjects"]) == ["a", "b"]
        assert not any(check_solids(document, ("1.2", "2.2")).values())
    # Rules that have other footprints than rectangles make a house of the L, too.
    (tmp_path / "rules.toml").write_text('footprint = "L"\nroof_shape = "gabled"')
    wings = ["--footprints", str(tmp_path / "f.gpkg"), "--rules", str(tmp_path / "rules.toml")]
    assert main(["synth", str(tmp_path / "w"), *style, *wings]) == 0
    (*same, c) = read_json(tmp_path / "w/parameters.jsonl")
    assert [one.id for one in same] == ["a", "b"]
    outline = shapely.from_wkb(pyogrio.raw.read(tmp_path / "w/footprints.gpkg")[2][2])
    assert outline.symmetric_difference(translate(RING, 500_040, 6_000_000)).area < 0.05
    assert (c.roof.shape, {one.wall for one in c.openings}) == ("gabled", set(range(6)))
    found = check_solids(read_document(tmp_path / "w/town.city.jsonl"), ("1.2", "2.2"))
    assert found["c", "2.2"] == found["c", "1.2"] == set()
    broken = check_solids(read_document(tmp_path / "t/broken.city.jsonl"), ("1.2",))
    assert sum(map(bool, broken.values())) == 27
    # Parameters make the same model, and edited ones another.
    again = ["--parameters", str(tmp_path / "t/parameters.jsonl"), "--lidar", "2"]
    assert main(["synth", str(tmp_path / "u"), *style, *again]) == 0
    assert (tmp_path / "u/town.city.jsonl").read_bytes() == (tmp_path / "t/town.city.jsonl").read_bytes()
    las = laspy.read(next((tmp_path / "u/tiles").glob("*.laz")))
    assert {2, 6} <= set(np.asarray(las.classification).tolist())
    row = json.loads((tmp_path / "t/parameters.jsonl").read_text().splitlines()[1])
    assert row["id"] == "b"
    (tmp_path / "edited.jsonl").write_text(house_json(b))
    again = ["--parameters", str(tmp_path / "edited.jsonl")]
    assert main(["synth", str(tmp_path / "v"), *style, *again]) == 0
    assert list(read_document(tmp_path / "v/town.city.jsonl")["CityObjects"]) == ["b"]


def test_a_town_obeys_the_schemas(tmp_path: Path) -> None:
    interiors = [f"interior-LOD{level}" for level in ("0", "1", "2_2", "2_3")]
    town = ["synth", str(tmp_path / "t"), "--style", "blocks", "--size", "60", "--density", "0", "--trees", "0.9"]
    assert main([*town, "--broken", "--variants", ",".join([*interiors, "LOD3_3_S0"])]) == 0
    rules = schema("cityjsonfeature")
    kinds = set()
    for path in (tmp_path / "t").rglob("*.city.jsonl"):
        head, *features = map(json.loads, path.read_text().splitlines())
        assert [error.message for error in schema("cityjson").iter_errors(head)] == []
        for feature in features[::5]:
            assert [error.message for error in rules.iter_errors(feature)] == [], path
        kinds |= {thing["type"] for feature in features for thing in feature["CityObjects"].values()}
    assert kinds >= {"Building", "BuildingStorey", "Road", "PlantCover", "SolitaryVegetationObject"}
    gml = tmp_path / "t.gml"
    storeys = [str(tmp_path / f"t/variants/{name}.city.jsonl") for name in interiors[2:]]
    town = [str(tmp_path / "t/town.city.jsonl"), *storeys, "--output", str(gml), "--overwrite"]
    for version, inside in (("2", "Room"), ("3", "Storey")):
        assert main(["convert", *town, "--format", f"citygml{version}"]) == 0
        assert validate_gml(gml, f"{version}.0") == []
        text = gml.read_text()
        assert all(f":{kind} " in text for kind in (inside, "Road", "PlantCover", "SolitaryVegetationObject"))


def test_the_parser_has_the_lists_of_the_packages() -> None:
    assert ("boxes", *STYLES) == TOWN_STYLES
    assert TOWN_WALLS == FOOTPRINTS
    assert tuple(TOPS) == BLOCK_HEIGHTS


def test_what_is_no_such_file_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "f.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    for words, told in (
        (["--footprints", str(tmp_path / "f.geojson")], "expected a projected one in metres"),
        (["--footprints", str(tmp_path / "none.gpkg")], "cannot be read"),
        (["--degrade", "-1"], "--degrade -1"),
        (["--variants", "LOD9"], "--variants LOD9: no such representation"),
        (["--workers", "-2"], "--workers -2: expected 0, for this process, or more"),
        (["--class-errors", "0.2"], "--class-errors: are those of the points of --lidar"),
        (["--parameters", "f.jsonl", "--lidar", "-8"], "--lidar -8: expected 0 to 1000"),
        (["--footprints", "f.gpkg", "--trees", "0.5"], "--trees: goes with towns that are drawn"),
    ):
        assert main(["synth", str(tmp_path / "t"), "--style", "grid", "--size", "50", *words]) in (1, 2)
        assert told in capsys.readouterr().err
    assert main(["synth", str(tmp_path / "t"), "--lidar", "8"]) == 2
    assert "--lidar: goes with a town" in capsys.readouterr().err
