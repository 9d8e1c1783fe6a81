"""Textures of a city whose truth is known: `python -m tests.benchmarks.texture_truth STYLE SIZE [FOLDER]`.

A town of `citystitch synth` is meshed, VTK takes images of it with a checker on everything, and textures are made.
Printed are: the error of texels that an image shows; how hidden points agree with rays of VTK (intersection over
union); the processor time a building.
"""

import json
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from tests.helpers.oriented_images import (
    Array,
    Pose,
    colour_of,
    scene_of,
    see_truth,
    survey,
    take_images,
    write_colmap,
)
from tiler.cli.main import main as command
from tiler.convert.inputs import open_source
from tiler.textures.camera_files import read_cameras, usable_cameras
from tiler.textures.cameras import Camera
from tiler.textures.paint import NO_IMAGE, paint_surfaces
from tiler.textures.surfaces import Bins, Surface, sort_city
from tiler.textures.texture import TextureAsked, texture_models
from tiler.textures.views import Plants, facing, open_view, rank_images, texel_grid, texel_middles
from tiler.textures.visibility import HIDDEN, OUTSIDE

TEXEL = 0.2
ABOVE, STEP = 150.0, 125.0  # m
SPACING = 2.0  # m, of points whose visibility is compared
OFF = 0.02  # m, of rays from their surface


def measure(run: Path, folder: Path, poses: list[Pose], triangles: Array, texel: float) -> dict[str, float]:
    """Measure texels against the colours of their places, and hidden points against rays."""
    origin = triangles.reshape(-1, 3).min(axis=0)
    told: Counter[str] = Counter()
    with open_source([run]) as source, TemporaryDirectory() as waiting:
        read = read_cameras(folder, origin, source.crs, 0.0, told)
        cameras, _ = usable_cameras(read, folder, source.low, source.high, told)
        eyes = {pose.name: pose.eye for pose in poses}
        bins = sort_city(source, run, Path(waiting), 250.0)
        errors: list[Array] = []
        both = either = 0
        for code in bins.tiles:
            surfaces = bins.tile(code).surfaces
            ranking = rank_images(surfaces, cameras, bins, lambda _: Plants(), 1.0)
            painted = paint_surfaces(
                surfaces, cameras, ranking, bins, folder, lambda _: Plants(), texel=texel, least=1.0
            )
            for surface, one in zip(surfaces, painted, strict=True):
                if one is not None:
                    shown = one.inside & (one.rank != NO_IMAGE)
                    middles = texel_middles(surface, one.texel, shown)
                    errors.append(np.abs(one.pixels[shown] - colour_of(middles)).mean(axis=1))
            for _, camera, rows in facing(surfaces, cameras):
                own = [surfaces[row] for row in rows]
                found, truth = hidden_points(camera, own, bins, triangles, eyes[camera.name])
                both += int((found & truth).sum())
                either += int((found | truth).sum())
    off = np.concatenate(errors)
    return {
        "mean error of 255": float(off.mean()),
        "median error of 255": float(np.median(off)),
        "texels off by more than 30": float((off > 30).mean()),
        "IoU": both / either,
        "hidden points": either,
    }


def hidden_points(
    camera: Camera, surfaces: list[Surface], bins: Bins, triangles: Array, eye: tuple[float, float, float]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Tell of points of surfaces that are in an image whether they are hidden: by us, and by rays."""
    view = open_view(camera, surfaces, bins, Plants())
    found, places = [np.empty(0, np.bool_)], [np.empty((0, 3))]
    for surface in surfaces if view is not None else []:
        points = texel_middles(surface, SPACING, texel_grid(surface, SPACING))
        if view is not None and len(points):
            state, _, _ = view.see(points, surface)
            kept = state != OUTSIDE
            found.append(state[kept] == HIDDEN)
            places.append(points[kept] + OFF * surface.axes[2])
    return np.concatenate(found), ~see_truth(triangles, np.concatenate(places), eye)


def main(style: str, size: float, work: Path) -> None:
    """Make the town, its images and textures, and print what was measured."""
    run, images = work / "out", work / "images"
    town = work / "town"
    words = ["synth", str(town), "--style", style, "--size", str(size)]
    assert command(words) == 0
    clouds = [str(path) for path in sorted((town / "tiles").glob("*.laz"))]
    given = ["--buildings", str(town / "town.city.jsonl"), "--tile-size", "250", "--quiet", "--no-dashboard"]
    assert command(["run", *clouds, *given, "--out", str(run)]) in (0, 3)
    triangles = scene_of(run)
    flat = triangles.reshape(-1, 3)
    low, high = flat.min(axis=0), flat.max(axis=0)
    poses = survey(low.tolist(), high.tolist(), above=ABOVE, step=STEP, size=(1600, 1200), angle=60.0)
    images.mkdir()
    take_images(triangles, poses, images)
    write_colmap(poses, images, low)
    asked = TextureAsked(images, images, ",".join(map(repr, low.tolist())), texel=TEXEL, overwrite=True)
    texture_models([run], work / "textures", asked)  # compiles the kernels
    begun, wall = time.process_time(), time.perf_counter()
    lines = texture_models([run], work / "textures", asked)
    spent, wall = time.process_time() - begun, time.perf_counter() - wall
    print(*lines, sep="\n")
    record = json.loads((work / "textures" / "textures.json").read_text())
    print(f"{len(poses)} images of {poses[0].size}; {len(triangles)} triangles")
    print(f"{spent:.1f} s of CPU, {spent / record['buildings']:.4f} s a building; {wall:.1f} s in all")
    print(json.dumps(measure(run, images, poses, triangles, TEXEL), indent=1))


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        main(sys.argv[1], float(sys.argv[2]), Path(sys.argv[3] if len(sys.argv) > 3 else folder))
