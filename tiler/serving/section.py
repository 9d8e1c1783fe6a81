"""``GET /section``: the volume mesh of the city, cut upright between two places, for the page."""

import asyncio
from pathlib import Path

import numpy as np
import shapely

from pipeline.data.errors import CityError, InputError
from pipeline.data.mesh import TetMesh
from pipeline.quality.quality import measure_cells
from stitch.tiling.grid import BAND_SHARE
from tiler.mesh_files.run_files import RUN_RECORD, RunFiles, find_files
from tiler.mesh_files.vtk_files import read_vtu
from tiler.serving.handlers import Api
from tiler.store.run_folder import read_run_record
from tiler.tiles3d.globe import Array, Globe, geocentric, geographic_of
from tiler.tiles3d.slices import ROW, cut_along

MOST_TRIANGLES = 500_000


class Section(Api):
    """``GET /section?from=X,Y,Z&to=X,Y,Z``: places are geocentric (EPSG:4978, m).

    The answer is binary, little-endian: 3 float64, a place; then for each triangle of the section 10 float32: its
    corners from that place (m), and the radius ratio of its cell.
    """

    directory: Path
    globe: Globe

    async def get(self) -> None:
        """Cut the mesh as it is now."""
        try:
            ends = np.array([self._place("from"), self._place("to")])
            work = asyncio.get_running_loop().run_in_executor(None, cut_section, self.directory, self.globe, ends)
            self.set_header("Content-Type", "application/octet-stream")
            self.finish(await work)
        except CityError as error:
            self.refuse(error)

    def _place(self, name: str) -> list[float]:
        text = self.get_query_argument(name, "")
        try:
            x, y, z = map(float, text.split(","))
        except ValueError:
            raise InputError(f"{name}={text}: three numbers X,Y,Z expected, geocentric, in metres") from None
        return [x, y, z]


def cut_section(directory: Path, globe: Globe, ends: Array) -> bytes:
    """Cut the mesh of a finished run; see `Section`.

    Parameters
    ----------
    directory : Path
        Folder of the run.
    globe : Globe
        Where it lies.
    ends : float64, (2, 3)
        Geocentric places.

    Raises
    ------
    InputError
        If the two are one place, or the section meets no cell, or too many.
    """
    files = find_files(directory)
    lon, lat, _ = geographic_of(ends).T
    places = globe.plan(lon, lat)
    if not np.isfinite(places).all() or not np.hypot(*(places[1] - places[0])) > 0:
        raise InputError("section: from and to are one place, or none of the region; give two")
    rows = _cut_pieces(files, places)
    n = len(rows)
    if not n:
        raise InputError("section: 0 cells between from and to; give places nearer the city")
    xyz = geocentric(globe.geographic(rows[:, : ROW - 1].reshape(-1, 3)))
    local = np.column_stack(((xyz - xyz[0]).reshape(n, -1), rows[:, -1]))
    return b"".join((xyz[0].astype("<f8").tobytes(), local.astype("<f4").tobytes()))


def _cut_pieces(files: RunFiles, places: Array) -> Array:
    """Give rows (k, `ROW`) of triangles of the pieces that the line meets; InputError if they are too many."""
    x, y, u, v = places.ravel().tolist()
    line, found = shapely.LineString(places), [np.empty((0, ROW))]
    boxes = {name: box for name, box in read_run_record(files.directory / RUN_RECORD).tiles.items() if box}
    beyond = BAND_SHARE * max((xmax - xmin for xmin, _, xmax, _ in boxes.values()), default=0.0)
    for path in files.volumes:
        box = boxes.get(path.stem)
        if box is not None and line.distance(shapely.box(*box)) > beyond:  # pieces reach as far as seams go
            continue
        mesh = read_vtu(path).mesh
        corners, cell = cut_along((x, y, u, v), mesh.points, mesh.cells)
        cut, row = np.unique(cell, return_inverse=True)
        quality = measure_cells(TetMesh(mesh.points, mesh.cells[cut])).radius_ratio
        found.append(np.column_stack((corners.reshape(-1, ROW - 1), quality[row])))
        if (n := sum(map(len, found))) > MOST_TRIANGLES:
            raise InputError(f"section: {n:,} triangles or more; bound: {MOST_TRIANGLES:,}; give nearer places")
    return np.concatenate(found)
