"""Steps 1.6 and 2.3: ground and roof height of each building, and the roofs that terrain forces up."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.building_points import BuildingPoints
from pipeline.geometry.group_order import percentile_by_group
from pipeline.points_terrain.terrain import Dtm, sample_dtm

ROOF_SOURCES = ("points", "attribute", "default", "none")
WALL_SAMPLE = 0.5  # m, distance between the places on a wall where the terrain is looked up


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights of ``n`` buildings and where they come from."""

    #: (n,): absolute heights (m); `roof` is NaN where the source is "none"
    ground: NDArray[np.float64]
    roof: NDArray[np.float64]
    roof_source: NDArray[np.int8]  #: (n,): index into `ROOF_SOURCES`
    ground_from_dtm: NDArray[np.bool_]  #: (n,): true where a building had no ground points


def compute_building_heights(
    points: BuildingPoints,
    polygons: NDArray[np.object_],
    dtm: Dtm,
    *,
    ground_percentile: float,
    roof_percentile: float,
    given_height: NDArray[np.float64],
    default_height: float,
) -> Heights:
    """Compute ground and roof heights (paper, steps 1.6 and 2.3).

    Parameters
    ----------
    points : BuildingPoints
        Points of each building.
    polygons : object, (n,)
        Footprints, for the terrain at their centroid where there are no ground points.
    dtm : Dtm
        Terrain.
    ground_percentile, roof_percentile : float
        Percentiles of the ground and the roof points, linear between them (paper: 10 and 90).
    given_height : float64, (n,)
        Height above ground (m) for a building without roof points; NaN where none is known.
    default_height : float
        Height above ground (m) for a building with neither; 0 gives it none.
    """
    ground = percentile_by_group(points.ground_start, points.ground_z, ground_percentile)
    from_dtm = np.isnan(ground)
    centres = shapely.get_coordinates(shapely.centroid(polygons[from_dtm]))
    ground[from_dtm] = sample_dtm(dtm, centres)
    roof = percentile_by_group(points.roof_start, points.roof_z, roof_percentile)
    source = np.where(np.isnan(roof), 3, 0).astype(np.int8)
    use_given = np.isnan(roof) & (given_height > 0)
    roof[use_given] = (ground + given_height)[use_given]
    source[use_given] = 1
    if default_height > 0:
        use_default = np.isnan(roof)
        roof[use_default] = ground[use_default] + default_height
        source[use_default] = 2
    return Heights(ground, roof, source, from_dtm)


def highest_wall_ground(polygons: NDArray[np.object_], dtm: Dtm) -> NDArray[np.float64]:
    """Highest terrain along the walls of each building (m), looked up every half metre.

    Parameters
    ----------
    polygons : object, (n,)
        Footprints with their courtyards.
    dtm : Dtm
        Terrain.
    """
    xy, polygon = shapely.get_coordinates(shapely.segmentize(polygons, WALL_SAMPLE), return_index=True)
    highest = np.full(len(polygons), -np.inf)
    np.maximum.at(highest, polygon, sample_dtm(dtm, xy))
    return highest


def raise_low_roofs(
    roof: NDArray[np.float64], wall_ground: NDArray[np.float64], *, clearance: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Raise each roof to `clearance` (m) above the highest terrain at its walls.

    A roof below the terrain on the uphill side would turn cells over. Returns the roofs and which were
    raised.
    """
    floor = wall_ground + clearance
    low = roof < floor
    return np.where(low, floor, roof), low
