"""The proofs of land cover and leaves find each fault."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.mesh import Boundary, Marker
from tiler.check.cover_proofs import check_cover, check_leaves, check_levels
from tiler.check.proofs import Surface, make_surface
from tiler.store.run_folder import GroundPatch

GROUND = (GroundPatch("ground"), GroundPatch("ground_water", 0.0002))
RIGHT = np.array([1, 0, -1], np.int8)


def surface() -> Surface:
    """Two ground facets, the first on water west of x = 1, and a roof."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 3, 0], [4, 0, 5], [4, 4, 5], [0, 4, 5]])
    marker = np.array([Marker.GROUND, Marker.GROUND, Marker.ROOF], np.int32)
    facets = np.array([[0, 2, 1], [1, 2, 3], [4, 6, 5]], np.int32)
    return make_surface(points, Boundary(facets, marker, np.array([-1, -1, 7])), np.zeros((3, 3)))


def patches_at(xy: NDArray[np.float64]) -> NDArray[np.int8]:
    return (xy[:, 0] < 1).astype(np.int8)


def test_patches_by_hand() -> None:
    found = check_cover(surface(), RIGHT, GROUND, patches_at)
    assert (found.faults, found.sums["facets"], found.sums["ground_water"]) == ((), 2, 0.5)


@pytest.mark.parametrize(
    ("patch", "kind"),
    [
        (None, "patch-missing"),
        (RIGHT.astype(np.int32), "patch-missing"),
        (np.array([0, 0, -1], np.int8), "patch-wrong"),
        (np.array([2, 0, -1], np.int8), "patch-unknown"),
        (np.array([1, 0, 0], np.int8), "patch-elsewhere"),
    ],
)
def test_a_wrong_patch_is_a_fault(patch: NDArray[np.int8] | None, kind: str) -> None:
    (fault,) = check_cover(surface(), patch, GROUND, patches_at).faults
    assert (fault.kind, fault.count) == (kind, 1)


def test_water_off_its_level_and_leaves_elsewhere_are_faults() -> None:
    ground, level = np.array([[0.0, 0, 2.0], [1, 0, 2.1], [2, 0, 9]]), np.array([2.0, 2.0, np.nan])
    assert [fault.kind for fault in check_levels(ground, level).faults] == ["water-uneven"]
    assert check_levels(ground[[0, 2]], level[[0, 2]]).faults == ()
    points, cells = np.array([[0.0, 0, 0], [6, 0, 0], [0, 6, 0], [0, 0, 6]]), np.array([[0, 1, 2, 3]], np.int32)

    def density_at(places: NDArray[np.float64]) -> NDArray[np.float32]:
        return (places[:, 2] < 3).astype(np.float32)

    assert check_leaves(points, cells, np.ones(1, np.float32), density_at).sums["volume"] == pytest.approx(36.0)
    (fault,) = check_leaves(points, cells, np.zeros(1, np.float32), density_at).faults
    assert (fault.kind, fault.places) == ("leaves-elsewhere", ((1.5, 1.5, 1.5),))
