"""What a run folder says about itself: its record, buildings, volume pieces."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.regions import Region, Regions
from pipeline.data.roofs import Roofs, Weld
from tiler.config.config import roofs_stay_flat
from tiler.config.zone_levels import read_described
from tiler.config.zones import LEVELS, Zones
from tiler.store.json_stream import iterate_members, read_members

SCHEMA = 1  # of run.json
CELLS_REPLACED = "cells replaced by blocks"  # count of cells whose buildings are left out
RECORD_MEMBERS = ("schema", "status", "error", "region", "counts", "parameters", "parts", "land_cover", "zones")
TILES = "tiles"
EASED = "roof nodes moved for cells"  # a count: roofs at vertices of outlines
PARTS = "building parts"  # a count: those of the city model, of which a building has one or several
REGION = "region"  # cell array of a piece with soil
PATCH_OF_GROUND = "ground_patch"  # cell array of the boundary with land cover: patch of the ground, -1 elsewhere
LEAVES = "lad"  # cell array of a piece with trees: leaf area density (m2/m3), 0 in open air
ROOF_MOVED = "moved_for_cells"  # point array of the boundary: by how much a roof was moved (m)
# How a field that is missing, or of another type, or too large, shows when it is used.
WRONG_FIELD = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)


@dataclass(frozen=True)
class MeshPart:
    """A part of a mesh that shares no face with others: cells, tiles, and those that have other cells too."""

    cells: int
    tiles: tuple[str, ...] = ()
    divided: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroundPatch:
    """A patch of the ground: its name, and its roughness length (m), None where it has none of its own."""

    name: str
    roughness: float | None = None


@dataclass(frozen=True)
class RoofRules:
    """How far the mesher may move roofs at their outlines."""

    sloped: bool = False  #: whether roofs are planes; flat ones are exact
    step: float = 0.0  #: largest step by which it parts two roofs that meet (m)
    clearance: float = 0.0  #: height above the terrain at its walls up to which it raises a roof (m)
    joined: float = 0.0  #: roofs closer than this are always joined (m)
    #: whether the least distance of two nodes may be more than the step, so that the upper one is raised
    lifts: bool = False
    slack: float = 0.0  #: how far a roof may be moved besides, where the boundary's `ROOF_MOVED` says so (m)
    #: height above the terrain at its walls up to which the city model raises a flat roof, at least (m)
    raised: float = 0.0


FLAT_ROOFS = RoofRules()


@dataclass(frozen=True)
class SizesAsked:
    """Target edge lengths of a run beside those of its zones."""

    #: that outside of zones, and the largest one in the open (m)
    mesh_size: float = 10.0
    largest: float = 10.0
    growth: float = 1.2  #: growth from edge to edge around zones
    alone: bool = False  #: whether nothing else makes triangles finer: walls, further areas, land cover
    even: bool = True  #: whether the vertical spacing does not grow from the ground upwards
    clearance: float = 1.0  #: least distance of walls, also from the region's sides (m)


@dataclass(frozen=True)
class RunRecord:
    """The part of ``run.json`` that the files can be held against."""

    status: str  #: ``"done"`` when every tile is
    bounds: tuple[float, float, float, float]  #: west, south, east and north border of the region (m)
    top: float  #: absolute height of the top (m) where the mesher makes it flat, NaN where it does not
    counts: Mapping[str, int]  #: ``cells``, ``points``, ``facets`` and ``building parts``
    #: boxes of the tiles by name (m), as far as they are stated
    tiles: Mapping[str, tuple[float, ...] | None] = field(default_factory=dict)
    depth: float = 0.0  #: depth of the soil below the terrain (m), 0 where there is none
    core: tuple[float, float, float, float] | None = None  #: the region without its pad (m); None without a pad
    rim: float = math.nan  #: height of the ground along the outer sides of the pad (m), NaN without one
    #: parts of the mesh, that of the most cells first; of many those beyond the first are empty. None at all where
    #: the record does not tell
    parts: tuple[MeshPart, ...] = ()
    roofs: RoofRules = FLAT_ROOFS  #: how far the mesher may move roofs
    ground: tuple[GroundPatch, ...] = ()  #: patches of the ground by number, without land cover none
    dtm_spacing: float = 1.0  #: distance between nodes of the terrain (m)
    leaves: bool = False  #: whether cells tell their leaf area density
    leaf_column: float = 2.0  #: side of the columns in which that is known (m)
    zones: Zones = ()  #: zones of detail; none where all buildings have one level
    #: building parts at each level of detail, where there are zones, and `CELLS_REPLACED`
    level_counts: Mapping[str, int] = field(default_factory=dict)
    solids: bool = False  #: whether buildings have cells
    sizes: SizesAsked = SizesAsked()  #: other sizes, where there are zones

    @property
    def regions(self) -> Regions:
        """What cells are filled with."""
        return (Region.AIR, *[Region.SOIL] * (self.depth > 0), *[Region.BUILDING] * self.solids)


@dataclass(frozen=True, eq=False)
class Buildings:
    """Buildings of a CityJSON file, by ascending number."""

    numbers: NDArray[np.int64]  #: (n,): attribute ``number``: what the boundary's array ``building`` refers to
    #: (n,): shapely Polygons, or MultiPolygons where the file has several surfaces (m)
    footprints: NDArray[np.object_]
    #: (n,): attributes ``ground_height`` and ``roof_height``, absolute (m): of a sloped roof the highest place
    ground: NDArray[np.float64]
    roof: NDArray[np.float64]
    roofs: Roofs  #: roofs, by attribute ``roof_plane``; flat at `roof` where a building has none

    def __len__(self) -> int:
        return len(self.numbers)

    @cached_property
    def tree(self) -> shapely.STRtree:
        """Footprints by place."""
        return shapely.STRtree(self.footprints)


def read_run_record(path: Path) -> RunRecord:
    """Read ``run.json``.

    Raises
    ------
    InputError
        If it is missing or damaged, or has another schema.
    """
    record = _read_members(path, RECORD_MEMBERS)
    try:
        if record["schema"] != SCHEMA:
            raise InputError(f"{path}: schema {record['schema']!r}, expected {SCHEMA}; run again")
        if record["status"] == "failed":
            raise InputError(f"{path}: the run failed ({record['error']}); mend that and run again")
        if "region" not in record:
            raise InputError(f"{path}: the run is {record['status']} and has no mesh yet; wait, or run again")
        west, south, east, north = (float(value) for value in record["region"]["bounds"])
        top = float(record["region"].get("top", math.nan))
        counts = {name: int(record["counts"][name]) for name in ("cells", "points", "facets")}
        # A record of an earlier version counts parts as buildings.
        counts[PARTS] = int(record["counts"][PARTS if PARTS in record["counts"] else "buildings"])
        status = str(record["status"])
        depth = float(record.get("parameters", {}).get("underground", 0.0))
        core, rim = _read_pad(record["region"])
        parts = _read_parts(record.get("parts") or {}, counts["cells"])
        roofs = _read_roof_rules(record.get("parameters", {}))
        found = (record.get("land_cover") or {}).get("patches", [])
        given = record.get("parameters", {})
        solids = bool(given.get("solids", False))
        leaves = bool(given.get("vegetation_classes") or given.get("trees"))
        cell = float(given.get("leaf_column", 2.0))
        zones = read_described(record.get("zones") or ())
        if not zones and (given.get("focus") or given.get("lod_zones")):
            raise InputError(f"{path}: its parameters name zones of detail, and the zones are missing; run again")
        at_levels = {level: int(record["counts"].get(f"parts at level {level}", 0)) for level in LEVELS}
        at_levels[CELLS_REPLACED] = int(record["counts"].get(CELLS_REPLACED, 0))
        sizes = _read_sizes(given) if zones else SizesAsked()
        spacing = float(given.get("dtm_spacing", 1.0))
        ground = tuple(GroundPatch(str(row["patch"]), _optional(row["z0 (m)"])) for row in found)
    except WRONG_FIELD as error:
        raise broken_field(path, error) from None
    if not (west < east and south < north and math.isfinite(west + south + east + north)):
        raise InputError(f"{path}: region bounds {west, south, east, north} are no box; run again")
    if not 0 <= depth < math.inf:
        raise InputError(f"{path}: underground is {depth} m, expected 0 or more; run again")
    return RunRecord(
        status,
        (west, south, east, north),
        top,
        counts,
        record[TILES],
        depth,
        core,
        rim,
        parts,
        roofs,
        ground,
        spacing,
        leaves,
        cell,
        zones,
        at_levels,
        solids,
        sizes,
    )


def _optional(value: Any) -> float | None:
    return None if value is None else float(value)


def _read_roof_rules(parameters: Mapping[str, Any]) -> RoofRules:
    if parameters.get("roofs", "flat") == "flat" or roofs_stay_flat(parameters["mesher"], parameters["simplify"]):
        return FLAT_ROOFS
    least = float(parameters["least_spacing"]) * float(parameters["mesh_size"])
    return RoofRules(
        sloped=True,
        step=max(Weld.most, least),
        clearance=max(float(parameters["roof_clearance"]), least),
        joined=Weld.least / 2,
        lifts=least > Weld.least,
        slack=Weld.slack,
        raised=float(parameters["roof_clearance"]),
    )


def _read_sizes(given: Mapping[str, Any]) -> SizesAsked:
    size, others = float(given["mesh_size"]), ("wall_size", "refine", "refine_areas", "land_cover", "water_points")
    alone = not any(given.get(name) for name in others)
    largest, growth = max(size, float(given["open_size"])), float(given["refine_growth"])
    return SizesAsked(size, largest, growth, alone, not given.get("first_layer"), float(given["clearance"]))


def _read_parts(found: Mapping[str, Any], n_cells: int) -> tuple[MeshPart, ...]:
    n = min(int(found.get("n", 0)), n_cells)
    listed = [
        MeshPart(int(part["cells"]), tuple(map(str, part["tiles"])), tuple(map(str, part["divided"])))
        for part in found.get("largest", ())
    ]
    return (*listed, *[MeshPart(0)] * max(n - len(listed), 0))[: max(n, 0)]


def _read_pad(region: Mapping[str, Any]) -> tuple[tuple[float, float, float, float] | None, float]:
    if "core" not in region:
        return None, math.nan
    west, south, east, north = (float(value) for value in region["core"])
    return (west, south, east, north), float(region["rim"])


def read_crs(path: Path) -> str:
    """Read from ``run.json`` in which CRS the run's coordinates are.

    Raises
    ------
    InputError
        If it is missing or damaged, or names no CRS.
    """
    record = _read_members(path, ("region",))
    try:
        crs = record["region"]["crs"]
        if not isinstance(crs, str) or not crs:
            raise TypeError(f"crs is {crs!r}")
    except WRONG_FIELD as error:
        raise broken_field(path, error) from None
    return crs


def broken_field(path: Path, error: Exception) -> InputError:
    """Make the error of a file with a `WRONG_FIELD`."""
    return InputError(f"{path}: a field is missing or wrong ({error!r}); run again")


def _read_members(path: Path, names: Collection[str]) -> dict[str, Any]:
    """Read some members of a JSON object; of tiles, their boxes (n, 4) by name."""
    found, _ = read_members(path, names.__contains__)
    found[TILES] = {name: _box(tile) for name, tile in iterate_members(path, TILES)}
    return found


def _box(tile: Any) -> tuple[float, ...] | None:
    """Take the box of a tile (m), None where it has none."""
    try:
        west, south, east, north = map(float, tile["box"])
    except WRONG_FIELD:
        return None
    return west, south, east, north
