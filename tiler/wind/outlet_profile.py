"""`citystitch wind --profile`: the profile of the wind at the outlet of bare ground, as a table for another inlet.

Cells and wall functions do not keep the logarithmic profile to the last per cent near the ground; what leaves a
domain of bare ground is the profile that they keep.
"""

import json
from pathlib import Path

import numpy as np

from pipeline.data.errors import ConfigError, InputError
from tiler.export.export import EXPORT_RECORD
from tiler.export.wind_case import OUTLET
from tiler.export.wind_profile import COLUMNS, SIDES, flow_of, split_sides
from tiler.store.atomic import replacing
from tiler.wind.results import Floats, WindCase, open_case, read_table, sampled_file

FIELDS = {"U": 6, "k": 4, "epsilon": 4}  # numbers of a row: its place and its value
LEVEL = 0.05  # m; 3 % of the speed at 0.5 m
ROW = 1.05  # faces of one row of the table: highest over lowest height, unless it has few faces
FEW = 0.02  # of all


def write_outlet_profile(directory: Path, path: Path, *, overwrite: bool = False) -> list[str]:
    """Write the mean profile at the outlet as CSV, for `--wind-table`.

    Parameters
    ----------
    directory : Path
        An exported wind case of one direction over bare level ground, which has run.
    path : Path
        File to write.
    overwrite : bool
        Whether it may be replaced.

    Returns
    -------
    list of str
        How far it is from the profile at the inlet, a line.

    Raises
    ------
    ConfigError
        If the file exists and may not be replaced, or the case has several directions, houses or a slope.
    InputError
        If the case cannot be read, or has not run.
    """
    if path.exists() and not overwrite:
        raise ConfigError(f"{path}: exists; give another --profile, or --overwrite")
    case = open_case(directory)
    if (n := len(case.wind.directions)) > 1:
        raise ConfigError(f"{directory}: has {n} directions; --profile takes a case of one")
    rows = _read_outlet(case, _find_ground(case))
    with replacing(path) as part:
        lines = [",".join(f"{value:.6g}" for value in row) for row in rows]
        part.write_text("\n".join([",".join(COLUMNS), *lines]) + "\n")
    off = rows[:, 1] / case.wind.speed_at(rows[:, 0]) - 1
    return [
        f"{len(rows)} heights; speeds at the outlet are {off.min():+.1%} to {off.max():+.1%} off those of the "
        f"inlet, most at {rows[np.abs(off).argmax(), 0]:.3g} m"
    ]


def _find_ground(case: WindCase) -> float:
    """Return the lowest point of the sides by which the wind leaves (m), as the case counts."""
    path = case.folder / EXPORT_RECORD
    lowest: dict[str, float] = {}
    highest: dict[str, float] = {}
    try:
        for mesh in json.loads(path.read_text())["meshes"]:
            lowest |= {name: min(z, lowest.get(name, z)) for name, z in mesh["lowest"].items()}
            highest |= {name: max(z, highest.get(name, z)) for name, z in mesh["highest"].items()}
        _, outlets, _ = split_sides(case.wind.directions[0], [side for side in SIDES if side in lowest])
        ground, uneven = min(lowest[side] for side in outlets), highest["ground"] - lowest["ground"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is damaged ({error}); export the case again") from None
    if others := sorted(lowest.keys() - {"ground", "top", *SIDES}):
        raise ConfigError(f"{case.folder}: --profile takes a case of bare ground; this one has {others[0]}")
    if uneven > LEVEL:
        raise ConfigError(
            f"{case.folder}: --profile takes level ground, within {LEVEL:g} m; this spans {uneven:.3g} m; if its "
            "points do by their noise alone, mesh with --dtm-spacing 10"
        )
    return ground


def _read_outlet(case: WindCase, ground: float) -> Floats:
    """Return the means of the faces by which the wind leaves, by height, (n, 4) as `COLUMNS`."""
    (direction,) = case.wind.directions
    fields = {name: read_table(sampled_file(case, direction, f"{name}_{OUTLET}"), n) for name, n in FIELDS.items()}
    height = fields["U"][:, 2] - ground
    speed = fields["U"][:, 3:] @ (*flow_of(direction), 0.0)
    step = (np.log(height / height.min()) / np.log(ROW) + 1e-6).astype(int)
    row = np.unique((np.cumsum(np.bincount(step)) - 1)[step] // (FEW * len(step)), return_inverse=True)[1]
    columns = (height, speed, fields["k"][:, 3], fields["epsilon"][:, 3])
    return np.column_stack([np.bincount(row, column) for column in columns]) / np.bincount(row)[:, None]
