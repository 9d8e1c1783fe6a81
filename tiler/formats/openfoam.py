"""OpenFOAM's polyMesh, whole or decomposed, written from the pieces one by one.

Faces stand in upper triangular order, then patch by patch. A decomposed mesh is written straight from the
tiles, as `decomposePar` would: columns of cells are grouped, faces between two groups become processor patches in
the same order on both sides, and the addressing to the whole mesh lies beside it for `reconstructPar`.
"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

import numpy as np

from pipeline.data.errors import CityError, ConfigError, InputError
from pipeline.data.regions import Region
from tiler.export.cell_parts import ColumnsFile, divide_cells, take_whole
from tiler.export.export import CELLS, EXPORT_RECORD, LARGEST_PART, ORIGIN, WORKERS, Format
from tiler.export.foam_case import write_system
from tiler.export.foam_files import LABEL_LIMIT
from tiler.export.foam_part import DISTANCES, FoamPlan, PartCounts, PointPlaces, write_part
from tiler.export.foam_patches import FIRST_BUILDING, GROUND_ZONE, interface_name, is_house, leaf_key
from tiler.export.pedestrian_surface import write_pedestrian_surface
from tiler.export.pieces import Pieces
from tiler.export.prism_pieces import PrismPieces, open_prisms
from tiler.export.region_faces import Ints, find_inner_ground, find_outer, survey_faces
from tiler.export.wind_case import PEDESTRIAN, Domain, write_wind_cases
from tiler.export.wind_profile import PEDESTRIAN_HEIGHT, Wind, WindWords, make_wind
from tiler.mesh_files.air import open_air
from tiler.mesh_files.mesh_pieces import MeshPiece, open_pieces
from tiler.mesh_files.run_files import RunFiles, RunSource, crs_of
from tiler.mesh_files.threads import map_threads
from tiler.store.atomic import replacing_folder

# Roughness lengths between rough ground and the centres of its cells. Over bare ground the profile stays within
# 2 % at 3 of them, and is 19 % off at 0.6: docs/wind.md.
LEAST_DISTANCE = 2.5
REGION_WORDS = {Region.SOIL: "cells in soil", Region.BUILDING: "cells in buildings"}
WIND_OPTIONS = ("direction", "wind_speed", "wind_height", "wind_table", "roughness", "patch_roughness")


def export_openfoam(
    output: Path,
    source: RunSource,
    *,
    parts: int | None = None,
    case: str | None = None,
    buildings: str | None = None,
    cells: str | None = None,
    prism_layers: int | None = None,
    workers: int = 0,
    **wind: Unpack[WindWords],
) -> list[str]:
    """Write a case folder of OpenFOAM from a finished run.

    Parameters
    ----------
    output : Path
        The folder; it appears whole or not at all.
    source : Path or RunFiles
        Folder of the run.
    parts, buildings
        See `write_openfoam`.
    case : {"wind"}, optional
        Add the files of a simulation. The mesh is then that of the air alone.
    cells : {"prism", "hybrid"}, optional
        Write prisms instead of tetrahedra; see `tiler.export.prism_pieces.open_prisms`, also for memory.
    prism_layers : int, optional
        Of a hybrid mesh.
    workers : int
        See `write_openfoam`.
    **wind
        See `tiler.export.wind_profile.Wind`.

    Returns
    -------
    list of str
        What must be known of the case: sides for each direction of the wind, and where the mesh does not suit it.

    Raises
    ------
    ConfigError
        If there are too few columns for so many parts, no side for the wind to come from, or a mesh of several
        parts that share no face.
    InputError
        If the run is not finished, or a file of it is missing or damaged.
    OutputError
        If the folder cannot be written.
    """
    if case is None and wind:
        raise ConfigError(f"--{min(wind).replace('_', '-')}: is for --case wind; give that too")
    blowing = make_wind(wind)
    notes: list[str] = []
    pieces = open_pieces(source)
    if case is None and buildings is not None and Region.BUILDING in pieces.files.regions:
        raise ConfigError(
            f"--buildings {buildings}: buildings of this mesh have cells, so walls and roofs are no patches; "
            "leave it out, add --case wind, which is of the air alone, or mesh without --solids"
        )
    if case is not None and pieces.files.parts != 1:
        raise _refuse_parts(case, pieces.files)
    if case is not None and len(pieces.files.regions) > 1:
        others = " and ".join(REGION_WORDS[region] for region in pieces.files.regions if region != Region.AIR)
        pieces, notes = open_air(pieces), [f"the case is of the air alone: {others} stay out"]
    with replacing_folder(output) as folder, TemporaryDirectory(dir=folder, prefix=".heights.") as name:
        heights = None if case is None else Path(name, "heights")
        if heights is not None:
            heights.mkdir()
        combined = pieces if cells is None else open_prisms(pieces, cells, prism_layers, Path(name))
        counts = write_openfoam(
            folder, combined, parts=parts, buildings=buildings, heights=heights, threads=workers
        )
        if heights is None:
            write_system(folder, parts=parts)
        else:
            surface = folder / "constant" / "triSurface" / f"{PEDESTRIAN}.obj"
            write_pedestrian_surface(surface, pieces.files, height=PEDESTRIAN_HEIGHT)
            domain = _describe_domain(counts, heights)
            own = {name: z0 for name, z0 in pieces.files.ground if z0 is not None and domain.patches.get(name)}
            blowing = replace(blowing, patches={**own, **blowing.patches})
            notes += write_wind_cases(folder, domain, blowing, parts=parts)
            notes += _tell_near_walls(counts, blowing)
        # ParaView opens a case by an empty file.
        (folder / "case.foam").touch()
        record = _record(counts, parts)
        if any(pieces.files.origin):
            record["origin"] = pieces.files.origin
        if case is not None:
            crs = crs_of(pieces.files)
            record |= {"crs": crs, "wind": asdict(blowing), "notes": notes, "regions": ["air"]}
        (folder / EXPORT_RECORD).write_text(json.dumps(record, indent=1) + "\n")
    return notes


def _describe_domain(counts: Sequence[PartCounts], heights: Path) -> Domain:
    patches: Counter[str] = Counter()
    lowest: dict[str, float] = {}
    highest: dict[str, float] = {}
    for part in counts:
        patches.update({name: n for name, n in part.patches.items() if name in part.lowest})
        lowest |= {name: min(z, lowest.get(name, z)) for name, z in part.lowest.items()}
        highest |= {name: max(z, highest.get(name, z)) for name, z in part.highest.items()}
    leaves = sorted(set().union(*(part.leaves for part in counts)))
    return Domain(patches, lowest, highest, tuple(heights / str(n) for n in range(len(counts))), tuple(leaves))


def _tell_near_walls(counts: Sequence[PartCounts], wind: Wind) -> list[str]:
    """Tell where cells at rough walls are thinner than their roughness allows."""
    lines = []
    for patch, z0 in {"ground": wind.roughness, **wind.patches}.items():
        near = sum((part.near[patch] for part in counts if patch in part.near), np.zeros(len(DISTANCES) + 1, int))
        least = LEAST_DISTANCE * z0
        below, n = int(near[: np.searchsorted(DISTANCES, least)].sum()), int(near.sum())
        if below:
            lines.append(
                f"warning: {below:,} of {n:,} cells on {patch} ({below / n:.0%}) have their centre within "
                f"{least:g} m of it, where the wall function of a roughness length of {z0:g} m does not hold; "
                f"give a smaller --roughness or --patch-roughness {patch}=..., or mesh with a larger --first-layer"
            )
    return lines


def _refuse_parts(case: str, files: RunFiles) -> CityError:
    """Make the error of a mesh in which the wind does not get everywhere."""
    if not files.parts:
        return InputError(f"{files.directory}: its record does not say in how many parts the mesh is; run again")
    return ConfigError(
        f"--case {case}: the mesh is {files.parts:,} parts that share no face, and no air flows between them; "
        "give --largest-part for the largest alone, mesh them apart by --bounds, or close the gap between the "
        "point clouds"
    )


def _record(counts: Sequence[PartCounts], parts: int | None) -> dict[str, Any]:
    record: dict[str, Any] = {"schema": 1, "format": "openfoam", "decomposed": parts is not None}
    if parts is not None:
        cells = [part.cells for part in counts]
        record["balance"] = round(max(cells) * len(cells) / sum(cells), 6)  # the largest part over the mean
        record["interfaces"] = [
            [number, other, n]
            for number, part in enumerate(counts)
            for other in range(number + 1, parts)
            if (n := part.patches.get(interface_name(number, other), 0))
        ]
    meshes = [asdict(part) for part in counts]
    for mesh in meshes:
        del mesh["near"]
        if not mesh["leaves"]:
            del mesh["leaves"]
    return {**record, "meshes": meshes}


def write_openfoam(
    folder: Path,
    pieces: Pieces,
    *,
    parts: int | None = None,
    buildings: str | None = None,
    heights: Path | None = None,
    threads: int = 0,
) -> list[PartCounts]:
    """Write a mesh as OpenFOAM reads it.

    Parameters
    ----------
    folder : Path
        An existing folder: that of the case.
    pieces : Pieces
        The mesh.
    parts : int, optional
        Write ``processor0`` to ``processorN-1`` instead of the whole mesh.
    buildings : {"patches", "zones"}, optional
        Give each building, walls and roofs, a patch of its own, or a face zone beside the patches.
    heights : Path, optional
        An existing folder to write the heights of the centres of cells to; see `FoamPlan`.
    threads : int
        How many read and write pieces of the whole mesh, or write parts; with less than 2 this one does.

    Returns
    -------
    list of PartCounts
        Of the whole mesh, or of each part.

    Raises
    ------
    ConfigError
        If there are too few columns for so many parts.
    InputError
        If a piece is damaged, or pieces do not fit together.

    Notes
    -----
    Memory: for each thread one piece with its faces (some 80 bytes a cell), the faces between one part and the
    others (some 60 bytes each), and what `survey_faces` holds. Files beside the result, gone at the end: 40 bytes
    a face between two tiles; for parts also 8 bytes a point, 12 a cell and 24 a column. Each piece is read twice;
    for parts twice, and once more for each part that has cells of it.
    """
    if parts is not None and parts < 1:
        raise ConfigError(f"--parts {parts}: must be 1 or more")
    sets_of = _by_building if buildings == "patches" else _by_marker
    zones_of = _by_zone if buildings == "zones" else _by_ground
    with TemporaryDirectory(dir=folder, prefix=".faces.") as name:
        scratch = Path(name)
        columns = ColumnsFile(scratch / "columns")
        look = None if parts is None else columns.add
        region, (patches, zones, volumes) = survey_faces(
            pieces, scratch, kinds=(sets_of, zones_of, _by_volume), look=look, threads=threads
        )
        if parts is None:
            divided = take_whole(region, (patches, zones, volumes))
        else:
            kinds = ((sets_of, patches), (zones_of, zones))
            divided = divide_cells(
                pieces, region, columns, scratch, n_parts=parts, kinds=kinds, volumes=(_by_volume, volumes)
            )
        n_faces = region.n_inner + int(patches.first(range(len(pieces.names)))[1].sum())
        polygons = isinstance(pieces, PrismPieces)
        most = max((4 if polygons else 3) * n_faces, pieces.n_points, int(region.cell_start[-1]))
        label = 32 if most <= LABEL_LIMIT else 64
        zoned = buildings == "zones" or len(zones.keys) > 0
        plan = FoamPlan(
            pieces,
            region,
            patches,
            volumes,
            zoned,
            sets_of,
            zones_of,
            divided,
            label,
            heights,
            _by_volume,
            polygons,
        )
        if parts is None:
            return [write_part(folder, plan, 0, None, threads=threads)]

        def write(number: int) -> PartCounts:
            places = PointPlaces(scratch / f"places{number}", pieces.n_points)
            return write_part(folder / f"processor{number}", plan, number, places)

        return list(map_threads(write, range(parts), threads))


def _by_marker(piece: MeshPiece) -> Ints:
    return np.where(find_outer(piece), piece.marker, -1).astype(np.int64)


def _by_building(piece: MeshPiece) -> Ints:
    houses = is_house(piece.marker, piece.building)
    return np.where(houses, piece.building + FIRST_BUILDING, _by_marker(piece))


def _by_zone(piece: MeshPiece) -> Ints:
    return np.where(is_house(piece.marker, piece.building), piece.building, _by_ground(piece))


def _by_ground(piece: MeshPiece) -> Ints:
    return np.where(find_inner_ground(piece), GROUND_ZONE, -1)


def _by_volume(piece: MeshPiece) -> Ints:
    """Give the key of each cell's zone, -1 for none; nothing at all where no cell can have one."""
    if piece.leaves is None:
        return np.empty(0, np.int64) if piece.region is None else piece.region.astype(np.int64)
    of_region = -1 if piece.region is None else piece.region.astype(np.int64)
    return np.where(piece.leaves > 0, leaf_key(piece.leaves), of_region)


FORMAT = Format(
    "a case folder of OpenFOAM",
    export_openfoam,
    options=("parts", "case", *WIND_OPTIONS, "buildings", *CELLS, LARGEST_PART, ORIGIN, WORKERS),
    buildings=("patches", "zones"),
    folder=True,
)
