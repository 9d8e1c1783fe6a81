"""Step 1.2 at the edge: which footprints are read, in which CRS, under which ids."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import Footprints, make_ids
from pipeline.data.errors import ConfigError, InputError
from pipeline.data.notes import Note, count_notes
from tests.helpers.footprint_reading import read_footprint_crs, read_footprints

RD = pyproj.CRS("EPSG:28992")
WGS84 = pyproj.CRS("EPSG:4326")
X, Y = 120000.0, 486000.0
BOX = (X, Y, X + 100, Y + 100)


def square(x: float, y: float, size: float = 10) -> Any:
    return shapely.box(X + x, Y + y, X + x + size, Y + y + size)


def write(
    path: Path,
    geometry: list[Any],
    fields: dict[str, Any] | None = None,
    *,
    crs: str | None = "EPSG:28992",
    **options: Any,
) -> Path:
    fields = fields or {}
    pyogrio.raw.write(
        path,
        shapely.to_wkb(np.array(geometry, object)),
        [np.array(values) for values in fields.values()],
        list(fields),
        geometry_type=options.pop("geometry_type", "Unknown"),
        crs=crs,
        **options,
    )
    return path


def read(path: Path, **options: Any) -> tuple[Footprints, tuple[Note, ...]]:
    return read_footprints(path, **{"crs": RD, "bounds": BOX, **options})


def same_shapes(one: NDArray[np.object_], other: list[Any]) -> bool:
    shapes = shapely.normalize(np.array(other, object))
    return bool(shapely.equals_identical(shapely.normalize(one), shapes).all())


@pytest.mark.parametrize("name", ["a.shp", "a.gpkg", "a.geojson", "a.fgb"])
def test_formats(tmp_path: Path, name: str) -> None:
    shapes = [square(5, 5), square(20, 5).difference(square(22, 7, 2))]
    path = write(tmp_path / name, shapes, {"uuid": ["b", "a"], "h": [3.5, 8.0]}, geometry_type="Polygon")
    footprints, notes = read(path, height_attribute="h")
    assert read_footprint_crs(path) == RD
    assert footprints.ids.tolist() == ["a", "b"]
    assert footprints.given_height.tolist() == [8.0, 3.5]
    assert same_shapes(footprints.polygons, shapes[::-1])
    assert notes == ()


def write_parquet(path: Path, shapes: list[Any], fields: dict[str, Any], **column: Any) -> Path:
    import json

    import pyarrow as pa
    import pyarrow.parquet as pq

    meta = {
        "version": "1.1.0",
        "primary_column": "geometry",
        "columns": {"geometry": {"encoding": "WKB", **column}},
    }
    table = pa.table({**fields, "geometry": shapely.to_wkb(np.array(shapes, object)).tolist()})
    pq.write_table(table.replace_schema_metadata({"geo": json.dumps(meta)}), path)
    return path


def test_geoparquet(tmp_path: Path) -> None:
    corner = shapely.Polygon([(X - 9, Y + 5), (X + 5, Y - 9), (X - 9, Y - 9)])  # its box meets, it does not
    shapes = [shapely.force_3d(square(5, 5), 7.0), square(500, 5), square(20, 5), None, corner]
    fields = {"uuid": ["b", "far", "a", "none", "corner"], "h": [3.5, 1.0, None, 2.0, 3.0]}
    path = write_parquet(tmp_path / "a.parquet", shapes, fields, crs=RD.to_json_dict())
    footprints, notes = read(path, height_attribute="h")
    assert read_footprint_crs(path) == RD
    assert footprints.ids.tolist() == ["a", "b"]
    assert same_shapes(footprints.polygons, [square(20, 5), square(5, 5)])
    assert not shapely.has_z(footprints.polygons).any()
    np.testing.assert_array_equal(footprints.given_height, [np.nan, 3.5])
    assert count_notes(notes) == {"footprint-height-missing": 1, "footprints-without-geometry": 1}


def test_geoparquet_says_nothing_unknown_or_nonsense(tmp_path: Path) -> None:
    degrees = write_parquet(tmp_path / "degrees.parquet", [square(5, 5)], {}, bbox=[X, Y, X + 10, Y + 10])
    assert read_footprint_crs(degrees) == pyproj.CRS("OGC:CRS84")
    with pytest.raises(InputError, match="its coordinates reach 486010"):
        read(degrees)
    unknown = write_parquet(tmp_path / "unknown.parquet", [square(5, 5)], {}, crs=None)
    assert read_footprint_crs(unknown) is None
    assert count_notes(read(unknown)[1]) == {"footprints-without-crs": 1}
    other = write_parquet(tmp_path / "other.parquet", [square(5, 5)], {}, encoding="WKT")
    with pytest.raises(InputError, match="has geometries as WKT; write them as WKB"):
        read(other)
    wrong = write_parquet(tmp_path / "wrong.parquet", [square(5, 5)], {}, encoding="polygon")
    with pytest.raises(InputError, match="binary is no polygon of GeoArrow"):
        read(wrong)
    cut = tmp_path / "cut.parquet"
    cut.write_bytes(unknown.read_bytes()[:-20])
    with pytest.raises(InputError, match="cut.parquet: cannot be read as GeoParquet".replace(".", r"\.")):
        read(cut)
    with pytest.raises(ConfigError, match="Parquet has no layers"):
        read(unknown, layer="x")


def test_only_what_meets_the_box(tmp_path: Path) -> None:
    corner = shapely.Polygon([(X - 9, Y + 5), (X + 5, Y - 9), (X - 9, Y - 9)])  # its box meets, it does not
    shapes = [square(-10, 50), square(-20, 50), square(95, 95), corner]
    footprints, _ = read(write(tmp_path / "a.geojson", shapes, {"id": ["touches", "off", "over", "corner"]}))
    assert footprints.ids.tolist() == ["over", "touches"]


def test_another_crs_is_reprojected(tmp_path: Path) -> None:
    shapes = [square(10 * i, 90, 5) for i in range(10)] + [square(50, 100.5), square(-300, 50)]
    forward = pyproj.Transformer.from_crs(RD, WGS84, always_xy=True)
    there = shapely.transform(np.array(shapes, object), forward.transform, interleaved=False)
    path = write(tmp_path / "a.gpkg", list(there), {"id": [f"{i:02}" for i in range(12)]}, crs="EPSG:4326")
    footprints, notes = read(path)
    assert footprints.ids.tolist() == [f"{i:02}" for i in range(10)]
    assert (shapely.hausdorff_distance(footprints.polygons, np.array(shapes[:10], object)) < 1e-3).all()
    assert [(note.kind, note.detail) for note in notes] == [
        ("footprints-reprojected", "from EPSG:4326 to EPSG:28992")
    ]


def test_a_region_that_the_footprints_crs_cannot_hold(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", [square(5, 5)], crs="EPSG:28992")
    with pytest.raises(InputError, match="has no place in EPSG:28992"):
        read(path, crs=pyproj.CRS("EPSG:3035"), bounds=(9e7, 9e7, 9.1e7, 9.1e7))


def test_no_crs_is_the_regions_and_told(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="crs"):
        path = write(tmp_path / "a.gpkg", [square(5, 5)], {"id": ["a"]}, crs=None)
    assert read_footprint_crs(path) is None
    footprints, notes = read(path)
    assert footprints.ids.tolist() == ["a"]
    told = [(note.kind, note.subject, note.detail) for note in notes]
    assert told == [("footprints-without-crs", "a.gpkg", "taken as EPSG:28992, the region's CRS")]


@pytest.mark.parametrize("form", ["geometry", "feature", "collection"])
def test_metres_in_a_geojson_without_crs_are_no_degrees(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.geojson"
    shape = shapely.to_geojson(square(5, 5))
    feature = f'{{"type":"Feature","properties":{{}},"geometry":{shape}}}'
    collection = f'{{"type":"FeatureCollection","features":[{feature}]}}'
    path.write_text({"geometry": shape, "feature": feature, "collection": collection}[form])
    with pytest.raises(InputError, match=r"EPSG:4326 \(degrees\), but its coordinates reach 486015"):
        read(path)


def test_only_polygons(tmp_path: Path) -> None:
    multi = shapely.MultiPolygon([square(5, 5), square(20, 20)])
    shapes = [multi, shapely.Point(X + 1, Y + 2), shapely.LineString([(X, Y), (X + 4, Y + 2)]), None]
    shapes += [shapely.force_3d(square(40, 40), 7.0), shapely.GeometryCollection([square(50, 50)])]
    footprints, notes = read(write(tmp_path / "a.gpkg", shapes, {"id": list("abcdef")}))
    assert footprints.ids.tolist() == ["a", "e", "f"]
    assert same_shapes(footprints.polygons, [multi, square(40, 40), square(50, 50)])
    assert not shapely.has_z(footprints.polygons).any()
    assert count_notes(notes) == {
        "footprint-not-polygon": 2,
        "footprint-outline-of-surface": 1,
        "footprints-without-geometry": 1,
    }
    assert (notes[0].subject, notes[0].x, notes[0].y) == ("b", X + 1, Y + 2)
    assert notes[0].detail == "feature 2: is a point"
    assert notes[1].detail == "feature 3: is an open line: its ends are 4.47 m apart"


def test_broken_geometries_are_kept_or_told(tmp_path: Path) -> None:
    bow = f"[[{X},{Y}],[{X + 9},{Y + 9}],[{X + 9},{Y}],[{X},{Y + 9}],[{X},{Y}]]"
    bad = f"[[{X},{Y}],[{X + 9},{Y + 9}],[{X + 9},NaN],[{X},{Y}]]"
    path = tmp_path / "a.geojson"
    text = ",".join(
        f'{{"type":"Feature","properties":{{"id":"{name}"}},"geometry":{{"type":"Polygon","coordinates":[{ring}]}}}}'
        for name, ring in (("bow", bow), ("bad", bad))
    )
    crs = '"crs":{"type":"name","properties":{"name":"EPSG:28992"}}'
    path.write_text(f'{{"type":"FeatureCollection",{crs},"features":[{text}]}}')
    footprints, notes = read(path)
    assert footprints.ids.tolist() == ["bow"]
    assert not shapely.is_valid(footprints.polygons).any()
    assert count_notes(notes) == {"footprint-not-finite": 1}


def test_what_the_reader_warns_of_is_told(tmp_path: Path) -> None:
    ring = f"[[{X},{Y}],[{X + 9},{Y + 9}],[{X + 9},{Y}]]"
    shape = f'{{"type":"Feature","properties":{{}},"geometry":{{"type":"Polygon","coordinates":[{ring}]}}}}'
    path = tmp_path / "a.geojson"
    crs = '"crs":{"type":"name","properties":{"name":"EPSG:28992"}}'
    path.write_text(f'{{"type":"FeatureCollection",{crs},"features":[{shape},{shape}]}}')
    footprints, notes = read(path)
    assert len(footprints.ids) == 2
    assert count_notes(notes) == {"footprints-reader-warning": 1}
    assert "Non closed ring" in notes[0].detail


def test_ids_by_name_of_the_attribute(tmp_path: Path) -> None:
    fields = {"GID": [7, 8], "Identificatie": ["B", "A"], "name": ["n", "m"]}
    path = write(tmp_path / "a.gpkg", [square(5, 5), square(20, 5)], fields)
    assert read(path)[0].ids.tolist() == ["A", "B"]
    assert read(path, id_attribute="GID")[0].ids.tolist() == ["7", "8"]
    with pytest.raises(ConfigError, match=r"no attribute 'id'; it has: GID, Identificatie, name"):
        read(path, id_attribute="id")
    with pytest.raises(ConfigError, match="no attribute 'height'"):
        read(path, height_attribute="height")


def test_ids_from_geometry(tmp_path: Path) -> None:
    shapes = [square(5, 5), square(20, 5), square(35, 5)]
    bare, _ = read(write(tmp_path / "bare.gpkg", shapes, {"name": ["x", "x", "x"]}))
    assert bare.ids.tolist() == sorted(make_ids(np.array(shapes, object)).tolist())
    turned, _ = read(write(tmp_path / "turned.gpkg", shapes[::-1]))
    assert turned.ids.tolist() == bare.ids.tolist()
    assert same_shapes(turned.polygons, list(bare.polygons))
    null = np.array(["id-1", None, " "], object)
    footprints, notes = read(write(tmp_path / "null.gpkg", shapes, {"id": null}))
    assert set(footprints.ids.tolist()) == {"id-1", *make_ids(np.array(shapes[1:], object)).tolist()}
    assert count_notes(notes) == {"footprint-id-missing": 2}


def test_numeric_ids_with_nulls_stay_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", [square(5, 5), square(20, 5)], {"id": [363100012078463.0, np.nan]})
    assert "363100012078463" in read(path)[0].ids.tolist()


def test_repeated_ids_are_told_apart(tmp_path: Path) -> None:
    shapes = [square(5, 5), square(20, 5), square(35, 5), square(35, 5)]
    footprints, notes = read(write(tmp_path / "a.gpkg", shapes, {"id": ["a", "a", "twin", "twin"]}))
    made = make_ids(np.array(shapes, object))
    assert footprints.ids.tolist() == sorted(["a-" + made[0], "a-" + made[1], "twin", "twin"])
    assert count_notes(notes) == {"footprint-id-repeated": 2}


def test_heights_must_be_positive_numbers(tmp_path: Path) -> None:
    shapes = [square(15 * i, 5) for i in range(6)]
    heights = np.array(["7.5", "8 storeys", None, "-1", "0", "inf"], object)
    path = write(tmp_path / "a.gpkg", shapes, {"id": list("abcdef"), "h": heights})
    footprints, notes = read(path, height_attribute="h")
    np.testing.assert_array_equal(footprints.given_height, [7.5, *[np.nan] * 5])
    assert count_notes(notes) == {"footprint-height-missing": 5}
    assert notes[0].subject == "b"
    assert "8 storeys" in notes[0].detail
    assert np.isnan(read(path)[0].given_height).all()


def test_no_features_are_fine(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    path.write_text('{"type":"FeatureCollection","features":[]}')
    footprints, _ = read(path, id_attribute="id", height_attribute="h")
    assert len(footprints.polygons) == len(footprints.ids) == len(footprints.given_height) == 0


def test_footprints_elsewhere_are_told(tmp_path: Path) -> None:
    footprints, notes = read(write(tmp_path / "a.gpkg", [square(500, 500)], {"id": ["a"]}))
    assert len(footprints.ids) == 0
    assert [note.kind for note in notes] == ["footprints-outside"]
    assert "120500, 486500, 120510, 486510" in notes[0].detail


def test_layers_must_be_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", [square(5, 5)], {"id": ["one"]}, layer="one")
    write(path, [square(5, 5)], {"id": ["two"]}, layer="two", append=True)
    assert read(path, layer="two")[0].ids.tolist() == ["two"]
    with pytest.raises(ConfigError, match=r"has 2 layers; name one of them: one, two"):
        read(path)
    with pytest.raises(ConfigError, match=r"no layer 'three'; its layers are: one, two"):
        read_footprint_crs(path, "three")
    table = tmp_path / "table.gpkg"
    pyogrio.raw.write(table, geometry=None, field_data=[np.array(["1"])], fields=["id"], geometry_type=None)
    with pytest.raises(InputError, match="no layer with geometries"):
        read(table)


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    text = tmp_path / "text.gpkg"
    text.write_text("no geopackage")
    cut = write(tmp_path / "cut.geojson", [square(5, 5)])
    cut.write_bytes(cut.read_bytes()[:-30])
    for path, reason in (
        (text, "cannot be read"),
        (cut, "cannot be read"),
        (tmp_path / "gone.shp", "no such file"),
    ):
        with pytest.raises(InputError, match=reason) as caught:
            read(path)
        assert str(path) in str(caught.value)
        with pytest.raises(InputError, match=reason):
            read_footprint_crs(path)


def test_shapefiles_with_parts_missing_or_cut(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    whole.mkdir()
    write(whole / "a.shp", [square(5, 5), square(20, 5)], {"id": ["a", "b"]}, geometry_type="Polygon")

    def part(name: str, *, without: str = "", cut: str = "") -> Path:
        shutil.copytree(whole, tmp_path / name)
        path = tmp_path / name / "a.shp"
        if without:
            path.with_suffix(without).unlink()
        if cut:
            torn = path.with_suffix(cut)
            torn.write_bytes(torn.read_bytes()[:-40])
        return path

    with pytest.raises(InputError, match="SHAPE_RESTORE_SHX YES mended"):
        read(part("no index", without=".shx"))
    with pytest.raises(InputError, match=r"a\.shp: has \d+ of the \d+ bytes"):
        read(part("torn", cut=".shp"))
    with pytest.raises(InputError, match=r"a\.dbf: has \d+ of the \d+ bytes"):
        read(part("torn table", cut=".dbf"))
    assert count_notes(read(part("no crs", without=".prj"))[1]) == {"footprints-without-crs": 1}
    bare, _ = read(part("no table", without=".dbf"))
    assert bare.ids.tolist() == sorted(make_ids(bare.polygons).tolist())


@pytest.mark.shared
def test_real_footprints(shared_data: Path) -> None:
    folder = shared_data / "amsterdam"
    box = (120625.0, 485936.8, 121250.46, 486523.26)  # of the cloud
    shp, told = read(folder / "footprints.shp", bounds=box)
    gpkg, _ = read(folder / "footprints.gpkg", bounds=box)
    assert told == ()
    assert len(shp.ids) == 1128
    assert shp.ids.tolist() == gpkg.ids.tolist()  # though the attribute's name is cut in SHP
    assert all(len(name) == 16 for name in shp.ids)
    west, _ = read(
        shared_data / "amsterdam_west_small" / "footprints.shp", bounds=(119000, 485000, 120000, 486000)
    )
    assert len(west.ids) == 452
    assert len(np.unique(west.ids)) == 452


@pytest.mark.shared
def test_nasty_footprints(shared_data: Path) -> None:
    path = shared_data / "nasty_footprints.geojson"
    crs = pyproj.CRS("EPSG:3857")
    footprints, notes = read(path, crs=crs, bounds=(-10, -10, 5000, 5000))
    assert len(footprints.ids) == 352
    assert notes == ()
    assert not shapely.is_valid(footprints.polygons).all()
