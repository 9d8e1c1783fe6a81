"""How roofs of planes fit their points: by method, and the worst buildings with what is known of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.citymodel import CityModel
from pipeline.data.roofs import ROOF_METHODS
from pipeline.quality.point_fidelity import HouseFidelity

WORST = 20  # houses that are listed
LEAST_POINTS = 8  # of a listed house
CLIPPED, COVERED, SPARSE = 0.2, 0.5, 1.0  # shares of the area, and points a m2, that are told as reasons


@dataclass
class RoofFits:
    """Collects the fit of buildings, block by block, and the houses of largest RMSE with their worst parts."""

    #: index into `ROOF_METHODS` of the buildings of each block
    method: list[NDArray[np.int8]] = field(default_factory=list)
    #: each (n, 4): number of points, RMSE (m), median distance (m) and share within 0.25 m of each
    values: list[NDArray[np.float64]] = field(default_factory=list)
    #: of a house: ``id``, ``method``, ``parts``, ``points``, ``rmse`` (m), ``within``, ``worst_part``, which adds
    #: most to the RMSE, its place ``x``, ``y`` (m), and ``why``, what is known of it
    worst: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self,
        model: CityModel,
        roof_method: NDArray[np.int8],
        fidelity: HouseFidelity,
        told: Mapping[str, Sequence[Any]],
    ) -> None:
        """Add buildings, all parts of each house among them; `told` comes from `building_facts.describe_roofs`."""
        self.method.append(roof_method)
        self.values.append(np.column_stack((fidelity.n_points, fidelity.rmse, fidelity.median, fidelity.within)))
        n, squares = fidelity.n_points, fidelity.n_points * np.nan_to_num(fidelity.rmse) ** 2
        names, house = np.unique(model.house, return_inverse=True)
        house = house.reshape(-1)
        total = np.bincount(house, n, minlength=len(names))
        rmse = np.sqrt(np.bincount(house, squares, minlength=len(names)) / np.maximum(total, 1))
        rmse[total < LEAST_POINTS] = 0.0
        order = np.argsort(-np.round(rmse, 3), kind="stable")
        for k in order[:WORST][rmse[order[:WORST]] > 0].tolist():
            parts = np.flatnonzero(house == k)
            row = int(parts[np.argmax(squares[parts])])
            self.worst.append(_describe(model, fidelity, told, parts, row))
        self.worst.sort(key=lambda one: (-one["rmse"], one["id"]))
        del self.worst[WORST:]

    def by_method(self) -> dict[str, dict[str, float]]:
        """Tell how each method fits.

        Returns
        -------
        dict
            By method: ``buildings`` (parts), ``points``, ``rmse`` over the points (m), ``median`` of the
            buildings' median distances (m), ``within``, the share of the points within 0.25 m. Those without
            points count as buildings alone.
        """
        method = np.concatenate([np.empty(0, np.int8), *self.method])
        values = np.concatenate([np.empty((0, 4)), *self.values])
        table: dict[str, dict[str, float]] = {}
        for code, name in enumerate(ROOF_METHODS):
            mine = values[method == code]
            n, rmse, median, within = mine[mine[:, 0] > 0].T
            if len(mine):
                table[name] = {"buildings": len(mine), "points": int(n.sum())}
            if len(n):
                table[name] |= {
                    "rmse": round(float(np.sqrt((n * rmse**2).sum() / n.sum())), 4),
                    "median": round(float(np.median(median)), 4),
                    "within": round(float((n * within).sum() / n.sum()), 4),
                }
        return table


def _describe(
    model: CityModel,
    fidelity: HouseFidelity,
    told: Mapping[str, Sequence[Any]],
    parts: NDArray[np.int64],
    row: int,
) -> dict[str, Any]:
    """Tell of a house of these parts, of which that of `row` adds most to its RMSE."""
    n = fidelity.n_points[parts]
    squares, near = n * np.nan_to_num(fidelity.rmse[parts]) ** 2, n * np.nan_to_num(fidelity.within[parts])
    x, y = model.polygons[row].representative_point().coords[0]
    return {
        "id": str(model.house[row]),
        "method": told["roof_method"][row],
        "parts": len(parts),
        "points": int(n.sum()),
        "rmse": round(float(np.sqrt(squares.sum() / n.sum())), 3),
        "within": round(float(near.sum() / n.sum()), 3),
        "worst_part": str(model.ids[row]),
        "x": round(x, 1),
        "y": round(y, 1),
        "why": _find_reasons(fidelity, told, row),
    }


def _find_reasons(fidelity: HouseFidelity, told: Mapping[str, Sequence[Any]], row: int) -> str:
    density, clipped = told["roof_density"][row], told["roof_clipped"][row]
    reasons = [
        (bool(told["roof_fallback"][row]), f"{told['roof_fallback'][row]}: one height"),
        (density < SPARSE, f"{density:.2f} points a m2"),
        (fidelity.coverage[row] < COVERED, f"points over {100 * fidelity.coverage[row]:.0f} % of it"),
        (clipped > CLIPPED, f"plane cut by its limits on {100 * clipped:.0f} %"),
        (fidelity.median[row] <= 0.25, "most points fit: façade points or what stands on the roof"),
        (abs(fidelity.bias[row]) > 0.5 * fidelity.rmse[row], f"{fidelity.bias[row]:+.1f} m in the mean"),
    ]
    found = [words for holds, words in reasons if holds]
    return "; ".join(found) or "points at several heights, which no plane fits"
