"""Points that stages read of each other: boxes, classes and files that mark no building, by hand."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.pointcloud import BUILDING, GROUND, HIGH_VEGETATION, UNCLASSIFIED, WATER
from tiler.readers import read_cloud

Rows = list[tuple[int, int, int, int]]  # x, y, z in centimetres, and class


def a_task(**files: tuple[Rows, bool]) -> Any:
    """Task that reads files of one cell each: rows, and whether the file marks buildings; none is unreadable."""
    facts = {
        name: {
            "unreadable": not file[0],
            "scale": (0.01,) * 3,
            "offset": (0.0,) * 3,
            "marks_buildings": file[1],
        }
        for name, file in files.items()
    }

    def read(stage: str, name: str, names: tuple[str, ...]) -> tuple[dict[str, Any], None]:
        end = np.array([len(files[name][0])])
        return {"cell": np.array([[0, 0]]), "cell_row": np.array([0]), "block": np.array([0, 1]), "end": end}, None

    def read_ranges(
        stage: str, name: str, names: tuple[str, ...], ranges: list[tuple[int, int]]
    ) -> dict[str, Any]:
        rows = np.concatenate([np.array(files[name][0])[first:stop] for first, stop in ranges])
        return {"units": rows[:, :3].astype(np.int32), "classification": rows[:, 3].astype(np.uint8)}

    store = SimpleNamespace(attributes=lambda stage, name: {"facts": facts[name]}, read=read)
    context = SimpleNamespace(bounds=(0.0, 0.0, 64.0, 64.0))
    return SimpleNamespace(refs={"points": tuple(files)}, store=store, context=context, read_ranges=read_ranges)


MARKED: Rows = [(100, 200, 300, BUILDING), (6300, 0, 5, GROUND), (400, 0, 6, UNCLASSIFIED), (0, 0, 7, WATER)]
UNMARKED: Rows = [(0, 300, 8, UNCLASSIFIED), (0, 400, 9, HIGH_VEGETATION), (0, 500, 10, GROUND), (0, 0, 11, 255)]
BOX = (0.0, 0.0, 10.0, 10.0)


def test_only_points_of_the_classes_in_the_box_are_read() -> None:
    task = a_task(a=(MARKED, True), b=([], True), c=(UNMARKED, False))
    cloud = read_cloud(task, BOX, classes=(BUILDING, WATER))
    expected = [[1, 2, 3], [0, 0, 0.07], [0, 3, 0.08], [0, 0, 0.11]]
    assert cloud.xyz.tolist() == [pytest.approx(place) for place in expected]
    assert cloud.classification.tolist() == [BUILDING, WATER, BUILDING, BUILDING]
    assert read_cloud(task, BOX, classes=(GROUND,)).xyz[:, 2] == pytest.approx([0.1])
    assert read_cloud(task, BOX).classification.tolist() == [
        *(BUILDING, UNCLASSIFIED, WATER),
        *(BUILDING, HIGH_VEGETATION, GROUND, BUILDING),
    ]
    assert len(read_cloud(a_task(b=([], True)), BOX, classes=(GROUND,)).xyz) == 0


def test_the_filter_finds_ground_before_classes_are_chosen() -> None:
    """Low points of any class are ground; what stands over them, and was ground, is not."""
    flat = [(100 * i, 100 * j, 0, HIGH_VEGETATION) for i in range(64) for j in range(64)]
    above = [(510, 510, 400, GROUND), (620, 620, 400, BUILDING), (6010, 6010, 400, GROUND)]
    for marked, roofs in ((True, [BUILDING]), (False, [BUILDING] * 2)):
        task = a_task(a=(flat + above, marked))
        assert len(read_cloud(task, BOX, classes=(GROUND,), ground_filter=True).xyz) == 11 * 11
        cloud = read_cloud(task, BOX, classes=(BUILDING,), ground_filter=True)
        assert cloud.classification.tolist() == roofs
        assert (cloud.xyz[:, 2] == 4.0).all()
