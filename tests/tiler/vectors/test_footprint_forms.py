"""Step 1.2 at the edge: footprints in every form that agencies deliver, and features that cannot be read."""

import json
import shutil
import sqlite3
import struct
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio
import pyproj
import pytest
import shapely

from pipeline.data.citymodel import Footprints, make_ids
from pipeline.data.errors import ConfigError, InputError
from pipeline.data.notes import Note, count_notes
from tests.helpers.footprint_files import (
    BOX,
    RD,
    OsmTown,
    X,
    Y,
    blob,
    chain,
    face,
    square,
    write_gpkg,
    write_table,
)
from tests.helpers.footprint_reading import read_footprints
from tiler.vectors import gdal_features
from tiler.vectors.vector_forms import check_form
from tiler.workflow.summary import INCOMPLETE

SMALL = (X, Y + 1, X + 35, Y + 99)  # not all of the files here: they are asked for by their index


def read(path: Path, **options: Any) -> tuple[Footprints, tuple[Note, ...]]:
    return read_footprints(path, **{"crs": RD, "bounds": BOX, **options})


def told(notes: tuple[Note, ...], kind: str) -> list[str]:
    return [note.detail for note in notes if note.kind == kind]


def assert_outlines(footprints: Footprints, expected: list[Any]) -> None:
    assert len(footprints.ids) == len(expected)
    for polygon, outline in zip(footprints.polygons, expected, strict=True):
        assert shapely.hausdorff_distance(polygon, outline, densify=0.1) < 0.1
        assert abs(polygon.area - outline.area) < 0.01 * outline.area


# Curves

CENTRE = (X + 20, Y + 20)


def at(x: float, y: float) -> tuple[float, float]:
    return CENTRE[0] + x, CENTRE[1] + y


CIRCLE = shapely.Point(CENTRE).buffer(10, quad_segs=500)
HALF = shapely.intersection(CIRCLE, shapely.box(X, Y, *at(10, 0)))
FOUR = chain(8, [at(-10, 0), at(0, 10), at(10, 0), at(0, -10), at(-10, 0)])
ROUND_SIDE = blob(9, chain(8, [at(-10, 0), at(0, -10), at(10, 0)]), chain(2, [at(10, 0), at(-10, 0)]))
CURVES = {
    "a circle of two arcs": (blob(10, FOUR), CIRCLE),
    "a circle of one arc": (blob(10, chain(8, [at(-10, 0), at(10, 0), at(-10, 0)])), CIRCLE),
    "a compound curve": (blob(10, ROUND_SIDE), HALF),
    "a courtyard": (
        blob(10, FOUR, chain(2, [at(-2, -2), at(2, -2), at(2, 2), at(-2, -2)])),
        CIRCLE.difference(shapely.Polygon([at(-2, -2), at(2, -2), at(2, 2)])),
    ),
    "a multisurface": (blob(12, blob(10, ROUND_SIDE)), HALF),
    "a multisurface of both": (
        blob(12, blob(10, ROUND_SIDE), shapely.to_wkb(square(20, 70))),
        shapely.union(HALF, square(20, 70)),
    ),
    "a closed curve": (ROUND_SIDE, HALF),
    "curves that close": (blob(11, ROUND_SIDE), HALF),
    "with Z": (blob(1010, chain(1008, [(*at(-10, 0), 3), (*at(10, 0), 3), (*at(-10, 0), 3)])), CIRCLE),
    "with M": (blob(2010, chain(2008, [(*at(-10, 0), 3), (*at(10, 0), 3), (*at(-10, 0), 3)])), CIRCLE),
    "with Z and M": (
        blob(3010, chain(3008, [(*at(-10, 0), 3, 1), (*at(10, 0), 3, 1), (*at(-10, 0), 3, 1)])),
        CIRCLE,
    ),
}


@pytest.mark.parametrize(
    ("name", "declared"), [(name, ("GEOMETRY", "POLYGON")[k % 2]) for k, name in enumerate(CURVES)]
)
def test_arcs_become_segments(tmp_path: Path, name: str, declared: str) -> None:
    curved, outline = CURVES[name]
    path = write_gpkg(tmp_path / "a.gpkg", [curved, shapely.to_wkb(square(60, 60))], declared=declared)
    for bounds in (BOX, (X, Y, X + 69.9, Y + 69.9)):
        footprints, notes = read(path, bounds=bounds)
        assert_outlines(footprints, [outline, square(60, 60)])
        assert shapely.hausdorff_distance(footprints.polygons[0].boundary, outline.boundary) < 0.0101
        assert count_notes(notes)["footprint-curve-linearised"] == 1
        assert "feature 1: arcs made segments of 4 degrees at most" in told(notes, "footprint-curve-linearised")[0]


def test_a_round_wall_of_two_houses_is_one(tmp_path: Path) -> None:
    arc = [at(-7, -8), at(0.3, -10.1), at(8, -6.5)]
    over = blob(9, chain(8, arc), chain(2, [arc[2], at(0, 20), arc[0]]))
    under = blob(9, chain(8, arc[::-1]), chain(2, [arc[0], at(0, -19), arc[2]]))
    footprints, _ = read(write_gpkg(tmp_path / "a.gpkg", [blob(10, over), blob(10, under)]))
    one, two = (set(map(tuple, shapely.get_coordinates(polygon))) for polygon in footprints.polygons)
    assert len(one & two) > 8
    assert shapely.intersection(*footprints.polygons).area == 0


# Z, M and surfaces


@pytest.mark.parametrize("z", [0, 1, 2])
def test_layers_of_any_geometry_with_z(tmp_path: Path, z: int) -> None:
    flat = square(60, 60)
    ring = [(*xy, 2.0, 7.0) for xy in flat.exterior.coords]
    kinds = [(3, 2), (1003, 3), (2003, 3), (3003, 4)]
    blobs = [face(kind, [point[:size] for point in ring]) for kind, size in kinds]
    path = write_gpkg(tmp_path / "a # 50% & b.gpkg", [*blobs, shapely.to_wkb(shapely.force_3d(flat, 5.0))], z=z)
    footprints, _ = read(path)
    assert footprints.ids.tolist() == list("abcde")
    assert_outlines(footprints, [flat] * 5)
    assert not shapely.has_z(footprints.polygons).any()


def body(x: float, y: float, *, overhang: float = 0.0) -> list[list[tuple[float, float, float]]]:
    """Faces of a house of 12 x 8 m: ground, two roof planes, walls that stand in by an overhang."""
    x0, y0, x1, y1, e = X + x, Y + y, X + x + 12, Y + y + 8, overhang
    ground = [(x0 + e, y0 + e, 1.0), (x0 + e, y1 - e, 1.0), (x1 - e, y1 - e, 1.0), (x1 - e, y0 + e, 1.0)]
    roofs = [
        [(x0, y0, 5.0), (x1, y0, 5.0), (x1, y0 + 4, 7.0), (x0, y0 + 4, 7.0)],
        [(x0, y0 + 4, 7.0), (x1, y0 + 4, 7.0), (x1, y1, 5.0), (x0, y1, 5.0)],
    ]
    corners = [*ground, ground[0]]
    walls = [[a, b, (b[0], b[1], 5.0), (a[0], a[1], 5.0)] for a, b in pairwise(corners)]
    return [[*ring, ring[0]] for ring in (ground, *roofs, *walls)]


def triangles(x: float, y: float) -> list[bytes]:
    return [face(1017, [ring[0], *pair, ring[0]]) for ring in body(x, y) for pair in (ring[1:3], ring[2:4])]


HOUSE = shapely.box(X + 20, Y + 30, X + 32, Y + 38)
FACES = [face(1003, ring) for ring in body(20, 30)]
SURFACES = {
    "multipolygon with walls": blob(1006, *FACES),
    "polyhedral surface": blob(1015, *FACES),
    "polyhedral surface with overhangs": blob(1015, *(face(1003, ring) for ring in body(20, 30, overhang=0.5))),
    "TIN": blob(1016, *triangles(20, 30)),
    "collection of polygons": blob(1007, *FACES),
    "collection of TINs": blob(1007, blob(1016, *triangles(20, 30)[:4]), blob(1016, *triangles(20, 30)[4:])),
    "collection of polygons without Z": blob(
        7,
        shapely.to_wkb(shapely.box(X + 20, Y + 30, X + 26, Y + 38)),
        shapely.to_wkb(shapely.box(X + 26, Y + 30, X + 32, Y + 38)),
    ),
    "roofs alone, 4 mm apart": blob(
        1006, FACES[1], face(1003, [(a, b + 0.004, c) for a, b, c in body(20, 30)[2]]), *FACES[3:]
    ),
}


TYPES = ["GEOMETRY", "MULTIPOLYGON", "POLYHEDRALSURFACE", "TIN"]


@pytest.mark.parametrize(("name", "declared"), [(name, TYPES[k % 4]) for k, name in enumerate(SURFACES)])
def test_surfaces_have_their_plan_outline(tmp_path: Path, name: str, declared: str) -> None:
    blobs = [SURFACES[name], shapely.to_wkb(square(60, 60))]
    footprints, notes = read(write_gpkg(tmp_path / "a.gpkg", blobs, declared=declared, z=2))
    assert_outlines(footprints, [HOUSE, square(60, 60)])
    assert footprints.polygons[0].geom_type == "Polygon"
    assert shapely.is_valid(footprints.polygons).all()
    assert len(footprints.polygons[0].interiors) == 0
    assert count_notes(notes)["footprint-outline-of-surface"] == 1


def test_a_triangle_is_a_polygon_and_a_wall_is_none(tmp_path: Path) -> None:
    wall = blob(1015, FACES[3], FACES[4])
    ring = [(X + 60, Y + 60, 1.0), (X + 80, Y + 60, 1.0), (X + 60, Y + 80, 4.0), (X + 60, Y + 60, 1.0)]
    footprints, notes = read(write_gpkg(tmp_path / "a.gpkg", [face(1017, ring), wall], z=1))
    assert_outlines(footprints, [shapely.Polygon(ring)])
    assert told(notes, "footprint-not-polygon") == ["feature 2: has 2 faces, all vertical or without area"]


def test_multipatches(tmp_path: Path) -> None:
    """Rings, a triangle strip and a fan, as ArcGIS writes them."""
    x, y = X + 20, Y + 30
    roof = [(x, y, 5.0), (x + 12, y, 5.0), (x, y + 8, 7.0), (x + 12, y + 8, 7.0)]
    wall = [(x, y, 1.0), (x + 12, y, 1.0), (x, y, 5.0), (x + 12, y, 5.0)]
    around = [roof[k] for k in (0, 1, 3, 2)]
    shapes = [[(0, roof), (0, wall)], [(1, around)], [(2, [*around, around[0]])]]
    path = write_table(tmp_path / "a.shp", ("id", "C", 5), [b"strip", b"fan", b"ring"])
    write_multipatch(path, shapes)
    footprints, notes = read(path)
    assert footprints.ids.tolist() == ["fan", "ring", "strip"]
    assert_outlines(footprints, [HOUSE] * 3)
    assert count_notes(notes)["footprint-outline-of-surface"] >= 2


def write_multipatch(path: Path, shapes: list[list[tuple[int, list[tuple[float, float, float]]]]]) -> None:
    records, index, place = b"", b"", 50
    for number, parts in enumerate(shapes, 1):
        points = np.array([point for _, part in parts for point in part])
        first = np.cumsum([0, *(len(part) for _, part in parts)])[:-1]
        low, high = points.min(axis=0), points.max(axis=0)
        content = struct.pack("<i4d2i", 31, *low[:2], *high[:2], len(parts), len(points))
        content += np.array(first, "<i4").tobytes() + np.array([kind for kind, _ in parts], "<i4").tobytes()
        content += points[:, :2].astype("<f8").tobytes() + struct.pack("<2d", low[2], high[2])
        content += points[:, 2].astype("<f8").tobytes()
        records += struct.pack(">2i", number, len(content) // 2) + content
        index += struct.pack(">2i", place, len(content) // 2)
        place += 4 + len(content) // 2
    for suffix, data in ((".shp", records), (".shx", index)):
        head = struct.pack(">7i", 9994, 0, 0, 0, 0, 0, 50 + len(data) // 2)
        head += struct.pack("<2i8d", 1000, 31, X, Y, X + 100, Y + 100, 0, 10, 0, 0)
        path.with_suffix(suffix).write_bytes(head + data)


# Lines


def test_closed_lines_are_outlines(tmp_path: Path) -> None:
    yard = square(5, 5, 30).difference(square(10, 10, 5))
    ends = list(square(50, 5).exterior.coords)
    shapes = [
        shapely.LineString(square(40, 5).exterior.coords),
        shapely.MultiLineString([ring.coords for ring in (yard.exterior, *yard.interiors)]),
        shapely.MultiLineString([ends[:3], ends[2:]]),
        shapely.LineString([*ends[:-1], (ends[0][0] + 0.005, ends[0][1])]),
        shapely.LineString(ends[:4]),
        shapely.MultiLineString([ends[:3], ends[3:]]),
    ]
    footprints, notes = read(write_gpkg(tmp_path / "a.gpkg", shapely.to_wkb(shapes).tolist()))
    assert footprints.ids.tolist() == list("abcd")
    assert_outlines(footprints, [square(40, 5), yard, square(50, 5), square(50, 5)])
    assert count_notes(notes) == {"footprint-from-line": 4, "footprint-not-polygon": 2}
    assert told(notes, "footprint-not-polygon") == [
        "feature 5: is an open line: its ends are 10 m apart",
        "feature 6: is 2 lines that do not close together",
    ]


# Tables of Shapefiles


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8"])
def test_text_without_a_stated_encoding(tmp_path: Path, encoding: str) -> None:
    names = ["Straße 1/ü", "plain"]
    path = write_table(tmp_path / "a.shp", ("id", "C", 20), [name.encode(encoding) for name in names])
    footprints, notes = read(path)
    assert footprints.ids.tolist() == sorted(names)
    assert told(notes, "footprints-reader-warning") == (
        ["text that is no UTF-8 is read as Windows-1252"] if encoding == "cp1252" else []
    )
    path.with_suffix(".cpg").write_text("UTF-8")  # whatever the file states
    assert read(path)[0].ids.tolist() == sorted(names)


def test_whole_numbers_of_19_digits_stay_whole(tmp_path: Path) -> None:
    ids = [1234567890123456788, 1234567890123456789, 2**63 - 1]
    path = write_table(tmp_path / "a.shp", ("id", "N", 19), [str(number).encode() for number in ids])
    footprints, notes = read(path)
    assert footprints.ids.tolist() == [str(number) for number in ids]
    assert notes == ()


def test_numbers_that_a_table_makes_equal_blame_it(tmp_path: Path) -> None:
    ids = [b"12345678901234567890", b"12345678901234567891", b"77"]
    footprints, notes = read(write_table(tmp_path / "a.shp", ("id", "N", 20), ids))
    assert len(set(footprints.ids.tolist())) == 3
    assert "77" in footprints.ids
    details = told(notes, "footprint-id-repeated")
    assert len(details) == 2
    assert "holds id as a number of 20 digits, read as a float" in details[0]
    assert "Export the ids as text, or as whole numbers of a GPKG" in details[0]


def test_ids_of_64_bits_and_with_signs(tmp_path: Path) -> None:
    shapes = shapely.to_wkb(np.array([square(5, 5), square(20, 5), square(35, 5)], object))
    whole = np.array([2**53 + 1, 2**63 - 1, -5])
    text = np.array(['NL.IMBAG/05 0#a?b&c="x"', "a/b", "ü"], object)
    for values in (whole, text):
        path = tmp_path / f"{values.dtype}.gpkg"
        pyogrio.raw.write(path, shapes, [values], ["id"], geometry_type="Polygon", crs="EPSG:28992")
        assert sorted(read(path)[0].ids.tolist()) == sorted(map(str, values.tolist()))


def test_upper_case_suffixes_and_a_missing_prj(tmp_path: Path) -> None:
    path = write_table(tmp_path / "a.shp", ("id", "C", 5), [b"a", b"b"])
    (tmp_path / "up").mkdir()
    for suffix in (".shp", ".shx", ".dbf"):
        shutil.copy(path.with_suffix(suffix), tmp_path / "up" / f"A{suffix.upper()}")
    footprints, notes = read(tmp_path / "up" / "A.SHP")
    assert footprints.ids.tolist() == ["a", "b"]
    assert count_notes(notes) == {"footprints-without-crs": 1}


# GeoPackages as programs leave them


def test_a_geopackage_in_use_and_one_of_qgis(tmp_path: Path) -> None:
    path = write_gpkg(tmp_path / "a.gpkg", [shapely.to_wkb(square(5, 5))])
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE layer_styles (id INTEGER PRIMARY KEY, styleName TEXT)")
        database.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) "
            "VALUES ('layer_styles', 'attributes', 'layer_styles')"
        )
    database.close()
    assert read(path)[0].ids.tolist() == ["a"]
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode = WAL")
    writer.execute("UPDATE b SET id = 'new'")
    writer.commit()
    assert path.with_name("a.gpkg-wal").stat().st_size > 0
    assert read(path)[0].ids.tolist() == ["new"]
    writer.close()


def test_a_view_is_a_layer_that_can_be_named(tmp_path: Path) -> None:
    path = write_gpkg(tmp_path / "a.gpkg", [shapely.to_wkb(square(5, 5)), shapely.to_wkb(square(20, 5))])
    with sqlite3.connect(path) as database:
        database.execute("CREATE VIEW v AS SELECT fid AS OGC_FID, geom, id FROM b WHERE id <> 'a'")
        database.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) "
            "VALUES ('v', 'features', 'v', 28992)"
        )
        database.execute(
            "INSERT INTO gpkg_geometry_columns SELECT 'v', column_name, geometry_type_name, srs_id, z, m "
            "FROM gpkg_geometry_columns WHERE table_name = 'b'"
        )
    database.close()
    with pytest.raises(ConfigError, match="has 2 layers; name one of them: b, v"):
        read(path)
    for bounds in (BOX, SMALL):
        assert read(path, layer="v", bounds=bounds)[0].ids.tolist() == ["b"]


# GeoParquet


class Wkb(pa.ExtensionType):  # type: ignore[misc]
    """What pyarrow writes as type GEOMETRY of Parquet."""

    def __init__(self, metadata: str = "{}", name: str = "geoarrow.wkb", storage: Any = None) -> None:
        self.metadata = metadata
        super().__init__(storage or pa.binary(), name)

    def __arrow_ext_serialize__(self) -> bytes:
        return self.metadata.encode()

    @classmethod
    def __arrow_ext_deserialize__(cls, _storage: Any, data: bytes) -> "Wkb":
        return cls(data.decode())


def test_parquet_with_its_own_type_of_geometry(tmp_path: Path) -> None:
    blobs = pa.array([shapely.to_wkb(square(5, 5)), None, shapely.to_wkb(square(20, 5))], pa.binary())
    for k, crs in enumerate(('"EPSG:28992"', RD.to_json())):
        column = pa.ExtensionArray.from_storage(Wkb(f'{{"crs": {crs}}}'), blobs)
        path = tmp_path / f"{k}.parquet"
        pq.write_table(pa.table({"other": blobs, "id": ["a", "none", "b"], "shape": column}), path)
        footprints, notes = read(path)
        assert footprints.ids.tolist() == ["a", "b"]
        assert_outlines(footprints, [square(5, 5), square(20, 5)])
        assert count_notes(notes) == {"footprints-without-geometry": 1}


SHAPES = [square(5, 5).difference(square(8, 8, 2)), square(20, 5), square(35, 5)]
GEOARROW = {
    "polygon": SHAPES,
    "multipolygon": [
        shapely.MultiPolygon([SHAPES[0], square(50, 50)]),
        *map(shapely.MultiPolygon, [[s] for s in SHAPES[1:]]),
    ],
    "linestring": [shapely.LineString(shape.exterior.coords) for shape in SHAPES],
}


@pytest.mark.parametrize("interleaved", [True, False])
@pytest.mark.parametrize("stated", ["geo", "extension"])
@pytest.mark.parametrize("kind", GEOARROW)
def test_parquet_with_encodings_of_geoarrow(tmp_path: Path, kind: str, stated: str, interleaved: bool) -> None:
    _, xy, offsets = shapely.to_ragged_array(GEOARROW[kind])
    values = pa.FixedSizeListArray.from_arrays(pa.array(xy.ravel()), 2)
    if not interleaved:
        values = pa.StructArray.from_arrays([pa.array(side.copy()) for side in xy.T], ["x", "y"])
    for level in offsets:
        values = pa.ListArray.from_arrays(pa.array(level, pa.int32()), values)
    values = values.take(pa.array([0, None, 1, 2]))
    if stated == "extension":
        values = pa.ExtensionArray.from_storage(
            Wkb(json.dumps({"crs": "EPSG:28992"}), f"geoarrow.{kind}", values.type), values
        )
    table = pa.table({"id": ["a", "none", "b", "c"], "geometry": values})
    if stated == "geo":
        column = {"encoding": kind, "crs": RD.to_json_dict()}
        meta = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
        table = table.replace_schema_metadata({"geo": json.dumps(meta)})
    pq.write_table(table, tmp_path / "a.parquet", row_group_size=3)
    footprints, _ = read(tmp_path / "a.parquet")
    assert footprints.ids.tolist() == ["a", "b", "c"]
    expected = GEOARROW[kind] if kind != "linestring" else [shapely.Polygon(shape.exterior) for shape in SHAPES]
    assert_outlines(footprints, expected)


def test_parquet_without_metadata(tmp_path: Path) -> None:
    to_degrees = pyproj.Transformer.from_crs(RD, "EPSG:4326", always_xy=True).transform
    there = shapely.transform(square(5, 5), to_degrees, interleaved=False)
    names = pa.array([{"primary": "x"}], pa.struct([("primary", pa.string())]))
    for name, shape, kinds in (
        ("degrees", there, {"footprints-without-metadata": 1, "footprints-reprojected": 1}),
        ("metres", square(5, 5), {"footprints-without-metadata": 1, "footprints-without-crs": 1}),
    ):
        path = tmp_path / f"{name}.parquet"
        pq.write_table(pa.table({"id": ["a"], "names": names, "geometry": [shapely.to_wkb(shape)]}), path)
        footprints, notes = read(path)
        assert_outlines(footprints, [square(5, 5)])
        assert count_notes(notes) == kinds
    pq.write_table(pa.table({"id": ["a"], "geometry": [b"no geometry"]}), tmp_path / "no.parquet")
    with pytest.raises(InputError, match="has no column with geometries"):
        read(tmp_path / "no.parquet")


# Ids of GeoJSON


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([2**53 + 1, 2**53 + 2, 7], ["7", str(2**53 + 1), str(2**53 + 2)]),
        ([0, 1, 2], ["0", "1", "2"]),
        (["way/7", "b", "c"], ["b", "c", "way/7"]),
        ([None, None, None], None),
    ],
)
def test_ids_of_geojson(tmp_path: Path, given: list[Any], expected: list[str] | None) -> None:
    shapes = [square(5, 5), square(20, 5), square(35, 5)]
    features = [
        {"type": "Feature", "properties": {"a": 1}, "geometry": json.loads(shapely.to_geojson(shape))}
        | ({} if name is None else {"id": name})
        for name, shape in zip(given, shapes, strict=True)
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::28992"}}
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    for bounds in (BOX, (X, Y, X + 36, Y + 99)):
        footprints, _ = read(path, bounds=bounds)
        assert footprints.ids.tolist() == (expected or sorted(make_ids(np.array(shapes, object)).tolist()))


def test_the_number_of_a_feature_may_be_asked_for(tmp_path: Path) -> None:
    path = write_gpkg(tmp_path / "a.gpkg", [shapely.to_wkb(square(5, 5)), shapely.to_wkb(square(20, 5))])
    assert read(path, id_attribute="fid")[0].ids.tolist() == ["1", "2"]


# OpenStreetMap


def osm_town() -> OsmTown:
    town = OsmTown().way(10, square(5, 5), building="yes", height="33 ft").way(11, square(20, 5), building="house")
    town.ways[-1][2]["building:levels"] = "2"
    town.way(12, square(35, 5), building__part="yes", height="7,5").way(13, square(50, 5), building="no")
    town.way(14, square(0, 0, 90), landuse="residential").way(15, square(65, 5))
    town.way(16, square(80, 5), building="yes", height="low")
    return town.relation(10, [15], building="yes", height="12 m")


@pytest.mark.parametrize("form", ["osm", "osm.pbf"])
def test_extracts_of_osm(tmp_path: Path, form: str) -> None:
    town = osm_town()
    path = town.write_xml(tmp_path / "a.osm") if form == "osm" else town.write_pbf(tmp_path / "a.osm.pbf")
    footprints, notes = read(path)
    assert footprints.ids.tolist() == ["relation/10", "way/10", "way/11", "way/12", "way/16"]
    assert_outlines(footprints, [square(x, 5) for x in (65, 5, 20, 35, 80)])
    np.testing.assert_allclose(footprints.given_height, [12, 33 * 0.3048, 6, 7.5, np.nan])
    assert told(notes, "footprint-height-missing") == ["'low' is no height above 0 m"]
    assert told(notes, "footprint-heights-by-levels") == ["1 heights are building:levels x 3 m"]
    assert count_notes(notes)["footprints-of-osm"] == 1


def test_osm_that_ogr2ogr_made_a_geopackage(tmp_path: Path) -> None:
    extract = osm_town().write_xml(tmp_path / "a.osm")
    names = ["osm_id", "osm_way_id", "building", "other_tags"]
    meta, _, shapes, values = pyogrio.raw.read(extract, layer="multipolygons", columns=names)
    path = tmp_path / "a.gpkg"
    options = {"geometry_type": "MultiPolygon", "crs": "EPSG:4326", "driver": "GPKG"}
    pyogrio.raw.write(path, shapes, values, meta["fields"], **options)
    footprints, notes = read(path)
    assert footprints.ids.tolist() == ["relation/10", "way/10", "way/11", "way/16"]
    np.testing.assert_allclose(footprints.given_height, [12, 33 * 0.3048, 6, np.nan])
    assert told(notes, "footprints-not-buildings") == [
        "2 polygons without building=* or building:part=* are left out"
    ]
    for name, expected in (("height", [12, 10.0584, 6, np.nan]), ("building:levels", [np.nan, np.nan, 6, np.nan])):
        footprints, notes = read(path, height_attribute=name)
        np.testing.assert_allclose(footprints.given_height, expected)
        assert count_notes(notes)["footprint-height-missing"] == int(np.isnan(expected).sum())


@pytest.mark.parametrize(
    "text", ["<?xml version='1.0'?><!DOCTYPE osm [<!ENTITY a 'b'>]><osm/>", "<gml><osm></osm></gml>", "<kml/>"]
)
def test_other_xml_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.osm"
    path.write_text(text)
    with pytest.raises(InputError, match="is none of SHP, GPKG, GeoJSON, FlatGeobuf, OSM"):
        read(path)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ('{"type": "CityJSON", "version": "2.0"}', "CityJSON"),
        ('{"type":"CityJSONFeature"}', "CityJSON"),
        ("<?xml version='1.0'?><core:CityModel xmlns:core='http://www.opengis.net/citygml/2.0'/>", "CityGML"),
    ],
)
def test_a_city_model_is_told_from_footprints(tmp_path: Path, text: str, name: str) -> None:
    path = tmp_path / "city.model"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"is a city model \({name}\), no vector file; give it as --buildings"):
        read(path)


def test_a_property_makes_no_city_model(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    path.write_text('{"type": "FeatureCollection", "note": {"type": "CityJSON", "text": "<CityModel>"}}')
    check_form(path)


# Features that cannot be read

GOOD, NEXT, FOURTH = (shapely.to_wkb(square(x, 5, 9)) for x in (0, 10, 30))  # where the index has them
BAD = {
    "no header": b"!" + GOOD,
    "text": "POLYGON EMPTY",
    "number": 5,
    "cut off": GOOD[:40],
    "unknown kind": struct.pack("<BII", 1, 999, 1),
    "claimed vertices": struct.pack("<BIII", 1, 3, 1, 2**31) + GOOD[13:],
    "half an arc": blob(10, chain(8, [at(0, 0), at(1, 1)])),
    "arcs that do not close": blob(10, chain(8, [at(-10, 0), at(0, -10), at(10, 0)])),
    "arcs in a collection": blob(7, blob(10, FOUR)),
    "a point among polygons": blob(6, shapely.to_wkb(shapely.Point(1, 2))),
    "a point among surfaces": blob(12, shapely.to_wkb(shapely.Point(1, 2))),
    "deep": struct.pack("<BII", 1, 7, 1) * 300,
    "claimed faces": blob(1015, count=2**32 - 1),
}


@pytest.mark.parametrize("name", BAD)
def test_a_geometry_that_cannot_be_parsed_is_listed(tmp_path: Path, name: str) -> None:
    blobs = [GOOD, NEXT, BAD[name], FOURTH, None, shapely.to_wkb(square(50, 5, 9))]
    for unindexed in ((), (2,)):
        path = write_gpkg(tmp_path / f"{len(unindexed)}.gpkg", blobs, unindexed=unindexed)
        for bounds in (BOX, SMALL):
            footprints, notes = read(path, bounds=bounds)
            assert footprints.ids.tolist() == ["a", "b", "d", *["f"] * (bounds is BOX)]
            (note,) = [note for note in notes if note.kind in INCOMPLETE]
            assert (note.kind, note.subject) == ("footprint-unreadable", "c")
            assert note.detail.startswith("feature 3: its geometry cannot be parsed")


def test_a_geometry_with_nan_is_listed(tmp_path: Path) -> None:
    nan = face(3, [(X, Y), (X + 9, float("nan")), (X + 9, Y + 9), (X, Y)])
    wall = blob(1015, face(1003, [(X, Y, 0), (X + 9, float("nan"), 0), (X + 9, Y + 9, 0), (X, Y, 0)]))
    arc = blob(10, chain(8, [at(0, 0), at(float("nan"), 1), at(3, 4), at(2, 2), at(0, 0)]))
    for k, bad in enumerate((nan, wall, arc)):
        path = write_gpkg(tmp_path / f"{k}.gpkg", [GOOD, bad, shapely.to_wkb(square(20, 5, 9))])
        for bounds in (BOX, SMALL):
            footprints, notes = read(path, bounds=bounds)
            assert footprints.ids.tolist() == ["a", "c"]
            assert [(note.kind, note.subject) for note in notes if note.kind in INCOMPLETE] == [
                ("footprint-not-finite", "b")
            ]


@pytest.mark.parametrize(("place", "value"), [(8, 9), (8 + 36, 2**31 - 1), (8, 99)])
def test_a_damaged_record_of_a_shapefile_is_listed(tmp_path: Path, place: int, value: int) -> None:
    path = write_table(tmp_path / "a.shp", ("id", "C", 5), [b"a", b"b", b"c"])
    data = bytearray(path.read_bytes())
    start = 100 + 136 + place  # of the second record
    data[start : start + 4] = struct.pack("<I", value)
    path.write_bytes(data)
    for bounds in (BOX, (X, Y, X + 39.5, Y + 99)):
        footprints, notes = read(path, bounds=bounds)
        assert footprints.ids.tolist() == ["a", "c"]
        assert [(note.subject, note.detail) for note in notes if note.kind == "footprint-unreadable"] == [
            ("b", "feature 1: its geometry cannot be parsed")
        ]


def test_null_shapes_are_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.shp"
    shapes = shapely.to_wkb(np.array([square(5, 5), None], object))
    pyogrio.raw.write(
        path, shapes, [np.array(["a", "b"], object)], ["id"], geometry_type="Polygon", crs="EPSG:28992"
    )
    footprints, notes = read(path)
    assert footprints.ids.tolist() == ["a"]
    assert told(notes, "footprints-without-geometry") == ["1 features have no geometry"]
    assert count_notes(notes) == {"footprints-without-geometry": 1}


def test_geojson_with_a_geometry_of_words_is_listed(tmp_path: Path) -> None:
    shapes = [json.loads(shapely.to_geojson(square(x, 5))) for x in (5, 20, 35)]
    shapes[1]["coordinates"][0][0] = ["here", "there"]
    features = [
        {"type": "Feature", "id": k, "properties": {}, "geometry": shape} for k, shape in enumerate(shapes)
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::28992"}}
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    for bounds in (BOX, (X, Y, X + 36, Y + 99)):
        footprints, notes = read(path, bounds=bounds)
        assert footprints.ids.tolist() == ["0", "2"]
        assert [(note.subject, note.detail) for note in notes if note.kind in INCOMPLETE] == [
            ("1", "feature 1: has no geometry, or one that cannot be parsed")
        ]


def test_parquet_with_a_geometry_that_cannot_be_parsed(tmp_path: Path) -> None:
    blobs = [shapely.to_wkb(square(500, 5)), GOOD, GOOD[:40], shapely.to_wkb(square(20, 5))]
    column = pa.ExtensionArray.from_storage(Wkb('{"crs": "EPSG:28992"}'), pa.array(blobs, pa.binary()))
    pq.write_table(pa.table({"id": list("xaby"), "geometry": column}), tmp_path / "a.parquet", row_group_size=2)
    footprints, notes = read(tmp_path / "a.parquet")
    assert footprints.ids.tolist() == ["a", "y"]
    assert [(note.subject, note.detail) for note in notes] == [("b", "feature 2: its geometry cannot be parsed")]


def test_a_feature_whose_reading_fails_is_read_around(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for the stream of GDAL, which ends with an error at one feature."""
    shapes = [shapely.to_wkb(square(10 * k, 5, 9)) for k in range(23)]
    path = write_gpkg(tmp_path / "a.gpkg", shapes)
    true = gdal_features._to_list

    def fail(column: Any, warned: list[str]) -> list[Any]:
        values = true(column, warned)
        if "k" in values:
            raise ValueError("year 20000 is out of range")
        return values

    monkeypatch.setattr(gdal_features, "_to_list", fail)
    for bounds, n in (((X, Y, X + 300, Y + 99), 22), ((X, Y, X + 195, Y + 99), 19)):
        footprints, notes = read(path, bounds=bounds)
        assert len(footprints.ids) == len(set(footprints.ids.tolist())) == n
        assert "k" not in footprints.ids
        (detail,) = told(notes, "footprint-unreadable")
        assert detail.startswith("feature 10: ")
        assert "year 20000 is out of range" in detail
    monkeypatch.setattr(gdal_features, "_to_list", refuse)
    with pytest.raises(InputError, match="cannot be read"):
        read(path)


def refuse(_column: Any, _warned: list[str]) -> list[Any]:
    raise ValueError("no column can be read")


def test_a_house_that_the_index_does_not_know_is_read(tmp_path: Path) -> None:
    path = write_gpkg(tmp_path / "a.gpkg", [GOOD, shapely.to_wkb(square(20, 5, 4)), None], unindexed=[1, 2])
    for bounds in (BOX, SMALL):
        footprints, notes = read(path, bounds=bounds)
        assert footprints.ids.tolist() == ["a", "b"]
        assert count_notes(notes) == {"footprints-without-geometry": 1}
