"""Straight skeletons against those of an independent program (CGAL by compas-cgal), and their faces."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from compas_cgal.straight_skeleton_2 import interior_straight_skeleton, interior_straight_skeleton_with_holes
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pipeline.skeletons.straight_skeleton import Skeleton, outline_edges, straight_skeleton
from tests.helpers.house_outlines import HAND, KINDS, random_outlines

Array = NDArray[np.float64]

SAME = 1e-5  # m, nodes of both programs are this close
# Three edges in nearly one direction meet in a place that rounding moves by about this, divided by how far from
# singular their equations are. Solved with 40 digits for the 11 such footprints: ours were within 1e-10 m.
ROUNDING = 5e-15
MAX_VERTICES = 250


def peer_nodes(polygon: shapely.Polygon, origin: Array) -> Array:
    """Nodes of the other program, in coordinates relative to ours."""
    starts, stops = outline_edges(polygon).transpose(1, 0, 2)
    first = [0, *(k + 1 for k in range(len(starts) - 1) if (stops[k] != starts[k + 1]).any())]
    rings = [
        np.column_stack((ring - origin, np.zeros(len(ring)))).tolist() for ring in np.split(starts, first[1:])
    ]
    if len(rings) == 1:
        points = interior_straight_skeleton(rings[0], as_graph=False)[0]
    else:
        points = interior_straight_skeleton_with_holes(rings[0], rings[1:], as_graph=False)[0]
    nodes: Array = np.asarray(points)[:, :2]
    return nodes


def looseness(skeleton: Skeleton) -> Array:
    """How far rounding of coordinates may move each node (m)."""
    along = np.diff(skeleton.nodes[skeleton.edges], axis=1)[:, 0]
    along /= np.hypot(*along.T)[:, np.newaxis]
    planes = np.column_stack((-along[:, 1], along[:, 0], -skeleton.speed))
    edge = np.repeat(np.arange(len(skeleton)), np.diff(skeleton.face_start))
    result = np.full(len(skeleton.nodes), SAME)
    for node in range(len(skeleton), len(skeleton.nodes)):
        least = np.linalg.svd(planes[edge[skeleton.face_node == node]], compute_uv=False)[-1]
        result[node] += ROUNDING / max(least, 1e-300)
    return result


def compare_nodes(polygon: shapely.Polygon) -> float:
    """Compare the nodes of both programs; gives the largest distance (m)."""
    skeleton = straight_skeleton(polygon, tolerance=0.0)
    ours, theirs = skeleton.nodes - skeleton.origin, peer_nodes(polygon, skeleton.origin)
    far = np.asarray(KDTree(theirs).query(ours)[0])
    back, nearest = map(np.asarray, KDTree(ours).query(theirs))
    most = looseness(skeleton) if max(far.max(), back.max()) > SAME else np.full(len(ours), SAME)
    assert (far <= most).all(), (shapely.to_wkt(polygon, 17), far.max())
    assert (back <= most[nearest]).all(), (shapely.to_wkt(polygon, 17), back.max())
    return float(max(far.max(), back.max()))


def check_faces(polygon: shapely.Polygon, skeleton: Skeleton, tolerance: float) -> None:
    """One simple face for each edge, monotone to it, in its plane; together the polygon."""
    a, b = outline_edges(polygon).transpose(1, 0, 2)
    assert len(skeleton) == len(a)
    faces = np.array([shapely.Polygon(skeleton.nodes[skeleton.face(e)]) for e in range(len(a))], dtype=object)
    assert shapely.is_valid(faces).all()
    assert shapely.area(faces).sum() == pytest.approx(polygon.area, rel=1e-9)
    lines, of_face = [], []
    for e in range(len(a)):
        face = skeleton.face(e)
        np.testing.assert_array_equal(skeleton.nodes[face[:2]], [a[e], b[e]])
        ux, uy = (b[e] - a[e]) / np.hypot(*(b[e] - a[e]))
        along, across = np.array([[ux, uy], [-uy, ux]]) @ (skeleton.nodes[face] - a[e]).T
        assert np.abs(across - skeleton.time[face]).max() <= tolerance + 1e-6
        places = np.unique(along.round(6))
        middle = 0.5 * (places[1:] + places[:-1])[np.diff(places) > 4 * tolerance + 1e-3]
        ends = np.multiply.outer(middle, (ux, uy)) + a[e]
        reach = np.array([-uy, ux]) * (across.max() + 1.0)
        lines.append(np.stack((ends - reach, ends + reach), axis=1))
        of_face += [e] * len(middle)
    # Lines across its edge meet a monotone face in one piece.
    pieces = shapely.intersection(shapely.linestrings(np.concatenate(lines)), faces[of_face])
    assert (shapely.get_num_geometries(pieces) == 1).all()


def read_footprints(shared_data: Path) -> list[shapely.Polygon]:
    """Valid footprints of Amsterdam and the difficult ones, a part at a time, up to `MAX_VERTICES`."""
    found = []
    for name in ("amsterdam/footprints.shp", "nasty_footprints.geojson"):
        _, _, blobs, _ = pyogrio.raw.read(shared_data / name, columns=[])
        parts = shapely.get_parts(shapely.force_2d(shapely.from_wkb(blobs)))
        usable = shapely.is_valid(parts) & (shapely.area(parts) > 0)
        found += parts[usable & (shapely.get_num_coordinates(parts) <= MAX_VERTICES)].tolist()
    return found


def compare_all(polygons: Sequence[shapely.Polygon]) -> None:
    """Compare many polygons, of which next to all have well-placed nodes."""
    off = [compare_nodes(polygon) for polygon in polygons]
    assert sum(distance > SAME for distance in off) <= 0.01 * len(off)
    for polygon in polygons:
        check_faces(polygon, straight_skeleton(polygon), 0.005)


@pytest.mark.parametrize("name", HAND)
def test_hand_made_outlines_have_the_nodes_of_cgal(name: str) -> None:
    if not name.startswith("courtyard at"):  # polygons that the peer splits differently
        compare_nodes(HAND[name])
    check_faces(HAND[name], straight_skeleton(HAND[name]), 0.005)


@pytest.mark.parametrize("kind", KINDS)
def test_random_outlines_have_the_nodes_of_cgal(kind: str) -> None:
    compare_all(random_outlines(kind, 6, seed=1))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_many_random_outlines_have_the_nodes_of_cgal(kind: str) -> None:
    compare_all(random_outlines(kind, 80, seed=2))


@pytest.mark.long
@pytest.mark.shared
def test_footprints_have_the_nodes_of_cgal(shared_data: Path) -> None:
    polygons = read_footprints(shared_data)
    assert len(polygons) > 1800
    compare_all(polygons)
