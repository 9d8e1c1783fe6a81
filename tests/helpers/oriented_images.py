"""Images of a run from known cameras: VTK tells which triangle a pixel shows, and its place gives the colour.

Cameras are placed by VTK's own words (position, focal point, up, view angle), so that nothing of ours projects.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyvista as pv
import vtk
from numpy.typing import NDArray
from PIL import Image

from pipeline.data.mesh import is_ground
from tiler.convert.inputs import open_source
from tiler.convert.triangles import iter_triangles
from tiler.export.surface import open_surface
from tiler.mesh_files.run_files import find_files

Array = NDArray[np.float64]
# Directions whose waves make a checker of any plane, and slow waves that tint places (radians per metre).
CHECKER = np.pi / 2.5 * np.array([(0.83, 0.41, 0.38), (-0.37, 0.78, 0.51), (0.29, -0.36, 0.89)])
TINTS = 2 * np.pi * np.array([(1 / 61, 1 / 83, 1 / 29), (-1 / 71, 1 / 53, 1 / 31), (1 / 97, -1 / 59, 1 / 23)])


@dataclass(frozen=True)
class Pose:
    """A camera of VTK: eye and the place that it looks at (m), size (pixels), vertical angle of view (degrees)."""

    name: str
    eye: tuple[float, float, float]
    at: tuple[float, float, float]
    size: tuple[int, int] = (800, 600)
    angle: float = 40.0

    @property
    def focal(self) -> float:
        """Focal length (pixels)."""
        return float(self.size[1] / 2 / np.tan(np.radians(self.angle) / 2))

    def turn(self) -> Array:
        """Rotation from the axes of the world to x right, y down, z ahead."""
        ahead = np.subtract(self.at, self.eye)
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, self.up())
        right = right / np.linalg.norm(right)
        found: Array = np.array([right, np.cross(ahead, right), ahead])
        return found

    def up(self) -> tuple[float, float, float]:
        """Give the direction that is upwards in the image: north where it looks down."""
        return (0.0, 0.0, 1.0) if self.eye[:2] != self.at[:2] else (0.0, 1.0, 0.0)


def scene_of(run: Path) -> Array:
    """Triangles (t, 3, 3) of the buildings and the ground of a run."""
    parts = []
    with open_source([run]) as source:
        parts += [one.xyz[one.triangles] for one in iter_triangles(source, "auto")]
    surface = open_surface(find_files(run))
    for k in range(len(surface.names)):
        piece = surface.read(k)
        parts.append(piece.points[piece.facets[is_ground(piece.marker)]])
    return np.concatenate(parts)


def colour_of(xyz: Array) -> Array:
    """Colours (n, 3), 0 to 255, of places of the world (n, 3): a checker of 2.5 m with tints."""
    local = xyz - np.floor(xyz / 1000) * 1000
    checker = np.sign(np.sin(local @ CHECKER.T).prod(axis=1))
    found: Array = 127 + 60 * np.sin(local @ TINTS.T) + 45 * checker[:, np.newaxis]
    return found


def take_images(triangles: Array, poses: Sequence[Pose], folder: Path) -> None:
    """Write an image of each pose as PNG."""
    origin = triangles.reshape(-1, 3).min(axis=0)
    local = triangles - origin
    mesh = pv.PolyData.from_regular_faces(local.reshape(-1, 3), np.arange(3 * len(local)).reshape(-1, 3))
    number = np.arange(1, len(local) + 1)
    mesh.cell_data["id"] = np.column_stack((number >> 16, number >> 8 & 255, number & 255)).astype(np.uint8)
    plotter = pv.Plotter(off_screen=True, window_size=poses[0].size)
    plotter.disable_anti_aliasing()
    plotter.background_color = "black"
    plotter.add_mesh(mesh, scalars="id", rgb=True, lighting=False, show_edges=False)
    for pose in poses:
        plotter.camera.position = tuple(np.subtract(pose.eye, origin))
        plotter.camera.focal_point = tuple(np.subtract(pose.at, origin))
        plotter.camera.up = pose.up()
        plotter.camera.view_angle = pose.angle
        plotter.reset_camera_clipping_range()
        plotter.render()
        ids = np.asarray(plotter.screenshot(return_img=True)).astype(np.int64)
        found = (ids[..., 0] << 16 | ids[..., 1] << 8 | ids[..., 2]) - 1
        Image.fromarray(_shade(local, found, pose, origin)).save(folder / pose.name)
    plotter.close()


def _shade(local: Array, found: NDArray[np.int64], pose: Pose, origin: Array) -> NDArray[np.uint8]:
    """Give each pixel the colour of the place where its ray meets the plane of its triangle."""
    height, width = found.shape
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack((x / pose.focal, y / pose.focal, np.ones_like(x)), axis=-1) @ pose.turn()
    corners = local[found]
    normal = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    eye = np.subtract(pose.eye, origin)
    with np.errstate(divide="ignore", invalid="ignore"):
        far = ((corners[..., 0, :] - eye) * normal).sum(axis=-1) / (rays * normal).sum(axis=-1)
    far = np.where((found >= 0) & np.isfinite(far), far, 0.0)
    places = eye + far[..., np.newaxis] * rays + origin
    pixels = colour_of(places.reshape(-1, 3)).reshape(height, width, 3)
    return np.where(found[..., np.newaxis] >= 0, np.clip(np.round(pixels), 0, 255), [170, 200, 230]).astype(
        np.uint8
    )


def write_colmap(poses: Sequence[Pose], folder: Path, origin: Array) -> None:
    """Write cameras.txt and images.txt of COLMAP, in coordinates from an origin."""
    from scipy.spatial.transform import Rotation

    cameras, images = [], []
    for k, pose in enumerate(poses, 1):
        (width, height), turn = pose.size, pose.turn()
        cameras.append(f"{k} PINHOLE {width} {height} {pose.focal!r} {pose.focal!r} {width / 2} {height / 2}")
        x, y, z, w = Rotation.from_matrix(turn).as_quat().tolist()
        shift = (-turn @ np.subtract(pose.eye, origin)).tolist()
        images += [" ".join(map(repr, [k, w, x, y, z, *shift, k])) + f" {pose.name}", ""]
    (folder / "cameras.txt").write_text("# cameras\n" + "\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")


def see_truth(triangles: Array, places: Array, eye: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Tell by rays of VTK which places (n, 3), 2 cm off their surfaces, are seen from an eye."""
    origin = triangles.reshape(-1, 3).min(axis=0)
    local = (triangles - origin).reshape(-1, 3)
    mesh = pv.PolyData.from_regular_faces(local, np.arange(len(local)).reshape(-1, 3))
    tree = vtk.vtkStaticCellLocator()
    tree.SetDataSet(mesh)
    tree.BuildLocator()
    end = np.subtract(eye, origin).tolist()
    t, sub = vtk.mutable(0.0), vtk.mutable(0)
    hit, coordinates = [0.0] * 3, [0.0] * 3
    return np.array(
        [not tree.IntersectWithLine(p, end, 1e-6, t, hit, coordinates, sub) for p in (places - origin).tolist()],
        np.bool_,
    )


def survey(
    low: Sequence[float], high: Sequence[float], *, above: float, step: float, size: tuple[int, int], angle: float
) -> list[Pose]:
    """Poses of a flight: at places of a grid one image straight down, and four 45 degrees off it."""
    poses: list[Pose] = []
    ground = float(low[2])
    for x in np.arange(low[0] + step / 2, high[0], step).tolist():
        for y in np.arange(low[1] + step / 2, high[1], step).tolist():
            for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
                eye = (x - above * dx, y - above * dy, ground + above)
                poses.append(Pose(f"{len(poses):03d}.png", eye, (x, y, ground), size, angle))
    return poses
