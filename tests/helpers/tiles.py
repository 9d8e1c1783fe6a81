"""Towns as files for tiled runs: terraces, blocks, halls, holes in the cloud; and runs of them to compare."""

import dataclasses
import hashlib
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import laspy
import numpy as np
import pyogrio
import pyproj
import shapely
from numpy.typing import NDArray
from shapely import affinity

from pipeline.data.classes import BUILDING, GROUND
from pipeline.points_terrain.synthetic_roofs import RoofShapes, draw_roofs, shape_heights
from stitch.tiling.grid import Bounds
from tiler.check.check import CheckReport, check_run
from tiler.config.config import Config, make_config
from tiler.config.step_options import derived_parameters
from tiler.engine.engine import Engine
from tiler.engine.executor import Serial
from tiler.engine.run_context import RunContext, pack_tiles
from tiler.engine.stage import REGION_ITEM
from tiler.objects.places import identify
from tiler.planning.plan import Plan, make_plan
from tiler.stages.citymodel import city_model_stages
from tiler.stages.mesh import mesh_stages
from tiler.store.results import StoredTerrain
from tiler.workflow.resolved_domain import resolve_domain
from tiler.workflow.run import run
from tiler.workflow.stage_sequence import run_city_stages

CRS = "EPSG:3006"
X, Y = 318_000.0, 6_399_000.0
SIZE = 140.0  # m; least tile for cells of 10 m
ROOF_SIGMA = 0.05  # m, of the points on sloped roofs
ROAD = 14.0  # m between two terraces, back to back ones are closer


def box(width: float, height: float, *, west: float = X, south: float = Y) -> Bounds:
    return west, south, west + width, south + height


def around(tile: tuple[int, int], by: float, *, size: float = SIZE) -> Bounds:
    """The box of a tile, grown by some tiles."""
    (i, j), far = tile, by * size
    return i * size - far, j * size - far, (i + 1) * size + far, (j + 1) * size + far


def put_beside(polygons: list[shapely.Polygon], *others: shapely.Polygon) -> list[shapely.Polygon]:
    """Take others in, and all that is farther from them than 2 m."""
    place = shapely.buffer(shapely.union_all([shapely.envelope(other) for other in others]), 2.0)
    return [polygon for polygon in polygons if not polygon.intersects(place)] + list(others)


@dataclass(frozen=True, eq=False)
class Town:
    """Footprints, heights of their roofs above the ground at their centroid (m), hills of some height (m).

    Roofs are flat but for those that have `shapes`.
    """

    bounds: Bounds
    polygons: NDArray[np.object_]
    heights: NDArray[np.float64]
    relief: float = 0.0
    shapes: RoofShapes | None = None

    def ground(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of the ground (m), a function of the place alone."""
        hills: NDArray[np.float64] = 5.0 + self.relief / 4 * (np.sin(x / 130 + y / 310) + np.cos(y / 170))
        return hills


def make_town(bounds: Bounds, polygons: Sequence[shapely.Polygon], *, relief: float = 0.0, seed: int = 0) -> Town:
    """Town of some footprints with heights of 4 to 25 m."""
    outlines = np.empty(len(polygons), object)
    outlines[:] = list(polygons)
    return Town(bounds, outlines, np.random.default_rng([seed, 1]).uniform(4, 25, len(outlines)), relief)


def put_roofs(town: Town, *, seed: int) -> Town:
    """Give the houses of a town roofs of all types; those that are flat have their heights."""
    ground = town.ground(*shapely.get_coordinates(shapely.centroid(town.polygons)).reshape(-1, 2).T)
    shapes = draw_roofs(town.polygons, ground, ground + town.heights, seed=seed)
    return dataclasses.replace(town, shapes=shapes)


def terraces(bounds: Bounds, *, seed: int, angle: float = 17.0) -> list[shapely.Polygon]:
    """Rows of narrow houses that touch, overhang each other, or leave gaps around the clearance of 1 m.

    Rows stand back to back at 1 to 3 m, so that clusters reach along and across them and come close to others
    when they are simplified. Those that leave the bounds, less 3 m, are not built.
    """
    rng = np.random.default_rng(seed)
    xmin, ymin, xmax, ymax = bounds
    far = max(xmax - xmin, ymax - ymin) / 4
    rows: list[shapely.Polygon] = []
    y, back = ymin - far, False
    while y < ymax + far:
        x, depth = xmin - far, rng.uniform(8, 14)
        while x < xmax + far:
            width = rng.uniform(4, 12)
            front = y + rng.choice([0, 0, 0.3, 0.6, -0.4])
            rows.append(shapely.box(x, front, x + width, front + depth + rng.uniform(-1.5, 1.5)))
            x += width + rng.choice([0, 0, 0, 0.3, 0.7, 1.02, 1.1, 1.4, 6])
        y += depth + (ROAD if back else rng.choice([1.05, 1.2, 1.6, 2.5, 3.1]) + 1.5)
        back = not back
    middle = ((xmin + xmax) / 2, (ymin + ymax) / 2)
    turned = shapely.set_precision(
        np.array([affinity.rotate(row, angle, origin=middle) for row in rows], object), 0.001
    )
    inner = shapely.box(xmin + 3, ymin + 3, xmax - 3, ymax - 3)
    return list(turned[shapely.contains_properly(inner, turned)])


def comb(x: float, y: float) -> shapely.Polygon:
    """A house of thin walls, 20 x 20 m: most of it is lost when it is simplified unless its outline is closed."""
    teeth = [shapely.box(x + k, y, x + k + 0.5, y + 20) for k in np.arange(0, 20.1, 1.25)]
    return shapely.union_all([shapely.box(x, y, x + 20.5, y + 0.5), *teeth])


def write_town(
    folder: Path,
    town: Town,
    *,
    files: tuple[int, int] = (1, 1),
    without: Collection[tuple[int, int]] = (),
    lake: shapely.Geometry | None = None,
    spacing: float = 1.0,
) -> dict[str, Any]:
    """Write a town as LAZ files and footprints; returns what a configuration says of them.

    Parameters
    ----------
    folder : Path
        Where to.
    town : Town
        What.
    files : (nx, ny)
        Files in x and y, of equal size.
    without : collection of (i, j)
        Files that are not written.
    lake : shapely geometry, optional
        Area without returns.
    spacing : float
        Distance of the points (m).
    """
    xmin, ymin, xmax, ymax = town.bounds
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(xmin + spacing / 2, xmax, spacing), np.arange(ymin + spacing / 2, ymax, spacing))
    x, y = (axis.ravel() + rng.uniform(-0.3, 0.3, axis.size) * spacing for axis in (x, y))
    z, classes = town.ground(x, y), np.full(len(x), GROUND, np.uint8)
    where, house = shapely.STRtree(shapely.points(x, y)).query(town.polygons, predicate="intersects")[::-1]
    centre = shapely.get_coordinates(shapely.centroid(town.polygons)).reshape(-1, 2)
    if town.shapes is None:
        z[where] = (town.ground(*centre.T) + town.heights)[house]
    else:
        z[where] = shape_heights(town.shapes, house, np.column_stack((x, y))[where])
        z[where] += np.random.default_rng(1).normal(0, ROOF_SIGMA, len(where))
    classes[where] = BUILDING
    dry = np.ones(len(x), np.bool_) if lake is None else ~shapely.contains_xy(lake, x, y)
    (folder / "tiles").mkdir(parents=True)
    i = np.floor((x - xmin) / (xmax - xmin) * files[0]).astype(int)
    j = np.floor((y - ymin) / (ymax - ymin) * files[1]).astype(int)
    for a in range(files[0]):
        for b in range(files[1]):
            rows = dry & (i == a) & (j == b)
            if (a, b) not in without and rows.any():
                write_laz(folder / "tiles" / f"{a}_{b}.laz", x[rows], y[rows], z[rows], classes[rows])
    ids = np.array([f"b{k:04d}" for k in range(len(town.polygons))], object)
    write_footprints(folder / "footprints.gpkg", town.polygons, ids)
    return {"pointcloud": [str(folder / "tiles")], "footprints": str(folder / "footprints.gpkg")}


def write_laz(
    path: Path, x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], classes: NDArray[np.uint8]
) -> None:
    """Write points in `CRS`, whole centimetres."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), np.array([np.floor(x.min()), np.floor(y.min()), 0.0])
    header.add_crs(pyproj.CRS(CRS))
    las = laspy.LasData(header)
    las.x, las.y, las.z, las.classification = x, y, z, classes
    las.write(str(path))


@contextmanager
def open_engine(config: Config) -> Iterator[tuple[Engine, Plan]]:
    """Engine over the items of a configuration, without workers: stages of choice, where a run does them all."""
    out = Path(config.out)
    for folder in ("mesh", "boundary"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    plan = make_plan(config, lambda _: None)
    context = RunContext(
        plan.region.bounds,
        plan.region.crs,
        config.tile_size,
        config.mesh_size,
        pack_tiles(plan.grid),
        config.open_size,
    )
    parameters = SimpleNamespace(
        **dataclasses.asdict(config),
        **derived_parameters(config),
        footprints_identity=identify(Path(config.footprints)),
        footprints_frame=dataclasses.astuple(plan.georeference.footprints),
        footprints_shift=(0.0, 0.0),
        zones=plan.zones,
        generalised_identity="",
    )
    with nullcontext(Serial()) as executor:
        yield (
            Engine(out / "store.zarr", plan.layout, parameters=parameters, context=context, executor=executor),
            plan,
        )


def hash_files(folder: Path, *, besides: Callable[[Path], bool] = lambda _: False) -> dict[str, str]:
    """Hash of every file of a run but run.json, which has times, and those that are left out."""
    files = sorted(
        path
        for path in folder.rglob("*")
        if path.is_file()
        and path.name not in ("run.json", "progress.json", "events.jsonl", "config.toml", "report.html")
    )
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if not besides(path)
    }


def run_of(values: dict[str, Any], out: Path, **others: Any) -> dict[str, Any]:
    """Run with a lower domain than usual, for time; returns the record."""
    return run(make_config({"domain_height": 60.0} | values | {"out": str(out)} | others))


def column_arrays(values: dict[str, Any], out: Path, tile: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Columns of a tile and their facts, of a run that makes nothing that these do not need."""
    config = make_config(values | {"out": str(out)})
    with open_engine(config) as (engine, plan):
        run_city_stages(engine, config)
        seams, columns = mesh_stages(config, resolve_domain(engine, config))
        box = shapely.box(*plan.layout.tiles[tile])
        near = [name for name, line in plan.layout.seams.items() if shapely.box(*line).intersects(box)]
        engine.run(seams, items={"seams": near})
        engine.run(columns, items={"columns": [tile]})
        arrays, attributes = engine.store.read("columns", tile)
        return arrays, attributes["facts"]


def prove(out: Path) -> CheckReport:
    report = check_run(out, StoredTerrain)
    assert report.ok, "\n".join(report.lines())
    return report


def prove_local(values: dict[str, Any], tile: tuple[int, int], folder: Path, *bounds: Bounds) -> None:
    """Prove that a tile has the same arrays and facts in several regions."""
    first: tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]] | None = None
    for k, region in enumerate(bounds):
        arrays, facts = column_arrays(values | {"bounds": region}, folder / str(k), f"{tile[0]}_{tile[1]}")
        first = first or (arrays, facts)
        assert arrays.keys() == first[0].keys()
        for name, array in arrays.items():
            assert array.tobytes() == first[0][name].tobytes(), f"{name} of region {k}"
        assert facts == first[1]


def shape_city(values: dict[str, Any], out: Path) -> tuple[list[int], int]:
    """Make the city models; tells how many clusters each round joined, and how many houses were closed."""
    config = make_config(values | {"out": str(out)})
    with open_engine(config) as (engine, plan):
        last = run_city_stages(engine, config)
        engine.run(*city_model_stages(config))
        joined = [engine.records[f"join-{k}", REGION_ITEM].facts["joined"] for k in range(last + 1)]
        shapes = (engine.store.read(f"shapes-{last - 1}", tile, names=("closed",)) for tile in plan.layout.tiles)
        return joined, sum(len(arrays["closed"]) for arrays, _ in shapes)


def shuffle_inputs(values: dict[str, Any], folder: Path, *, seed: int) -> dict[str, Any]:
    """Write the points of all files of a town, and its footprints, in another order, into files of other names."""
    rng = np.random.default_rng(seed)
    (folder / "tiles").mkdir(parents=True)
    paths = sorted(Path(values["pointcloud"][0]).iterdir())
    for k, path in enumerate(reversed(paths)):
        las = laspy.read(path)
        order = rng.permutation(len(las.points))
        x, y, z = (np.asarray(axis)[order] for axis in (las.x, las.y, las.z))
        write_laz(folder / "tiles" / f"part{k}.laz", x, y, z, np.asarray(las.classification)[order])
    _, _, geometry, (ids,) = pyogrio.raw.read(values["footprints"])
    order = rng.permutation(len(ids))
    write_footprints(folder / "footprints.gpkg", shapely.from_wkb(geometry[order]), ids[order])
    return {"pointcloud": [str(folder / "tiles")], "footprints": str(folder / "footprints.gpkg")}


def write_footprints(path: Path, polygons: NDArray[np.object_], ids: NDArray[np.object_], crs: str = CRS) -> None:
    """Write footprints with their ids."""
    pyogrio.raw.write(
        path, geometry=shapely.to_wkb(polygons), field_data=[ids], fields=["id"], geometry_type="Polygon", crs=crs
    )
