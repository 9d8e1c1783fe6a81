"""OpenFOAM's polyMesh, whole or decomposed, written from the pieces one by one.

Faces stand in upper triangular order, then patch by patch. A decomposed mesh is written straight from the
tiles, as `decomposePar` would: columns of cells are grouped, faces between two groups become processor patches in
the same order on both sides, and the addressing to the whole mesh lies beside it for `reconstructPar`.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pipeline.data.errors import CityError, ConfigError, InputError
from tiler.export.cell_parts import ColumnsFile, divide_cells, take_whole
from tiler.export.export import EXPORT_RECORD, LARGEST_PART, Format
from tiler.export.foam_case import INLET, OUTLET, write_system, write_wind_case
from tiler.export.foam_files import LABEL_LIMIT
from tiler.export.foam_part import FoamPlan, PartCounts, PointPlaces, write_part
from tiler.export.foam_patches import FIRST_BUILDING, GROUND_ZONE, interface_name, is_house
from tiler.export.pieces import Pieces
from tiler.export.region_faces import Ints, find_outer, survey_faces
from tiler.mesh_files.mesh_pieces import MeshPiece, open_pieces
from tiler.mesh_files.run_files import RunFiles, RunSource
from tiler.store.atomic import replacing_folder


def export_openfoam(
    output: Path,
    source: RunSource,
    *,
    parts: int | None = None,
    case: str | None = None,
    buildings: str | None = None,
) -> None:
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
        Add the files of a simulation.

    Raises
    ------
    ConfigError
        If there are too few columns for so many parts, no side for the wind to come from, soil where it should
        blow, or a mesh of several parts that share no face.
    InputError
        If the run is not finished, or a file of it is missing or damaged.
    OutputError
        If the folder cannot be written.
    """
    pieces = open_pieces(source)
    if case is not None and pieces.files.depth:
        raise ConfigError(
            f"--case {case}: the mesh has soil to {pieces.files.depth:g} m below ground, where no wind blows; "
            "leave --case out, or mesh without --underground"
        )
    if case is not None and pieces.files.parts != 1:
        raise _refuse_parts(case, pieces.files)
    with replacing_folder(output) as folder:
        counts = write_openfoam(folder, pieces, parts=parts, buildings=buildings)
        write_system(folder, parts=parts, case=case)
        if case is not None:
            inlet = [part.lowest[INLET] for part in counts if INLET in part.lowest]
            if not inlet or not any(part.patches.get(OUTLET) for part in counts):
                raise ConfigError(
                    f"--case {case}: the mesh has no facets on its {INLET} or {OUTLET} side; leave --case out"
                )
            starts = [folder] if parts is None else [folder / f"processor{n}" for n in range(parts)]
            write_wind_case(folder, starts, ground=min(inlet))
        # ParaView opens a case by an empty file.
        (folder / "case.foam").touch()
        (folder / EXPORT_RECORD).write_text(_record(counts, parts))


def _refuse_parts(case: str, files: RunFiles) -> CityError:
    """Make the error of a mesh in which the wind does not get everywhere."""
    if not files.parts:
        return InputError(f"{files.directory}: its record does not say in how many parts the mesh is; run again")
    return ConfigError(
        f"--case {case}: the mesh is {files.parts:,} parts that share no face, and no air flows between them; "
        "give --largest-part for the largest alone, mesh them apart by --bounds, or close the gap between the "
        "point clouds"
    )


def _record(counts: Sequence[PartCounts], parts: int | None) -> str:
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
    return json.dumps({**record, "meshes": [asdict(part) for part in counts]}, indent=1) + "\n"


def write_openfoam(
    folder: Path, pieces: Pieces, *, parts: int | None = None, buildings: str | None = None
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
    Memory: one piece with its faces (some 80 bytes a cell), the faces between one part and the others (some
    60 bytes each), and what `survey_faces` holds. Files beside the result, gone at the end: 40 bytes a face
    between two tiles; for parts also 8 bytes a point, 12 a cell and 24 a column. Each piece is read twice; for
    parts twice, and once more for each part that has cells of it.
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
            pieces, scratch, kinds=(sets_of, zones_of, _by_region), look=look
        )
        if parts is None:
            divided = take_whole(region, (patches, zones, volumes))
        else:
            kinds = ((sets_of, patches), (zones_of, zones))
            divided = divide_cells(
                pieces, region, columns, scratch, n_parts=parts, kinds=kinds, volumes=(_by_region, volumes)
            )
        n_faces = region.n_inner + int(patches.first(range(len(pieces.names)))[1].sum())
        label = 32 if max(3 * n_faces, pieces.n_points, int(region.cell_start[-1])) <= LABEL_LIMIT else 64
        zoned = buildings == "zones" or len(zones.keys) > 0
        plan = FoamPlan(pieces, region, patches, volumes, zoned, sets_of, zones_of, divided, label)
        if parts is None:
            return [write_part(folder, plan, 0, None)]
        places = PointPlaces(scratch / "places", pieces.n_points)
        return [write_part(folder / f"processor{number}", plan, number, places) for number in range(parts)]


def _by_marker(piece: MeshPiece) -> Ints:
    return np.where(find_outer(piece), piece.marker, -1).astype(np.int64)


def _by_building(piece: MeshPiece) -> Ints:
    houses = is_house(piece.marker, piece.building)
    return np.where(houses, piece.building + FIRST_BUILDING, _by_marker(piece))


def _by_zone(piece: MeshPiece) -> Ints:
    return np.where(is_house(piece.marker, piece.building), piece.building, _by_ground(piece))


def _by_ground(piece: MeshPiece) -> Ints:
    return np.where(find_outer(piece), -1, GROUND_ZONE)


def _by_region(piece: MeshPiece) -> Ints:
    return np.empty(0, np.int64) if piece.region is None else piece.region.astype(np.int64)


FORMAT = Format(
    "a case folder of OpenFOAM",
    export_openfoam,
    options=("parts", "case", "buildings", LARGEST_PART),
    buildings=("patches", "zones"),
    folder=True,
)
