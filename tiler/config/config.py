"""Every parameter of a run, once: default, unit, meaning, source. The command line and TOML follow it."""

import dataclasses
import math
import unicodedata
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, get_args, get_origin, get_type_hints

from pipeline.data.classes import BUILDING, GROUND, HIGH_NOISE, LOW_NOISE, WATER
from pipeline.data.errors import ConfigError
from stitch.tiling.smallest_tile import LEAST_TILE
from tiler.config.domain_height import (
    EXPECTED_TALLEST,
    LEAST_SIDE,
    ROUNDING,
    Height,
    check_widths,
    choose_tile_size,
    height_in_metres,
    read_height,
)
from tiler.config.zones import BLOCKS, ZonesAsked, is_file, read_zones_asked
from tiler.objects.places import absolute, check_url, is_url
from tiler.words.plain_text import shorten

MAX_TEXT = 10_000  # characters of one value; a CRS as WKT has some 2,000
MAX_INT = 2**53
UNSET = ""
AUTO = "auto"  # instead of metres: as measured
ANYWHERE = "127.0.0.1:0"  # a free port of this machine, for this machine
PAD_COARSENING = 3.0  # mesh sizes; target edge length in a pad, where none is given for the open
NO_BUILDINGS = (GROUND, LOW_NOISE, WATER, HIGH_NOISE)  # classes that cannot mark buildings
LEAST_SIZE = 0.1  # m; of edges
CLEARANCE_OF_MODELS = 0.5  # m; their walls are exact: moved by more, a court comes under a roof beside it
FINER_CLEARANCE = 0.3  # m; at 0.2 m cells are flatter
KEPT = ("both", "store", "pieces")  # what may stay in the folder of a run that is done
LEAST_FIRST_LAYER = 0.001  # mesh sizes; flatter cells are of no use to any solver


# Parameters that name inputs: files, folders, patterns or URLs; of zones not all values do.
INPUTS = (
    *("pointcloud", "footprints", "buildings", "terrain", "land_cover", "land_cover_table", "trees"),
    *("refine_areas", "lod_zones", "generalised"),
)


class Above(float):
    """A lower bound that is itself too low."""


def _parameter(
    default: Any,
    section: str,
    text: str,
    *,
    unit: str = "",
    source: str = "",
    choices: tuple[str, ...] = (),
    least: float | None = None,
    most: float | None = None,
) -> Any:
    """Declare a parameter: its section in TOML, its bounds, and all that a user should know of it."""
    metadata = {"section": section, "text": text, "unit": unit, "source": source, "choices": choices}
    return field(default=default, metadata=metadata | {"least": least, "most": most})


@dataclass(frozen=True)
class Config:
    """The parameters of a run; the field's metadata says what each means.

    Examples
    --------
    >>> Config(pointcloud=("a.laz",), mesh_size=5.0).layer_height_or_default
    5.0
    """

    pointcloud: tuple[str, ...] = _parameter(
        (), "input", "LAS, LAZ or COPC files, globs or folders with such files"
    )
    footprints: str = _parameter(
        UNSET,
        "input",
        "SHP, GPKG, GeoJSON or GeoParquet file of building footprints; with a city model: buildings that it lacks",
    )
    buildings: tuple[str, ...] = _parameter(
        (), "input", "CityJSON, CityJSONSeq or CityGML files of buildings, or GeoPackages of 3DBAG, instead of "
        "footprints or with them; their roof surfaces are meshed unchanged",
    )  # fmt: skip
    terrain: tuple[str, ...] = _parameter(
        (), "input", "rasters of ground height (GeoTIFF, COG, VRT), instead of ground points; these count where "
        "the rasters have no data",
    )  # fmt: skip
    lod: str = _parameter(
        "auto", "input", "level of detail of the buildings of a city model: auto for the best roofs that it has, "
        "or the best level up to a number", choices=("auto", "1.2", "1.3", "2.1", "2.2"),
    )  # fmt: skip
    prefer: str = _parameter(
        "model", "input", "source of a roof that both the point cloud and the city model have",
        choices=("model", "points"),
    )  # fmt: skip
    axis_order: str = _parameter(
        UNSET, "input", "first coordinate in city models: xy for the easting, yx for the northing; empty: "
        "detected from the coordinates", choices=(UNSET, "xy", "yx"),
    )  # fmt: skip
    shift_z: float | str = _parameter(
        0.0, "input", "offset added to all heights of city models, if they differ from the terrain's; auto: "
        "median height of the terrain rasters above the feet of buildings", unit="m", least=-1e4, most=1e4,
    )  # fmt: skip
    layer: str = _parameter(UNSET, "input", "layer of the footprint file; empty: its only or first one")
    id_attribute: str = _parameter(
        UNSET, "input", "attribute with building ids; empty: a well-known name, else ids from geometry"
    )
    height_attribute: str = _parameter(
        UNSET, "input", "attribute with heights above ground, for buildings without roof points", unit="m"
    )
    roof_attribute: str = _parameter(
        UNSET, "input", "attribute with roof shapes, as in roof:shape of OSM or as CityGML codes; empty: a "
        "well-known name; only for --roofs planes and skeleton",
    )  # fmt: skip
    land_cover: tuple[str, ...] = _parameter(
        (), "input", "vector files of polygons that make patches of the ground: water, street, grass and others"
    )
    land_cover_field: str = _parameter(
        "class", "input", "attribute of land_cover with the class; of a comma-separated list the first whose "
        "value is in the table",
    )  # fmt: skip
    land_cover_table: str = _parameter(
        UNSET,
        "input",
        "TOML file with the patches of the ground, their roughness length and classes; empty: the built-in table",
    )
    water_points: bool = _parameter(
        False, "input", "make water where points of class 9 lie: a level patch of the ground, with or without "
        "land_cover",
    )  # fmt: skip
    vegetation_classes: tuple[int, ...] = _parameter(
        (), "input", "point classes of vegetation, such as 5 or 3,4,5; cells between the leaves are porous; "
        "empty: none",
        least=0, most=255,
    )  # fmt: skip
    trees: str = _parameter(
        UNSET,
        "input",
        "vector file of trees: crowns or positions, with or without heights; their cells are porous",
    )
    leaf_area_density: float = _parameter(
        0.0, "input", "leaf area density of all trees; 0: from the share of points that pass the leaves, and 1 "
        "for trees whose height the file states", unit="m2/m3", least=0, most=10,
    )  # fmt: skip
    leaf_column: float = _parameter(
        2.0, "input", "side of the columns in which leaves are counted", unit="m", least=0.5, most=50
    )
    crs: str = _parameter(UNSET, "input", "CRS of the region, as EPSG:NNNN; empty: the CRS that the data state")
    reproject: bool = _parameter(
        False, "input", "reproject point clouds in another CRS than the region's, in degrees, or in a projection "
        "without true lengths (Web Mercator), to crs or to their UTM zone",
    )  # fmt: skip
    align: bool = _parameter(
        False, "input", "move the footprints by the measured shift that best fits the roofs in the point cloud"
    )
    height_unit: str = _parameter(
        UNSET, "input", "unit of heights of the point clouds, instead of the stated one: m, ft, or ftUS (US "
        "survey feet); empty: as stated, else metres, or feet where x and y are in feet",
        choices=(UNSET, "m", "ft", "ftUS"),
    )  # fmt: skip
    bounds: tuple[float, ...] = _parameter(
        (),
        "input",
        "region as xmin ymin xmax ymax; empty: extent of the point clouds, rounded inwards to whole metres",
        unit="m",
    )
    building_classes: tuple[int, ...] = _parameter(
        (BUILDING,), "input", "point classes of buildings, such as 6,67",
        source="ASPRS LAS 1.4", least=0, most=255,
    )  # fmt: skip
    skip_unreadable: bool = _parameter(
        False, "input", "leave out point-cloud files that cannot be read, list them, and end with exit code 3"
    )
    dtm_spacing: float = _parameter(
        1.0, "terrain", "spacing of the terrain grid", unit="m", source="paper, step 1.3", least=Above(0)
    )
    ground_filter: bool = _parameter(
        False, "terrain", "classify ground points by the built-in filter, for clouds without ground classes"
    )
    min_building_area: float = _parameter(5.0, "buildings", "smaller footprints are dropped", unit="m2", least=0)
    vertex_tolerance: float = _parameter(
        0.01, "buildings", "vertices closer than this are merged; also the tolerance for removing redundant ones",
        unit="m", source="paper, step 1.4", least=Above(0), most=0.5,
    )  # fmt: skip
    ground_margin: float = _parameter(
        1.0, "buildings", "ground points of a building lie within this distance of its footprint", unit="m",
        source="paper, step 1.5", least=Above(0),
    )  # fmt: skip
    ground_percentile: float = _parameter(
        10.0, "buildings", "ground height of a building, percentile of its ground points", unit="%",
        source="paper, step 1.6", least=0, most=100,
    )  # fmt: skip
    roof_height: str = _parameter(
        "median", "buildings", "roof height of a building: the median of its roof points, or roof_percentile (the "
        "paper's)", choices=("median", "percentile"),
    )  # fmt: skip
    roof_percentile: float = _parameter(
        90.0, "buildings", "percentile of the roof points with roof_height = percentile", unit="%",
        source="paper, step 1.6", least=0, most=100,
    )  # fmt: skip
    default_height: float = _parameter(
        6.0, "buildings", "height above ground of a building without roof points and height attribute; 0 drops it",
        unit="m", least=0,
    )  # fmt: skip
    roof_clearance: float = _parameter(
        2.0, "buildings", "roofs are raised to this height above the highest terrain at their walls", unit="m",
        least=Above(0),
    )  # fmt: skip
    border: str = _parameter(
        "clip", "buildings", "buildings on the region's border are clipped to it less the clearance, or dropped",
        choices=("clip", "drop"),
    )  # fmt: skip
    simplify: str = _parameter(
        "clearance", "simplify", "clearance: one planar graph of walls that keeps every house; paper: merging",
        source="paper, step 2.1", choices=("clearance", "paper"),
    )  # fmt: skip
    clearance: float = _parameter(
        1.0, "simplify", "least distance of walls; with simplify = paper, buildings closer than this are merged. "
        f"Where roofs of a city model are meshed as they are, {CLEARANCE_OF_MODELS:g} m by default",
        unit="m", source="paper, step 2.1", least=0.1,
    )  # fmt: skip
    finer_clearance: float = _parameter(
        0.0, "simplify", "least distance of walls in clusters of houses where roofs of a city model would be off "
        f"by more than 0.5 m; 0: the clearance. Where that is not given, {FINER_CLEARANCE:g} m by default",
        unit="m", least=0,
    )  # fmt: skip
    clearance_floor: float = _parameter(
        0.1, "simplify", "with simplify = paper: finer details of one building are repaired", unit="m",
        least=Above(0),
    )  # fmt: skip
    min_courtyard_area: float = _parameter(5.0, "simplify", "smaller courtyards are filled", unit="m2", least=0)
    roofs: str = _parameter(
        "planes", "simplify", "roofs of houses: planes found in their points, hipped ones by the skeleton of the "
        "outline, or flat; always flat with mesher = layered or simplify = paper",
        choices=("planes", "skeleton", "flat"),
    )  # fmt: skip
    roof_price: float = _parameter(
        4.0, "simplify", "roof area half a metre off its points that a wall between planes must save: less gives "
        "more planes and cells, with roofs = planes", unit="m2", least=0.5,
    )  # fmt: skip
    full_parts: bool = _parameter(
        True, "simplify", "divide the houses of citymodel-full.city.json by their roofs, closer to points than "
        "the mesh; without, each has one height there; with sloped roofs",
    )  # fmt: skip
    split_levels: bool = _parameter(
        True, "simplify", "divide houses where their roof points show a step, with roofs = flat"
    )
    roof_group: float = _parameter(
        2.5, "simplify", "adjacent houses closer in height than this get one roof, with roofs = flat",
        unit="m", least=0,
    )  # fmt: skip
    manifold: bool = _parameter(
        False, "simplify", "open or close the corners in which houses touch in a point only"
    )
    mesh_size: float = _parameter(
        10.0, "mesh", "target edge length h: triangles of the plane mesh have about h^2/2 at most", unit="m",
        source="paper, step 3.1", least=0.1,
    )  # fmt: skip
    open_size: float = _parameter(
        0.0, "mesh", "target edge length far from walls, above mesh_size (the length at walls); 0: mesh_size "
        "everywhere", unit="m", least=0,
    )  # fmt: skip
    grading: float = _parameter(
        0.2, "mesh", "growth of the target edge length per metre away from walls, with open_size or pad",
        least=Above(0), most=1,
    )  # fmt: skip
    wall_size: float = _parameter(
        0.0, "mesh", "horizontal target edge length at walls, below mesh_size; 0: mesh_size",
        unit="m", least=0,
    )  # fmt: skip
    wall_growth: float = _parameter(
        1.2, "mesh", "with wall_size: ratio of each edge length to the one before it, away from a wall",
        least=Above(1), most=2,
    )  # fmt: skip
    refine: tuple[str, ...] = _parameter(
        (), "mesh", "box or circle with its own target edge length, x0,y0,x1,y1,SIZE or x,y,RADIUS,SIZE in "
        "coordinates of the region; repeatable", unit="m",
    )  # fmt: skip
    refine_areas: str = _parameter(
        UNSET, "mesh", "vector file of areas or lines, each with its own target edge length"
    )
    refine_attribute: str = _parameter("size", "mesh", "attribute of refine_areas with that length in metres")
    refine_growth: float = _parameter(
        1.2, "mesh", "with refine or refine_areas: ratio of each edge length to the one before it, away from a "
        "box or an area", least=Above(1), most=2,
    )  # fmt: skip
    focus: str = _parameter(
        UNSET, "mesh", "place of interest, x,y,RADIUS or x,y,RADIUS,SIZE: full detail and cells of SIZE (a "
        "quarter of mesh_size by default), rings of less detail and coarser cells around it, up to mesh_size",
        unit="m",
    )  # fmt: skip
    lod_zones: tuple[str, ...] = _parameter(
        (), "mesh", "zones with their own level of detail (2.2, 1.3, 1.2, 0C, 0B, 0A) and target edge length, at "
        "most mesh_size: circles x,y,RADIUS,LEVEL,SIZE, vector files of polygons with the attributes level and "
        "size, and rest,LEVEL outside of all zones, 2.2 by default; where zones overlap, the finest counts",
    )  # fmt: skip
    generalised: str = _parameter(
        UNSET, "mesh", "GeoPackage of citystitch generalise with the blocks of zones of level 0C, 0B and 0A"
    )
    pad: tuple[float | str, ...] = _parameter(
        (), "mesh", "width of a margin of bare ground around the region, which flattens outwards and has coarser "
        "cells: one for all sides, or west east south north; metres, or 5H for five times the height of the "
        "tallest building; empty: none", unit="m",
    )  # fmt: skip
    min_angle: float = _parameter(
        0.0, "mesh", "least angle of the plane mesh, except at sharp corners; 0: 28 for adaptive, 25 for layered",
        unit="degrees", source="paper, step 3.1", least=0, most=32,
    )  # fmt: skip
    domain_height: float | str = _parameter(
        100.0, "mesh", "height of the domain above the terrain: metres, or 6H for six times the height of the "
        "tallest building", unit="m", source="paper, step 3.2", least=Above(0),
    )  # fmt: skip
    top: str = _parameter(
        "terrain", "mesh", "top of the domain: it follows the smoothed terrain, or is flat, domain_height above "
        "the highest terrain of the region", choices=("terrain", "flat"),
    )  # fmt: skip
    first_layer: float = _parameter(
        0.0, "mesh", "height of the lowest cells above open ground, from which vertical spacing grows; 0: the "
        "same spacing at all heights", unit="m", least=0,
    )  # fmt: skip
    layer_growth: float = _parameter(
        1.2, "mesh", "with first_layer: ratio of each layer height to the one below it", least=1, most=3
    )
    underground: float = _parameter(
        0.0, "mesh", "depth of the soil meshed below the terrain, with the ground as an interior surface; 0: none",
        unit="m", least=0, most=10_000,
    )  # fmt: skip
    solids: bool = _parameter(
        False, "mesh", "fill buildings with cells too, from the terrain up to their roofs, conforming with the air"
    )
    mesher: str = _parameter(
        "adaptive", "mesh", "how columns are filled: each by its own levels, or by the paper's layers",
        source="paper, steps 3.2-3.5", choices=("adaptive", "layered"),
    )  # fmt: skip
    least_spacing: float = _parameter(
        0.1, "mesh", "least vertical spacing with mesher = adaptive, in mesh sizes", least=Above(0), most=1
    )
    most_spacing: float = _parameter(
        0.8, "mesh", "largest vertical spacing with mesher = adaptive, in mesh sizes", least=Above(0), most=5
    )
    stagger: float = _parameter(
        0.8, "mesh", "shift of neighbouring columns with mesher = adaptive; 0 for none, 1 for thirds of a step",
        least=0, most=1,
    )  # fmt: skip
    improve_passes: int = _parameter(
        1, "mesh", "rounds of moving levels at the worst cells with mesher = adaptive", least=0, most=20
    )
    layer_height: float = _parameter(
        0.0, "mesh", "height of a layer with mesher = layered; 0: the mesh size", unit="m",
        source="paper, step 3.2", least=0,
    )  # fmt: skip
    smoother: str = _parameter(
        "columns", "mesh", "with mesher = layered: fast filter and column solver, or the paper's finite elements",
        source="paper, steps 3.3 and 3.5", choices=("columns", "fem"),
    )  # fmt: skip
    smoothing_tolerance: float = _parameter(
        0.003,
        "mesh",
        "largest residual over the diagonal with smoother = columns; heights are then within about "
        "ten times this of the exact solution",
        unit="m",
        least=Above(0),
    )
    fem_tolerance: float = _parameter(
        1e-8, "mesh", "relative residual of the linear systems with smoother = fem", least=Above(0), most=1e-2
    )
    tile_size: float = _parameter(
        0.0,
        "run",
        "side of a tile, at least 14 mesh sizes; tiles are aligned to multiples of it in the CRS; 0: 1250 m, and "
        "less for meshes finer than 10 m (660 m for 5 m, 350 m for 2.5 m), which have more cells",
        unit="m",
        least=0,
    )
    workers: int = _parameter(
        0, "run", "worker processes on this machine; 0 runs in this process", least=0, most=1024
    )
    memory_limit: float = _parameter(
        0.0, "run", "memory of a worker on this machine; 0: nine tenths of the machine's memory, divided by the "
        "workers", unit="GiB",
        least=0,
    )  # fmt: skip
    time_limit: float = _parameter(
        3600.0, "run", "a task that takes longer in a single-threaded worker is ended; 0: no limit", unit="s",
        least=0,
    )  # fmt: skip
    retries: int = _parameter(
        1, "run", "number of times that a failed task is repeated before its tile is left out", least=0, most=100
    )
    store_patience: float = _parameter(
        600.0, "run", "time that a run waits for the bucket of its results if it does not answer: less than the "
        "15 minutes for which S3 accepts a signed request", unit="s", least=0, most=840,
    )  # fmt: skip
    scheduler: str = _parameter(
        UNSET, "run", "address of a running Dask scheduler, whose workers see the same files; instead of workers"
    )
    tls_ca: str = _parameter(
        UNSET, "run", "with a scheduler at tls://: certificate file of the cluster's authority; empty: that of "
        "Dask's configuration",
    )  # fmt: skip
    tls_cert: str = _parameter(UNSET, "run", "likewise: certificate file of this client")
    tls_key: str = _parameter(UNSET, "run", "likewise: file of its key; empty: the key is in the certificate file")
    cluster: str = _parameter(
        UNSET,
        "run",
        "TOML file that describes a cluster, whose batch system starts the workers; instead of workers",
    )
    allow_empty: bool = _parameter(
        False, "run", "accept a mesh without buildings although footprints were given; else the run fails"
    )
    out: str = _parameter("out", "run", "folder for the results, or s3://BUCKET/NAME")
    keep: str = _parameter(
        KEPT[0], "run", "what stays in the folder of a run that is done: store, the results of all steps, from "
        "which the mesh is written again; pieces, of the mesh, with the terrain for check; or both", choices=KEPT,
    )  # fmt: skip
    overwrite: bool = _parameter(
        False, "run", "remove the results of an earlier run in that folder, and start anew"
    )

    @property
    def on_cluster(self) -> bool:
        """Whether workers are of a cluster, not of this machine."""
        return bool(self.scheduler or self.cluster)

    @property
    def has_buildings(self) -> bool:
        """Whether any file of buildings is given: footprints or a city model."""
        return bool(self.footprints or self.buildings)

    @property
    def sources(self) -> tuple[str, ...]:
        """All that is given of points, buildings in space, and terrain."""
        return (*self.pointcloud, *self.buildings, *self.terrain)

    @property
    def inputs(self) -> list[str]:
        """All inputs, as they were given."""
        given: list[str] = []
        for name in INPUTS:
            value = self.zones_asked.files if name == "lod_zones" else getattr(self, name)
            given += [value] if isinstance(value, str) else value
        return list(filter(None, given))

    @property
    def building_files(self) -> tuple[str, ...]:
        """Files of buildings: of a city model, and footprints."""
        return (*self.buildings, *filter(None, [self.footprints]))

    @property
    def has_sloped_roofs(self) -> bool:
        """Whether roofs may slope: they are asked for, and the mesher and the simplification know them."""
        return self.roofs != "flat" and not roofs_stay_flat(self.mesher, self.simplify)

    @property
    def keeps_model_roofs(self) -> bool:
        """Whether roofs of a city model are meshed as they are."""
        return bool(self.buildings) and self.has_sloped_roofs and self.prefer == "model"

    @property
    def padded(self) -> bool:
        """Whether there is a pad around the region."""
        return any(width != 0 for width in self.pad)

    @property
    def refined(self) -> bool:
        """Whether walls or areas are finer than the rest."""
        return bool(self.wall_size or self.refine or self.refine_areas or self.zoned)

    @property
    def zoned(self) -> bool:
        """Whether places have levels of detail of their own."""
        return bool(self.focus or self.lod_zones)

    @property
    def has_blocks(self) -> bool:
        """Whether blocks of generalised buildings may stand for those of some zones."""
        return bool(self.zoned and self.generalised)

    @cached_property
    def zones_asked(self) -> ZonesAsked:
        """What options say of zones."""
        return read_zones_asked(
            self.lod_zones, self.focus, mesh_size=self.mesh_size, blocks=bool(self.generalised)
        )

    @cached_property
    def refinements_asked(self) -> list[tuple[float, tuple[float, ...]]]:
        """Boxes and circles with a size of their own, as `read_refinement` gives them."""
        return [read_refinement(text, self.largest_size) for text in self.refine]

    @property
    def finest_size(self) -> float:
        """Target edge length (m) that the city model is made for: that of the finest circle of all zones."""
        if not self.zoned:
            return self.mesh_size
        return min([self.mesh_size, *(circle.size for circle in self.zones_asked.circles)])

    @property
    def covered(self) -> bool:
        """Whether the ground has patches."""
        return bool(self.land_cover or self.water_points)

    @property
    def has_trees(self) -> bool:
        """Whether cells between leaves are marked."""
        return bool(self.vegetation_classes or self.trees)

    @property
    def largest_size(self) -> float:
        """Largest target edge length within the region (m)."""
        return self.open_size or self.mesh_size

    @property
    def graded_size(self) -> float:
        """Largest target edge length of region and pad where sizes are graded (m); 0 where all are the same.

        Without ``open_size`` that of the pad is three times the mesh size, or as much as the size of tiles allows
        and, with the adaptive mesher, a height of the domain in metres.
        """
        if self.open_size or not self.padded:
            return self.open_size
        most = self.tile_size_or_default / LEAST_TILE
        if self.mesher == "adaptive" and not isinstance(self.domain_height, str):
            most = min(most, self.domain_height / (2 * self.most_spacing))
        size = min(PAD_COARSENING * self.mesh_size, most * (1 - ROUNDING))
        return size if size > self.mesh_size else 0.0

    @property
    def layer_height_or_default(self) -> float:
        """Height of a layer (m): the mesh size where none is given."""
        return self.layer_height or self.mesh_size

    @property
    def tile_size_or_default(self) -> float:
        """Side of a tile (m), which follows the mesh size where none is given."""
        return self.tile_size or choose_tile_size(self.finest_size, self.largest_size)

    @property
    def expected_height(self) -> float:
        """Height of the domain (m); before there is a city model, a multiple is that of an expected building."""
        return height_in_metres(self.domain_height, EXPECTED_TALLEST)


def roofs_stay_flat(mesher: str, simplify: str) -> bool:
    """Whether roofs are flat whatever is asked: mesher = layered and simplify = paper know no others."""
    return mesher != "adaptive" or simplify != "clearance"


# Parameters that count only where another one has a certain value.
CONDITIONS = {
    "roof_percentile": ("roof_height", "percentile"),
    "clearance_floor": ("simplify", "paper"),
    "split_levels": ("simplify", "clearance"),
    "roof_group": ("simplify", "clearance"),
    "manifold": ("simplify", "clearance"),
    "least_spacing": ("mesher", "adaptive"),
    "most_spacing": ("mesher", "adaptive"),
    "stagger": ("mesher", "adaptive"),
    "improve_passes": ("mesher", "adaptive"),
    "layer_height": ("mesher", "layered"),
    "smoother": ("mesher", "layered"),
    "smoothing_tolerance": ("mesher", "layered"),
    "fem_tolerance": ("mesher", "layered"),
}
TLS = ("tls_ca", "tls_cert", "tls_key")
NAMED = ("generalised", *TLS)  # files that a message does not repeat
OF_FLAT_ROOFS = ("split_levels", "roof_group")
SOIL = ("least_spacing", "most_spacing", "stagger")  # of these, those that count for soil with either mesher


def idle_parameters(config: Config) -> list[str]:
    """Sentences about the parameters that are not at their default, but have no effect.

    Examples
    --------
    >>> idle_parameters(Config(smoother="fem"))
    ['smoother = fem has no effect: it counts with mesher = layered']
    """
    default = Config()
    others = config.refine or config.refine_areas or config.zoned
    idle: list[tuple[tuple[str, ...], object, str]] = [
        ((name,), getattr(config, other) == value or (config.underground and name in SOIL), f"{other} = {value}")
        for name, (other, value) in CONDITIONS.items()
    ]
    idle += [
        (("roof_price",), config.roofs == "planes" and config.has_sloped_roofs, "roofs = planes"),
        (("full_parts",), config.has_sloped_roofs, "roofs = planes, skeleton"),
        (OF_FLAT_ROOFS, not config.has_sloped_roofs, "roofs = flat"),
        (("finer_clearance",), config.keeps_model_roofs, "buildings whose roofs are meshed as they are"),
        (("grading",), config.graded_size, "open_size above 0"),
        (("wall_growth",), config.wall_size, "wall_size above 0"),
        (("refine_growth",), others, "refine, refine_areas, focus, lod_zones"),
        (("generalised",), config.zoned, "lod_zones, focus"),
        (("refine_attribute",), config.refine_areas, "refine_areas"),
        (("land_cover_field", "land_cover_table"), config.covered, "land_cover"),
        (("leaf_area_density", "leaf_column"), config.has_trees, "vegetation_classes, trees"),
        (("layer_growth",), config.first_layer, "first_layer above 0"),
        (TLS, config.scheduler, "scheduler"),
    ]

    def show(name: str) -> str:
        return name if name in NAMED else f"{name} = {getattr(config, name)}"

    return [
        f"{show(name)} has no effect: it counts with {what}"
        for names, counts, what in idle
        for name in names
        if not counts and getattr(config, name) != getattr(default, name)
    ]


def make_config(values: Mapping[str, Any]) -> Config:
    """Check the values of parameters and fill in defaults.

    Raises
    ------
    ConfigError
        With the parameter, its value against its bound, for a value of the wrong type or out of bounds.
    """
    hints = get_type_hints(Config)
    checked = {}
    for entry in dataclasses.fields(Config):
        if entry.name in values:
            value = _convert(entry.name, values[entry.name], hints[entry.name])
            _check_bounds(entry.name, value, entry.metadata)
            checked[entry.name] = value
    config = Config(**checked)
    if "clearance" not in checked and config.keeps_model_roofs:
        finer = config.finer_clearance if "finer_clearance" in checked else FINER_CLEARANCE
        config = dataclasses.replace(config, clearance=CLEARANCE_OF_MODELS, finer_clearance=finer)
    _check_together(config)
    return config


def with_absolute_inputs(config: Config) -> Config:
    """Name inputs such that they are found from any folder."""
    return dataclasses.replace(
        config, **{name: change_places(name, getattr(config, name), absolute) for name in INPUTS}
    )


def change_places(name: str, value: Any, change: Callable[[str], str]) -> Any:
    """Change the places that the value of a parameter of `INPUTS` names; what names none stays as it is."""
    if isinstance(value, (list, tuple)):
        return type(value)(change_places(name, item, change) for item in value)
    is_place = isinstance(value, str) and value and (name != "lod_zones" or is_file(value))
    return change(value) if is_place else value


def _convert(name: str, value: Any, wanted: Any) -> Any:
    if wanted == Height:
        wanted = str if isinstance(value, str) else float
        converted = _convert(name, value, wanted)
        return _read_shift(converted) if name == "shift_z" else read_height(converted, name)
    if get_origin(wanted) is tuple:
        if get_args(wanted)[0] is int and isinstance(value, str):
            value = _split_numbers(name, value)
        if isinstance(value, str) or not isinstance(value, (list, tuple)):
            value = [value]
        return tuple(_convert(name, item, get_args(wanted)[0]) for item in value)
    if isinstance(value, int) and abs(value) > MAX_INT:
        raise ConfigError(f"{name}: a whole number of {value.bit_length()} bits; at most 2^53 is taken")
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not wanted:
        raise ConfigError(f"{name} = {_shown(value)}: {wanted.__name__} expected, not {type(value).__name__}")
    if isinstance(value, str):
        _check_text(name, value)
        if name in (*INPUTS, "out"):
            check_url(value)
    return value


def _read_shift(value: Height) -> Height:
    """Read metres, or the word for what is measured."""
    if isinstance(value, float) or value.strip().lower() == AUTO:
        return value if isinstance(value, float) else AUTO
    try:
        return float(value)
    except ValueError:
        raise ConfigError(f"shift_z = {_shown(value)}: metres or {AUTO!r} expected") from None


def _split_numbers(name: str, text: str) -> list[int]:
    """Read whole numbers with commas between them, as the command line gives them."""
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise ConfigError(f"{name} = {_shown(text)}: whole numbers with commas expected, as 6,67") from None


def _check_text(name: str, text: str) -> None:
    if len(text) > MAX_TEXT:
        raise ConfigError(f"{name}: {len(text)} characters; at most {MAX_TEXT} are taken")
    allowed = "\n\r\t" if name == "crs" else ""  # WKT has lines
    if any(sign not in allowed and unicodedata.category(sign) == "Cc" for sign in text):
        raise ConfigError(f"{name} = {_shown(text)}: has control characters; write it without them")


def _shown(value: Any) -> str:
    """Show a value in a message; tables and lists by their kind alone, as they may be deep."""
    if isinstance(value, (dict, list)):
        return "{...}" if isinstance(value, dict) else "[...]"
    return shorten(repr(value), 100)


def _check_bounds(name: str, value: Any, data: Mapping[str, Any]) -> None:
    if data["choices"] and value not in data["choices"]:
        raise ConfigError(f"{name} = {_shown(value)}: must be one of {', '.join(data['choices'])}")
    if isinstance(value, tuple) and data["least"] is not None:
        for item in value:
            _check_bounds(name, item, data)
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return
    unit = f" {data['unit']}" if data["unit"] else ""
    least, most = data["least"], data["most"]
    if not math.isfinite(value):
        raise ConfigError(f"{name} = {value}: must be a finite number")
    if isinstance(least, Above) and not value > least:
        raise ConfigError(f"{name} = {value:g}{unit}: must be above {least:g}{unit}")
    if least is not None and not value >= least:
        raise ConfigError(f"{name} = {value:g}{unit}: must be at least {least:g}{unit}")
    if most is not None and not value <= most:
        raise ConfigError(f"{name} = {value:g}{unit}: must be at most {most:g}{unit}")


def _check_together(config: Config) -> None:
    if config.bounds:
        if len(config.bounds) != 4 or not all(math.isfinite(value) for value in config.bounds):
            raise ConfigError(f"bounds = {list(config.bounds)}: four finite numbers xmin ymin xmax ymax expected")
        xmin, ymin, xmax, ymax = config.bounds
        if xmax - xmin < config.mesh_size or ymax - ymin < config.mesh_size:
            raise ConfigError(
                f"bounds = {list(config.bounds)}: {xmax - xmin:g} x {ymax - ymin:g} m is smaller than one cell "
                f"of {config.mesh_size:g} m; give xmin ymin xmax ymax"
            )
    _check_classes(config.building_classes)
    if taken := sorted(set(config.vegetation_classes) & {*config.building_classes, *NO_BUILDINGS}):
        raise ConfigError(
            f"vegetation_classes = {_shown(config.vegetation_classes)}: {taken[0]} is of ground (2), water (9), "
            "noise (7, 18) or buildings (building_classes); leave it out"
        )
    _check_sources(config)
    if config.finer_clearance > config.clearance:
        raise ConfigError(
            f"finer_clearance = {config.finer_clearance:g} m: must be at most clearance = {config.clearance:g} m"
        )
    if config.clearance_floor > config.clearance:
        raise ConfigError(
            f"clearance_floor = {config.clearance_floor:g} m: must be at most clearance = {config.clearance:g} m"
        )
    _check_sizes(config)
    if config.least_spacing > config.most_spacing:
        raise ConfigError(
            f"least_spacing = {config.least_spacing:g}: must be at most most_spacing = {config.most_spacing:g}"
        )
    least = config.least_spacing * config.mesh_size
    if 0 < config.underground < least:
        raise ConfigError(
            f"underground = {config.underground:g} m: at least {least:g} m (least_spacing x mesh_size), the least "
            "height of a cell; raise it, lower --least-spacing, or give 0 for no soil"
        )
    spacing = largest_spacing(config, config.largest_size)
    if config.first_layer > spacing:
        size = "open_size" if config.open_size else "mesh_size"
        source = "layer_height" if config.mesher == "layered" else f"most_spacing x {size}"
        raise ConfigError(
            f"first_layer = {config.first_layer:g} m: at most the largest vertical spacing, {spacing:g} m "
            f"({source}); lower --first-layer"
        )
    if 0 < config.first_layer < LEAST_FIRST_LAYER * config.mesh_size:
        raise ConfigError(
            f"first_layer = {config.first_layer:g} m: at least {LEAST_FIRST_LAYER:g} of mesh_size = "
            f"{config.mesh_size:g} m; raise --first-layer or lower --mesh-size"
        )
    _check_pad(config)
    _check_zones(config)
    _check_way(config)
    if not isinstance(config.domain_height, str):
        check_height(config, config.domain_height)


def _check_sizes(config: Config) -> None:
    if config.open_size and config.open_size <= config.mesh_size:
        raise ConfigError(
            f"open_size = {config.open_size:g} m: must be above mesh_size = {config.mesh_size:g} m; 0 takes "
            "mesh_size everywhere"
        )
    if config.wall_size and not LEAST_SIZE <= config.wall_size < config.mesh_size:
        raise ConfigError(
            f"wall_size = {config.wall_size:g} m: must be at least {LEAST_SIZE:g} m and below mesh_size = "
            f"{config.mesh_size:g} m; 0 takes mesh_size"
        )
    _ = config.refinements_asked


def _check_zones(config: Config) -> None:
    if not config.zoned:
        return
    if not config.has_sloped_roofs:
        raise ConfigError(
            f"zones of detail with roofs = {config.roofs}, mesher = {config.mesher}, simplify = "
            f"{config.simplify}: level 2.2 has sloped roofs; give --roofs planes or skeleton, with --mesher "
            "adaptive and --simplify clearance"
        )
    asked = config.zones_asked
    check_blocks([asked.rest, *(circle.level for circle in asked.circles)], config, "lod_zones")


def check_blocks(levels: Iterable[str], config: Config, subject: str) -> None:
    """Raise ConfigError if a level takes blocks, and there are none; `subject` begins the message."""
    found = sorted({level for level in levels if level in BLOCKS})
    if found and not config.generalised:
        raise ConfigError(
            f"{subject}: level {found[0]} takes blocks of generalised buildings; make them with `citystitch "
            "generalise` and give --generalised FILE.gpkg"
        )


def read_refinement(text: str, largest: float) -> tuple[float, tuple[float, ...]]:
    """Read a box or a circle with a size of its own: x0,y0,x1,y1,SIZE or x,y,RADIUS,SIZE (m).

    Parameters
    ----------
    text : str
        As the command line gives it.
    largest : float
        Target edge length of the rest (m), which the size is below.

    Returns
    -------
    float
        The size (m).
    tuple of 4 or 3 floats
        xmin, ymin, xmax, ymax of the box; x, y and radius of the circle (m).

    Raises
    ------
    ConfigError
        If it is no such box or circle.

    Examples
    --------
    >>> read_refinement("30,0,10,20,2.5", 10.0)
    (2.5, (10.0, 0.0, 30.0, 20.0))
    >>> read_refinement("30,0,100,2.5", 10.0)
    (2.5, (30.0, 0.0, 100.0))
    """
    subject = f"refine = {_shown(text)}"
    try:
        *place, size = (float(word) for word in text.split(","))
    except ValueError:
        place, size = [], 0.0
    if len(place) not in (3, 4):
        raise ConfigError(
            f"{subject}: five numbers x0,y0,x1,y1,SIZE expected, or four of a circle: x,y,RADIUS,SIZE"
        )
    if not all(map(math.isfinite, place)):
        raise ConfigError(f"{subject}: a number is not finite; give metres in coordinates of the region")
    check_refinement(size, largest, subject)
    if len(place) == 3:
        if place[2] <= 0:
            raise ConfigError(f"{subject}: a radius of {place[2]:g} m; must be above 0")
        return size, tuple(place)
    x0, y0, x1, y1 = place
    if x0 == x1 or y0 == y1:
        raise ConfigError(f"{subject}: the box has no area; give x0,y0,x1,y1,SIZE")
    return size, (min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))


def check_refinement(size: float, largest: float, place: str) -> None:
    """Raise ConfigError if the size of an area is out of bounds (m); `place` begins the message."""
    if not LEAST_SIZE <= size < largest:
        raise ConfigError(
            f"{place}: a size of {size:g} m; must be at least {LEAST_SIZE:g} m and below that of the rest, "
            f"{largest:g} m"
        )


def _check_classes(classes: tuple[int, ...]) -> None:
    if not classes:
        raise ConfigError(
            f"building_classes is empty; give at least one, {BUILDING} in most clouds: where a file has none of "
            "them, roofs are found without"
        )
    for number in sorted(set(classes) & set(NO_BUILDINGS)):
        raise ConfigError(
            f"building_classes = {_shown(classes)}: {number} is ground (2), water (9) or noise (7, 18) and marks "
            "no buildings; leave it out"
        )


def _check_way(config: Config) -> None:
    """Check how and where the run takes place."""
    if 0 < config.tile_size < LEAST_SIDE:
        raise ConfigError(
            f"tile_size = {config.tile_size:g} m: at least {LEAST_SIDE:g} m; raise it, or give 0 for one that "
            "follows the mesh size"
        )
    if config.cluster and is_url(config.out):
        raise ConfigError(
            f"out = {config.out} with a cluster: jobs keep their scripts and logs in the output folder; give one "
            "of a file system that all nodes see"
        )
    if config.scheduler and config.cluster:
        raise ConfigError(
            f"scheduler = {_shown(config.scheduler)} and cluster = {_shown(config.cluster)}: workers are of one "
            "or the other; leave one out"
        )


def _check_sources(config: Config) -> None:
    if config.ground_filter and not config.pointcloud and (config.buildings or config.terrain):
        raise ConfigError("ground_filter = true without a point cloud, in which it finds the ground; leave it out")
    if config.ground_filter and config.terrain:
        raise ConfigError("ground_filter = true with terrain: ground is that of the rasters; leave one out")
    if config.prefer == "points" and not (config.buildings and config.pointcloud):
        raise ConfigError("prefer = points: takes city models beside a point cloud; leave it out, or give both")
    if config.shift_z == AUTO and not (config.buildings and config.terrain):
        raise ConfigError(
            f"shift_z = {AUTO}: takes city models and rasters of terrain; give it in metres: a run tells how many"
        )


def _check_pad(config: Config) -> None:
    if len(config.pad) not in (0, 1, 4):
        raise ConfigError(
            f"pad: {len(config.pad)} widths; give one for all sides, or four: west east south north (on the "
            "command line behind the point clouds)"
        )
    check_widths(config.pad, mesh_size=config.mesh_size, dtm_spacing=config.dtm_spacing)


def largest_spacing(config: Config, largest_size: float) -> float:
    """Largest vertical spacing (m), of either mesher, where edges are as long as that (m)."""
    if config.mesher == "layered":
        return config.layer_height_or_default
    return config.most_spacing * largest_size


def check_height(config: Config, height: float) -> None:
    """Refuse a domain of less than two layers.

    Raises
    ------
    ConfigError
        With the spacing against the height (m).
    """
    spacing = largest_spacing(config, max(config.largest_size, config.graded_size))
    if spacing <= height / 2:
        return
    shown = f"domain_height = {height:g} m"
    if isinstance(config.domain_height, str):
        shown = f"domain_height = {config.domain_height}, here {height:g} m"
    if config.mesher == "layered":
        raise ConfigError(
            f"layer height {spacing:g} m: at most half of {shown}; lower --layer-height or raise --domain-height"
        )
    name = "open_size" if config.open_size else "mesh_size"
    move = f"lower --most-spacing or --{name.replace('_', '-')}"
    if config.graded_size and not config.open_size:
        name, move = f"the pad's size of {config.graded_size:g} m", "lower --most-spacing, give an --open-size"
    raise ConfigError(
        f"vertical spacing of up to {spacing:g} m (most_spacing x {name}): at most half of {shown}; {move}, or "
        "raise --domain-height"
    )
