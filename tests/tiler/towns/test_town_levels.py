"""One command makes every level of a town as a volume mesh of its own."""

import json
from pathlib import Path

import pytest

from pipeline.data.errors import ConfigError
from tiler.cli.main import main
from tiler.report.roof_truth import compare_with_truth


@pytest.mark.long
def test_each_level_is_a_mesh_of_its_own(tmp_path: Path) -> None:
    levels = ["1.2", "1.3", "2.1", "2.2"]
    town = ["synth", str(tmp_path / "t"), "--style", "detached", "--size", "90", "--lidar", "4", "--seed", "4"]
    assert main([*town, "--levels", ",".join(levels)]) == 0
    inputs = [str(tmp_path / "t/tiles"), "--buildings", str(tmp_path / "t/town.city.jsonl")]
    mesh = ["--mesh-size", "8", "--domain-height", "40", "--workers", "0", "--out", str(tmp_path / "m")]
    assert main(["run", *inputs, *mesh, "--lods", ",".join(levels)]) == 0
    parts = {}
    for lod in levels:
        assert main(["check", str(tmp_path / f"m/lod{lod}")]) == 0
        record = json.loads((tmp_path / f"m/lod{lod}/run.json").read_text())
        assert record["parameters"]["lod"] == lod
        parts[lod] = record["counts"]["building parts"], record["counts"].get("sloped parts", 0)
    assert parts["1.2"][0] < parts["1.3"][0] < parts["2.1"][0] < parts["2.2"][0]  # parts, planes, dormers
    assert parts["1.2"][1] == parts["1.3"][1] == 0 < parts["2.1"][1]
    assert main(["report", str(tmp_path / "m/lod2.2"), "--truth", str(tmp_path / "t/truth.jsonl")]) == 0
    page = (tmp_path / "m/lod2.2/report.html").read_text()
    assert "Fidelity to the truth" in page
    rows = {row["type"]: row for row in compare_with_truth(tmp_path / "m/lod2.2", tmp_path / "t/truth.jsonl")}
    assert rows["all"]["houses"] > 5  # without those beside the border
    assert rows["all"]["right_type"] == 1.0
    assert rows["all"]["height_50"] < 0.01
    other = json.loads((tmp_path / "t/truth.jsonl").read_text().splitlines()[0]) | {"id": "another"}
    (tmp_path / "t/other.jsonl").write_text(json.dumps(other) + "\n")
    with pytest.raises(ConfigError, match="none of its"):
        compare_with_truth(tmp_path / "m/lod1.2", tmp_path / "t/other.jsonl")


def test_levels_need_a_city_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(tmp_path), "--out", str(tmp_path / "o"), "--lods", "1.2,2.2"]) == 2
    assert "--lods: takes levels of --buildings" in capsys.readouterr().err
    config = tmp_path / "city.toml"
    config.write_text(f'[input]\npointcloud = ["{tmp_path}"]\nbuildings = ["{tmp_path / "none.city.json"}"]\n')
    assert main(["run", str(config), "--out", str(tmp_path / "o"), "--lods", "1.2,2.2"]) != 0
    assert "--lods" not in capsys.readouterr().err
