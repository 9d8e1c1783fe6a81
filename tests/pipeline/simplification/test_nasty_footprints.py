"""Difficult real footprints, group by group through steps 1.4 to 3.5: all sound, nothing lost unsaid."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.city_model.footprints import clean_footprints
from pipeline.city_model.heights import highest_wall_ground
from pipeline.columns.columns import lowest_gap
from pipeline.columns.layered import LayeredOptions, mesh_layers
from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roofs import flat_roofs
from pipeline.geometry.clearance import is_sound
from pipeline.plane_mesh.plane import mesh_plane
from pipeline.simplification.merge import MergedFootprints, merge_footprints
from tests.helpers.cities import city_of, hilly_dtm

MIN_AREA, TOLERANCE, CLEARANCE, MIN_HOLE_AREA, FLOOR = 5.0, 0.01, 1.0, 10.0, 0.1
# The group numbers of the file; gaps in them are as published.
GROUPS = [*range(1, 20), *range(57, 99), *range(141, 189), *range(199, 214)]
# A note of these kinds says that a footprint, or a part of one, is not there.
GONE = {
    "footprint-duplicate",
    "footprint-empty",
    "footprint-not-finite",
    "footprint-sliver",
    "footprint-too-small",
}

pytestmark = pytest.mark.shared


@cache
def read(path: Path) -> tuple[NDArray[np.object_], NDArray[np.int32]]:
    """Polygons of a file, in metres whatever CRS it states, and the group of each."""
    meta, _, blobs, fields = pyogrio.raw.read(path)
    names = dict(zip(meta["fields"], fields, strict=True))
    return shapely.from_wkb(blobs), names.get("group", np.zeros(len(blobs), np.int32))


@pytest.fixture
def nasty(shared_data: Path) -> tuple[NDArray[np.object_], NDArray[np.int32]]:
    return read(shared_data / "nasty_footprints.geojson")


def clean(polygons: NDArray[np.object_]) -> tuple[Footprints, tuple[Note, ...]]:
    ids = np.array([f"{row:04d}" for row in range(len(polygons))], dtype=np.str_)
    rows = Footprints(polygons, ids, np.full(len(polygons), np.nan))
    return clean_footprints(rows, min_area=MIN_AREA, tolerance=TOLERANCE)


def simplify(polygons: NDArray[np.object_]) -> tuple[Footprints, tuple[Note, ...], MergedFootprints]:
    cleaned, notes = clean(polygons)
    merged = merge_footprints(
        cleaned.polygons, clearance=CLEARANCE, min_hole_area=MIN_HOLE_AREA, floor=FLOOR, tolerance=TOLERANCE
    )
    return cleaned, notes, merged


def assert_promises(cleaned: Footprints, merged: MergedFootprints) -> None:
    assert shapely.is_valid(merged.polygons).all()
    assert is_sound(merged.polygons, FLOOR).all()
    distance = shapely.distance(merged.polygons[:, None], merged.polygons[None, :])
    assert (distance[~np.eye(len(distance), dtype=np.bool_)] >= CLEARANCE).all()
    rows = [row for members in merged.members for row in members.tolist()]
    assert sorted(rows) == list(range(len(cleaned.ids)))


def assert_nothing_lost(given: NDArray[np.object_], notes: tuple[Note, ...], merged: MergedFootprints) -> None:
    """Check that each footprint, and each part of one, is covered in one place at least or noted."""
    gone = {note.subject for note in notes if note.kind in GONE}
    city = shapely.union_all(merged.polygons)
    for row, geometry in enumerate(given):
        for part in shapely.get_parts(shapely.make_valid(geometry, method="structure")):
            covered = city.distance(part.representative_point()) < FLOOR
            assert covered or f"{row:04d}" in gone, f"footprint {row}: {part.wkt[:200]}"


@pytest.mark.parametrize("number", GROUPS)
def test_a_group_becomes_sound_keeps_its_buildings_and_is_meshed(
    number: int, nasty: tuple[NDArray[np.object_], NDArray[np.int32]]
) -> None:
    """Steps 2.1 and 3.1, and the volume over the plane: nothing is inverted."""
    polygons = nasty[0][nasty[1] == number]
    cleaned, notes, merged = simplify(polygons)
    assert_promises(cleaned, merged)
    assert_nothing_lost(polygons, notes, merged)
    # What merging covers, each building keeps but for the margins of the repairs.
    lost = shapely.union_all(cleaned.polygons).difference(shapely.union_all(merged.polygons)).area
    assert lost <= FLOOR * shapely.length(cleaned.polygons).sum()
    box = shapely.total_bounds(polygons)
    bounds = (float(box[0]) - 30, float(box[1]) - 30, float(box[2]) + 30, float(box[3]) + 30)
    plane, complete = mesh_plane(bounds, merged.polygons, mesh_size=10.0)
    assert complete
    expected = np.prod(np.subtract(bounds[2:], bounds[:2])) / (10**2 / 2)
    assert len(plane.triangles) < 20 * expected
    city = city_of(list(merged.polygons), [12.0 + 3 * k for k in range(len(merged.polygons))])
    dtm = hilly_dtm(tuple(np.floor(bounds)), relief=6.0)
    wall_ground = highest_wall_ground(city.polygons, dtm)
    roofed = dataclasses.replace(city, roofs=flat_roofs(np.maximum(city.roof, wall_ground + 2.0)))
    options = LayeredOptions(10.0, 10.0, 100.0 + float(roofed.roof.max(initial=0)), "columns", 0.003, 1e-8)
    columns, _ = mesh_layers(plane, dtm, roofed, wall_ground, bounds, options)
    assert lowest_gap(columns)[1] == 0


def test_the_groups_are_those_of_the_file(nasty: tuple[NDArray[np.object_], NDArray[np.int32]]) -> None:
    assert np.unique(nasty[1]).tolist() == GROUPS
    assert len(nasty[0]) == 352


def test_all_groups_together_merge_as_they_do_alone(nasty: tuple[NDArray[np.object_], NDArray[np.int32]]) -> None:
    cleaned, notes, merged = simplify(nasty[0])
    assert_promises(cleaned, merged)
    assert_nothing_lost(nasty[0], notes, merged)
    alone = [simplify(nasty[0][nasty[1] == number])[2].polygons for number in GROUPS]
    assert set(shapely.to_wkb(np.concatenate(alone))) == set(shapely.to_wkb(merged.polygons))
