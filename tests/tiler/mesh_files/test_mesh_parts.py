"""Parts of a mesh that share no face: counted by the run and by the check, told, and not exported as one."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.data.mesh import Marker
from stitch.pieces.conformity import pair_cell_faces
from tests.helpers.bad_input import call, write_cloud, write_houses
from tests.helpers.cities import cloud_over
from tiler.check.check import check_run
from tiler.config.config import make_config
from tiler.export.export import export_run
from tiler.mesh_files.mesh_parts import TileParts, join_tiles, label_triangles, report_parts
from tiler.mesh_files.mesh_pieces import open_pieces
from tiler.mesh_files.run_files import find_files, take_largest_part
from tiler.report.write import write_report
from tiler.store.results import StoredTerrain
from tiler.store.run_folder import read_run_record
from tiler.workflow.run import run

Capture = pytest.CaptureFixture[str]
WEST, SOUTH, TILE = 318_000.0, 6_399_000.0, 60.0


def write_islands(folder: Path, *columns: tuple[int, int]) -> dict[str, Any]:
    """Write a cloud for each range of columns of tiles, with a house in each, and nothing between them."""
    folder.mkdir()
    houses = []
    for k, (first, last) in enumerate(columns):
        x = WEST + first * TILE
        house = shapely.box(x + 20, SOUTH + 20, x + 35, SOUTH + 35)
        houses.append(house)
        cloud = cloud_over((x, SOUTH, WEST + last * TILE, SOUTH + TILE), [(house, 10.0)], ground=2.0)
        write_cloud(folder / f"{k}.laz", cloud.xyz, cloud.classification)
    write_houses(folder / "houses.gpkg", houses)
    return {
        "pointcloud": [str(folder)],
        "footprints": str(folder / "houses.gpkg"),
        "mesh_size": 4.0,
        "tile_size": TILE,
        "domain_height": 60.0,
        "out": str(folder / "out"),
    }


@pytest.fixture(scope="module")
def islands(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tiles in the west, a gap of one tile, and one tile in the east."""
    given = write_islands(tmp_path_factory.mktemp("islands") / "town", (0, 2), (3, 4))
    run(make_config(given))
    return Path(given["out"])


def test_the_run_counts_parts_and_says_so(islands: Path) -> None:
    record = json.loads((islands / "run.json").read_text())
    assert record["parts"]["n"] == 2
    west, east = record["parts"]["largest"]
    assert (len(west["tiles"]), len(east["tiles"])) == (2, 1)
    assert west["cells"] + east["cells"] == record["counts"]["cells"]
    assert record["notes"]["mesh-in-parts"]["count"] == 1
    assert any("2 parts that share no face" in message for message in record["messages"])


def test_the_check_counts_the_same_parts_from_the_files(islands: Path) -> None:
    report = check_run(islands, StoredTerrain)
    assert report.ok
    assert report.facts["parts"] == 2
    record = json.loads((islands / "run.json").read_text())
    (remark,) = report.remarks
    assert remark == report_parts([part["cells"] for part in record["parts"]["largest"]])
    assert report.lines()[-2] == f"NOTE  {remark}"
    assert report.lines()[-1].endswith("everything is proved, but see the note")


@pytest.mark.usefixtures("small_pictures")
def test_the_report_tells_of_parts(islands: Path) -> None:
    assert "2 parts that share no face" in write_report(islands).read_text()


def test_one_region_is_one_part(tmp_path: Path) -> None:
    given = write_islands(tmp_path / "town", (0, 3))
    record = run(make_config(given))
    assert record["parts"] == {"n": 1}
    assert "mesh-in-parts" not in record["notes"]
    report = check_run(Path(given["out"]), StoredTerrain)
    assert (report.facts["parts"], report.remarks) == (1, ())


def test_a_gap_within_one_tile_is_told(tmp_path: Path) -> None:
    """One part then, whose middle nobody has measured."""
    given = write_islands(tmp_path / "town", (0, 1), (5, 6)) | {"tile_size": 1000.0, "mesh_size": 10.0}
    record = run(make_config(given))
    assert record["parts"] == {"n": 1}
    (note,) = record["notes"]["terrain-far-from-points"]["items"]
    assert "more than 32 m from any ground point" in note["detail"]
    assert note["detail"] in record["messages"]


def test_tiles_that_touch_in_a_corner_are_parts_and_soil_joins_none(tmp_path: Path) -> None:
    folder = tmp_path / "town"
    folder.mkdir()
    for i, j in ((0, 0), (1, 1)):
        x, y = WEST + i * TILE, SOUTH + j * TILE
        cloud = cloud_over((x, y, x + TILE, y + TILE), [], ground=2.0)
        write_cloud(folder / f"{i}.laz", cloud.xyz, cloud.classification)
    given = {"pointcloud": [str(folder)], "mesh_size": 4.0, "tile_size": TILE, "underground": 10.0}
    record = run(make_config({**given, "domain_height": 40.0, "out": str(folder / "out")}))
    report = check_run(folder / "out", StoredTerrain)
    assert record["parts"]["n"] == report.facts["parts"] == 2
    assert report.ok


def test_a_wind_case_of_two_parts_is_refused_and_the_largest_taken(
    islands: Path, tmp_path: Path, capsys: Capture
) -> None:
    wanted = ("export", islands, "--format", "openfoam", "-o", tmp_path / "case", "--case", "wind")
    found = call(capsys, *wanted)
    assert found.code == 2
    assert "2 parts that share no face" in found.err
    assert "--largest-part" in found.err
    assert not (tmp_path / "case").exists()
    assert call(capsys, *wanted, "--largest-part").code == 0
    (mesh,) = json.loads((tmp_path / "case" / "export.json").read_text())["meshes"]
    largest = json.loads((islands / "run.json").read_text())["parts"]["largest"][0]
    assert mesh["cells"] == largest["cells"]
    assert mesh["patches"]["west"]
    assert mesh["patches"]["east"]  # where the gap begins
    assert not mesh["patches"].get("missing")


@pytest.mark.parametrize("name", ["vtu", "stl"])
def test_other_formats_take_the_largest_part(islands: Path, tmp_path: Path, name: str) -> None:
    for largest in (False, True):
        export_run(islands, tmp_path / f"{largest}.{name}", name=name, options={"largest_part": largest})
    sizes = [(tmp_path / f"{largest}.{name}").stat().st_size for largest in (True, False)]
    assert 0.5 < sizes[0] / sizes[1] < 0.8


def test_the_pieces_of_the_largest_part_have_no_missing_side(islands: Path) -> None:
    pieces = open_pieces(take_largest_part(find_files(islands)))
    markers = np.concatenate([pieces.read(k).marker for k in range(len(pieces.names))])
    assert len(pieces.names) == 2
    assert Marker.MISSING not in markers
    whole = open_pieces(islands)
    assert Marker.MISSING in np.concatenate([whole.read(k).marker for k in range(3)])


def test_city_models_have_no_parts(islands: Path, tmp_path: Path, capsys: Capture) -> None:
    found = call(capsys, "export", islands, "--format", "gpkg", "-o", tmp_path / "a.gpkg", "--largest-part")
    assert found.code == 2
    assert "--largest-part: format gpkg does not take it" in found.err


def test_a_record_that_does_not_tell_is_not_believed(islands: Path, tmp_path: Path) -> None:
    record = json.loads((islands / "run.json").read_text())
    for parts, n in ((None, 0), ({"n": 1}, 1), (record["parts"], 2), ({"n": 10**12}, record["counts"]["cells"])):
        path = tmp_path / "run.json"
        path.write_text(json.dumps(record | {"parts": parts}))
        assert len(read_run_record(path).parts) == n


def random_cells(rng: np.random.Generator, n_points: int, n: int) -> NDArray[np.int32]:
    cells = [rng.choice(n_points, 4, replace=False) for _ in range(n)]
    return np.array(cells, np.int32)


def test_parts_of_cells_are_components_by_faces() -> None:
    """Against scipy, where every face that exactly two cells have joins them."""
    for seed in range(30):
        cells = random_cells(np.random.default_rng(seed), 7, 12)
        faces = [tuple(sorted(np.delete(cell, k).tolist())) for cell in cells for k in range(4)]
        pairs = [
            (i // 4, j // 4)
            for i in range(48)
            for j in range(i)
            if faces[i] == faces[j] and faces.count(faces[i]) == 2
        ]
        graph = coo_array((np.ones(len(pairs)), tuple(np.array(pairs).reshape(-1, 2).T)), shape=(12, 12))
        n, expected = connected_components(graph, directed=False)
        found = pair_cell_faces(cells, 7).part
        assert len(np.unique(found)) == n
        assert len(np.unique(np.stack((found, expected)), axis=1).T) == n


def test_triangles_that_touch_in_a_point_are_parts() -> None:
    triangles = np.array([[0, 1, 2], [3, 4, 5], [2, 1, 3], [5, 4, 6], [6, 7, 8]], np.int32)
    assert label_triangles(triangles, 9).tolist() == [0, 1, 0, 1, 2]
    assert label_triangles(np.empty((0, 3), np.int32), 0).tolist() == []


def test_parts_of_a_tile_are_joined_around_its_neighbours() -> None:
    """A tile in two parts, of which one hangs together with its neighbour; and two tiles in two parts each."""
    edge, other = (0.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 2.0)
    divided = TileParts("a", [5, 3], {"s": 2}, {"s": [(edge, 1)]})
    found = join_tiles([divided, TileParts("b", [7], {"s": 2})])
    assert [(part["cells"], part["tiles"], part["divided"]) for part in found] == [
        (10, ["a", "b"], ["a"]),
        (5, ["a"], ["a"]),
    ]
    crossed = TileParts("b", [7, 1], {"s": 4}, {"s": [(edge, 1), (other, 0)]})
    both = TileParts("a", [5, 3], {"s": 4}, {"s": [(edge, 0), (other, 1)]})
    assert [part["cells"] for part in join_tiles([both, crossed])] == [10, 6]
    # Without the tile beyond, a seam joins nothing.
    assert [part["cells"] for part in join_tiles([both])] == [5, 3]
