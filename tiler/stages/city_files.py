"""What stages make of city models and terrain rasters: points, footprints, roof surfaces, heights of nodes."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.city_model.city import find_places
from pipeline.data.citymodel import Footprints
from pipeline.data.notes import Note
from pipeline.data.roofs import Roofs, take_roofs
from pipeline.points_terrain.raster import Dtm, NodeWindow
from pipeline.roofs.roof_surfaces import RoofSurfaces, no_surfaces
from tiler.cityinput.lattices import Cells, interpolate_cells
from tiler.cityinput.model_blocks import UNIT, Wanted, pack_points, read_model_blocks
from tiler.cityinput.rasters import HEIGHT_UNIT, Lattice, find_lattice, read_raster
from tiler.cityinput.row_arrays import OF_CELL, RowPacker, unpack_rows
from tiler.cityinput.rows import ModelRows, join_rows, no_rows, take_rows
from tiler.cityinput.sources import MODEL, TERRAIN
from tiler.engine.stage import Box, Facts
from tiler.engine.task import Task
from tiler.georeference.frame import origin_of
from tiler.pointclouds.cells import ranges_near
from tiler.stages.readers import extent_of, read_units_of
from tiler.store.edit_journal import Outline

# Parameters of a run that decide what is read of a city model.
MODEL_PARAMETERS = ("lod", "height_attribute", "points_of_models", "ground_of_models", "shift_z")
OFF_GROUND = 5.0  # m; a house whose foot is farther from the ground is told
SHIFTED = 2.0  # m; a median of all from which on they are told together
UPLOADED = "uploaded_"  # what the names of arrays of uploaded buildings begin with
BAND = 20_000  # rows of buildings in memory at a time


def read_model_file(task: Task, path: Path) -> Facts:
    """Read a city model: its buildings as rows, and points on their roofs and around them (step 1.1)."""
    given = task.parameters
    wanted = Wanted(
        given.lod, given.height_attribute, given.points_of_models, given.ground_of_models, given.shift_z
    )
    middle = (task.box[0] + task.box[2]) / 2, (task.box[1] + task.box[3]) / 2
    origin = origin_of(middle)
    counts: Counter[str] = Counter()
    packer, n_points, n_cells, blocks = RowPacker(), 0, 0, [0]
    for block in read_model_blocks(path, task.frame, task.context.bounds, wanted):
        points, start = pack_points(block, origin)
        task.append(**points, cell_row=start[:-1] + n_points, **packer.pack(block.rows))
        task.notes(block.notes)
        counts.update(block.counts)
        n_points += len(points["units"])
        n_cells += len(points["cell"])
        blocks.append(n_cells)
    task.put(block=np.array(blocks), end=np.array([n_points]))
    return {
        "kind": MODEL,
        "counts": {"read": n_points, "kept": n_points},
        "model": dict(sorted(counts.items())),
        "n": packer.n_rows,
        "classes": [2, 6],
        "marks_buildings": True,
        "unreadable": None,
        "scale": (UNIT,) * 3,
        "offset": (*origin, 0.0),
    }


def read_terrain_file(task: Task, path: Path) -> Facts:
    """Read a raster of terrain: its cells as points of the ground (step 1.1)."""
    bounds = task.context.bounds
    lattice = find_lattice(path, task.frame, bounds)
    n_read = n_points = n_cells = 0
    blocks = [0]
    for block in read_raster(path, task.frame, lattice, bounds):
        task.append(
            units=block.units,
            classification=np.full(len(block.units), 2, np.uint8),
            cell=block.cell,
            cell_row=block.start[:-1] + n_points,
        )
        n_read += block.n_read
        n_points += len(block.units)
        n_cells += len(block.cell)
        blocks.append(n_cells)
    task.put(block=np.array(blocks), end=np.array([n_points]))
    return {
        "kind": TERRAIN,
        "counts": {"read": n_read, "without height": n_read - n_points, "kept": n_points},
        "classes": [2],
        "marks_buildings": True,
        "unreadable": None,
        "lattice": [lattice.x, lattice.y, lattice.dx, lattice.dy, lattice.nx, lattice.ny],
        "scale": (lattice.dx, lattice.dy, HEIGHT_UNIT),
        "offset": (lattice.x, lattice.y, 0.0),
    }


def list_kind(task: Task, kind: str) -> list[tuple[str, Facts]]:
    """List the files of a kind that a task reads, with their facts."""
    found = []
    for name in task.refs["points"]:
        facts = task.store.attributes("points", name)["facts"]
        if facts.get("kind") == kind:
            found.append((name, facts))
    return found


def read_model_bands(task: Task) -> Iterator[tuple[Footprints, list[Note]]]:
    """Read the buildings of all city models as footprints, some at a time; each id once.

    Of several buildings of one id the one with the best level counts, then the one with the larger area: tiles of
    a city share the buildings on their borders. A file that has an id twice keeps both: cleaning numbers them.
    """
    files = list_kind(task, MODEL)
    best = _find_doubles(task, files) if len(files) > 1 else {}
    for name, facts in files:
        for first in range(0, facts["n"], BAND):
            rows = unpack_rows(partial(_read, task, name), [(first, min(first + BAND, facts["n"]))])
            lost = np.array([best.get(one, name) != name for one in rows.ids.tolist()], np.bool_)
            notes = [
                Note(
                    "model-in-two-files", rows.ids[k], detail=f"{name}: the one of {best[str(rows.ids[k])]} counts"
                )
                for k in np.flatnonzero(lost).tolist()
            ]
            kept = np.flatnonzero(~lost)
            yield Footprints(rows.outlines[kept], rows.ids[kept], rows.given_height[kept]), notes
    if not any(facts["n"] for _, facts in files):
        yield Footprints(np.empty(0, object), np.empty(0, np.str_), np.empty(0)), []


def _read(
    task: Task, name: str, names: tuple[str, ...], ranges: list[tuple[int, int]]
) -> dict[str, NDArray[np.generic]]:
    return task.read_ranges("points", name, names, ranges)


def _find_doubles(task: Task, files: list[tuple[str, Facts]]) -> dict[str, str]:
    """Find the ids that several files have, and the file whose building counts."""
    seen: dict[str, tuple[float, float, str]] = {}
    double: set[str] = set()
    for name, facts in files:
        for first in range(0, facts["n"], BAND):
            rows = unpack_rows(partial(_read, task, name), [(first, min(first + BAND, facts["n"]))])
            merits = zip(
                np.nan_to_num(rows.lod, nan=-9.0).tolist(),
                np.round(shapely.area(rows.outlines), 3).tolist(),
                strict=True,
            )
            for one, (level, area) in zip(rows.ids.tolist(), merits, strict=True):
                merit = level, area, name
                before = seen.get(one, merit)
                if before[2] != name:
                    double.add(one)
                seen[one] = max(before, merit)
    return {one: seen[one][2] for one in double}


def read_surfaces(
    task: Task, polygons: NDArray[np.object_], ids: NDArray[np.str_], uploads: ModelRows
) -> tuple[RoofSurfaces, NDArray[np.float64]]:
    """Read the roof surfaces of houses from the city models near them, by their ids; and how low they reach (m).

    A house that is a part of a building, as ``A-2`` of ``A``, takes those of the building. Uploaded buildings take
    the place of those of their ids.
    """
    extent = extent_of(polygons)
    if extent is None:
        return no_surfaces(0), np.empty(0)
    rows = join_rows([_rows_near(task, name, facts, extent) for name, facts in list_kind(task, MODEL)])
    if len(uploads):
        rows = join_rows([take_rows(rows, np.flatnonzero(~np.isin(rows.ids, uploads.ids))), uploads])
    return take_surfaces(rows, find_rows(rows, polygons, ids))


def take_surfaces(rows: ModelRows, row: NDArray[np.int64]) -> tuple[RoofSurfaces, NDArray[np.float64]]:
    """Take the roof surfaces of houses, and how low they reach, by the rows of `find_rows`."""
    of_house = [np.arange(rows.start[k], rows.start[k + 1]) if k >= 0 else np.empty(0, np.int64) for k in row]
    chosen = np.concatenate([np.empty(0, np.int64), *of_house])
    start = np.cumsum([0, *map(len, of_house)])
    base = np.append(rows.base, np.nan)[row]
    return RoofSurfaces(start, rows.surfaces[chosen], take_roofs(rows.roofs, chosen)), base


def find_rows(rows: ModelRows, polygons: NDArray[np.object_], ids: NDArray[np.str_]) -> NDArray[np.int64]:
    """Find the building that each house is, by its id and its place; -1 for none."""
    by_id: dict[str, list[int]] = {}
    for k, one in enumerate(rows.ids.tolist()):
        by_id.setdefault(one, []).append(k)
    found = np.full(len(ids), -1)
    for k, (one, polygon) in enumerate(zip(ids.tolist(), polygons, strict=True) if by_id else ()):
        found[k] = _choose(rows, by_id.get(one) or by_id.get(one.rpartition("-")[0]) or [], polygon)
    return found


def pack_uploads(outlines: Sequence[Outline]) -> dict[str, NDArray[Any]]:
    """Give the arrays of uploaded buildings that tell their height, as of city models; none where none does."""
    told = [one for one in outlines if one.tells]
    if not told:
        return {}
    surface = [each for one in told for each in one.surfaces]
    plane = np.array([values for _, values in surface], np.float64).reshape(-1, 7)
    rows = ModelRows(
        shapely.from_wkb([one.polygon for one in told]).astype(object),
        np.array([one.id for one in told], np.str_),
        np.array([one.height for one in told], np.float64),
        np.full(len(told), np.nan),
        np.array([np.nan if one.base is None else one.base for one in told], np.float64),
        np.cumsum([0, *(len(one.surfaces) for one in told)]),
        shapely.from_wkb([blob for blob, _ in surface]).astype(object),
        Roofs(plane[:, :3], plane[:, 3:5], plane[:, 5:]),
    )
    return {f"{UPLOADED}{name}": values for name, values in RowPacker().pack(rows).items()}


def read_uploads(task: Task) -> ModelRows:
    """Read the uploaded buildings of a tile that tell their height, from the stage ``outlines``; mostly none."""
    (found,) = task.read("outlines")
    arrays = {
        name.removeprefix(UPLOADED): values for name, values in found.arrays.items() if name.startswith(UPLOADED)
    }
    if not arrays:
        return no_rows()
    return unpack_rows(
        lambda names, ranges: {name: np.concatenate([arrays[name][slice(*r)] for r in ranges]) for name in names},
        [(0, len(arrays["model_end"]))],
    )


def _choose(rows: ModelRows, candidates: list[int], polygon: shapely.Polygon) -> int:
    """Row of the building that is a house: of several of one id the one over it, then by level; -1 for none."""
    merit = [
        (
            round(shapely.area(shapely.intersection(rows.outlines[k], polygon)), 3),
            np.nan_to_num(rows.lod[k], nan=-9.0),
            -i,
        )
        for i, k in enumerate(candidates)
    ]
    best = max(range(len(merit)), key=merit.__getitem__, default=-1)
    return candidates[best] if best >= 0 and merit[best][0] > 0 else -1  # a footprint beside it may have its id


def note_feet(footprints: Footprints, base: NDArray[np.float64], ground: NDArray[np.float64]) -> list[Note]:
    """Tell of the houses of a city model whose foot is far from the ground: kind ``model-off-ground``."""
    off = base - ground
    return [
        Note(
            "model-off-ground",
            *place,
            f"its foot is {abs(off[k]):.1f} m {'above' if off[k] > 0 else 'below'} the ground",
        )
        for k, place in find_places(footprints, np.abs(off) > OFF_GROUND)
    ]


def count_feet(base: NDArray[np.float64], ground: NDArray[np.float64]) -> dict[str, int]:
    """Count houses by how far their foot is above the ground, in decimetres, as facts have it."""
    known = np.isfinite(base) & np.isfinite(ground)
    off = np.round(10 * (base - ground)[known]).astype(np.int64)
    return {str(value): n for value, n in sorted(Counter(off.tolist()).items())}


def describe_feet(counts: Iterable[dict[str, int]]) -> list[Note]:
    """Tell where buildings of city models stand above or below the ground in the median: kind ``model-shift``."""
    total: Counter[int] = Counter()
    for one in counts:
        total.update({int(value): n for value, n in one.items()})
    values = np.repeat(list(total), list(total.values())).astype(np.float64)
    if not len(values) or abs(shift := float(np.median(values)) / 10) <= SHIFTED:
        return []
    side = "above" if shift > 0 else "below"
    detail = (
        f"the feet of {len(values)} buildings are {abs(shift):.1f} m {side} the ground in the median: heights of "
        f"model and terrain may be of two systems; --shift-z {-shift:.1f} moves the model"
    )
    return [Note("model-shift", detail=detail)]


def _rows_near(task: Task, name: str, facts: Facts, box: Box) -> ModelRows:
    if not facts["n"]:
        return join_rows([])
    arrays, _ = task.store.read("points", name, names=OF_CELL)
    ranges = ranges_near(arrays["model_cell_box"], np.append(arrays["model_cell_start"], facts["n"]), box)
    return unpack_rows(partial(_read, task, name), ranges)


def sample_rasters(task: Task, window: NodeWindow, spacing: float) -> Dtm:
    """Heights of nodes from the rasters of terrain around them; NaN where none has any.

    Rasters whose cells lie on one lattice are one: a node between two files takes cells of both. Finer lattices
    come first.
    """
    x = np.asarray((window.i0 + np.arange(window.nx)) * spacing, np.float64)
    y = np.asarray((window.j0 + np.arange(window.ny)) * spacing, np.float64)
    z = np.full((window.ny, window.nx), np.nan)
    groups: dict[tuple[float, ...], list[tuple[str, Lattice]]] = {}
    for name, facts in list_kind(task, TERRAIN):
        lattice = Lattice(*facts["lattice"])
        phase = (lattice.x / lattice.dx) % 1.0, (lattice.y / lattice.dy) % 1.0
        key = (lattice.dx, lattice.dy, *(round(value, 4) % 1.0 for value in phase))
        groups.setdefault(key, []).append((name, lattice))
    for key in sorted(groups):
        cells = Cells.around((float(x[0]), float(y[0]), float(x[-1]), float(y[-1])), groups[key][0][1])
        for name, lattice in groups[key]:
            for units in read_units_of(task, name, cells.box):
                cells.put(units.units, lattice, HEIGHT_UNIT)
        found = interpolate_cells(cells, x, y, spacing)
        z = np.where(np.isnan(z), found, z)
    return Dtm(z, window.i0, window.j0, spacing)
