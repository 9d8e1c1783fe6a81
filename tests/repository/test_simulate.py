"""The simulator of countries: what it tells of a small one."""

from pathlib import Path

import pytest

from tests.benchmarks.countries import COUNTRIES
from tests.benchmarks.recorded import recorded_stages
from tests.benchmarks.simulate import run_disk, run_virtual
from tests.benchmarks.simulate_blocks import record, simulate
from tests.helpers.synthetic import city_files
from tiler.generalisation.region_cells import read_areas


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


@pytest.mark.long
def test_a_country_of_blocks_has_the_cells_of_its_tiles(tmp_path: Path) -> None:
    files = city_files(tmp_path / "city", size=2000.0, buildings=200, density=0.0)
    sample, counts, seconds = record(Path(files["footprints"]), tmp_path)
    own = sample.tiles("sides")
    (i, j), buildings = own[0], sum(counts["sort_buildings", tile][0] for tile in own)
    told = simulate(sample, counts, [(i + a, j + b) for a in range(4) for b in range(4)], tmp_path / "country")
    assert (len(own), told["buildings"]) == (4, 4 * buildings)
    cells = sum(len(read_areas(sample, 2, tile)[0]) for tile in own)
    assert 0.8 < told["cells"] / (4 * cells) < 1.1  # those on the sides of the town are joined with their copies
    assert seconds > 0
