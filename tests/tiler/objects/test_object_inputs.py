"""Inputs of web servers: point clouds and GeoParquet by ranges, other files fetched once; what fails is told."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely

from pipeline.data.errors import InputError
from tests.helpers.footprint_reading import read_footprint_crs, read_footprints
from tests.helpers.object_servers import FileServer, file_server
from tests.helpers.whole_clouds import read_points
from tests.tiler.stages.test_ingest import write_copc
from tests.tiler.vectors.test_vectors import RD, write_parquet
from tiler.objects.places import identify, place
from tiler.objects.requests import StoreUnreachableError
from tiler.objects.results import local_copy
from tiler.pointclouds.clouds import find_clouds, read_header
from tiler.pointclouds.ingest import read_cells

pytest.importorskip("obstore")
ORIGIN = np.array([120_000.0, 480_000.0, 0.0])
SQUARES = [shapely.box(x, 0, x + 5, 5) for x in range(0, 100, 10)]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("served")
    rng = np.random.default_rng(3)
    xyz = ORIGIN + np.round(rng.uniform((-500, -500, 0), (500, 500, 20), (150_000, 3)), 2)
    write_copc(folder / "city.copc.laz", xyz, np.full(len(xyz), 2, np.uint8), depth=4, origin=ORIGIN)
    write_parquet(folder / "houses.parquet", SQUARES, {"id": list("abcdefghij")}, crs=RD.to_json_dict())
    pyogrio.raw.write(
        folder / "houses.gpkg",
        geometry=np.array([shapely.to_wkb(square) for square in SQUARES], object),
        field_data=[np.array(list("abcdefghij"), object)],
        fields=["id"],
        geometry_type="Polygon",
        crs="EPSG:28992",
        driver="GPKG",
    )
    return folder


@pytest.fixture
def served(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with file_server(files) as server:
        yield server


def test_a_copc_file_is_read_by_its_octree_over_http(files: Path, served: FileServer) -> None:
    (path,) = find_clouds([f"{served.url}/city.copc.laz"])
    disk = files / "city.copc.laz"
    assert read_header(path).bounds == read_header(disk).bounds
    served.n_bytes = 0
    x, y = ORIGIN[:2]
    box = (x - 400, y - 400, x - 330, y - 330)
    found, expected = (list(read_cells(source, box)) for source in (path, disk))
    assert sum(len(block.units) for block in expected) > 100
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.units, other.units)
        assert one.counts == other.counts
    assert served.n_bytes < disk.stat().st_size / 2
    whole = (x - 600, y - 600, x + 600, y + 600)
    cloud, counts = read_points(f"{served.url}/city.copc.laz", whole)
    np.testing.assert_array_equal(cloud.xyz, read_points(disk, whole)[0].xyz)
    assert counts["kept"] == 150_000


@pytest.mark.parametrize("name", ["houses.parquet", "houses.gpkg"])
def test_footprints_of_a_server_are_those_of_the_file(files: Path, served: FileServer, name: str) -> None:
    url, box = f"{served.url}/{name}", (8.0, 0.0, 48.0, 9.0)
    assert read_footprint_crs(url) == RD
    found, notes = read_footprints(url, crs=RD, bounds=box)
    expected, others = read_footprints(files / name, crs=RD, bounds=box)
    np.testing.assert_array_equal(found.ids, expected.ids)
    assert shapely.equals_exact(found.polygons, expected.polygons).all()
    assert (len(found.ids), notes) == (4, others)


def test_a_file_is_fetched_once_for_all_processes_and_again_when_it_changes(
    files: Path, served: FileServer, tmp_path: Path
) -> None:
    path, disk = place(f"{served.url}/houses.gpkg"), files / "houses.gpkg"
    copy = local_copy(path)
    assert copy.is_relative_to(tmp_path)
    assert copy.name == "houses.gpkg"
    assert copy.read_bytes() == disk.read_bytes()
    served.n_bytes, first = 0, identify(path)
    assert local_copy(path) == copy
    assert served.n_bytes == 0
    os.utime(disk, (1, 1))
    assert identify(path) != first
    assert local_copy(path) != copy
    folder = copy.parent.parent
    folder.chmod(0o777)
    with pytest.raises(InputError, match="is not this user's alone"):
        local_copy(path)


def test_what_a_server_refuses_is_told(files: Path, served: FileServer) -> None:
    for name, reason in (("none.laz", "no such object"), ("secret.laz", "access denied")):
        with pytest.raises(InputError, match=f"{name}: cannot be read .{reason}"):
            find_clouds([f"{served.url}/{name}"])
        with pytest.raises(InputError, match=reason):
            read_footprint_crs(f"{served.url}/{name.replace('laz', 'gpkg')}")
    served.ranges = False
    with pytest.raises(InputError, match="gives no ranges of files; download"):
        read_header(place(f"{served.url}/city.copc.laz"))
    with file_server(files) as other:
        url = other.url
    with pytest.raises(StoreUnreachableError, match="no connection"):
        read_header(place(f"{url}/city.copc.laz", patience=0.2))
