"""What OpenFOAM sampled in an exported wind case: speeds over triangles of the ground, for each direction."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from tiler.export.export import EXPORT_RECORD
from tiler.export.wind_case import PEDESTRIAN
from tiler.export.wind_profile import Wind, WindTable, case_name

Floats = NDArray[np.float64]
NEAR = 0.01  # m; how far a sample may be from the centre of its triangle
FIELDS = ("U", "k")


@dataclass(frozen=True, eq=False)
class WindCase:
    """An exported wind case."""

    folder: Path  #: the export
    wind: Wind  #: the undisturbed wind
    crs: str  #: CRS of the coordinates
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: place in it (m) that those of the case count from

    def case_of(self, direction: float) -> Path:
        """Return the folder of a direction."""
        return self.folder / case_name(direction) if len(self.wind.directions) > 1 else self.folder


@dataclass(frozen=True, eq=False)
class Triangles:
    """The surface on which the wind is sampled: float64 points (n, 3) (m), int64 corners (t, 3)."""

    points: Floats
    corners: NDArray[np.int64]

    @property
    def centres(self) -> Floats:
        """Centre of each triangle (m), (t, 3)."""
        a, b, c = (self.points[self.corners[:, k]] for k in range(3))
        return (a + b + c) / 3


@dataclass(frozen=True, eq=False)
class Sampled:
    """Speeds of one direction: of each triangle (m/s), NaN where there was no cell; and after which iteration."""

    speed: Floats
    iteration: int

    @property
    def n_lost(self) -> int:
        """Number of triangles without a speed."""
        return int(np.isnan(self.speed).sum())


def open_case(folder: Path) -> WindCase:
    """Read what an export says of its wind.

    Raises
    ------
    InputError
        If the folder holds no exported wind case.
    """
    path = folder / EXPORT_RECORD
    try:
        record: Mapping[str, Any] = json.loads(path.read_text())
        words = record["wind"]
        wind = Wind(
            tuple(float(value) for value in words["directions"]),
            float(words["speed"]),
            float(words["height"]),
            float(words["roughness"]),
            table=WindTable(**{k: tuple(v) for k, v in words["table"].items()}) if words.get("table") else None,
        )
        if not wind.directions or not math.isfinite(wind.speed_at(wind.height)) or not wind.speed > 0:
            raise ValueError(f"wind {wind}")
        x, y, z = (float(value) for value in record.get("origin", (0.0, 0.0, 0.0)))
        return WindCase(folder, wind, str(record["crs"]), (x, y, z))
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError) as error:
        raise InputError(
            f"{folder}: is no exported wind case ({path.name}: {error}); make one by citystitch export --format "
            "openfoam --case wind"
        ) from None


def read_triangles(case: WindCase) -> Triangles:
    """Read the surface on which the wind is sampled.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    path = case.folder / "constant" / "triSurface" / f"{PEDESTRIAN}.obj"
    try:
        lines = path.read_text().splitlines()
        points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], np.float64)
        corners = np.array([line.split()[1:] for line in lines if line.startswith("f ")], np.int64) - 1
        if points.shape != (len(points), 3) or corners.shape != (len(corners), 3):
            raise ValueError("no triangles")
        if corners.min() < 0 or corners.max() >= len(points):
            raise ValueError("a vertex that is not there")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: is missing or damaged ({error}); export the case again") from None
    return Triangles(points + case.origin, corners)


def read_samples(case: WindCase, direction: float, triangles: Triangles) -> Sampled:
    """Read the speeds that OpenFOAM sampled after the last iteration that it wrote.

    Raises
    ------
    InputError
        If there are none, or they are not of this surface.
    """
    path = sampled_file(case, direction, f"U_{PEDESTRIAN}")
    table = read_table(path, 6)
    speed = _match(table[:, :3] + case.origin, np.linalg.norm(table[:, 3:], axis=1), triangles.centres)
    if np.isnan(speed).all():
        raise InputError(f"{path}: none of its {len(table)} samples is over a triangle of the case; run it again")
    return Sampled(speed, int(path.parent.name))


def sampled_file(case: WindCase, direction: float, name: str) -> Path:
    """Return the file of what was sampled last; InputError if nothing was."""
    folder = case.case_of(direction) / "postProcessing" / PEDESTRIAN
    times = [int(path.name) for path in folder.glob("*") if path.name.isdigit()] if folder.is_dir() else []
    if not times:
        raise InputError(
            f"{folder}: nothing was sampled yet for {direction:g} degrees; run {folder.parents[1]}/Allrun"
        )
    return folder / str(max(times)) / f"{name}.raw"


def read_table(path: Path, width: int) -> Floats:
    """Read rows of places and values, (n, width); InputError if they are not there."""
    try:
        table = np.loadtxt(path, np.float64, ndmin=2)
        if table.shape[1] != width or not np.isfinite(table).all():
            raise ValueError(f"rows of {table.shape[1]} numbers, expected {width} finite ones")
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path}: is missing or damaged ({error}); run the case again") from None
    return table


def _match(places: Floats, values: Floats, centres: Floats) -> Floats:
    """Give each centre (t, 3) the value of the place (n, 3) that is there; NaN where there is none."""
    from scipy.spatial import cKDTree

    distance, row = cKDTree(places).query(centres, distance_upper_bound=NEAR)
    found = np.full(len(centres), np.nan)
    known = np.isfinite(distance)
    found[known] = values[np.asarray(row)[known]]
    return found
