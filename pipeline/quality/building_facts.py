"""What is known of each building and of the whole model, for the export and the report (steps 1.7, 2.4)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.city_model.building_points import has_building_class
from pipeline.city_model.city import City
from pipeline.city_model.heights import ROOF_SOURCES
from pipeline.data.citymodel import CityModel
from pipeline.data.pointcloud import PointCloud
from pipeline.points_terrain.terrain import Dtm
from pipeline.quality.point_fidelity import KINDS, HouseFidelity, PointFidelity, measure_fidelity, measure_houses
from pipeline.roofs.roof_points import locate_roof_points

MOVED = 0.005  # m; a roof that moved less is told as it was measured


def describe_buildings(cloud: PointCloud, city: City) -> dict[str, Sequence[object]]:
    """Attributes of each building: how well its roof fits its points, and what was done to it.

    Parameters
    ----------
    cloud : PointCloud
        Points of the region.
    city : City
        The buildings.

    Returns
    -------
    dict of str to a sequence of n values
        ``roof_points``, ``roof_rmse`` (m), ``roof_coverage`` (0 to 1), ``roof_source``, ``roof_moved`` (m, by
        grouping and raising) and ``changes``, words out of "merged", "split", "defaulted", "moved".
    """
    model = city.model
    points = locate_roof_points(cloud, model.polygons, building_class=has_building_class(cloud))
    fidelity = measure_houses(points, model.polygons, model.roofs)
    return report_buildings(model, city.roof_source, city.measured_roof, fidelity)


def report_buildings(
    model: CityModel,
    roof_source: NDArray[np.int8],
    measured_roof: NDArray[np.float64],
    fidelity: HouseFidelity,
) -> dict[str, Sequence[object]]:
    """Attributes of each building, as `describe_buildings` gives them, of what was measured before.

    Parameters
    ----------
    model : CityModel
        The buildings.
    roof_source : int8, (n,)
        Index into `heights.ROOF_SOURCES`.
    measured_roof : float64, (n,)
        Roof heights (m) before roofs were grouped and raised.
    fidelity : HouseFidelity
        How the roofs fit their points.
    """
    moved = model.roof - measured_roof
    sources = [ROOF_SOURCES[source] for source in roof_source]
    changes = [
        [
            word
            for word, holds in (
                ("merged", len(names) > 1),
                ("split", name != house),
                ("defaulted", source != "points"),
                ("moved", abs(by) > MOVED),
            )
            if holds
        ]
        for names, name, house, source, by in zip(
            model.members, model.ids, model.house, sources, moved, strict=True
        )
    ]
    return {
        "roof_source": sources,
        "roof_points": fidelity.n_points.tolist(),
        "roof_rmse": _rounded(fidelity.rmse),
        "roof_coverage": _rounded(fidelity.coverage),
        "roof_moved": _rounded(moved),
        "changes": changes,
    }


def measure_model(
    cloud: PointCloud, dtm: Dtm, city: City, footprints: NDArray[np.object_]
) -> dict[str, dict[str, float]]:
    """Distance of the point cloud to the city model, by kind of point.

    Parameters
    ----------
    cloud : PointCloud
        Points of the region.
    dtm : Dtm
        Terrain.
    city : City
        The model.
    footprints : object, (f,)
        Clean footprints before simplification.

    Returns
    -------
    dict
        ``roof``, ``missed``, ``ground`` and ``swallowed`` as in `point_fidelity.PointFidelity`, each with ``n``,
        ``rmse``, ``p50``, ``p95`` and ``bias`` (m).
    """
    return fidelity_table(
        measure_fidelity(
            cloud,
            dtm,
            city.model.polygons,
            city.model.roofs,
            footprints=footprints,
            building_class=has_building_class(cloud),
        )
    )


def fidelity_table(found: PointFidelity) -> dict[str, dict[str, float]]:
    """Table of the fidelity for the report, as `measure_model` returns it; values without points are left out."""
    table = {}
    for name in KINDS:
        residuals = getattr(found, name)
        values = {key: float(getattr(residuals, key)) for key in ("rmse", "p50", "p95", "bias")}
        known = {key: round(value, 4) for key, value in values.items() if np.isfinite(value)}
        table[name] = {"n": residuals.n} | known
    return table


def _rounded(values: NDArray[np.float64]) -> list[object]:
    return [round(float(value), 3) for value in values]
