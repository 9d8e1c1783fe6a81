"""GeoPackages with a layer for each level of detail, as of 3DBAG."""

from collections import Counter
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
import shapely.affinity

from pipeline.data.errors import InputError
from tests.tiler.cityinput.models import CORNERS, FACES, PLACE
from tiler.cityinput.faces import ModelBuilding
from tiler.cityinput.rows import make_rows
from tiler.cityinput.sources import kind_of, read_model_header, scan_model
from tiler.georeference.frame import Frame


def solid_of(dx: float = 0.0, *, scale: float = 1.0) -> shapely.MultiPolygon:
    """All faces of the house; its heights times a factor."""
    xyz = np.array(CORNERS) * [1, 1, scale] + np.array(PLACE) + [dx, 0, 0]
    return shapely.MultiPolygon([shapely.Polygon(xyz[ring]) for rings in FACES.values() for ring in rings])


def write(path: Path, layers: dict[str, tuple[list[str], list[shapely.Geometry]]]) -> Path:
    for layer, (ids, shapes) in layers.items():
        flat = not shapely.has_z(np.array(shapes)).any()
        pyogrio.raw.write(
            path,
            np.array(shapely.to_wkb(shapes, flavor="iso"), object),
            [np.array(ids, object)],
            ["identificatie"],
            geometry_type="MultiPolygon" if flat else "MultiPolygon Z",
            crs="EPSG:7415" if not flat else "EPSG:28992",
            layer=layer,
            append=path.exists(),
            driver="GPKG",
        )
    return path


@pytest.fixture
def package(tmp_path: Path) -> Path:
    outline = shapely.MultiPolygon([shapely.box(100_000, 450_000, 100_010, 450_008)])
    return write(
        tmp_path / "bag.gpkg",
        {
            "pand": (["b", "a"], [shapely.affinity.translate(outline, 50), outline]),
            "lod22_3d": (["a"], [solid_of()]),
            "lod12_3d": (["b", "a"], [solid_of(50), solid_of(scale=2)]),
        },
    )


def test_levels_of_layers_come_together_by_id(package: Path) -> None:
    assert kind_of(package) == "model"
    found = [each for each in scan_model(package) if isinstance(each, ModelBuilding)]
    assert [(one.id, sorted(shape.lod for shape in one.shapes)) for one in found] == [
        ("a", [0.0, 1.2, 2.2]), ("b", [0.0, 1.2]),
    ]  # fmt: skip
    rows, notes = make_rows(found, Frame(), "auto", Counter())
    assert (rows.lod.tolist(), notes) == ([2.2, 1.2], [])
    assert shapely.area(rows.outlines) == pytest.approx([80.0, 80.0])


def test_a_header_has_crs_and_extent(package: Path) -> None:
    header = read_model_header(package)
    assert header.crs is not None
    assert header.crs.name.startswith("Amersfoort")
    assert header.n_buildings == 2
    assert header.bounds[:4] == (100_000.0, 450_000.0, 100_060.0, 450_008.0)


def test_footprints_alone_are_refused_with_the_option(tmp_path: Path) -> None:
    box = shapely.MultiPolygon([shapely.box(0, 0, 1, 1)])
    path = write(tmp_path / "a.gpkg", {"houses": (["a"], [box])})
    with pytest.raises(InputError, match="footprints are taken by --footprints"):
        read_model_header(path)


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.gpkg").write_bytes(b"SQLite format 3\0" + b"\1" * 200)
    with pytest.raises(InputError, match="cannot be read as a GeoPackage"):
        read_model_header(tmp_path / "a.gpkg")
