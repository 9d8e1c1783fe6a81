"""3D Tiles of a run: the tree holds what it says, places are right on the globe, features are the buildings."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from jsonschema import Draft202012Validator
from referencing import Registry, Resource
from scipy.spatial import cKDTree

from pipeline.data.errors import ConfigError, InputError
from pipeline.data.mesh import Marker
from tests.helpers.tile_schemas import OWN
from tests.helpers.tilesets import contents, ellipsoid, read_content, split_subtree, to_degrees, walk_tree
from tests.tiler.editing.test_edit import write
from tiler.cli.main import main
from tiler.export.export import export_run
from tiler.export.surface import open_surface
from tiler.generalisation.generalise import generalise
from tiler.generalisation.options import Asked, Inputs
from tiler.tiles3d import base, cells
from tiler.tiles3d.cells import encode
from tiler.tiles3d.content import Surface
from tiler.tiles3d.globe import Globe
from tiler.tiles3d.subtrees import Tile, make_tileset, write_tree
from tiler.tiles3d.terrain import Site, add_skirt

GEOID = 43.0
SCHEMAS = "CITYSTITCH_3D_TILES_SCHEMAS"  # specification/schema of github.com/CesiumGS/3d-tiles
GIVEN = pytest.mark.skipif(
    SCHEMAS not in os.environ, reason=f"{SCHEMAS} names no folder of the specification's schemas"
)


@pytest.fixture(scope="module")
def tiles(sloped_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sloped city as 3D Tiles."""
    path = tmp_path_factory.mktemp("tiles") / "tiles"
    words = ["--format", "3dtiles", "-o", str(path), "--geoid-height", str(GEOID)]
    assert main(["export", str(sloped_run), *words]) == 0
    return path


def test_the_tree_holds_what_it_says(tiles: Path) -> None:
    tree = walk_tree(tiles)
    root = json.loads((tiles / "tileset.json").read_text())["root"]
    assert {cell for cell, tile in tree.items() if tile.content} == {cell for cell, _ in contents(tiles)}
    depth = root["implicitTiling"]["availableLevels"] - 1
    assert depth > 0
    low, high = (
        np.array(root["boundingVolume"]["region"])[[0, 1, 4]],
        np.array(root["boundingVolume"]["region"])[[2, 3, 5]],
    )
    for (level, x, y), tile in tree.items():
        assert tile.error <= root["geometricError"] / 2**level
        assert (tile.error == 0) == (level == depth)
        for child in tile.children:
            assert tree[child].error < tile.error
            assert (tree[child].region[[0, 1, 4]] >= tile.region[[0, 1, 4]]).all()
            assert (tree[child].region[[2, 3, 5]] <= tile.region[[2, 3, 5]]).all()
        assert (tile.region[[0, 1, 4]] >= low).all()
        assert (tile.region[[2, 3, 5]] <= high).all()
        _, parts = read_content(tiles / f"content/{level}/{x}/{y}.glb")
        for part in parts.values():
            place = to_degrees(part.places) * [np.pi / 180, np.pi / 180, 1]
            slack = np.array([1e-11, 1e-11, 1e-4])  # of float32: less than 0.1 mm
            assert (place.min(axis=0) >= tile.region[[0, 1, 4]] - slack).all()
            assert (place.max(axis=0) <= tile.region[[2, 3, 5]] + slack).all()
            for name, triangles in part.triangles.items():
                a, b, c = (part.places[triangles[:, k]] for k in range(3))
                area = np.cross(b - a, c - a)
                up = (area * a).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(area, axis=1)
                # The way from the middle of the Earth and the upright differ by 0.2 degrees.
                assert {"ground": up > -0.01, "roofs": up > 0, "walls": abs(up) < 0.01}[name].all()


def test_ground_lies_on_the_globe_to_a_millimetre(sloped_run: Path, tiles: Path) -> None:
    """The vertices of the finest ground are those of the mesh, by PROJ and the formula of the ellipsoid."""
    surface = open_surface(sloped_run)
    wanted = []
    for k in range(len(surface.names)):
        piece = surface.read(k)
        wanted.append(piece.points[piece.facets[piece.marker == Marker.GROUND]].reshape(-1, 3))
    xyz = np.unique(np.concatenate(wanted), axis=0)
    crs = json.loads((sloped_run / "run.json").read_text())["region"]["crs"]
    lon, lat = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(xyz[:, 0], xyz[:, 1])
    places = ellipsoid(np.column_stack((lon, lat, xyz[:, 2] + GEOID)))
    depth = max(level for (level, _, _), _ in contents(tiles))
    grounds = [read_content(path)[1]["terrain"] for (level, _, _), path in contents(tiles) if level == depth]
    found = np.concatenate([ground.places for ground in grounds])
    away = np.array([np.linalg.norm(found - place, axis=1).min() for place in places])
    assert away.max() < 1e-3
    assert len(xyz) > 500


def test_features_of_the_finest_tiles_are_the_buildings(sloped_run: Path, tiles: Path) -> None:
    model = json.loads((sloped_run / "citymodel.city.json").read_text())["CityObjects"]
    wanted = {name: thing["attributes"] for name, thing in model.items() if "children" not in thing}
    levels: dict[int, list[dict[str, Any]]] = {}
    for (level, _, _), path in contents(tiles):
        _, parts = read_content(path)
        part = parts["buildings"]
        rows = [dict(zip(part.table, row, strict=True)) for row in zip(*part.table.values(), strict=True)]
        assert np.array_equal(np.unique(part.feature), np.arange(len(rows)))
        levels.setdefault(level, []).extend(rows)
        for row, own in zip(rows, (part.places[part.feature == k] for k in range(len(rows))), strict=True):
            top = to_degrees(own)[:, 2].max() - GEOID
            assert top == pytest.approx(row["roof_height"], abs=row["error"] + 0.02)
    finest = levels[max(levels)]
    assert sorted(row["id"] for row in finest) == sorted(wanted)
    for row in finest:
        known = wanted[row["id"]]
        assert (row["lod"], row["error"], row["roof_method"]) == ("2.2", 0.0, known["roof_method"])
        assert row["height"] == pytest.approx(known["height"], rel=1e-6)
    coarse = levels[0]
    houses = {row["house"] for row in finest}
    assert {row["house"] for row in coarse} <= houses
    assert {row["lod"] for row in coarse} & {"1.2", "1.3"}
    assert len(coarse) < len(finest)


def test_blocks_stand_for_houses_in_the_upper_levels(
    sloped_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each house stays in sight up the tree: by itself, or by the one object that stands for it."""
    monkeypatch.setattr(cells, "STEP", cells.STEP / 4)  # 76 m
    monkeypatch.setattr(base, "SHARE", 16)  # 9.5, 19 and 38 m are allowed above
    blocks = tmp_path / "blocks.gpkg"
    generalise(Inputs(models=[sloped_run]), blocks, Asked(least_share=0.05))
    export_run(sloped_run, tmp_path / "tiles", name="3dtiles", options={"generalised": str(blocks)})
    known: dict[str, tuple[float, float]] = {}
    for layer in ("lod0c", "lod0b", "lod0a"):
        columns = ["id", "height", "members", "ground_height"]  # in the order of the file
        _, _, _, values = pyogrio.raw.read(blocks, layer=layer, columns=columns)
        known |= {name: (n, height + ground) for name, height, n, ground in zip(*values, strict=True)}
    box = np.array(json.loads((tmp_path / "tiles/tileset.json").read_text())["root"]["boundingVolume"]["region"])
    tree, lods, whole = walk_tree(tmp_path / "tiles"), dict[int, set[str]](), set[float]()
    for (level, x, y), path in contents(tmp_path / "tiles"):
        part = read_content(path)[1].get("buildings")
        if part is None:
            continue
        lods.setdefault(level, set()).update(part.table["lod"])
        assert max(part.table["error"]) <= tree[level, x, y].error + 1e-5  # of float32
        for k, (name, lod) in enumerate(zip(part.table["id"], part.table["lod"], strict=True)):
            if lod.startswith("0"):
                places = to_degrees(part.places[part.feature == k])
                found = part.table["buildings"][k], part.table["roof_height"][k], places[:, 2].max()
                assert found == pytest.approx((known[name][0], known[name][1], known[name][1]), abs=0.01)
                assert found[0] > 1
                within = (np.radians(places[:, :2]) - box[:2]) / (box[2:4] - box[:2]) * 2**level - (x, y)
                assert (abs(within - 0.5) < 0.5 + 1e-3).all()  # no farther than its cell
        if level == 0:
            whole.update(part.table["buildings"])
    depth = max(lods)
    assert (lods[depth], lods[0], sum(whole)) == ({"2.2"}, {"0A"}, 24)
    assert {"1.2", "0C"} <= lods[depth - 1]
    other = tmp_path / "other.gpkg"
    generalise(Inputs(footprints=write(tmp_path / "one.gpkg", shapely.box(0, 0, 9, 9), ids=["x"])), other, Asked())
    with pytest.raises(InputError, match=r"other\.gpkg: has no building of the run"):
        export_run(sloped_run, tmp_path / "no", name="3dtiles", options={"generalised": str(other)})


def test_draco_moves_no_vertex_by_a_millimetre_and_keeps_features(
    sloped_run: Path, tiles: Path, tmp_path: Path
) -> None:
    given = {"compression": "draco", "geoid_height": GEOID}
    export_run(sloped_run, tmp_path / "packed", name="3dtiles", options=given)
    before = {cell: read_content(path)[1] for cell, path in contents(tiles)}
    for cell, path in contents(tmp_path / "packed"):
        document, parts = read_content(path)
        assert document["extensionsRequired"] == ["KHR_draco_mesh_compression"]
        for name, part in parts.items():
            old = before[cell][name]
            assert part.table == old.table
            for material, triangles in old.triangles.items():
                assert len(part.triangles[material]) == len(triangles)
                sides = [(one.places, one.feature, one.triangles[material].ravel()) for one in (old, part)]
                # Of another feature is far away.
                a, b = (np.column_stack((xyz, 1e3 * feature))[used] for xyz, feature, used in sides)
                assert max(np.max(cKDTree(a).query(b)[0]), np.max(cKDTree(b).query(a)[0])) < 1e-3
    sizes = [sum(path.stat().st_size for _, path in contents(one)) for one in (tiles, tmp_path / "packed")]
    assert sizes[1] < 0.5 * sizes[0]
    with pytest.raises(ConfigError, match="--compression zip: expected draco"):
        export_run(sloped_run, tmp_path / "no", name="3dtiles", options={"compression": "zip"})


def test_the_same_run_gives_the_same_bytes(sloped_run: Path, tiles: Path, tmp_path: Path) -> None:
    words = ["--format", "3dtiles", "-o", str(tmp_path / "again"), "--geoid-height", str(GEOID)]
    assert main(["export", str(sloped_run), *words]) == 0
    names = sorted(path.relative_to(tiles) for path in tiles.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(tmp_path / "again") for path in (tmp_path / "again").rglob("*.*"))
    assert all((tiles / name).read_bytes() == (tmp_path / "again" / name).read_bytes() for name in names)


def test_subtrees_of_a_country(tmp_path: Path) -> None:
    """Of leaves over twelve levels, without contents, every tile is found again in its subtree."""
    depth = 11
    x, y = np.random.default_rng(0).integers(0, 2**depth, (2, 400))
    leaves = np.unique(encode(x, y))

    def make(cell: tuple[int, int, int], _: Any) -> tuple[Tile, None]:
        return Tile((0, 0, 1, 1, 0, 9), (7.0 * cell[1] + cell[2]) % 11, content=False), None

    tree = write_tree(tmp_path, leaves, depth, make)
    document = make_tileset(tree, (0.0, 0.0, 1.0, 1.0), depth, {})
    (tmp_path / "tileset.json").write_text(json.dumps(document))
    tiles = walk_tree(tmp_path)
    wanted = {
        (level, a >> (depth - level), b >> (depth - level))
        for level in range(depth + 1)
        for a, b in zip(x, y, strict=True)
    }
    assert set(tiles) == wanted
    assert tree.tiles == len(wanted)
    assert tree.error == max(tile.error * 2**level for (level, _, _), tile in tiles.items())
    assert all(tiles[child].error <= tile.error for tile in tiles.values() for child in tile.children)
    assert len({tile.error for tile in tiles.values()}) == 11
    assert not any(tile.content for tile in tiles.values())


def validators(folder: Path | None) -> dict[str, Any]:
    """JSON schemas by name: our own, or those of a folder, which refer to each other by their places."""
    if folder is None:
        return {name: Draft202012Validator(schema) for name, schema in OWN.items()}
    found = {path.as_uri(): json.loads(path.read_text()) for path in folder.rglob("*.json")}
    pairs = [(uri, Resource.from_contents(words | {"$id": uri})) for uri, words in found.items()]
    registry: Registry[Any] = Registry().with_resources(pairs)
    places = {name: {"$ref": (folder / f"{name}.schema.json").as_uri()} for name in OWN}
    return {name: Draft202012Validator(place, registry=registry) for name, place in places.items()}


@pytest.mark.parametrize("source", ["own", pytest.param("specification", marks=GIVEN)])
def test_json_is_as_the_specification_has_it(source: str, tiles: Path) -> None:
    schemas = validators(Path(os.environ[SCHEMAS]) if source == "specification" else None)
    document = json.loads((tiles / "tileset.json").read_text())
    (path,) = tiles.glob("subtrees/*/*/*")
    subtree, _ = split_subtree(path)
    found = [("tileset", document), ("Subtree/subtree", subtree)]
    for _, content in contents(tiles):
        tables = read_content(content)[0]["extensions"]["EXT_structural_metadata"]
        found += [("Schema/schema", tables["schema"])]
        found += [("PropertyTable/propertyTable", table) for table in tables["propertyTables"]]
    assert [(name, error.message) for name, one in found for error in schemas[name].iter_errors(one)] == []
    for name, good in dict(reversed(found)).items():
        for key in good:
            assert not schemas[name].is_valid(good | {key: -1})
            if source == "own":  # there nothing is optional
                assert not schemas[name].is_valid({other: good[other] for other in good if other != key})


def test_skirts_look_away_from_their_cell() -> None:
    """Of a square of ground inside the region, walls of a depth hang from all four sides."""
    west, south, side = 121_000.0, 487_000.0, 100.0
    bounds = (west - side, south - side, west + 2 * side, south + 2 * side)
    site = Site(Globe("EPSG:28992", bounds), bounds, np.array([bounds]))
    xyz = np.array(
        [[west, south, 0.0], [west + side, south, 1], [west + side, south + side, 2], [west, south + side, 1]]
    )
    ground = Surface(xyz, np.array([[0, 1, 2], [0, 2, 3]]), np.array([1, 1]), np.zeros(4, np.int64))
    box = site.globe.geographic(xyz)[:, :2]
    found = add_skirt(ground, site, (*box.min(axis=0).tolist(), *box.max(axis=0).tolist()), 5.0)
    assert (len(found.triangles), found.skirt) == (2 + 8, 16)
    a, b, c = (found.xyz[found.triangles[2:, k]] for k in range(3))
    outwards = (a + b + c)[:, :2] / 3 - (west + side / 2, south + side / 2)
    normal = np.cross(b - a, c - a)
    assert ((normal[:, :2] * outwards).sum(axis=1) > 0).all()
    assert np.linalg.norm(normal, axis=1) / 2 == pytest.approx(np.full(8, side * 5 / 2))


def test_heights_are_raised_by_the_grid_of_their_crs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import rasterio
    from affine import Affine

    rd, bounds = "EPSG:28992", (121_000.0, 487_000.0, 122_000.0, 488_000.0)
    with pytest.raises(ConfigError, match=r"needs the grid us_nga_egm96_15\.tif"):
        Globe(rd, bounds, vertical_crs="EPSG:5773")
    with pytest.raises(ConfigError, match="is no CRS of heights"):
        Globe(rd, bounds, vertical_crs="EPSG:4326")
    with pytest.raises(ConfigError, match="both raise the heights"):
        Globe(rd, bounds, vertical_crs="EPSG:5773", geoid_height=43)
    # A geoid of our own under the grid's name: 40 m, and 1 m more with each degree to the east.
    height = np.tile(40 + np.arange(-180.0, 181.0, dtype=np.float32), (181, 1))
    words = {"driver": "GTiff", "width": 361, "height": 181, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(
        tmp_path / "us_nga_egm96_15.tif", "w", transform=Affine(1, 0, -180.5, 0, -1, 90.5), **words
    ) as file:
        file.update_tags(AREA_OR_POINT="Point")
        file.write(height, 1)
    folder = pyproj.datadir.get_data_dir()
    pyproj.datadir.append_data_dir(str(tmp_path))
    try:
        (place,) = Globe(rd, bounds, vertical_crs="EPSG:5773").geographic(np.array([[121_500.0, 487_500.0, 7.0]]))
    finally:
        pyproj.datadir.set_data_dir(folder)
    assert place[2] == pytest.approx(7 + 40 + place[0], abs=1e-4)


@pytest.mark.parametrize(
    ("crs", "bounds", "geoid", "said"),
    [
        ("EPSG:28992", (0.0, 0.0, 1.0, 1.0), 150.0, "--geoid-height 150 m: the geoid is within 120 m"),
        ('LOCAL_CS["site",UNIT["metre",1]]', (0.0, 0.0, 1.0, 1.0), 0.0, "says nothing about the place on Earth"),
        ("EPSG:32631", (5e7, 0.0, 6e7, 1.0), 0.0, "has no place on Earth"),
        ("EPSG:3832", (3339000.0, 0.0, 3340000.0, 9.0), 0.0, "crosses the date line"),
    ],
)
def test_what_has_no_place_on_the_globe_is_refused(
    crs: str, bounds: tuple[float, ...], geoid: float, said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        Globe(crs, bounds, geoid_height=geoid)
