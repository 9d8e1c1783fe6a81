"""Step 2.1: merging ends with the clearance between all, the paper's way, whatever the order of the input."""

from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely import Polygon, box

from pipeline.city_model.footprints import clean_footprints
from pipeline.data.citymodel import Footprints, make_ids
from pipeline.data.errors import GeometryError
from pipeline.geometry.clearance import has_clearance, is_sound, make_sound
from pipeline.geometry.rings import make_canonical
from pipeline.simplification.merge import MergedFootprints, merge_footprints
from pipeline.simplification.patches import merge_polygons, project_vertices
from tests.helpers.campaigns import examples

CLEARANCE, MIN_HOLE_AREA, FLOOR, TOLERANCE = 1.0, 10.0, 0.1, 0.01


def merge(*polygons: Polygon) -> MergedFootprints:
    return merge_footprints(
        np.array(polygons, dtype=object),
        clearance=CLEARANCE,
        min_hole_area=MIN_HOLE_AREA,
        floor=FLOOR,
        tolerance=TOLERANCE,
    )


def pair(a: Polygon, b: Polygon) -> tuple[Polygon, str]:
    return merge_polygons(
        a, b, clearance=CLEARANCE, max_iterations=3, min_hole_area=MIN_HOLE_AREA, tolerance=TOLERANCE
    )


def members(merged: MergedFootprints) -> list[list[int]]:
    return [rows.tolist() for rows in merged.members]


def used(merged: MergedFootprints) -> dict[str, int]:
    return {key: count for key, count in merged.counts.items() if count}


def assert_promises(merged: MergedFootprints, n: int) -> None:
    """Check clearances by brute force, membership, canonical form, and that step 2.2 has nothing to do."""
    polygons = merged.polygons
    assert shapely.is_valid(polygons).all()
    distance = shapely.distance(polygons[:, None], polygons[None, :])
    assert (distance[~np.eye(len(polygons), dtype=np.bool_)] >= CLEARANCE).all()
    assert (shapely.minimum_clearance(polygons) >= FLOOR).all()
    assert is_sound(polygons, FLOOR).all()
    assert sorted(i for rows in merged.members for i in rows.tolist()) == list(range(n))
    alone = [len(rows) == 1 for rows in merged.members]
    assert [how == "single" for how in merged.method if not how.startswith("repaired")] == [
        one for one, how in zip(alone, merged.method, strict=True) if not how.startswith("repaired")
    ]
    merges = sum(merged.counts[how] for how in ("union", "patch", "hulls", "hull"))
    assert merges == n - len(polygons)
    unknown = np.full(len(polygons), np.nan)
    again, notes = clean_footprints(
        Footprints(polygons, make_ids(polygons), unknown), min_area=0.0, tolerance=TOLERANCE
    )
    # A repair may leave a building just below the width of a sliver.
    assert {note.kind for note in notes} <= {"footprint-sliver"}
    assert set(blobs(again.polygons)) <= set(blobs(polygons))
    assert len(again.ids) + len(notes) == len(polygons)


def blobs(polygons: NDArray[np.object_]) -> list[bytes]:
    return sorted(shapely.to_wkb(polygons).tolist())


YARD = box(0, 0, 20, 20).difference(box(5, 5, 15, 15))
NORTH = Polygon([(0, 10), (5, 10), (5, 15), (15, 15), (15, 10), (20, 10), (20, 20), (0, 20)])
SOUTH = Polygon([(0, 0), (20, 0), (20, 10), (15, 10), (15, 5), (5, 5), (5, 10), (0, 10)])
HOLES = box(2, 2, 5, 5).union(box(2, 10, 38, 10.9)).union(box(10, 2, 14, 6))
CHAIN = [box(5 * k, 0, 5 * k + 4.5, 4) for k in range(6)]
# Footprints; what becomes of the first, or its area; rows of each; how each was made, and how often.
BY_HAND: dict[str, tuple[list[Polygon], Polygon | float, list[list[int]], tuple[str, ...], dict[str, int]]] = {
    "squares half a metre apart are patched": (
        [box(0, 0, 4, 4), box(4.5, 0, 9, 4)], box(0, 0, 9, 4), [[0, 1]], ("patch",), {"patch": 1},
    ),
    # Within 1 m there are two points, a line; within 2 m the patch ends at (4.5, 4), 0.5 m from (4, 4);
    # within 4 m it is the trapezoid between the facing walls, 4 and 5 m long.
    "a patch grows until no step is shorter than the clearance": (
        [box(0, 0, 4, 4), box(4.5, 1, 9, 6)], 16 + 22.5 + 0.5 * (4 + 5) / 2, [[0, 1]], ("patch",), {"patch": 1},
    ),
    "overlapping squares are united": (
        [box(0, 0, 4, 4), box(2, 2, 6, 6)], 28.0, [[0, 1]], ("union",), {"union": 1},
    ),
    "houses that share a wall lose it": (
        [box(0, 0, 4, 4), box(4, 0, 8, 4), box(8, 0, 12, 4)],
        box(0, 0, 12, 4), [[0, 1, 2]], ("union",), {"union": 2},
    ),
    # Nothing of one projects beyond the common corner within 1 or 2 m; at 4 m the patch is the point still.
    "squares that touch in a corner become one polygon": (
        [box(0, 0, 4, 4), box(4, 4, 8, 8)], 64.0 - 16, [[0, 1]], ("hull",), {"hull": 1},
    ),
    "a gap of the clearance stays": (
        [box(0, 0, 4, 4), box(5, 0, 9, 4), box(9.999, 0, 13, 4)],
        box(0, 0, 4, 4), [[0], [1, 2]], ("single", "patch"), {"patch": 1},
    ),
    "a chain is merged through its links": (
        [*CHAIN[::-1], box(90, 0, 95, 4)],
        box(0, 0, 29.5, 4), [[0, 1, 2, 3, 4, 5], [6]], ("patch", "single"), {"patch": 5},
    ),
    "a building far from the walls of its courtyard stays": (
        [box(8, 8, 12, 12), YARD], YARD, [[1], [0]], ("single", "single"), {},
    ),
    # Only the patch within 4 m has area. It reaches the walls north and south; two corners left are filled.
    "a building close to the wall of its courtyard merges and the courtyard stays": (
        [YARD, box(5.5, 7, 9, 12)],
        box(0, 0, 20, 20).difference(box(9, 5, 15, 15)), [[0, 1]], ("patch",), {"patch": 1},
    ),
    "a courtyard too small or thin for the mesh is filled": (
        [box(0, 0, 40, 20).difference(HOLES)],
        box(0, 0, 40, 20).difference(box(10, 2, 14, 6)), [[0]], ("single",), {"hole-filled": 2},
    ),
    "a footprint in another vanishes in it": (
        [box(0, 0, 20, 20), box(5, 5, 9, 9), box(0, 0, 20, 20)],
        box(0, 0, 20, 20), [[0, 1, 2]], ("union",), {"union": 2},
    ),
    "a union that encloses a courtyard keeps it": ([NORTH, SOUTH], YARD, [[0, 1]], ("union",), {"union": 1}),
    "needless vertices go also where nothing is merged": (
        [Polygon([(0, 0), (2, 0.005), (4, 0), (4, 4), (0, 4)])], box(0, 0, 4, 4), [[0]], ("single",), {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BY_HAND)
def test_merges_by_hand(name: str) -> None:
    footprints, first, rows, method, counts = BY_HAND[name]
    merged = merge(*footprints)
    assert (members(merged), merged.method, used(merged)) == (rows, method, counts)
    if isinstance(first, float):
        assert merged.polygons[0].area == pytest.approx(first)
    else:
        assert merged.polygons[0].normalize().equals_exact(first.normalize(), 1e-9)


def test_hulls_are_taken_where_no_patch_helps() -> None:
    # The wedge-shaped notch in the first has walls 0.6 m apart at its bottom: no union keeps the clearance.
    notched = Polygon([(0, 0), (10, 0), (10, 10), (5.3, 10), (5.3, 6), (4.7, 6), (4.7, 10), (0, 10)])
    polygon, method = pair(notched, box(9, 0, 20, 10))
    assert method == "hulls"
    assert polygon.equals(box(0, 0, 20, 10))


def test_the_hull_is_taken_at_last() -> None:
    polygon, method = pair(box(0, 0, 10, 10), box(0, 9, 0.5, 12))
    assert method == "hull"
    assert polygon.equals(Polygon([(0, 0), (10, 0), (10, 10), (0.5, 12), (0, 12)]))


def test_iterations_double_the_reach_of_the_patch() -> None:
    a = box(0, 0, 10, 10)
    b = Polygon([(10.5, 5), (20, 3.8), (20, 6.2)])
    eps = [len(project_vertices(b, a, reach)) + len(project_vertices(a, b, reach)) for reach in (1, 2, 4, 8)]
    assert eps[0] == 1
    assert eps == sorted(eps)
    once = merge_polygons(a, b, clearance=1.0, max_iterations=0, min_hole_area=0.0, tolerance=0.0)
    assert once[1] == "hull"


def test_projections_are_the_nearest_points_of_close_edges_holes_included() -> None:
    yard = box(0, 0, 20, 20).difference(box(5, 5, 15, 15))
    guest = box(5.5, 9, 8, 11)
    points = project_vertices(guest, yard, 1.0)
    assert sorted(map(tuple, points.tolist())) == [(5, 9), (5, 11)]
    assert len(project_vertices(yard, guest, 1.0)) == 0


def test_a_merged_polygon_is_compared_again() -> None:
    # The hull of the first two reaches the third, which neither of them is close to.
    corner = [box(0, 0, 4, 4), box(4, 4, 8, 8), box(6, 0, 9, 2.9)]
    assert shapely.distance(corner[2], np.array(corner[:2])).min() > CLEARANCE
    merged = merge(*corner)
    assert members(merged) == [[0, 1, 2]]
    assert used(merged)["hull"] >= 1


def test_no_footprints_and_one() -> None:
    empty = merge()
    assert (len(empty.polygons), empty.members, empty.method, used(empty)) == (0, (), (), {})
    assert merge(box(0, 0, 3, 3)).method == ("single",)


def test_bad_input_is_refused_with_its_place_in_the_input() -> None:
    bow_tie = Polygon([(0, 0), (4, 4), (4, 0), (0, 4)])
    with pytest.raises(GeometryError, match=r"footprint 1 \(Self-intersection.*step 1.4"):
        merge(box(0, 0, 3, 3), bow_tie)
    with pytest.raises(GeometryError, match=r"footprint 0 .* and 1 others of 2"):
        merge(Polygon(), shapely.MultiPolygon([box(0, 0, 3, 3)]))
    with pytest.raises(ValueError, match="floor"):
        merge_footprints(np.array([box(0, 0, 3, 3)]), clearance=1.0, min_hole_area=10.0, floor=1.5, tolerance=0.01)


UNSOUND = {
    "short edge": (Polygon([(0, 0), (10, 0), (10, 9.95), (9.95, 10), (0, 10)]), "repaired-simplify"),
    "thin spike": (Polygon([(0, 0), (10, 0), (10, 4), (18, 4.02), (10, 4.08), (10, 9)]), "repaired-simplify"),
    "thin gap": (
        Polygon([(0, 0), (10, 0), (10, 4), (3, 4), (3, 4.05), (10, 4.05), (10, 9), (0, 9)]),
        "repaired-simplify",
    ),
    "thin neck": (box(0, 0, 9, 9).union(box(12, 0, 21, 9)).union(box(5, 4, 15, 4.06)), "repaired-buffer"),
    "thin wall beside a court": (box(0, 0, 20, 20).difference(box(0.06, 5, 15, 15)), "repaired-buffer"),
    "sharp corner": (Polygon([(0, 0), (40, 0), (40, 3)]), "repaired-buffer"),
    "sharp notch": (
        Polygon([(0, 0), (40, 0), (40, 20), (20.4, 20), (20, 4), (19.6, 20), (0, 20)]),
        "repaired-buffer",
    ),
    "hole that touches the shell": (
        Polygon([(0, 0), (20, 0), (20, 20), (0, 20)], [[(0, 0), (5, 12), (12, 5)]]),
        "repaired-buffer",
    ),
    "needle": (Polygon([(0, 0), (30, 0), (0, 0.08)]), "repaired-buffer"),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_an_unsound_polygon_is_repaired_close_to_what_it_was(name: str) -> None:
    polygon, rung = UNSOUND[name]
    (canonical,) = make_canonical(np.array([polygon]))
    sound, used_rung = make_sound(canonical, FLOOR)
    assert used_rung == rung
    assert is_sound(np.array([sound]), FLOOR)[0]
    assert make_sound(sound, FLOOR) == (sound, "")
    assert sound.symmetric_difference(polygon).area < 0.2 * polygon.length
    merged = merge(polygon)
    assert used(merged) == {rung: 1}
    assert merged.method == (rung,)


@pytest.mark.parametrize(("name", "bounds"), [("thin neck", (0, 0, 21, 9)), ("needle", (-0.1, -0.1, 30.1, 0.18))])
def test_the_last_rungs_are_the_hull_and_a_box(
    name: str, bounds: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.geometry.clearance.BUFFER_RADII", ())
    sound, rung = make_sound(UNSOUND[name][0], FLOOR)
    assert rung == "repaired-hull"
    assert is_sound(np.array([sound]), FLOOR)[0]
    np.testing.assert_allclose(sound.bounds, bounds, atol=0.01)


def test_a_repair_that_comes_too_close_to_a_neighbour_merges_with_it() -> None:
    neck = UNSOUND["thin neck"][0]
    neighbour = box(0, 10.02, 9, 14)
    assert neck.distance(neighbour) > CLEARANCE
    merged = merge(neck, neighbour)
    assert members(merged) == [[0, 1]]
    assert merged.counts["repaired-buffer"] >= 1


def test_a_merged_polygon_with_a_short_edge_is_repaired() -> None:
    notched = Polygon([(0, 0), (10, 0), (10, 10), (5.3, 10), (5.3, 6), (4.7, 6), (4.7, 10), (0, 10)])
    # Their hull has the vertices (10, 10) and (10.06, 9.97).
    merged = merge(notched, Polygon([(10.06, 9.97), (10.06, 0), (16, 0)]))
    assert used(merged) == {"hull": 1, "repaired-simplify": 1}
    assert merged.method == ("repaired-simplify",)
    assert len(merged.polygons[0].exterior.coords) == 5


def test_a_courtyard_that_a_repair_closes_is_filled_if_too_small() -> None:
    gate = box(6, 4.98, 20, 5.03)
    for court, holes in ((box(4, 4, 6, 6), 0), (box(2, 2, 6, 8), 1)):
        merged = merge(box(0, 0, 10, 10).difference(court).difference(gate))
        assert used(merged) == {"repaired-buffer": 1}
        assert len(merged.polygons[0].interiors) == holes


def test_a_ring_that_touches_another_has_no_clearance() -> None:
    touching = UNSOUND["hole that touches the shell"][0]
    assert shapely.minimum_clearance(touching) > 1.0
    assert has_clearance(np.array([touching, box(0, 0, 3, 3)]), 1.0).tolist() == [False, True]


def test_clusters_merge_alone_as_they_do_together() -> None:
    rng = np.random.default_rng(3)
    near = random_houses(rng, 40, 60.0)
    far = shapely.transform(near[:25], lambda xy: xy + np.array([3000.0, 100.0]))
    huge = np.array([box(9000, 9000, 9900, 9900)])
    together = merge(*near, *far, *huge)
    apart = [*merge(*near).polygons, *merge(*far).polygons, *huge]
    assert blobs(together.polygons) == blobs(make_canonical(np.array(apart)))


def random_houses(rng: np.random.Generator, n: int, width: float) -> NDArray[np.object_]:
    corner = rng.uniform(0, width, (n, 2))
    size = rng.uniform(3, 12, (n, 2))
    turn = rng.uniform(0, np.pi / 2, n)
    u, v = np.stack([np.cos(turn), np.sin(turn)], axis=1), np.stack([-np.sin(turn), np.cos(turn)], axis=1)
    steps = [0 * u, size[:, :1] * u, size[:, :1] * u + size[:, 1:] * v, size[:, 1:] * v]
    houses: NDArray[np.object_] = shapely.polygons(np.stack([corner + step for step in steps], axis=1))
    return houses


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 25), st.sampled_from([20.0, 60.0]))
def test_promises_hold_in_any_order(seed: int, n: int, width: float) -> None:
    rng = np.random.default_rng(seed)
    houses = random_houses(rng, n, width)
    merged = merge(*houses)
    assert_promises(merged, n)
    order = rng.permutation(n)
    other = merge(*houses[order])
    assert shapely.to_wkb(other.polygons).tolist() == shapely.to_wkb(merged.polygons).tolist()
    assert [np.sort(order[rows]).tolist() for rows in other.members] == members(merged)
    assert (other.method, other.counts) == (merged.method, merged.counts)


def random_shapes(rng: np.random.Generator, n: int) -> NDArray[np.object_]:
    """Make star shapes with courtyards: spikes, thin gaps, sharp corners, crossing rings."""
    rings = [
        rng.uniform(0, 40, 2) + rng.choice([3, 10, 30]) * rng.uniform(0, 1, (corners, 2))
        for corners in rng.integers(3, 12, n)
    ]
    courts = [ring.mean(axis=0) + rng.uniform(0.05, 0.6) * (ring - ring.mean(axis=0)) for ring in rings]
    return np.array([Polygon(a, [b]) for a, b in zip(rings, courts, strict=True)], dtype=object)


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_promises_hold_for_ragged_shapes(seed: int, n: int) -> None:
    shapes = random_shapes(np.random.default_rng(seed), n)
    rows = Footprints(shapes, np.array([f"{i}" for i in range(n)]), np.full(n, np.nan))
    clean, _ = clean_footprints(rows, min_area=1.0, tolerance=TOLERANCE)
    assert_promises(merge(*clean.polygons), len(clean.ids))


def test_sparse_houses_cost_about_as_much_as_they_are() -> None:
    grid = np.stack(np.meshgrid(np.arange(50), np.arange(60)), axis=-1).reshape(-1, 2) * 20.0
    merged = merge(*shapely.box(grid[:, 0], grid[:, 1], grid[:, 0] + 12, grid[:, 1] + 9))
    assert len(merged.polygons) == len(grid)
    assert set(merged.method) == {"single"}


@pytest.mark.long
@pytest.mark.shared
def test_amsterdam_keeps_the_promises(shared_data: Path) -> None:
    _, _, raw, _ = pyogrio.raw.read(shared_data / "amsterdam" / "footprints.shp")
    given_polygons = shapely.from_wkb(raw)
    rows = Footprints(given_polygons, make_ids(given_polygons), np.full(len(raw), np.nan))
    clean, _ = clean_footprints(rows, min_area=5.0, tolerance=TOLERANCE)
    merged = merge(*clean.polygons)
    assert_promises(merged, len(clean.polygons))
    # About 1.5 s on one shared core; 537 of 1,406 merges end in the hull, which is the paper's way.
    lost = shapely.union_all(clean.polygons).difference(shapely.union_all(merged.polygons))
    assert lost.area < 1e-4 * shapely.area(clean.polygons).sum()
