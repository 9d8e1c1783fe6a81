"""The proofs of `citystitch check`: one claim about the written mesh each, with its numbers or its faults."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.mesh import Boundary, Marker, TetMesh
from stitch import conformity
from tiler.run_folder import RunRecord

HEIGHT_TOLERANCE = 1e-6  # m, of a height against the DTM or the city model
SIDE_TOLERANCE = 1e-6  # m, of a vertex against its side of the box, and of a wall against the vertical
RELATIVE_TOLERANCE = 1e-9  # of areas and volumes that must be equal
N_PLACES = 3  # places that a fault names
N_CORNERS = 20  # corners that the check lists in which houses only touch

Vertices = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Dtm(Protocol):
    """A terrain that can be sampled."""

    def sample(self, xy: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Return the ground height (m) at points (n, 2); NaN where there is none."""


@dataclass(frozen=True)
class Fault:
    """One way in which a claim does not hold.

    Attributes
    ----------
    kind : str
        Which rule, in kebab case.
    count : int
        How often.
    places : tuple of (x, y, z)
        The first few places (m); empty where the fault has none.
    detail : str
        The observed value against its bound.
    """

    kind: str
    count: int
    places: tuple[tuple[float, float, float], ...]
    detail: str


@dataclass(frozen=True)
class Proof:
    """A claim, and the faults that were found in it: none when it is proved."""

    claim: str
    faults: tuple[Fault, ...]


@dataclass(frozen=True, eq=False)
class Surface:
    """The boundary of the whole region, merged from its pieces.

    Attributes
    ----------
    points : float64, (n, 3)
        Distinct vertices (m).
    boundary : Boundary
        All facets.
    corners : float64, (k, 3, 3)
        The vertices of each facet.
    area, volume : float64, (k,)
        Signed plan area (m²) and volume above height zero (m³), see `compute_facet_areas`.
    """

    points: Vertices
    boundary: Boundary
    corners: Vertices
    area: NDArray[np.float64]
    volume: NDArray[np.float64]

    def marked(self, *markers: Marker) -> Mask:
        """Tell which facets have one of the markers."""
        return np.isin(self.boundary.marker, markers)


def make_surface(points: Vertices, boundary: Boundary) -> Surface:
    """Work out the geometry of the facets once, for all proofs."""
    area, volume = conformity.compute_facet_areas(points, boundary.facets)
    return Surface(points, boundary, points[boundary.facets], area, volume)


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


def at_most(bound: float) -> str:
    """Tell a bound on a length (m)."""
    return f"bound: {bound:g} m"


def find_cell_faults(mesh: TetMesh, volumes: NDArray[np.float64], flat: Mask) -> list[Fault]:
    """Find inverted and flat cells, unused and duplicate vertices of one piece."""
    centres = mesh.points[mesh.cells[flat | (volumes < 0)]].mean(axis=1)
    inverted = (volumes < 0)[flat | (volumes < 0)]
    unused = conformity.find_unused_points(mesh.cells, len(mesh.points))
    duplicate = conformity.find_duplicate_points(mesh.points)
    least = volumes.min(initial=np.inf)
    bound = f"smallest volume {least:.3g} m³; bound: more than {conformity.FLAT:g} of its longest edge cubed"
    return [
        *find_faults("cell-inverted", centres[inverted], bound),
        *find_faults("cell-flat", centres[~inverted], bound),
        *find_faults("vertex-unused", mesh.points[unused], "no cell uses it"),
        *find_faults("vertex-duplicate", mesh.points[duplicate], "all coordinates equal another vertex's"),
    ]


def find_face_faults(points: Vertices, pairs: conformity.FacePairs) -> list[Fault]:
    """Find faces of more than two cells, or of two cells on the same side."""
    return [
        *find_faults("face-shared", _centres(points, pairs.shared), "a face of more than 2 cells"),
        *find_faults("face-same-side", _centres(points, pairs.same_side), "2 cells on one side of a face"),
    ]


def prove_same_boundary(surface: Surface, exterior: NDArray[np.int32]) -> Proof:
    """The facets of the boundary files are the exterior faces of the cells, each once, outwards.

    Parameters
    ----------
    surface : Surface
        The boundary files.
    exterior : int32, (k, 3)
        Exterior faces of the cells, as indices of the surface's points.
    """
    facets = surface.boundary.facets
    match = conformity.match_facets(exterior, facets)
    lists = [
        (
            "facet-missing",
            exterior[match.missing],
            "an exterior face of the cells is not in the boundary file",
        ),
        ("facet-extra", facets[match.extra], "a facet of the boundary file is no exterior face of the cells"),
        ("facet-flipped", facets[match.flipped], "a facet points into its cell"),
        ("facet-duplicate", facets[match.duplicate], "a facet is there twice"),
    ]
    faults = [
        fault for kind, rows, why in lists for fault in find_faults(kind, _centres(surface.points, rows), why)
    ]
    return Proof(
        f"the {len(facets)} boundary facets are the {len(exterior)} exterior faces, outwards, bitwise",
        tuple(faults),
    )


def prove_closed(surface: Surface) -> tuple[Proof, int]:
    """The boundary is closed and oriented; also return how many edges have more than two facets."""
    edges = conformity.pair_edges(surface.boundary.facets)
    middles = surface.points[edges.open].mean(axis=1)
    faults = find_faults("boundary-open", middles, "an edge without a facet in the other direction")
    count = len(edges.non_manifold)
    corners = np.unique(surface.points[edges.non_manifold].mean(axis=1)[:, :2], axis=0)
    claim = f"the boundary is closed and oriented; {count} edges have more than 2 facets, all of them paired"
    if count:
        listed = ", ".join(f"({x:.2f}, {y:.2f})" for x, y in corners[:N_CORNERS])
        more = f" and {len(corners) - N_CORNERS} more" if len(corners) > N_CORNERS else ""
        claim += f", where houses or their roofs touch in a corner only: {listed}{more}"
    return Proof(claim, tuple(faults)), count


def prove_box(surface: Surface, bounds: tuple[float, float, float, float]) -> Proof:
    """Side facets lie on their side of the box, and nothing else does; ground and roofs face down, top up."""
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
    ]
    claim = f"sides lie on the box {west:.3f} {south:.3f} {east:.3f} {north:.3f}; {at_most(SIDE_TOLERANCE)}"
    return Proof(claim, merge_faults(faults))


def prove_top(surface: Surface, height: float) -> Proof:
    """The top lies at the height that the run states; NaN states none."""
    vertices = surface.points[np.unique(surface.boundary.facets[surface.marked(Marker.TOP)])]
    low, high = vertices[:, 2].min(initial=np.inf), vertices[:, 2].max(initial=-np.inf)
    off = np.abs(vertices[:, 2] - height) > HEIGHT_TOLERANCE
    stated = "run.json states none" if np.isnan(height) else f"stated {height:.6f} m"
    detail = f"top between {low:.6f} and {high:.6f} m, {stated}; {at_most(HEIGHT_TOLERANCE)}"
    return Proof(
        f"the top lies between {low:.6f} and {high:.6f} m ({stated})",
        tuple(find_faults("top-height", vertices[off], detail)),
    )


def prove_ground(surface: Surface, dtm: Dtm) -> Proof:
    """Ground vertices lie on the DTM."""
    vertices = surface.points[np.unique(surface.boundary.facets[surface.marked(Marker.GROUND)])]
    error = np.abs(vertices[:, 2] - dtm.sample(vertices[:, :2]))
    off = ~(error <= HEIGHT_TOLERANCE)
    worst = error.max(initial=0)
    return Proof(
        f"{len(vertices)} ground vertices lie on the DTM, worst {worst:.2g} m; {at_most(HEIGHT_TOLERANCE)}",
        tuple(find_faults("ground-off-dtm", vertices[off], f"{worst:.3g} m off; {at_most(HEIGHT_TOLERANCE)}")),
    )


def prove_plan(surface: Surface, bounds: tuple[float, float, float, float]) -> Proof:
    """Ground and roofs cover the box once, and so does the top."""
    west, south, east, north = bounds
    box = (east - west) * (north - south)
    below = -surface.area[surface.marked(Marker.GROUND, Marker.ROOF)].sum()
    top = surface.area[surface.marked(Marker.TOP)].sum()
    claim = f"plan areas: ground and roofs {below:.6f}, top {top:.6f}, box {box:.6f} m²"
    return Proof(claim, _unless_equal("plan-area", claim, box, below, top))


def prove_volume(surface: Surface, cell_volume: float) -> Proof:
    """The cells fill the box without the ground and the buildings."""
    air = surface.volume[surface.marked(Marker.GROUND, Marker.ROOF, Marker.TOP)].sum()
    claim = f"volumes: cells {cell_volume:.6f}, box minus ground minus buildings {air:.6f} m³"
    return Proof(claim, _unless_equal("volume", claim, float(air), cell_volume))


def prove_record(record: RunRecord, counts: dict[str, int]) -> Proof:
    """``run.json`` says that the run is done, and has the counts that were found."""
    wrong = [f"{name} {record.counts[name]}, found {n}" for name, n in counts.items() if record.counts[name] != n]
    faults = [Fault("counts", len(wrong), (), "run.json: " + "; ".join(wrong))] if wrong else []
    if record.status != "done":
        faults.append(Fault("not-done", 1, (), f"run.json: status {record.status!r}, expected 'done'"))
    found = ", ".join(f"{n} {name}" for name, n in counts.items())
    return Proof(f"run.json has what the files have: {found}", tuple(faults))


def _centres(points: Vertices, rows: NDArray[np.int32]) -> Vertices:
    centres: Vertices = points[rows].mean(axis=1)
    return centres


def _unless_equal(kind: str, detail: str, first: float, *others: float) -> tuple[Fault, ...]:
    equal = all(abs(other - first) <= RELATIVE_TOLERANCE * abs(first) for other in others)
    bound = f"{detail}; bound: {RELATIVE_TOLERANCE:g} relative"
    return () if equal else (Fault(kind, 1, (), bound),)
