"""Towns of blocks with sloped roofs: sheds, gables, and halves whose roofs cross, on hills."""

from dataclasses import dataclass

import numpy as np
import shapely

from pipeline.columns.adaptive import AdaptiveOptions
from pipeline.columns.spacing import SpacingLimits
from pipeline.data.citymodel import CityModel
from pipeline.data.mesh import PlaneMesh
from pipeline.data.roofs import Roofs, Weld
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.points_terrain.terrain import Dtm
from tests.helpers.cities import city_of, crowded_blocks, hilly_dtm

BOUNDS = (0.0, 0.0, 200.0, 200.0)
OPTIONS = AdaptiveOptions(10.0, 80.0, SpacingLimits(0.1, 0.8), 0.8, 1, weld=Weld())


@dataclass(frozen=True, eq=False)
class SlopedTown:
    """Buildings with sloped roofs, their plane mesh and terrain."""

    model: CityModel
    plane: PlaneMesh
    dtm: Dtm


def sloped_town(seed: int, n: int = 30, *, steepest: float = 1.6) -> SlopedTown:
    """Make a town; walls have no least distance, so that some cells are poor."""
    rng = np.random.default_rng(seed)
    parts: list[shapely.Polygon] = []
    rows: list[list[float]] = []
    for block in crowded_blocks(BOUNDS, n, seed=seed):
        middle = np.round(shapely.get_coordinates(block.centroid)[0])
        height, slope = rng.uniform(5, 25), rng.uniform(0.2, steepest)
        axis, kind = int(rng.integers(2)), int(rng.integers(4))
        slopes = [(0.0,), (slope,), (slope, -slope), (rng.uniform(-1, 1), rng.uniform(-1, 1))][kind]
        for side, tilt in zip((-1, 1), slopes, strict=False):
            low, high = np.array(BOUNDS[:2]) - 1, np.array(BOUNDS[2:]) + 1
            if len(slopes) == 2:
                (high if side < 0 else low)[axis] = middle[axis]
            for part in shapely.get_parts(block.intersection(shapely.box(*low, *high))):
                if part.geom_type == "Polygon" and part.area > 1:
                    parts.append(shapely.orient_polygons(part))
                    up = height + (rng.uniform(-3, 3) if kind == 3 else 0)
                    slope_xy = (tilt, 0.0) if axis == 0 else (0.0, tilt)
                    rows.append([*slope_xy, up, *middle, up - 6 * (tilt != 0), up + 6 * (tilt != 0)])
    table = np.array(rows)
    city = city_of(parts, [0.0] * len(parts))
    roofs = Roofs(table[:, :3].copy(), table[:, 3:5].copy(), table[:, 5:].copy())
    model = CityModel(city.polygons, city.ids, city.numbers, city.ground, roofs, city.members, city.house)
    plane, _ = mesh_plane(BOUNDS, model.polygons, mesh_size=10.0, min_angle=28, refinements=1, passes=4)
    return SlopedTown(model, plane, hilly_dtm(BOUNDS, relief=6.0, noise=0.1))
