"""Pictures without OpenGL: facets shaded and painted from back to front, for machines that have no graphics."""

import subprocess
import sys
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

SUN = np.array([0.42, -0.64, 0.64])  # from the south-east
AMBIENT = 0.55
SAMPLES = 2  # pixels painted along each pixel shown
LINE = (60, 53, 48)
LINE_STRENGTH = 0.25
LINE_FACETS = 60_000  # facets up to which edges are drawn
PROBE = """
from vtkmodules.vtkRenderingCore import vtkRenderWindow
import vtkmodules.vtkRenderingOpenGL2
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.Render()
"""


@cache
def has_graphics() -> bool:
    """Return whether VTK can draw here; asked in a process of its own, which VTK brings down where it cannot."""
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=120, check=False)
    return done.returncode == 0


class PlainPlotter:
    """Collects meshes as a pyvista plotter does, and paints them without OpenGL."""

    def __init__(self) -> None:
        self._corners: list[NDArray[np.float64]] = []
        self._colours: list[NDArray[np.float64]] = []

    def add_mesh(self, mesh: Any, *, color: str | None = None, scalars: str | None = None, **_: Any) -> None:
        """Add the faces of a surface, of one colour or with colours by cell or point; lines are left out."""
        if mesh.n_lines:
            return
        surface = mesh.triangulate()
        faces = np.asarray(surface.faces).reshape(-1, 4)[:, 1:]
        if color is not None:
            rgb = np.tile(list(bytes.fromhex(color[1:])), (len(faces), 1)).astype(np.float64)
        elif scalars in surface.cell_data:
            rgb = np.asarray(surface.cell_data[scalars], dtype=np.float64)
        else:
            rgb = np.asarray(surface.point_data[scalars], dtype=np.float64)[faces].mean(axis=1)
        self._corners.append(np.asarray(surface.points, dtype=np.float64)[faces])
        self._colours.append(rgb)

    def paint(
        self,
        position: NDArray[np.float64],
        focal: NDArray[np.float64],
        *,
        view_angle: float,
        size: tuple[int, int],
        sky: tuple[str, str],
    ) -> NDArray[np.uint8]:
        """Paint what was added, seen from `position` towards `focal`.

        Parameters
        ----------
        position, focal : float64, (3,)
            Camera and the place in the middle of the picture (m).
        view_angle : float
            Vertical opening angle (degrees).
        size : (int, int)
            Width and height (pixels).
        sky : (str, str)
            Colours at the bottom and at the top.

        Returns
        -------
        uint8, (height, width, 3)
            The picture; the same every time.
        """
        from PIL import Image, ImageDraw

        corners, rgb = np.concatenate(self._corners), np.concatenate(self._colours)
        width, height = size[0] * SAMPLES, size[1] * SAMPLES
        pixel, depth = _project(corners, position, focal, view_angle, (width, height))
        shaded = np.rint(rgb * _shade(corners)[:, None]).astype(np.uint8)
        image = Image.fromarray(_gradient(sky, (width, height)))
        draw = ImageDraw.Draw(image)
        edges = len(corners) <= LINE_FACETS
        lined = np.rint(shaded * (1 - LINE_STRENGTH) + np.array(LINE) * LINE_STRENGTH).astype(np.uint8)
        for facet in np.argsort(-depth, kind="stable").tolist():
            outline = tuple(lined[facet].tolist()) if edges else None
            draw.polygon(pixel[facet].ravel().tolist(), fill=tuple(shaded[facet].tolist()), outline=outline)
        small: NDArray[np.uint8] = np.asarray(image.resize(size, Image.Resampling.BOX))
        return small


def _project(
    corners: NDArray[np.float64],
    position: NDArray[np.float64],
    focal: NDArray[np.float64],
    view_angle: float,
    size: tuple[int, int],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels of the corners, (k, 3, 2), and the mean depth of each facet, (k,)."""
    ahead = (focal - position) / np.linalg.norm(focal - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (corners - position) @ np.column_stack((right, np.cross(right, ahead), ahead))
    scale = size[1] / 2 / np.tan(np.radians(view_angle) / 2)
    plane = seen[..., :2] / seen[..., 2:] * scale * [1.0, -1.0]
    return plane + np.array(size) / 2, seen[..., 2].mean(axis=1)


def _shade(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    light: NDArray[np.float64] = np.clip(normal @ SUN / length, 0, 1)
    return np.minimum(AMBIENT + (1 - AMBIENT) * light * 1.2, 1.0)


def _gradient(sky: tuple[str, str], size: tuple[int, int]) -> NDArray[np.uint8]:
    low, high = (np.array(list(bytes.fromhex(colour[1:]))) for colour in sky)
    share = np.linspace(1, 0, size[1])[:, None, None]
    rows: NDArray[np.uint8] = np.rint(low + (high - low) * share).astype(np.uint8)
    return np.repeat(rows, size[0], axis=1)
