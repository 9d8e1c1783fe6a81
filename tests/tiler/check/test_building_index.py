"""City models larger than memory: JSON read member by member, buildings by number and place."""

import json
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.data.citymodel import CityModel, number_ids
from pipeline.data.errors import InputError
from pipeline.data.roofs import Roofs, flat_roofs, roof_heights
from tiler.check.check import _in_order
from tiler.citymodels import building_index
from tiler.citymodels.building_index import index_buildings
from tiler.citymodels.cityjson import write_city_blocks
from tiler.store import json_stream
from tiler.store.json_stream import iterate_elements, iterate_members, read_members
from tiler.store.run_folder import RunRecord

INTEGERS = st.integers(-(2**62), 2**62)
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=5)
LEAVES = st.none() | st.booleans() | INTEGERS | st.floats(allow_nan=False, allow_infinity=False) | TEXT
DOCUMENTS = st.dictionaries(
    st.text("abc", min_size=1, max_size=3),
    st.recursive(LEAVES, lambda inner: st.lists(inner) | st.dictionaries(TEXT, inner), max_leaves=8),
    max_size=5,
)


def streamed(path: Path) -> Any:
    """Read an object by its members, arrays and objects in it by theirs."""
    found, large = read_members(path, lambda _name: False)
    for name, kind in large.items():
        found[name] = (
            list(iterate_elements(path, name)) if kind == "start_array" else dict(iterate_members(path, name))
        )
    return found


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(DOCUMENTS, st.sampled_from([None, 0, 2]), st.booleans())
def test_a_document_is_what_json_makes_of_it(
    tmp_path: Path, document: dict[str, Any], indent: int | None, ascii_only: bool
) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(document, indent=indent, ensure_ascii=ascii_only), encoding="utf-8")
    assert streamed(path) == document
    assert read_members(path, lambda _name: True) == (document, {})


def test_what_is_no_json_is_an_error_wherever_it_breaks(tmp_path: Path) -> None:
    text = '{"a": [1, {"x": [2]}], "b": {"c": 3.5, "d": "e"}, "f": -4}'
    path = tmp_path / "a.json"
    broken = [text[:end] for end in range(len(text))]
    broken += [text.replace('"e"', '"\\udcc3"')]  # a byte of a path that is no text, which yajl does not take
    broken += [text + "}", text.replace(":", ";"), text.replace('"b"', "7"), text.replace("],", "] ]")]
    for content in (*broken, "[1]", "3", text.replace("3.5", "NaN"), text.replace("2", "[" * 200 + "]" * 200)):
        path.write_text(content)
        with pytest.raises(InputError, match=r"a\.json: (is no JSON|nests deeper)"):
            streamed(path)
    with pytest.raises(InputError, match="cannot be read"):
        streamed(tmp_path / "none.json")


def test_what_is_skipped_is_not_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(json_stream.OPTIONS, "buf_size", 1000)
    path = tmp_path / "a.json"
    path.write_text('{"a": [' + "7, " * 100_000 + '7], "b": {"c": [1]}, "d": "e", "f": 2}')
    tracemalloc.start()
    found, large = read_members(path, lambda _name: False)
    assert sum(iterate_elements(path, "a")) == 700_007
    assert tracemalloc.get_traced_memory()[1] < 50_000
    tracemalloc.stop()
    assert (found, large) == ({"d": "e", "f": 2}, {"a": "start_array", "b": "start_map"})


def octagons(n: int) -> Iterator[tuple[CityModel, dict[str, Any]]]:
    """A grid of buildings, every third one with a courtyard, in blocks."""
    turn = np.linspace(0, 2 * np.pi, 9)[:-1]
    ring = np.column_stack((np.cos(turn), np.sin(turn)))
    for start in range(0, n, 1000):
        k = np.arange(start, min(start + 1000, n))
        middle = np.column_stack((k % 100, k // 100)) * 20.0 + [150_000, 460_000]
        outer = np.round(middle[:, None] + 8 * ring, 3)
        inner = np.round(middle[:, None] + 2 * ring, 3)
        polygons = np.array(
            [shapely.Polygon(o, [i] if j % 3 == 0 else []) for j, o, i in zip(k, outer, inner, strict=True)]
        )
        ids = np.array([f"b{j:06d}" for j in k])
        height = (3.0 + k % 7).astype(np.float64)
        yield CityModel(polygons, ids, number_ids(ids), height / 8, flat_roofs(height), ((),) * len(k), ids), {}


def write(path: Path, n: int) -> Path:
    write_city_blocks(path, octagons(n), crs="EPSG:28992", bounds=(150_000, 460_000, 0, 160_000, 470_000, 100))
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "c.city.json", 1500)


def test_buildings_are_those_of_the_file_whatever_its_layout(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(building_index, "BLOCK", 64)
    models = [model for model, _ in octagons(1500)]
    numbers = np.concatenate([model.numbers for model in models])
    order = np.argsort(numbers)
    document = json.loads(path.read_text())
    other = tmp_path / "other.json"
    other.write_text(json.dumps(dict(sorted(document.items(), reverse=True)), indent=3))
    assert list(json.loads(other.read_text())) != list(document)
    for file in (path, other):
        with index_buildings(file) as index:
            found = index.take(np.arange(len(index)))
        np.testing.assert_array_equal(found.numbers, numbers[order])
        np.testing.assert_array_equal(found.roof, np.concatenate([model.roof for model in models])[order])
        np.testing.assert_array_equal(found.ground, np.concatenate([model.ground for model in models])[order])
        expected = np.concatenate([model.polygons for model in models])[order]
        assert shapely.equals_exact(shapely.normalize(found.footprints), shapely.normalize(expected), 1e-6).all()


def test_buildings_are_found_by_place_and_number(path: Path) -> None:
    rng = np.random.default_rng(3)
    with index_buildings(path) as index:
        every = index.take(np.arange(len(index)))
        boxes = shapely.bounds(every.footprints)
        for _ in range(50):
            low = rng.uniform([149_900, 459_900], [152_100, 460_400])
            (west, south), (east, north) = low.tolist(), (low + rng.uniform(0, 90, 2)).tolist()
            meets = (boxes[:, :2] <= [east, north]).all(axis=1) & (boxes[:, 2:] >= [west, south]).all(axis=1)
            near = index.find_near((west, south, east, north))
            assert set(np.flatnonzero(meets)) <= set(near)
            # Boxes are rounded to a few hundredths of a metre.
            assert (boxes[near, :2] <= np.array([east, north]) + 0.1).all()
            assert (boxes[near, 2:] >= np.array([west, south]) - 0.1).all()
            some = index.take(near)
            assert shapely.equals_exact(some.footprints, every.footprints[near], 0).all()
        # Boxes that touch in a corner meet, whatever is rounded.
        for row, (west, south, east, north) in enumerate(boxes[:200].tolist()):
            assert row in index.find_near((east, north, east + 1, north + 1))
            assert row in index.find_near((west - 1, south - 1, west, south))
        asked = np.array([every.numbers[7], -1, every.numbers[0], 2**52 + 1])
        assert index.find_rows(asked).tolist() == [7, -1, 0, -1]


def test_a_city_model_without_buildings(tmp_path: Path) -> None:
    with index_buildings(write(tmp_path / "none.json", 0)) as index:
        assert len(index) == 0
        assert index.find_rows(np.array([3])).tolist() == [-1]
        assert index.find_near((0, 0, 1e6, 1e6)).tolist() == []
        assert len(index.take(np.empty(0, np.int64))) == 0


def test_sloped_roofs_are_read_as_they_were_given(tmp_path: Path) -> None:
    ids = np.array(["flat", "shed", "gutter"])
    roofs = Roofs(
        np.array([[0, 0, 9.0], [0.5, -0.1 / 3, 8.123456789], [0.3, 0, 12.0]]),
        np.array([[0, 0], [150_012.0, 460_003.0], [150_031.0, 460_004.0]]),
        np.array([[9.0, 9.0], [6.5, 11.25], [11.8, 30.0]]),
    )
    boxes = shapely.box(150_000 + 20 * np.arange(3), [460_000] * 3, 150_010 + 20 * np.arange(3), [460_008] * 3)
    model = CityModel(boxes, ids, np.array([3, 1, 2]), np.zeros(3), roofs, ((),) * 3, ids)
    file = tmp_path / "a.json"
    write_city_blocks(file, [(model, {})], crs="EPSG:28992", bounds=(150_000, 460_000, 0, 160_000, 470_000, 100))
    with index_buildings(file) as index:
        found = index.take(np.arange(3))
    order = [1, 2, 0]
    assert found.numbers.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(found.roof, model.roof[order])
    for name in ("plane", "origin", "limits"):
        np.testing.assert_array_equal(getattr(found.roofs, name), getattr(roofs, name)[order])
    height = roof_heights(
        found.roofs, np.array([0, 2]), np.array([[150_014.0, 460_003.0], [150_001.0, 460_001.0]])
    )
    assert height.tolist() == [9.123456789, 9.0]


@pytest.mark.long
def test_memory_is_a_hundred_bytes_a_building(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building_index, "BLOCK", 256)
    monkeypatch.setitem(json_stream.OPTIONS, "buf_size", 10_000)
    peaks = []
    for n in (1000, 3000):
        file = write(tmp_path / f"{n}.json", n)
        tracemalloc.start()
        with index_buildings(file) as index:
            assert len(index) == n
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert (peaks[1] - peaks[0]) / 2000 < 150


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "vertices": (lambda model: model.pop("vertices"), "a field is missing or wrong"),
    "no array": (lambda model: model.update(vertices={}), "a field is missing or wrong"),
    "vertices of two": (lambda model: model.update(vertices=[[1, 2]]), "a field is missing or wrong"),
    "a word": (lambda model: model["vertices"][3].__setitem__(0, "x"), "a field is missing or wrong"),
    "scale": (lambda model: model["transform"].update(scale=[1, 2]), "a field is missing or wrong"),
    "object": (lambda model: model["CityObjects"].update(b=3), "a field is missing or wrong"),
    "a plane of six": (
        lambda model: model["CityObjects"]["b000004"]["attributes"].update(roof_plane=[0, 0, 7, 0, 0, 7]),
        "building 'b000004': a field is missing or wrong",
    ),
    "a roof above its plane": (
        lambda model: model["CityObjects"]["b000004"]["attributes"].update(roof_plane=[0, 0, 7, 0, 0, 6, 6.9]),
        "building 'b000004': a field is missing or wrong",
    ),
    "two of one number": (
        lambda model: model["CityObjects"].update(other=model["CityObjects"]["b000004"]),
        "two buildings have one number",
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_city_models_that_cannot_be_used(path: Path, tmp_path: Path, name: str) -> None:
    change, message = CHANGES[name]
    document = json.loads(path.read_text())
    change(document)
    other = tmp_path / "other.json"
    other.write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"other\.json: {message}.* run again"), index_buildings(other):
        pass


def test_pieces_go_along_the_long_side() -> None:
    """Across first: what waits is then what the short side has."""
    boxes = {
        f"{i}_{j}": (100.0 * i, 100.0 * j, 100.0 * i + 100, 100.0 * j + 100) for i in range(8, 12) for j in (9, 10)
    }
    files = [(f"mesh/{name}.vtu", f"boundary/{name}.vtp") for name in sorted(boxes)]
    wide = RunRecord("done", (800.0, 900.0, 1200.0, 1100.0), np.nan, {}, boxes)
    names = [Path(volume).stem for volume, _ in _in_order(files, wide)]
    assert names == [f"{i}_{j}" for i in range(8, 12) for j in (9, 10)]
    tall = RunRecord("done", (800.0, 900.0, 1200.0, 2100.0), np.nan, {}, boxes)
    assert [Path(volume).stem for volume, _ in _in_order(files, tall)] == [
        f"{i}_{j}" for j in (9, 10) for i in range(8, 12)
    ]
    some: dict[str, tuple[float, ...] | None] = {**boxes, "9_9": None}
    for tiles in ({}, some):
        assert _in_order(files, RunRecord("done", (0.0, 0.0, 1.0, 1.0), np.nan, {}, tiles)) == files
