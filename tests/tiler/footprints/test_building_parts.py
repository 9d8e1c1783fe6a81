"""Parts of buildings of OpenStreetMap: each place has one footprint, whatever the order of the file (step 1.2)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roof_forms import ROOF_SHAPES, SHAPE
from tests.tiler.vectors.test_vectors import BOX, X, Y, read, square, write


def box(x: float, y: float, width: float, height: float) -> Any:
    return shapely.box(X + x, Y + y, X + x + width, Y + y + height)


# A church: its outline; a nave with a gable; a tower over its end, from 12 m up; a vestry that is lower; a wall.
CHURCH: dict[str, tuple[Any, dict[str, str]]] = {
    "way/1": (box(10, 10, 40, 20), {"building": "church", "height": "50", "roof:shape": "gabled"}),
    "way/2": (box(10, 10, 30, 15), {"building:part": "yes", "height": "20", "roof:shape": "gabled"}),
    "way/3": (box(36, 10, 8, 8), {"building:part": "tower", "height": "50", "min_height": "12"}),
    "way/4": (box(12, 12, 4, 4), {"building:part": "yes", "height": "8"}),
    "way/5": (box(60, 60, 10, 10), {"building": "yes", "height": "9"}),
    "way/6": (box(65, 50, 10, 12), {"building:part": "no", "building": "shed"}),
}
TAGS = ("building", "building:part", "height", "min_height", "roof:shape")


def write_osm(path: Path, things: dict[str, tuple[Any, dict[str, str]]], *, order: int = 1) -> Path:
    names = list(things)[::order]
    columns = {tag: np.array([things[name][1].get(tag) for name in names], object) for tag in TAGS}
    fields = {"@id": np.array(names, object), **columns}
    return write(path, [things[name][0] for name in names], fields)


def by_id(footprints: Footprints) -> dict[str, Any]:
    return dict(zip(footprints.ids.tolist(), footprints.polygons, strict=True))


def parts_told(notes: tuple[Note, ...]) -> dict[str, str]:
    return {note.kind: note.detail for note in notes if "parts" in note.kind or "replaced" in note.kind}


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("batch", [1, 100])
def test_the_highest_part_has_the_place(tmp_path: Path, order: int, batch: int) -> None:
    footprints, notes = read(write_osm(tmp_path / "a.gpkg", CHURCH, order=order), batch=batch)
    found = by_id(footprints)
    assert sorted(found) == ["way/1", "way/2", "way/3", "way/5", "way/6"]  # the vestry is below the nave
    tower = CHURCH["way/3"][0]
    assert shapely.equals(found["way/3"], tower)
    assert shapely.equals(found["way/2"], box(10, 10, 30, 15).difference(tower))
    rest = box(10, 10, 40, 20).difference(box(10, 10, 30, 15)).difference(tower)
    assert shapely.equals(found["way/1"], rest)
    assert shapely.equals(found["way/5"], CHURCH["way/5"][0])  # touched by no part: a shed is none
    assert found["way/1"].area + found["way/2"].area + tower.area == pytest.approx(800)
    np.testing.assert_array_equal(footprints.given_height, [50, 20, 50, 9, np.nan])
    shapes = ["" if np.isnan(code) else ROOF_SHAPES[int(code)] for code in footprints.forms[:, SHAPE].tolist()]
    assert shapes == ["", "gabled", "", "", ""]  # the outline has lost more than a fifth of its area
    assert parts_told(notes) == {
        "footprint-parts": "2 parts of buildings (building:part) are taken one by one",
        "footprint-parts-covered": "1 parts lie below higher ones and are left out",
        "footprint-parts-raised": "1 parts begin above the ground (min_height): they are taken down to it",
        "footprint-outlines-of-parts": "1 outlines keep what no part of theirs covers",
    }


def test_an_outline_that_is_all_parts_is_left_out(tmp_path: Path) -> None:
    """What is left is 0.3 m wide, or 3 m2."""
    things: dict[str, tuple[Any, dict[str, str]]] = {
        "way/1": (box(10, 10, 20, 20.3), {"building": "yes"}),
        "way/2": (box(10, 10, 20, 10), {"building:part": "yes"}),
        "way/3": (box(10, 20, 20, 10).difference(box(10, 20, 1, 3)), {"building:part": "yes"}),
    }
    footprints, notes = read(write_osm(tmp_path / "a.gpkg", things))
    assert footprints.ids.tolist() == ["way/2", "way/3"]
    assert parts_told(notes)["footprint-outlines-replaced"].startswith("1 of these keep nothing")


def test_without_heights_the_smaller_part_has_the_place(tmp_path: Path) -> None:
    things: dict[str, tuple[Any, dict[str, str]]] = {
        "way/2": (box(10, 10, 20, 10), {"building:part": "yes"}),
        "way/3": (box(12, 12, 3, 3), {"building:part": "yes"}),
        "way/4": (box(20, 10, 5, 10), {"building:part": "yes", "height": "3"}),
    }
    found = by_id(read(write_osm(tmp_path / "a.gpkg", things))[0])
    assert found["way/3"].area == 9
    assert found["way/4"].area == 50
    assert found["way/2"].area == 200 - 50 - 9


def test_a_part_takes_nothing_from_the_house_beside_its_own(tmp_path: Path) -> None:
    things: dict[str, tuple[Any, dict[str, str]]] = {
        "way/1": (box(10, 10, 20, 10), {"building": "yes"}),
        "way/2": (box(15, 10, 20, 10), {"building:part": "yes", "building": "yes"}),
        "way/3": (box(34, 10, 10, 10), {"building": "yes"}),
    }
    found = by_id(read(write_osm(tmp_path / "a.gpkg", things))[0])
    assert [found[name].area for name in sorted(found)] == [50, 200, 100]


def test_an_invalid_part_and_data_that_are_not_of_osm(tmp_path: Path) -> None:
    bow = shapely.Polygon([(X + 10, Y + 10), (X + 20, Y + 20), (X + 20, Y + 10), (X + 10, Y + 20)])
    things: dict[str, tuple[Any, dict[str, str]]] = {
        "way/1": (box(10, 10, 10, 10), {"building": "yes"}),
        "way/2": (bow, {"building:part": "yes"}),
    }
    found = by_id(read(write_osm(tmp_path / "a.gpkg", things))[0])
    assert found["way/1"].area == pytest.approx(50)
    fields = {"id": ["a", "b"], "building:part": ["", "yes"]}
    path = write(tmp_path / "b.gpkg", [square(10, 10, 20), square(12, 12, 5)], fields)
    assert by_id(read(path)[0])["a"].area == 400


def test_a_footprint_depends_on_no_region(tmp_path: Path) -> None:
    """A part beyond the region is taken from an outline on its border."""
    path = write_osm(tmp_path / "a.gpkg", CHURCH)
    small = by_id(read(path, bounds=(X, Y, X + 12, Y + 90))[0])
    assert sorted(small) == ["way/1", "way/2"]
    large = by_id(read(path, bounds=BOX)[0])
    assert all(shapely.equals_identical(small[name], large[name]) for name in small)


@pytest.mark.parametrize("seed", range(5))
def test_places_have_one_footprint(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    things: dict[str, tuple[Any, dict[str, str]]] = {}
    for k in range(30):
        outline = box(*rng.uniform(5, 60, 2), *rng.uniform(3, 25, 2))
        tags = {"building:part": "yes", "height": str(int(rng.integers(1, 5)))}
        things[f"way/{k + 1}"] = outline, tags if k else {"building": "yes"}
    things["way/1"] = box(0, 0, 95, 95), {"building": "yes"}
    polygons: NDArray[np.object_] = read(write_osm(tmp_path / "a.gpkg", things))[0].polygons
    assert shapely.area(polygons).sum() == pytest.approx(shapely.union_all(polygons).area, rel=1e-9)
    assert shapely.union_all(polygons).area > 0.97 * 95 * 95
