"""`citystitch check --cfd`: distances, blockage and cells worked out by hand, and the table of a run."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.mesh import Marker
from pipeline.quality.histograms import count_values
from tiler.check import cfd_guidelines
from tiler.check.cfd_guidelines import check_guidelines
from tiler.check.cfd_survey import HEIGHTS, RATIOS, Blocks, CfdSurvey, _front_area, _measure_columns, survey_domain
from tiler.cli.main import main
from tiler.mesh_files.mesh_pieces import MeshPiece


def survey(pad: float = 100.0, top: float = 120.0, height: float = 20.0) -> CfdSurvey:
    """A house of 20 x 10 m and `height` in the middle of bare ground, another half as high behind it."""
    box = np.array([[0.0, 0.0, 20.0, 10.0], [30.0, 0.0, 40.0, 10.0]])
    corners = np.array([[0.0, 0], [20, 0], [20, 10], [0, 10], [30, 0], [40, 0], [40, 10], [30, 10]])
    roof = np.array([height, height / 2])
    blocks = Blocks(np.arange(2), box, np.zeros(2), roof, np.array([200.0, 100.0]), corners, np.repeat([0, 1], 4))
    return CfdSurvey(
        (-pad, -pad, 40.0 + pad, 10.0 + pad),
        blocks,
        top,
        0.0,
        count_values(np.array([1.0, 1.2]), *RATIOS),
        count_values(np.array([0.8]), *HEIGHTS),
        count_values(np.array([1.7]), *HEIGHTS),
        np.array([12.0, 11.0]),
    )


def test_distances_by_direction() -> None:
    found = survey(100.0)
    assert found.tallest == 20.0
    assert [found.distance_to(side) for side in ("west", "east", "south", "north")] == [100.0] * 4
    assert found.distances(270.0) == (100.0, 100.0, 100.0)
    assert found.distances(225.0) == (100.0, 100.0, math.inf)


def test_blockage_by_hand() -> None:
    """From the west the lower house is hidden: 10 x 20 m2 of 210 x 120; from the south both are seen."""
    found = survey(100.0)
    assert found.blockage(270.0) == pytest.approx(10 * 20 / (210 * 120))
    assert found.blockage(180.0) == pytest.approx((20 * 20 + 10 * 10) / (240 * 120))
    # From the south-west, along the diagonal: (20 + 10) / sqrt 2 wide, and 14 to 21 m of the other beyond it.
    assert found.blockage(225.0) == pytest.approx(
        (21.2 * 20 + 14.1 * 10) / ((240 + 210) / math.sqrt(2) * 120), rel=0.05
    )
    assert _front_area(np.array([5.0]), np.array([5.1]), np.array([3.0])) == 3.0


def test_steps_along_columns_by_hand() -> None:
    """Two cells one on the other over a corner, 1 m and 1.5 m high: a ratio of 1.5, nodes at 1 and 2.5 m."""
    points = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 1], [0, 0, 2.5]])
    cells = np.array([[0, 1, 2, 3], [3, 1, 2, 4]], np.int32)
    facets, marker = np.array([[0, 2, 1]], np.int32), np.array([Marker.GROUND], np.int32)
    piece = MeshPiece("0_0", points, cells, facets, marker, np.array([-1]), np.arange(5))
    ratios, first, second = _measure_columns(piece)
    assert (ratios.tolist(), first.tolist(), second.tolist()) == ([1.5], [1.0], [2.5])


def table(monkeypatch: pytest.MonkeyPatch, found: CfdSurvey, *directions: float) -> dict[str, tuple[str, ...]]:
    monkeypatch.setattr(cfd_guidelines, "survey_domain", lambda _: found)
    report = check_guidelines(Path("run"), directions)
    return {row.name: row.cells() for row in report.rows}


def test_a_domain_that_is_right_for_one_guideline_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """10 H behind the houses are enough for AIJ, not for COST 732."""
    rows = table(monkeypatch, survey(200.0), 270.0)
    outlet = rows["270 deg: outlet (east)"]
    assert outlet == ("270 deg: outlet (east)", "10.0 H", ">= 15 H FAIL", ">= 10 H pass", "--pad 5H 15H 5H 5H")
    assert rows["270 deg: inlet (west)"] == ("270 deg: inlet (west)", "10.0 H", ">= 5 H pass", ">= 5 H pass", "")
    assert rows["top above the highest roof"][1:3] == ("5.0 H", ">= 5 H pass")
    assert all("FAIL" not in cell for name, row in rows.items() if "outlet" not in name for cell in row)
    report = check_guidelines(Path("run"), [270.0])
    assert not report.ok
    assert report.lines()[-1] == "run: COST 732: 1 of 8 not met, AIJ: met"
    assert report.lines()[0] == "H = 20.0 m, the tallest of 2 buildings and parts"


def test_what_fails_names_the_option(monkeypatch: pytest.MonkeyPatch) -> None:
    found = replace(survey(60.0, top=60.0), cells_a_side=np.array([5.0, 6.3, 12.0]))
    rows = table(monkeypatch, found, 240.0, 90.0)
    assert rows["cells a building side"][1] == "6.3 median, 33% have them"
    option = "a --wall-size of 0.46 times the present one, or a --mesh-size of 0.63 times"
    assert rows["cells a building side"][4] == option
    assert rows["240 deg: inlet (west, south)"][4] == "--pad 15H 15H 5H 15H"
    assert rows["top above the highest roof"][1:] == (
        "2.0 H", ">= 5 H FAIL", ">= 5 H FAIL", "--domain-height 6H --top flat",
    )  # fmt: skip
    assert "lateral" not in " ".join(name for name in rows if name.startswith("240"))
    assert rows["90 deg: lateral (south, north)"][1] == "3.0 H"


def test_the_table_of_a_run(small_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(small_run), "--cfd", "--direction", "240"]) == 1
    said = capsys.readouterr().out
    assert "240 deg: inlet (west, south)" in said
    assert "of 7 not met, AIJ: " in said
    assert main(["check", str(small_run), "--direction", "240"]) == 2
    assert "--direction: is for check --cfd" in capsys.readouterr().err
    assert main(["check", str(small_run), "--cfd", "--workers", "2"]) == 2
    assert "--workers: goes with check alone" in capsys.readouterr().err
    found = survey_domain(small_run)
    assert np.isfinite(found.cells_a_side).all()
    assert found.growth.minimum >= 1.0
    assert 0 < found.first.minimum < found.second.minimum
    assert 0 < found.blockage(270.0) < 1
