"""Write a synthetic city: classified LAZ in several files, footprints as SHP and GPKG, and the truth."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import shapely
from numpy.typing import NDArray

from pipeline.data.errors import ConfigError
from pipeline.points_terrain.synthetic import ORIGIN, SyntheticCity, city_points, cut_city, make_city
from pipeline.points_terrain.synthetic_roofs import ROOF_TYPES, wing_rings
from tiler.executors.in_order import map_in_order
from tiler.formats.gpkg import fixed_time
from tiler.mesh_files.threads import check_workers
from tiler.towns.synthetic_files import DAY, write_laz

CRS = "EPSG:3006"
DENSITY = 1.5  # points/m2
RELIEF = 20.0  # m
SEED = 1

_TILE_SIZE = 500.0  # m, about: a city is cut into equal squares
_TAGS = {"shed": "skillion", "gable": "gabled", "hip": "hipped", "pyramid": "pyramidal"}  # of `ROOF_TYPES`


@dataclass(frozen=True)
class SynthFiles:
    """What `write_city` wrote."""

    clouds: list[Path]  #: LAZ files, sorted
    #: the same footprints as GPKG and SHP, with the attribute ``id``. With mixed roofs the GPKG has besides, in
    #: the words of OpenStreetMap, ``height`` (m, from the ground to the ridge), ``roof:shape``, ``roof:height``,
    #: ``roof:direction`` and ``roof:orientation``
    footprints: Path
    shapefile: Path
    #: JSON with the parameters, and the ground and the highest place of the roof of each building (m); with mixed
    #: roofs also its type, its eaves, and its planes: over each of the ``wings``, whose corners are ``ring``, the
    #: roof is the lowest of ``a (x - x0) + b (y - y0) + c``, where ``origin`` is ``x0, y0`` and each of ``planes``
    #: is ``a, b, c``; where two wings overlap, the higher of both
    truth: Path


def write_city(
    directory: Path,
    *,
    size: float,
    buildings: int,
    density: float = DENSITY,
    relief: float = RELIEF,
    seed: int = SEED,
    roofs: str = "flat",
    workers: int = 0,
) -> SynthFiles:
    """Make a synthetic city and write it: the same parameters give the same bytes, whatever the workers.

    Parameters
    ----------
    directory : Path
        Folder to write to; made if it is missing.
    size, buildings, density, relief, seed, roofs
        See `pipeline.points_terrain.synthetic.make_city`.
    workers : int
        Processes of this machine that write point clouds; with 0 this one does.

    Returns
    -------
    SynthFiles

    Raises
    ------
    ConfigError
        If a parameter is out of range, the folder cannot be written, or it holds point clouds that this
        city does not have.

    Notes
    -----
    The city's buildings are in the memory of this process, and one LAZ file at a time in that of each worker.
    """
    check_workers(workers)
    try:
        city = make_city(size=size, buildings=buildings, density=density, relief=relief, seed=seed, roofs=roofs)
    except ValueError as error:
        raise ConfigError(f"synth: {error}") from error
    tiles = _tiles(city, directory / "tiles")
    files = SynthFiles(
        sorted(tiles), directory / "footprints.gpkg", directory / "footprints.shp", directory / "truth.json"
    )
    with _write_errors(directory):
        (directory / "tiles").mkdir(parents=True, exist_ok=True)
        strangers = set((directory / "tiles").iterdir()) - set(tiles)
        if strangers:
            raise ConfigError(f"{min(strangers)}: is not of this city; give an empty folder or remove it")
        parts = cut_city(city, (bounds for _, bounds in tiles.values()))
        for _ in map_in_order(_write_cloud, zip(parts, tiles.items(), strict=True), workers):
            pass
        _write_footprints(city, files)
        files.truth.write_text(json.dumps(_truth(city, buildings, relief), indent=1) + "\n")
    return files


Tile = tuple[tuple[int, int], tuple[float, float, float, float]]  # column and row, and its box


def _write_cloud(item: tuple[SyntheticCity, tuple[Path, Tile]]) -> None:
    """Write the points of a part of a city."""
    city, (path, (part, bounds)) = item
    write_laz(path, city_points(city, bounds, part), bounds, CRS)


def _tiles(city: SyntheticCity, folder: Path) -> dict[Path, Tile]:
    """Cut the city into files named by their lower left corner."""
    n = max(1, round(city.size / _TILE_SIZE))
    x, y = (corner + np.linspace(0, city.size, n + 1) for corner in ORIGIN)
    return {
        folder / f"{x[i]:.0f}_{y[j]:.0f}.laz": (
            (i, j),
            (float(x[i]), float(y[j]), float(x[i + 1]), float(y[j + 1])),
        )
        for i in range(n)
        for j in range(n)
    }


def _write_footprints(city: SyntheticCity, files: SynthFiles) -> None:
    wkb = shapely.to_wkb(city.polygons)
    ids = {"id": city.ids.astype(np.object_)}
    words = {} if city.roofs == "flat" else _roof_tags(city)
    with fixed_time(DAY):
        for path, fields, options in (
            (files.footprints, ids | words, {}),
            (files.shapefile, ids, {"DBF_DATE_LAST_UPDATE": DAY.isoformat()}),
        ):
            path.unlink(missing_ok=True)
            values = list(fields.values())
            pyogrio.raw.write(
                path, wkb, values, list(fields), geometry_type="Polygon", crs=CRS, layer="footprints", **options
            )


def _roof_tags(city: SyntheticCity) -> dict[str, NDArray[Any]]:
    """Attributes of roofs as OpenStreetMap has them; None or NaN where one says nothing."""
    shapes, first = city.shapes, city.shapes.start[:-1]
    types = [ROOF_TYPES[kind] for kind in shapes.kind.tolist()]
    gabled = ~np.isfinite(shapes.plane[first, 0, 2])  # no plane rises from the ends of the ridge
    shape = [_TAGS.get(name, name) for name in types]
    shape = ["gambrel" if name == "mansard" and ends else name for name, ends in zip(shape, gabled, strict=True)]
    shed = np.array([name == "skillion" for name in shape])
    used = np.isfinite(shapes.plane[first, :, 2]).argmax(axis=1)
    east, north = shapes.plane[first, used, :2].T
    direction = np.degrees(np.arctan2(-east, -north)) % 360
    across = shapes.half[first, 0] < shapes.half[first, 1]
    ridge = np.array([name in ("gabled", "gambrel") for name in shape])
    words = ["across" if wide else "along" for wide in across.tolist()]
    return {
        "height": np.round(city.roof - city.ground, 3),
        "roof:shape": np.array(shape, np.object_),
        "roof:height": np.round(city.roof - shapes.eaves, 3),
        "roof:direction": np.where(shed, np.round(direction, 1) % 360, np.nan),
        "roof:orientation": np.array(
            [word if known else None for word, known in zip(words, ridge.tolist(), strict=True)], np.object_
        ),
    }


def _truth(city: SyntheticCity, buildings: int, relief: float) -> dict[str, object]:
    pond = dict(zip(("x", "y", "radius", "level"), city.pond.tolist(), strict=True))
    roofs: dict[str, object] = {} if city.roofs == "flat" else {"roofs": city.roofs}
    return {
        "crs": CRS,
        "bounds": [*ORIGIN, ORIGIN[0] + city.size, ORIGIN[1] + city.size],
        "size": city.size,
        "n_buildings": buildings,
        "density": city.density,
        "relief": relief,
        "seed": city.seed,
        **roofs,
        "pond": pond,
        "buildings": [
            {"id": str(name), "ground": round(ground, 3), "roof": round(roof, 3), **shape}
            for name, ground, roof, shape in zip(
                city.ids, city.ground.tolist(), city.roof.tolist(), _shapes(city), strict=True
            )
        ],
    }


def _shapes(city: SyntheticCity) -> list[dict[str, object]]:
    """Describe type, eaves and planes of each roof, but for a city of flat ones."""
    shapes = city.shapes
    if city.roofs == "flat":
        return [{}] * len(shapes)
    rings = np.round(wing_rings(shapes), 3).tolist()
    wings = [
        {
            "ring": ring,
            "origin": [round(place, 3) for place in centre],
            "planes": [[round(part, 9) for part in plane] for plane in planes if plane[2] != np.inf],
        }
        for ring, centre, planes in zip(rings, shapes.centre.tolist(), shapes.plane.tolist(), strict=True)
    ]
    return [
        {"type": ROOF_TYPES[kind], "eaves": round(eaves, 3), "wings": wings[first:last]}
        for kind, eaves, first, last in zip(
            shapes.kind.tolist(), shapes.eaves.tolist(), shapes.start[:-1], shapes.start[1:], strict=True
        )
    ]


@contextmanager
def _write_errors(directory: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, pyogrio.errors.DataSourceError) as error:
        raise ConfigError(f"{directory}: cannot be written ({error}); give a folder that can") from error
