"""What is known of each building and of the whole model, for the export and the report (steps 1.7, 2.4)."""

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import has_building_class
from pipeline.city_model.city import City
from pipeline.city_model.heights import ROOF_SOURCES
from pipeline.city_model.roof_areas import block_heights, measure_roof_areas
from pipeline.data.citymodel import CityModel
from pipeline.data.pointcloud import PointCloud
from pipeline.data.roof_forms import ROOF_SHAPES
from pipeline.data.roofs import ROOF_FALLBACKS, ROOF_METHODS, is_flat
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


def describe_roofs(
    model: CityModel,
    roof_method: NDArray[np.int8],
    roof_fallback: NDArray[np.int8],
    roof_form: NDArray[np.int8],
    fidelity: HouseFidelity,
) -> dict[str, Sequence[object]]:
    """Attributes of each building's roof, where roofs of planes were looked for.

    Parameters
    ----------
    model : CityModel
        Buildings, all parts of each house among them.
    roof_method, roof_fallback, roof_form : int8, (n,)
        As of `City`.
    fidelity : HouseFidelity
        How the roofs fit their points.

    Returns
    -------
    dict of str to a sequence of n values
        Of the house: ``roof_method``; ``roof_fallback``, why it has one height, empty where its points tell so;
        ``roof_form``, the shape that it has by an attribute of its footprint, empty where it has none by that;
        ``roof_parts`` and ``roof_planes``, the numbers of parts and of different planes. Of the row:
        ``roof_median`` (m), ``roof_within`` (share of its points within 0.25 m), ``roof_density`` (points a m²),
        ``roof_clipped`` (share of the area where its plane is cut by its limits), ``roof_slope`` (degrees) and
        ``roof_azimuth`` (degrees from north, clockwise, downwards; None where flat), and ``lod12_height`` and
        ``lod13_height``, the heights (m) of its block models.
    """
    area = shapely.area(model.polygons)
    areas = measure_roof_areas(model.polygons, model.roofs)
    _, house = np.unique(model.house, return_inverse=True)
    house = house.reshape(-1)
    n_houses = int(house.max(initial=-1)) + 1
    planes = np.column_stack((house, model.roofs.plane, model.roofs.origin))
    different = np.unique(planes, axis=0)[:, 0].astype(np.int64)
    flat = is_flat(model.roofs)
    east, north = np.where(flat[:, None], 0.0, model.roofs.plane[:, :2]).T
    azimuth = np.degrees(np.arctan2(-east, -north)) % 360
    blocks = block_heights(model)
    return {
        "roof_method": [ROOF_METHODS[method] for method in roof_method.tolist()],
        "roof_fallback": [ROOF_FALLBACKS[why] for why in roof_fallback.tolist()],
        "roof_form": [ROOF_SHAPES[form] if form >= 0 else "" for form in roof_form.tolist()],
        "roof_parts": np.bincount(house, minlength=n_houses)[house].tolist(),
        "roof_planes": np.bincount(different, minlength=n_houses)[house].tolist(),
        "roof_median": _rounded(fidelity.median),
        "roof_within": _rounded(fidelity.within),
        "roof_density": _rounded(fidelity.n_points / area),
        "roof_clipped": _rounded((areas.at_low + areas.at_high) / area),
        "roof_slope": [round(value, 1) for value in np.degrees(np.arctan(np.hypot(east, north))).tolist()],
        "roof_azimuth": [
            None if level else round(value, 1) % 360
            for level, value in zip(flat.tolist(), azimuth.tolist(), strict=True)
        ],
        "lod12_height": blocks[:, 0].tolist(),
        "lod13_height": blocks[:, 1].tolist(),
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
