"""Parameters: file and command line, bounds, messages."""

import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.errors import ConfigError
from stitch.tiling.smallest_tile import LEAST_TILE
from tiler.cli.main import make_parser
from tiler.config.config import Config, make_config
from tiler.config.config_file import annotated_defaults, load_config, with_file
from tiler.config.step_options import derived_parameters
from tiler.interface.synth import write_city
from tiler.planning.plan import survey_inputs
from tiler.workflow.run import warn_of_flat_roofs


def test_the_annotated_defaults_are_the_defaults() -> None:
    document = tomllib.loads(annotated_defaults())
    values = {name: value for table in document.values() for name, value in table.items()}
    assert make_config(values) == Config()
    assert set(values) == {entry.name for entry in dataclasses.fields(Config)}


def test_every_parameter_says_what_it_is() -> None:
    for entry in dataclasses.fields(Config):
        assert entry.metadata["text"], entry.name
        assert f"{entry.name} = " in annotated_defaults()


def test_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text('[input]\npointcloud = ["a.laz", "/b.laz"]\n[mesh]\nmesh_size = 7\ndomain_height = 80.0\n')
    options = make_parser().parse_args(["run", str(file), "--mesh-size", "5", "--bounds", "0", "0", "90", "90"])
    config = make_config(with_file(vars(options)))
    assert config.mesh_size == 5.0
    assert config.domain_height == 80.0
    assert config.bounds == (0.0, 0.0, 90.0, 90.0)
    assert config.pointcloud == (str(tmp_path / "a.laz"), "/b.laz")


def test_one_cloud_may_stand_without_brackets(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text('[input]\npointcloud = "a.laz"\n')
    assert make_config(load_config(file)).pointcloud == (str(tmp_path / "a.laz"),)


def test_every_parameter_is_an_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        make_parser().parse_args(["run", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for entry in dataclasses.fields(Config):
        if entry.name != "pointcloud":
            assert f"--{entry.name.replace('_', '-')}" in text


def test_walls_of_a_city_model_have_a_clearance_of_their_own() -> None:
    model: dict[str, object] = {"buildings": ["a.gml"]}
    other = (
        {"roofs": "flat"},
        {"mesher": "layered"},
        {"pointcloud": ["a.laz"], "prefer": "points"},
        {"clearance": 1.0},
    )
    assert (make_config(model).clearance, make_config(model).finer_clearance) == (0.5, 0.3)
    assert make_config(model | {"finer_clearance": 0.0}).finer_clearance == 0
    assert [make_config(model | one).clearance for one in other] == [1.0] * 4
    assert [make_config(model | one).finer_clearance for one in other] == [0.0] * 4
    assert make_config({"footprints": "a.gpkg"}).clearance == 1.0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mesh_size": 0.0}, r"mesh_size = 0 m: must be at least 0\.1 m"),
        ({"domain_height": float("nan")}, "domain_height = nan: must be a finite number"),
        ({"tile_size": 9.0}, "tile_size = 9 m: at least 10 m; .*or give 0 for one that follows the mesh size"),
        ({"roof_percentile": 101.0}, "roof_percentile = 101 %: must be at most 100 %"),
        ({"dtm_spacing": -1.0}, "dtm_spacing = -1 m: must be above 0 m"),
        ({"smoother": "magic"}, "smoother = 'magic': must be one of columns, fem"),
        ({"workers": 1.5}, "workers = 1.5: int expected, not float"),
        ({"mesh_size": "10"}, "mesh_size = '10': float expected, not str"),
        ({"bounds": (0.0, 1.0)}, "four finite numbers"),
        ({"bounds": (0.0, 0.0, 5.0, 90.0)}, "smaller than one cell"),
        ({"finer_clearance": 2.0}, "finer_clearance = 2 m: must be at most clearance = 1 m"),
        ({"clearance_floor": 2.0}, "clearance_floor = 2 m: must be at most clearance = 1 m"),
        ({"layer_height": 60.0, "mesher": "layered"}, "layer height 60 m: at most half of domain_height"),
        ({"mesh_size": 100.0}, "vertical spacing of up to 80 m .*: at most half of domain_height = 100 m"),
        ({"open_size": 10.0}, "open_size = 10 m: must be above mesh_size = 10 m; 0 takes mesh_size everywhere"),
        ({"open_size": 70.0}, r"of up to 56 m \(most_spacing x open_size\).*--most-spacing or --open-size"),
        ({"grading": 0.0}, "grading = 0: must be above 0"),
        ({"least_spacing": 0.9}, "least_spacing = 0.9: must be at most most_spacing = 0.8"),
    ],
)
def test_bad_values_are_refused_with_value_and_bound(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_config(values)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[mesh\n", "not valid TOML"),
        ("[mush]\nmesh_size = 1\n", r"unknown section \[mush\]"),
        ("[mesh]\nmesh_sise = 1\n", r"unknown parameter mesh_sise in \[mesh\]"),
        ("[run]\nmesh_size = 1\n", r"unknown parameter mesh_size in \[run\]"),
        ("x = 1\n", r"unknown section \[x\]"),
        ("#" * 1_000_001, "this is no configuration"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "run.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config(file)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "none.toml")


def test_tiles_follow_the_mesh_size_alone_where_no_side_is_given(tmp_path: Path) -> None:
    sizes = np.array([100.0, 80.0, 20.0, 10.0, 7.0, 5.0, 2.5, 1.0])
    high = {"domain_height": 1000.0}
    sides = np.array([make_config({"mesh_size": size} | high).tile_size_or_default for size in sizes.tolist()])
    assert sides[2:4].tolist() == [1250.0, 1250.0]
    assert (np.diff(sides) <= 0).all()
    assert (sides >= LEAST_TILE * sizes).all()
    fine = sizes <= 10
    triangles = (sides / sizes)[fine] ** 2  # but for a factor
    assert (np.diff(triangles) >= 0).all()  # no more seams for its area as meshes get finer
    assert (np.diff(triangles * sizes[fine] ** 0.4) <= 0).all()  # nor many more columns
    assert make_config({"mesh_size": 2.5, "open_size": 40.0}).tile_size_or_default == LEAST_TILE * 40.0

    files = write_city(tmp_path, size=100, buildings=1)
    given = {"pointcloud": [str(path) for path in files.clouds], "mesh_size": 2.5}
    said: list[str] = []
    assert survey_inputs(make_config(given), said.append).region.tile_size == 350.0
    assert survey_inputs(make_config(given | {"tile_size": 90.0}), said.append).region.tile_size == 90.0


def test_roofs_stay_flat_where_the_mesher_or_the_simplification_knows_no_others() -> None:
    sloped = Config(roofs="planes")
    assert derived_parameters(sloped)["roofs_or_flat"] == "planes"
    layered, paper = Config(roofs="planes", mesher="layered"), Config(roofs="planes", simplify="paper")
    for config, why in ((layered, "mesher = layered"), (paper, "simplify = paper")):
        assert derived_parameters(config)["roofs_or_flat"] == "flat"
        assert warn_of_flat_roofs(config) == f"roofs are flat, not planes: {why} has no sloped ones"
