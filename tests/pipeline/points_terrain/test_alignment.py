"""Footprints beside the roofs of a cloud: the shift measured, told and applied."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely

from pipeline.points_terrain.alignment import LEAST_HOUSES, REACH, best_shift, describe_shift, score_shifts
from tiler.config.config import make_config
from tiler.interface.synth import write_city
from tiler.workflow.run import run
from tiler.workflow.single_tile import run_alone

HOUSES = [
    shapely.box(x, y, x + 12 + k, y + 9) for k, (x, y) in enumerate([(20, 20), (60, 22), (25, 60), (70, 64)])
]


def points(shift: tuple[float, float] = (0.0, 0.0), step: float = 0.5) -> tuple[Any, Any]:
    rng = np.random.default_rng(1)
    grid = np.arange(0.0, 110.0, step)
    xy = np.column_stack([axis.ravel() for axis in np.meshgrid(grid, grid)]) + rng.uniform(
        0, step, (len(grid) ** 2, 2)
    )
    roof = shapely.contains_xy(shapely.union_all(HOUSES), xy - shift)
    return xy, roof


@pytest.mark.parametrize("shift", [(3.1, -1.2), (-0.8, 0.6), (0.0, -5.5)])
def test_a_shift_is_found_to_a_quarter_of_a_metre(shift: tuple[float, float]) -> None:
    scores, n = score_shifts(np.array(HOUSES, object), *points(shift))
    found = best_shift(scores, n, len(HOUSES))
    assert found is not None
    np.testing.assert_allclose(found, shift, atol=0.25)


def test_outlines_wider_or_narrower_than_roofs_are_in_the_middle() -> None:
    for margin in (-1.5, 2.0):
        polygons = shapely.buffer(np.array(HOUSES, object), margin, join_style="mitre")
        scores, n = score_shifts(polygons, *points())
        found = best_shift(scores, n, len(HOUSES))
        assert found is not None
        assert np.hypot(*found) < 0.5


def test_nothing_is_found_of_too_few_houses_or_beyond_the_reach() -> None:
    scores, n = score_shifts(np.array(HOUSES[:2], object), *points((2.0, 0.0)))
    assert best_shift(scores, n, LEAST_HOUSES - 1) is None
    scores, n = score_shifts(np.array(HOUSES, object), *points((REACH + 6, 0.0)))
    assert best_shift(scores, n, len(HOUSES)) is None
    scores, n = score_shifts(np.array(HOUSES, object), np.empty((0, 2)), np.empty(0, bool))
    assert (n, best_shift(scores, n, len(HOUSES))) == (0, None)


def test_scores_of_parts_add_up_in_any_order() -> None:
    xy, roof = points((1.0, 1.0))
    whole = score_shifts(np.array(HOUSES, object), xy, roof)
    backwards = score_shifts(np.array(HOUSES[::-1], object), xy[::-1], roof[::-1])
    parts = [score_shifts(np.array([house], object), xy, roof) for house in HOUSES]
    for scores, n in (backwards, (sum(scores for scores, _ in parts), sum(n for _, n in parts))):
        np.testing.assert_array_equal(scores, whole[0])
        assert n == whole[1]


def test_where_to_is_told_from_the_roofs() -> None:
    assert describe_shift((0.0, -2.0)) == "2.0 m to the north of"
    assert describe_shift((-1.0, -1.0)) == "1.4 m to the north-east of"


@pytest.fixture(scope="module")
def moved_city(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A city on four tiles whose footprints lie 2 m east and 1.5 m north of its roofs."""
    folder = tmp_path_factory.mktemp("moved")
    files = write_city(folder / "city", size=300, buildings=25, density=2.0)
    meta, _, blobs, columns = pyogrio.raw.read(files.footprints)
    moved = shapely.transform(shapely.from_wkb(blobs), lambda xy: xy + np.array([2.0, 1.5]))
    path = folder / "moved.gpkg"
    pyogrio.raw.write(
        path, shapely.to_wkb(moved), columns, list(meta["fields"]), geometry_type="Polygon", crs=meta["crs"]
    )
    return {
        "pointcloud": [str(path) for path in files.clouds],
        "footprints": str(path),
        "true": str(files.footprints),
        "tile_size": 150.0,
        "domain_height": 60.0,
    }


def corners_of(out: Path) -> dict[str, Any]:
    """South-western corner of each building that lies well within the region, by id."""
    city = json.loads((out / "citymodel-full.city.json").read_text())
    vertices = np.array(city["vertices"]) * city["transform"]["scale"] + city["transform"]["translate"]
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    used: dict[str, list[int]] = {}
    for name, item in city["CityObjects"].items():
        mine = used.setdefault(item.get("parents", [name])[0], [])
        mine += [row for shape in item.get("geometry", []) for row in flatten(shape["boundaries"])]
    places = {name: vertices[rows, :2] for name, rows in used.items() if rows}
    return {name: xy.min(axis=0) for name, xy in places.items() if (xy > low + 5).all() and (xy < high - 5).all()}


def flatten(item: Any) -> Any:
    if isinstance(item, int):
        yield item
    else:
        for part in item:
            yield from flatten(part)


def mesh(city: dict[str, Any], out: Path, **options: Any) -> dict[str, Any]:
    given = {name: value for name, value in city.items() if name != "true"} | options
    return run(make_config(given | {"out": str(out)}))


def test_a_run_tells_the_shift_and_aligns_where_asked_to(moved_city: dict[str, Any], tmp_path: Path) -> None:
    told = mesh(moved_city, tmp_path / "told")
    found = told["georeference"]["alignment"]
    np.testing.assert_allclose(found["shift"], (-2.0, -1.5), atol=0.25)
    assert found["applied"] is False
    assert told["notes"]["footprints-misaligned"]["count"] == 1
    assert any("2.5 m to the north-east of the roofs" in text for text in told["messages"])
    aligned = mesh(moved_city, tmp_path / "aligned", align=True)
    assert aligned["georeference"]["alignment"]["applied"] is True
    true = mesh(moved_city, tmp_path / "true", footprints=moved_city["true"])
    assert true["georeference"]["alignment"]["applied"] is False
    assert "footprints-misaligned" not in true["notes"]
    corners = {name: corners_of(tmp_path / name) for name in ("told", "aligned", "true")}
    inner = sorted(corners["true"].keys() & corners["aligned"].keys() & corners["told"].keys())
    assert len(inner) > 15
    for name in inner:
        np.testing.assert_allclose(corners["aligned"][name], corners["true"][name], atol=0.3)
        np.testing.assert_allclose(corners["told"][name], corners["true"][name] + (2.0, 1.5), atol=0.02)
    # a tile alone takes the shift of the whole region
    config = make_config(
        {name: value for name, value in moved_city.items() if name != "true"}
        | {"out": str(tmp_path / "aligned"), "align": True}
    )
    tile = sorted(aligned["tiles"])[0]
    alone = run_alone(config, tile)
    assert alone.read_bytes() == (tmp_path / "aligned" / "mesh" / f"{tile}.vtu").read_bytes()
