"""Programs of others read the models of a town: cjio, citygmltest of libcitygml, and GDAL."""

import json
import re
import sys
from pathlib import Path

import pytest

from tests.helpers.programs import run_program
from tiler.cli.main import main

LEVELS = ("1.2", "2.2", "3.2")


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("town")
    asked = ("--style", "detached", "--size", "150", "--levels", ",".join(LEVELS))
    assert main(["synth", str(folder), *asked]) == 0
    for target, name in (("cityjson", "town.city.json"), ("citygml2", "town.gml")):
        wanted = ("--format", target, "-o", str(folder / name))
        assert main(["convert", str(folder / "town.city.jsonl"), *wanted]) == 0
    return folder


def count_houses(town: Path) -> int:
    return (town / "town.city.jsonl").read_text().count('"CityJSONFeature"')


@pytest.mark.long
def test_cjio_reads_all_houses_and_takes_one_level_of_them(town: Path) -> None:
    cjio = (str(Path(sys.executable).parent / "cjio"), "town.city.json")
    said = run_program((*cjio, "info", "lod_filter", "2.2", "save", "roofs.city.json"), town)
    assert f"Building ({count_houses(town)})" in said, said
    assert "EPSG = 3006" in said
    objects = json.loads((town / "roofs.city.json").read_text())["CityObjects"].values()
    levels = {geometry["lod"] for thing in objects for geometry in thing["geometry"]}
    assert levels == {"2.2"}
    run_program((cjio[0], "roofs.city.json", "export", "stl", "roofs.stl"), town)
    assert (town / "roofs.stl").read_text().count("facet normal") > 10 * count_houses(town)


@pytest.mark.long
def test_gdal_reads_all_houses_as_surfaces_in_space(town: Path) -> None:
    said = run_program(("ogrinfo", "-ro", "-al", "town.gml"), town)
    assert re.findall(r"^Layer name: (\w+)", said, re.MULTILINE) == ["Building"]
    assert f"Feature Count: {count_houses(town)}" in said
    assert said.count("POLYHEDRALSURFACE Z") == count_houses(town), said[:3000]
    assert "SWEREF99 TM" in said
    assert not re.search(r"\b(ERROR|Warning)\b", said), said[:3000]


@pytest.mark.long
def test_libcitygml_reads_it_without_an_error(town: Path) -> None:
    """It ends with 0 whatever it reads, and prints ``ERROR`` where it knows an element not."""
    said = run_program(("citygmltest", "-log", "town.gml"), town)
    assert "Done in" in said, said[:3000]
    assert not re.search("ERROR|WARN", said), said[:3000]
    (town / "broken.gml").write_text(re.sub(r"bldg:Building\b", "bldg:House", (town / "town.gml").read_text()))
    assert "ERROR" in run_program(("citygmltest", "-log", "broken.gml"), town)
