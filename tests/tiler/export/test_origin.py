"""Coordinates that count from a place of their own: the same numbers less that place, in every format."""

import json
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
import pyvista
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from tests.helpers.foam_reader import read_poly_mesh
from tests.tiler.export.conftest import Exported
from tiler.cli.main import main
from tiler.cli.negative_values import mark_values
from tiler.export.export import export_run, list_formats, load_format
from tiler.wind.results import open_case, read_triangles

ORIGIN = (317_990.0, 6_399_000.0, -5.0)
WITHOUT = {"3dtiles", "cityjsonseq", "glb", "gpkg"}
TEXT = "317990,6399000,-5"


def points_of(path: Path, name: str) -> NDArray[np.float64]:
    """All points of a file, in its order."""
    if name in ("msh", "msh2"):
        return np.asarray(meshio.read(path).points)
    if name in ("obj", "stl"):
        begin = "v " if name == "obj" else "vertex "
        lines = map(str.strip, path.read_text().splitlines())
        return np.array([line.split()[1:] for line in lines if line.startswith(begin)], float)
    readers = {"openfoam": read_foam, "xdmf": read_hdf5, "cgns": read_hdf5, "vtkhdf": read_hdf5, "ply": read_ply}
    return readers[name](path) if name in readers else np.asarray(pyvista.read(path).points)


def read_foam(path: Path) -> NDArray[np.float64]:
    return read_poly_mesh(path / "constant/polyMesh").points


def read_hdf5(path: Path) -> NDArray[np.float64]:
    with h5py.File(path.with_suffix(".h5") if path.suffix == ".xdmf" else path) as file:
        if path.suffix == ".cgns":
            axes = [file[f"city/air/GridCoordinates/Coordinate{axis}/ data"][:] for axis in "XYZ"]
            return np.column_stack(axes)
        points: NDArray[np.float64] = file["points" if path.suffix == ".xdmf" else "VTKHDF/mesh/Points"][:]
        return points


def read_ply(path: Path) -> NDArray[np.float64]:
    head, data = path.read_bytes().split(b"end_header\n", 1)
    n = int(head.split(b"element vertex ")[1].split()[0])
    return np.frombuffer(data[: 24 * n], "<f8").reshape(-1, 3)


@pytest.mark.parametrize("name", sorted(set(list_formats()) - WITHOUT))
def test_points_are_those_of_the_crs_less_the_origin(
    small_run: Path, exported: Exported, tmp_path: Path, name: str
) -> None:
    whole = exported(small_run, name)
    part = tmp_path / whole.name
    said = export_run(small_run, part, name=name, options={"origin": TEXT})
    plain, local = (points_of(path, name) for path in (whole, part))
    assert plain.shape == local.shape
    assert (plain - ORIGIN == local).all()
    assert said[0].startswith("coordinates count from 317990 6399000 -5 m, in EPSG:")
    if name in ("xdmf", "cgns", "msh", "msh2", "vtkhdf"):
        content = part.read_bytes()
        wanted = np.array(ORIGIN).tobytes() if name == "vtkhdf" else b"317990 6399000 -5"
        assert wanted in content
        assert wanted not in whole.read_bytes()


def test_a_wind_case_knows_its_place(small_run: Path, tmp_path: Path) -> None:
    found = []
    for word, options in (("plain", {}), ("local", {"origin": "auto"})):
        given: dict[str, Any] = {"case": "wind", **options}
        export_run(small_run, tmp_path / word, name="openfoam", options=given)
        found.append(read_triangles(open_case(tmp_path / word)).points)
    record = json.loads((tmp_path / "local" / "export.json").read_text())
    bounds = json.loads((small_run / "run.json").read_text())["region"]["bounds"]
    assert record["origin"] == [np.floor(bounds[0]), np.floor(bounds[1]), 0.0]
    assert "origin" not in json.loads((tmp_path / "plain" / "export.json").read_text())
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-8)


@pytest.mark.parametrize("text", ["1,2", "a,b,c", "0.5,0,0", "1e12,0,0", "nan,0,0"])
def test_an_origin_that_would_lose_digits_is_refused(small_run: Path, tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="--origin"):
        export_run(small_run, tmp_path / "a.vtu", name="vtu", options={"origin": text})


def test_formats_of_the_mesh_take_it_but_those_with_a_place_of_their_own(small_run: Path, tmp_path: Path) -> None:
    assert {name for name in list_formats() if "origin" not in load_format(name).options} == WITHOUT
    words = ["export", str(small_run), "--format", "vtp", "-o", str(tmp_path / "a.vtp"), "--origin", "-7,5,0"]
    assert mark_values(words)[-1] == "--origin=-7,5,0"
    assert main(words) == 0
    assert pyvista.read(tmp_path / "a.vtp").bounds[0] > 318_000
