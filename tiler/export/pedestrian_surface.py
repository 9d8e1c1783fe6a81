"""The ground lifted to the height of people, as a surface on which OpenFOAM samples the wind."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.data.mesh import Marker, is_ground
from tiler.export.obj_file import write_obj
from tiler.export.surface import BoundaryPart, RunSurface, Surface, open_surface
from tiler.mesh_files.run_files import RunSource


@dataclass(frozen=True, eq=False)
class LiftedGround:
    """The ground of a boundary, lifted: see `tiler.export.surface.Surface`."""

    surface: Surface  #: the boundary
    height: float  #: how far it is lifted (m)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pieces, in their order."""
        return self.surface.names

    @property
    def n_points(self) -> int:
        """Number of different points of the whole mesh."""
        return self.surface.n_points

    @property
    def ground(self) -> tuple[str, ...]:
        """Names of the patches of the ground, by number."""
        return self.surface.ground

    def read(self, k: int) -> BoundaryPart:
        """Read the ground of piece `k`."""
        piece = self.surface.read(k)
        ground = is_ground(piece.marker)
        marker = np.full(int(ground.sum()), Marker.GROUND, np.int32)  # one group, of whatever patches
        points = piece.points + np.array([0.0, 0.0, self.height])
        return BoundaryPart(points, piece.facets[ground], marker, piece.building[ground], piece.ids)


def write_pedestrian_surface(path: Path, source: RunSource, *, height: float) -> None:
    """Write the ground of a run without houses, lifted, as Wavefront OBJ; makes the folder too.

    Parameters
    ----------
    path : Path
        The file.
    source : Path or RunFiles
        The run.
    height : float
        How far above the ground (m).

    Notes
    -----
    OBJ and not STL: OpenFOAM reads coordinates of STL files in single precision, half a metre at a northing of
    millions.
    """
    surface: RunSurface = open_surface(source)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_obj(path, LiftedGround(surface, height))
