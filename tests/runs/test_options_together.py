"""Options for wind and ground that all change columns, in one mesh of four tiles: proved as any other."""

from pathlib import Path

import pytest

from tiler.check.check import check_run
from tiler.config.config import make_config
from tiler.interface.synth import write_city
from tiler.store.results import StoredTerrain
from tiler.workflow.run import run


@pytest.mark.long
@pytest.mark.parametrize("mesher", ["adaptive", "layered"])
def test_all_options_that_change_columns_go_together(mesher: str, tmp_path: Path) -> None:
    files = write_city(tmp_path / "city", size=700, buildings=12, density=0.7)
    given = {
        "pointcloud": [str(path) for path in files.clouds],
        "footprints": str(files.footprints),
        "out": str(tmp_path / "out"),
        "tile_size": 350.0,
        "mesher": mesher,
        "first_layer": 1.0,
        "top": "flat",
        "domain_height": "3H",
        "open_size": 25.0,
        "underground": 20.0,
        "workers": 0,
    }
    record = run(make_config(given))
    assert record["exit_code"] == 0
    assert len(record["tiles"]) == 4
    report = check_run(tmp_path / "out", StoredTerrain)
    assert not report.faults
