"""`citystitch check --cfd`: a mesh held against COST action 732 and AIJ, and the option that mends what fails.

References
----------
J. Franke, A. Hellsten, H. Schlünzen, B. Carissimo (eds.), "Best practice guideline for the CFD simulation of flows
in the urban environment", COST action 732, 2007.
Y. Tominaga et al., "AIJ guidelines for practical applications of CFD to pedestrian wind environment around
buildings", J. Wind Eng. Ind. Aerodyn. 96, 1749-1761, 2008.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.data.errors import ConfigError
from pipeline.quality.histograms import percentile
from tiler.check.cfd_survey import CfdSurvey, survey_domain
from tiler.export.wind_profile import PEDESTRIAN_HEIGHT, SIDES, WEST, split_sides

COST, AIJ = "COST 732", "AIJ"
INLET, LATERAL, TOP = 5.0, 5.0, 5.0  # heights of the tallest building
OUTLET = {COST: 15.0, AIJ: 10.0}
BLOCKAGE = 0.03
EXPANSION = 1.3
CELLS_A_SIDE = 10.0
FINER_WALLS = (
    1.7  # roofs and layers are not finer by it: 1, 0.63 and 0.45 m gave 6.3, 8.2 and 10.1 cells in Amsterdam
)
MOST = 95.0  # percent of the cells that must be so
HEAD = ("quantity", "value", COST, AIJ, "option that would mend it")


@dataclass(frozen=True)
class CfdRow:
    """One quantity."""

    #: what was measured, in words
    name: str
    value: str
    bounds: tuple[str, str]  #: what COST 732 and AIJ ask, in words
    passed: tuple[bool, bool]  #: whether each is met
    option: str  #: what would mend it

    def cells(self) -> tuple[str, ...]:
        """Return the row of the table."""
        verdicts = [
            f"{bound} {'pass' if passed else 'FAIL'}"
            for bound, passed in zip(self.bounds, self.passed, strict=True)
        ]
        return (self.name, self.value, *verdicts, "" if all(self.passed) else self.option)


@dataclass(frozen=True)
class CfdReport:
    """All rows, the height of the tallest building (m), and how many buildings there are."""

    directory: Path
    rows: tuple[CfdRow, ...]
    tallest: float
    n_buildings: int

    @property
    def ok(self) -> bool:
        """Whether both guidelines are met."""
        return all(all(row.passed) for row in self.rows)

    def lines(self) -> list[str]:
        """Return the report as text: a table, and the verdict."""
        table = [HEAD, *(row.cells() for row in self.rows)]
        width = [max(len(row[k]) for row in table) for k in range(len(HEAD))]
        lines = ["  ".join(f"{text:<{n}}" for text, n in zip(row, width, strict=True)).rstrip() for row in table]
        failed = [sum(not row.passed[k] for row in self.rows) for k in range(2)]
        verdict = ", ".join(
            f"{name}: {'met' if not n else f'{n} of {len(self.rows)} not met'}"
            for name, n in zip((COST, AIJ), failed, strict=True)
        )
        return [
            f"H = {self.tallest:.1f} m, the tallest of {self.n_buildings:,} buildings and parts",
            *lines,
            f"{self.directory}: {verdict}",
        ]


def check_guidelines(directory: Path, directions: Sequence[float] = (WEST,)) -> CfdReport:
    """Hold the mesh of a run against guidelines for wind simulations.

    Parameters
    ----------
    directory : Path
        The folder of a run.
    directions : sequence of float
        Where the wind comes from (degrees from north).

    Raises
    ------
    ConfigError
        If a direction is no number.
    InputError
        If the folder holds no finished run with buildings, or a file of it is missing or damaged.
    """
    if not all(math.isfinite(direction) for direction in directions):
        raise ConfigError("--direction: must be degrees from north, as 240")
    survey = survey_domain(directory)
    rows: list[CfdRow] = []
    for direction in directions:
        rows += _domain_rows(survey, direction % 360.0, directions)
    rows += [_top_row(survey), *_cell_rows(survey)]
    return CfdReport(directory, tuple(rows), survey.tallest, len(survey.blocks.height))


def _domain_rows(survey: CfdSurvey, direction: float, directions: Sequence[float]) -> list[CfdRow]:
    tallest = survey.tallest
    inlet, outlet, lateral = (gap / tallest for gap in survey.distances(direction))
    words = [", ".join(sides) for sides in split_sides(direction, SIDES)]
    pad = f"--pad {_ask_pad(directions)}"
    rows = [
        _row(f"{direction:g} deg: inlet ({words[0]})", inlet, (INLET, INLET), pad),
        _row(f"{direction:g} deg: outlet ({words[1]})", outlet, (OUTLET[COST], OUTLET[AIJ]), pad),
    ]
    if words[2]:
        rows.append(_row(f"{direction:g} deg: lateral ({words[2]})", lateral, (LATERAL, LATERAL), pad))
    blocked = survey.blockage(direction)
    met = blocked <= BLOCKAGE
    bound = f"<= {BLOCKAGE:.0%}"
    rows.append(
        CfdRow(
            f"{direction:g} deg: blockage",
            f"{blocked:.2%}",
            (bound, bound),
            (met, met),
            f"{pad} --domain-height 6H",
        )
    )
    return rows


def _ask_pad(directions: Sequence[float]) -> str:
    """Give the widths that a pad needs for some directions: west, east, south, north."""
    widths = dict.fromkeys(SIDES, INLET)
    for direction in directions:
        for side in split_sides(direction % 360.0, SIDES)[1]:
            widths[side] = max(OUTLET.values())
    return " ".join(f"{widths[side]:g}H" for side in ("west", "east", "south", "north"))


def _row(name: str, value: float, least: tuple[float, float], option: str) -> CfdRow:
    cost, aij = least
    # A pad is as wide as was asked for, but for rounding.
    return CfdRow(
        name,
        f"{value:.1f} H",
        (f">= {cost:g} H", f">= {aij:g} H"),
        (value >= cost - 1e-6, value >= aij - 1e-6),
        option,
    )


def _top_row(survey: CfdSurvey) -> CfdRow:
    above = (survey.top - float(survey.blocks.roof.max())) / survey.tallest
    return _row("top above the highest roof", above, (TOP, TOP), "--domain-height 6H --top flat")


def _cell_rows(survey: CfdSurvey) -> list[CfdRow]:
    growth = percentile(survey.growth, MOST)
    grown = round(growth, 2) <= EXPANSION  # as it is shown
    sides = survey.cells_a_side[~np.isnan(survey.cells_a_side)]
    cells = float(np.median(sides)) if len(sides) else 0.0
    enough = cells >= CELLS_A_SIDE
    second = percentile(survey.second, MOST)
    low = second <= PEDESTRIAN_HEIGHT
    first = percentile(survey.first, 50.0)
    return [
        CfdRow(
            "expansion ratio, upright",
            f"{growth:.2f} for {MOST:g} %, worst {survey.growth.maximum:.2f}",
            (f"<= {EXPANSION}", f"<= {EXPANSION}"),
            (grown, grown),
            "--first-layer and --layer-growth 1.2",
        ),
        CfdRow(
            "cells a building side",
            f"{cells:.1f} median, {(sides >= CELLS_A_SIDE).mean():.0%} have them" if len(sides) else "none",
            (f">= {CELLS_A_SIDE:g}", f">= {CELLS_A_SIDE:g}"),
            (enough, enough),
            f"a --wall-size of {(cells / CELLS_A_SIDE) ** FINER_WALLS:.2f} times the present one, "
            f"or a --mesh-size of {cells / CELLS_A_SIDE:.2f} times",
        ),
        CfdRow(
            f"cells below {PEDESTRIAN_HEIGHT} m",
            f"first {first:.2f} m high, third begins at {second:.2f} m for {MOST:g} %",
            (f"third <= {PEDESTRIAN_HEIGHT} m", f"third <= {PEDESTRIAN_HEIGHT} m"),
            (low, low),
            f"--first-layer {PEDESTRIAN_HEIGHT / 2.4:.1f}",  # two of them, the second up to 1.4 times as high
        ),
    ]
