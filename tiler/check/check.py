"""`citystitch check`: prove from the written files that a run's mesh is right."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import InputError
from pipeline.data.mesh import INTERFACES
from pipeline.geometry.components import join_pairs
from stitch.pieces.frontier import Settled, add_rim, close_frontier, start_frontier
from tiler.check import city_proofs, cover_proofs, pad_proofs, proofs, soil_proofs, wall_proofs
from tiler.check.check_piece import ANY, GROUND, TOP
from tiler.check.piece_survey import LoadDtm, PieceTask, Survey, load_survey, survey_piece
from tiler.check.proofs import Fault, Finding, Proof, Vertices
from tiler.check.solid_proofs import check_crs, check_solids, read_outlines
from tiler.check.zone_proofs import check_zones, prove_sizes_of_zones, read_given_blocks
from tiler.citymodels.building_index import BuildingIndex, copy_vertices, index_buildings, open_vertices
from tiler.executors.dask_settings import FREED, start_fork_server
from tiler.executors.in_order import map_in_order
from tiler.mesh_files.mesh_parts import report_parts
from tiler.mesh_files.threads import check_workers
from tiler.mesh_files.vtk_files import read_piece_paths
from tiler.store.kept import IN_PIECES, need
from tiler.store.out_folder import CITY_MODEL, FULL_CITY_MODEL, RUN_RECORD, STORE
from tiler.store.run_folder import PARTS, RunRecord, read_crs, read_run_record

VOLUME_INDEX = "mesh.pvtu"
BOUNDARY_INDEX = "boundary.pvtp"


@dataclass(frozen=True)
class CheckReport:
    """What was proved of a run folder."""

    directory: Path  #: the folder
    proofs: tuple[Proof, ...]  #: all claims, in a fixed order, with the faults of each
    #: numbers read on the way: ``cells``, ``points``, ``facets``, ``building parts``, ``non_manifold_edges``,
    #: ``volume`` and ``smallest_cell`` (m³), ``seam_faces``, ``missing_facets``, ``parts`` of the air that share
    #: no face
    facts: Mapping[str, float]
    remarks: tuple[str, ...] = ()  #: what is no fault, but must be known before a solver runs

    @property
    def faults(self) -> tuple[Fault, ...]:
        """All faults."""
        return tuple(fault for proof in self.proofs for fault in proof.faults)

    @property
    def ok(self) -> bool:
        """Whether every claim is proved."""
        return not self.faults

    def lines(self) -> list[str]:
        """Return the report as text: one line a claim, and one below it for each of its faults."""
        lines = []
        for proof in self.proofs:
            lines.append(f"{'FAULT' if proof.faults else 'ok   '} {proof.claim}")
            lines += [f"      {_tell(fault)}" for fault in proof.faults]
        n = len({fault.kind for fault in self.faults})
        verdict = "everything is proved" if self.ok else f"{n} {'kind' if n == 1 else 'kinds'} of fault"
        if self.remarks:
            verdict += f", {'but' if self.ok else 'and'} see the {'note' if len(self.remarks) == 1 else 'notes'}"
        return [*lines, *(f"NOTE  {remark}" for remark in self.remarks), f"{self.directory}: {verdict}"]


def check_run(directory: Path, load_dtm: LoadDtm, *, workers: int = 0) -> CheckReport:
    """Prove that the mesh in a run folder is conforming, watertight, and that of its city model and DTM.

    Parameters
    ----------
    directory : Path
        The folder of a run.
    load_dtm : callable
        Given the path of the store, returns the terrain, which has ``sample(xy (n, 2)) -> z (n,)``. A function of
        a module, so that workers can import it.
    workers : int
        Processes of this machine that look at pieces; with 0 this one does.

    Returns
    -------
    CheckReport
        Claims and faults: the same whatever the workers.

    Raises
    ------
    ConfigError
        If there are less than 0 workers.
    InputError
        If a file is missing or damaged.
    ClusterError
        If a worker process died.

    Notes
    -----
    A task reads a piece, with the buildings and the terrain around it, and leaves what it says in a temporary
    file. These are put together here, piece after piece along the long side of the region: memory holds what waits
    for a neighbour on the frontier (`stitch.pieces.frontier`), besides some 100 bytes a building and 500 a piece.
    """
    check_workers(workers)
    need(directory, IN_PIECES)
    record = read_run_record(directory / RUN_RECORD)
    if workers:
        start_fork_server()  # which imports what workers need while buildings are read here
    with (
        TemporaryDirectory(prefix="citystitch-") as folder,
        index_buildings(directory / CITY_MODEL, Path(folder)) as index,
    ):
        files = _in_order(_pair_pieces(directory), record)
        tasks = [
            PieceTask(directory, *names, Path(folder), Path(folder) / f"{k}.survey", load_dtm)
            for k, names in enumerate(files)
        ]
        items: list[tuple[Path, Path] | PieceTask] = [(directory, Path(folder)), *tasks]
        sums, frontier = _Sums.start(len(index)), start_frontier()
        looks = map_in_order(_look, items, workers, malloc=FREED)
        models = next(looks)
        for number, (task, _) in enumerate(zip(tasks, looks, strict=True)):
            survey = load_survey(task.out)
            rim = replace(survey.rim, part=survey.rim.part + len(sums.part_cells))
            frontier, settled, fresh = add_rim(frontier, rim, number)
            sums.add_piece(survey)
            sums.add_fresh(survey, fresh, record)
            sums.add_settled(settled)
        sums.add_settled(close_frontier(frontier))
        sums.add_rim_walls()
        claims, facts = _conclude(sums, len(files), record, index)
        claims += models
        if record.zones:
            files_of_models = directory / CITY_MODEL, directory / FULL_CITY_MODEL
            given = read_given_blocks(directory / STORE, load_dtm(directory / STORE), record)
            claims += (check_zones(record.zones, *files_of_models, record.level_counts, given),)
        parts = sums.count_parts()
        remarks = (report_parts(parts),) if len(parts) > 1 else ()
        return CheckReport(directory, claims, {**facts, "parts": len(parts)}, remarks)


def _look(item: tuple[Path, Path] | PieceTask) -> tuple[Proof, ...]:
    """Look at the city models of a folder, which gives proofs, or at a piece."""
    if isinstance(item, PieceTask):
        survey_piece(item)
        return ()
    directory, folder = item
    model, full = open_vertices(folder), directory / FULL_CITY_MODEL
    with TemporaryFile() as file:
        earlier = copy_vertices(full, file)
        return (
            check_solids(directory / CITY_MODEL, model),
            check_solids(
                full,
                earlier,
                title="the city model before simplification",
                outlines=read_outlines(directory / STORE),
            ),
            check_crs({CITY_MODEL: model, FULL_CITY_MODEL: earlier}, read_crs(directory / RUN_RECORD)),
        )


@dataclass(eq=False)
class _Sums:
    """What has been found so far: by claim, by building, and in numbers."""

    found: dict[str, Finding]
    built: city_proofs.Built
    counts: dict[str, int]
    smallest: float
    faults: tuple[Fault, ...]
    crowded: Vertices  # (c, 2): where edges have more than two facets
    seams: NDArray[np.int64]  # (s, 2): pairs of pieces that share faces
    part_cells: NDArray[np.int64]  # (p,): cells of each part of a piece
    part_air: NDArray[np.bool_]  # (p,): whether it is air
    joined: NDArray[np.int64]  # (j, 2): pairs of parts that share faces
    rim_walls: wall_proofs.Walls  # over the rims of pieces

    @classmethod
    def start(cls, n_buildings: int) -> "_Sums":
        built = city_proofs.start_built(n_buildings)
        counts = {"cells": 0, "points": 0, "facets": 0, PARTS: n_buildings}
        pairs, part = np.empty((0, 2), np.int64), (np.empty(0, np.int64), np.empty(0, np.bool_))
        walls = wall_proofs.no_walls()
        return cls({}, built, counts, np.inf, (), np.empty((0, 2)), pairs, *part, pairs, walls)

    def add_piece(self, survey: Survey) -> None:
        """Add what a piece alone says."""
        for name, finding in survey.found.items():
            self._join(name, finding)
        self.rim_walls = wall_proofs.join_walls(self.rim_walls, survey.rim_walls)
        city_proofs.add_built(self.built, survey.rows, survey.built)
        self.counts["cells"] += survey.n_cells
        self.counts["points"] += survey.n_points
        self.counts["facets"] += survey.n_facets
        self.smallest = min(self.smallest, survey.smallest)
        self.faults = proofs.merge_faults((*self.faults, *survey.faults))
        self._add_crowded(survey.crowded)
        self.part_cells = np.concatenate((self.part_cells, survey.part_cells))
        self.part_air = np.concatenate((self.part_air, survey.part_air))

    def add_fresh(self, survey: Survey, fresh: NDArray[np.bool_], record: RunRecord) -> None:
        """Add the points over the rim of a piece that no earlier piece had."""
        points, kind = survey.rim.points[:, :3], survey.rim.points[:, 3]
        self.counts["points"] += int((fresh & (kind == ANY)).sum())
        on_ground = fresh & (kind == GROUND)
        ground = points[on_ground]
        self._join("top", proofs.check_top(points[fresh & (kind == TOP)], record.top))
        self._join("ground", proofs.check_ground(ground, survey.terrain[on_ground]))
        if record.core is not None:
            self._join("pad", pad_proofs.check_level(ground, record.bounds, record.core, record.rim))
        if record.ground:
            self._join("levels", cover_proofs.check_levels(ground, survey.level[on_ground]))

    def add_settled(self, settled: Settled) -> None:
        """Add what is settled between pieces."""
        self._join("seams", proofs.check_seams(settled))
        self._join("closed", proofs.check_closed(settled.open_lines, settled.crowded_lines))
        self._add_crowded(settled.crowded_lines)
        if len(settled.seams):
            self.seams = np.unique(np.concatenate((self.seams, settled.seams)), axis=0)
            self.joined = np.unique(np.concatenate((self.joined, settled.joined)), axis=0)

    def add_rim_walls(self) -> None:
        """Add the walls over the rims of pieces, of which no more will come."""
        self._join("overlap", wall_proofs.check_overlap(self.rim_walls))

    def count_parts(self) -> list[int]:
        """Cells of the parts of the air that share no face, the largest first."""
        air, name = self.part_air, join_pairs(len(self.part_cells), self.joined)
        cells = np.bincount(name[air], self.part_cells[air]).astype(np.int64)
        return sorted(cells[cells > 0].tolist(), reverse=True)

    def _join(self, name: str, finding: Finding) -> None:
        self.found[name] = proofs.join_findings(self.found.get(name, Finding()), finding)

    def _add_crowded(self, edges: Vertices) -> None:
        self.crowded = np.unique(np.concatenate((self.crowded, edges.mean(axis=1)[:, :2])), axis=0)


def _conclude(
    sums: _Sums, n_pieces: int, record: RunRecord, index: BuildingIndex
) -> tuple[tuple[Proof, ...], Mapping[str, float]]:
    """Make the claims and the facts of what was found."""
    found, bounds = sums.found, record.bounds
    partial = found["box"].sums["missing"] > 0
    facts = sums.counts | {
        "non_manifold_edges": int(found["closed"].sums["crowded"]),
        "volume": found["sizes"].sums["cells"],
        "smallest_cell": sums.smallest,
        "seam_faces": int(found["seams"].sums["faces"]),
        "missing_facets": int(found["box"].sums["missing"]),
    }
    claims: tuple[Proof, ...] = (
        _prove_cells(sums, n_pieces),
        proofs.prove_seams(found["seams"], len(sums.seams), n_pieces),
        proofs.prove_same_boundary(found["same"]),
        proofs.prove_closed(found["closed"], sums.crowded),
        city_proofs.prove_marks(found["marks"]),
        proofs.prove_box(found["box"], bounds),
        proofs.prove_top(found["top"], record.top),
        proofs.prove_ground(found["ground"]),
        city_proofs.prove_roofs(found["roofs"]),
        city_proofs.prove_walls(found["walls"]),
        wall_proofs.prove_overlap(found["overlap"]),
        city_proofs.prove_buildings(sums.built, index, bounds, rules=record.roofs, partial=partial),
        proofs.prove_plan(found["sizes"], bounds, partial=partial),
        proofs.prove_volume(found["sizes"]),
        proofs.prove_record(record, sums.counts, partial=partial),
    )
    if record.core is not None:
        claims += (pad_proofs.prove_pad(found["pad"], record.core, record.rim),)
    if record.ground:
        claims += (
            cover_proofs.prove_cover(found["cover"], record.ground),
            cover_proofs.prove_levels(found["levels"]),
        )
    if record.leaves:
        claims += (cover_proofs.prove_leaves(found["leaves"]),)
    if record.zones:
        claims += (prove_sizes_of_zones(found["zones"]),)
    for sides in INTERFACES:
        if (name := f"between {soil_proofs.name_interface(sides)}") in found:
            claims += (soil_proofs.prove_between(found[name], sides),)
    if record.depth:
        claims += (soil_proofs.prove_bottom(found["bottom"], record.depth),)
    if "foundations" in found:
        claims += (soil_proofs.prove_foundations(found["foundations"]),)
    if record.depth:
        claims += (soil_proofs.prove_soil_sizes(found["soil"], found["sizes"]),)
        facts |= {"soil_volume": found["soil"].sums["cells"]}
    if record.solids:
        claims += (soil_proofs.prove_building_cells(found["houses"]),)
        facts |= {"building_volume": found["houses"].sums["cells"]}
    return claims, facts


def _tell(fault: Fault) -> str:
    places = "; ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in fault.places)
    return f"{fault.kind}: {fault.count}, {fault.detail}" + (f", at {places}" if places else "")


def _pair_pieces(directory: Path) -> list[tuple[str, str]]:
    """Return the volume and boundary file of every piece, below the directory: they have one name."""
    volumes, boundaries = (
        {path.stem: str(path.relative_to(directory)) for path in read_piece_paths(directory / index)}
        for index in (VOLUME_INDEX, BOUNDARY_INDEX)
    )
    alone = sorted(volumes.keys() ^ boundaries.keys())
    if alone:
        names = f"{VOLUME_INDEX} and {BOUNDARY_INDEX}"
        raise InputError(f"{directory}: only one of {names} names the piece {alone[0]!r}; run again")
    return [(path, boundaries[name]) for name, path in volumes.items()]


def _in_order(files: list[tuple[str, str]], record: RunRecord) -> list[tuple[str, str]]:
    """Put pieces in an order in which few wait: across the region, then along its long side.

    What waits for a neighbour is then no more than the pieces across have. Where the record does not state the
    boxes of all tiles, pieces stay in the order of the index.
    """
    west, south, east, north = record.bounds
    axes = (0, 1) if east - west >= north - south else (1, 0)
    corners = [record.tiles.get(Path(volume).stem) for volume, _ in files]
    known = [corner for corner in corners if corner is not None]
    if len(known) < len(files):
        return files
    order = sorted(range(len(files)), key=lambda k: [known[k][axis] for axis in axes])
    return [files[k] for k in order]


def _prove_cells(sums: _Sums, n_pieces: int) -> Proof:
    claim = (
        f"{sums.counts['cells']} cells in {n_pieces} pieces: every face in one or two of them,"
        f" none inverted or flat (smallest {sums.smallest:.3g} m³), no vertex unused or duplicate"
    )
    return Proof(claim, sums.faults)
