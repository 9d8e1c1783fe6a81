"""Compile the kernels of roofs of planes, which `citystitch kernels` leaves out; run as a program."""

import dataclasses

import shapely

from tests.helpers.cities import cloud_over
from tests.pipeline.columns.test_tile import BOUNDS, footprints_of
from tests.pipeline.simplification.test_simplify import PLANAR, planar_city

if __name__ == "__main__":
    house = shapely.box(1020, 2020, 1032, 2040)
    planes = dataclasses.replace(PLANAR, roofs="planes")
    planar_city(footprints_of(house), cloud_over(BOUNDS, [(house, 12.0)]), options=planes)
