"""`citystitch check`: prove from the written files that a run's mesh is right."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.mesh import Marker
from stitch.frontier import Settled, add_rim, close_frontier, start_frontier
from tiler import city_proofs, proofs
from tiler.check_piece import ANY, GROUND, TOP, Piece, read_piece, take_vertices
from tiler.proofs import Dtm, Fault, Finding, Proof, Vertices
from tiler.run_folder import Buildings, RunRecord, read_buildings, read_run_record
from tiler.vtk_files import read_piece_paths

RUN_RECORD = "run.json"
STORE = "store.zarr"
CITY_MODEL = "citymodel.city.json"
VOLUME_INDEX = "mesh.pvtu"
BOUNDARY_INDEX = "boundary.pvtp"


@dataclass(frozen=True)
class CheckReport:
    """What was proved of a run folder.

    Attributes
    ----------
    directory : Path
        The folder.
    proofs : tuple of Proof
        All claims, in a fixed order, with the faults of each.
    facts : mapping of str to float
        Numbers read on the way: ``cells``, ``points``, ``facets``, ``buildings``, ``non_manifold_edges``,
        ``volume`` and ``smallest_cell`` (m³), ``seam_faces``, ``missing_facets``.
    """

    directory: Path
    proofs: tuple[Proof, ...]
    facts: Mapping[str, float]

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
        return [*lines, f"{self.directory}: {verdict}"]


def check_run(directory: Path, load_dtm: Callable[[Path], Dtm]) -> CheckReport:
    """Prove that the mesh in a run folder is conforming, watertight, and that of its city model and DTM.

    Parameters
    ----------
    directory : Path
        The folder of a run.
    load_dtm : callable
        Given the path of the store, returns the terrain, which has ``sample(xy (n, 2)) -> z (n,)``.

    Returns
    -------
    CheckReport
        Claims and faults.

    Raises
    ------
    InputError
        If a file is missing or damaged.

    Notes
    -----
    Pieces are read one after the other: memory holds one piece, what waits for a neighbour on the frontier
    (`stitch.frontier`), and the city model.
    """
    record = read_run_record(directory / RUN_RECORD)
    buildings = read_buildings(directory / CITY_MODEL)
    files = _pair_pieces(directory)
    dtm = load_dtm(directory / STORE)
    sums = _Sums.start(len(buildings))
    frontier = start_frontier()
    for number, (volume, boundary) in enumerate(files):
        piece = read_piece(volume, boundary, record.bounds)
        frontier, settled, fresh = add_rim(frontier, piece.rim, number)
        sums.add_piece(piece, fresh, record, buildings, dtm)
        sums.add_settled(settled)
    sums.add_settled(close_frontier(frontier))
    return CheckReport(directory, *_conclude(sums, len(files), record, buildings))


@dataclass(eq=False)
class _Sums:
    """What has been found so far: by claim, by building, and in numbers."""

    found: dict[str, Finding]
    built: city_proofs.Built
    counts: dict[str, int]
    smallest: float
    faults: tuple[Fault, ...]
    crowded: Vertices  # (c, 2): where edges have more than two facets
    seams: set[tuple[int, int]]

    @classmethod
    def start(cls, n_buildings: int) -> "_Sums":
        none = np.zeros(n_buildings)
        built = city_proofs.Built(none, none.astype(np.int64), none.astype(np.int64), none)
        counts = {"cells": 0, "points": 0, "facets": 0, "buildings": n_buildings}
        return cls({}, built, counts, np.inf, (), np.empty((0, 2)), set())

    def add_piece(
        self, piece: Piece, fresh: NDArray[np.bool_], record: RunRecord, buildings: Buildings, dtm: Dtm
    ) -> None:
        """Add what a piece says; `fresh` are the points of its rim that no earlier piece had."""
        surface = piece.surface
        found = {
            "same": piece.same_boundary,
            "closed": piece.closed,
            "marks": city_proofs.check_marks(surface, buildings),
            "box": proofs.check_box(surface, record.bounds, piece.rim.edges),
            "top": proofs.check_top(take_vertices(piece, Marker.TOP, TOP, fresh), record.top),
            "ground": proofs.check_ground(take_vertices(piece, Marker.GROUND, GROUND, fresh), dtm),
            "roofs": city_proofs.check_roofs(surface, buildings),
            "walls": city_proofs.check_walls(surface, buildings),
            "sizes": proofs.check_sizes(surface, piece.outline, piece.volume),
        }
        for name, finding in found.items():
            self._join(name, finding)
        self.built = city_proofs.add_built(self.built, city_proofs.find_built(surface, buildings, piece.outline))
        self.counts["cells"] += piece.n_cells
        self.counts["points"] += piece.n_points + int((piece.rim.points[fresh, 3] == ANY).sum())
        self.counts["facets"] += len(surface.boundary.facets)
        self.smallest = min(self.smallest, piece.smallest)
        self.faults = proofs.merge_faults((*self.faults, *piece.faults))
        self._add_crowded(piece.crowded)

    def add_settled(self, settled: Settled) -> None:
        """Add what is settled between pieces."""
        self._join("seams", proofs.check_seams(settled))
        self._join("closed", proofs.check_closed(settled.open_lines, settled.crowded_lines))
        self._add_crowded(settled.crowded_lines)
        self.seams.update((int(one), int(two)) for one, two in settled.seams)

    def _join(self, name: str, finding: Finding) -> None:
        self.found[name] = proofs.join_findings(self.found.get(name, Finding()), finding)

    def _add_crowded(self, edges: Vertices) -> None:
        self.crowded = np.unique(np.concatenate((self.crowded, edges.mean(axis=1)[:, :2])), axis=0)


def _conclude(
    sums: _Sums, n_pieces: int, record: RunRecord, buildings: Buildings
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
    claims = (
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
        city_proofs.prove_buildings(sums.built, buildings, bounds, partial=partial),
        proofs.prove_plan(found["sizes"], bounds, partial=partial),
        proofs.prove_volume(found["sizes"]),
        proofs.prove_record(record, sums.counts, partial=partial),
    )
    return claims, facts


def _tell(fault: Fault) -> str:
    places = "; ".join(f"({x:.3f}, {y:.3f}, {z:.3f})" for x, y, z in fault.places)
    return f"{fault.kind}: {fault.count}, {fault.detail}" + (f", at {places}" if places else "")


def _pair_pieces(directory: Path) -> list[tuple[Path, Path]]:
    """Return the volume and boundary file of every piece: they have one name."""
    volumes = {path.stem: path for path in read_piece_paths(directory / VOLUME_INDEX)}
    boundaries = {path.stem: path for path in read_piece_paths(directory / BOUNDARY_INDEX)}
    alone = sorted(volumes.keys() ^ boundaries.keys())
    if alone:
        names = f"{VOLUME_INDEX} and {BOUNDARY_INDEX}"
        raise InputError(f"{directory}: only one of {names} names the piece {alone[0]!r}; run again")
    return [(path, boundaries[name]) for name, path in volumes.items()]


def _prove_cells(sums: _Sums, n_pieces: int) -> Proof:
    claim = (
        f"{sums.counts['cells']} cells in {n_pieces} pieces: every face in one or two of them,"
        f" none inverted or flat (smallest {sums.smallest:.3g} m³), no vertex unused or duplicate"
    )
    return Proof(claim, sums.faults)
