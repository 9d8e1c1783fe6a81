"""How roofs of planes fit their points: by method, and the worst buildings with what is known of them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.citymodel import CityModel
from pipeline.data.roofs import ROOF_METHODS
from pipeline.quality.point_fidelity import HouseFidelity

WORST = 20  # buildings that are listed
LEAST_POINTS = 8  # of a listed building
CLIPPED, COVERED, SPARSE = 0.2, 0.5, 1.0  # shares of the area, and points a m2, that are told as reasons


@dataclass
class RoofFits:
    """Collects the fit of buildings, block by block, and the worst of them."""

    method: list[NDArray[np.int8]] = field(default_factory=list)
    values: list[NDArray[np.float64]] = field(default_factory=list)
    worst: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self,
        model: CityModel,
        roof_method: NDArray[np.int8],
        fidelity: HouseFidelity,
        told: dict[str, Sequence[object]],
    ) -> None:
        """Add buildings; `told` are their attributes as from `building_facts.describe_roofs`."""
        self.method.append(roof_method)
        self.values.append(np.column_stack((fidelity.n_points, fidelity.rmse, fidelity.median, fidelity.within)))
        rmse = np.where(fidelity.n_points >= LEAST_POINTS, np.nan_to_num(fidelity.rmse), 0.0)
        for row in np.argsort(-rmse, kind="stable")[:WORST].tolist():
            if rmse[row] > 0:
                self.worst.append(_describe(model, fidelity, told, row))
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
    model: CityModel, fidelity: HouseFidelity, told: dict[str, Sequence[object]], row: int
) -> dict[str, Any]:
    x, y = model.polygons[row].representative_point().coords[0]
    return {
        "id": str(model.ids[row]),
        "x": round(x, 1),
        "y": round(y, 1),
        "method": told["roof_method"][row],
        "points": int(fidelity.n_points[row]),
        "rmse": round(float(fidelity.rmse[row]), 3),
        "median": round(float(fidelity.median[row]), 3),
        "within": round(float(fidelity.within[row]), 3),
        "why": _find_reasons(fidelity, told, row),
    }


def _find_reasons(fidelity: HouseFidelity, told: dict[str, Sequence[Any]], row: int) -> str:
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
    return "; ".join(found) or "points spread about its plane"
