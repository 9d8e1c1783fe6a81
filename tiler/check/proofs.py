"""The proofs of `citystitch check`: one claim about the written mesh each, with its numbers or its faults.

A claim is checked piece by piece (``check_...``); what is found is added up and told at the end (``prove_...``).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Boundary, Marker, TetMesh
from pipeline.data.regions import Region
from stitch.pieces import conformity
from stitch.pieces.frontier import Settled, find_edges_below
from tiler.store.run_folder import RunRecord

HEIGHT_TOLERANCE = 1e-6  # m, of a height against the DTM or the city model
SIDE_TOLERANCE = 1e-6  # m, of a vertex against its side of the box, and of a wall against the vertical
RELATIVE_TOLERANCE = 1e-9  # of areas and volumes that must be equal
CELLS_AT_ONCE = 1 << 18  # that are looked at together
N_PLACES = 3  # places that a fault names
EXTRA = "a facet of the boundary file is no exterior face of the cells"
SAME_SIDE = "2 cells on one side of a face"
SHARED = "a face of more than 2 cells"
N_CORNERS = 20  # corners that the check lists in which houses only touch

Vertices = NDArray[np.float64]
Mask = NDArray[np.bool_]
Bounds = tuple[float, float, float, float]


class Dtm(Protocol):
    """A terrain that can be sampled."""

    def sample(self, xy: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Return the ground height (m) at points (n, 2); NaN where there is none."""


@dataclass(frozen=True)
class Fault:
    """One way in which a claim does not hold."""

    kind: str  #: which rule, in kebab case
    count: int  #: how often
    #: each (x, y, z): the first few places (m); empty where the fault has none
    places: tuple[tuple[float, float, float], ...]
    detail: str  #: the observed value against its bound


@dataclass(frozen=True)
class Proof:
    """A claim, and the faults that were found in it: none when it is proved."""

    claim: str
    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class Finding:
    """What pieces say of a claim."""

    faults: tuple[Fault, ...] = ()  #: those of one kind are one
    #: numbers by name: those that add up over pieces, and those of which the largest counts
    sums: Mapping[str, float] = field(default_factory=dict)
    largest: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Surface:
    """The boundary of one piece."""

    points: Vertices  #: (n, 3): distinct vertices (m) of the exterior faces and of the boundary file
    boundary: Boundary  #: all facets
    corners: Vertices  #: (k, 3, 3): the vertices of each facet
    #: (k, 3): by how much the file says that the roof at each of these was moved for the sake of cells (m)
    moved: NDArray[np.float64]
    #: (k,): signed plan area (m²) and volume above height zero (m³), see `compute_facet_areas`
    area: NDArray[np.float64]
    volume: NDArray[np.float64]

    def marked(self, *markers: Marker) -> Mask:
        """Tell which facets have one of the markers."""
        return np.isin(self.boundary.marker, markers)


def make_surface(points: Vertices, boundary: Boundary, moved: NDArray[np.float64]) -> Surface:
    """Work out the geometry of the facets once, for all proofs."""
    area, volume = conformity.compute_facet_areas(points, boundary.facets)
    return Surface(points, boundary, points[boundary.facets], moved, area, volume)


def find_faults(kind: str, places: Vertices, detail: str) -> list[Fault]:
    """Make one fault of all the places (n, 3), or none if there is no place."""
    first = tuple((float(x), float(y), float(z)) for x, y, z in places[:N_PLACES])
    return [Fault(kind, len(places), first, detail)] if len(places) else []


def merge_faults(faults: Iterable[Fault]) -> tuple[Fault, ...]:
    """Join faults of one kind: counts add up, the first places and the first detail stay."""
    merged: dict[str, Fault] = {}
    for fault in faults:
        old = merged.get(fault.kind, Fault(fault.kind, 0, (), fault.detail))
        places = (old.places + fault.places)[:N_PLACES]
        merged[fault.kind] = Fault(fault.kind, old.count + fault.count, places, old.detail)
    return tuple(merged.values())


def join_findings(one: Finding, two: Finding) -> Finding:
    """Join what was found in some pieces and in others."""
    names = one.sums.keys() | two.sums.keys()
    largest = {
        name: max(one.largest.get(name, -np.inf), two.largest.get(name, -np.inf))
        for name in one.largest.keys() | two.largest.keys()
    }
    sums = {name: one.sums.get(name, 0) + two.sums.get(name, 0) for name in names}
    return Finding(merge_faults((*one.faults, *two.faults)), sums, largest)


def at_most(bound: float) -> str:
    """Tell a bound on a length (m)."""
    return f"bound: {bound:g} m"


def measure_plan_widths(corners: Vertices, area: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the height of each facet's plan over its longest edge: 0 when the facet is vertical."""
    edges = np.roll(corners, -1, axis=1)[:, :, :2] - corners[:, :, :2]
    longest = np.hypot(edges[:, :, 0], edges[:, :, 1]).max(axis=1, initial=0)
    width: NDArray[np.float64] = np.divide(2 * np.abs(area), longest, out=np.zeros(len(area)), where=longest > 0)
    return width


def check_cells(mesh: TetMesh, region: NDArray[np.int8]) -> Finding:
    """Cells are not inverted or flat, and the vertices of a piece are used, each there once.

    Parameters
    ----------
    region : int8, (m,)
        `pipeline.data.mesh.Region` of each.

    Returns
    -------
    Finding
        Volumes of each region, ``air`` and so on, add up (m³); ``-smallest`` is that of the smallest cell with a
        minus sign.
    """
    found = Finding(sums={kind.name.lower(): 0.0 for kind in Region}, largest={"-smallest": -np.inf})
    for start in range(0, len(mesh.cells), CELLS_AT_ONCE):
        rows = slice(start, start + CELLS_AT_ONCE)
        found = join_findings(found, _measure_cells(mesh.points, mesh.cells[rows], region[rows]))
    unused = conformity.find_unused_points(mesh.cells, len(mesh.points))
    duplicate = conformity.find_duplicate_points(mesh.points)
    faults = [
        *find_faults("vertex-unused", mesh.points[unused], "no cell uses it"),
        *find_faults("vertex-duplicate", mesh.points[duplicate], "all coordinates equal another vertex's"),
    ]
    return join_findings(found, Finding(tuple(faults)))


def _measure_cells(points: Vertices, cells: NDArray[np.int32], region: NDArray[np.int8]) -> Finding:
    volumes, flat = conformity.compute_cell_volumes(points, cells)
    wrong = flat | (volumes < 0)
    centres, inverted = points[cells[wrong]].mean(axis=1), volumes[wrong] < 0
    least = float(volumes.min())
    bound = f"smallest volume {least:.3g} m³; bound: more than {conformity.FLAT:g} of its longest edge cubed"
    faults = [
        *find_faults("cell-inverted", centres[inverted], bound),
        *find_faults("cell-flat", centres[~inverted], bound),
    ]
    sums = {kind.name.lower(): float(volumes[region == kind].sum()) for kind in Region}
    return Finding(tuple(faults), sums, {"-smallest": -least})


def find_face_faults(points: Vertices, pairs: conformity.FacePairs) -> list[Fault]:
    """Find faces of more than two cells, or of two cells on the same side."""
    return [
        *find_faults("face-shared", centres_of(points, pairs.shared), SHARED),
        *find_faults("face-same-side", centres_of(points, pairs.same_side), SAME_SIDE),
    ]


def check_same_boundary(
    points: Vertices,
    facets: NDArray[np.int32],
    exterior: NDArray[np.int32],
    match: conformity.Matched,
    on_rim: Mask,
) -> Finding:
    """The facets of the boundary files are the exterior faces of the cells, each once, outwards.

    Parameters
    ----------
    points : float64, (n, 3)
        Points of a piece's surface (m).
    facets : int32, (f, 3)
        What its boundary file has: all facets but those with cells on both sides.
    exterior : int32, (k, 3)
        Exterior faces of its cells.
    match : Matched
        These against the facets.
    on_rim : bool, (k,)
        Which of them another piece may have too: what the file lacks of these is no fault yet.
    """
    missing = match.missing[~on_rim[match.missing]]
    lists = [
        ("facet-missing", exterior[missing], "an exterior face of the cells is not in the boundary file"),
        ("facet-extra", facets[match.extra], EXTRA),
        ("facet-flipped", facets[match.flipped], "a facet points into its cell"),
        ("facet-duplicate", facets[match.duplicate], "a facet is there twice"),
    ]
    faults = [fault for kind, rows, why in lists for fault in find_faults(kind, centres_of(points, rows), why)]
    n_exterior = len(exterior) - len(match.missing) + len(missing)
    return Finding(merge_faults(faults), {"facets": len(facets), "exterior": n_exterior})


def prove_same_boundary(found: Finding) -> Proof:
    """Tell whether boundary files and cells agree."""
    facets, exterior = int(found.sums["facets"]), int(found.sums["exterior"])
    claim = f"the {facets} boundary facets are the {exterior} exterior faces, outwards, bitwise"
    return Proof(claim, found.faults)


def check_closed(open_edges: Vertices, crowded: Vertices) -> Finding:
    """The boundary is closed and oriented.

    Parameters
    ----------
    open_edges, crowded : float64, (k, 2, 3)
        Edges without a facet in the other direction, and paired ones of more than two facets.
    """
    faults = find_faults(
        "boundary-open", open_edges.mean(axis=1), "an edge without a facet in the other direction"
    )
    return Finding(tuple(faults), {"crowded": len(crowded)})


def prove_closed(found: Finding, corners: Vertices) -> Proof:
    """Tell whether the boundary is closed, and where in the plan (n, 2) edges have more than two facets."""
    count = int(found.sums["crowded"])
    claim = f"the boundary is closed and oriented; {count} edges have more than 2 facets, all of them paired"
    if count:
        listed = ", ".join(f"({x:.2f}, {y:.2f})" for x, y in corners[:N_CORNERS])
        more = f" and {len(corners) - N_CORNERS} more" if len(corners) > N_CORNERS else ""
        claim += f", where houses or their roofs touch in a corner only: {listed}{more}"
    return Proof(claim, found.faults)


def check_seams(settled: Settled) -> Finding:
    """Seam faces are there from both sides, bit for bit.

    Parameters
    ----------
    settled : Settled
        Faces over the rims of pieces, as far as they are settled.
    """
    lists = [
        ("seam-open", settled.open, "a face over a seam that no other piece has"),
        ("facet-extra", settled.extra, EXTRA),
        ("face-same-side", settled.same_side, SAME_SIDE),
        ("face-shared", settled.shared, SHARED),
        ("seam-mixed", settled.mixed, "cells of two regions, and no wall is marked between them; or one is"),
    ]
    faults = [fault for kind, faces, why in lists for fault in find_faults(kind, faces.mean(axis=1), why)]
    return Finding(merge_faults(faults), {"faces": settled.n_matched, "walls": settled.n_walls})


def prove_seams(found: Finding, n_seams: int, n_pieces: int) -> Proof:
    """Tell whether the pieces fit together."""
    count = int(found.sums["faces"])
    claim = f"{count} faces on {n_seams} seams of {n_pieces} pieces are bitwise equal from both sides"
    if walls := int(found.sums["walls"]):
        claim += f", {walls} of them walls with air on one and a building on the other"
    return Proof(claim, found.faults)


def check_box(surface: Surface, bounds: Bounds, outline: Vertices) -> Finding:
    """Side facets lie on their side of the box, and nothing else does; ground and roofs face down, top up.

    Parameters
    ----------
    bounds : (west, south, east, north)
        The box (m).
    outline : float64, (k, 2, 2)
        Edges of the piece's plan within the box: facets to a missing piece stand over these.
    """
    west, south, east, north = bounds
    planes = {
        Marker.WEST: (0, west),
        Marker.EAST: (0, east),
        Marker.SOUTH: (1, south),
        Marker.NORTH: (1, north),
    }
    centres, offset = surface.corners.mean(axis=1), np.zeros(len(surface.corners))
    on_side = np.zeros(len(surface.corners), np.bool_)
    for marker, (axis, value) in planes.items():
        distance = np.abs(surface.corners[:, :, axis] - value).max(axis=1)
        offset = np.where(surface.marked(marker), distance, offset)
        on_side |= ~surface.marked(marker) & (distance <= SIDE_TOLERANCE)
    off = offset > SIDE_TOLERANCE
    low, high = np.array([west, south]) - SIDE_TOLERANCE, np.array([east, north]) + SIDE_TOLERANCE
    outside = np.any((surface.points[:, :2] < low) | (surface.points[:, :2] > high), axis=1)
    downward = surface.marked(Marker.GROUND, Marker.ROOF) & ~(surface.area < 0)
    upward = surface.marked(Marker.TOP) & ~(surface.area > 0)
    missing = surface.marked(Marker.MISSING)
    astray = missing.copy()
    astray[missing] = find_edges_below(surface.corners[missing], outline) < 0
    faults = [
        *find_faults(
            "side-off-box",
            centres[off],
            f"{offset.max(initial=0):.3g} m off its side; {at_most(SIDE_TOLERANCE)}",
        ),
        *find_faults(
            "facet-on-side", centres[on_side], "a facet on a side of the box that is not marked as that side"
        ),
        *find_faults("vertex-outside-box", surface.points[outside], f"outside {bounds}"),
        *find_faults("facet-direction", centres[downward], "a ground or roof facet that does not face down"),
        *find_faults("facet-direction", centres[upward], "a top facet that does not face up"),
        *find_faults("missing-astray", centres[astray], "marked missing, but not upright on its piece's outline"),
    ]
    return Finding(merge_faults(faults), {"missing": int(missing.sum())})


def prove_box(found: Finding, bounds: Bounds) -> Proof:
    """Tell whether nothing but ground, roofs and walls is within the box, and seams of missing pieces."""
    west, south, east, north = bounds
    claim = f"sides lie on the box {west:.3f} {south:.3f} {east:.3f} {north:.3f}; {at_most(SIDE_TOLERANCE)}"
    if found.sums["missing"]:
        claim += f"; {int(found.sums['missing'])} facets bound pieces that are missing"
    return Proof(claim, found.faults)


def check_top(vertices: Vertices, height: float) -> Finding:
    """The top's vertices (n, 3) lie at the height that the run states (m); NaN states none."""
    low, high = vertices[:, 2].min(initial=np.inf), vertices[:, 2].max(initial=-np.inf)
    off = np.abs(vertices[:, 2] - height) > HEIGHT_TOLERANCE
    detail = f"top between {low:.6f} and {high:.6f} m, stated {height:.6f} m; {at_most(HEIGHT_TOLERANCE)}"
    faults = find_faults("top-height", vertices[off], detail)
    return Finding(tuple(faults), {}, {"high": float(high), "-low": float(-low)})


def prove_top(found: Finding, height: float) -> Proof:
    """Tell between which heights the top lies."""
    low, high = -found.largest["-low"], found.largest["high"]
    stated = "run.json states none" if np.isnan(height) else f"stated {height:.6f} m"
    return Proof(f"the top lies between {low:.6f} and {high:.6f} m ({stated})", found.faults)


def check_ground(vertices: Vertices, terrain: NDArray[np.float64]) -> Finding:
    """Ground vertices (n, 3) lie on the DTM, which has the heights `terrain` (n,) there (m)."""
    error = np.abs(vertices[:, 2] - terrain)
    off = ~(error <= HEIGHT_TOLERANCE)
    worst = float(error.max(initial=0))
    detail = f"{worst:.3g} m off; {at_most(HEIGHT_TOLERANCE)}"
    faults = find_faults("ground-off-dtm", vertices[off], detail)
    return Finding(tuple(faults), {"vertices": len(vertices)}, {"worst": worst})


def prove_ground(found: Finding) -> Proof:
    """Tell how far the ground is off the DTM at most."""
    count, worst = int(found.sums["vertices"]), found.largest["worst"]
    claim = f"{count} ground vertices lie on the DTM, worst {worst:.2g} m; {at_most(HEIGHT_TOLERANCE)}"
    return Proof(claim, found.faults)


def check_sizes(surface: Surface, outline: Vertices, cell_volume: float) -> Finding:
    """Measure plan areas and volumes.

    Parameters
    ----------
    outline : float64, (k, 2, 2)
        All edges of its plan, with the piece on the left.
    cell_volume : float
        Volume of its cells (m³).
    """
    middle = outline.mean(axis=(0, 1)) if len(outline) else np.zeros(2)
    start, end = (outline - middle).transpose(1, 2, 0).reshape(2, 2, -1)
    parts = surface.marked(Marker.GROUND, Marker.ROOF, Marker.TOP)
    sums = {
        "below": -surface.area[surface.marked(Marker.GROUND, Marker.ROOF)].sum(),
        "top": surface.area[surface.marked(Marker.TOP)].sum(),
        "plan": (start[0] * end[1] - start[1] * end[0]).sum() / 2,
        "air": surface.volume[parts].sum(),
        "cells": cell_volume,
    }
    return Finding(sums={name: float(value) for name, value in sums.items()})


def prove_plan(found: Finding, bounds: Bounds, *, partial: bool) -> Proof:
    """Ground and roofs cover the box once, and so does the top; or the plan of the pieces, if some are missing."""
    west, south, east, north = bounds
    below, top = found.sums["below"], found.sums["top"]
    whole = found.sums["plan"] if partial else (east - west) * (north - south)
    name = "the pieces' plan" if partial else "box"
    claim = f"plan areas: ground and roofs {below:.6f}, top {top:.6f}, {name} {whole:.6f} m²"
    return Proof(claim, unless_equal("plan-area", claim, whole, below, top))


def prove_volume(found: Finding) -> Proof:
    """The cells fill the box without the ground and the buildings."""
    air, cells = found.sums["air"], found.sums["cells"]
    claim = f"volumes: cells {cells:.6f}, box minus ground minus buildings {air:.6f} m³"
    return Proof(claim, unless_equal("volume", claim, air, cells))


def prove_record(record: RunRecord, counts: Mapping[str, int], *, partial: bool) -> Proof:
    """``run.json`` says that the run is done, or partly if pieces are missing, and has the counts found."""
    wrong = [f"{name} {record.counts[name]}, found {n}" for name, n in counts.items() if record.counts[name] != n]
    faults = [Fault("counts", len(wrong), (), "run.json: " + "; ".join(wrong))] if wrong else []
    expected = "partial" if partial else "done"
    if record.status not in ("done", expected):
        faults.append(Fault("not-done", 1, (), f"run.json: status {record.status!r}, expected {expected!r}"))
    found = ", ".join(f"{n} {name}" for name, n in counts.items())
    return Proof(f"run.json has what the files have: {found}", tuple(faults))


def centres_of(points: Vertices, rows: NDArray[np.int32]) -> Vertices:
    """Return the middle of each face."""
    centres: Vertices = points[rows].mean(axis=1)
    return centres


def unless_equal(kind: str, detail: str, first: float, *others: float) -> tuple[Fault, ...]:
    """Make a fault if one of the others is not the first, but for rounding."""
    equal = all(abs(other - first) <= RELATIVE_TOLERANCE * abs(first) for other in others)
    bound = f"{detail}; bound: {RELATIVE_TOLERANCE:g} relative"
    return () if equal else (Fault(kind, 1, (), bound),)
