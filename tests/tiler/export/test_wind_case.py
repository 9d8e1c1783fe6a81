"""Wind cases: a folder a direction on one mesh, the profile kept over bare ground, the surface sampled."""

import json
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tests.conftest import Once
from tests.helpers.foam_reader import PolyMesh, read_field, read_labels, read_patch, read_poly_mesh
from tests.helpers.programs import mesh_is_ok, run_foam
from tests.helpers.synthetic import run_city
from tests.tiler.export.conftest import Exported
from tiler.cli.main import main
from tiler.export.export import export_run
from tiler.export.foam_part import DISTANCES, count_distances
from tiler.export.wind_profile import Wind, flow_of, read_wind_table

MESH = "constant/polyMesh"
Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def flat_runs(once: Once) -> Mapping[str, Path]:
    """Finished runs of 240 x 80 m of bare level ground, 60 m high, with thin cells at the ground, by mesher."""
    city = {"size": 300, "buildings": 1, "density": 0.5, "relief": 0.0}
    west, south = 318000.0, 6399000.0
    given: dict[str, Any] = {"bounds": [west + 30, south + 30, west + 270, south + 110], "footprints": ""}
    given |= {"mesh_size": 8.0, "first_layer": 1.0, "top": "flat", "tile_size": 1000.0, "dtm_spacing": 10.0}

    def run_on(mesher: str) -> Path:
        return once(f"flat-{mesher}", lambda folder: run_city(folder, city, **given, mesher=mesher)) / "out"

    return {mesher: run_on(mesher) for mesher in ("adaptive", "layered")}


@pytest.fixture(scope="module")
def small_wind(small_run: Path, exported: Exported) -> Path:
    """Export of three directions for two processes."""
    words = ("--direction", "240", "--direction", "0", "--direction", "22.5", "--parts", "2")
    return exported(small_run, "openfoam", "--case", "wind", *words)


def conditions(path: Path) -> dict[str, str]:
    """Read the type of each patch of a field."""
    text = path.read_bytes().split(b"boundaryField")[1].decode("latin1")
    return dict(re.findall(r"^    (\S+) \{ type (\w+);", text, re.MULTILINE))


def test_directions_share_one_mesh(small_wind: Path) -> None:
    assert sorted(path.name for path in small_wind.iterdir()) == [
        "Allrun", "case.foam", "constant", "export.json", "processor0", "processor1", "system",
        "wind_0", "wind_22.5", "wind_240",
    ]  # fmt: skip
    for name in ("wind_0", "wind_22.5", "wind_240"):
        for n in range(2):
            link = small_wind / name / f"processor{n}" / MESH
            assert link.is_symlink()
            assert link.resolve() == (small_wind / f"processor{n}" / MESH).resolve()
        assert (small_wind / name / "constant" / "triSurface" / "pedestrian.obj").is_file()
        assert os.access(small_wind / name / "Allrun", os.X_OK)
        assert "mpirun -np 2" in (small_wind / name / "Allrun").read_text()
    size = sum(path.stat().st_size for path in small_wind.rglob("*") if path.is_file())
    record = json.loads((small_wind / "export.json").read_text())
    assert record["wind"]["directions"] == [240.0, 0.0, 22.5]
    assert record["crs"].startswith("EPSG")
    assert size > 0


def test_conditions_are_those_of_the_direction(small_wind: Path) -> None:
    oblique = conditions(small_wind / "wind_240" / "processor0" / "0" / "U")
    inlet = {name for name, kind in oblique.items() if kind == "atmBoundaryLayerInletVelocity"}
    outlet = {name for name, kind in oblique.items() if kind == "inletOutlet"}
    assert (inlet, outlet) == ({"west", "south"}, {"east", "north"})
    straight = conditions(small_wind / "wind_0" / "processor1" / "0" / "U")
    assert straight["north"] == "atmBoundaryLayerInletVelocity"
    assert straight["south"] == "inletOutlet"
    assert straight["west"] == straight["east"] == "slip"
    text = (small_wind / "wind_240" / "constant" / "wind").read_text()
    assert "flowDir (0.866025403784 0.5 0);" in text
    nut = conditions(small_wind / "wind_240" / "processor0" / "0" / "nut")
    assert (nut["ground"], nut["walls"]) == ("nutkAtmRoughWallFunction", "nutkWallFunction")


def test_cells_start_with_the_profile(small_run: Path, tmp_path: Path) -> None:
    case = tmp_path / "case"
    export_run(small_run, case, name="openfoam", options={"case": "wind", "direction": [180.0]})
    mesh = read_poly_mesh(case / MESH)
    ground = mesh.points[mesh.faces[mesh.patch_of("south")]][..., 2].min()
    height = np.maximum(centres_of(mesh)[:, 2] - ground, 0.0)
    velocity = read_field(case / "0" / "U", 3)
    assert np.allclose(velocity[:, 1], Wind().speed_at(height), atol=1e-6)
    assert np.all(velocity[:, [0, 2]] == 0)
    assert np.allclose(read_field(case / "0" / "epsilon", 1)[:, 0], Wind().epsilon_at(height), atol=1e-6)
    parts = tmp_path / "parts"
    export_run(small_run, parts, name="openfoam", options={"case": "wind", "direction": [180.0], "parts": 3})
    for n in range(3):
        cell = read_labels(parts / f"processor{n}" / MESH / "cellProcAddressing")
        start = parts / f"processor{n}" / "0" / "U"
        assert np.array_equal(read_field(start, 3), velocity[cell])
        # On faces towards another part stand the values of its cells.
        part = read_poly_mesh(parts / f"processor{n}" / MESH)
        for name, patch in part.patches.items():
            if patch.kind == "processor":
                beyond = int(patch.words["neighbProcNo"])
                other = read_poly_mesh(parts / f"processor{beyond}" / MESH)
                owner = other.owner[other.patch_of(f"procBoundary{beyond}to{n}")]
                to = read_labels(parts / f"processor{beyond}" / MESH / "cellProcAddressing")
                data = start.read_bytes()
                at = data.index(f"{name} {{ type processor; value nonuniform List<vector> {patch.n}\n(".encode())
                values = np.frombuffer(data, "<f8", 3 * patch.n, data.index(b"(", at) + 1).reshape(-1, 3)
                assert np.array_equal(values, velocity[to[owner]])


def test_what_the_mesh_does_not_allow_is_said(
    small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", str(small_run), "--format", "openfoam", "-o", str(tmp_path / "case")]
    assert main([*command, "--direction", "240"]) == 2
    assert "--direction: is for --case wind; give that too" in capsys.readouterr().err
    assert main([*command, "--case", "wind", "--patch-roughness", "water=0.001"]) == 2
    assert (
        "--patch-roughness water: the mesh has no such patch that is solid; it has ground"
        in capsys.readouterr().err
    )
    assert list(tmp_path.iterdir()) == []
    assert main([*command, "--case", "wind", "--roughness", "0.001", "--patch-roughness", "ground=20"]) == 0
    said = capsys.readouterr().out
    assert "wind from 270 degrees: in by west, out by east; slip along south, north; slip at the top" in said
    assert "the top follows the terrain and is a slip wall" in said
    assert re.search(r"warning: [\d,]+ of [\d,]+ cells on ground \(100%\) have their centre within 50 m", said)
    assert "z0 uniform 20.0;" in (tmp_path / "case" / "0" / "nut").read_text()


def test_distances_of_first_cells_by_hand() -> None:
    # A cell of 4 m over the ground, and one of 0.4 m at a slope of 45 degrees: centres 1 m and 0.1/sqrt(2) m off.
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 4], [1, 0, 1], [0, 0, 0.4]])
    centres = points[[[0, 1, 2, 3], [0, 4, 2, 5]]].mean(axis=1)
    counts = count_distances(centres, points, np.array([[0, 2, 1], [0, 2, 4]]))
    found = np.flatnonzero(counts)
    assert counts.sum() == 2
    assert [DISTANCES[k - 1] <= d <= DISTANCES[k] for k, d in zip(found, (0.0707, 1.0), strict=True)] == [True] * 2


def centres_of(mesh: PolyMesh) -> Floats:
    """Centre of each tetrahedron: the mean of the centres of its faces."""
    middle = mesh.points[mesh.faces].mean(axis=1)
    total = np.zeros((mesh.n_cells, 3))
    for cells in (mesh.owner, mesh.neighbour):
        np.add.at(total, cells, middle[: len(cells)])
    return total / 4


def run_wind(run: Path, case: Path, iterations: int, **options: Any) -> Path:
    export_run(run, case, name="openfoam", options={"case": "wind", **options})
    control = case / "system" / "controlDict"
    text = re.sub(r"endTime +\d+;", f"endTime {iterations};", control.read_text())
    control.write_text(re.sub(r"writeInterval +\d+;", f"writeInterval {iterations};", text))
    run_foam("simpleFoam", case)
    return case / str(max(int(path.name) for path in case.iterdir() if path.name.isdigit()))


def outlet_off(case: Path, end: Path, direction: float, wind: Wind) -> Floats:
    """How far speeds at the outlet are off those of the inlet: means of faces by height, 0 without any."""
    run_foam("postProcess", case, "-func", "writeCellCentres", "-latestTime")
    sides = ("east", "north") if direction == 240.0 else ("east",)
    velocity, places = (np.concatenate([read_patch(end / name, side, 3) for side in sides]) for name in "UC")
    (mesh,) = json.loads((case / "export.json").read_text())["meshes"]
    height = places[:, 2] - min(mesh["lowest"][side] for side in sides)
    ratio = velocity @ (*flow_of(direction), 0.0) / wind.speed_at(height)
    row = np.digitize(height, [1.0, 2.0, 3.0, 4.0, 6.0, 10.0, 15.0, 25.0, 40.0])
    return np.array([ratio[row == k].mean() if k in row else 1.0 for k in range(10)]) - 1.0


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("mesher", "cells", "direction"), [("adaptive", {}, 240.0), ("layered", {"cells": "prism"}, 270.0)]
)
def test_the_profile_at_the_outlet_is_that_of_the_inlet(
    flat_runs: Mapping[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mesher: str,
    cells: dict[str, str],
    direction: float,
) -> None:
    """What the logarithmic profile becomes over bare ground is kept within 2 % in all rows, from any direction."""
    log, table = Wind((270.0,), roughness=0.03), tmp_path / "inlet.csv"
    case = tmp_path / "log"
    end = run_wind(flat_runs[mesher], case, 200, direction=[270.0], roughness=0.03, **cells)
    assert mesh_is_ok(run_foam("checkMesh", case))
    assert 0.02 < np.abs(outlet_off(case, end, 270.0, log)).max() < 0.05
    assert main(["wind", str(case), "--profile", str(table)]) == 0
    case = tmp_path / "kept"
    end = run_wind(
        flat_runs[mesher], case, 200, direction=[direction], roughness=0.03, wind_table=str(table), **cells
    )
    off = outlet_off(case, end, direction, replace(log, table=read_wind_table(table)))
    assert np.abs(off).max() < 0.02, off
    capsys.readouterr()
    assert main(["wind", str(case), "--profile", str(table), "--overwrite"]) == 0
    said = re.search(r"speeds at the outlet are (\S+)% to (\S+)% off those of the inlet", capsys.readouterr().out)
    assert said
    assert -4.0 < float(said[1]) < float(said[2]) < 4.0  # rows of a few faces of tetrahedra are not that even


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_table_enters_as_it_is(flat_runs: Mapping[str, Path], tmp_path: Path) -> None:
    """After an iteration the faces of both sides that the wind enters have what the table says at their height."""
    table = tmp_path / "wind.csv"
    table.write_text("height,speed,k,epsilon\n0,0,0.5,0.5\n20,4,0.4,0.02\n60,6,0.2,0.01\n")
    case = tmp_path / "case"
    end = run_wind(flat_runs["adaptive"], case, 1, direction=[240.0], wind_table=str(table))
    mesh, given = read_poly_mesh(case / MESH), np.loadtxt(table, delimiter=",", skiprows=1)
    flow = np.array([*flow_of(240.0), 0.0])
    ground = min(mesh.points[mesh.faces[mesh.patch_of(side)]][..., 2].min() for side in ("west", "south"))
    for side in ("west", "south"):
        rows = mesh.patch_of(side)
        height = mesh.points[mesh.faces[rows]].mean(axis=1)[:, 2] - ground
        for name, column in (("U", 1), ("k", 2), ("epsilon", 3)):
            values = read_patch(end / name, side, 3 if name == "U" else 1)
            found = values @ flow if name == "U" else values[:, 0]
            assert np.allclose(found, np.interp(height, given[:, 0], given[:, column]), rtol=1e-6), (side, name)
    record = json.loads((case / "export.json").read_text())
    assert record["wind"]["table"]["speed"] == [0.0, 4.0, 6.0]


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_wind_is_sampled_above_each_triangle_of_the_ground(small_run: Path, tmp_path: Path) -> None:
    case = tmp_path / "case"
    run_wind(small_run, case, 3, direction=[240.0])
    table = np.loadtxt(case / "postProcessing" / "pedestrian" / "3" / "U_pedestrian.raw")
    mesh = read_poly_mesh(case / MESH)
    ground = mesh.points[mesh.faces[mesh.patch_of("ground")]].mean(axis=1)
    assert len(table) == len(ground)
    expected = ground[np.lexsort(ground.T)] + np.array([0.0, 0.0, 1.75])
    assert np.allclose(table[np.lexsort(table[:, :3].T), :3], expected, atol=1e-3)


def test_a_direction_without_a_side_to_leave_by_is_refused(small_run: Path, tmp_path: Path) -> None:
    from tiler.export.wind_case import Domain, write_wind_cases

    heights = {"west": 0.0, "top": 50.0, "ground": 0.0}
    domain = Domain({"west": 4, "top": 4, "ground": 8}, heights, heights, ())
    with pytest.raises(ConfigError, match="--direction 270: the mesh has no side by which the wind could leave"):
        write_wind_cases(tmp_path, domain, Wind(), parts=None)
