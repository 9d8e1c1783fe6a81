"""The simulator of countries: what it tells of a small one."""

from pathlib import Path

from tests.benchmarks.countries import COUNTRIES
from tests.benchmarks.recorded import recorded_stages
from tests.benchmarks.simulate import run_disk, run_virtual


def test_every_country_has_its_recorded_tiles() -> None:
    for country in COUNTRIES.values():
        assert "columns" in recorded_stages(country.tile_size)


def test_a_small_country_in_virtual_time(tmp_path: Path) -> None:
    whole = run_virtual("sweden", 40, 4, 0.0, tmp_path / "whole")
    assert whole["tasks"] == whole["records"]
    assert (whole["planned_again"], whole["missing"], whole["reused"]) == (0, 0, 0)
    assert 0.9 < whole["busy"] <= 1.0
    assert 3600 * whole["core_hours"] > 40
    holes = run_virtual("sweden", 40, 4, 0.01, tmp_path / "holes")
    assert holes["planned_again"] > 0
    assert 0 < holes["missing"] < 40
    assert holes["records"] < whole["records"]


def test_a_small_country_goes_on_from_its_half(tmp_path: Path) -> None:
    told = run_disk("netherlands", 10, tmp_path, half=True)
    half = told["first_half"]["tasks"]
    assert half < told["tasks"]
    assert half <= told["reused"] < told["tasks"]  # what was in flight when it stopped was done too
