"""Edges between patches of the ground: their clearance, what they part, and that they follow from what is near."""

import numpy as np
import shapely
from numpy.typing import NDArray

from stitch.tiling.land_cover import LandCover, cover_edges, find_kept, find_patches
from stitch.tiling.walls import cut_walls

SIZE, CLEARANCE = 10.0, 1.0
BOX = shapely.box(0, 0, 200, 200)


def scene(seed: int) -> tuple[LandCover, NDArray[np.object_]]:
    """Overlapping lakes, streets that cross, a polygon beside another at 0.4 m, and houses among them."""
    rng = np.random.default_rng(seed)
    lakes = shapely.simplify(
        shapely.buffer(shapely.points(rng.uniform(0, 200, (12, 2))), rng.uniform(8, 30, 12)), 0.5
    )
    ends = rng.uniform(0, 200, (8, 2, 2))
    streets = shapely.buffer(shapely.linestrings(ends), 4, cap_style="flat")
    close = np.array([shapely.box(20, 20, 60, 60), shapely.box(60.4, 20, 90, 60)])
    houses = np.array([shapely.box(x, y, x + 12, y + 9) for x, y in rng.uniform(0, 185, (15, 2))])
    cover = np.concatenate((lakes, streets, close))
    return LandCover(cover, np.repeat([1, 2, 3], [12, 8, 2]), (10.0, 10.0, 190.0, 190.0), 9), houses


def edges_of(cover: LandCover, houses: NDArray[np.object_]) -> NDArray[np.float64]:
    return cover_edges(cover, cut_walls(houses, mesh_size=SIZE), BOX, mesh_size=SIZE, clearance=CLEARANCE)


def test_edges_keep_the_clearance_and_part_patches() -> None:
    cover, houses = scene(1)
    edges = edges_of(cover, houses)
    assert len(edges) > 200
    lines = shapely.linestrings(edges)
    # Between two places that are looked at, half a clearance apart, an edge may be closer by a fourth.
    least = CLEARANCE * 0.75
    assert shapely.distance(lines, shapely.union_all(shapely.boundary(houses))).min() > least
    assert shapely.distance(lines, BOX.boundary).min() > least
    one, two = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=least)
    pairs = [(a, b) for a, b in zip(one.tolist(), two.tolist(), strict=True) if a < b]
    assert pairs
    assert all((edges[a][:, None] == edges[b][None]).all(axis=2).any() for a, b in pairs)  # they share an end
    middle, across = edges.mean(axis=1), edges[:, 1] - edges[:, 0]
    size = np.hypot(*across.T)
    assert size.min() >= CLEARANCE
    normal = np.column_stack((-across[:, 1], across[:, 0])) / size[:, None] * 0.2
    assert (find_patches(cover, middle + normal) != find_patches(cover, middle - normal)).mean() > 0.97
    assert 9 in find_patches(cover, middle + normal)  # the pad's border is an edge, too


def test_edges_follow_from_what_is_near_alone() -> None:
    cover, houses = scene(2)
    whole = edges_of(cover, houses)
    box = shapely.box(40, 40, 120, 120)
    around = box.buffer(2 * SIZE)
    near = shapely.intersects(cover.polygons, around)
    order = np.random.default_rng(3).permutation(int(near.sum()))
    part = LandCover(cover.polygons[near][order], cover.row[near][order], cover.core, cover.pad)
    found = edges_of(part, houses[shapely.intersects(houses, around)])

    def inside(edges: NDArray[np.float64]) -> list[list[float]]:
        return sorted(edges[shapely.intersects(box, shapely.linestrings(edges))].reshape(-1, 4).tolist())

    assert len(inside(whole)) > 30
    assert inside(found) == inside(whole)


def test_edges_of_a_mesh_on_given_ones() -> None:
    xy = np.array([[0.0, 0], [4, 0], [2, 0], [2, 3], [2, -3]])
    triangles = np.array([[0, 2, 3], [2, 1, 3], [0, 4, 2], [4, 1, 2]], np.int32)
    kept = find_kept(xy, np.array([[[0.0, 0], [4, 0]]]), triangles)
    assert sorted(map(sorted, kept.tolist())) == [[0, 2], [1, 2]]
