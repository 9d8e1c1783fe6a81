"""The proof of `citystitch check` that triangles have the sizes that zones of detail ask for.

Facets of the top are the triangles of the plane mesh. Each has an area of about h**2 / 2 at most, with the target
edge length h in its middle. Houses and seams make smaller ones; on open ground none is much smaller.
"""

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from pipeline.plane_mesh.sizes import Finer, finer_sizes
from tiler.check.proofs import Finding, Proof, Surface, Vertices, find_faults
from tiler.config.step_options import make_finer
from tiler.store.run_folder import RunRecord

# Areas over h**2 / 2. Of the facets of real and synthetic cities the largest has 1.5, the smallest on open ground
# 0.25.
MOST, LEAST = 2.0, 0.15
CLEAR = 2.0  # sizes; open ground is that far from vertices of houses and from the border of a piece


def zone_finer(record: RunRecord) -> list[Finer]:
    """Give the zones that are finer than the rest, those of one size together."""
    return make_finer([(size, place) for _, size, place in record.zones if place], record.sizes.growth)


def check_sizes_of_zones(
    surface: Surface, outline: Vertices, finer: Sequence[Finer], record: RunRecord
) -> Finding:
    """Measure the facets of a piece's top; `outline` (k, 2, 2) are the edges of its plan."""
    top, asked = surface.marked(Marker.TOP), record.sizes
    middle = surface.corners[top].mean(axis=1)
    size = finer_sizes(finer, middle[:, :2], asked.largest)
    if record.core is not None:  # in the pad they grow beyond that
        west, south, east, north = record.core
        beyond = ~shapely.intersects_xy(shapely.box(west, south, east, north), middle[:, 0], middle[:, 1])
        size[beyond & (size >= asked.largest)] = np.inf
    share = np.abs(surface.area[top]) / (size**2 / 2)
    rows = np.flatnonzero(size <= asked.mesh_size) if asked.alone else np.empty(0, np.int64)
    open_rows = rows[_are_clear(surface, outline, middle[rows, :2], CLEAR * size[rows])]
    low, high = float(share[open_rows].min(initial=1.0)), float(share.max(initial=0.0))
    small = open_rows[share[open_rows] < LEAST]
    faults = [
        *find_faults("zone-too-coarse", middle[share > MOST], f"{high:.3g} of h^2 / 2; bound: {MOST:g}"),
        *find_faults("zone-too-fine", middle[small], f"{low:.3g} of h^2 / 2; bound: {LEAST:g}"),
    ]
    return Finding(tuple(faults), {"facets": len(share), "open": len(open_rows)}, {"share": high, "-least": -low})


def _are_clear(
    surface: Surface, outline: Vertices, xy: NDArray[np.float64], reach: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Tell which places (n, 2) are farther from vertices of houses and from the piece's border than that (m)."""
    houses = surface.corners[surface.marked(Marker.WALL, Marker.ROOF)].reshape(-1, 3)
    tree = shapely.STRtree([*shapely.linestrings(outline), *shapely.points(np.unique(houses[:, :2], axis=0))])
    (near, _), distance = tree.query_nearest(
        shapely.points(xy), max_distance=reach.max(initial=1.0), return_distance=True, all_matches=False
    )
    clear = np.ones(len(xy), np.bool_)
    clear[near] = distance > reach[near]
    return clear


def prove_sizes_of_zones(found: Finding) -> Proof:
    """Tell how large triangles are, over what their zone asks for."""
    claim = (
        f"{int(found.sums['facets'])} facets of the top have the sizes h of zones and of the growth between them: "
        f"{found.largest['share']:.2f} of h^2 / 2 at most, and {-found.largest['-least']:.2f} at least for "
        f"{int(found.sums['open'])} on open ground"
    )
    return Proof(claim, found.faults)
