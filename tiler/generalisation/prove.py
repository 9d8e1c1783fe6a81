"""`citystitch check FILE.gpkg`: the files of a generalisation are held against each other, by SQL."""

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from itertools import groupby, pairwise
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import make_ids
from pipeline.data.errors import InputError
from tiler.check.check import CheckReport
from tiler.check.proofs import Fault, Proof
from tiler.citymodels.building_index import Vertices, copy_vertices, read_objects
from tiler.generalisation.generalise import ADJACENT, Outputs
from tiler.generalisation.gpkg_layers import BATCH
from tiler.generalisation.rows import LEVELS, Rows, level_word
from tiler.generalisation.summary import LevelSum, describe_levels
from tiler.vectors.features import to_objects
from tiler.vectors.gdal_layer import list_some
from tiler.vectors.wkb import parse_wkb, strip_header

ROUNDED = 1e-6  # of numbers, as shares
# m; of the middle of a building from its cell, and from its LoD0C, or of blocks from their cells, as outlines are
# moved by half of the gap of adjacent buildings.
IN_CELL, AT_BLOCK = 0.01, ADJACENT / 2
FLAT = 0.002  # m; heights and places of CityJSON are rounded to a millimetre
ABOVE = list(pairwise(LEVELS))
# Kind of fault, and the ids that have it.
QUERIES = [
    *(("id", f"select id from {name} group by id having count(*) > 1") for name in ("cells", *LEVELS)),
    *(("level", f"select id from {name} where level is not '{level_word(name)}'") for name in LEVELS),
    *(
        ("parent", f"select a.id from {one} a left join {other} b on b.id = a.parent where b.id is null")
        for one, other in ABOVE
    ),
    ("parent", "select id from lod0a where parent is not ''"),
    ("members", "select id from lod1 where members is not 1"),
    *(
        (
            "members",
            f"select b.id from {other} b left join (select parent, sum(members) n from {one} group by parent) a "
            "on a.parent = b.id where a.n is not b.members",
        )
        for one, other in ABOVE
    ),
    ("members", "select id from cells c where members is not (select count(*) from lod1 where cell = c.id)"),
    *(
        (
            "landmark",
            f"select a.id from {one} a join {other} b on b.id = a.parent where a.landmark is not b.landmark",
        )
        for one, other in ABOVE
    ),
    ("landmark", "select id from lod1 where landmark not in (0, 1)"),
    *(
        ("cell", f"select a.id from {one} a join {other} b on b.id = a.parent where a.cell is not b.cell")
        for one, other in ABOVE[:2]
    ),
    *(
        ("cell", f"select a.id from {one} a left join cells c on c.id = a.cell where c.id is null")
        for one in LEVELS
    ),
    (
        "id",
        "select b.id from lod0c b join (select parent, min(id) m from lod1 group by parent) a on a.parent = b.id "
        "where b.id is not case b.landmark when 1 then a.m else b.cell || '/' || a.m end",
    ),
    (
        "id",
        "select b.id from lod0a b join cells c on c.id = b.cell where b.landmark = 0 and c.landuse = 'Building' "
        "and (b.id is not c.parent or b.id is not 'A' || substr(c.id, 2))",
    ),
    (
        "outline",
        "select a.id from lod1 a join lod0c b on b.id = a.parent where b.members = 1 and a.geom is not b.geom",
    ),
    *(
        ("outline", f"select a.id from {one} a join {other} b on b.id = a.id where a.geom is not b.geom")
        for one, other in ABOVE
    ),
    (
        "land-use",
        "select c.id from cells c left join lod0b b on b.id = c.id where c.landuse not in ('Building', 'Other') "
        "or (c.landuse = 'Building') is not (b.id is not null) or c.parent is not ifnull(b.parent, '')",
    ),
    (
        "land-use",
        "select id from cells c where landuse = 'Other' and share > (select min(share) from cells where "
        "landuse = 'Building') and exists (select 1 from lod1 where cell = c.id and landmark = 0)",
    ),
    (
        "share",
        "select id from cells where other_area < -1e-6 or other_area > area + 1e-6 or "
        f"abs(ifnull(share, 0) * (area - other_area) - building_area * (share is not null)) > {ROUNDED} * area",
    ),
    (
        "building-area",
        "select c.id from cells c left join (select cell, sum(area) s from lod0c group by cell) b "
        f"on b.cell = c.id where abs(c.building_area - ifnull(b.s, 0)) > {ROUNDED} * c.area",
    ),
]
DETAILS = {
    "id": "there twice, or not of its outline, its cell or its lowest building",
    "level": "of another level than its layer",
    "parent": "the object one level up is not there",
    "members": "not the number of buildings below it",
    "landmark": "not as the object below it",
    "cell": "not that of the objects below it, or none",
    "outline": "stands for itself one level up, with another outline",
    "land-use": "not by shares and blocks, or the cell names another object of LoD0A",
    "share": "not the building area over the area without other objects",
    "building-area": "not that of its objects of LoD0C",
    "area": "not that of the outline",
    "volume": "not area times height",
    "height": "neither the mean of its buildings by area, nor their volume over its area",
    "ground": "not the mean of the known ones of its buildings by area",
    "place": "not in its cell, or not where its buildings are",
    "coverage": "cells overlap, or do not cover their convex hull",
    "numbers": "the table of levels or a count is another one",
    "city-json": "another object than in the GeoPackage",
}


def check_generalisation(path: Path) -> CheckReport:
    """Prove the files of `generalise`: levels, cells, numbers and CityJSON are those of each other.

    Joins are SQLite's, on the disk; memory holds some thousand rows, one cell of buildings, one object of LoD0A.

    Raises
    ------
    InputError
        If a file is missing or is another one.
    """
    files = Outputs(path)
    try:
        numbers = json.loads(files.numbers.read_bytes())
        with closing(sqlite3.connect("", uri=True)) as base:
            base.execute("attach ? as given", (f"{path.absolute().as_uri()}?mode=ro",))
            proofs = [*_prove_layers(base), *_prove_shapes(base, numbers), _prove_city_json(base, files.city_json)]
    except (OSError, ValueError, KeyError, TypeError, sqlite3.Error) as error:
        raise InputError(f"{path}: no result of citystitch generalise ({error}); make it anew") from None
    return CheckReport(path, tuple(proofs), {})


def _faults(found: Mapping[str, Sequence[str]]) -> tuple[Fault, ...]:
    return tuple(
        Fault(kind, len(ids), (), f"{DETAILS[kind]}: {list_some(sorted(ids))}")
        for kind, ids in found.items()
        if ids
    )


def _prove_layers(base: sqlite3.Connection) -> Iterator[Proof]:
    found: dict[str, list[str]] = {}
    for kind, query in QUERIES:
        found.setdefault(kind, []).extend(str(row[0]) for row in base.execute(query))
    n = [base.execute(f"select count(*) from {name}").fetchone()[0] for name in ("cells", *LEVELS)]
    counts = ", ".join(f"{k} of {name}" for name, k in zip(("cells", *LEVELS), n, strict=True))
    yield Proof(f"ids, levels, parents, members, landmarks, cells, land use agree: {counts}", _faults(found))
    base.execute(
        "create temp table chain as select a.area, a.height, a.ground_height ground, b.id lod0c, c.id lod0b, "
        "c.parent lod0a from lod1 a join lod0c b on b.id = a.parent join lod0b c on c.id = b.parent"
    )
    heights: dict[str, list[str]] = {"ground": []}
    kept: dict[str, list[str]] = {"area": [], "volume": []}
    for level in LEVELS[1:]:
        sums = base.execute(
            f"select o.id, o.height, o.area, o.ground_height, sum(c.area), sum(c.area * c.height), "
            "sum(case when c.ground is not null then c.area end), sum(c.area * c.ground) "
            f"from {level} o join chain c on c.{level} = o.id group by o.id"
        )
        for name, height, area, ground, built, volume, known, below in sums:
            for way, over in (("area", built), ("volume", area)):
                if not abs(height * over - volume) <= ROUNDED * volume:
                    kept[way].append(name)
            if (ground is None) != (known is None) or (
                known and abs(ground - below / known) > ROUNDED * (1 + abs(ground))
            ):
                heights["ground"].append(name)
    heights["height"] = min(kept.values(), key=len)
    yield Proof("heights and grounds of objects are those of their buildings", _faults(heights))


def _scan(base: sqlite3.Connection, query: str) -> Iterator[list[tuple[Any, ...]]]:
    found = base.execute(query)
    while rows := found.fetchmany(BATCH):
        yield rows


def _shapes(blobs: Sequence[object]) -> NDArray[np.object_]:
    """Read geometries of a GeoPackage; ValueError where one is damaged."""
    stripped = [strip_header(blob) for blob in blobs]
    found, _, broken = parse_wkb(to_objects([plain for plain, _ in stripped]))
    faults = [fault for _, fault in stripped if fault] + list(broken.values())
    if faults:
        raise ValueError(f"a geometry: {faults[0]}")
    return found


def _prove_shapes(base: sqlite3.Connection, numbers: Mapping[str, Any]) -> Iterator[Proof]:
    found: dict[str, list[str]] = {kind: [] for kind in ("id", "area", "volume", "place")}
    sums = {level: LevelSum() for level in LEVELS}
    moved = max(AT_BLOCK, numbers.get("adjacent", 0.0) / 2 + IN_CELL)
    for layer in ("cells", *LEVELS):
        more = "" if layer == "cells" else ", volume, height, members, landmark"
        for rows in _scan(base, f"select id, geom, area{more} from {layer}"):
            ids, blobs, area, *others = zip(*rows, strict=True)
            outlines = _shapes(blobs)
            wrong = ~np.isclose(shapely.area(outlines), area, rtol=ROUNDED)
            found["area"] += to_objects(list(ids))[wrong].tolist()
            if layer == "cells":
                parts, owner = shapely.get_parts(outlines, return_index=True)
                single = np.bincount(owner, minlength=len(outlines)) == 1
                names = make_ids(np.where(single, parts[np.searchsorted(owner, np.arange(len(ids)))], outlines))
                found["id"] += [str(one) for one, name in zip(ids, names, strict=True) if one != f"C{name[1:]}"]
            else:
                volume, height, members, landmark = (np.array(one) for one in others)
                wrong = ~np.isclose(np.array(area) * height, volume, rtol=ROUNDED)
                found["volume"] += to_objects(list(ids))[wrong].tolist()
                text = np.full(len(ids), "", object)
                sums[layer].add(Rows(outlines, text, text, text, height, height, members, landmark))
    found["coverage"] = _find_overlaps(base)
    for rows in _scan(
        base,
        "select a.id, a.geom, c.geom, b.geom from lod1 a join cells c on c.id = a.cell "
        "join lod0c b on b.id = a.parent",
    ):
        ids, own, cell, block = zip(*rows, strict=True)
        middle = shapely.point_on_surface(_shapes(own))
        near = shapely.dwithin(_shapes(cell), middle, IN_CELL) & shapely.dwithin(_shapes(block), middle, moved)
        found["place"] += to_objects(list(ids))[~near].tolist()
    for level, query in (
        ("lod0b", "select b.id, b.geom, c.geom from lod0b b join cells c on c.id = b.id order by b.id"),
        ("lod0a", "select b.id, b.geom, c.geom from lod0a b join cells c on c.parent = b.id order by b.id"),
    ):
        for name, same in groupby(base.execute(query), key=lambda row: row[0]):
            _, block, cells = zip(*same, strict=True)
            around = shapely.buffer(shapely.union_all(_shapes(cells)), moved)
            if not shapely.covers(around, _shapes(block[:1])[0]):
                found["place"].append(f"{name} of {level}")
    yield Proof(
        "areas and volumes are those of outlines, in their cells, which cover their hull",
        _faults(found),
    )
    yield Proof("the table of levels has their sums", _faults({"numbers": _hold_numbers(base, sums, numbers)}))


def _hold_numbers(base: sqlite3.Connection, sums: dict[str, LevelSum], numbers: Mapping[str, Any]) -> list[str]:
    """Hold the table of levels and counts against what the layers have."""
    wrong = []
    for level, told in describe_levels(sums).items():
        for key, value in told.items():
            other = numbers["levels"][level][key]
            if (value is None) != (other is None) or (
                value is not None and abs(value - other) > 0.01 + ROUNDED * abs(value)
            ):
                wrong.append(f"{key} of {level}")
    for what, condition in (("cells", "1"), ("cells of land use Building", "landuse = 'Building'")):
        if base.execute(f"select count(*) from cells where {condition}").fetchone()[0] != numbers["counts"].get(
            what, 0
        ):
            wrong.append(what)
    return wrong


def _find_overlaps(base: sqlite3.Connection) -> list[str]:
    """List cells that overlap; all of them together cover their convex hull."""
    hull, total, found = shapely.MultiPoint(), 0.0, []
    for rows in _scan(base, "select geom from cells"):
        cells = _shapes([blob for (blob,) in rows])
        hull = shapely.convex_hull(shapely.geometrycollections([hull, *shapely.convex_hull(cells)]))
        total += float(shapely.area(cells).sum())
    if abs(hull.area - total) > FLAT * hull.length + ROUNDED * total:
        found.append("all together")
    for rows in _scan(
        base,
        "select a.id, a.geom, b.geom from cells a join rtree_cells_geom r on r.id = a.fid join rtree_cells_geom s "
        "on s.id > r.id and s.minx < r.maxx and s.maxx > r.minx and s.miny < r.maxy and s.maxy > r.miny "
        "join cells b on b.fid = s.id",
    ):
        ids, one, other = zip(*rows, strict=True)
        common = shapely.intersection(_shapes(one), _shapes(other))
        found += to_objects(list(ids))[shapely.area(common) > FLAT * (1 + shapely.length(common))].tolist()
    return found


def _prove_city_json(base: sqlite3.Connection, path: Path) -> Proof:
    """Hold objects of CityJSON against rows: each is there once, at the lowest level where it stands alone."""
    columns = "id, level, height, parent, cell, members, landmark, ground_height, area"
    base.execute(f"create temp table things ({columns}, primary key (id))")
    for level in LEVELS:
        only = " where landmark = 0" if level == "lod0c" else ""
        base.execute(f"insert or ignore into things select {columns} from {level}{only}")
    base.execute("create index by_parent on things (parent)")
    (n,), seen, wrong = base.execute("select count(*) from things").fetchone(), set[int](), list[str]()
    with TemporaryFile() as file:
        vertices = copy_vertices(path, file)
        for name, thing in read_objects(path):
            row = base.execute(f"select rowid, {columns} from things where id = ?", (name,)).fetchone()
            below = base.execute("select id from things where parent = ? and id is not parent", (name,))
            if row is None or row[0] in seen or not _is_same(thing, row[1:], {one for (one,) in below}, vertices):
                wrong.append(name)
            if row is not None:
                seen.add(row[0])
    found = {"city-json": wrong + ["missing ones"] * (n > len(seen))}
    return Proof(
        f"CityJSON has the {n} objects, with their attributes, hierarchy, areas and heights", _faults(found)
    )


def _is_same(thing: Mapping[str, Any], row: tuple[Any, ...], below: set[str], vertices: Vertices) -> bool:
    name, level, height, parent, cell, members, landmark, ground, area = row
    told = {"level": level, "height": height, "cell": cell, "members": members, "landmark": landmark}
    told |= {} if ground is None else {"ground_height": ground}
    if thing["attributes"] != told or thing.get("parents", []) != [parent] * (parent not in ("", name)):
        return False
    kind, lod = ("Building", "1.2") if level == "1" else ("CityObjectGroup", "1.0")
    if thing["type"] != kind or set(thing.get("children", ())) != below:
        return False
    if not thing["geometry"]:
        return True  # told as an object without a solid
    (geometry,) = thing["geometry"]
    solids = geometry["boundaries"] if geometry["type"] == "MultiSolid" else [geometry["boundaries"]]
    values = (
        geometry["semantics"]["values"] if geometry["type"] == "MultiSolid" else [geometry["semantics"]["values"]]
    )
    flat, low, high = 0.0, np.inf, -np.inf
    for (shell,), (kinds,) in zip(solids, values, strict=True):
        for rings, of in zip(shell, kinds, strict=True):
            corners = [vertices.take(ring) for ring in rings]
            low, high = min(low, corners[0][:, 2].min()), max(high, corners[0][:, 2].max())
            flat += shapely.Polygon(corners[0], corners[1:]).area if of == 0 else 0.0
    base = 0.0 if ground is None else ground
    at = abs(low - base) <= FLAT and abs(high - base - height) <= FLAT
    return bool(geometry["lod"] == lod and at and abs(flat - area) <= FLAT * (1 + np.sqrt(area) * 20))
