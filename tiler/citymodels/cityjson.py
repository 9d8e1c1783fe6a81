"""The city model as a CityJSON 2.0 file (steps 1.7 and 2.4)."""

import hashlib
import uuid
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from math import isfinite
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, BinaryIO

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj.exceptions import CRSError

from pipeline.city_model.sloped_solids import GROUND, ROOF, WALL
from pipeline.city_model.solids import Levels, Solids, build_solids
from pipeline.data.citymodel import CityModel, join_models, take_model
from pipeline.data.errors import ConfigError
from pipeline.data.notes import Note
from pipeline.data.roofs import Roofs, is_flat
from tiler.citymodels.building_index import PLANE
from tiler.citymodels.cityjson_text import ObjectLines, compact, reference_system
from tiler.store.atomic import replacing

# Coordinates are whole multiples of this length (m).
GRID = 0.001
# Attributes of every building; further columns may not take their names.
ATTRIBUTES = ("number", "ground_height", "roof_height", "height", "members")
# Columns with the heights of flat roofs of LoD1.2 and LoD1.3; with them, the solids of these and of LoD2.2 are
# written, else one of LoD1.2 up to the highest place of the roof.
BLOCK_HEIGHTS = {"1.2": "lod12_height", "1.3": "lod13_height"}
RUN = 512  # buildings that are written at once, and share their vertices
# Semantic surfaces of every solid, by the numbers GROUND, ROOF and WALL.
SURFACES = '[{"type":"GroundSurface"},{"type":"RoofSurface"},{"type":"WallSurface"}]'
Attributes = Mapping[str, Sequence[object]]


def write_city_model(
    path: Path,
    model: CityModel,
    *,
    crs: str,
    bounds: Sequence[float],
    title: str = "",
    attributes: Attributes | None = None,
) -> tuple[Note, ...]:
    """Write the buildings as CityJSON 2.0: LoD0 footprints and solids.

    Parameters
    ----------
    path : Path
        File to write; it appears whole or not at all.
    model : CityModel
        The buildings. Each becomes a ``Building`` whose key is its id; the parts of a house become
        ``BuildingPart`` objects below a ``Building`` that has no geometry of its own.
    crs : str
        The region's CRS in any form that pyproj reads: ``"EPSG:28992"``, WKT.
    bounds : 6 floats
        Region ``(x0, y0, z0, x1, y1, z1)`` (m). The lower corner, floored, is the file's origin.
    title : str
        Title of the dataset; the file has none if empty.
    attributes : mapping of str to a sequence of n values
        Further attributes, one column each. NaN is written as null. With `BLOCK_HEIGHTS` among them there are
        solids of LoD1.2, LoD1.3 and LoD2.2, else of LoD1.2 alone, up to the highest place of the roof.

    Returns
    -------
    tuple of Note
        Those of `pipeline.city_model.solids.build_solids`: a building whose footprint is lost has no geometry in
        the file, a flat one has no solid. ``crs-without-epsg``: the file names no reference system.

    Raises
    ------
    ValueError
        If two buildings have one id, a footprint is not a Polygon, a height or bound is not finite,
        or a column of `attributes` has the wrong length or one of our names.
    ConfigError
        If pyproj does not know the CRS.
    OutputError
        If the file cannot be written.

    Notes
    -----
    Coordinates are rounded to 1 mm; the heights among the attributes are not. Equal input gives equal
    bytes: no clock is read, the identifier is a hash of the buildings. An empty model makes a valid file.

    References
    ----------
    CityJSON 2.0.1, https://www.cityjson.org/specs/2.0.1/
    """
    return write_city_blocks(path, [(model, attributes or {})], crs=crs, bounds=bounds, title=title)


def write_city_blocks(
    path: Path,
    blocks: Iterable[tuple[CityModel, Attributes]],
    *,
    crs: str,
    bounds: Sequence[float],
    title: str = "",
) -> tuple[Note, ...]:
    """Write buildings that come in blocks, as `write_city_model` does, without ever holding all of them.

    Parameters
    ----------
    path, crs, bounds, title
        As in `write_city_model`, as are notes and errors.
    blocks : iterable of (CityModel, attributes)
        The buildings and their further attributes, the same columns in every block, else ValueError.

    Notes
    -----
    The bytes do not depend on how the buildings are cut into blocks. One object a line, then one vertex a line,
    then what is known only then: extent and identifier. Memory holds a block and `RUN` buildings, the numbers of
    all, and the ids of those that are parts; vertices wait in a temporary file beside `path`. Buildings of one
    run share their vertices.
    """
    if len(bounds) != 6 or not np.all(np.isfinite(bounds)):
        raise ValueError(f"bounds {tuple(bounds)} must be 6 finite numbers")
    system = _reference_system(crs)
    origin = np.floor(np.asarray(bounds[:3], dtype=np.float64))
    head = {"type": "CityJSON", "version": "2.0", "transform": {"scale": [GRID] * 3, "translate": origin.tolist()}}
    with replacing(path) as part, part.open("wb") as file, TemporaryFile(dir=path.parent) as vertex_file:
        file.write(f"{compact(head)[:-1]},\n".encode("ascii"))
        writer = _Writer(file, vertex_file, origin)
        for model, columns in _cut_runs(blocks):
            writer.add(model, columns)
        writer.finish()
        metadata: dict[str, Any] = {
            "geographicalExtent": _extent(bounds, writer.box),
            "identifier": str(uuid.UUID(bytes=writer.digest.digest()[:16], version=5)),
        }
        if system is not None:
            metadata["referenceSystem"] = system
        if title:
            metadata["title"] = title
        file.write(f',\n"metadata":{compact(metadata)}}}\n'.encode("ascii"))
    notes = tuple(writer.notes)
    if system is None:
        notes = (*notes, Note("crs-without-epsg", detail=f"{crs}: the city model names no reference system"))
    return notes


class _Writer:
    """Writes objects and vertices, and keeps what must be known at the end."""

    def __init__(self, file: BinaryIO, vertex_file: IO[bytes], origin: NDArray[np.float64]) -> None:
        self.file, self.origin = file, origin
        # A version 5 identifier is this hash of a name space and a name: the name is all that we write.
        self.digest = hashlib.sha1(uuid.NAMESPACE_URL.bytes, usedforsecurity=False)
        self.box = np.empty((0, 3))
        self.notes: list[Note] = []
        self.children: dict[str, list[str]] = {}
        self.hashes: list[NDArray[np.int64]] = []
        self.lines = ObjectLines(self._write, vertex_file)

    def add(self, model: CityModel, extra: Attributes) -> None:
        """Write the objects of a run."""
        columns = _columns(model, extra)
        self._check_ids(model.ids)
        levels, notes = build_solids(model, self.origin, grid=GRID, blocks=_block_heights(columns))
        self.notes += notes
        attributes, geometry = (
            _attribute_texts(columns, model.roofs),
            _geometry_texts(levels, self.lines.n_vertices),
        )
        ids, houses = model.ids.tolist(), model.house.tolist()
        for name, house in zip(ids, houses, strict=True):
            if house != name:
                self.children.setdefault(house, []).append(name)
        rows = zip(_value_texts(ids), _value_texts(houses), attributes, geometry, strict=True)
        self.lines.add_objects(_object_text(*texts) for texts in rows)
        if len(levels.vertices):
            places = levels.vertices * GRID + self.origin
            self.box = np.vstack((self.box, places.min(axis=0), places.max(axis=0)))
            self.box = np.stack((self.box.min(axis=0), self.box.max(axis=0)))
            self.lines.add_vertices(levels.vertices)

    def finish(self) -> None:
        """Write the houses that have parts, and the vertices."""
        hashes = np.sort(np.concatenate([np.empty(0, np.int64), *self.hashes]))
        n_again = int((hashes[1:] == hashes[:-1]).sum())
        if n_again:
            raise ValueError(f"{n_again} of the buildings have the id of another one, none may")
        mixed = np.isin(_hash_names(self.children), hashes)
        for is_row, (house, children) in zip(mixed.tolist(), self.children.items(), strict=True):
            if is_row:
                raise ValueError(f"building {house}: is a row and has parts, it may be one of these")
            content = compact({"type": "Building", "children": children})
            self.lines.add_objects([f"{compact(house)}:{content}"])
        self.lines.finish()

    def _check_ids(self, ids: NDArray[np.str_]) -> None:
        """Refuse two rows of one id in a run; the hashes of all, 8 bytes a building, are compared at the end."""
        names, times = np.unique(ids, return_counts=True)
        if (times > 1).any():
            raise ValueError(f"building {names[times > 1][0]}: 2 buildings have this id, at most 1 may")
        self.hashes.append(_hash_names(ids.tolist()))

    def _write(self, data: bytes) -> None:
        self.digest.update(data)
        self.file.write(data)


def _hash_names(names: Collection[str]) -> NDArray[np.int64]:
    hashes = (hashlib.blake2b(name.encode(), digest_size=8).digest() for name in names)
    return np.frombuffer(b"".join(hashes), np.int64)


def _cut_runs(blocks: Iterable[tuple[CityModel, Attributes]]) -> Iterator[tuple[CityModel, Attributes]]:
    """Put blocks together and cut them anew, into runs of `RUN` buildings."""
    waiting: list[tuple[CityModel, Attributes]] = []
    for model, columns in blocks:
        waiting.append((model, columns))
        while (n_rows := sum(len(part) for part, _ in waiting)) >= RUN:
            joined = _join_blocks(waiting)
            yield _take_rows(joined, slice(0, RUN))
            waiting = [_take_rows(joined, slice(RUN, n_rows))]
    yield from [_join_blocks(waiting)] if waiting else []


def _join_blocks(blocks: Sequence[tuple[CityModel, Attributes]]) -> tuple[CityModel, Attributes]:
    models, names = [model for model, _ in blocks], blocks[0][1].keys()
    for model, columns in blocks:
        if columns.keys() != names:
            raise ValueError(
                f"blocks with the attributes {sorted(names)} and {sorted(columns)}; expected equal ones"
            )
        for name, column in columns.items():
            if len(column) != len(model):
                raise ValueError(f"attribute {name!r} has {len(column)} values for {len(model)} buildings")
    return join_models(models), {
        name: [value for _, columns in blocks for value in columns[name]] for name in names
    }


def _take_rows(block: tuple[CityModel, Attributes], rows: slice) -> tuple[CityModel, Attributes]:
    model, columns = block
    return take_model(model, rows), {name: column[rows] for name, column in columns.items()}


def _object_text(name: str, house: str, attributes: str, geometry: str) -> str:
    """Write a city object, its texts given: a building, or a part of the house that the row names."""
    kind, parents = ("Building", "") if name == house else ("BuildingPart", f',"parents":[{house}]')
    return f'{name}:{{"type":"{kind}","attributes":{attributes},"geometry":{geometry}{parents}}}'


def _columns(model: CityModel, extra: Attributes) -> dict[str, Sequence[object]]:
    """Gather the attributes by name."""
    for name in extra:
        if name in (*ATTRIBUTES, PLANE):
            raise ValueError(f"attribute {name!r} is one of ours; rename the column")
    own: tuple[Sequence[object], ...] = (
        model.numbers.tolist(),
        model.ground.tolist(),
        model.roof.tolist(),
        (model.roof - model.ground).tolist(),
        [[str(name) for name in names] for names in model.members],
    )
    return {**dict(zip(ATTRIBUTES, own, strict=True)), **extra}


def _attribute_texts(columns: Attributes, roofs: Roofs) -> list[str]:
    """Write the attributes of each building; those with a sloped roof have its plane besides."""
    if not len(roofs):
        return []
    form = ",".join(f"{compact(name).replace('%', '%%')}:%s" for name in columns)
    texts = [_value_texts(column) for column in columns.values()]
    planes = np.column_stack((roofs.plane, roofs.origin, roofs.limits)).tolist()
    words = compact(planes)[2:-2].split("],[")  # a list of numbers each
    last = [
        "" if flat else f",{compact(PLANE)}:[{plane}]"
        for flat, plane in zip(is_flat(roofs).tolist(), words, strict=True)
    ]
    rows = zip(*texts, strict=True)
    return [f"{{{form % row}{plane}}}" for row, plane in zip(rows, last, strict=True)]


def _value_texts(column: Sequence[object]) -> list[str]:
    """Write each value of a column; NaN and infinity as null."""
    values = list(column)
    if any(issubclass(kind, np.generic) for kind in set(map(type, values))):
        values = [value.item() if isinstance(value, np.generic) else value for value in values]
    kinds = set(map(type, values))
    if float in kinds and not (kinds == {float} and np.isfinite(np.array(values, np.float64)).all()):
        values = [None if isinstance(value, float) and not isfinite(value) else value for value in values]
    # All at once: a call for each takes ten times as long. As many parts as values: no value has a comma.
    texts = compact(values)[1:-1].split(",")
    return texts if len(texts) == len(values) else [compact(value) for value in values]


def _reference_system(crs: str) -> str | None:
    try:
        return reference_system(pyproj.CRS.from_user_input(crs))
    except CRSError as error:
        raise ConfigError(f"CRS {crs!r}: unknown to pyproj; give a code such as EPSG:28992") from error


def _extent(bounds: Sequence[float], points: NDArray[np.floating]) -> list[float]:
    """Box of the region, grown by the points beyond it."""
    box = np.asarray(bounds, dtype=np.float64).reshape(2, 3)
    low, high = np.vstack([box[:1], points]).min(axis=0), np.vstack([box[1:], points]).max(axis=0)
    return [round(float(value), 3) for value in (*low, *high)]


def _block_heights(columns: Attributes) -> NDArray[np.float64] | None:
    """Heights of the block models among the columns; None where there are none."""
    names = [name for name in BLOCK_HEIGHTS.values() if name in columns]
    if not names:
        return None
    if len(names) < len(BLOCK_HEIGHTS):
        raise ValueError(
            f"attribute {names[0]!r} without the other of {', '.join(BLOCK_HEIGHTS.values())}; give both"
        )
    return np.column_stack([np.array(columns[name], np.float64) for name in names])


def _geometry_texts(levels: Levels, first: int) -> list[str]:
    """Write the geometry of each building, LoD0 and those of its solids, on vertices from `first` on.

    Text is put together here: of a million lists, Python's encoder would take twice as long as all else.
    """
    lods = (*BLOCK_HEIGHTS, "2.2")[: len(levels.solids)]
    texts = [_floor_texts(levels.footprints, first)]
    texts += [_solid_texts(solids, lod, first) for solids, lod in zip(levels.solids, lods, strict=True)]
    return [f"[{','.join(filter(None, row))}]" for row in zip(*texts, strict=True)]


def _floor_texts(solids: Solids, first: int) -> list[str]:
    low, start = _as_texts(solids.low + first), solids.ring_start.tolist()
    texts = []
    for ring, end in pairwise(solids.building_start.tolist()):
        rings = list(pairwise(start[ring : end + 1]))
        texts.append(_floor_text(low, rings) if rings else "")
    return texts


def _solid_texts(solids: Solids, lod: str, first: int) -> list[str]:
    """Write the solid of each building that has one."""
    low, high = _as_texts(solids.low + first), _as_texts(solids.high + first)
    walls = [f"[[{a},{b},{c},{d}]]" for a, b, c, d in (solids.walls + first).tolist()]
    start, texts = solids.ring_start.tolist(), []
    rows = zip(solids.has_solid.tolist(), pairwise(solids.building_start.tolist()), strict=True)
    for row, (has_solid, (ring, end)) in enumerate(rows):
        rings = list(pairwise(start[ring : end + 1]))
        if not (rings and has_solid):
            texts.append("")
        elif row in solids.others:
            faces = solids.others[row]
            shell = ",".join(_face_text([ring + first for ring in face]) for _, face in faces)
            texts.append(_shell_text(lod, shell, ",".join(str(kind) for kind, _ in faces)))
        else:
            texts.append(_prism_text(lod, low, high, walls[start[ring] : start[end]], rings))
    return texts


def _as_texts(numbers: NDArray[np.int64]) -> list[str]:
    return [str(number) for number in numbers.tolist()]


def _face_text(rings: Sequence[NDArray[np.int64]]) -> str:
    texts = [",".join(_as_texts(ring)) for ring in rings]
    return f"[{','.join(f'[{text}]' for text in texts)}]"


def _floor_text(low: list[str], rings: list[tuple[int, int]]) -> str:
    floor = ",".join(f"[{','.join(low[a:b])}]" for a, b in rings)
    return f'{{"type":"MultiSurface","lod":"0","boundaries":[[{floor}]]}}'


def _prism_text(lod: str, low: list[str], high: list[str], walls: list[str], rings: list[tuple[int, int]]) -> str:
    """Put one closed shell together; the floor is turned over to look down."""
    floor = ",".join(f"[{','.join(reversed(low[a:b]))}]" for a, b in rings)
    roof = ",".join(f"[{','.join(high[a:b])}]" for a, b in rings)
    kinds = f"{GROUND},{ROOF}" + f",{WALL}" * len(walls)
    return _shell_text(lod, ",".join((f"[{floor}]", f"[{roof}]", *walls)), kinds)


def _shell_text(lod: str, shell: str, kinds: str) -> str:
    return (
        f'{{"type":"Solid","lod":"{lod}","boundaries":[[{shell}]],'
        f'"semantics":{{"surfaces":{SURFACES},"values":[[{kinds}]]}}}}'
    )
