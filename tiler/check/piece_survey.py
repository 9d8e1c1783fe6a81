"""What one piece says of all claims: a task of `citystitch check`, which leaves it in a file for the seams."""

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from pipeline.plane_mesh.sizes import Finer
from stitch.pieces.frontier import Rim
from tiler.check import city_proofs, cover_proofs, pad_proofs, proofs, soil_proofs, wall_proofs
from tiler.check.check_piece import GROUND, Piece, read_piece, take_vertices
from tiler.check.proofs import Bounds, Dtm, Fault, Finding, Mask, Vertices
from tiler.check.zone_proofs import check_sizes_of_zones, zone_finer
from tiler.citymodels.building_index import BuildingIndex, open_index
from tiler.store.out_folder import RUN_RECORD, STORE
from tiler.store.run_folder import RunRecord, read_run_record

if TYPE_CHECKING:
    from tiler.landcover.stored_cover import StoredCanopy, StoredCover

ALONE = 3.0  # spacings of the terrain; closer to other water a node may have its level

LoadDtm = Callable[[Path], Dtm]


@dataclass(frozen=True)
class PieceTask:
    """A piece to survey."""

    directory: Path  #: folder of the run
    #: the files of the piece, below it
    volume: str
    boundary: str
    shared: Path  #: folder of the check: has the index of buildings
    out: Path  #: where the survey is to be put
    load_dtm: LoadDtm  #: given the path of the store, returns the terrain


@dataclass(frozen=True, eq=False)
class Survey:
    """What a piece says of all claims, and what it has over its rim."""

    found: dict[str, Finding]  #: what it alone says, by claim
    rows: NDArray[np.int64]  #: (b,): rows of the buildings that it may have anything of
    built: city_proofs.Built  #: what it has of each of these
    #: cells, points that are not over the rim, and facets
    n_cells: int
    n_points: int
    n_facets: int
    smallest: float  #: volume of the smallest cell (m³)
    faults: tuple[Fault, ...]  #: of its cells
    crowded: Vertices  #: (c, 2, 3): boundary edges of more than two facets, paired, not over the rim
    #: as of `Piece`
    part_cells: NDArray[np.int64]
    part_air: Mask
    rim: Rim
    #: (p,): height of the terrain at each point of the rim that is ground, and level of water there, if any (m)
    terrain: NDArray[np.float64]
    level: NDArray[np.float64]
    rim_walls: wall_proofs.Walls  #: walls over the rim


def survey_piece(task: PieceTask) -> None:
    """Read a piece, hold it against the city model and the terrain, and put what it says into a file.

    Raises
    ------
    InputError
        If a file is missing or damaged.
    """
    run = open_run(task.directory, task.load_dtm, task.shared)
    record = run.record
    piece = read_piece(
        task.directory / task.volume,
        task.directory / task.boundary,
        record.bounds,
        regions=record.regions,
        density_at=run.canopy,
        upright=bool(record.zones),
    )
    with open_index(task.shared) as index:
        survey = _survey(piece, run, index)
    run.dtm.sample(np.empty((0, 2)))  # the next piece has another window of the terrain
    task.out.write_bytes(pickle.dumps(survey))


def load_survey(path: Path) -> Survey:
    """Load what `survey_piece` put into a file, which is removed."""
    survey: Survey = pickle.loads(path.read_bytes())
    path.unlink()
    return survey


@dataclass(frozen=True, eq=False)
class Run:
    """What a process has open of a run."""

    record: RunRecord
    dtm: Dtm
    cover: "StoredCover | None"
    canopy: "StoredCanopy | None"
    finer: list[Finer]

    def find_levels(self, ground: Vertices) -> NDArray[np.float64]:
        """Level of the water at vertices of the ground (n, 3) (m); NaN where there is none."""
        if self.cover is None:
            return np.full(len(ground), np.nan)
        return self.cover.levels_at(ground[:, :2], alone=ALONE * self.record.dtm_spacing)


@lru_cache(maxsize=1)
def open_run(directory: Path, load_dtm: LoadDtm, shared: Path) -> Run:
    """Open what all pieces of a run need, once in a process for a check, whose folder is `shared`."""
    record, store = read_run_record(directory / RUN_RECORD), directory / STORE
    cover = canopy = None
    if record.ground or record.leaves:  # their modules import much
        from tiler.landcover.stored_cover import StoredCanopy, StoredCover
    if record.ground:
        cover = StoredCover(store, _boxes(record), record.core, len(record.ground) - 1)
    if record.leaves:
        canopy = StoredCanopy(store, _boxes(record), record.leaf_column)
    return Run(record, load_dtm(store), cover, canopy, zone_finer(record))


def _boxes(record: RunRecord) -> dict[str, Bounds]:
    return {name: (box[0], box[1], box[2], box[3]) for name, box in record.tiles.items() if box is not None}


def _survey(piece: Piece, run: Run, index: BuildingIndex) -> Survey:
    surface, record, dtm = piece.surface, run.record, run.dtm
    within, over_rim = wall_proofs.split_walls(surface, piece.on_rim)
    rows = _find_buildings(index, piece)
    buildings = index.take(rows)
    ground, edge = take_vertices(piece, Marker.GROUND), piece.rim.points[piece.rim.points[:, 3] == GROUND]
    # All of the ground at once: what terrain is read for it serves what follows.
    terrain, level = dtm.sample(np.concatenate((ground, edge[:, :3]))[:, :2]), np.full(len(edge), np.nan)
    found: dict[str, Finding] = {
        "same": piece.same_boundary,
        "closed": piece.closed,
        "marks": city_proofs.check_marks(surface, buildings, regions=record.regions),
        "box": proofs.check_box(surface, record.bounds, piece.rim.edges),
        "top": proofs.check_top(take_vertices(piece, Marker.TOP), record.top),
        "ground": proofs.check_ground(ground, terrain[: len(ground)]),
        "roofs": city_proofs.check_roofs(surface, buildings, dtm, record.roofs),
        "walls": city_proofs.check_walls(surface, buildings, dtm, record.roofs),
        "overlap": wall_proofs.check_overlap(within),
        "sizes": proofs.check_sizes(surface, piece.outline, piece.volumes["air"]),
        **{f"between {name}": finding for name, finding in piece.between.items()},
    }
    if record.core is not None:
        level_pad = pad_proofs.check_level(ground, record.bounds, record.core, record.rim)
        found["pad"] = proofs.join_findings(level_pad, pad_proofs.check_houses(surface, record.core))
    if record.depth:
        found |= {
            "bottom": soil_proofs.check_bottom(surface, record.depth),
            "soil": soil_proofs.check_soil_sizes(surface, piece.volumes["soil"]),
        }
    if len(record.regions) > 1:
        found["foundations"] = soil_proofs.check_foundations(surface, dtm, up=record.depth > 0)
    if record.solids:
        found["houses"] = soil_proofs.check_building_cells(
            surface, piece.volumes["building"], piece.houses, buildings
        )
    if run.cover is not None:
        found["cover"] = cover_proofs.check_cover(surface, piece.patch, record.ground, run.cover)
        levels = run.find_levels(np.concatenate((ground, edge[:, :3])))
        found["levels"], level = cover_proofs.check_levels(ground, levels[: len(ground)]), levels[len(ground) :]
    if run.canopy is not None:
        found["leaves"] = piece.leaves
    if record.zones:
        found["zones"] = check_sizes_of_zones(surface, piece.outline, piece.upright, run.finer, record)
    return Survey(
        found=found,
        rows=rows,
        built=city_proofs.find_built(surface, buildings, piece.outline),
        n_cells=piece.n_cells,
        n_points=piece.n_points,
        n_facets=len(surface.boundary.facets),
        smallest=piece.smallest,
        faults=piece.faults,
        crowded=piece.crowded,
        part_cells=piece.part_cells,
        part_air=piece.part_air,
        rim=piece.rim,
        terrain=_spread(piece, terrain[len(ground) :]),
        level=_spread(piece, level),
        rim_walls=over_rim,
    )


def _spread(piece: Piece, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give values of the ground's points over the rim to all points there, NaN to the others."""
    spread = np.full(len(piece.rim.points), np.nan)
    spread[piece.rim.points[:, 3] == GROUND] = values
    return spread


def _find_buildings(index: BuildingIndex, piece: Piece) -> NDArray[np.int64]:
    """Find the buildings that a piece may have anything of: around its plan, and those that its facets name."""
    named = index.find_rows(np.unique(piece.surface.boundary.building))
    rows = [named[named >= 0]]
    if len(piece.outline):
        (west, south), (east, north) = (ends(piece.outline, axis=(0, 1)).tolist() for ends in (np.min, np.max))
        rows.append(index.find_near((west, south, east, north)))
    return np.unique(np.concatenate(rows))
